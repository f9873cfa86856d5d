"""The contract gradcal-prediction/1 for a whole unit."""

from collections.abc import Mapping, Sequence
from typing import Any, cast

import numpy as np

from gradcal_jax.api.unit_build import AssembledUnit, assemble_unit
from gradcal_jax.api.unit_residual import UNIT_OF_QUANTITY, summed_up, unit_residual, worst_axis
from gradcal_jax.api.unit_sentences import unit_warnings
from gradcal_jax.files import Spec
from gradcal_jax.files.contracts import ParameterRow, Prediction, RequirementRow
from gradcal_jax.files.requirement import GyroScaleFactorRequirement, Requirement, UnitRequirement
from gradcal_jax.files.unit_spec import UnitSpec
from gradcal_jax.information import Posterior, posterior, unit_information
from gradcal_jax.model import SensorModel, UnitModel
from gradcal_jax.trajectory import TableMotion, body_nodes


def predict_unit(spec: UnitSpec) -> Prediction:
    """What a unit's plan leaves of every requirement, with every parameter's standard deviation (1σ). Errors: none."""
    built = assemble_unit(spec)
    known = posterior_of_unit(built)
    return Prediction(
        requirements=tuple(requirement_row(built, known, requirement) for requirement in spec.requirement),
        warnings=tuple(unit_warnings(built, known)),
        **of_plan(spec, built.model, {"unit": known}),
    )


def of_plan(spec: Spec | UnitSpec, model: SensorModel | UnitModel, known: Mapping[Any, Posterior]) -> dict[str, Any]:
    """What a prediction says of any plan: its title, its times, rows of the reported parameters, and their covariance;
    axes one after the other, which are independent.
    """
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
    """What is known of a unit after its plan, and what was done before."""
    return known_of_motions(built, (*built.past, built.motion))


def known_of_motions(built: AssembledUnit, motions: Sequence[TableMotion]) -> Posterior:
    """What is known of a unit after several motions, each with drifts of its own."""
    return posterior(unit_information([(m, body_nodes(m, built.points)) for m in motions], built.model))


def asked_and_left(requirement: Requirement | UnitRequirement, values: Mapping[str, float | None]) -> dict[str, Any]:
    """Of the row of a requirement what it asks for, and what is left by the name of each statistic."""
    return {
        **{name: getattr(requirement, name) for name in ("name", "quantity", "statistic")},
        "temperature_c": (float(requirement.temperature[0]), float(requirement.temperature[1])),
        "grid": tuple(requirement.grid),
        **{name.replace(" ", "_"): value for name, value in values.items()},
    }


def requirement_row(built: AssembledUnit, known: Posterior, requirement: UnitRequirement) -> RequirementRow:
    """What is left of one requirement, in people's units."""
    found = unit_residual(built, known, requirement)
    values = summed_up(requirement, found)
    unit, factor = UNIT_OF_QUANTITY[requirement.quantity]
    target = None if requirement.target is None else float(requirement.target) * factor
    decisive = values[requirement.statistic]
    verdict = None if target is None else "met" if decisive is not None and decisive <= target else "missed"
    worst = worst_axis(requirement, found)
    by_rate = isinstance(requirement, GyroScaleFactorRequirement)
    return RequirementRow(
        **asked_and_left(requirement, values),
        unit=cast("Any", unit),
        axis=requirement.axis,
        rate_dps=(float(np.degrees(found.rates[0])), float(np.degrees(found.rates[-1]))) if by_rate else None,
        target=target,
        verdict="unobservable" if decisive is None else verdict,
        limited_by=None if worst is None else f"axis {worst}",
    )
