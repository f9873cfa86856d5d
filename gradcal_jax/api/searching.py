"""The search for the plan that minimises a [design]'s objective: what every kind of it has in common.

A search proposes points; each becomes a plan as a recipe rounds it, which counts as `predict` evaluates it.
"""

import math
from collections.abc import Iterator, Mapping
from contextlib import suppress
from typing import Any, NamedTuple, Protocol

import numpy as np

from gradcal_jax.api.contract_rows import finite
from gradcal_jax.api.exact_objective import ExactObjective, Residuals, requirement_changes
from gradcal_jax.api.search_results import MET, Optimised, SearchStep
from gradcal_jax.files.problems import SpecError
from gradcal_jax.files.rounding import rounded
from gradcal_jax.files.spec_sections import Spec


class PlanSearch(Protocol):
    """A search over points of its own kind. `own_counts`: whether the spec's own plan is a candidate."""

    objective: ExactObjective
    own_counts: bool

    def run(self) -> Iterator[tuple[float, Any]]:
        """The completed share and the best point so far, now and then; the last one is the optimum."""
        ...

    def plan_of(self, point: Any) -> tuple[Spec, str]:
        """The plan of a point, and its structure in words. Errors: `SpecError` where no controller can execute it."""
        ...

    def state(self, reached: Any) -> dict[str, np.ndarray]:
        """Arrays from which `resume` continues, with the point of the best plan so far (None: the spec's own)."""
        ...

    def resume(self, arrays: Mapping[str, np.ndarray]) -> Any:
        """Continue from such arrays; returns that point."""
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
    words: str = "as it was"


def search_plans(
    search: PlanSearch, *, until_met: bool, checkpoint: Mapping[str, np.ndarray] | None
) -> Iterator[SearchStep | Optimised]:
    """As `optimise`, by one search: a step whenever it proposes a point. The result is never worse than the spec's own
    plan, where that counts."""
    objective, own = search.objective, search.own_counts
    spec, (name, unit, _), last = objective.spec, objective.name_and_unit(), PlanOutcome()
    before = objective.residuals(spec)
    start = finite(objective.shown(before))
    best = _Best(spec, before, objective.value_of(before) if own else math.inf)
    searched = not (until_met and objective.met(before))
    met = not searched

    def improve(point: Any) -> None:
        nonlocal best, last
        try:
            found, words = search.plan_of(point)
            plan = rounded(found).spec
        except SpecError as error:
            last = PlanOutcome(trouble=str(error))
            return
        left = objective.residuals(plan)
        last, value = PlanOutcome(objective.shown(left)), objective.value_of(left)
        if value < best.value:
            best = _Best(plan, left, value, point, words)

    if searched and checkpoint is not None and (reached := search.resume(checkpoint)) is not None:
        improve(reached)
    seen: Any = None
    for share, point in search.run() if searched else ():
        if point is not seen:
            seen = point
            improve(point)
        if own or best.point is not None:
            missed = objective.missed(best.left).items()
            words = ", ".join(f"{n} is {math.exp(by):.3g} times its limit" for n, by in missed)
            now = objective.shown(best.left)
            yield SearchStep(name, unit, start, now, share, best.words, words, search.state(best.point))
            if met := until_met and objective.met(best.left):
                break
    plan, left, kept = best.plan, best.left, best.point is None
    if kept:
        with suppress(SpecError):
            plan = rounded(spec).spec
        left = objective.residuals(plan)
    now = objective.shown(left) if own or not kept else math.inf
    missed, changes = objective.missed(left), requirement_changes(spec, plan)
    result = Optimised(plan, name, unit, start, now, now, True, "", changes, best.words, kept)
    result = result._replace(**search.record(result, None if met else best.point, last))
    sentence = result.sentence
    if not searched:
        sentence = f"the plan in the file: {MET}, without a search"
    elif met:
        sentence = f"stopped early: {MET}" + (f"; {sentence}" if sentence else "")
    elif kept:
        sentence = f"no plan is better than the plan in the file ({now:.4g} {unit}), which remains; {sentence}"
    if missed:
        sentence += f"; no plan was found that meets the target of {', '.join(missed)}"
    yield result._replace(sentence=sentence, converged=met or (result.converged and not missed))
