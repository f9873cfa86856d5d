"""The contract gradcal-prediction/1 for a whole unit."""

from collections.abc import Sequence

import numpy as np

from gradcal_jax.api.unit_build import AssembledUnit, assemble_unit
from gradcal_jax.api.unit_residual import UNIT_OF_QUANTITY, summed_up, unit_residual, worst_axis
from gradcal_jax.api.unit_sentences import unit_warnings
from gradcal_jax.files.contracts import ParameterRow, Prediction, RequirementRow
from gradcal_jax.files.requirement import GyroScaleFactorRequirement, UnitRequirement
from gradcal_jax.files.unit_spec import UnitSpec
from gradcal_jax.information import Posterior, posterior, unit_information
from gradcal_jax.trajectory import TableMotion, body_nodes


def predict_unit(spec: UnitSpec) -> Prediction:
    """What a unit's plan leaves of every requirement, with every parameter's standard deviation (1σ). Errors: none."""
    built = assemble_unit(spec)
    known = posterior_of_unit(built)
    schedule, reported = spec.schedule, built.model.to_reported[: built.model.calibrated]
    deviations, block = known.deviations(reported), known.covariance(reported)
    seen = np.isfinite(deviations)
    names, units = built.model.names(), built.model.units()
    return Prediction(
        title=spec.title,
        duration_s=schedule.duration,
        soak_s=schedule.soak,
        motion_s=schedule.motion,
        requirements=tuple(requirement_row(built, known, requirement) for requirement in spec.requirement),
        parameters=tuple(
            ParameterRow(name=names[i], axis="unit", std=float(d) if seen[i] else None, unit=units[i])
            for i, d in enumerate(deviations)
        ),
        covariance=tuple(
            tuple(float(v) if seen[i] and seen[j] else None for j, v in enumerate(row)) for i, row in enumerate(block)
        ),
        warnings=tuple(unit_warnings(built, known)),
    )


def posterior_of_unit(built: AssembledUnit) -> Posterior:
    """What is known of a unit after its plan, and what was done before."""
    return known_of_motions(built, (*built.past, built.motion))


def known_of_motions(built: AssembledUnit, motions: Sequence[TableMotion]) -> Posterior:
    """What is known of a unit after several motions, each with drifts of its own."""
    return posterior(unit_information([(m, body_nodes(m, built.points)) for m in motions], built.model))


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
        name=requirement.name,
        quantity=requirement.quantity,
        unit=unit,  # pyright: ignore[reportArgumentType]
        axis=requirement.axis,
        temperature_c=(float(requirement.temperature[0]), float(requirement.temperature[1])),
        rate_dps=(float(np.degrees(found.rates[0])), float(np.degrees(found.rates[-1]))) if by_rate else None,
        grid=tuple(requirement.grid),
        statistic=requirement.statistic,
        mean_of_max=values.get("mean of max"),
        max=values["max"],
        mean=values["mean"],
        rms=values["rms"],
        target=target,
        verdict="unobservable" if decisive is None else verdict,
        limited_by=None if worst is None else f"axis {worst}",
    )
