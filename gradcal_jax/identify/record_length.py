"""How well a record at rest of some length determines a gyro's noise, before it is recorded.

Of N, B and K the errors are those of the fit of `allan`: Allan variances are drawn about the mixture's own, with the
covariance that the fit itself uses, and the coefficients fitted to them, none negative. Of a first-order Markov drift
(σ, τ) they are those of `markov`, the inverse of its information. The Direct Bound is no estimate but an upper limit.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy import optimize

from gradcal_jax.identify.allan import averaging_times, design_of_noise, octaves, variance_covariance
from gradcal_jax.identify.markov import markov_covariance

_DRAWS, _SEED = 1000, 1431
# Correlation times in the shortest record of a drift.
_OF_TAU = 20.0
LONGEST_S = 14 * 86400.0
"""The longest record that is thought of, s."""


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
        raise ValueError(f"{duration_s:g} s at {1 / sample_interval_s:g} Hz have too few samples for four coefficients")
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
            f"a drift of {correlation_time_s:g} s needs a record that is at least {_OF_TAU:g} times as long"
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
