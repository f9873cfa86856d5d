"""Robust estimation: readings that the model cannot explain get a lower weight, and each of them is reported.

Huber's function on the normalised innovations `r_k`, `k = 2.5` by default (the efficiency on clean data stays above
99 %): weights `w = min(1, k/|r|)`. A weight acts on the *reading*, whose variance becomes `R + (1/w − 1) S`, S the
variance of its innovation, and all rows are whitened again: a lower weight of the whitened row alone would leave the
effect of the bad reading in the filter's state and so in the next innovations.

This corrects bad *readings* (an encoder's slip, a reading taken too early). A jump of the integrated rate persists and
shows as several bad readings in a row: it is reported, but only the data can be corrected.
"""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import numpy as np

from gradcal_jax.estimation.solve import Estimate, Observations, Whitened, solve, whitened
from gradcal_jax.information import NoiseSteps
from gradcal_jax.model import SensorModel

HUBER = 2.5
_ROUNDS = 20
# Change of a weight at which the rounds end.
_NO_CHANGE = 0.01
Solution = TypeVar("Solution")


class RobustEstimate(NamedTuple):
    """`estimate` with the reweighted readings; `weights` `(U, n)` of the readings used (1: counted in full)."""

    estimate: Estimate
    white: tuple[Whitened, ...]
    weights: np.ndarray


def estimate_robustly(observations: Observations, model: SensorModel, *, threshold: float = HUBER) -> RobustEstimate:
    """Each unit separately, since outliers are its own; without outliers the result is exactly that of `solve`.

    Ends when no weight changes by 0.01. Errors: `ValueError` for a threshold that is not positive.
    """
    if not threshold > 0.0:
        raise ValueError(f"the threshold of a robust estimate must be positive, not {threshold}")
    used = observations.used
    plain = whitened(observations, model)
    first = solve(plain)
    estimates: list[Estimate] = []
    whites: list[Whitened] = []
    weights = np.ones((observations.unit_count, int(used.sum())))
    for unit in range(observations.unit_count):
        single = plain.of_unit(unit)
        one = Estimate._make(of_all[unit : unit + 1] for of_all in first)
        if np.max(np.abs(one.residuals), initial=0.0) > threshold:
            alone = observations._replace(
                columns=observations.columns_of(unit), readings=observations.readings[:, unit : unit + 1]
            )

            def again(steps: NoiseSteps, _, alone=alone) -> tuple[Whitened, Estimate]:
                white = whitened(alone, model, steps)
                return white, solve(white)

            residuals = lambda both: both[1].residuals[0]  # noqa: E731
            (single, one), weights[unit] = reweighted(
                alone.steps, used, (single, one), residuals, again, threshold, _ROUNDS
            )
        estimates.append(one)
        whites.append(single)
    parameters, known, *others = zip(*estimates, strict=True)
    joined = Estimate(np.concatenate(parameters), sum(known, ()), *map(np.concatenate, others))
    return RobustEstimate(joined, tuple(whites), weights)


def reweighted(
    steps: NoiseSteps,
    used: np.ndarray,
    solution: Solution,
    residuals: Callable[[Solution], np.ndarray],
    again: Callable[[NoiseSteps, Solution], Solution],
    threshold: float,
    rounds: int,
) -> tuple[Solution, np.ndarray]:
    """The solution and the weights of the readings `used`, after the weights have converged.

    `residuals` of a solution, in their standard deviations; `again`: solves with other noise steps.
    """
    plain, extra, weights = steps.reading_variance, np.zeros(len(used)), np.ones(int(used.sum()))
    for _ in range(rounds):
        spread = innovation_variance(steps)[used]
        # The innovation relative to its variance without the increase.
        plain_spread = spread - extra[used]
        against = np.abs(residuals(solution)) * np.sqrt(spread / np.maximum(plain_spread, np.finfo(float).tiny))
        new = np.minimum(1.0, threshold / np.maximum(against, threshold))
        if np.max(np.abs(new - weights)) < _NO_CHANGE:
            break
        weights = new
        extra[used] = (1.0 / weights - 1.0) * plain_spread
        steps = steps._replace(reading_variance=np.asarray(plain) + extra)
        solution = again(steps, solution)
    return solution, weights


def innovation_variance(steps) -> np.ndarray:
    """`(N,)`: variance of each reading conditional on those before it, rad², also at steps without a reading.

    A plain covariance filter in NumPy, since only a few units need it.
    """
    transition, noise = np.asarray(steps.transition), np.asarray(steps.covariance)
    observation, variance = np.asarray(steps.observation), np.asarray(steps.reading_variance)
    used = np.asarray(steps.used)
    state = np.asarray(steps.initial)
    spread = np.empty(len(used))
    for k in range(len(used)):
        state = transition[k] @ state @ transition[k].T + noise[k]
        cross = state @ observation[k]
        spread[k] = observation[k] @ cross + variance[k]
        if used[k] and spread[k] > 0.0:
            state = state - np.outer(cross, cross) / spread[k]
    return spread
