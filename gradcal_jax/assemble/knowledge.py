"""What is known after a spec's plan, on its requirements' boxes."""

from typing import Final, Literal, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from gradcal_jax import plans
from gradcal_jax.assemble.build import Assembled
from gradcal_jax.errormodel import GyroModel
from gradcal_jax.files.plan import StandardPlan as StandardPlanSection
from gradcal_jax.files.requirement import Requirement
from gradcal_jax.information import Posterior, information, posterior, residual, unweighted
from gradcal_jax.units import DEG_PER_H as DEG_PER_H
from gradcal_jax.units import DEG_PER_S as DEG_PER_S
from gradcal_jax.units import PPM as PPM

UNIT_OF: Final[dict[str, tuple[Literal["ppm", "deg/h"], float]]] = {
    "scale_factor": ("ppm", PPM),
    "bias": ("deg/h", DEG_PER_H),
}


# In parts that are compiled once each: the timeline serves every model, the survey and the unweighted estimator.
@eqx.filter_jit
def _timeline(plan: plans.Plan, channel: str, thermal_lag) -> plans.Timeline:
    return plan.timeline(channel, thermal_lag)


_information = eqx.filter_jit(information)


def timeline_of(built: Assembled, channel: str) -> plans.Timeline:
    """A spec's plan as the sensor on one axis sees it, its lag included; compiled once for each structure."""
    return _timeline(built.plan, channel, None if built.thermal_lag is None else np.asarray(built.thermal_lag))


def knowledge(built: Assembled, channel: str = "x", model: GyroModel | None = None) -> Posterior:
    """What is known after the plan, by the estimator that the spec names. `model` replaces the assembled one."""
    model = built.model if model is None else model
    line, section = timeline_of(built, channel), built.spec.plan
    if isinstance(section, StandardPlanSection) and section.estimator == "least squares":
        return unweighted(line, model)
    return posterior(_information(line, model))


class Survey(NamedTuple):
    """Where a plan takes a sensor: coldest and warmest (°C), and its fastest rate (rad/s), on a grid of each piece."""

    coldest: float
    warmest: float
    fastest: float


@eqx.filter_jit
def _survey(line: plans.Timeline):
    moving = line.moving_pieces.values
    grid = jnp.broadcast_to(jnp.linspace(0.0, 1.0, 33), (len(moving), 33))
    ends = line.temperature(jnp.broadcast_to(jnp.array([0.0, 1.0]), (line.piece_count, 2)))
    return jnp.min(ends), jnp.max(ends), jnp.max(jnp.abs(line.rate(grid, moving)), initial=0.0)


def survey(built: Assembled, channel: str = "x") -> Survey:
    """Where the plan takes the sensor on one axis."""
    return Survey(*(float(v) for v in _survey(timeline_of(built, channel))))


def residual_map(
    built: Assembled, known: Posterior, requirement: Requirement
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Temperatures (°C), rates (deg/s) and the residual `(n_T, n_ω)` in ppm or deg/h, on a requirement's box."""
    temperatures, rates = box(requirement)
    values = residual(known, built.model, requirement.quantity, temperatures, rates)
    return temperatures, rates * DEG_PER_S, values * UNIT_OF[requirement.quantity][1]


def box(requirement: Requirement, most: int | None = None) -> tuple[np.ndarray, np.ndarray]:
    """A requirement's temperatures (°C) and rates (rad/s) on its grid, or on one of at most `most` a side."""
    cold, warm = requirement.temperature
    temperatures = np.linspace(float(cold), float(warm), min(most or requirement.grid[0], requirement.grid[0]))
    if requirement.quantity == "bias":
        return temperatures, np.zeros(1)
    slow, fast = requirement.rate
    return temperatures, np.linspace(float(slow), float(fast), min(most or requirement.grid[1], requirement.grid[1]))


def target_of(requirement: Requirement) -> float | None:
    """In ppm or deg/h."""
    return None if requirement.target is None else float(requirement.target) * UNIT_OF[requirement.quantity][1]


def verdict(requirement: Requirement, residual: float | None) -> Literal["met", "missed", "unobservable"] | None:
    """What a residual (ppm or deg/h; None: not observable) is against a requirement's target, if it has one."""
    if residual is None:
        return "unobservable"
    target = target_of(requirement)
    if target is None:
        return None
    return "met" if residual <= target else "missed"
