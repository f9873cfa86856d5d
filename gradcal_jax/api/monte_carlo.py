"""Monte Carlo simulation of a spec's calibration, compared with the prediction."""

from typing import NamedTuple

import numpy as np

from gradcal_jax.api.build import assemble
from gradcal_jax.api.posterior_of_plan import UNIT_OF, contrasts_of, residual_map, statistic_of, unweighted_estimator
from gradcal_jax.display import summary
from gradcal_jax.files import Spec
from gradcal_jax.information import WishartTest, monte_carlo_errors, wishart_test


class TwinRow(NamedTuple):
    """One requirement: its statistic as predicted and over the simulated runs, in `unit`."""

    name: str
    axis: str
    unit: str
    predicted: float
    simulated: float

    __repr__ = summary


def monte_carlo(spec: Spec, runs: int, seed: int = 0) -> tuple[list[TwinRow], dict[str, WishartTest]]:
    """Simulate `runs` calibrations of a spec's plan. Returns a row for each requirement (ppm, deg/h), and for each axis
    the test of the sample covariance against the predicted one (likelihood ratio of a Wishart matrix).

    Errors: `ValueError` for fewer runs than parameters, and where the plan leaves something unobservable.
    """
    built = assemble(spec)
    least = 2 * built.model.size
    if runs < least:
        raise ValueError(f"{runs} runs cannot test a covariance of {least // 2} parameters: ask for {least} or more")
    rows: list[TwinRow] = []
    tests: dict[str, WishartTest] = {}
    for channel in built.channels:
        weighted = not unweighted_estimator(spec)
        result = monte_carlo_errors(built.trajectory(channel), built.model, runs, seed, weighted=weighted)
        tests[channel] = wishart_test(result.errors, result.predicted)
        for requirement in spec.requirement:
            predicted = residual_map(built, result.predicted, requirement)[2]
            unit, factor = UNIT_OF[requirement.quantity]
            # Root mean square error of the simulated maps at each point.
            places = contrasts_of(built.model, requirement, "max").rows
            mean_square = result.left.T @ result.left / len(result.left)
            squares = np.einsum("gi,ij,gj->g", places, mean_square, places)
            simulated = np.sqrt(squares).reshape(predicted.shape) * factor
            values = (statistic_of(requirement, of) for of in (predicted, simulated))
            rows.append(TwinRow(requirement.name, channel, unit, *values))
    return rows, tests
