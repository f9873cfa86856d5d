"""Maximum-likelihood estimate of a random walk and a first-order Markov process in a record at rest, and its
covariance.

Source: P. Whittle, "The analysis of multiple stationary time series", J. R. Stat. Soc. B 15, 1953 (the likelihood in
the frequency domain). Rows are means over Δ of the rate; θ = (ln N, ln σ, ln τ), a = exp(−Δ/τ):

S(ω) = N²/Δ + c₀ + 2 c₁ (cos ω − a)/(1 − 2 a cos ω + a²) spectrum of such rows, exact c₀ = 2σ²τ²(Δ/τ − 1 + a)/Δ², c₁ =
σ²τ²(1 − a)²/Δ² −ln L = Σ_j [ln S(ω_j) + I_j/S(ω_j)], ω_j = 2πj/n, j = 1 … n/2; I the periodogram information = Σ_j ∂ln
S ∂ln Sᵀ

The record is taken as much longer than τ: below 20 τ the likelihood of frequencies leaks, and errors are larger.

**How well a record at rest of some length determines a gyro's noise, before it is recorded.** Of N, B and K the errors
are those of the fit of `allan`: Allan variances are drawn about the mixture's own, with the covariance that the fit
itself uses, and the coefficients fitted to them, none negative. Of a first-order Markov drift (σ, τ) they are those of
`markov`, the inverse of its information. The Direct Bound is no estimate but an upper limit.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy import optimize

from gradcal_jax import formulas
from gradcal_jax.identify.allan import averaging_times, design_of_noise, octaves, variance_covariance

_ROW_S = 1.0
# Twice the logarithm of likelihoods beyond which a process shows beside white noise: three degrees at 1 in 1000.
_SHOWS = 16.3
_FEWEST = 200


class MarkovFit(NamedTuple):
    """N `walk` (rad/√s), `sigma` (rad/s) and `tau` (s); `covariance` `(3, 3)` of their logarithms; `shows`: whether the
    process is seen beside white noise."""

    walk: float
    sigma: float
    tau: float
    covariance: np.ndarray
    shows: bool


def spectrum_of_means(omega: np.ndarray, row_s: float, walk: float, sigma: float, tau: float) -> np.ndarray:
    """S(ω) of means over `row_s` (s), ω in radians a row; the square of the rate's unit."""
    x = row_s / tau
    a, share = np.exp(-x), -np.expm1(-x)
    # (2(x − 1 + e⁻ˣ)/x², without its cancellation.)
    first = 2.0 * (x - share) / x**2 if x > 1e-4 else 1.0 - x / 3.0
    later = 2.0 * (share / x) ** 2 * (np.cos(omega) - a) / (1.0 - 2.0 * a * np.cos(omega) + a**2)
    return walk**2 / row_s + sigma**2 * (first + later)


def markov_covariance(duration_s: float, row_s: float, walk: float, sigma: float, tau: float) -> np.ndarray:
    """`(3, 3)`: covariance of the maximum-likelihood estimates of ln N, ln σ, ln τ from a record of rows of `row_s`."""
    count = int(duration_s / row_s)
    if count < _FEWEST:
        raise ValueError(f"{duration_s:g} s of data are {count} rows of {row_s:g} s: too few to determine a drift")
    omega = 2.0 * np.pi * np.arange(1, count // 2) / count
    here = np.log([walk, sigma, tau])

    def log_spectrum(theta: np.ndarray) -> np.ndarray:
        return np.log(spectrum_of_means(omega, row_s, *np.exp(theta)))

    step = 1e-4
    slopes = np.array([(log_spectrum(here + d) - log_spectrum(here - d)) / (2.0 * step) for d in step * np.eye(3)])
    return np.linalg.inv(slopes @ slopes.T)


def fit_markov(rate: np.ndarray, sample_interval_s: float, valid: np.ndarray) -> MarkovFit | None:
    """The process of the longest unbroken stretch of a record `(n,)`, rad/s; None where it is too short."""
    edges = formulas.runs(valid)
    if not len(edges):
        return None
    start, stop = edges[np.argmax(edges[:, 1] - edges[:, 0])]
    size = max(round(_ROW_S / sample_interval_s), 1)
    rows = rate[start : start + (stop - start) // size * size].reshape(-1, size).mean(axis=1)
    count, row_s = len(rows), size * sample_interval_s
    if count < _FEWEST or np.ptp(rows) == 0.0:
        return None
    power = np.abs(np.fft.rfft(rows - rows.mean())[1 : count // 2]) ** 2 / count
    omega = 2.0 * np.pi * np.arange(1, count // 2) / count

    def loss(theta: np.ndarray) -> float:
        with np.errstate(all="ignore"):
            spectrum = spectrum_of_means(omega, row_s, *np.exp(theta))
            value = float(np.sum(np.log(spectrum) + power / spectrum))
        return value if np.isfinite(value) else 1e300

    white = float(np.sqrt(np.mean(power) * row_s))
    alone = float(np.sum(np.log(np.mean(power)) + power / np.mean(power)))
    quiet = float(np.sqrt(np.median(power[len(power) // 2 :]) / np.log(2.0) * row_s))
    least, longest = np.log(2.0 * row_s), np.log(count * row_s / 4.0)
    best = None
    for tau in np.exp(np.linspace(least + 1.0, longest - 0.5, 4)):
        sigma = np.sqrt(max(np.var(rows) - quiet**2 / row_s, 1e-3 * np.var(rows)))
        begin = np.log([min(quiet, white), sigma, tau])
        bounds = [(begin[0] - 5.0, np.log(white) + 1.0), (begin[1] - 10.0, begin[1] + 10.0), (least, longest)]
        one = optimize.minimize(loss, begin, method="L-BFGS-B", bounds=bounds)
        best = one if best is None or one.fun < best.fun else best
    assert best is not None
    walk, sigma, tau = np.exp(best.x).tolist()
    inside = least + 0.01 < best.x[2] < longest - 0.01
    shows = bool(2.0 * (alone - best.fun) > _SHOWS and inside)
    covariance = markov_covariance(count * row_s, row_s, walk, sigma, tau) if inside else np.full((3, 3), np.nan)
    return MarkovFit(walk, sigma, tau, covariance, shows)


_DRAWS, _SEED = 1000, 1431
# Correlation times in the shortest record of a drift.
_OF_TAU = 20.0
LONGEST_S = 14 * 86400.0
"""The longest record that is considered, s."""


class CoefficientErrors(NamedTuple):
    """Relative standard deviations; NaN of a coefficient that is zero."""

    angle_random_walk: float
    bias_instability: float
    rate_random_walk: float


def coefficient_errors(
    duration_s: float, sample_interval_s: float, walk: float, instability: float = 0.0, rate_walk: float = 0.0
) -> CoefficientErrors:
    """Of the fit of N (rad/√s), B (rad/s), K (rad/s/√s) to a record. Raises `ValueError` where it is too short."""
    samples = int(duration_s / sample_interval_s)
    steps = np.rint(averaging_times(samples, sample_interval_s) / sample_interval_s).astype(np.int64)
    steps = steps[octaves(steps, at_least=5)]
    if len(steps) < 5:
        raise ValueError(
            f"{duration_s:g} s of data at {1 / sample_interval_s:g} Hz contain too few samples to estimate "
            "four coefficients"
        )
    squares = np.array([0.0, walk, instability, rate_walk]) ** 2
    table = design_of_noise(steps * sample_interval_s)
    root = np.linalg.cholesky(variance_covariance(steps, ((samples, 1),), sample_interval_s, squares))
    weighed = np.linalg.solve(root, table)
    scale = np.linalg.norm(weighed, axis=0)
    noise = np.random.default_rng(_SEED).standard_normal((_DRAWS, len(steps)))
    fitted = np.array([optimize.nnls(weighed / scale, weighed @ squares + one)[0] for one in noise]) / scale
    values = np.sqrt(fitted)
    truth = np.sqrt(squares)
    errors = np.sqrt(np.mean((values[:, 1:] - truth[1:]) ** 2, axis=0))
    return CoefficientErrors(*np.divide(errors, truth[1:], out=np.full(3, np.nan), where=truth[1:] > 0.0).tolist())


def drift_errors(duration_s: float, walk: float, sigma: float, correlation_time_s: float) -> tuple[float, float, float]:
    """Relative errors of N, σ and τ by `markov.fit_markov`. Raises `ValueError` for records of less than 20 τ."""
    if duration_s < _OF_TAU * correlation_time_s:
        raise ValueError(
            f"a drift with a correlation time of {correlation_time_s:g} s needs a record that is at least {_OF_TAU:g} "
            "times as long"
        )
    covariance = markov_covariance(duration_s, min(1.0, 0.1 * correlation_time_s), walk, sigma, correlation_time_s)
    walk_error, sigma_error, tau_error = np.sqrt(np.diag(covariance)).tolist()
    return walk_error, sigma_error, tau_error


def shortest_record(worst: Callable[[float], float], error: float, at_least_s: float) -> float:
    """The record (s) of which `worst`, its largest relative error, is at most `error`; infinite where no record of two
    weeks is. `worst` may raise `ValueError` for a record that is too short."""

    def of(duration_s: float) -> float:
        try:
            return worst(duration_s)
        except ValueError:
            return np.inf

    low = high = at_least_s
    while of(high) > error:
        low, high = high, 2.0 * high
        if high > LONGEST_S:
            return np.inf
    for _ in range(6):
        middle = float(np.sqrt(low * high))
        low, high = (low, middle) if of(middle) <= error else (middle, high)
    return high
