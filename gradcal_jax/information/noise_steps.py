"""The noise states of a channel, one linear-Gaussian step for each piece of its timeline.

State `x = [integrated angle error, one entry per process, offset of the current standstill]`. Over a piece

    x⁺ = F x + w,  Cov w = Q,        reading: y = H x + v,  Var v = R

For a process with decay λ and diffusion q that drives the angle with the coefficient c(t) = α + γ·ω(t):

    F_θx = ∫ c(s) e^(−λs) ds,   h(u) = ∫_u^D c(s) e^(−λ(s−u)) ds,
    Q_θθ = q²∫h² du,            Q_θx = q²∫h e^(−λ(D−u)) du,          Q_xx = q²(1 − e^(−2λD))/(2λ)

At rest and at constant rate c is constant and these are closed forms; on ramps and curved moves they are integrated on
Gauss–Legendre nodes, `h` by the nodes' own integration matrix.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from gradcal_jax.errormodel import GyroModel, Processes
from gradcal_jax.information.regressors import quadrature
from gradcal_jax.plans import Timeline

_NODES = 16


class NoiseSteps(NamedTuple):
    """`N` steps of a linear-Gaussian system with `n` states and one scalar reading a step (`used`:
    whether there is one).
    """

    transition: Float[Array, "N n n"]
    covariance: Float[Array, "N n n"]
    observation: Float[Array, "N n"]
    reading_variance: Float[Array, " N"]
    used: Bool[Array, " N"]
    initial: Float[Array, "n n"]


def noise_steps(timeline: Timeline, model: GyroModel) -> NoiseSteps:
    """Steps of the noise alone, the parameters kept out of the state.

    The first reading is the angle's origin: its white noise and its standstill's offset are the angle state's initial
    error, which is the exact treatment of an unknown initial angle.
    """
    p, reference = model.processes, model.reference
    m, offset = p.count, 1 if reference.has_offset else 0
    n, count = 1 + m + offset, timeline.piece_count
    duration = timeline.duration

    decayed = jnp.exp(-p.decay[None, :] * duration[:, None])
    to_angle, q_angle, q_cross, q_self = _constant_drive(p, duration, timeline.end_rate())
    varying = timeline.varying_pieces.values
    if m and len(varying):
        by_rate = (p.rate_gain != 0.0)[None, :]
        driven = _varying_drive(p, timeline, varying)
        # A process that the rate does not drive has a constant c, whose closed form holds for any correlation time.
        to_angle, q_angle, q_cross = (
            x.at[varying].set(jnp.where(by_rate, y, x[varying]))
            for x, y in zip((to_angle, q_angle, q_cross), driven, strict=True)
        )

    transition = jnp.zeros((count, n, n)).at[:, 0, 0].set(1.0)
    covariance = (
        jnp.zeros((count, n, n)).at[:, 0, 0].set(model.angle_random_walk**2 * duration + jnp.sum(q_angle, axis=1))
    )
    initial = jnp.zeros((n, n))
    observation = jnp.zeros((count, n)).at[:, 0].set(1.0)
    states = np.arange(1, 1 + m)
    transition = transition.at[:, 0, 1 : 1 + m].set(to_angle).at[:, states, states].set(decayed)
    covariance = covariance.at[:, states, states].set(q_self)
    covariance = covariance.at[:, 0, 1 : 1 + m].set(q_cross).at[:, 1 : 1 + m, 0].set(q_cross)
    initial = initial.at[states, states].set(p.initial_std**2)

    if timeline.rate_reference:
        held = jnp.square(reference.rate_accuracy * timeline.turned())
        transition = jnp.where(timeline.reset[:, None, None], 0.0, transition)
        # An independent point: its processes start afresh, and drive its angle over the piece as over any other.
        fresh = jnp.zeros((count, n, n)).at[:, 0, 0].set(1.0)
        fresh = fresh.at[:, 0, 1 : 1 + m].set(to_angle).at[:, states, states].set(decayed)
        started = jnp.einsum("kij,jl,kml->kim", fresh, initial, fresh)
        covariance = covariance + jnp.where(timeline.reset[:, None, None], started, 0.0)
        return NoiseSteps(transition, covariance, observation, held, timeline.read, initial)

    white = reference.reading_noise**2
    at_origin = white
    if offset:
        variance = reference.standstill_offset**2
        # A move leaves the old standstill and makes the next one's draw; its readings on the way see none.
        kept = jnp.where(timeline.moving, 0.0, 1.0)
        transition = transition.at[:, -1, -1].set(kept)
        covariance = covariance.at[:, -1, -1].set((1.0 - kept) * variance)
        observation = observation.at[:, -1].set(jnp.where(timeline.at_rest, 1.0, 0.0))
        initial = initial.at[-1, -1].set(variance).at[0, -1].set(-variance).at[-1, 0].set(-variance)
        at_origin = at_origin + variance
    initial = initial.at[0, 0].set(at_origin)
    gaps = timeline.gap_pieces.values
    if len(gaps):
        # A new origin: the angle state is minus what the reference says then, its white noise and its standstill's
        # offset.
        transition = transition.at[gaps, 0, :].set(jnp.zeros(n).at[n - 1].set(-1.0) if offset else 0.0)
        covariance = covariance.at[gaps, 0, :].set(0.0).at[gaps, :, 0].set(0.0).at[gaps, 0, 0].set(white)
    on_the_move = jnp.where(timeline.at_rest, 0.0, timeline.end_rate() * reference.timing_error)
    variance = jnp.asarray(white / timeline.share + on_the_move**2)
    return NoiseSteps(transition, covariance, observation, variance, timeline.read, initial)


def _constant_drive(
    p: Processes, duration: Float[Array, " P"], rate: Float[Array, " P"]
) -> tuple[Array, Array, Array, Array]:
    """F_θx, Q_θθ, Q_θx, Q_xx of shape (P, m) for a constant c = α + γω: closed forms that stay exact as λD → 0."""
    d = duration[:, None]
    drive = jnp.asarray(p.bias_gain[None, :] + p.rate_gain[None, :] * rate[:, None])
    x = jnp.asarray(p.decay[None, :] * d)
    g1, g2, g3 = _phi1(x), _phi1(2.0 * x), _chi(x)
    diffusion = jnp.square(p.diffusion)[None, :]
    to_angle = drive * d * g1
    q_angle = diffusion * drive**2 * d**3 * g3
    q_cross = diffusion * drive * d**2 * 0.5 * g1**2
    return to_angle, q_angle, q_cross, diffusion * d * g2


def _phi1(x: Array) -> Array:
    """(1 − e^(−x))/x, and 1 at 0."""
    small = x < 1e-8
    return jnp.where(small, 1.0 - 0.5 * x, -jnp.expm1(-x) / jnp.where(small, 1.0, x))


def _chi(x: Array) -> Array:
    """(2x − 3 + 4e^(−x) − e^(−2x))/(2x³), and 1/3 at 0, by its series where the closed form loses digits."""
    small = x < 0.3
    safe = jnp.where(small, 1.0, x)
    closed = (2.0 * safe - 3.0 + 4.0 * jnp.exp(-safe) - jnp.exp(-2.0 * safe)) / (2.0 * safe**3)
    # Σ_{k≥0} (−x)^k (2^(k+3) − 4)/(2(k+3)!), from the exponentials' own series.
    within = jnp.where(small, x, 0.0)
    series, factorial = jnp.zeros_like(x), 6.0
    coefficients = []
    for k in range(16):
        coefficients.append((2.0 ** (k + 3) - 4.0) / (2.0 * factorial) * (-1.0) ** k)
        factorial *= k + 4
    for c in reversed(coefficients):
        series = series * within + c
    return jnp.where(small, series, closed)


def _varying_drive(p: Processes, timeline: Timeline, pieces: np.ndarray) -> tuple[Array, Array, Array]:
    """F_θx, Q_θθ, Q_θx of shape (k, m) on the given pieces, for c = α + γω, by quadrature."""
    nodes, weights = quadrature(_NODES)
    tails = jnp.asarray(_tail_integration(nodes))
    w = jnp.asarray(weights)
    duration = timeline.duration[pieces][:, None, None]
    v = jnp.broadcast_to(jnp.asarray(nodes), (len(pieces), _NODES))
    rate = timeline.rate(v, pieces)[:, None, :]
    drive = p.bias_gain[None, :, None] + p.rate_gain[None, :, None] * rate
    # Moves are divided to keep λD small, but for the processes that the rate drives only.
    x = jnp.where(p.rate_gain != 0.0, p.decay, 0.0)[None, :, None] * duration
    # e^(−λ(s−u)) between all nodes: also those before u, which the interpolation needs.
    apart = jnp.asarray(nodes)[None, :] - jnp.asarray(nodes)[:, None]
    fading = jnp.exp(-x[..., None] * apart[None, None])
    h = duration * jnp.einsum("us,kmus,kms->kmu", tails, fading, drive)
    d = duration[..., 0]
    at = jnp.asarray(nodes)[None, None]
    diffusion = jnp.square(p.diffusion)[None, :]
    to_angle = d * jnp.einsum("s,kms,kms->km", w, drive, jnp.exp(-x * at))
    q_angle = diffusion * d * jnp.einsum("u,kmu->km", w, h**2)
    q_cross = diffusion * d * jnp.einsum("u,kmu,kmu->km", w, h, jnp.exp(-x * (1.0 - at)))
    return to_angle, q_angle, q_cross


def _tail_integration(nodes: np.ndarray) -> np.ndarray:
    """`S[u, s]` with `Σ_s S[u, s] f(s) = ∫_u^1 f`, exact for the polynomials that the nodes interpolate."""
    count = len(nodes)
    x = 2.0 * nodes - 1.0
    values = np.polynomial.legendre.legvander(x, count - 1)
    integrals = np.zeros_like(values)
    for k in range(count):
        antiderivative = np.polynomial.legendre.legint(np.eye(count)[k])
        ends = np.polynomial.legendre.legval(np.append(x, 1.0), antiderivative)
        integrals[:, k] = (ends[-1] - ends[:-1]) / 2.0
    return integrals @ np.linalg.inv(values)
