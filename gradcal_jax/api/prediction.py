"""The prediction of a spec, as the contract gradcal-prediction/1."""

from collections.abc import Callable, Iterator, Mapping, Sequence
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
    run_of,
    statistic_of,
    target_of,
    verdict_of,
)
from gradcal_jax.api.scenarios import extremes
from gradcal_jax.api.systematic import CountedPosteriors, budget_of_plan, budget_of_unit, shares_of_variance
from gradcal_jax.api.tested_maps import noticing, noticing_of_imu
from gradcal_jax.api.unit_build import AssembledUnit, assemble_unit, posterior_of_unit
from gradcal_jax.api.unit_residual import unit_residual
from gradcal_jax.api.unit_sentences import unit_warnings
from gradcal_jax.api.warnings import warnings
from gradcal_jax.files import Prediction, Spec
from gradcal_jax.files.absent import absent_terms, with_typical
from gradcal_jax.files.contracts import AbsentRow, CheckRow, ParameterRow, RequirementRow
from gradcal_jax.files.moves import Axis
from gradcal_jax.files.requirement import GyroScaleFactorRequirement, HeadingRequirement, Requirement, UnitRequirement
from gradcal_jax.files.spec import expect_spec
from gradcal_jax.files.unit_spec import UnitSpec
from gradcal_jax.information import STATISTICS, Posterior
from gradcal_jax.information.conformity import acceptance_limit, chance_of_keeping, global_risks, specific_risk
from gradcal_jax.information.residual import Statistic
from gradcal_jax.model import SensorModel, UnitModel

# The chances of keeping a target are computed on a grid of at most this many temperatures and rates.
_GRID = 41


def predict(spec: Spec | UnitSpec, *, limits: bool = False, notices: bool = False, outlook: bool = False) -> Prediction:
    """The residual that a spec's plan leaves: by requirement (ppm, deg/h; 1σ), by parameter (SI), with its covariance.

    `limits`: also the error sources that limit each requirement, and its range where noise figures are `uncertain`.
    `notices`: also which hidden structure of the maps the plan would notice. `outlook`: also the chance that an axis
    meets a target, and the risks of a second run that checks it. The covariance is the exact one of generalised least
    squares under the spec's noise (`gradcal_jax.information`); verdicts and risks also count every term that the spec
    omits, at its class's typical figure. What cannot be observed is None, with a warning. Errors: none; `read_spec` has
    validated the spec.
    """
    absent = absent_terms(spec if isinstance(spec, UnitSpec) else expect_spec(spec))
    omitted = tuple(AbsentRow(key=t.key, typical=t.typical, source=t.source) for t in absent)
    if isinstance(spec, UnitSpec):
        unit = assemble_unit(spec)
        after = posterior_of_unit(unit)
        rows = _unit_rows(unit, after)
        if outlook:
            pairs = zip(spec.requirement, rows, strict=True)
            rows = [row.model_copy(update=_checked(requirement, row)) for requirement, row in pairs]
        return Prediction(
            requirements=tuple(_between(rows, extremes(spec) if limits else [])),
            notices=noticing_of_imu(unit) if notices else (),
            warnings=tuple(unit_warnings(unit, after)),
            omitted=omitted,
            **_of_plan(spec, unit.model, {"unit": after}),
        )
    built = assemble(spec)
    known = posteriors_of_plan(built)
    shares: dict[Axis, dict[str, dict[str, float]]] = {}
    rows: list[RequirementRow] = []
    for requirement, channel, budget in counted_posteriors(built, known):
        row = requirement_row(built, budget, requirement, channel)
        more = _risks(budget, requirement, row) if outlook else {}
        if limits:
            if channel not in shares:
                shares[channel] = error_budget(budget.built, channel, budget.fit)
            more["limited_by"] = limited_by(_shares(budget, requirement, shares[channel].get(row.name)))
        rows.append(row.model_copy(update=more))
    return Prediction(
        requirements=tuple(_between(rows, extremes(spec) if limits else [])),
        notices=noticing(built) if notices else (),
        warnings=tuple(warnings(built, known)),
        omitted=omitted,
        **_of_plan(spec, built.model, known),
    )


def requirement_rows(spec: Spec | UnitSpec, until_s: float = np.inf) -> list[RequirementRow]:
    """The residual of every requirement after a spec's plan on every axis, and nothing else of its prediction.
    `until_s`: where the plan is broken off, on its clock."""
    if isinstance(spec, UnitSpec):
        unit = assemble_unit(spec, until_s)
        return _unit_rows(unit, posterior_of_unit(unit))
    built = assemble(spec, until_s)
    return [
        requirement_row(built, budget, r, c) for r, c, budget in counted_posteriors(built, posteriors_of_plan(built))
    ]


def counted_posteriors(
    built: Assembled, known: Mapping[Axis, Posterior]
) -> Iterator[tuple[Requirement, Axis, CountedPosteriors]]:
    """Every requirement on every axis, with the posteriors that decide."""
    full = with_typical(built.spec)
    complete = built if full is built.spec else assemble(full, built.until_s)
    budgets = {channel: budget_of_plan(built, of, channel, complete) for channel, of in known.items()}
    for requirement, channel in product(built.spec.requirement, built.channels):
        yield requirement, channel, budgets[channel]


def _unit_rows(unit: AssembledUnit, known: Posterior) -> list[RequirementRow]:
    full = with_typical(unit.spec)
    budget = budget_of_unit(unit, known, unit if full is unit.spec else assemble_unit(full, unit.until_s))
    return [unit_requirement_row(unit, budget, requirement) for requirement in unit.spec.requirement]


def _between(rows: Sequence[RequirementRow], others: Sequence[Spec | UnitSpec]) -> Sequence[RequirementRow]:
    """The rows with the smallest and largest value over these and other specs with the same requirements."""
    if not others:
        return rows
    ranges = []
    for row, *same in zip(rows, *map(requirement_rows, others), strict=True):
        known = [v for v in (one.judged for one in (row, *same)) if v is not None]
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


def unit_requirement_row(
    built: AssembledUnit, budget: CountedPosteriors, requirement: UnitRequirement
) -> RequirementRow:
    """The residual and the verdict of one requirement."""
    left = unit_residual(built, budget.own, requirement)
    judged, more = _judged_maps(
        budget, requirement, lambda of: unit_residual(budget.built, of, requirement), lambda m: m.statistic()
    )
    by_rate = isinstance(requirement, GyroScaleFactorRequirement)
    worst = judged.worst_axis()
    infinite = lambda name: value if (value := judged.statistic(name)) is not None else np.inf  # noqa: E731
    return RequirementRow(
        **_asked_and_left(
            requirement, {name: left.statistic(name) for name in STATISTICS if name != "mean of max" or by_rate}
        ),
        **more,
        **_decided(requirement, infinite),
        axis=requirement.axis,
        rate_dps=(float(np.degrees(left.rates[0])), float(np.degrees(left.rates[-1]))) if by_rate else None,
        limited_by=None if worst is None else f"axis {worst}",
    )


def requirement_row(
    built: Assembled, budget: CountedPosteriors, requirement: Requirement, channel: Axis
) -> RequirementRow:
    """The residual and the verdict of one requirement on one axis."""
    _, rates, values = residual_map(built, budget.own, requirement)
    judged, more = _judged_maps(
        budget,
        requirement,
        lambda of: residual_map(budget.built, of, requirement)[2],
        lambda m: finite(statistic_of(requirement, m)),
    )
    statistics = {
        name: finite(statistic_of(requirement, values, name))
        for name in STATISTICS
        if name != "mean of max" or requirement.quantity == "scale_factor"
    }
    own, flown = own_noise_of(built, requirement), requirement if isinstance(requirement, HeadingRequirement) else None
    if flown is not None:
        rates = np.array([float(rate) * DEG_PER_S for rate in flown.rate])
    return RequirementRow(
        **_asked_and_left(requirement, statistics),
        **more,
        **_decided(requirement, lambda name: statistic_of(requirement, judged, name)),
        axis=channel,
        rate_dps=(float(rates[0]), float(rates[-1])) if len(rates) > 1 else None,
        own=None if own is None else own.total,
        own_sources=None if own is None else own.sources,
        missions=None if flown is None or own is None else mission_table(flown, values, own),
    )


def _judged_maps(
    budget: CountedPosteriors,
    requirement: Requirement | UnitRequirement,
    residual_of: Callable[[Posterior], Any],
    value: Callable[[Any], float | None],
) -> tuple[Any, dict[str, Any]]:
    """The residual that the verdict judges, and its fields in the row: with omitted terms, and with another run."""
    fields: dict[str, Any] = {}
    judged = residual_of(budget.whole)
    if budget.whole is not budget.own:
        fields["with_typical"] = value(judged)
    if run_of(requirement) == "any run" and budget.any_run is not budget.whole:
        judged = residual_of(budget.any_run)
        fields["another_run"] = value(judged)
    return judged, fields


def _decided(requirement: Requirement | UnitRequirement, of: Callable[[Statistic], float]) -> dict[str, Any]:
    """Target, verdict, rule and risk, by the statistics of what is judged."""
    target, worst = target_of(requirement), finite(of("max"))
    return {
        "unit": UNIT_OF[requirement.quantity][0],
        "target": target,
        "worst": worst,
        "verdict": verdict_of(requirement, of),
        "coverage": requirement.coverage,
        "risk": None if requirement.risk is None else float(requirement.risk),
        "rule": decision_rule(requirement) or None,
        "specific_risk": None if target is None or worst is None else specific_risk(0.0, worst, target),
    }


def counted_shares(spec: Spec) -> dict[tuple[str, Axis], dict[str, float]]:
    """For each requirement (by name) and axis the share of every error in the variance of what the verdict judges:
    noise, what no residual shows, and what the spec omits."""
    built = assemble(spec)
    shares: dict[tuple[str, Axis], dict[str, float]] = {}
    of_fit: dict[Axis, dict[str, dict[str, float]]] = {}
    for requirement, channel, budget in counted_posteriors(built, posteriors_of_plan(built)):
        if channel not in of_fit:
            of_fit[channel] = error_budget(budget.built, channel, budget.fit)
        if (found := _shares(budget, requirement, of_fit[channel].get(requirement.name))) is not None:
            shares[requirement.name, channel] = found
    return shares


def _shares(
    budget: CountedPosteriors, requirement: Requirement, of_fit: Mapping[str, float] | None
) -> dict[str, float] | None:
    """The shares of all errors in what the verdict judges, the largest first."""
    if of_fit is None:
        return None

    def value(of: Posterior) -> float:
        return statistic_of(requirement, residual_map(budget.built, of, requirement)[2])

    fit, unseen = shares_of_variance(budget, run_of(requirement), value)
    shares = {name: share * fit for name, share in of_fit.items()}
    return dict(sorted((shares | unseen).items(), key=lambda item: -item[1]))


def _risks(budget: CountedPosteriors, requirement: Requirement, row: RequirementRow) -> dict[str, Any]:
    """The chances that a unit keeps the target (on a grid of at most 41 a side), and the risks of a second run.

    That run is as uncertain as the first and independent of it. Errors that both runs share (the sensor's clock, the
    encoder's error by angle) do not show in a second run, and are not in its risks.
    """
    if row.target is None or row.worst is None or row.worst == 0.0:
        return {}
    known = budget.judged(run_of(requirement))
    model = budget.built.model
    temperatures, rates = box(requirement, _GRID)
    places = contrasts_of(model, requirement, requirement.statistic, (temperatures, rates))
    shape, target = (len(temperatures), len(rates)), float(requirement.target or 0.0)
    chances = chance_of_keeping(known, model, places, shape, requirement.statistic, target)
    return _checked(requirement, row) | (
        {} if chances is None else dict(zip(("chance", "chance_everywhere"), chances, strict=True))
    )


def _checked(requirement: Requirement | UnitRequirement, row: RequirementRow) -> dict[str, Any]:
    """The risks of a second run that checks the first one: as uncertain as that and independent of it."""
    if row.target is None or not row.worst:
        return {}
    acceptance: float | None = row.target
    if requirement.risk is not None:
        acceptance = acceptance_limit(row.worst, row.target, float(requirement.risk))
    if acceptance is None:
        return {
            "check": CheckRow(
                accepted=0.0, false_accept=0.0, false_reject=1.0 - specific_risk(0.0, row.worst, row.target)
            )
        }
    return {"check": CheckRow(**global_risks(row.worst, row.worst, row.target, acceptance)._asdict())}
