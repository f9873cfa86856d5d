"""Lower limits of the noise for any motion: a density that replaces the random walk's, and a variance for every plan.

**Drift and readings.** With readings at least Δ apart, of variance R each, N² may be replaced by the least over λ of

    S(λ) = N² + Σ 2σ²τ/(1 + λ²τ²) + R λ²/(1/Δ + ε/2 + λ²/(2ε))        for any ε > 0:

the integrated error is seen through a window of frequencies in which slow motion is limited by drift and fast motion
by the readings. No design avoids every frequency (large-sieve inequality); the best ε is taken.

**The bias.** Suppose that M(T, ω) is known and the error of the rate is observed at every instant instead of through
readings. Then generalised least squares in T gives the least covariance of B, and every reading is a function of this
observation. All noise that depends on the rate is left out.

**Processes that multiply the rate** (instability of the scale factor, an error of the temperature or of the sensor's
clock) cannot be distinguished from the scale factor itself. Suppose that `M(T, ω) + δ(t)` is observed at every rate at
once, whenever the axis has the table. Then `M(T, ω) − M(T, 0)` is known exactly, generalised least squares in T gives
M(T, 0), and every reading is a function of this observation. The information of a continuous observation of functions
f(t) = ψ(T(t)) under a Gauss–Markov process (σ, decay λ) is, with `f' = df/dt`, the windows [a, b] and φ = exp(−λ(a⁺ −
b)) between them,

    f(a₀)f(a₀)ᵀ/σ² + Σ ∫ (f' + λf)(f' + λf)ᵀ dt/(2σ²λ) + Σ (f(a⁺) − φf(b))(f(a⁺) − φf(b))ᵀ/(σ²(1 − φ²)),

exactly, whatever the correlation time (samples of a quick process would know less, and give a floor that is too high).
The variance of the best linear estimate under a sum of noises is at least the sum of the variances under each noise
alone, so these variances are added to that of the random walk. A prior is a reading, too, and its variance is divided:
half for the random walk, a quarter each for constant errors and for processes (priors seldom limit a plan, so that the
shares hardly matter).
"""

from collections.abc import Callable, Sequence
from itertools import pairwise

import jax
import numpy as np
from jaxtyping import Float

from gradcal_jax.information import square_root, whiten
from gradcal_jax.information.noise_steps import NoiseSteps, process_steps
from gradcal_jax.model import Basis, Map, Processes
from gradcal_jax.motion import quadrature

# Begin and end of windows, s; the sensor's temperature (°C) and its rate (K/s) at times (s).
Windows = Sequence[tuple[float, float]]
Course = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
# Shares of a prior's variance: see above.
PRIOR_OF_WALK = 0.5
_PRIOR_OF_OTHERS = 0.25
# Nodes in a window or a step; the step of a derivative in temperature, K; windows nearer than this touch, s.
_NODES = 12
_SMALL = 1e-4
_TOUCHING = 1e-6
# Distance of a window's ends from a jump, in windows; variance of a process's change at a jump, over its variance.
_INSET, _AT_ONCE = 1e-9, 1e-12
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
    p, basis = processes, scale.temperature
    variance = np.where(p.bias_gain == 0.0, p.rate_gain * p.initial_std, 0.0) ** 2
    same = np.kron(np.eye(basis.size), scale.rate.constant[:, None])
    prior = np.asarray(scale.prior_rows()) @ same / np.sqrt(_PRIOR_OF_OTHERS)
    floor = np.zeros(len(at))
    clock = float(np.sum(variance[p.decay == 0.0]))
    if clock > 0.0:
        # A constant error adds its variance to that of M, as far as the prior does not separate the two.
        floor += 1.0 / (np.sum((prior @ basis.constant) ** 2) + 1.0 / clock)
    moving = np.flatnonzero((variance > 0.0) & (p.decay > 0.0))
    for k in moving:
        seen = _continuous_look(basis, windows, course, float(variance[k]), float(p.decay[k]))
        known = square_root(np.concatenate([seen, np.sqrt(len(moving)) * prior]))
        floor += known.deviations(basis(at)) ** 2
    return floor


def _continuous_look(basis: Basis, windows: Windows, course: Course, variance: float, decay: float) -> np.ndarray:
    """Rows whose squares are the information of a continuous observation of the basis under a Gauss–Markov process."""
    edges = np.array(_at_breaks(basis, windows, course))
    nodes, weights = quadrature(_NODES)
    width = np.diff(edges, axis=1)
    t, of_time = course((edges[:, :1] + width * nodes).ravel())
    # A temperature step small enough for polynomials and splines to be straight.
    slope = (basis(t + _SMALL) - basis(t - _SMALL)) / (2.0 * _SMALL) * of_time[:, None]
    share = np.sqrt((width * weights).ravel() / (2.0 * variance * decay))
    inside = (slope + decay * basis(t)) * share[:, None]
    inset = _INSET * width[:, 0]
    begin, end = basis(course(edges[:, 0] + inset)[0]), basis(course(edges[:, 1] - inset)[0])
    # Where a function jumps and the process does not, the jump is observed directly.
    apart = edges[1:, 0] - edges[:-1, 1]
    kept = np.minimum(np.exp(-decay * apart), 1.0 - _AT_ONCE)[:, None]
    between = (begin[1:] - kept * end[:-1]) / np.sqrt(variance * (1.0 - kept**2))
    touch = apart <= _TOUCHING
    between[touch] = (begin[1:] - end[:-1])[touch] / np.sqrt(2.0 * variance * _AT_ONCE)
    return np.concatenate([begin[:1] / np.sqrt(variance), inside, between])


def _at_breaks(basis: Basis, windows: Windows, course: Course) -> list[tuple[float, float]]:
    """The windows, divided where the temperature, monotone in each, crosses a break of the basis."""
    from scipy import optimize

    edges: list[tuple[float, float]] = []
    for begin, end in windows:
        first, last = course(np.array([begin, end]))[0]
        cuts = []
        for value in basis.breaks:
            if min(first, last) < value < max(first, last):
                above = lambda t, value=value: float(course(np.array([t]))[0][0] - value)  # noqa: E731
                cuts.append(optimize.root_scalar(above, bracket=(begin, end)).root)
        edges += pairwise([begin, *sorted(cuts), end])
    return edges


def bias_seen_continuously(
    bias: Map, walk: float, processes: Processes, windows: Windows, course: Course, rows: np.ndarray
) -> Float[np.ndarray, " g"]:
    """Standard deviations, rad/s, of combinations `rows` `(g, p)` of a bias's parameters that no plan reduces.

    All else is known exactly and the error itself is observed at every instant of the `windows` (in order; the
    chamber's slope is constant in each), moving or not: every reading of any plan is a function of this observation.
    The noise is white (`walk`, rad/√s), with the processes that act at rate zero.
    """
    at_rest = jax.tree.map(lambda of: np.asarray(of)[np.asarray(processes.rate_gain) == 0.0], processes)
    divided = _at_breaks(bias.temperature, windows, course)
    step = min(_LONGEST_S, _SHARE_OF_CORRELATION / np.max(at_rest.decay, initial=1e-12))

    def variance(longest: float) -> np.ndarray:
        seen = _integrals_seen(bias, walk, at_rest, divided, course, longest)
        return square_root(np.concatenate([seen, bias.prior_rows()])).deviations(rows) ** 2

    # Integrals over steps have less information than instants: halving all further steps adds at most as much as this
    # one.
    coarse, fine = variance(step), variance(0.5 * step)
    return np.sqrt(np.maximum(fine - np.abs(coarse - fine), 0.0))


def _integrals_seen(
    bias: Map, walk: float, processes: Processes, windows: Windows, course: Course, longest: float
) -> np.ndarray:
    """Whitened rows of the error's integrals over steps of the windows, each no longer than `longest` s."""
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
    temperature = course((time[:-1, None] + lasting[:, None] * nodes).ravel())[0].reshape(len(lasting), -1)
    values = np.asarray(bias.values(temperature, np.zeros_like(temperature)))
    columns = lasting[:, None] * np.einsum("q,sqp->sp", weights, values)
    # State: the error's integral over the step, and the processes.
    driven, decayed, white, cross, own = process_steps(
        processes, lasting, np.zeros(len(lasting)), None, None, afresh=False
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
