"""Robust estimation: readings that the model cannot explain get a lower weight, and each of them is reported.

Huber's function on the normalised innovations `r_k`, `k = 2.5` by default (the efficiency on clean data stays above
99 %): weights `w = min(1, k/|r|)`. A weight acts on the *reading*, whose variance becomes `R + (1/w − 1) S`, S the
variance of its innovation, and all rows are whitened again: a lower weight of the whitened row alone would leave the
effect of the bad reading in the filter's state and so in the next innovations.

This corrects bad *readings* (an encoder's slip, a reading taken too early). A jump of the integrated rate persists and
shows as several bad readings in a row: it is reported, but only the data can be corrected.
"""

from collections.abc import Callable
from typing import TypeVar

import numpy as np

from gradcal_jax.information import NoiseSteps
from gradcal_jax.information.by_reading import filter_readings

HUBER = 2.5
_ROUNDS = 20
# Change of a weight at which the rounds end.
_NO_CHANGE = 0.01
Solution = TypeVar("Solution")


def reweighted(
    steps: NoiseSteps,
    used: np.ndarray,
    solution: Solution,
    residuals: Callable[[Solution], np.ndarray],
    again: Callable[[NoiseSteps, Solution], Solution],
    threshold: float,
    with_noise: Callable[[NoiseSteps, np.ndarray], NoiseSteps],
) -> tuple[Solution, np.ndarray]:
    """The solution and the weights of the readings `used`, after the weights have converged: none changes by 0.01.

    `residuals` of a solution, in their standard deviations; `again`: solves with other noise steps; `with_noise`: steps
    whose readings have more noise, by these variances `(N,)`. Errors: `ValueError` for a threshold that is not
    positive.
    """
    if not threshold > 0.0:
        raise ValueError(f"the threshold of a robust estimate must be positive, not {threshold}")
    plain, extra, weights = steps, np.zeros(len(used)), np.ones(int(used.sum()))
    for _ in range(_ROUNDS):
        spread = innovation_variance(steps)[used]
        # The innovation relative to its variance without the increase.
        plain_spread = spread - extra[used]
        against = np.abs(residuals(solution)) * np.sqrt(spread / np.maximum(plain_spread, np.finfo(float).tiny))
        new = np.minimum(1.0, threshold / np.maximum(against, threshold))
        if np.max(np.abs(new - weights)) < _NO_CHANGE:
            break
        weights = new
        extra[used] = (1.0 / weights - 1.0) * plain_spread
        steps = with_noise(plain, extra)
        solution = again(steps, solution)
    return solution, weights


def innovation_variance(steps: NoiseSteps) -> np.ndarray:
    """`(N,)`: variance of each reading conditional on those before it, rad²; zero at steps without a reading."""
    none = np.zeros((len(steps.initial), 0)), np.zeros((len(steps.used), 0))
    per_std = filter_readings(none[0], steps.initial, steps, none[1]).per_std
    return np.divide(1.0, per_std**2, out=np.zeros(len(per_std)), where=per_std > 0.0)
