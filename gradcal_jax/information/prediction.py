"""The prediction of a spec, as the contract gradcal-prediction/1."""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple, cast

import numpy as np

from gradcal_jax.information import STATISTICS, Posterior
from gradcal_jax.information.error_budget import ErrorBudget, limited_by
from gradcal_jax.information.plan_information import imu_posterior
from gradcal_jax.information.plan_sentences import plan_warnings
from gradcal_jax.information.residual import residual_map
from gradcal_jax.information.unseen import TURN_ON, CountedPosteriors, budget_of_imu
from gradcal_jax.information.verdicts import (
    decision_rule,
    finite,
    limit_of,
    run_of,
    target_of,
    verdict_of,
)
from gradcal_jax.model.build import BuiltImu, build_imu
from gradcal_jax.spec.absent import absent_terms, with_typical
from gradcal_jax.spec.contracts import AbsentRow, ParameterRow, PlaceRow, Prediction, RequirementRow
from gradcal_jax.spec.places import hung_alike
from gradcal_jax.spec.requirement import QUANTITIES, GyroScaleFactorRequirement, Requirement
from gradcal_jax.spec.spec import expect_spec
from gradcal_jax.spec.spec_sections import Spec


class JudgedPlan(NamedTuple):
    """An IMU after its plan: its posterior, those that decide on its requirements, and a row for each of these."""

    built: BuiltImu
    known: Posterior
    budget: CountedPosteriors
    rows: list[RequirementRow]

    def shares(self) -> list[dict[str, float] | None]:
        """The shares of all errors in what the verdict on each requirement judges; None where it is not observable."""
        requirements = self.built.spec.requirement
        sources = ErrorBudget(self.budget) if requirements else None
        return [sources.shares(r, run_of(r)) for r in requirements if sources]

    def limited_rows(self) -> Iterator[RequirementRow]:
        """The rows with the error sources that limit them."""
        for row, shares in zip(self.rows, self.shares(), strict=True):
            axis = (row.limited_by or "").removeprefix("axis ") or None
            yield row.model_copy(update={"limited_by": limited_by(shares, axis)})


def judged_plan(spec: Spec) -> JudgedPlan:
    """What an IMU's plan leaves of every requirement."""
    built = build_imu(expect_spec(spec))
    known = imu_posterior(built)
    full = with_typical(built.spec)
    budget = budget_of_imu(built, known, built if full is built.spec else build_imu(full, like=built))
    return JudgedPlan(built, known, budget, [requirement_row(built, budget, r) for r in built.spec.requirement])


def predict(spec: Spec, *, limits: bool = False, place: str | None = None) -> Prediction:
    """The residual that a spec's plan leaves: by requirement (ppm, deg/h; 1σ), by parameter (SI), with its covariance.

    `limits`: also the error sources that limit each requirement. The covariance is the exact one of generalised least
    squares under the spec's noise (`gradcal_jax.information`); verdicts also count every term that the spec omits, at
    its class's typical figure. What cannot be observed is None, with a warning. Of a fixture each IMU is estimated by
    itself; `place`: the one of which all else is beside the residuals of every place (None: the worst by the residual
    over the target, or else over that of the others). Errors: `ValueError` for a place that the table does not have.

    >>> from gradcal_jax import parse_spec, presets
    >>> predict(parse_spec(presets.text("paper-static-gradient")))  # doctest: +ELLIPSIS
    Prediction: Berman: gyro bias by the gradient method, one ramp
    2 h 40 min in all: soak 1 h, motion 1 h 40 min
    ...
    full range   mean       0.4016 deg/h
    """
    spec = expect_spec(spec)
    places = [of.name for of in spec.rig.table.place]
    if place is not None and place not in places:
        raise ValueError(f"the table has no place {place!r}; known: {', '.join(places)}")
    # Places that hang alike are computed once.
    plans = [(judged_plan(at), names) for at, names in hung_alike(spec)]
    if place is not None:
        plan, names = next(of for of in plans if place in of[1])
    else:
        plan, names = plans[int(np.argmax(_excesses([of.rows for of, _ in plans])))]
    values = {name: {row.name: row.judged for row in of.rows} for of, alike in plans for name in alike}
    omitted = absent_terms(plan.built.spec)
    return Prediction(
        requirements=tuple(plan.limited_rows() if limits else plan.rows),
        warnings=tuple(plan_warnings(plan.built, plan.known)),
        omitted=tuple(AbsentRow(key=t.key, typical=t.typical, source=t.source) for t in omitted),
        places=tuple(PlaceRow(name=name, values=values[name]) for name in places),
        place=(place or names[0]) if places else None,
        **_of_plan(plan.built, plan.known),
    )


def _excesses(places: Sequence[Sequence[RequirementRow]]) -> np.ndarray:
    """How far each place is beyond its targets, or beyond the best place."""
    left = np.array([[np.inf if row.judged is None else row.judged for row in rows] for rows in places])
    best = np.min(left, axis=0, initial=np.inf)
    aims = [
        row.target or (least if np.isfinite(least) else 0.0) or 1.0 for row, least in zip(places[0], best, strict=True)
    ]
    return np.max(left / np.array(aims), axis=1, initial=0.0)


def requirement_rows(spec: Spec) -> list[RequirementRow]:
    """The residual of every requirement after a spec's plan, and nothing else of its prediction."""
    return judged_plan(spec).rows


def missed_targets(spec: Spec, margin: float) -> list[str]:
    """The requirements whose targets a plan does not meet with a margin (a share of the target), with all that their
    verdicts count; of a fixture at any of its places."""
    missed = dict[str, None]()
    for at, _ in hung_alike(spec):
        for row, requirement in zip(judged_plan(at).rows, at.requirement, strict=True):
            aim = limit_of(requirement)
            if aim is not None and (row.judged is None or row.judged > (1.0 - margin) * aim[1]):
                missed[row.name] = None
    return list(missed)


def _of_plan(built: BuiltImu, known: Posterior) -> dict[str, Any]:
    """The part of a prediction that is common to all plans: title, times, the reported parameters and their
    covariance."""
    spec, model = built.spec, built.model
    own = np.flatnonzero(model.discrepancy_stds[: model.calibrated] == 0.0)
    names, units = ([of[k] for k in own] for of in (model.names(), model.units()))
    reported = model.to_reported[own]
    deviations = known.deviations(reported)
    stds = [finite(std) for std in deviations]
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
    left = judged = residual_map(built, budget.own, requirement)
    more: dict[str, Any] = {}
    if not budget.complete:
        judged = residual_map(budget.built, budget.judged("this run"), requirement)
        more["with_typical"] = finite(judged.statistic())
    if run_of(requirement) == "any run" and TURN_ON in budget.columns:
        judged = residual_map(budget.built, budget.judged("any run"), requirement)
        more["another_run"] = finite(judged.statistic())
    by_rate = isinstance(requirement, GyroScaleFactorRequirement)
    rates = left.rates
    axis, target, worst = judged.worst_axis(), target_of(requirement), finite(judged.statistic("max"))
    return RequirementRow(
        **{name: getattr(requirement, name) for name in ("name", "quantity", "statistic", "axis", "coverage")},
        temperature_c=(float(requirement.temperature[0]), float(requirement.temperature[1])),
        grid=tuple(requirement.grid),
        **{n.replace(" ", "_"): finite(left.statistic(n)) for n in STATISTICS if n != "mean of max" or by_rate},
        **more,
        unit=QUANTITIES[requirement.quantity].unit,
        target=target,
        worst=worst,
        verdict=verdict_of(requirement, judged.statistic),
        rule=decision_rule(requirement) or None,
        rate_dps=(float(np.degrees(rates[0])), float(np.degrees(rates[-1]))) if len(rates) > 1 else None,
        limited_by=None if axis is None else f"axis {axis}",
    )


def counted_shares(spec: Spec) -> dict[str, dict[str, float]]:
    """For each requirement (by name) the share of every error in the variance of what the verdict judges: noise, what
    no residual shows, and what the spec omits; requirements that the plan cannot observe are left out."""
    plan = judged_plan(spec)
    shares = zip(plan.built.spec.requirement, plan.shares(), strict=True)
    return {str(requirement.name): of for requirement, of in shares if of is not None}
