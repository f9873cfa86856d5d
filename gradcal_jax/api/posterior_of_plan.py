"""What is known after a spec's plan, on its requirements' boxes."""

from typing import Final, Literal, NamedTuple

import numpy as np

from gradcal_jax.api.build import Assembled
from gradcal_jax.files import Spec
from gradcal_jax.files.moves import Axis
from gradcal_jax.files.plan import StandardPlan as StandardPlanSection
from gradcal_jax.files.requirement import Requirement
from gradcal_jax.information import Posterior, information, posterior, residual, statistic, unweighted
from gradcal_jax.information.conformity import coverage_of_risk
from gradcal_jax.information.residual import Statistic
from gradcal_jax.model import SensorModel
from gradcal_jax.units import DEG_PER_H as DEG_PER_H
from gradcal_jax.units import DEG_PER_S as DEG_PER_S
from gradcal_jax.units import PPM as PPM

UNIT_OF: Final[dict[str, tuple[Literal["ppm", "deg/h"], float]]] = {
    "scale_factor": ("ppm", PPM),
    "bias": ("deg/h", DEG_PER_H),
}


def posterior_of_plan(built: Assembled, channel: Axis | None = None, model: SensorModel | None = None) -> Posterior:
    """What is known after the plan, by the estimator that the spec names. `model` replaces the assembled one."""
    model = built.model if model is None else model
    line = built.trajectory(channel)
    return unweighted(line, model) if unweighted_estimator(built.spec) else posterior(information(line, model))


def unweighted_estimator(spec: Spec) -> bool:
    """Whether the spec's estimator is ordinary least squares on the points' rates, as in the paper's figure."""
    return isinstance(spec.plan, StandardPlanSection) and spec.plan.estimator == "least squares"


class Survey(NamedTuple):
    """Where a plan takes a sensor: coldest and warmest (°C), and its fastest rate (rad/s), on a grid of each piece."""

    coldest: float
    warmest: float
    fastest: float


def survey(built: Assembled, channel: Axis | None = None) -> Survey:
    """Where the plan takes the sensor on one axis."""
    line = built.trajectory(channel)
    grid = np.broadcast_to(np.linspace(0.0, 1.0, 33), (len(line.moving_pieces), 33))
    used = ~line.gap
    ends = np.concatenate([end[used] for end in line.ends()])
    fastest = np.max(np.abs(line.rate(grid, line.moving_pieces)), initial=0.0)
    return Survey(float(ends.min()), float(ends.max()), float(fastest))


def residual_map(
    built: Assembled, known: Posterior, requirement: Requirement, *, si: bool = False
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Temperatures (°C), rates (deg/s) and the residual `(n_T, n_ω)` in ppm or deg/h, on a requirement's box.

    `si`: the rates in rad/s, the residual in 1 or rad/s.
    """
    temperatures, rates = box(requirement)
    values = residual(known, built.model, requirement.quantity, temperatures, rates)
    if si:
        return temperatures, rates, values
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


def limit_of(requirement: Requirement) -> tuple[Statistic, float] | None:
    """What a target asks of the residual map (1σ): a statistic of it, and what it may come to at most, in ppm or deg/h.

    Simple acceptance: the requirement's own statistic, `target / coverage`. Guarded: the worst place, by the risk.
    """
    target = target_of(requirement)
    if target is None:
        return None
    if requirement.risk is None:
        return requirement.statistic, target / requirement.coverage
    return "max", target / coverage_of_risk(float(requirement.risk))


def decision_rule(requirement: Requirement) -> str:
    """The decision rule of a target, in words. Empty without one."""
    if requirement.target is None:
        return ""
    if requirement.risk is None:
        of = f"{requirement.coverage:g} × " if requirement.coverage != 1.0 else ""
        return f"simple acceptance: {of}{requirement.statistic} (1σ) within {requirement.target}"
    return f"guarded: beyond {requirement.target} at the worst place with a chance of {requirement.risk} at most"


def verdict(requirement: Requirement, values: np.ndarray) -> Literal["met", "missed", "unobservable"] | None:
    """What a residual map (ppm or deg/h, 1σ) is against a requirement's target by its rule, if it has one."""
    if not np.isfinite(statistic(requirement.statistic, values)):
        return "unobservable"
    limit = limit_of(requirement)
    if limit is None:
        return None
    return "met" if statistic(limit[0], values) <= limit[1] else "missed"
