"""The prediction of a spec, as the contract gradcal-prediction/1."""

from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any, cast

import numpy as np

from gradcal_jax.api.build import Assembled, assemble
from gradcal_jax.api.contract_rows import finite
from gradcal_jax.api.error_budget import error_budget, limited_by
from gradcal_jax.api.missions import mission_table, own_noise_of
from gradcal_jax.api.posterior_of_plan import (
    DEG_PER_S,
    UNIT_OF,
    box,
    contrasts_of,
    decision_rule,
    posteriors_of_plan,
    residual_map,
    statistic_of,
    target_of,
    verdict,
)
from gradcal_jax.api.scenarios import extremes
from gradcal_jax.api.tested_maps import noticing
from gradcal_jax.api.unit_build import AssembledUnit, assemble_unit, posterior_of_unit
from gradcal_jax.api.unit_residual import unit_residual
from gradcal_jax.api.unit_sentences import unit_warnings
from gradcal_jax.api.warnings import warnings
from gradcal_jax.files import Prediction, Spec
from gradcal_jax.files.absent import absent_terms, with_typical
from gradcal_jax.files.contracts import AbsentRow, CheckRow, ParameterRow, RequirementRow
from gradcal_jax.files.moves import Axis
from gradcal_jax.files.requirement import GyroScaleFactorRequirement, HeadingRequirement, Requirement, UnitRequirement
from gradcal_jax.files.unit_spec import UnitSpec
from gradcal_jax.information import STATISTICS, Posterior
from gradcal_jax.information.conformity import acceptance_limit, chance_of_keeping, global_risks, specific_risk
from gradcal_jax.model import SensorModel, UnitModel

# The chances of keeping a target are computed on a grid of at most this many temperatures and rates.
_GRID = 41


def predict(spec: Spec | UnitSpec, *, limits: bool = False, notices: bool = False, outlook: bool = False) -> Prediction:
    """The residual that a spec's plan leaves: by requirement (ppm, deg/h; 1σ), by parameter (SI), with its covariance.

    `limits`: also the error sources that limit each requirement, and its range where noise figures are `uncertain`.
    `notices`: also which hidden structure of the maps the plan would notice. `outlook`: also the chance that a unit
    meets a target, and the residual with every absent error term at its typical value. The covariance is the exact one
    of generalised least squares under the spec's noise (`gradcal_jax.information`). What cannot be observed is None,
    with a warning. Errors: none; `read_spec` has validated the spec.
    """
    if isinstance(spec, UnitSpec):
        unit = assemble_unit(spec)
        after = posterior_of_unit(unit)
        of_unit = [unit_requirement_row(unit, after, requirement) for requirement in spec.requirement]
        return Prediction(
            requirements=tuple(_between(of_unit, extremes(spec) if limits else [])),
            warnings=tuple(unit_warnings(unit, after)),
            **_of_plan(spec, unit.model, {"unit": after}),
        )
    built = assemble(spec)
    known = posteriors_of_plan(built)
    shares = {channel: error_budget(built, channel, of) for channel, of in known.items()} if limits else {}
    absent = absent_terms(spec)
    there = [row.decisive for row in requirement_rows(with_typical(spec))] if outlook and absent else []
    rows: list[RequirementRow] = []
    for requirement, channel in product(spec.requirement, built.channels):
        row = _requirement_row(built, known[channel], requirement, channel)
        more = _risks(built, known[channel], requirement, row) if outlook else {}
        if limits:
            more["limited_by"] = limited_by(shares[channel].get(row.name))
        if there:
            more["with_typical"] = there[len(rows)]
        rows.append(row.model_copy(update=more))
    return Prediction(
        requirements=tuple(_between(rows, extremes(spec) if limits else [])),
        notices=noticing(built) if notices else (),
        warnings=tuple(warnings(built, known)),
        counted_as_zero=tuple(AbsentRow(key=t.key, typical=t.typical, source=t.source) for t in absent),
        **_of_plan(spec, built.model, known),
    )


def requirement_rows(spec: Spec | UnitSpec) -> list[RequirementRow]:
    """The residual of every requirement after a spec's plan on every axis, and nothing else of its prediction."""
    if isinstance(spec, UnitSpec):
        unit = assemble_unit(spec)
        known_unit = posterior_of_unit(unit)
        return [unit_requirement_row(unit, known_unit, requirement) for requirement in spec.requirement]
    built = assemble(spec)
    pairs = product(spec.requirement, posteriors_of_plan(built).items())
    return [_requirement_row(built, known, requirement, channel) for requirement, (channel, known) in pairs]


def _between(rows: Sequence[RequirementRow], others: Sequence[Spec | UnitSpec]) -> Sequence[RequirementRow]:
    """The rows with the smallest and largest value over these and other specs with the same requirements."""
    if not others:
        return rows
    ranges = []
    for row, *same in zip(rows, *map(requirement_rows, others), strict=True):
        known = [v for v in (one.decisive for one in (row, *same)) if v is not None]
        ranges.append(row.model_copy(update={"uncertain": (min(known), max(known)) if known else None}))
    return ranges


def _of_plan(spec: Spec | UnitSpec, model: SensorModel | UnitModel, known: Mapping[Any, Posterior]) -> dict[str, Any]:
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


def _asked_and_left(requirement: Requirement | UnitRequirement, values: Mapping[str, float | None]) -> dict[str, Any]:
    """The common fields of a requirement's row: what it asks for, and the value of each statistic."""
    return {
        **{name: getattr(requirement, name) for name in ("name", "quantity", "statistic")},
        "temperature_c": (float(requirement.temperature[0]), float(requirement.temperature[1])),
        "grid": tuple(requirement.grid),
        **{name.replace(" ", "_"): value for name, value in values.items()},
    }


def unit_requirement_row(built: AssembledUnit, known: Posterior, requirement: UnitRequirement) -> RequirementRow:
    """The residual and the verdict of one requirement."""
    left = unit_residual(built, known, requirement)
    by_rate = isinstance(requirement, GyroScaleFactorRequirement)
    values = {name: left.statistic(name) for name in STATISTICS if name != "mean of max" or by_rate}
    unit, factor = UNIT_OF[requirement.quantity]
    target = None if requirement.target is None else float(requirement.target) * factor
    decisive = values[requirement.statistic]
    decision = None if target is None else "met" if decisive is not None and decisive <= target else "missed"
    worst = left.worst_axis()
    return RequirementRow(
        **_asked_and_left(requirement, values),
        unit=unit,
        axis=requirement.axis,
        rate_dps=(float(np.degrees(left.rates[0])), float(np.degrees(left.rates[-1]))) if by_rate else None,
        target=target,
        verdict="unobservable" if decisive is None else decision,
        limited_by=None if worst is None else f"axis {worst}",
    )


def _requirement_row(built: Assembled, known: Posterior, requirement: Requirement, channel: Axis) -> RequirementRow:
    _, rates, values = residual_map(built, known, requirement)
    statistics = {
        name: finite(statistic_of(requirement, values, name))
        for name in STATISTICS
        if name != "mean of max" or requirement.quantity == "scale_factor"
    }
    target, worst = target_of(requirement), statistics["max"]
    own, flown = own_noise_of(built, requirement), requirement if isinstance(requirement, HeadingRequirement) else None
    if flown is not None:
        rates = np.array([float(rate) * DEG_PER_S for rate in flown.rate])
    return RequirementRow(
        **_asked_and_left(requirement, statistics),
        unit=UNIT_OF[requirement.quantity][0],
        axis=channel,
        rate_dps=(float(rates[0]), float(rates[-1])) if len(rates) > 1 else None,
        target=target,
        verdict=verdict(requirement, values),
        coverage=requirement.coverage,
        rule=decision_rule(requirement) or None,
        specific_risk=None if target is None or worst is None else specific_risk(0.0, worst, target),
        own=None if own is None else own.total,
        own_sources=None if own is None else own.sources,
        missions=None if flown is None or own is None else mission_table(flown, values, own),
    )


def _risks(built: Assembled, known: Posterior, requirement: Requirement, row: RequirementRow) -> dict[str, Any]:
    """The chances that a unit keeps the target (on a grid of at most 41 a side), and the risks of a second run.

    That run is as uncertain as the first and independent of it. Errors that both runs share (the sensor's clock, the
    encoder's error by angle) do not show in a second run, and are not in its risks.
    """
    if row.target is None or row.max is None or row.max == 0.0:
        return {}
    temperatures, rates = box(requirement, _GRID)
    places = contrasts_of(built.model, requirement, requirement.statistic, (temperatures, rates))
    shape, target = (len(temperatures), len(rates)), float(requirement.target or 0.0)
    chances = chance_of_keeping(known, built.model, places, shape, requirement.statistic, target)
    acceptance: float | None = row.target
    if requirement.risk is not None:
        acceptance = acceptance_limit(row.max, row.target, float(requirement.risk))
    if acceptance is None:
        check = CheckRow(accepted=0.0, false_accept=0.0, false_reject=1.0 - specific_risk(0.0, row.max, row.target))
    else:
        check = CheckRow(**global_risks(row.max, row.max, row.target, acceptance)._asdict())
    return {"check": check} | (
        {} if chances is None else dict(zip(("chance", "chance_everywhere"), chances, strict=True))
    )
