"""The search for the cycle of poses, turns and rests that minimises the residuals of an IMU's requirements.

Every cycle descends along the exact gradient of `design.pose_cycle`: first the file's own, then cycles of a changed
structure near the best one. What counts in the end is the plan as a recipe rounds it, evaluated as `predict` does it.
"""

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

import jax
import jax.numpy as jnp
import numpy as np

from gradcal_jax.api.cycle_plan import CyclePlan, RepeatedCycle
from gradcal_jax.api.cycle_prices import active_limits, shadow_prices
from gradcal_jax.api.search_results import MET, NO_TARGET, Optimised, SearchStep
from gradcal_jax.api.turn_search import requirement_changes
from gradcal_jax.design.cycle_moves import Neighbourhood
from gradcal_jax.design.pose_cycle import PoseTurn
from gradcal_jax.files.problems import SpecError
from gradcal_jax.files.rounding import rounded
from gradcal_jax.files.spec_sections import Spec

EVALUATIONS, QUICK_EVALUATIONS = 14000, 800
# Cycles that descend side by side.
TOGETHER = 2
# Evaluations of a descent between two looks; sharpness of the maxima and evaluations of the first descents, of those
# from a changed cycle, and of the last one.
_LOOK, _FIRST, _HOP, _LAST = 20, ((8.0, 60), (30.0, 120)), (30.0, 80), (100.0, 300)
# A changed cycle that after n looks is worse than the present one by an n-th of this is left; so much worse (natural
# logarithm) a cycle may be and be gone on from, at the begin of the search.
_HOPELESS, _WARM = 0.04, 0.006
# Probability of another number of cycles, and by how much (natural logarithm) it may differ.
_RECOUNTED, _RECOUNT = 0.12, 0.3
# Probability of another course of the chamber, and the size of its random steps.
_COURSE, _COURSE_STEP = 0.2, 0.5


def search_poses(
    spec: Spec,
    *,
    evaluations: int = EVALUATIONS,
    until_met: bool = False,
    checkpoint: Mapping[str, np.ndarray] | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> Iterator[SearchStep | Optimised]:
    """As `optimise`, over cycles of turns and poses; a step after every descent.

    `evaluations`: of the objective and its gradient. The optimum is never worse than the spec's own plan.
    """
    if not spec.requirement:
        raise ValueError("the spec has no [[requirement]] to minimise: add one")
    if until_met and all(r.target is None for r in spec.requirement):
        raise ValueError(NO_TARGET)
    plan = CyclePlan(spec)
    name, unit, factor = plan.shown()
    before = after = plan.residuals(spec)
    least = plan.value_of(before)
    best, words, used, cycle = spec, "as it was", 0, None
    search = _Search(plan, evaluations, plan.design.seed, stop)
    if checkpoint is not None:
        cycle = search.resume(checkpoint)
    if cycle is not None:
        best = rounded(plan.spec_of(cycle)).spec
        after = plan.residuals(best)
        least, words = plan.value_of(after), plan.in_words(cycle)
    # Other courses of the chamber, as they are, are plans too.
    other_starts = [] if checkpoint is not None else plan.starts()[1:]

    def improve(by: RepeatedCycle) -> None:
        nonlocal best, after, least, cycle, words
        with suppress(SpecError):
            found = rounded(plan.spec_of(by)).spec
            reached = plan.residuals(found)
            if (value := plan.value_of(reached)) < least:
                best, after, least, cycle, words = found, reached, value, by, plan.in_words(by)

    met = until_met and plan.met(after)
    for start in () if met else other_starts:
        improve(start)
    met = until_met and plan.met(after)
    if not met:
        seen: RepeatedCycle | None = None
        for share in search.run():
            used = search.used
            if search.best is not seen:
                seen = search.best
                improve(seen)
            missed = plan.exceeded(after)
            was, now = (factor * math.exp(value) for value in (plan.without_limits(before), plan.without_limits(after)))
            yield SearchStep(name, unit, _finite(was), now, share, words, ", ".join(missed), search.state(cycle))
            met = until_met and plan.met(after)
            if met:
                break
    kept = best is spec
    if kept:
        with suppress(SpecError):
            best = rounded(spec).spec
        after = plan.residuals(best)
    changes, missed = requirement_changes(spec, best), plan.exceeded(after)
    start, now = (factor * math.exp(plan.without_limits(left)) for left in (before, after))
    result = Optimised(
        best, name, unit, _finite(start), now, now, not missed, "", changes, words, kept, evaluations=used
    )  # fmt: skip
    if cycle is not None and not met and not stop():
        result = result._replace(active=active_limits(plan, cycle), prices=shadow_prices(plan, cycle, now))
    how = f"after {used} gradients" if used else "without a search"
    sentence = f"better by a factor of {result.gain:.2f} in the geometric mean of all requirements, {how}"
    if kept:
        sentence = f"the plan in the file, {how}"
        sentence = sentence if met else f"nothing better than {sentence}"
    if len(spec.rig.table.place) > 1:
        sentence += f"; {plan.apart}" if plan.apart else ", of all IMUs estimated together"
    if missed:
        sentence += f"; no plan was found that meets the target of {', '.join(missed)}"
    yield result._replace(sentence=f"{MET}: {sentence}" if met else sentence)


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


class _Search:
    """A search over structures, each of which descends along the gradient."""

    def __init__(self, plan: "CyclePlan", evaluations: int, seed: int, stop: Callable[[], bool]) -> None:
        self._plan, self._budget, self._stop = plan, evaluations, stop
        self._rng = np.random.default_rng(seed)
        self._around = Neighbourhood(plan.limits, plan.slots)
        self.used, self.best, self._value = 0, plan.start, math.inf
        self._here, self._now, self._begun = plan.start, math.inf, 0
        self._state: dict[str, np.ndarray] = {}

    def run(self) -> Iterator[float]:
        """Yields the completed share after every round of descents."""
        plan, rng = self._plan, self._rng
        for sharpness, count in _FIRST[self._begun :]:
            begins = [self._here] if self._begun else plan.starts()
            self._now, self._here = min(self._descents(begins, sharpness, count), key=lambda found: found[0])
            self.best, self._value = self._here, self._now
            self._begun += 1
            yield self._share()
        last = min(_LAST[1], self._budget // 4)
        while self.used < self._budget - last and not self._stop():
            warm = _WARM * (1.0 - self.used / self._budget)
            changed = [self._neighbour(self._here, rng) for _ in range(TOGETHER)]
            for value, cycle in self._descents(changed, *_HOP, least=self._now):
                if value < self._now or rng.random() < math.exp(-(value - self._now) / max(warm, 1e-9)):
                    self._here, self._now = cycle, value
                if value < self._value:
                    self.best, self._value = cycle, value
            if self._now > self._value + 3.0 * warm:
                self._here, self._now = self.best, self._value
            yield self._share()
        ((_, self.best),) = self._descents([self.best], _LAST[0], last)
        if plan.design.angle_step is not None:
            snapped = self.best._replace(turns=plan.rounding.on_steps(self.best.turns))
            ((_, self.best),) = self._descents([snapped], _LAST[0], last, turnable=False)
        yield 1.0

    def state(self, reached: RepeatedCycle | None) -> dict[str, np.ndarray]:
        """Arrays from which `resume` continues, with the cycle of the best plan so far; of the last round that ended
        by itself."""
        if not self._stop() or not self._state:
            generator = json.dumps(self._rng.bit_generator.state)
            numbers = np.array([self.used, self._begun, self._now, self._value])
            self._state = {"numbers": numbers, "generator": np.array(generator)}
            for name, of in (("here", self._here), ("best", self.best), ("reached", reached)):
                turns = () if of is None else of.turns
                self._state[f"{name}_turns"] = np.array(turns, dtype=float).reshape(len(turns), 4)
                self._state[f"{name}_cycles"] = np.array(0 if of is None else of.cycles)
                self._state[f"{name}_course"] = np.array(() if of is None else of.course)
        return self._state

    def resume(self, arrays: Mapping[str, np.ndarray]) -> RepeatedCycle | None:
        """Continue from such arrays; returns the cycle of the best plan, None for the spec's own."""
        used, begun, self._now, self._value = (float(v) for v in arrays["numbers"])
        self.used, self._begun = int(used), int(begun)
        self._rng.bit_generator.state = json.loads(str(arrays["generator"]))

        def cycle(name: str) -> RepeatedCycle | None:
            turns = (PoseTurn(int(l), float(a), float(w), float(r)) for l, a, w, r in arrays[f"{name}_turns"])
            count = int(arrays[f"{name}_cycles"])
            return RepeatedCycle(tuple(turns), count, tuple(arrays[f"{name}_course"].tolist())) if count else None

        self._here, self.best = cycle("here") or self._here, cycle("best") or self.best
        return cycle("reached")

    def _neighbour(self, of: RepeatedCycle, rng: np.random.Generator) -> RepeatedCycle:
        """A cycle of another structure, or more or fewer of the same one."""
        if of.course and (not self._plan.turns_free or rng.random() < _COURSE):
            return of._replace(course=tuple(np.array(of.course) + _COURSE_STEP * rng.standard_normal(len(of.course))))
        if of.cycles > 1 and rng.random() < _RECOUNTED:
            count = round(of.cycles * math.exp(rng.uniform(-_RECOUNT, _RECOUNT)))
            return of._replace(cycles=max(2, count if count != of.cycles else count + int(rng.choice((-1, 1)))))
        return of._replace(turns=self._around.neighbour(of.turns, rng))

    def _share(self) -> float:
        return min(1.0, self.used / self._budget)

    def _descents(
        self,
        cycles: Sequence[RepeatedCycle],
        sharpness: float,
        evaluations: int,
        *,
        least: float = math.inf,
        turnable: bool = True,
    ) -> list[tuple[float, RepeatedCycle]]:
        """Value and cycle that a descent from each cycle reaches; one thread for each. A descent that is far above
        `least` after some looks ends there."""
        plan = self._plan

        def descend(cycle: RepeatedCycle) -> tuple[float, RepeatedCycle, int]:
            of = plan.structure(cycle, turnable=turnable)
            point, reached = plan.point(cycle, of), None
            args = (jax.tree.map(jnp.asarray, of), plan.course(cycle.cycles).ramps, sharpness)
            for reached in plan.descent(point, args, evaluations=evaluations, together=_LOOK):
                if self._stop() or reached.value > least + _HOPELESS * _LOOK / reached.evaluations:
                    break
            assert reached is not None
            return reached.value, plan.cycle_at(reached.point, of, cycle.cycles), reached.evaluations

        with ThreadPoolExecutor(len(cycles)) as pool:
            results = list(pool.map(descend, cycles))
        self.used += sum(count for *_, count in results)
        return [(value, cycle) for value, cycle, _ in results]
