"""The search for the cycle of turns and rests that minimises a [design]'s objective; and what the limits that bind it
are worth.

Every cycle descends along the gradient of `design.pose_cycle`: first the file's own, of an axis that has the table in
visits also random ones; then cycles near the best one, of a changed structure or by random steps. What counts in the
end is the plan as a recipe rounds it, evaluated as `predict` does it.
"""

import math
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gradcal_jax.design.compiling import compiler_options
from gradcal_jax.design.cycle_moves import Neighbourhood
from gradcal_jax.design.cycle_plan import CyclePlan, RepeatedCycle
from gradcal_jax.design.descent import LOOK, Reached
from gradcal_jax.design.pose_cycle import Ramp
from gradcal_jax.design.searching import Optimised, PlanOutcome, Price, PricedLimit, priced
from gradcal_jax.design.slots import CycleStructure
from gradcal_jax.spec.spec_sections import Spec

# A rate, pose, rest or slope within this share of its limit counts as limited.
_AT_LIMIT = 0.01
# Sharpness of the maxima of an optimum.
_SHARPNESS = 100.0
_DEGREE = np.pi / 180.0


def shadow_prices(plan: CyclePlan, cycle: RepeatedCycle, value: float) -> tuple[Price, ...]:
    """The derivatives in the limits of the objective `value` at an optimal cycle, where that through the free numbers
    vanishes (envelope theorem), with the cost of exceeded targets; by central differences of a compiled value."""
    of = plan.structure(cycle)
    args = plan.point(cycle, of), jax.tree.map(jnp.asarray, of), plan.course(cycle.cycles).ramps, plan.objective.targets
    quickly = compiler_options() | {"xla_backend_optimization_level": 0}
    log = jax.jit(partial(_eased, plan), compiler_options=quickly)
    return priced(value, [PricedLimit(*row) for row in _limits_of(plan)], lambda by: float(log(*args, by)))


def _limits_of(plan: CyclePlan) -> list[tuple[str, str, float, float]]:
    """Name, the unit in which it is eased, that unit in SI, and size (SI) of every limit, in the order of `_eased`."""
    limits, turns = plan.limits, float(plan.turns_free)
    axes = [axis.name for axis in plan.spec.rig.table.axis]
    spans = limits.reach[:, 1] - limits.reach[:, 0]
    rests = turns * limits.shortest * any(t.rest > 0.0 for t in plan.start.turns)
    slope = float(plan.spec.rig.chamber.max_heating) if plan.free_course is not None else 0.0
    return [
        ("time (every cycle longer in proportion)", "minute", 60.0, plan.motion),
        *((f"largest rate of {n}", "deg/s", _DEGREE, turns * w) for n, w in zip(axes, limits.rates, strict=True)),
        *(
            (f"largest acceleration of {n}", "deg/s^2", _DEGREE, turns * a)
            for n, a in zip(axes, limits.accelerations, strict=True)
        ),
        *(
            (f"travel of {n}, at each end", "deg", _DEGREE, s if turns else 0.0)
            for n, s in zip(axes, spans, strict=True)
        ),
        ("shortest rest", "s", 1.0, rests),
        ("chamber slope", "K/min", 1.0 / 60.0, slope),
    ]


def _eased(plan: CyclePlan, z: Any, of: CycleStructure, ramps: Ramp | None, targets: Any, by: Any) -> Any:
    """The objective's logarithm with the limits eased `by` so much, SI."""
    limits, ends = plan.limits, np.cumsum([1, *3 * [len(plan.limits.rates)], 1])
    time, rates, accelerations, travel, shortest, slope = jnp.split(by, ends)
    eased = limits._replace(
        rates=limits.rates + rates,
        accelerations=limits.accelerations + accelerations,
        reach=limits.reach + jnp.stack([-travel, travel], axis=1),
        shortest=limits.shortest - shortest[0],
    )
    longer = 1.0 + time[0] / plan.motion
    of, count = of._replace(period=of.period * longer), 3 * plan.slots
    if ramps is not None:
        ramps = ramps._replace(slope=ramps.slope / longer, elapsed=ramps.elapsed * longer)
    elif (course := plan.free_course) is not None:
        old = course.coordinates
        steeper = {"heating": old.heating + slope[0], "cooling": old.cooling + slope[0]}
        eased_course = course._replace(coordinates=replace(old, time=old.time * longer, **steeper))
        ramps = eased_course.ramps(z[count:], of.period)
    assert ramps is not None
    objective, visits = copy(plan.objective), plan.coordinates.visits
    if visits is not None:
        visits = visits._replace(stretch=longer)
    objective.coordinates = plan.coordinates._replace(limits=eased, visits=visits)
    return objective.value(jnp.reshape(z[:count], (3, plan.slots)), of, ramps, _SHARPNESS, targets)


def active_limits(plan: CyclePlan, cycle: RepeatedCycle) -> tuple[str, ...]:
    """Which limits bind a cycle, in words."""
    limits, binding, near = plan.limits, ["the time of the cycle"], 1.0 - _AT_LIMIT
    for k, axis in enumerate(plan.spec.rig.table.axis if plan.turns_free else ()):
        turns = [t for t in cycle.turns if t.axis == k]
        fastest = sum(t.rate >= near * limits.rates[k] for t in turns)
        if fastest:
            binding.append(f"the maximum rate of {axis.name}, in {fastest} of {len(turns)} turns")
        low, high = limits.reach[k]
        at = limits.start[k] + np.cumsum([t.angle for t in turns])
        if np.isfinite(high) and turns and np.max(np.abs(2.0 * at - low - high)) >= near * (high - low):
            binding.append(f"the travel of {axis.name}")
    rests = [t.rest for t in cycle.turns if t.rest > 0.0]
    shortest = sum(r <= limits.shortest * (1.0 + _AT_LIMIT) for r in rests)
    if shortest and plan.turns_free:
        binding.append(f"the shortest rest, in {shortest} of {len(rests)}")
    if plan.free_course is not None:
        of = plan.free_course.coordinates
        slopes = np.asarray(of.programme(np.array(cycle.course)).slopes)
        most = np.where(slopes > 0.0, float(of.heating), float(of.cooling))
        if steep := int(np.sum(np.abs(slopes) >= near * most)):
            binding.append(f"the chamber's slope, in {steep} of {len(slopes)} legs")
    return tuple(binding)


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
_OF_BEGIN = 180
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
        self._plans, self._budget, self._stop = plans, evaluations, stop
        self._rng = np.random.default_rng(plans[0].design.seed)
        self.used, self.best = 0, Found(plans[0], plans[0].start)

    def plan_of(self, point: Found) -> tuple[Spec, str]:
        """The plan of a cycle, and its structure in words."""
        return point.plan.spec_of(point.cycle), point.plan.in_words(point.cycle)

    def record(self, best: Optimised, point: Found | None, last: PlanOutcome) -> dict[str, Any]:
        """What the search took, and the limits that bind the cycle of the best plan."""
        of: dict[str, Any] = {"evaluations": self.used}
        if point is not None and not self._stop():
            of["active"] = active_limits(point.plan, point.cycle)
            of["prices"] = shadow_prices(point.plan, point.cycle, best.now)
        better = "" if best.kept else f"the geometric mean of all residuals is smaller by a factor of {best.gain:.2f}, "
        sentence = f"{better}after {self.used} gradients"
        if last.trouble:
            sentence += f"; the last plan cannot be rounded to the controllers' steps: {last.trouble}"
        return of | {"sentence": sentence}

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
                if self._stop():
                    break
            if number == 0 or ends[0].value < self.best.value:
                self.best = ends[0]
        yield from self._hops() if self.best.plan.draws else self._annealed()
        plan = self.best.plan
        sharpness, most = _LAST_OF_VISITS if plan.draws else _LAST
        last = max(1, min(most, self._budget // 4))
        if plan.by_time and not self._stop():
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
        while self.used < self._budget and without_gain < len(_STEPS) and not self._stop():
            before, plan, cycle = self.best.value, self.best.plan, self.best.cycle
            of = plan.structure(cycle)
            z, size = plan.point(cycle, of), _STEPS[rounds % len(_STEPS)]
            near = (z + size * self._rng.standard_normal(z.shape) for _ in range(_FEWEST))
            begins = [Found(plan, plan.cycle_at(one, of, cycle.cycles)) for one in near]
            ends = self._descents(begins, *_HOP_OF_VISITS, least=before)
            self.best = min((self.best, *ends), key=lambda end: end.value)
            without_gain, rounds = 0 if self.best.value < before - _HOP_GAIN else without_gain + 1, rounds + 1
            yield self._share(), self.best

    def _annealed(self) -> Iterator[tuple[float, Found]]:
        """Descents from changed structures, of which one that is a little worse is gone on from, too."""
        here, last = self.best, min(_LAST[1], self._budget // 4)
        around = Neighbourhood(here.plan.limits, here.plan.slots)
        while self.used < self._budget - last and not self._stop():
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
                return self._stop() or gained < gain or now.value > least + _HOPELESS * LOOK / now.evaluations

            most = min(evaluations, self._budget)
            reached = plan.descent(plan.point(cycle, of), args, evaluations=most, ends=ends)
            end = plan.cycle_at(reached.point, of, cycle.cycles)
            return Found(plan, end, reached.value), reached.evaluations

        with ThreadPoolExecutor(min(len(begins), max(TOGETHER, os.cpu_count() or 1))) as pool:
            results = list(pool.map(descend, begins))
        self.used += sum(count for _, count in results)
        return [end for end, _ in results]
