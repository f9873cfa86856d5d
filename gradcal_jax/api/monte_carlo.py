"""Monte Carlo simulation of a spec's calibration, compared with the prediction."""

from typing import NamedTuple

import numpy as np

from gradcal_jax.api.imu_build import build_imu, imu_posterior, unweighted_estimator
from gradcal_jax.api.imu_residual import quantity_of
from gradcal_jax.display import summary
from gradcal_jax.files.spec import expect_spec
from gradcal_jax.files.spec_sections import Spec
from gradcal_jax.information import (
    Posterior,
    WishartTest,
    estimator_of_means,
    imu_system,
    simulated_errors,
    wishart_test,
)
from gradcal_jax.model import Discrepancy


class TwinRow(NamedTuple):
    """One requirement: its statistic as predicted and over the simulated runs, in `unit`."""

    name: str
    axis: str
    unit: str
    predicted: float
    simulated: float

    __repr__ = summary


def monte_carlo(spec: Spec, runs: int, seed: int = 0) -> tuple[list[TwinRow], dict[str, WishartTest]]:
    """Simulate `runs` calibrations of a spec's plan. Returns a row for each requirement (ppm, deg/h; in its own unit),
    and for all channels together the test of the sample covariance against the predicted one (likelihood ratio of a
    Wishart matrix).

    Errors: `ValueError` for fewer runs than parameters, and where the plan leaves something unobservable.
    """
    spec = expect_spec(spec)
    built = build_imu(spec)
    model, motion, nodes = built.model, built.motion, built.body_nodes()
    _enough(runs, model.size)
    steps, columns = imu_system(motion, model, nodes)
    terms = [term for c in model.channels for term in c.model.terms]
    carried = np.concatenate([np.full(t.size, not isinstance(t, Discrepancy)) for t in terms])
    carried = np.pad(carried, (0, model.size - len(carried)), constant_values=True)
    known, plain = imu_posterior(built), None
    if unweighted_estimator(spec):
        plain = estimator_of_means(motion, model, steps, columns), known
    twin = simulated_errors(steps, np.asarray(columns), model.prior_rows(), carried, runs, seed, plain=plain)
    found = Posterior(twin.left.T / np.sqrt(len(twin.left)), np.zeros((model.size, 0)))
    rows: list[TwinRow] = []
    for requirement in spec.requirement:
        quantity = quantity_of(built, requirement)
        one, other = quantity.residual(known), quantity.residual(found, whole=True)
        values = (of.finite_statistic() for of in (one, other))
        rows.append(TwinRow(requirement.name, requirement.axis, one.unit, *values))
    own = model.calibrated if plain is not None else model.size
    believed = Posterior(twin.predicted.spread[:own], twin.predicted.hidden[:own])
    return rows, {"all": wishart_test(twin.errors[:, :own], believed)}


def _enough(runs: int, parameters: int) -> None:
    """Raise `ValueError` for too few runs."""
    if runs < 2 * parameters:
        raise ValueError(
            f"{runs} runs cannot test a covariance of {parameters} parameters: ask for {2 * parameters} or more"
        )
