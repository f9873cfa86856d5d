"""The problem that every method solves, and its answer by two roads that share no code with any of them.

Readings of an angle at irregular times; noise: angle random walk N, one Gauss–Markov drift (σ, τ) integrated to the
angle, white noise of each reading, an initial angle error and a stationary drift. Φ is given, dense and
smooth. Wanted is

    G = ΦᵀV⁻¹Φ + diag(prior)   (forward)   and   f = log det G with its gradient in Φ and in all N durations.

The prior is a millionth of the data's own information: the methods that put the parameters into the state need one.
"""

from typing import NamedTuple

import numpy as np

_DEG = np.pi / 180.0


class Problem(NamedTuple):
    """`columns` `(N, p)` and standard deviations in rad, or in deg with `per_rad` 57.3; durations s."""

    columns: np.ndarray
    durations: np.ndarray
    angle_random_walk: float
    drift_std: float
    correlation_time: float
    reading_std: float
    prior: np.ndarray
    per_rad: float


def make_problem(count: int, parameters: int, unit: str = "rad", seed: int = 0) -> Problem:
    """0.1 deg/√h, 1 deg/h over 120 s, readings of 0.05° at 1 s with 10 % of jitter."""
    rng = np.random.default_rng(seed)
    durations = 1.0 + 0.1 * rng.uniform(-1.0, 1.0, count)
    time = np.cumsum(durations)
    columns = smooth_columns(time, time[-1], parameters, rng)
    prior = 1e-6 * np.sum(columns**2, axis=0) / (0.05 * _DEG) ** 2
    per_rad = {"rad": 1.0, "deg": 1.0 / _DEG}[unit]
    return Problem(
        columns * per_rad,
        durations,
        0.1 * _DEG / 60.0 * per_rad,
        1.0 * _DEG / 3600.0 * per_rad,
        120.0,
        0.05 * _DEG * per_rad,
        prior,
        per_rad,
    )


def smooth_columns(time, span, parameters: int, rng: np.random.Generator) -> np.ndarray:
    """Growing waves of random phase, as the integral of a scale factor's functions over a long plan may be."""
    phase = rng.uniform(0.0, 2.0 * np.pi, parameters)
    cycles = 0.7 * np.arange(1, parameters + 1) + rng.uniform(0.0, 0.5, parameters)
    u = (np.asarray(time) / span)[:, None]
    return (0.2 + u) * np.cos(2.0 * np.pi * cycles * u + phase)


def state_space(problem: Problem, durations, xp):
    """`F_θx, F_xx, Q_θθ, Q_θx, Q_xx` of each step, over NumPy (any precision) or JAX; series where forms cancel."""
    tau = problem.correlation_time
    x = durations / tau
    faded = -xp.expm1(-x)
    power = 2 * problem.drift_std**2 / tau
    # (2x − 3 + 4e^(−x) − e^(−2x))/2 = x³/3 − x⁴/4 + …: twelve terms reach 1e-19 for x below 0.1, as all are.
    cubic, term = xp.zeros_like(x), x**3 / 6
    for k in range(12):
        cubic = cubic + term * (2.0 ** (k + 2) - 2.0) * (-1.0) ** k
        term = term * x / (k + 4)
    angle = problem.angle_random_walk**2 * durations + power * tau**3 * cubic
    return tau * faded, 1 - faded, angle, power * tau**2 * faded**2 / 2, power * tau * -xp.expm1(-2 * x) / 2


def covariance(problem: Problem, durations, xp):
    """`Var θ, Cov(θ, x)` of the noise state at each reading: the ingredients of a semiseparable V."""
    tau, time = problem.correlation_time, xp.cumsum(durations)
    x = time / tau
    faded = -xp.expm1(-x)
    spread = problem.reading_std**2 + problem.angle_random_walk**2 * time
    # The drift starts stationary, so this is 2σ²τ²(t/τ − 1 + e^(−t/τ)), which loses four digits at the first reading.
    return spread + 2 * problem.drift_std**2 * tau**2 * (x - faded), problem.drift_std**2 * tau * faded


def dense_information(problem: Problem) -> np.ndarray:
    """Generalised least squares with the whole N × N covariance, in float64."""
    from scipy.linalg import cholesky, solve_triangular

    angle, cross = covariance(problem, problem.durations, np)
    time = np.cumsum(problem.durations)
    tau = problem.correlation_time
    earlier = np.minimum.outer(np.arange(len(time)), np.arange(len(time)))
    apart = np.abs(np.subtract.outer(time, time))
    noise = angle[earlier] + cross[earlier] * tau * -np.expm1(-apart / tau)
    noise[np.diag_indices_from(noise)] += problem.reading_std**2
    white = solve_triangular(cholesky(noise, lower=True, overwrite_a=True), problem.columns, lower=True)
    return white.T @ white + np.diag(problem.prior)


def exact_information(problem: Problem, durations=None, columns=None) -> np.ndarray:
    """The same by the textbook recursion, one reading after the other, in extended precision (80 bits on x86)."""
    wide = np.longdouble
    durations = np.asarray(problem.durations if durations is None else durations, wide)
    columns = np.asarray(problem.columns if columns is None else columns, wide)
    exact = problem._replace(
        **{
            name: wide(getattr(problem, name))
            for name in ("angle_random_walk", "drift_std", "correlation_time", "reading_std")
        }
    )
    to_angle, kept, q_angle, q_cross, q_drift = state_space(exact, durations, np)
    read = exact.reading_std**2
    p00, p01, p11 = read, wide(0), exact.drift_std**2
    angle = np.zeros(columns.shape[1], wide)
    drift = np.zeros(columns.shape[1], wide)
    white = np.empty_like(columns)
    for k in range(len(durations)):
        f, g = to_angle[k], kept[k]
        p00, p01, p11 = (
            p00 + 2 * f * p01 + f * f * p11 + q_angle[k],
            g * (p01 + f * p11) + q_cross[k],
            g * g * p11 + q_drift[k],
        )
        angle, drift = angle + f * drift, g * drift
        spread = p00 + read
        white[k] = (columns[k] - angle) / np.sqrt(spread)
        a, b = p00 / spread, p01 / spread
        error = columns[k] - angle
        angle, drift = angle + a * error, drift + b * error
        p00, p01, p11 = p00 - a * p00, p01 - a * p01, p11 - b * p01
    return white.T @ white + np.diag(np.asarray(problem.prior, wide))


def exact_log_det(information: np.ndarray) -> np.longdouble:
    """`log det` in extended precision, by elimination (LAPACK has no such precision)."""
    a, total = information.copy(), np.longdouble(0)
    for k in range(len(a)):
        total += np.log(a[k, k])
        a[k + 1 :, k + 1 :] -= np.outer(a[k + 1 :, k], a[k, k + 1 :]) / a[k, k]
    return total


def directions(problem: Problem) -> list[tuple[np.ndarray, np.ndarray]]:
    """Random directions in which gradients are compared: all durations, all of Φ, both.

    Steps in Φ are small: white rows hold far more information than smooth ones, so log det G bends early.
    """
    rng = np.random.default_rng(1)
    some = [rng.standard_normal(problem.durations.shape) for _ in range(3)]
    many = [0.05 * rng.standard_normal(problem.columns.shape) * problem.per_rad for _ in range(3)]
    return [(some[0], 0.0 * many[0]), (0.0 * some[1], many[1]), (some[2], many[2])]


def exact_slopes(problem: Problem) -> np.ndarray:
    """Derivatives of `log det G` in the three directions, by fourth-order central differences in extended precision."""
    step = np.longdouble(2e-5)
    slopes = []
    for some, many in directions(problem):

        def value(s, some=some, many=many):
            return exact_log_det(exact_information(problem, problem.durations + s * some, problem.columns + s * many))

        slopes.append((8 * (value(step) - value(-step)) - (value(2 * step) - value(-2 * step))) / (12 * step))
    return np.array(slopes)


def slopes_of(gradient: tuple[np.ndarray, np.ndarray], problem: Problem) -> np.ndarray:
    """A method's gradient `(∂/∂Φ, ∂/∂durations)` in the same directions."""
    by_columns, by_durations = gradient
    return np.array([np.sum(by_durations * some) + np.sum(by_columns * many) for some, many in directions(problem)])


def information_error(found: np.ndarray, exact: np.ndarray) -> float:
    """Largest error of an entry, as a share of what the two diagonal entries allow."""
    size = np.sqrt(np.diagonal(exact))
    return float(np.max(np.abs((found - exact) / np.outer(size, size))))
