"""`optimise`: the best plan for a spec.

Whatever a search proposes becomes a plan as a recipe rounds it, which counts as `predict` evaluates it.
"""

import logging
import math
from collections.abc import Callable, Iterator
from contextlib import suppress
from statistics import fmean
from typing import Any, Final, NamedTuple

from gradcal_jax.design.cycle_plan import CyclePlan
from gradcal_jax.design.plan_objective import MARGIN, MET, RequirementChange
from gradcal_jax.design.pose_search import Found, PoseSearch
from gradcal_jax.design.visits import motion_time, visit_choices, with_motion
from gradcal_jax.information.prediction import missed_targets
from gradcal_jax.information.verdicts import finite
from gradcal_jax.recipe.rounding import rounded
from gradcal_jax.spec.design import Design
from gradcal_jax.spec.spec import expect_spec
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.tables.display import summary
from gradcal_jax.tables.problems import SpecError

_LOG = logging.getLogger(__name__)
_UNCHANGED: Final = "the plan is unchanged"

BY_HAND = (
    'rig.table.drive is "hand": the search plans turns of a motor. Optimise the plan with drive = "motor" and '
    'moves without shape = "hand", then write its turns as turns by hand, with the durations that a person needs'
)
"""Why no plan of turns by hand is searched."""


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


def optimise(
    spec: Spec,
    *,
    steps: int | None = None,
    until_met: bool = False,
    watch: Callable[[SearchStep], None] = lambda _: None,
) -> Optimised:
    """The best plan that gradient descent finds for a spec, rounded to the controllers' steps.

    The search changes a cycle of turns and rests, or of a table at rest the chamber's course, as [design] frees them.
    `steps`: gradients in all (14000; 4500 where one gyro turns about the only axis of a table); a tenth of them is
    within some per cent of the best. `until_met`: no further than to a plan that meets every target with a margin of
    10 %. `watch` is called with progress (`SearchStep`: `best` in `unit`, `share` of the
    work). Returns `Optimised`: the rounded `spec`, `now` its residual and `before` the first plan's,
    in `unit` (ppm or deg/h), all requirements in `rows`, `converged` and a `sentence`
    with the reason. It is the best of several local optima: `limit` bounds what another plan could still gain.

    Errors: `ValueError` where limits exclude each other, where nothing can be observed, and for `until_met` without a
    target.
    """
    for event in run_search(spec, steps=steps, until_met=until_met):
        if isinstance(event, Optimised):
            _LOG.info("optimise: %.4g %s; %s", event.now, event.unit, event.sentence)
            return event
        _LOG.info("optimise: %s %.4g %s, %.0f %% done", event.name, event.best, event.unit, 100.0 * event.share)
        watch(event)
    raise AssertionError("a search ends with its result")


def run_search(
    spec: Spec,
    *,
    steps: int | None = None,
    until_met: bool = False,
    stop: Callable[[], bool] = lambda: False,
) -> Iterator[SearchStep | Optimised]:
    """The search of `optimise`: a `SearchStep` every few iterations and the `Optimised` plan at the end.

    `stop`: called after every step; once true, the best plan so far is finished. Errors: `ValueError` when limits
    exclude each other, nothing can be observed, the table is turned by hand or, with `until_met`, there is no target.
    """
    spec = expect_spec(spec)
    stands, design = not spec.gradient_schedule.steps, spec.design or Design()
    if spec.rig.table.drive == "hand" and not stands:
        raise ValueError(BY_HAND)
    limited = design.max_motion or design.max_total
    timed = with_motion(spec, motion_time(spec, design)) if limited else spec
    visited = spec.turns_one_gyro and not stands
    plans = [CyclePlan(timed, times) for times in visit_choices(timed, design)] if visited else [CyclePlan(timed)]
    yield from _improved(PoseSearch(plans, steps, stop), until_met=until_met)


def _improved(search: PoseSearch, *, until_met: bool) -> Iterator[SearchStep | Optimised]:
    """A step whenever a search proposes a plan. The result is never worse than the spec's own plan."""
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


def belief_of(spec: Spec) -> str:
    """A sentence on the maps that a design takes as exact; empty where each has a discrepancy or smoothness."""
    gyro = spec.sensor.gyro
    sections = {} if gyro is None else {"bias": gyro.bias, "scale factor": gyro.scale_factor}
    sure = [name for name, s in sections.items() if s is not None and s.discrepancy is None and s.smoothness is None]
    if not sure:
        return ""
    return (
        f"assumed: the {' and the '.join(sure)} {'have' if len(sure) > 1 else 'has'} exactly the structure in the "
        "spec; if the spec states a discrepancy, the plan is robust against deviations from this structure"
    )
