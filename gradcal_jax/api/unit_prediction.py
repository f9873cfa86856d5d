"""The prediction for a whole unit, as the contract gradcal-prediction/1."""

from collections.abc import Mapping, Sequence
from typing import Any, cast

import numpy as np

from gradcal_jax.api.posterior_of_plan import UNIT_OF
from gradcal_jax.api.unit_build import AssembledUnit, assemble_unit
from gradcal_jax.api.unit_residual import summed_up, unit_residual, worst_axis
from gradcal_jax.api.unit_sentences import unit_warnings
from gradcal_jax.files import Spec
from gradcal_jax.files.contracts import ParameterRow, Prediction, RequirementRow
from gradcal_jax.files.requirement import GyroScaleFactorRequirement, Requirement, UnitRequirement
from gradcal_jax.files.unit_spec import UnitSpec
from gradcal_jax.information import Posterior, posterior, unit_information
from gradcal_jax.model import SensorModel, UnitModel
from gradcal_jax.trajectory import TableMotion, body_nodes


def predict_unit(spec: UnitSpec) -> Prediction:
    """The residual of every requirement after a unit's plan, and every parameter's standard deviation (1σ). Errors:
    none."""
    built = assemble_unit(spec)
    known = posterior_of_unit(built)
    return Prediction(
        requirements=tuple(requirement_row(built, known, requirement) for requirement in spec.requirement),
        warnings=tuple(unit_warnings(built, known)),
        **of_plan(spec, built.model, {"unit": known}),
    )


def of_plan(spec: Spec | UnitSpec, model: SensorModel | UnitModel, known: Mapping[Any, Posterior]) -> dict[str, Any]:
    """The part of a prediction that is common to all plans: title, times, the reported parameters and their covariance;
    axes, which are independent, in order."""
    count = model.calibrated
    names, units, reported = model.names(), model.units(), model.to_reported[:count]
    rows, size = [], len(known) * count
    covariance: list[list[float | None]] = [[0.0] * size for _ in range(size)]
    for k, (axis, of) in enumerate(known.items()):
        deviations, here = of.deviations(reported), slice(k * count, (k + 1) * count)
        stds = [float(std) if np.isfinite(std) else None for std in deviations]
        rows += [
            ParameterRow(name=n, axis=axis, std=std, unit=u) for n, std, u in zip(names, stds, units, strict=False)
        ]
        seen = np.isfinite(deviations)
        block = np.where(np.outer(seen, seen), of.covariance(reported), cast("Any", None))
        for row, values in zip(covariance[here], block.tolist(), strict=True):
            row[here] = values
    return {
        "title": spec.title,
        **{f"{name}_s": getattr(spec.schedule, name) for name in ("duration", "soak", "motion")},
        "parameters": tuple(rows),
        "covariance": tuple(map(tuple, covariance)),
    }


def posterior_of_unit(built: AssembledUnit) -> Posterior:
    """The posterior of a unit after its plan and the motions before it."""
    return known_of_motions(built, (*built.past, built.motion))


def known_of_motions(built: AssembledUnit, motions: Sequence[TableMotion]) -> Posterior:
    """The posterior of a unit after several motions, each with drifts of its own."""
    return posterior(unit_information([(m, body_nodes(m, built.points)) for m in motions], built.model))


def asked_and_left(requirement: Requirement | UnitRequirement, values: Mapping[str, float | None]) -> dict[str, Any]:
    """The common fields of a requirement's row: what it asks for, and the value of each statistic."""
    return {
        **{name: getattr(requirement, name) for name in ("name", "quantity", "statistic")},
        "temperature_c": (float(requirement.temperature[0]), float(requirement.temperature[1])),
        "grid": tuple(requirement.grid),
        **{name.replace(" ", "_"): value for name, value in values.items()},
    }


def requirement_row(built: AssembledUnit, known: Posterior, requirement: UnitRequirement) -> RequirementRow:
    """The residual and the verdict of one requirement."""
    left = unit_residual(built, known, requirement)
    values = summed_up(requirement, left)
    unit, factor = UNIT_OF[requirement.quantity]
    target = None if requirement.target is None else float(requirement.target) * factor
    decisive = values[requirement.statistic]
    verdict = None if target is None else "met" if decisive is not None and decisive <= target else "missed"
    worst = worst_axis(requirement, left)
    by_rate = isinstance(requirement, GyroScaleFactorRequirement)
    return RequirementRow(
        **asked_and_left(requirement, values),
        unit=unit,
        axis=requirement.axis,
        rate_dps=(float(np.degrees(left.rates[0])), float(np.degrees(left.rates[-1]))) if by_rate else None,
        target=target,
        verdict="unobservable" if decisive is None else verdict,
        limited_by=None if worst is None else f"axis {worst}",
    )
