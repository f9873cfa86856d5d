"""Lower limits of the noise for any motion: a density that replaces the random walk's, and a variance for every plan.

**Drift and readings.** With readings at least Δ apart, of variance R each, N² may be replaced by the least over λ of

    S(λ) = N² + Σ 2σ²τ/(1 + λ²τ²) + R λ²/(1/Δ + ε/2 + λ²/(2ε))        for any ε > 0:

the integrated error is seen through a window of frequencies in which slow motion is limited by drift and fast motion
by the readings. No design avoids every frequency (large-sieve inequality); the best ε is taken.

**A function of temperature** `ψ(T)ᵀβ` that is observed at every instant instead of through readings, under white noise
and Gauss–Markov processes together: generalised least squares has the least covariance of β, and every reading of any
plan is a function of this observation. So is

* the bias, if M(T, ω) is known, under the noise that acts at rate zero,
* M(T, 0), if `M(T, ω) + δ(t)` is observed at every rate at once whenever the axis has the table (`M(T, ω) − M(T, 0)` is
  then known exactly), under the processes δ that multiply the rate: instability of the scale factor, an error of the
  temperature or of the sensor's clock.

The variance of the best linear estimate under a sum of noises is at least the sum of the variances under each noise
alone, so that of M(T, 0) is added to the one under the random walk. A prior is a reading, too, and its variance is
divided: half for the random walk, a quarter each for constant errors and for processes (priors seldom limit a plan, so
that the shares hardly matter).
"""

from collections.abc import Callable, Sequence

import jax
import numpy as np
from jaxtyping import Float

from gradcal_jax.information import square_root, whiten
from gradcal_jax.information.noise_steps import NoiseSteps, process_steps
from gradcal_jax.model import Basis, Map, Processes
from gradcal_jax.motion import quadrature

# Begin and end of windows, s; the sensor's temperature (°C) at times (s).
Windows = Sequence[tuple[float, float]]
Course = Callable[[np.ndarray], np.ndarray]
# Shares of a prior's variance: see above.
PRIOR_OF_WALK = 0.5
_PRIOR_OF_OTHERS = 0.25
# Nodes in a step; windows nearer than this touch, s.
_NODES = 12
_TOUCHING = 1e-6
# Longest step of a continuous observation: as a share of the shortest correlation time, and in s.
_SHARE_OF_CORRELATION = 0.05
_LONGEST_S = 5.0


def least_noise_density(walk: float, processes: Processes, reading: float, spacing: float) -> float:
    """`max_ε min_λ S(λ)` in rad²/s of a random walk (rad/√s) and readings with a standard deviation (rad), at least
    `spacing` s apart; never below N². Only processes that drive the angle at any rate (bias_gain) count."""
    gain = np.where(processes.rate_gain == 0.0, processes.bias_gain, 0.0) * processes.diffusion
    square = np.concatenate([[0.0], np.geomspace(1e-7, 1e3, 4001)]) ** 2
    # q²/(λ² + 1/τ²): for a Gauss-Markov process 2σ²τ/(1 + λ²τ²).
    shared = square[:, None] + processes.decay**2
    noise = walk**2 + np.sum(np.where(gain == 0.0, 0.0, gain**2 / np.maximum(shared, 1e-300)), axis=1)
    # Any ε gives a valid limit, so a grid is enough.
    least = [walk**2]
    for epsilon in np.exp(np.linspace(-15.0, 10.0, 251)):
        window = 1.0 / spacing + epsilon / 2.0 + square / (2.0 * epsilon)
        least.append(float(np.min(noise + reading**2 * square / window)))
    return max(least)


def scale_factor_floor(
    scale: Map, processes: Processes, windows: Windows, course: Course, at: np.ndarray
) -> Float[np.ndarray, " n"]:
    """The variance of M at the temperatures `at` `(n,)`, °C, that no motion in the windows removes.

    `windows` (in order): all times at which the axis may turn; the chamber's slope is constant in each. A limit to
    which this is added may count only the share `PRIOR_OF_WALK` of the variance of the map's prior.
    """
    of_rate = processes.rate_gain * processes.initial_std * (processes.bias_gain == 0.0)
    basis, same = scale.temperature, np.kron(np.eye(scale.temperature.size), scale.rate.constant[:, None])
    prior = np.asarray(scale.prior_rows()) @ same / np.sqrt(_PRIOR_OF_OTHERS)
    floor, clock = np.zeros(len(at)), float(np.sum(of_rate[processes.decay == 0.0] ** 2))
    if clock > 0.0:
        # A constant error adds its variance to that of M, as far as the prior does not separate the two.
        floor += 1.0 / (np.sum((prior @ basis.constant) ** 2) + 1.0 / clock)
    if np.any(moving := (of_rate != 0.0) & (processes.decay > 0.0)):
        unsteady = jax.tree.map(lambda of: np.asarray(of)[moving], processes)
        floor += seen_continuously(basis, prior, 0.0, unsteady, windows, course, basis(at), rate=1.0) ** 2
    return floor


def seen_continuously(
    basis: Basis,
    prior: np.ndarray,
    walk: float,
    processes: Processes,
    windows: Windows,
    course: Course,
    rows: np.ndarray,
    *,
    rate: float = 0.0,
) -> Float[np.ndarray, " g"]:
    """Standard deviations of combinations `rows` `(g, p)` of the parameters of a function of temperature that no plan
    reduces: it is observed at every instant of the `windows` (in order; the chamber's slope is constant in each).

    `prior` `(q, p)`: whitened rows. The noise is white (`walk`, in the function's unit times √s), with the processes as
    they act at a `rate` (rad/s).
    """
    step = min(_LONGEST_S, _SHARE_OF_CORRELATION / np.max(processes.decay, initial=1e-12))

    def variance(longest: float) -> np.ndarray:
        seen = _integrals_seen(basis, walk, processes, windows, course, longest, rate)
        return square_root(np.concatenate([seen, prior])).deviations(rows) ** 2

    # Integrals over steps have less information than instants: halving all further steps adds at most as much as this
    # one.
    coarse, fine = variance(step), variance(0.5 * step)
    return np.sqrt(np.maximum(fine - np.abs(coarse - fine), 0.0))


def _integrals_seen(
    basis: Basis, walk: float, processes: Processes, windows: Windows, course: Course, longest: float, rate: float
) -> np.ndarray:
    """Whitened rows of the function's integrals over steps of the windows, each no longer than `longest` s."""
    edges, used = [np.array(windows[0][:1])], list[np.ndarray]()
    for begin, end in windows:
        if begin - edges[-1][-1] > _TOUCHING:
            edges.append(np.array([begin]))
            used.append(np.zeros(1, bool))
        parts = max(1, int(np.ceil((end - begin) / longest * (1.0 - 1e-9))))
        edges.append(np.linspace(begin, end, parts + 1)[1:])
        used.append(np.ones(parts, bool))
    time = np.concatenate(edges)
    lasting = np.diff(time)
    nodes, weights = quadrature(_NODES)
    values = basis(course(time[:-1, None] + lasting[:, None] * nodes))
    columns = lasting[:, None] * np.einsum("q,sqp->sp", weights, values)
    # State: the function's integral over the step, and the processes.
    driven, decayed, white, cross, own = process_steps(
        processes, lasting, np.full(len(lasting), rate), None, None, afresh=False
    )
    count = 1 + processes.count
    transition, covariance = np.zeros((2, len(lasting), count, count))
    transition[:, 0, 1:] = driven
    covariance[:, 0, 0] = walk**2 * lasting + white
    covariance[:, 0, 1:] = covariance[:, 1:, 0] = cross
    states = np.arange(1, count)
    transition[:, states, states], covariance[:, states, states] = decayed, own
    observed = np.tile(np.eye(count)[0], (len(lasting), 1))
    initial = np.diag(np.concatenate([[0.0], processes.initial_std**2]))
    return whiten(
        NoiseSteps(transition, covariance, observed, np.zeros(len(lasting)), np.concatenate(used), initial), columns
    )
