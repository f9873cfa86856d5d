"""The prediction of a spec, as the contract gradcal-prediction/1."""

from collections.abc import Callable, Mapping
from typing import Any, cast

import numpy as np

from gradcal_jax.information import (
    STATISTICS,
    Posterior,
)
from gradcal_jax.information.error_budget import ErrorBudget, limited_by, shares_of_variance
from gradcal_jax.information.imu_residual import (
    ImuResidual,
    imu_residual,
)
from gradcal_jax.information.plan_sentences import plan_warnings
from gradcal_jax.information.residual import Statistic
from gradcal_jax.information.unseen import CountedPosteriors, budget_of_imu
from gradcal_jax.information.verdicts import (
    UNIT_OF,
    decision_rule,
    finite,
    limit_of,
    run_of,
    specific_risk,
    target_of,
    verdict_of,
)
from gradcal_jax.model.build import (
    BuiltImu,
    build_imu,
    hung_alike,
    imu_posterior,
)
from gradcal_jax.spec.absent import absent_terms, with_typical
from gradcal_jax.spec.requirement import GyroScaleFactorRequirement, MissionHeadingRequirement, Requirement
from gradcal_jax.spec.spec import expect_spec
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.tables.contracts import AbsentRow, ParameterRow, PlaceRow, Prediction, RequirementRow


def predict(spec: Spec, *, limits: bool = False, place: str | None = None) -> Prediction:
    """The residual that a spec's plan leaves: by requirement (ppm, deg/h; 1σ), by parameter (SI), with its covariance.

    `limits`: also the error sources that limit each requirement. The covariance is the exact one of generalised least
    squares under the spec's noise (`gradcal_jax.information`); verdicts also count every term that the spec omits, at
    its class's typical figure. What cannot be observed is None, with a warning. `place`: of a fixture, the place of
    which all else is beside the residuals of every place (None: the worst). Errors: `ValueError` for a place that the
    table does not have.

    >>> from gradcal_jax import parse_spec, presets
    >>> predict(parse_spec(presets.text("paper-static-gradient")))  # doctest: +ELLIPSIS
    Prediction: Berman: gyro bias by the gradient method, one ramp
    2 h 40 min in all: soak 1 h, motion 1 h 40 min
    ...
    full range   mean       0.4016 deg/h
    """
    spec = expect_spec(spec)
    if spec.rig.table.place:
        return _at_places(spec, place, limits=limits)
    built = build_imu(spec)
    known = imu_posterior(built)
    budget = counted_posteriors(built, known)
    return _prediction(built, known, budget, limits=limits)


def _prediction(
    built: BuiltImu,
    known: Posterior,
    budget: CountedPosteriors,
    *,
    limits: bool,
) -> Prediction:
    """The prediction of an IMU with these posteriors."""
    spec = built.spec
    omitted = tuple(AbsentRow(key=t.key, typical=t.typical, source=t.source) for t in absent_terms(spec))
    sources = ErrorBudget(budget.built, budget.fit) if limits and spec.requirement else None
    rows: list[RequirementRow] = []
    for requirement in spec.requirement:
        row = requirement_row(built, budget, requirement)
        more: dict[str, Any] = {}
        if sources is not None:
            axis = (row.limited_by or "").removeprefix("axis ") or None
            more["limited_by"] = limited_by(_shares(budget, requirement, sources.shares(requirement)), axis)
        rows.append(row.model_copy(update=more))
    return Prediction(
        requirements=tuple(rows),
        warnings=tuple(plan_warnings(built, known)),
        omitted=omitted,
        **_of_plan(built, known),
    )


def _at_places(spec: Spec, place: str | None, **options: bool) -> Prediction:
    """The prediction of a fixture, each of whose IMUs is estimated by itself: of a place, or of the worst by the
    residual over the target or else over that of the others, with the values of all places. Places that hang alike are
    computed once."""
    hung = hung_alike(spec)
    alike = [names for _, names in hung]
    builts = [build_imu(at) for at, _ in hung]
    known = [imu_posterior(built) for built in builts]
    budgets = [counted_posteriors(built, of) for built, of in zip(builts, known, strict=True)]
    rows = [
        [requirement_row(built, budget, requirement) for requirement in spec.requirement]
        for built, budget in zip(builts, budgets, strict=True)
    ]
    least = [min((r.judged for r in of if r.judged is not None), default=0.0) for of in zip(*rows, strict=True)]

    def excess(k: int) -> float:
        """How far a place is beyond its targets, or beyond the best place."""
        ratios = [
            np.inf if row.judged is None else row.judged / (row.target or best or 1.0)
            for row, best in zip(rows[k], least, strict=True)
        ]
        return max(ratios, default=0.0)

    named = [k for k, names in enumerate(alike) if place in names]
    if place is not None and not named:
        known_names = ", ".join(of.name for of in spec.rig.table.place)
        raise ValueError(f"the table has no place {place!r}; known: {known_names}")
    shown = named[0] if named else max(range(len(rows)), key=excess)
    whole = _prediction(builts[shown], known[shown], budgets[shown], **options)
    values = {
        name: PlaceRow(name=name, values={row.name: row.judged for row in rows[k]})
        for k, names in enumerate(alike)
        for name in names
    }
    return whole.model_copy(
        update={
            "places": tuple(values[of.name] for of in spec.rig.table.place),
            "place": place if named else alike[shown][0],
        }
    )


def requirement_rows(spec: Spec) -> list[RequirementRow]:
    """The residual of every requirement after a spec's plan, and nothing else of its prediction."""
    built = build_imu(expect_spec(spec))
    budget = counted_posteriors(built, imu_posterior(built))
    return [requirement_row(built, budget, requirement) for requirement in built.spec.requirement]


def missed_targets(spec: Spec, margin: float) -> list[str]:
    """The requirements whose targets a plan does not meet with a margin (a share of the target), with all that their
    verdicts count; of a fixture at any of its places."""
    missed = dict[str, None]()
    for at, _ in hung_alike(spec):
        built = build_imu(at)
        budget = counted_posteriors(built, imu_posterior(built))
        for requirement in at.requirement:
            if (aim := limit_of(requirement)) is not None:
                left = _judged(budget, requirement)[0].finite_statistic(aim[0])
                missed |= {} if left <= (1.0 - margin) * aim[1] else {requirement.name: None}
    return list(missed)


def counted_posteriors(built: BuiltImu, known: Posterior) -> CountedPosteriors:
    """The posteriors that decide on every requirement."""
    return budget_of_imu(built, known, _complete(built))


def _complete(built: BuiltImu) -> BuiltImu:
    """The IMU with the error terms that its spec omits, at their classes' typical figures."""
    full = with_typical(built.spec)
    return built if full is built.spec else build_imu(full, like=built)


def _of_plan(built: BuiltImu, known: Posterior) -> dict[str, Any]:
    """The part of a prediction that is common to all plans: title, times, the reported parameters and their
    covariance."""
    spec, model = built.spec, built.model
    own = np.flatnonzero(model.discrepancy_stds[: model.calibrated] == 0.0)
    names, units = ([of[k] for k in own] for of in (model.names(), model.units()))
    reported = model.to_reported[own]
    deviations = known.deviations(reported)
    stds = [float(std) if np.isfinite(std) else None for std in deviations]
    rows = [ParameterRow(name=n, axis="unit", std=std, unit=u) for n, std, u in zip(names, stds, units, strict=True)]
    seen = np.isfinite(deviations)
    covariance = np.where(np.outer(seen, seen), known.covariance(reported), cast("Any", None))
    return {
        "title": spec.title,
        **{f"{name}_s": getattr(spec.schedule, name) for name in ("duration", "soak", "motion")},
        "parameters": tuple(rows),
        "covariance": tuple(map(tuple, covariance.tolist())),
    }


def requirement_row(built: BuiltImu, budget: CountedPosteriors, requirement: Requirement) -> RequirementRow:
    """The residual and the verdict of one requirement."""
    left = imu_residual(built, budget.own, requirement)
    judged, more = _judged(budget, requirement, left)
    by_rate = isinstance(requirement, GyroScaleFactorRequirement)
    worst, rates = judged.worst_axis(), left.rates
    if isinstance(requirement, MissionHeadingRequirement):
        rates = np.array([float(rate) for rate in requirement.rate])
    statistics = {name: left.statistic(name) for name in STATISTICS if name != "mean of max" or by_rate}
    return RequirementRow(
        **{name: getattr(requirement, name) for name in ("name", "quantity", "statistic")},
        temperature_c=(float(requirement.temperature[0]), float(requirement.temperature[1])),
        grid=tuple(requirement.grid),
        **{name.replace(" ", "_"): value for name, value in statistics.items()},
        **more,
        **decided(requirement, judged.finite_statistic),
        axis=requirement.axis,
        rate_dps=(float(np.degrees(rates[0])), float(np.degrees(rates[-1]))) if len(rates) > 1 else None,
        limited_by=None if worst is None else f"axis {worst}",
    )


def _judged(
    budget: CountedPosteriors, requirement: Requirement, own: ImuResidual | None = None
) -> tuple[ImuResidual, dict[str, Any]]:
    """The residual that the verdict judges, and its fields in the row: with omitted terms, and with another run. `own`:
    the residual with what the spec names, if it is known."""
    fields: dict[str, Any] = {}
    judged = own if budget.whole is budget.own else None
    judged = imu_residual(budget.built, budget.whole, requirement) if judged is None else judged
    if budget.whole is not budget.own:
        fields["with_typical"] = judged.statistic()
    if run_of(requirement) == "any run" and budget.any_run is not budget.whole:
        judged = imu_residual(budget.built, budget.any_run, requirement)
        fields["another_run"] = judged.statistic()
    return judged, fields


def decided(requirement: Requirement, of: Callable[[Statistic], float]) -> dict[str, Any]:
    """Target, verdict, rule and risk, by the statistics of what is judged."""
    target, worst = target_of(requirement), finite(of("max"))
    return {
        "unit": UNIT_OF[requirement.quantity][0],
        "target": target,
        "worst": worst,
        "verdict": verdict_of(requirement, of),
        "coverage": requirement.coverage,
        "rule": decision_rule(requirement) or None,
        "specific_risk": None if target is None or worst is None else specific_risk(0.0, worst, target),
    }


def counted_shares(spec: Spec) -> dict[str, dict[str, float]]:
    """For each requirement (by name) the share of every error in the variance of what the verdict judges: noise, what
    no residual shows, and what the spec omits; requirements that the plan cannot observe are left out."""
    built = build_imu(expect_spec(spec))
    budget = counted_posteriors(built, imu_posterior(built))
    sources = ErrorBudget(budget.built, budget.fit)
    shares = {r.name: _shares(budget, r, sources.shares(r)) for r in built.spec.requirement}
    return {name: of for name, of in shares.items() if of is not None}


def _shares(
    budget: CountedPosteriors, requirement: Requirement, of_fit: Mapping[str, float] | None
) -> dict[str, float] | None:
    """The shares of all errors in what the verdict judges, the largest first."""
    if of_fit is None:
        return None

    def value(of: Posterior) -> float:
        return imu_residual(budget.built, of, requirement).finite_statistic()

    fit, unseen = shares_of_variance(budget, run_of(requirement), value)
    shares = {name: share * fit for name, share in of_fit.items()}
    for name, share in unseen.items():
        shares[name] = shares.get(name, 0.0) + share
    return dict(sorted(shares.items(), key=lambda item: -item[1]))
