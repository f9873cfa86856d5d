"""The posterior covariance after a spec's plan, and residuals on its requirements' boxes."""

from typing import Literal

import numpy as np

from gradcal_jax.api.build import Assembled
from gradcal_jax.api.missions import earth_gain, flights_of
from gradcal_jax.api.verdicts import DEG_PER_H as DEG_PER_H
from gradcal_jax.api.verdicts import UNIT_OF, mission_weights
from gradcal_jax.api.verdicts import decision_rule as decision_rule
from gradcal_jax.api.verdicts import limit_of as limit_of
from gradcal_jax.api.verdicts import run_of as run_of
from gradcal_jax.api.verdicts import target_of as target_of
from gradcal_jax.design import Criterion, polynomial_grid
from gradcal_jax.files.plan import StandardPlan as StandardPlanSection
from gradcal_jax.files.requirement import (
    GyroScaleFactorRequirement,
    MissionHeadingRequirement,
    NorthRequirement,
    UnitRequirement,
)
from gradcal_jax.files.unit_spec import Spec
from gradcal_jax.information import Posterior, contrasts, information, posterior, residual, statistic, unweighted
from gradcal_jax.information.missions import mission_contrasts, mission_rows
from gradcal_jax.information.residual import Contrasts, Statistic, map_of
from gradcal_jax.model import BIAS, SCALE_FACTOR, HigherPolynomials, Map, Polynomial, SensorModel
from gradcal_jax.units import DEG_PER_S
from gradcal_jax.units import PPM as PPM
from gradcal_jax.units import G as G


def posterior_of_plan(built: Assembled) -> Posterior:
    """The posterior after the plan, by the estimator that the spec names."""
    line, model = built.trajectory(), built.model
    return unweighted(line, model) if unweighted_estimator(built.spec) else posterior(information(line, model))


def unweighted_estimator(spec: Spec) -> bool:
    """Whether the spec's estimator is ordinary least squares on the points' rates, as in the paper's figure."""
    return isinstance(spec.plan, StandardPlanSection) and spec.plan.estimator == "least squares"


def residual_map(
    built: Assembled, known: Posterior, requirement: UnitRequirement, *, si: bool = False
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Temperatures (°C), rates (deg/s) and the residual `(n_T, n_ω)` in the unit of `UNIT_OF`, on a requirement's box;
    for missions `(n, 1)`, with mission indices in the place of temperatures.

    `si`: the rates in rad/s, the residual in 1, rad/s or rad.
    """
    temperatures, rates = box(requirement)
    if isinstance(requirement, MissionHeadingRequirement):
        values = contrasts_of(built.model, requirement, "max").left(known)[:, None]
    else:
        values = residual(known, built.model, _map_of(requirement), temperatures, rates) * _gain(requirement)
    if si:
        return temperatures, rates, values
    return temperatures, rates * DEG_PER_S, values * UNIT_OF[requirement.quantity][1]


def box(requirement: UnitRequirement, most: int | None = None) -> tuple[np.ndarray, np.ndarray]:
    """A requirement's temperatures (°C) and rates (rad/s) on its grid, or on one of at most `most` a side; for missions
    their indices."""
    if isinstance(requirement, MissionHeadingRequirement):
        return np.arange(float(len(requirement.mission))), np.zeros(1)
    cold, warm = requirement.temperature
    temperatures = np.linspace(float(cold), float(warm), min(most or requirement.grid[0], requirement.grid[0]))
    if not isinstance(requirement, GyroScaleFactorRequirement):
        return temperatures, np.zeros(1)
    slow, fast = requirement.rate
    return temperatures, np.linspace(float(slow), float(fast), min(most or requirement.grid[1], requirement.grid[1]))


def contrasts_of(
    model: SensorModel,
    requirement: UnitRequirement,
    name: Statistic,
    at: tuple[np.ndarray, np.ndarray] | None = None,
) -> Contrasts:
    """The residual on a grid (by default `box`) as linear functions of the parameters; those of missions are scaled
    such that the unweighted statistic `name` is the weighted one."""
    if isinstance(requirement, MissionHeadingRequirement):
        rows = [mission_rows(model, flight, np.array([end]))[0] for flight, end in flights_of(requirement)]
        return mission_contrasts(model, np.stack(rows)).times(mission_weights(requirement, name)[:, 0])
    grid = (g.ravel() for g in np.meshgrid(*(at or box(requirement)), indexing="ij"))
    return contrasts(model, _map_of(requirement), *grid).times(_gain(requirement))


def criterion_of(
    model: SensorModel,
    requirement: UnitRequirement,
    name: Statistic | None = None,
    most: int | None = None,
) -> Criterion:
    """A requirement's statistic, or the one of that `name`, for a design (SI). `most`: see `box`; for a search, which
    interpolates a polynomial map between few places."""
    name, at = name or requirement.statistic, box(requirement, most)
    shape, between = (len(at[0]), len(at[1])), None
    if most is not None and not isinstance(requirement, MissionHeadingRequirement):
        at, between = _few_places(map_of(model, _map_of(requirement)), *at)
    rows, alone, beyond = contrasts_of(model, requirement, name, at)
    return Criterion(rows, alone if np.any(alone) else None, beyond, shape, name, between)


def _few_places(of: Map, temperatures: np.ndarray, rates: np.ndarray):
    """The places at which a map's residual is evaluated, and the matrices that interpolate it onto the grid."""
    bases = [(of.temperature, of.beyond and of.beyond.temperature), (of.rate, of.beyond and of.beyond.rate)]
    pairs = []
    for at, both in zip((temperatures, rates), bases, strict=True):
        degrees = [
            b.degree if isinstance(b, Polynomial | HigherPolynomials) else len(at) for b in both if b is not None
        ]
        pairs.append(polynomial_grid(at, max(degrees, default=0)))
    (few_t, by_t), (few_w, by_w) = pairs
    return (few_t, few_w), (by_t, by_w)


def statistic_of(requirement: UnitRequirement, values: np.ndarray, name: Statistic | None = None) -> float:
    """The requirement's statistic of its residuals, or the one of that `name`."""
    name = name or requirement.statistic
    return statistic(name, values * mission_weights(requirement, name))


def _map_of(requirement: UnitRequirement) -> Literal["bias", "scale_factor"]:
    return SCALE_FACTOR if requirement.quantity.endswith("scale_factor") else BIAS


def _gain(requirement: UnitRequirement) -> float:
    return earth_gain(requirement) if isinstance(requirement, NorthRequirement) else 1.0
