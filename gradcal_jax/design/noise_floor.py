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
from typing import NamedTuple

import jax
import numpy as np
import scipy.linalg

from gradcal_jax.information import information
from gradcal_jax.model import SCALE_FACTOR, Basis, Map, Processes, SensorModel, gyro_model
from gradcal_jax.motion import Programme, held, quadrature

# Begin and end of windows, s; the sensor's temperature (°C) and its rate (K/s) at times (s).
Windows = Sequence[tuple[float, float]]
Course = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
# Shares of a prior's variance: see above.
PRIOR_OF_WALK = 0.5
_PRIOR_OF_OTHERS = 0.25
# Nodes in a window; the step of a derivative in temperature, K; windows nearer than this touch, s.
_NODES = 12
_SMALL = 1e-4
_TOUCHING = 1e-6
# Distance of a window's ends from a jump, in windows; variance of a process's change at a jump, over its variance.
_INSET, _AT_ONCE = 1e-9, 1e-12
# The time at the table is divided into at least this many equal parts of one temperature, two or more for each turn.
PARTS = 48
_AT_KNOT = 1e-6
# Longest step of a continuous observation: as a share of the shortest correlation time, and in s.
_SHARE_OF_CORRELATION = 0.05
_LONGEST_S = 5.0


def between_knots(windows: Windows, knots: np.ndarray) -> Windows:
    """The windows, divided where the chamber's slope changes."""
    parts: list[tuple[float, float]] = []
    for begin, end in windows:
        inside = knots[(knots > begin + _AT_KNOT) & (knots < end - _AT_KNOT)]
        parts += [(float(a), float(b)) for a, b in pairwise([begin, *inside, end])]
    return parts


def middles_of_parts(windows: Windows) -> np.ndarray:
    """The middles (s) of equal parts of all windows' time together."""
    count = max(PARTS, 2 * len(windows))
    begin, end = np.array(windows).T
    lasted = np.concatenate([[0.0], np.cumsum(end - begin)])
    middle = lasted[-1] * (np.arange(count) + 0.5) / count
    k = np.clip(np.searchsorted(lasted, middle, side="right") - 1, 0, len(begin) - 1)
    return begin[k] + middle - lasted[k]


def sensor_course(chamber: Programme, lag: float | None) -> Course:
    """The sensor's temperature (°C) and its rate (K/s) at any time (s)."""
    of = chamber.sensor(lag)

    def at(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        k = np.clip(np.searchsorted(of.times, t, side="right") - 1, 0, len(of.slope) - 1)
        since = t - of.times[k]
        fading = of.excess[k] * np.exp(-of.lag_rate * since)
        return of.level[k] + of.slope[k] * since + fading, of.slope[k] - of.lag_rate * fading

    return at


def scale_factor_floor(model: SensorModel, windows: Windows, temperature: Course, at: np.ndarray) -> np.ndarray:
    """`(len(at),)`, the variance of M at the temperatures `at` (°C) that no motion in the windows removes.

    `windows` (begin, end; s, in order): all times at which the axis may turn; the chamber's slope is constant in each.
    `temperature(t)`: the sensor's (°C), and its rate (K/s). A limit to which this is added may count only the share
    `PRIOR_OF_WALK` of the variance of the map's prior.
    """
    p, scale = model.processes, model.scale
    if scale is None:
        return np.zeros(len(at))
    gain = np.where(p.bias_gain == 0.0, p.rate_gain, 0.0)
    variance, decay = (gain * p.initial_std) ** 2, p.decay
    prior = _prior_of_constants(model) / _PRIOR_OF_OTHERS
    wanted = scale.temperature(at)
    floor = np.zeros(len(at))
    clock = float(np.sum(variance[decay == 0.0]))
    if clock > 0.0:
        # A constant error adds its variance to that of M, as far as the prior does not separate the two.
        one = _constant(scale.temperature)
        floor += 1.0 / (one @ prior @ one + 1.0 / clock)
    moving = np.flatnonzero((variance > 0.0) & (decay > 0.0))
    for k in moving:
        seen = _continuous_look(scale.temperature, windows, temperature, float(variance[k]), float(decay[k]))
        root = np.linalg.qr(np.concatenate([seen, root_of(len(moving) * prior)]), mode="r")
        floor += np.sum(scipy.linalg.solve_triangular(root, wanted.T, trans=1) ** 2, axis=0)
    return floor


def _continuous_look(basis: Basis, windows, temperature, variance: float, decay: float) -> np.ndarray:
    """Rows whose squares are the information of a continuous observation of the basis under a Gauss–Markov process."""
    edges = _divided(basis, windows, temperature)
    nodes, weights = quadrature(_NODES)
    width = np.diff(edges, axis=1)
    t, of_time = temperature((edges[:, :1] + width * nodes).ravel())
    # A temperature step small enough for polynomials and splines to be straight.
    slope = (basis(t + _SMALL) - basis(t - _SMALL)) / (2.0 * _SMALL) * of_time[:, None]
    share = np.sqrt((width * weights).ravel() / (2.0 * variance * decay))
    inside = (slope + decay * basis(t)) * share[:, None]
    inset = _INSET * width[:, 0]
    begin, end = basis(temperature(edges[:, 0] + inset)[0]), basis(temperature(edges[:, 1] - inset)[0])
    # Where a function jumps and the process does not, the jump is observed directly.
    kept = np.minimum(np.exp(-decay * (edges[1:, 0] - edges[:-1, 1])), 1.0 - _AT_ONCE)[:, None]
    between = (begin[1:] - kept * end[:-1]) / np.sqrt(variance * (1.0 - kept**2))
    touch = edges[1:, 0] - edges[:-1, 1] <= _TOUCHING
    between[touch] = (begin[1:] - end[:-1])[touch] / np.sqrt(2.0 * variance * _AT_ONCE)
    return np.concatenate([begin[:1] / np.sqrt(variance), inside, between])


def _divided(basis: Basis, windows, temperature) -> np.ndarray:
    """`(k, 2)`, the windows divided where the temperature, monotone in each, crosses a break of the basis."""
    edges: list[tuple[float, float]] = []
    for a, b in windows:
        at_a, at_b = (float(temperature(np.array([t]))[0][0]) for t in (a, b))
        crossed = [v for v in basis.breaks if min(at_a, at_b) < v < max(at_a, at_b)]
        cuts = sorted(_when(temperature, v, a, b) for v in crossed)
        edges += pairwise([a, *cuts, b])
    return np.array(edges)


def _when(temperature, value: float, a: float, b: float) -> float:
    """The time between two times at which the sensor passes a temperature."""
    from scipy import optimize

    return optimize.root_scalar(lambda t: float(temperature(np.array([t]))[0][0]) - value, bracket=(a, b)).root


def _prior_of_constants(model: SensorModel) -> np.ndarray:
    """The prior's information on the functions of temperature that are the same at every rate, in the basis."""
    scale = model.scale
    assert scale is not None
    same = np.eye(scale.temperature.size)
    if scale.rate is not None:
        same = np.kron(same, _constant(scale.rate)[:, None])
    rows = model.prior_rows()[:, model.where(SCALE_FACTOR)] @ same
    return rows.T @ rows


def _constant(basis: Basis) -> np.ndarray:
    """Coefficients of the function that is one everywhere; ±100 °C or rad/s cover all uses."""
    values = basis(np.linspace(-100.0, 100.0, 16 * basis.size))
    return np.linalg.lstsq(values, np.ones(len(values)), rcond=None)[0]


def root_of(matrix: np.ndarray) -> np.ndarray:
    """Rows with `rowsᵀ rows = matrix`, which may be singular."""
    values, vectors = np.linalg.eigh(matrix)
    return np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T


def least_noise_density(model: SensorModel, spacing: float) -> float:
    """`max_ε min_λ S(λ)` in rad²/s, for readings at least `spacing` s apart; never below N².

    Only processes that drive the angle at any rate (bias_gain) count, and only the white noise of a reading.
    """
    spectrum = _Spectrum(model)
    # Any ε gives a valid limit, so a grid is enough.
    return max(spectrum.walk, *(spectrum.least(np.exp(x), spacing) for x in np.linspace(-15.0, 10.0, 251)))


class _Spectrum:
    """S(λ) of a model: see the module's head."""

    def __init__(self, model: SensorModel):
        p = model.processes
        gain = np.where(np.asarray(p.rate_gain) == 0.0, np.asarray(p.bias_gain), 0.0)
        keep = gain * np.asarray(p.diffusion) != 0.0
        self.walk = float(model.angle_random_walk) ** 2
        self.variance = float(model.reference.reading_noise) ** 2
        self.decay = np.asarray(p.decay)[keep]
        # q²/(λ² + 1/τ²): for a Gauss-Markov process 2σ²τ/(1 + λ²τ²).
        self.drive = (gain * np.asarray(p.diffusion))[keep] ** 2

    def least(self, epsilon: float, spacing: float) -> float:
        square = np.concatenate([[0.0], np.geomspace(1e-7, 1e3, 4001)]) ** 2
        drift = np.sum(self.drive / np.maximum(square[:, None] + self.decay**2, 1e-300), axis=1)
        window = 1.0 / spacing + epsilon / 2.0 + square / (2.0 * epsilon)
        return float(np.min(self.walk + drift + self.variance * square / window))


def longest_step(processes: Processes) -> float:
    """The longest time step (s) of `bias_seen_continuously`."""
    decays = processes.decay[np.asarray(processes.rate_gain) == 0.0]
    return min(_LONGEST_S, _SHARE_OF_CORRELATION / np.max(decays, initial=1e-12))


def bias_seen_continuously(
    bias: Map, angle_random_walk: float, processes: Processes, windows: Windows, course: Course, rows: np.ndarray
) -> np.ndarray:
    """Standard deviations `(g,)`, rad/s, of combinations `rows` of a bias's parameters that no plan reduces.

    All else is known exactly and the error itself is observed at every instant of the `windows` (s, in order; the
    chamber's slope is constant in each), moving or not: every reading of any plan is a function of this observation.
    The noise is white (rad/√s), with the processes that act at rate zero.
    """
    at_rest = jax.tree.map(lambda of: of[np.asarray(processes.rate_gain) == 0.0], processes)
    alone = gyro_model(bias, None, angle_random_walk, at_rest)

    def variance(longest: float) -> np.ndarray:
        look = look_at(windows, course, longest)
        none = np.zeros(len(look.start), bool)
        line = held(
            look.start, look.duration, np.zeros(len(none)), look.begin, look.end,
            read=look.used, at_rest=~none, moving=none, gap=~look.used,
        )  # fmt: skip
        return information(line, alone).deviations(rows) ** 2

    # Integrals over steps have less information than instants: halving all further steps adds at most as much as this
    # one.
    step = longest_step(processes)
    coarse, fine = variance(step), variance(0.5 * step)
    return np.sqrt(np.maximum(fine - np.abs(coarse - fine), 0.0))


class Look(NamedTuple):
    """Windows of time in steps, and the times between them: `start`, `duration` s, the temperature (°C) at their
    `begin` and `end`, and whether they belong to a window (`used`)."""

    start: np.ndarray
    duration: np.ndarray
    begin: np.ndarray
    end: np.ndarray
    used: np.ndarray


def look_at(windows: Windows, course: Course, longest: float) -> Look:
    """The windows in steps no longer than `longest` s."""
    edges, used = [np.array(windows[0][:1])], []
    for begin, end in windows:
        if begin - edges[-1][-1] > _TOUCHING:
            edges.append(np.array([begin]))
            used.append(np.zeros(1, bool))
        parts = max(1, int(np.ceil((end - begin) / longest * (1.0 - 1e-9))))
        edges.append(np.linspace(begin, end, parts + 1)[1:])
        used.append(np.ones(parts, bool))
    at = np.concatenate(edges)
    # The slope jumps at a knot, the temperature does not.
    temperature, _ = course(at)
    return Look(at[:-1], np.diff(at), temperature[:-1], temperature[1:], np.concatenate(used))
