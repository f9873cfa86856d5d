"""What a search for the best plan yields, and its record: whatever a search proposes becomes a plan as a recipe rounds
it, which counts as `predict` evaluates it."""

import math
from collections.abc import Iterator
from contextlib import suppress
from statistics import fmean
from typing import Any, Final, NamedTuple

from gradcal_jax.design.plan_objective import MARGIN, MET, RequirementChange
from gradcal_jax.design.pose_search import Found, PoseSearch
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
    every requirement. `kept`: nothing better was found than the spec's own plan, which it is. `evaluations`: of the
    objective and its gradient.
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
        "requirements": [{k: v for k, v in row._asdict().items() if v is not None} for row in best.rows],
    }
    return {name: value for name, value in record.items() if value is not None}


_UNCHANGED: Final = "the plan is unchanged"


def search_plans(search: PoseSearch, *, until_met: bool) -> Iterator[SearchStep | Optimised]:
    """As `optimise`, by one search: a step whenever it proposes a plan. The result is never worse than the spec's own
    plan."""
    objective = search.objective
    spec, (name, unit, _) = objective.spec, objective.name_and_unit()
    before = left = objective.left(spec)
    plan, start, structure, trouble = spec, finite(objective.shown(left)), _UNCHANGED, ""
    seen: Found | None = None

    def is_met() -> bool:
        """By the terms that the spec names, as the search minimises them, and by all that a verdict counts."""
        return until_met and objective.met(left) and not missed_targets(plan, MARGIN)

    met = at_once = is_met()
    for share, found in () if at_once else search.run():
        if found is not seen:
            seen, trouble = found, ""
            try:
                other = rounded(found.plan.spec_of(found.of)).spec
            except SpecError as error:
                trouble = f"; the last plan cannot be rounded to the controllers' steps: {error}"
            else:
                of_other = objective.left(other)
                if objective.value_of(of_other) < objective.value_of(left):
                    plan, left, structure = other, of_other, found.plan.in_words(found.of)
                    met = is_met()
        missed = [f"{n} is {math.exp(by):.3g} times its limit" for n, by in objective.missed(left).items()]
        yield SearchStep(name, unit, start, objective.shown(left), share, structure, ", ".join(missed))
        if met:
            break
    kept = structure == _UNCHANGED
    if kept:
        with suppress(SpecError):
            plan = rounded(spec).spec
        left = objective.left(plan)
    now, changes = objective.shown(left), objective.changes(before, left)
    result = Optimised(plan, name, unit, start, now, True, "", changes, structure, kept, search.used)
    sentence = f"after {search.used} gradients{trouble}"
    if at_once:
        sentence = f"the plan in the file: {MET}, without a search"
    elif kept:
        sentence = f"no better plan was found, so the plan in the file remains ({now:.4g} {unit}); {sentence}"
    else:
        sentence = f"the geometric mean of all residuals is smaller by a factor of {result.gain:.2f}, {sentence}"
        sentence = f"stopped early: {MET}; {sentence}" if met else sentence
    missed_now = list(objective.missed(left))
    counted = [] if not until_met or met else list(missed_targets(plan, 0.0))
    if missed_now or counted:
        how = "" if missed_now else " with the typical figures of the terms that the spec omits"
        sentence += f"; no plan was found that meets the target of {', '.join(missed_now or counted)}{how}"
    yield result._replace(sentence=sentence, converged=not missed_now and not counted)
