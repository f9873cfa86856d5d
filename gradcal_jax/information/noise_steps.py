"""Steps of a linear-Gaussian noise system, and what the processes of a channel contribute to them.

State `x = [integral of the error, one entry per process, …]`. Over a piece

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
from gradcal_jax.model import Processes
from gradcal_jax.motion import Trajectory, quadrature

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

    def moves(self) -> np.ndarray:
        """`(N,)`: whether a step precedes the reading."""
        return np.ones(len(self.used), bool) if self.stays is None else ~np.asarray(self.stays)

    def noise(self) -> "NoisePart":
        """All of the states' noise."""
        return NoisePart(self.covariance[self.moves()], self.initial)


class NoisePart(NamedTuple):
    """A part of a system's noise: its covariance in each of the `M` steps that precede a reading, and at the begin."""

    covariance: Float[AnyArray, "M n n"]
    initial: Float[AnyArray, "n n"]


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
    # e^(−λ(s−u)) = e^(−λs)/e^(−λu), as λD is small.
    fading = xp.exp(-x * nodes[None, None])
    faded = drive * fading
    h = duration * (faded @ _tail_integration().T) / fading
    d = duration[..., 0]
    diffusion = p.diffusion[None, :] ** 2
    to_angle = d * (faded @ weights)
    q_angle = diffusion * d * (h**2 @ weights)
    q_cross = diffusion * d * ((h * xp.exp(-x) / fading) @ weights)
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
