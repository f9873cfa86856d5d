"""Targets of requirements and verdicts on residuals: units for people, statistics, decision rules."""

from collections.abc import Callable
from typing import Final, Literal

import numpy as np

from gradcal_jax.files.requirement import MissionHeadingRequirement, Requirement
from gradcal_jax.information.conformity import coverage_of_risk
from gradcal_jax.information.residual import Statistic
from gradcal_jax.units import DEG_PER_H, PPM, G

PrintedUnit = Literal["ppm", "deg/h", "urad", "deg/h/g", "ug", "ug/g^2", "m", "deg"]
UNIT_OF: Final[dict[str, tuple[PrintedUnit, float]]] = {
    "scale_factor": ("ppm", PPM),
    "bias": ("deg/h", DEG_PER_H),
    "north": ("deg", float(np.degrees(1.0))),
    "heading": ("deg", float(np.degrees(1.0))),
    "mission_heading": ("deg", float(np.degrees(1.0))),
    "gyro_bias": ("deg/h", DEG_PER_H),
    "gyro_scale_factor": ("ppm", PPM),
    "gyro_misalignment": ("urad", 1e6),
    "g_sensitivity": ("deg/h/g", DEG_PER_H * G),
    "accelerometer_bias": ("ug", 1e6 / G),
    "accelerometer_scale_factor": ("ppm", PPM),
    "accelerometer_misalignment": ("urad", 1e6),
    "second_order": ("ug/g^2", 1e6 * G),
    "position": ("m", 1.0),
    "tilt": ("urad", 1e6),
}
"""For each quantity its unit for people, and how many of it are one in SI."""


def mission_weights(requirement: Requirement, name: Statistic) -> np.ndarray:
    """Factors `(n, 1)` of the residuals of missions that make a plain statistic the weighted one."""
    if not isinstance(requirement, MissionHeadingRequirement) or name not in ("rms", "mean"):
        return np.ones((1, 1))
    share = np.array([[mission.weight] for mission in requirement.mission])
    share = share / np.mean(share)
    return np.sqrt(share) if name == "rms" else share


def target_of(requirement: Requirement) -> float | None:
    """The target in the unit of `UNIT_OF`."""
    return None if requirement.target is None else float(requirement.target) * UNIT_OF[requirement.quantity][1]


def limit_of(requirement: Requirement) -> tuple[Statistic, float] | None:
    """The limit that a target sets to the residual map (1σ): a statistic, and its largest allowed value (`UNIT_OF`).

    Simple acceptance: the requirement's own statistic, `target / coverage`. Guarded: the maximum, by the risk.
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
    return f"guarded: beyond {requirement.target} at the worst point with a probability of at most {requirement.risk}"


def verdict_of(
    requirement: Requirement, statistic_named: Callable[[Statistic], float]
) -> Literal["met", "missed", "unobservable"] | None:
    """The verdict by a requirement's decision rule; None without a target. `statistic_named`: the residual's statistics
    by name (in `UNIT_OF`, 1σ), infinite where it is not observable."""
    if not np.isfinite(statistic_named(requirement.statistic)):
        return "unobservable"
    limit = limit_of(requirement)
    if limit is None:
        return None
    return "met" if statistic_named(limit[0]) <= limit[1] else "missed"


def run_of(requirement: Requirement) -> Literal["any run", "this run"]:
    """Whether the bias of another power-on counts."""
    return getattr(requirement, "of", "this run")
