"""Maximum-likelihood estimate of a random walk and a first-order Markov process in a record at rest, and its
covariance.

Source: P. Whittle, "The analysis of multiple stationary time series", J. R. Stat. Soc. B 15, 1953 (the likelihood in
the frequency domain). Rows are means over Δ of the rate; θ = (ln N, ln σ, ln τ), a = exp(−Δ/τ):

S(ω) = N²/Δ + c₀ + 2 c₁ (cos ω − a)/(1 − 2 a cos ω + a²) spectrum of such rows, exact c₀ = 2σ²τ²(Δ/τ − 1 + a)/Δ², c₁ =
σ²τ²(1 − a)²/Δ² −ln L = Σ_j [ln S(ω_j) + I_j/S(ω_j)], ω_j = 2πj/n, j = 1 … n/2; I the periodogram information = Σ_j ∂ln
S ∂ln Sᵀ

The record is taken as much longer than τ: below 20 τ the likelihood of frequencies leaks, and errors are larger.
"""

from typing import NamedTuple

import numpy as np
from scipy import optimize

from gradcal_jax import formulas

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
