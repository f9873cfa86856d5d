"""The search for the cycle of poses, turns and rests that minimises the residuals of an IMU's requirements.

Every cycle descends along the exact gradient of `design.pose_cycle`: first the file's own, then cycles of a changed
structure near the best one. What counts in the end is the plan as a recipe rounds it, evaluated as `predict` does it.
"""

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gradcal_jax.api.cycle_plan import CyclePlan, RepeatedCycle
from gradcal_jax.api.cycle_prices import active_limits, shadow_prices
from gradcal_jax.api.search_results import Optimised
from gradcal_jax.api.searching import PlanOutcome
from gradcal_jax.design.cycle_moves import Neighbourhood
from gradcal_jax.design.pose_cycle import PoseTurn
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


class PoseSearch:
    """The search over structures of cycles of turns and poses, each of which descends along the gradient.

    `evaluations`: of the objective and its gradient.
    """

    def __init__(self, plan: CyclePlan, evaluations: int, stop: Callable[[], bool] = lambda: False) -> None:
        self.objective, self.own_counts = plan.exact, True
        self._plan, self._budget, self._stop = plan, evaluations, stop
        self._rng = np.random.default_rng(plan.design.seed)
        self._around = Neighbourhood(plan.limits, plan.slots)
        self.used, self.best, self._value = 0, plan.start, math.inf
        self._here, self._now, self._begun = plan.start, math.inf, 0
        self._state: dict[str, np.ndarray] = {}

    def plan_of(self, point: RepeatedCycle) -> tuple[Spec, str]:
        """The plan of a cycle, and its structure in words."""
        return self._plan.spec_of(point), self._plan.in_words(point)

    def record(self, best: Optimised, point: RepeatedCycle | None, last: PlanOutcome) -> dict[str, Any]:
        """What the search took, and the limits that bind the cycle of the best plan."""
        del last
        plan, of = self._plan, {"evaluations": self.used}
        if point is not None and not self._stop():
            of |= {"active": active_limits(plan, point), "prices": shadow_prices(plan, point, best.now)}
        better = (
            "" if best.kept else f"better by a factor of {best.gain:.2f} in the geometric mean of all requirements, "
        )
        sentence = f"{better}after {self.used} gradients"
        if len(plan.spec.rig.table.place) > 1:
            sentence += f"; {self.objective.apart}" if self.objective.apart else ", of all IMUs estimated together"
        return of | {"sentence": sentence}

    def run(self) -> Iterator[tuple[float, RepeatedCycle]]:
        """A cycle after every round of descents; before them, other courses of the chamber, which are plans too."""
        plan, rng = self._plan, self._rng
        for start in [] if self._begun else plan.starts()[1:]:
            yield 0.0, start
        for sharpness, count in _FIRST[self._begun :]:
            begins = [self._here] if self._begun else plan.starts()
            self._now, self._here = min(self._descents(begins, sharpness, count), key=lambda found: found[0])
            self.best, self._value = self._here, self._now
            self._begun += 1
            yield self._share(), self.best
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
            yield self._share(), self.best
        ((_, self.best),) = self._descents([self.best], _LAST[0], last)
        if plan.design.angle_step is not None:
            snapped = self.best._replace(turns=plan.rounding.on_steps(self.best.turns))
            ((_, self.best),) = self._descents([snapped], _LAST[0], last, turnable=False)
        yield 1.0, self.best

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
