"""Targets of requirements in their display units, decision rules, and verdicts on residuals; and the rows of
calibration files that all estimators write."""

import platform
from collections.abc import Callable, Sequence
from importlib.metadata import PackageNotFoundError, version
from typing import Literal

import numpy as np

from gradcal_jax.spec.requirement import QUANTITIES, Requirement, Statistic


def target_of(requirement: Requirement) -> float | None:
    """The target in the unit of output."""
    return None if requirement.target is None else float(requirement.target) * QUANTITIES[requirement.quantity].factor


def limit_of(requirement: Requirement) -> tuple[Statistic, float] | None:
    """The limit that a target sets to the residual map (1σ): the requirement's own statistic, and its largest allowed
    value (in the unit of output), `target / coverage` (simple acceptance, JCGM 106, 8.2)."""
    target = target_of(requirement)
    return None if target is None else (requirement.statistic, target / requirement.coverage)


def decision_rule(requirement: Requirement) -> str:
    """The decision rule of a target, in words. Empty without one."""
    if requirement.target is None:
        return ""
    of = f"{requirement.coverage:g} × " if requirement.coverage != 1.0 else ""
    return f"simple acceptance: {of}{requirement.statistic} (1σ) within {requirement.target}"


def verdict_of(
    requirement: Requirement, statistic_named: Callable[[Statistic], float]
) -> Literal["met", "missed", "unobservable"] | None:
    """The verdict by a requirement's decision rule; None without a target. `statistic_named`: the residual's statistics
    by name (in the unit of output, 1σ), infinite where it is not observable."""
    if not np.isfinite(statistic_named(requirement.statistic)):
        return "unobservable"
    limit = limit_of(requirement)
    if limit is None:
        return None
    return "met" if statistic_named(limit[0]) <= limit[1] else "missed"


def run_of(requirement: Requirement) -> Literal["any run", "this run"]:
    """Whether the bias of another power-on counts."""
    return getattr(requirement, "of", "this run")


def finite(value: float | None) -> float | None:
    """The value, or None where it is not finite: JSON knows no infinity."""
    return None if value is None or not np.isfinite(value) else float(value)


def versions_of(packages: Sequence[str]) -> dict[str, str]:
    """The versions of Python and of those of `packages` that are installed."""
    versions = {"python": platform.python_version()}
    for name in packages:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            continue
    return versions
