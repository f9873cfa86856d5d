"""The objective of a spec's [design], as `predict` evaluates a plan: what it leaves of the requirements, over their
targets, in every scenario."""

import math
from collections.abc import Sequence
from statistics import fmean
from typing import Any, Final, NamedTuple

import numpy as np

from gradcal_jax.information import (
    Posterior,
)
from gradcal_jax.information.imu_residual import ImuResidual, quantity_of
from gradcal_jax.information.residual import Residual, Statistic
from gradcal_jax.information.unseen import own_of_imu, posterior_and_answers, unseen_columns
from gradcal_jax.information.verdicts import UNIT_OF, limit_of
from gradcal_jax.model.build import (
    BuiltImu,
    build_imu,
    hung_alike,
)
from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.design import ALL, TIMES, WORST, Design, Scenario
from gradcal_jax.spec.requirement import Requirement
from gradcal_jax.spec.spec_sections import Spec


def scenario_specs(spec: Spec) -> list[tuple[Spec, float]]:
    """The spec of each scenario, with its weight; the spec itself where there is none."""
    scenarios = spec.design.scenario if spec.design is not None else ()
    return [(changed(spec, overrides(s)), float(s.weight)) for s in scenarios] or [(spec, 1.0)]


def overrides(scenario: Scenario) -> dict[str, Any]:
    """A scenario's values by their dotted keys."""
    return dict(_leaves({"sensor": scenario.sensor, "rig": scenario.rig}, ""))


def _leaves(tables: dict[str, Any], before: str):
    for name, value in tables.items():
        key = f"{before}.{name}" if before else name
        if isinstance(value, dict):
            yield from _leaves(value, key)
        else:
            yield key, value


EXCESS: Final = 10.0
"""What a limit that is exceeded costs, in multiples of the logarithm of what it leaves over its target: more than any
limit's price, so that the optimum keeps all."""
KEPT: Final = 1e-3
"""Largest log excess at which a limit counts as satisfied."""
MARGIN: Final = 0.1
"""A target is met with margin if the residual is below the target by this fraction or more."""
MET: Final = f"every target is met with a margin of {MARGIN:.0%}"
NO_TARGET: Final = "to stop when every target is met, give a requirement a target"


class PlanCase(NamedTuple):
    """A scenario at a place, with its weight."""

    spec: Spec
    weight: float


def cases_of(spec: Spec) -> list[PlanCase]:
    """The spec at each place that hangs differently, in each scenario."""
    return [PlanCase(one, weight * len(names)) for at, names in hung_alike(spec) for one, weight in scenario_specs(at)]


def known_after(cases: Sequence[PlanCase]) -> tuple[list[BuiltImu], list[Posterior]]:
    """What is known after the plans of cases, by the terms that their specs name."""
    builts = [build_imu(case.spec) for case in cases]
    return builts, [own_of_imu(built) for built in builts]


Residuals = Sequence[Sequence[ImuResidual]]


class Aim(NamedTuple):
    """A number of a plan: the statistic of a requirement that counts, and its `limit` (1 where there is none) in its
    `unit`, of which `per_si` are one in SI. `counted` in the objective, or `limiting` the search."""

    name: str
    unit: str
    per_si: float
    statistic: Statistic
    limit: float
    counted: bool
    limiting: bool

    def log(self, left: ImuResidual) -> float:
        """The logarithm of the statistic over its limit."""
        value = left.statistic(self.statistic)
        return math.log(value / self.limit) if value else math.inf


class RequirementChange(NamedTuple):
    """A requirement's statistic (`unit`, 1σ, by the terms that the spec names) before and after a search; None: not
    observable."""

    name: str
    unit: str
    before: float | None
    now: float | None


class ExactObjective:
    """What the [design] of a spec minimises: the logarithms of the residuals over their `aims`, in each of its `cases`:
    of the requirements in order.

    Of several counted aims the mean or the `worst`; over the cases the worst, or the mean: of ratios to targets the
    geometric one.
    """

    def __init__(self, spec: Spec) -> None:
        self.spec, self.design = spec, spec.design or Design()
        self.cases = cases_of(spec)
        self.builts = [build_imu(case.spec) for case in self.cases]
        if len({built.model.size for built in self.builts}) > 1:
            raise ValueError(
                "a design.scenario changes the set of parameters: every scenario must have the spec's parameters"
            )
        weights = np.array([case.weight for case in self.cases])
        self.weights = weights / np.sum(weights)
        name = self.design.minimise
        timed = name in TIMES
        self.worst, self.of_logs = timed or name == WORST, name in (ALL, WORST)
        limited = not self.worst and name != ALL
        self.aims: tuple[Aim, ...] = tuple(
            Aim(
                r.name,
                *UNIT_OF[r.quantity],
                *_aim_of(r, self.design),
                (self.worst or name in (ALL, r.name)) and not (timed and r.target is None),
                limited and r.name != name and r.target is not None,
            )
            for r in spec.requirement
        )
        if timed and not any(aim.counted for aim in self.aims):
            raise ValueError(
                f'minimise = "{name}" finds the shortest plan that meets the targets: give at least one requirement a '
                "target"
            )
        if not self.aims:
            raise ValueError("the spec has no [[requirement]] to minimise: add one")
        self._quantities = [tuple(quantity_of(built, r) for r in spec.requirement) for built in self.builts]

    def statistics(self) -> list[tuple[Aim, Residual]]:
        """The aims that a search counts, then those that limit it, each as a function of a covariance."""
        built, found = self.builts[0], list[tuple[Aim, Residual]]()
        unseen = unseen_columns(built, posterior_and_answers(built)[1])
        for r, aim in zip(self.spec.requirement, self.aims, strict=False):
            if aim.counted or aim.limiting:
                found.append((aim, quantity_of(built, r).statistic(aim.statistic, unseen)))
        return sorted(found, key=lambda pair: pair[0].limiting)

    def residuals(self, spec: Spec) -> Residuals:
        """What a spec's plan leaves at each place in each scenario, in the order of the aims."""
        _, known = known_after(cases_of(spec))
        return [[q.residual(of) for q in quantities] for of, quantities in zip(known, self._quantities, strict=True)]

    def value_of(self, residuals: Residuals) -> float:
        """What a search minimises: the objective of a plan that leaves these residuals, and the cost of its excess."""
        return self.without_limits(residuals) + EXCESS * sum(self.exceeded(residuals).values())

    def without_limits(self, residuals: Residuals) -> float:
        """The objective alone."""
        logs = [[a.log(r) for r, a in zip(of, self.aims, strict=True) if a.counted] for of in residuals]
        each = [(max if self.worst else fmean)(of) for of in logs]
        if self.design.robust == "worst":
            return max(each)
        if self.of_logs or len(each) == 1 or not math.isfinite(max(each)):
            return float(self.weights @ each)
        return math.log(float(self.weights @ np.exp(each)))

    def shown(self, residuals: Residuals) -> float:
        """The objective alone, in the unit of `name_and_unit`."""
        return self.name_and_unit()[2] * math.exp(self.without_limits(residuals))

    def exceeded(self, residuals: Residuals) -> dict[str, float]:
        """By how much (natural logarithm) targets that are limits are exceeded, summed over the cases, by name."""
        logs = {a.name: [a.log(of[k]) for of in residuals] for k, a in enumerate(self.aims) if a.limiting}
        return {name: sum(max(x, 0.0) for x in of) for name, of in logs.items() if max(of) > 0.0}

    def missed(self, residuals: Residuals) -> dict[str, float]:
        """The same of targets that are exceeded by more than what counts as rounding."""
        return {name: by for name, by in self.exceeded(residuals).items() if by > KEPT}

    def name_and_unit(self) -> tuple[str, str, float]:
        """Name and unit of the objective for people, and how many of the unit are one of `value_of`, exponentiated."""
        counted = [aim for aim in self.aims if aim.counted]
        if self.worst or len(counted) > 1:
            name = "largest residual" if self.worst else "geometric mean of all residuals"
            rows = [r for r, aim in zip(self.spec.requirement, self.aims, strict=False) if aim.counted]
            return name, "of the target" if all(r.target is not None for r in rows) else "", 1.0
        (aim,) = counted
        return f"{aim.name} ({aim.statistic})", aim.unit, aim.limit

    def changes(self, before: Residuals, now: Residuals) -> tuple[RequirementChange, ...]:
        """What two plans leave of the requirements, in the worst case."""
        rows = []
        for k, r in enumerate(self.spec.requirement):
            worst = (max((of[k] for of in left), key=ImuResidual.finite_statistic) for left in (before, now))
            rows.append(RequirementChange(r.name, UNIT_OF[r.quantity][0], *(of.statistic() for of in worst)))
        return tuple(rows)

    def met(self, residuals: Residuals) -> bool:
        """Whether every target is met by its rule with `MARGIN`, and a hidden map noticed, in every case. Errors:
        `ValueError` where there is no target."""
        aims = [limit_of(r) for r in self.spec.requirement]
        if all(aim is None for aim in aims):
            raise ValueError(NO_TARGET)
        left = [(r.statistic(a[0]), a[1]) for of in residuals for r, a in zip(of, aims, strict=False) if a is not None]
        met = all(value is not None and value <= (1.0 - MARGIN) * limit for value, limit in left)
        return met


def _aim_of(requirement: Requirement, design: Design) -> tuple[Statistic, float]:
    """The statistic of a requirement that counts, and what it is divided by (`UNIT_OF`): its target by its rule, or 1.
    Of a requirement that alone is minimised its own statistic counts."""
    limit = None if requirement.name == design.minimise else limit_of(requirement)
    return (requirement.statistic, 1.0) if limit is None else limit
