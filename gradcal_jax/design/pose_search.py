"""The search for the cycle of turns and rests that minimises a [design]'s objective.

Every cycle descends along the gradient of `design.pose_cycle`: first the file's own, of an axis that has the table in
visits, or stands, also random ones; then cycles near the best one, of a changed structure or by random steps.
"""

import math
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gradcal_jax.design.cycle_moves import Neighbourhood
from gradcal_jax.design.cycle_plan import CyclePlan, RepeatedCycle
from gradcal_jax.design.descent import LOOK, Reached

EVALUATIONS, QUICK_EVALUATIONS = 14000, 800
# The same for each number of visits of an axis, of which a search tries random courses.
EVALUATIONS_OF_VISITS, QUICK_EVALUATIONS_OF_VISITS = 4500, 1600
# Cycles that descend side by side.
TOGETHER = 2
# Sharpness of the maxima and evaluations of the first descents, of those from a changed cycle, and of the last one.
_FIRST, _HOP, _LAST = ((8.0, 60), (30.0, 120)), (30.0, 80), (100.0, 300)
# The same of visits. There are many local optima, and a begin hardly predicts the end of its descent: of every stage
# the better half continues, and at least so many.
_FIRST_OF_VISITS, _HOP_OF_VISITS, _LAST_OF_VISITS = ((8.0, 80), (40.0, 140), (200.0, 140)), (1000.0, 140), (1000.0, 600)
_FEWEST = 4
# Evaluations for each random begin.
_OF_BEGIN = 140
# Sizes of random steps from the best course of visits, in turn; the search ends where a round of all gains less than
# this (natural logarithm), and a descent where twenty evaluations do.
_STEPS, _HOP_GAIN, _DESCENT_GAIN = (0.3, 1.0, 0.3, 1.0), 1e-3, 2e-4
# A changed cycle that after n looks is worse than the present one by an n-th of this is left; so much worse (natural
# logarithm) a cycle may be and be gone on from, at the begin of the search.
_HOPELESS, _WARM = 0.04, 0.006
# Probability of another number of cycles, and by how much (natural logarithm) it may differ.
_RECOUNTED, _RECOUNT = 0.12, 0.3
# Probability of another course of the chamber, and the size of its random steps.
_COURSE, _COURSE_STEP = 0.2, 0.5


class Found(NamedTuple):
    """A cycle of a plan, with the objective's logarithm at the sharpness of its descent."""

    plan: CyclePlan
    cycle: RepeatedCycle
    value: float = math.inf


class PoseSearch:
    """The search over structures of cycles of turns, each of which descends along the gradient, for the best one of
    several plans.

    `evaluations`: of the objective and its gradient.
    """

    def __init__(self, plans: Sequence[CyclePlan], evaluations: int, stop: Callable[[], bool] = lambda: False) -> None:
        self.objective = plans[0].exact
        self._plans, self._budget, self.stopped = plans, evaluations, stop
        self._rng = np.random.default_rng(plans[0].design.seed)
        self.used, self.best = 0, Found(plans[0], plans[0].start)

    def run(self) -> Iterator[tuple[float, Found]]:
        """A cycle after every round of descents; before them, other courses of the chamber, which are plans too."""
        for number, plan in enumerate(self._plans):
            begins = [Found(plan, cycle) for cycle in plan.starts()]
            for start in begins[1:]:
                yield 0.0, start
            if plan.draws:
                count = min(2 * plan.design.starts, self._budget // len(self._plans) // _OF_BEGIN)
                begins += [Found(plan, plan.drawn(self._rng)) for _ in range(max(count, 1))]
            stages, ends = _FIRST_OF_VISITS if plan.draws else _FIRST, begins
            for sharpness, evaluations in stages:
                ends = sorted(self._descents(begins, sharpness, evaluations), key=lambda end: end.value)
                begins = ends[: max(_FEWEST, len(ends) // 2)] if plan.draws else ends[:1]
                yield self._share(), ends[0]
                if self.stopped():
                    break
            if number == 0 or ends[0].value < self.best.value:
                self.best = ends[0]
        yield from self._hops() if self.best.plan.draws else self._annealed()
        plan = self.best.plan
        sharpness, most = _LAST_OF_VISITS if plan.draws else _LAST
        last = max(1, min(most, self._budget // 4))
        if plan.by_time and not self.stopped():
            # A turn that has shrunk to nothing is left out.
            fewer = self.best._replace(cycle=plan.without_brief(self.best.cycle))
            ends = self._descents([self.best, fewer], sharpness, last)
            self.best = min(ends, key=lambda end: end.value)
        else:
            (self.best,) = self._descents([self.best], sharpness, last)
        if plan.design.angle_step is not None:
            snapped = self.best._replace(cycle=plan.snapped(self.best.cycle))
            (self.best,) = self._descents([snapped], sharpness, last, turnable=False)
        yield 1.0, self.best

    def _hops(self) -> Iterator[tuple[float, Found]]:
        """Descents from random steps from the best course, until a round of all sizes gains nothing."""
        (self.best,) = self._descents([self.best], *_HOP_OF_VISITS)
        without_gain, rounds = 0, 0
        while self.used < self._budget and without_gain < len(_STEPS) and not self.stopped():
            before, plan, cycle = self.best.value, self.best.plan, self.best.cycle
            of = plan.structure(cycle)
            z, size = plan.point(cycle, of), _STEPS[rounds % len(_STEPS)]
            near = (z + size * self._rng.standard_normal(z.shape) for _ in range(_FEWEST))
            begins = [Found(plan, plan.cycle_at(one, of, cycle.cycles)) for one in near]
            ends = self._descents(begins, *_HOP_OF_VISITS, least=before)
            self.best = min((self.best, *ends), key=lambda end: end.value)
            # Of those that are nearly alike, rounding decides.
            for end in ends:
                if end.value < before + _HOP_GAIN:
                    yield self._share(), end
            without_gain, rounds = 0 if self.best.value < before - _HOP_GAIN else without_gain + 1, rounds + 1
            yield self._share(), self.best

    def _annealed(self) -> Iterator[tuple[float, Found]]:
        """Descents from changed structures, of which one that is a little worse is gone on from, too."""
        here, last = self.best, min(_LAST[1], self._budget // 4)
        around = Neighbourhood(here.plan.limits, here.plan.slots)
        while self.used < self._budget - last and not self.stopped():
            warm = _WARM * (1.0 - self.used / self._budget)
            changed = [Found(here.plan, self._neighbour(here, around)) for _ in range(TOGETHER)]
            for end in self._descents(changed, *_HOP, least=here.value):
                more = end.value - here.value
                if more < 0.0 or self._rng.random() < math.exp(-more / max(warm, 1e-9)):
                    here = end
                if end.value < self.best.value:
                    self.best = end
            if here.value > self.best.value + 3.0 * warm:
                here = self.best
            yield self._share(), self.best

    def _neighbour(self, here: Found, around: Neighbourhood) -> RepeatedCycle:
        """A cycle of another structure, or more or fewer of the same one."""
        of, rng = here.cycle, self._rng
        if of.course and (not here.plan.turns_free or rng.random() < _COURSE):
            return of._replace(course=tuple(np.array(of.course) + _COURSE_STEP * rng.standard_normal(len(of.course))))
        if of.cycles > 1 and rng.random() < _RECOUNTED:
            count = round(of.cycles * math.exp(rng.uniform(-_RECOUNT, _RECOUNT)))
            return of._replace(cycles=max(2, count if count != of.cycles else count + int(rng.choice((-1, 1)))))
        return of._replace(turns=around.neighbour(of.turns, rng))

    def _share(self) -> float:
        return min(1.0, self.used / self._budget)

    def _descents(
        self,
        begins: Sequence[Found],
        sharpness: float,
        evaluations: int,
        *,
        least: float = math.inf,
        turnable: bool = True,
    ) -> list[Found]:
        """Where a descent from each cycle ends; side by side. A descent that is far above `least` after some looks ends
        there, and one of visits where it gains little."""

        def descend(begin: Found) -> tuple[Found, int]:
            plan, cycle = begin.plan, begin.cycle
            of = plan.structure(cycle, turnable=turnable)
            ramps, targets = plan.course(cycle.cycles).ramps, plan.objective.targets
            args = (jax.tree.map(jnp.asarray, of), ramps, sharpness, targets)
            gain = _DESCENT_GAIN if plan.draws and evaluations < _LAST_OF_VISITS[1] else -math.inf
            before = math.inf

            def ends(now: Reached) -> bool:
                nonlocal before
                gained, before = before - now.value, now.value
                return self.stopped() or gained < gain or now.value > least + _HOPELESS * LOOK / now.evaluations

            most = min(evaluations, self._budget)
            reached = plan.descent(plan.point(cycle, of), args, evaluations=most, ends=ends)
            end = plan.cycle_at(reached.point, of, cycle.cycles)
            return Found(plan, end, reached.value), reached.evaluations

        with ThreadPoolExecutor(min(len(begins), max(TOGETHER, os.cpu_count() or 1))) as pool:
            results = list(pool.map(descend, begins))
        self.used += sum(count for _, count in results)
        return [end for end, _ in results]
