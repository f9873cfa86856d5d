"""What a search for the best plan yields, and its record: whatever a search proposes becomes a plan as a recipe rounds
it, which counts as `predict` evaluates it."""

import math
from collections.abc import Iterator
from contextlib import suppress
from statistics import fmean
from typing import Any, NamedTuple

from gradcal_jax.design.plan_objective import MARGIN, MET, RequirementChange
from gradcal_jax.design.pose_search import Found, PoseSearch
from gradcal_jax.design.prices import Price, shadow_prices
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


class Optimised(NamedTuple):
    """An optimised spec (rounded), and the record of its search. Values in `unit`.

    `before`: of the plan in the spec, None where it observes too little; `now`: of the rounded plan, exactly. `rows`:
    every requirement. `kept`: nothing better was found than the spec's own plan, which it is. `prices`: of the limits.
    `evaluations`: of the objective and its gradient.
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
    kept: bool
    evaluations: int
    prices: tuple[Price, ...] = ()

    __repr__ = summary

    @property
    def active(self) -> tuple[str, ...]:
        """The limits that restrict the plan."""
        return tuple(price.limit for price in self.prices if price.restricts)

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
        "shadow_prices": [{"limit": p.limit, "per": p.per, "change": p.change} for p in best.prices],
        "requirements": [{k: v for k, v in row._asdict().items() if v is not None} for row in best.rows],
    }
    return {name: value for name, value in record.items() if value is not None}


def search_plans(search: PoseSearch, *, until_met: bool) -> Iterator[SearchStep | Optimised]:
    """As `optimise`, by one search: a step whenever it proposes a plan. The result is never worse than the spec's own
    plan."""
    objective = search.objective
    spec, (name, unit, _) = objective.spec, objective.name_and_unit()
    plan, left, trouble = spec, objective.residuals(spec), ""
    before, start = left, finite(objective.shown(left))
    # The proposal whose plan is the best one; None: the spec's own.
    chosen: Found | None = None
    seen: Found | None = None

    def is_met() -> bool:
        """By the terms that the spec names, as the search minimises them, and by all that a verdict counts."""
        return until_met and objective.met(left) and not missed_targets(plan, MARGIN)

    met = is_met()
    searched = not met
    for share, found in search.run() if searched else ():
        if found is not seen:
            seen, trouble = found, ""
            try:
                other = rounded(found.plan.spec_of(found.cycle)).spec
            except SpecError as error:
                trouble = f"; the last plan cannot be rounded to the controllers' steps: {error}"
            else:
                of_other = objective.residuals(other)
                if objective.value_of(of_other) < objective.value_of(left):
                    plan, left, chosen = other, of_other, found
                    met = is_met()
        missed = objective.missed(left).items()
        words = ", ".join(f"{n} is {math.exp(by):.3g} times its limit" for n, by in missed)
        structure = "the plan is unchanged" if chosen is None else chosen.plan.in_words(chosen.cycle)
        yield SearchStep(name, unit, start, objective.shown(left), share, structure, words)
        if met:
            break
    if chosen is None:
        with suppress(SpecError):
            plan = rounded(spec).spec
        left = objective.residuals(plan)
    now, structure = objective.shown(left), "the plan is unchanged"
    result = Optimised(
        plan, name, unit, start, now, True, "", objective.changes(before, left), structure, chosen is None, search.used
    )
    sentence = f"after {search.used} gradients{trouble}"
    if chosen is not None:
        result = result._replace(structure=chosen.plan.in_words(chosen.cycle))
        sentence = f"the geometric mean of all residuals is smaller by a factor of {result.gain:.2f}, {sentence}"
        if not met and not search.stopped():
            result = result._replace(prices=shadow_prices(chosen.plan, chosen.cycle, now))
    if not searched:
        sentence = f"the plan in the file: {MET}, without a search"
    elif met:
        sentence = f"stopped early: {MET}; {sentence}"
    elif chosen is None:
        sentence = f"no better plan was found, so the plan in the file remains ({now:.4g} {unit}); {sentence}"
    missed_now = list(objective.missed(left))
    counted = [] if not until_met or met else list(missed_targets(plan, 0.0))
    if missed_now or counted:
        how = "" if missed_now else " with the typical figures of the terms that the spec omits"
        sentence += f"; no plan was found that meets the target of {', '.join(missed_now or counted)}{how}"
    yield result._replace(sentence=sentence, converged=not missed_now and not counted)
