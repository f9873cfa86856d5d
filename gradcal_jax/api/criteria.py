"""Requirements of a gyro as criteria of a search: their statistics as functions of the channel's parameters."""

from typing import Literal

import numpy as np

from gradcal_jax.api.imu_residual import box, earth_gain, flights_of
from gradcal_jax.api.verdicts import mission_weights
from gradcal_jax.design import Criterion, polynomial_grid
from gradcal_jax.files.requirement import (
    MissionHeadingRequirement,
    NorthRequirement,
    Requirement,
)
from gradcal_jax.information import contrasts
from gradcal_jax.information.missions import mission_contrasts, mission_rows
from gradcal_jax.information.residual import Contrasts, Statistic, map_of
from gradcal_jax.model import BIAS, SCALE_FACTOR, HigherPolynomials, Map, Polynomial, SensorModel


def contrasts_of(
    model: SensorModel,
    requirement: Requirement,
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
    requirement: Requirement,
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


def _map_of(requirement: Requirement) -> Literal["bias", "scale_factor"]:
    return SCALE_FACTOR if requirement.quantity.endswith("scale_factor") else BIAS


def _gain(requirement: Requirement) -> float:
    return earth_gain(requirement) if isinstance(requirement, NorthRequirement) else 1.0
