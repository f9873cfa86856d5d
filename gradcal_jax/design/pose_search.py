"""The search for the plan that minimises a [design]'s objective.

Every proposal descends along the gradient of `design.plan_value`: first the file's own, of an axis that has the table
in visits, or stands, also random ones; then plans near the best one, of a changed structure or by random steps.
"""

import math
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import count as numbers
from typing import Final, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gradcal_jax.design.cycle_moves import Neighbourhood
from gradcal_jax.design.cycle_plan import CyclePlan, Proposal
from gradcal_jax.design.descent import LOOK, Reached


class _Way(NamedTuple):
    """How a kind of plan is searched.

    `first`, `hop`, `last`: sharpness of the maxima and evaluations of the first descents, of those from a changed plan,
    and of the last one; of each stage of the first ones the better half continues, and at least `fewest`. `together`:
    plans that descend side by side. `steps`: sizes of random steps from the best plan, in turn; the search ends where a
    round of all gains less than `gain` (natural logarithm), and a descent where twenty evaluations gain less than
    `least_gain`. Without steps the structure is changed, and so much worse, `warm`, a plan may be and be gone on from,
    at the begin of the search. `evaluations`: in all.
    """

    first: tuple[tuple[float, int], ...]
    hop: tuple[float, int]
    last: tuple[float, int]
    fewest: int
    together: int
    steps: tuple[float, ...]
    gain: float
    least_gain: float
    warm: float
    evaluations: int


_OF_CYCLES: Final = _Way(((8.0, 60), (30.0, 120)), (30.0, 80), (100.0, 300), 1, 2, (), 0.0, -math.inf, 0.006, 14000)
# There are many local optima, and a begin hardly predicts the end of its descent.
_OF_VISITS: Final = _Way(
    ((8.0, 80), (40.0, 140), (200.0, 140)), (1000.0, 140), (1000.0, 600), 4, 4, (0.3, 1.0, 0.3, 1.0), 1e-3, 2e-4, 0.0,
    4500,
)  # fmt: skip
# Evaluations for each random begin.
_OF_BEGIN: Final = 140
# A changed plan that after n looks is worse than the present one by an n-th of this is left.
_HOPELESS: Final = 0.04
# Probability of another course of the chamber, and the size of its random steps.
_COURSE, _COURSE_STEP = 0.2, 0.5


class Found(NamedTuple):
    """A proposal of a plan, with the objective's logarithm at the sharpness of its descent."""

    plan: CyclePlan
    of: Proposal
    value: float = math.inf


class PoseSearch:
    """The search over structures of plans, each of which descends along the gradient, for the best one of several
    kinds.

    `evaluations`: of the objective and its gradient (None: as many as usual). `used`: so many were made.
    """

    def __init__(
        self,
        plans: Sequence[CyclePlan],
        evaluations: int | None,
        stop: Callable[[], bool] = lambda: False,
    ) -> None:
        self.objective = plans[0].exact
        self._way = _OF_VISITS if plans[0].draws else _OF_CYCLES
        self._plans, self._budget, self.stopped = plans, evaluations or len(plans) * self._way.evaluations, stop
        self._rng = np.random.default_rng(plans[0].design.seed)
        self.used, self.best = 0, Found(plans[0], plans[0].start)

    def run(self) -> Iterator[tuple[float, Found]]:
        """The share of the work that is done, and a proposal, after every round of descents; before them, other
        courses of the chamber, which are plans too."""
        for number, plan in enumerate(self._plans):
            begins = [Found(plan, of) for of in plan.starts()]
            for start in begins[1:]:
                yield 0.0, start
            if plan.draws:
                count = min(2 * plan.design.starts, self._budget // len(self._plans) // _OF_BEGIN)
                begins += [Found(plan, plan.drawn(self._rng)) for _ in range(max(count, 1))]
            ends = begins
            for sharpness, evaluations in self._way.first:
                ends = sorted(self._descents(begins, sharpness, evaluations), key=lambda end: end.value)
                begins = ends[: max(self._way.fewest, len(ends) // 2)] if plan.draws else ends[:1]
                yield self._share(), ends[0]
                if self.stopped():
                    break
            if number == 0 or ends[0].value < self.best.value:
                self.best = ends[0]
        yield from self._near()
        sharpness, most = self._way.last
        begins, plan = [self.best], self.best.plan
        if plan.coordinates.timed and not self.stopped():
            # A turn that has shrunk to nothing is left out.
            begins.append(self.best._replace(of=plan.without_brief(self.best.of)))
        ends = self._descents(begins, sharpness, max(1, min(most, self._budget // 4)))
        self.best = min(ends, key=lambda end: end.value)
        yield 1.0, self.best

    def _near(self) -> Iterator[tuple[float, Found]]:
        """Descents from plans near the present one, of which one that is a little worse is gone on from, too."""
        way = self._way
        if way.steps:
            (self.best,) = self._descents([self.best], *way.hop)
        last = 0 if way.steps else min(way.last[1], self._budget // 4)
        here, without_gain = self.best, 0
        for number in numbers():
            if self.used >= self._budget - last or self.stopped() or (way.steps and without_gain >= len(way.steps)):
                return
            before, warm = self.best.value, way.warm * (1.0 - self.used / self._budget)
            begins = [here._replace(of=self._changed(here, number)) for _ in range(way.together)]
            ends = self._descents(begins, *way.hop, least=here.value)
            for end in ends:
                more = end.value - here.value
                if more < 0.0 or (warm and self._rng.random() < math.exp(-more / max(warm, 1e-9))):
                    here = end
                if end.value < self.best.value:
                    self.best = end
            if here.value > self.best.value + 3.0 * warm:
                here = self.best
            # Of those that are nearly alike, rounding decides.
            for end in ends if way.steps else ():
                if end.value < before + way.gain:
                    yield self._share(), end
            without_gain = 0 if self.best.value < before - way.gain else without_gain + 1
            yield self._share(), self.best

    def _changed(self, here: Found, number: int) -> Proposal:
        """A proposal at a random step, or of another structure or course."""
        plan, of, rng = here.plan, here.of, self._rng
        if steps := self._way.steps:
            z = plan.point(of)
            near = z + steps[number % len(steps)] * rng.standard_normal(z.shape)
            return plan.at(near, plan.coordinates.structure(of.turns))
        if of.course and (not plan.turns_free or rng.random() < _COURSE):
            return of._replace(course=tuple(np.array(of.course) + _COURSE_STEP * rng.standard_normal(len(of.course))))
        return of._replace(turns=Neighbourhood(plan.limits, plan.coordinates.slots).neighbour(of.turns, rng))

    def _share(self) -> float:
        return min(1.0, self.used / self._budget)

    def _descents(
        self, begins: Sequence[Found], sharpness: float, evaluations: int, *, least: float = math.inf
    ) -> list[Found]:
        """Where a descent from each plan ends; side by side. A descent that is far above `least` after some looks ends
        there, and one of visits where it gains little."""
        way, most = self._way, min(evaluations, self._budget)

        def descend(begin: Found) -> tuple[Found, int]:
            plan, of = begin.plan, begin.plan.coordinates.structure(begin.of.turns)
            gain = way.least_gain if evaluations < way.last[1] else -math.inf
            before = math.inf

            def ends(now: Reached) -> bool:
                nonlocal before
                gained, before = before - now.value, now.value
                return self.stopped() or gained < gain or now.value > least + _HOPELESS * LOOK / now.evaluations

            args = (jax.tree.map(jnp.asarray, of), sharpness)
            reached = plan.descent(plan.point(begin.of), args, evaluations=most, ends=ends)
            return Found(plan, plan.at(reached.point, of), reached.value), reached.evaluations

        with ThreadPoolExecutor(min(len(begins), max(2, os.cpu_count() or 1))) as pool:
            results = list(pool.map(descend, begins))
        self.used += sum(count for _, count in results)
        return [end for end, _ in results]
