"""The search for the plan that minimises a [design]'s objective: what every kind of it has in common, and what it
yields.

A search proposes points; each becomes a plan as a recipe rounds it, which counts as `predict` evaluates it.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from statistics import fmean
from typing import Any, Final, NamedTuple, Protocol

import numpy as np

from gradcal_jax.design.plan_objective import (
    MARGIN,
    MET,
    ExactObjective,
    RequirementChange,
    Residuals,
    requirement_changes,
)
from gradcal_jax.information.prediction import missed_targets
from gradcal_jax.information.verdicts import finite
from gradcal_jax.recipe.rounding import rounded
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.tables.display import summary
from gradcal_jax.tables.problems import SpecError


class SearchStep(NamedTuple):
    """Progress of an optimisation: `best` in `unit`, of `name`; `share` of the work that is done, 0 to 1.

    `missed`: the limits that the best plan so far exceeds, in words.
    """

    name: str
    unit: str
    before: float | None
    best: float
    share: float
    words: str
    missed: str


class Price(NamedTuple):
    """The shadow price of a limit: the change of the objective for each `per` by which the limit is eased, zero or
    less; up to `linear` of them (None: unknown) the change is in proportion."""

    limit: str
    per: str
    change: float
    linear: float | None = None


class PricedLimit(NamedTuple):
    """A limit that may be eased: the unit `per` which it is priced, that unit and the limit's size in SI; a size that
    is zero or not finite: there is no such limit."""

    name: str
    per: str
    unit: float
    size: float


# Step of a derivative, as a share of the limit; easings at which a price is compared with the objective itself, and the
# relative error up to which it is linear.
_STEP: Final = 1e-4
_LINEAR_STEPS: Final = (10.0, 3.0, 1.0, 0.3, 0.1, 0.03, 0.01)
_LINEAR: Final = 0.2


def priced(value: float, limits: Sequence[PricedLimit], log: Callable[[np.ndarray], float]) -> tuple[Price, ...]:
    """The prices of limits at an optimum of a `value`, from the objective's logarithm with the limits eased by so much
    (SI), by central differences.

    A plan within a limit is within an eased one, so that no price is positive: where a slope is, the point is not
    quite an optimum, or the limit does not bind.
    """
    prices, eye = [], np.eye(len(limits))
    start = log(0.0 * eye[0])
    for by, (name, per, unit, size) in zip(eye, limits, strict=True):
        if not 0.0 < size < math.inf:
            continue
        step = _STEP * size
        slope = (log(step * by) - log(-step * by)) / (2.0 * step)
        price = float(min(value * slope, 0.0) * unit)
        steps = _LINEAR_STEPS if price else ()
        bent = (abs((log(s * unit * by) - start) / (slope * s * unit) - 1.0) for s in steps)
        prices.append(Price(name, per, price, next((s for s, b in zip(steps, bent, strict=True) if b < _LINEAR), None)))
    return tuple(prices)


class Optimised(NamedTuple):
    """An optimised spec (rounded), and the record of its search. Values in `unit`.

    `before`: of the plan in the spec, None where it observes too little; `now`: of the rounded plan, exactly. `rows`:
    every requirement. `kept`: nothing better was found than the spec's own plan, which it is. `active`: the limits that
    bind, in words. `evaluations`: of the objective and its gradient.
    """

    spec: Spec
    name: str
    unit: str
    before: float | None
    now: float
    converged: bool
    sentence: str
    rows: tuple[RequirementChange, ...]
    structure: str
    kept: bool = False
    active: tuple[str, ...] = ()
    prices: tuple[Price, ...] = ()
    evaluations: int | None = None

    __repr__ = summary

    @property
    def gain(self) -> float:
        """Geometric mean of before over now, of all requirements; 1 where none is observable."""
        ratios = [math.log(row.before / row.now) for row in self.rows if row.before and row.now]
        return math.exp(fmean(ratios)) if ratios else 1.0


def record_of(best: Optimised) -> dict[str, Any]:
    """An optimisation as a table of a recipe and of --json."""
    record: dict[str, Any] = {
        "before": best.before,
        "objective": best.name,
        "unit": best.unit,
        "now": finite(best.now),
        "converged": best.converged,
        "kept": best.kept,
        "gain": best.gain,
        "sentence": best.sentence,
        "structure": best.structure,
        "evaluations": best.evaluations,
        "active_limits": list(best.active),
        "shadow_prices": [
            {"limit": p.limit, "per": p.per, "change": p.change}
            | ({} if p.linear is None else {"linear_up_to": p.linear})
            for p in best.prices
        ],
        "requirements": [{k: v for k, v in row._asdict().items() if v is not None} for row in best.rows],
    }
    return {name: value for name, value in record.items() if value is not None}


class PlanSearch(Protocol):
    """A search over points of its own kind."""

    objective: ExactObjective

    def run(self) -> Iterator[tuple[float, Any]]:
        """The completed share and the best point so far, now and then; the last one is the optimum."""
        ...

    def plan_of(self, point: Any) -> tuple[Spec, str]:
        """The plan of a point, and its structure in words. Errors: `SpecError` where no controller can execute it."""
        ...

    def record(self, best: Optimised, point: Any, last: "PlanOutcome") -> dict[str, Any]:
        """What the search knows of its result (fields of it), which is the plan of `point` (None: no optimum), after
        the `last` plan that was tried."""
        ...


class PlanOutcome(NamedTuple):
    """What became of a point: the value of its rounded plan in the objective's unit, or why it has no plan."""

    value: float = math.inf
    trouble: str = ""


class _Best(NamedTuple):
    """The best plan so far, and what it leaves; `value`: what is minimised. `point` None: the spec's own plan."""

    plan: Spec
    left: Residuals
    value: float
    point: Any = None
    words: str = "the plan is unchanged"


def search_plans(search: PlanSearch, *, until_met: bool) -> Iterator[SearchStep | Optimised]:
    """As `optimise`, by one search: a step whenever it proposes a point. The result is never worse than the spec's own
    plan."""
    objective = search.objective
    spec, (name, unit, _), last = objective.spec, objective.name_and_unit(), PlanOutcome()
    before = objective.residuals(spec)
    start = finite(objective.shown(before))
    best = _Best(spec, before, objective.value_of(before))

    def is_met(plan: Spec, left: Residuals) -> bool:
        """By the terms that the spec names, as the search minimises them, and by all that a verdict counts."""
        return until_met and objective.met(left) and not missed_targets(plan, MARGIN)

    met = is_met(spec, before)
    searched = not met

    def improve(point: Any) -> None:
        nonlocal best, last, met
        try:
            found, words = search.plan_of(point)
            plan = rounded(found).spec
        except SpecError as error:
            last = PlanOutcome(trouble=str(error))
            return
        left = objective.residuals(plan)
        last, value = PlanOutcome(objective.shown(left)), objective.value_of(left)
        if value < best.value:
            best, met = _Best(plan, left, value, point, words), is_met(plan, left)

    seen: Any = None
    for share, point in search.run() if searched else ():
        if point is not seen:
            seen = point
            improve(point)
        missed = objective.missed(best.left).items()
        words = ", ".join(f"{n} is {math.exp(by):.3g} times its limit" for n, by in missed)
        yield SearchStep(name, unit, start, objective.shown(best.left), share, best.words, words)
        if met:
            break
    plan, left, kept = best.plan, best.left, best.point is None
    if kept:
        with suppress(SpecError):
            plan = rounded(spec).spec
        left = objective.residuals(plan)
    now = objective.shown(left)
    missed, changes = objective.missed(left), requirement_changes(spec, plan)
    counted_missed = [] if not until_met or met else missed_targets(plan, 0.0)
    result = Optimised(plan, name, unit, start, now, True, "", changes, best.words, kept)
    result = result._replace(**search.record(result, None if met else best.point, last))
    sentence = result.sentence
    if not searched:
        sentence = f"the plan in the file: {MET}, without a search"
    elif met:
        sentence = f"stopped early: {MET}" + (f"; {sentence}" if sentence else "")
    elif kept:
        sentence = f"no better plan was found, so the plan in the file remains ({now:.4g} {unit}); {sentence}"
    for of, how in ((missed, ""), (counted_missed, " with the typical figures of the terms that the spec omits")):
        if of:
            sentence += f"; no plan was found that meets the target of {', '.join(of)}{how}"
            break
    yield result._replace(sentence=sentence, converged=met or (result.converged and not missed and not counted_missed))
