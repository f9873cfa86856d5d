"""The noise states of a channel, one linear-Gaussian step for each piece of its timeline.

State `x = [integrated angle error, one entry per process, offset of the current standstill]`. Over a piece

    x⁺ = F x + w,  Cov w = Q,        reading: y = H x + v,  Var v = R

For a process with decay λ and diffusion q that drives the angle with the coefficient c(t) = α + γ·ω(t):

    F_θx = ∫ c(s) e^(−λs) ds,   h(u) = ∫_u^D c(s) e^(−λ(s−u)) ds,
    Q_θθ = q²∫h² du,            Q_θx = q²∫h e^(−λ(D−u)) du,          Q_xx = q²(1 − e^(−2λD))/(2λ)

At rest and at constant rate c is constant and these are closed forms; on ramps and curved moves they are integrated on
Gauss–Legendre nodes, `h` by the nodes' own integration matrix.
"""

from functools import lru_cache
from math import factorial
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from gradcal_jax.arrays import AnyArray, namespace, put
from gradcal_jax.model import Processes, SensorModel
from gradcal_jax.motion import Rule, Trajectory, quadrature

_NODES = 16


class NoiseSteps(NamedTuple):
    """`N` steps of a linear-Gaussian system with `n` states and one scalar reading a step (`used`: whether there is
    one). `stays`: true where no step precedes the reading: the transition is the identity, the covariance zero, and
    neither is differentiated.
    """

    transition: Float[AnyArray, "N n n"]
    covariance: Float[AnyArray, "N n n"]
    observation: Float[AnyArray, "N n"]
    reading_variance: Float[AnyArray, " N"]
    used: Bool[AnyArray, " N"]
    initial: Float[AnyArray, "n n"]
    stays: Bool[AnyArray, " N"] | None = None


def noise_steps(line: Trajectory, model: SensorModel, rule: Rule | None = None) -> NoiseSteps:
    """Steps of the noise alone, the parameters kept out of the state. `rule`: as of `posterior.at_readings`.

    The first reading is the angle's origin: its white noise and the offset of its standstill are the initial error of
    the angle state, an exact treatment of an unknown initial angle. A new origin is read at the end of a gap. With a
    held rate as the reference every point's angle begins at zero, and its error is one draw of the reference.
    """
    p, reference = model.processes, model.reference
    xp = namespace(line, model)
    # States: the angle, the processes, and the offset of a standstill where the model has one.
    m, count = p.count, line.piece_count
    offset = int(reference.has_offset and not line.rates)
    n = 1 + m + offset

    varying = line.varying_pieces
    driven = varying.shape[0] and ((xp is not np or np.any(p.rate_gain)) if rule is None else rule.driven)
    before = (xp.cumsum(xp.where(line.gap, 0, 1)) == 0)[:, None] if line.has_gaps else None
    along = (varying, drive_rates(line, varying)) if m and driven else None
    afresh = line.rates and line.points == "independent"
    drives = process_steps(p, line.duration, line.end_rate(), along, before, afresh=afresh)
    to_angle, decayed, driven_walk, q_cross, q_self = drives
    walk = model.angle_random_walk**2 * line.duration + driven_walk
    kept = xp.zeros((count, 1)) if line.rates else xp.ones((count, 1))
    none = xp.zeros((count, offset))
    first_row = xp.concatenate([kept, to_angle, none], axis=1)
    first_noise = xp.concatenate([walk[:, None], q_cross, none], axis=1)
    white = xp.asarray(0.0 if line.rates else reference.reading_noise**2)
    spread = reference.standstill_offset**2
    if line.has_gaps:
        # A new origin: the angle state is minus the error of the reference, its white noise and standstill offset.
        origin, gap = np.eye(n)[0] * 0.0, line.gap[:, None]
        if offset:
            origin[-1] = -1.0
        first_row = xp.where(gap, xp.asarray(origin)[None], first_row)
        first_noise = xp.where(gap, xp.asarray(np.eye(n)[:1]) * white, first_noise)
    # A move draws the offset of the next standstill; readings during the move have none.
    stands = xp.where(line.moving, 0.0, 1.0)[:, None]
    extra = [stands] * offset
    diagonal = xp.concatenate([xp.zeros((count, 1)), decayed, *extra], axis=1)
    noise = xp.concatenate([xp.zeros((count, 1)), q_self, *((1.0 - x) * spread for x in extra)], axis=1)
    states, below = np.arange(n), np.eye(n)[None, 1:]
    transition = xp.concatenate([first_row[:, None], below * diagonal[:, 1:, None]], axis=1)
    covariance = xp.concatenate([first_noise[:, 1:, None], (below * noise[:, 1:, None])[:, :, 1:]], axis=2)
    covariance = xp.concatenate([first_noise[:, None], covariance], axis=1)
    at_rest = xp.where(line.at_rest, 1.0, 0.0)[:, None]
    observation = xp.concatenate([xp.ones((count, 1)), xp.zeros((count, m)), *([at_rest] * offset)], axis=1)
    if line.rates:
        variance = xp.square(reference.rate_accuracy * line.turned())
        first = xp.zeros(1)
    else:
        on_the_move = xp.where(line.at_rest, 0.0, line.end_rate() * reference.timing_error)
        variance = white / line.share + on_the_move**2
        first = xp.reshape(white + offset * spread, (1,))
    initial = put(
        xp.zeros((n, n)),
        (states, states),
        xp.concatenate([first, p.initial_std**2, *([xp.reshape(spread, (1,))] * offset)]),
    )
    if offset:
        initial = put(initial, ([0, n - 1], [n - 1, 0]), -spread)
    return NoiseSteps(transition, covariance, observation, variance, line.read, initial)


def process_steps(
    p: Processes,
    duration: Float[AnyArray, " N"],
    rate: Float[AnyArray, " N"],
    varying: tuple[AnyArray, AnyArray] | None,
    before: AnyArray | None,
    *,
    afresh: bool,
) -> tuple[AnyArray, AnyArray, AnyArray, AnyArray, AnyArray]:
    """The part of `m` processes, which a rate drives, in the steps of an integral: F_θx and their decay `(N, m)`, the
    variance `(N,)` that they add to it, Q_θx and Q_xx `(N, m)`.

    `varying`: the steps in which the rate varies, and its values on the nodes there; `before` `(N, 1)`: steps before
    the data; `afresh`: the processes of every step start anew."""
    xp = namespace(duration, rate, p)
    to_integral, variance, cross, own = constant_drive(p, duration, rate)
    if varying is not None:
        steps, rates = varying
        by_rate = (p.rate_gain != 0.0)[None, :]
        # A process that the rate does not drive has a constant c, whose closed form holds for any correlation time.
        to_integral, variance, cross = (
            put(x, steps, xp.where(by_rate, y, x[steps]))
            for x, y in zip((to_integral, variance, cross), varying_drive(p, duration[steps], rates), strict=True)
        )
    decayed, start, total = (
        xp.exp(-p.decay[None] * duration[:, None]),
        (p.initial_std**2)[None],
        xp.sum(variance, axis=1),
    )
    if before is not None:
        # Every process begins with the data: the initial value of a random walk is part of the bias.
        decayed, own = xp.where(before, 1.0, decayed), xp.where(before, 0.0, own)
    if afresh:
        # The processes of a point start afresh, and drive its integral over the piece as over any other.
        total = total + xp.sum(to_integral**2 * start, axis=1)
        cross, own = cross + to_integral * decayed * start, own + decayed**2 * start
        to_integral, decayed = xp.zeros(to_integral.shape), xp.zeros(to_integral.shape)
    return to_integral, decayed, total, cross, own


def constant_drive(
    p: Processes, duration: Float[AnyArray, " P"], rate: Float[AnyArray, " P"]
) -> tuple[AnyArray, AnyArray, AnyArray, AnyArray]:
    """F_θx, Q_θθ, Q_θx, Q_xx of shape (P, m) for a constant c = α + γω: closed forms that stay exact as λD → 0."""
    d = duration[:, None]
    drive = p.bias_gain[None, :] + p.rate_gain[None, :] * rate[:, None]
    x = p.decay[None, :] * d
    g1, g2, g3 = _phi1(x), _phi1(2.0 * x), _chi(x)
    diffusion = p.diffusion[None, :] ** 2
    to_angle = drive * d * g1
    q_angle = diffusion * drive**2 * d**3 * g3
    q_cross = diffusion * drive * d**2 * 0.5 * g1**2
    return to_angle, q_angle, q_cross, diffusion * d * g2


def _phi1(x: AnyArray) -> AnyArray:
    """(1 − e^(−x))/x, and 1 at 0."""
    xp, small = namespace(x), x < 1e-8
    return xp.where(small, 1.0 - 0.5 * x, -xp.expm1(-x) / xp.where(small, 1.0, x))


def _chi(x: AnyArray) -> AnyArray:
    """(2x − 3 + 4e^(−x) − e^(−2x))/(2x³), and 1/3 at 0, by its series where the closed form loses digits."""
    xp, small = namespace(x), x < 0.3
    safe = xp.where(small, 1.0, x)
    closed = (2.0 * safe - 3.0 + 4.0 * xp.exp(-safe) - xp.exp(-2.0 * safe)) / (2.0 * safe**3)
    # Σ_{k≥0} (−x)^k (2^(k+3) − 4)/(2(k+3)!), from the exponentials' own series.
    within = xp.where(small, x, 0.0)
    series = xp.zeros_like(x)
    for k in reversed(range(16)):
        series = series * within + (2.0 ** (k + 3) - 4.0) / (2.0 * factorial(k + 3)) * (-1.0) ** k
    return xp.where(small, series, closed)


def drive_rates(line: Trajectory, pieces) -> Float[AnyArray, "k q"]:
    """Rates (rad/s) on the nodes of `varying_drive`."""
    nodes, _ = quadrature(_NODES)
    xp = namespace(line)
    return line.rate(xp.broadcast_to(xp.asarray(nodes), (pieces.shape[0], _NODES)), pieces)


def varying_drive(
    p: Processes, duration: Float[AnyArray, " k"], rate: Float[AnyArray, "k q"]
) -> tuple[AnyArray, AnyArray, AnyArray]:
    """F_θx, Q_θθ, Q_θx of shape (k, m) on pieces whose rate is `drive_rates`, for c = α + γω, by quadrature."""
    nodes, weights = quadrature(_NODES)
    xp = namespace(duration, rate, p)
    duration = duration[:, None, None]
    drive = p.bias_gain[None, :, None] + p.rate_gain[None, :, None] * rate[:, None, :]
    # Moves are divided to keep λD small only for the processes that the rate drives.
    x = xp.where(p.rate_gain != 0.0, p.decay, 0.0)[None, :, None] * duration
    # e^(−λ(s−u)) between all nodes, including those before u, which the interpolation needs.
    apart = xp.asarray(nodes[None, :] - nodes[:, None])
    fading = xp.exp(-x[..., None] * apart[None, None])
    h = duration * ((_tail_integration()[None, None] * fading) @ drive[..., None])[..., 0]
    d = duration[..., 0]
    diffusion = p.diffusion[None, :] ** 2
    at = nodes[None, None]
    to_angle = d * ((drive * xp.exp(-x * at)) @ weights)
    q_angle = diffusion * d * (h**2 @ weights)
    q_cross = diffusion * d * ((h * xp.exp(-x * (1.0 - at))) @ weights)
    return to_angle, q_angle, q_cross


@lru_cache(maxsize=1)
def _tail_integration() -> np.ndarray:
    """`S[u, s]` with `Σ_s S[u, s] f(s) = ∫_u^1 f`, exact for the polynomials that the nodes interpolate."""
    nodes, count = quadrature(_NODES)[0], _NODES
    x = 2.0 * nodes - 1.0
    values = np.polynomial.legendre.legvander(x, count - 1)
    integrals = np.zeros_like(values)
    for k in range(count):
        antiderivative = np.polynomial.legendre.legint(np.eye(count)[k])
        ends = np.polynomial.legendre.legval(np.append(x, 1.0), antiderivative)
        integrals[:, k] = (ends[-1] - ends[:-1]) / 2.0
    return integrals @ np.linalg.inv(values)
