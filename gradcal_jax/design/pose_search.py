"""The search for the cycle of poses, turns and rests that minimises the residuals of an IMU's requirements; and
what the limits that bind it are worth.

Every cycle descends along the exact gradient of `design.pose_cycle`: first the file's own, then cycles of a changed
structure near the best one. What counts in the end is the plan as a recipe rounds it, evaluated as `predict` does it.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gradcal_jax.design.compiling import compiler_options
from gradcal_jax.design.cycle_moves import Neighbourhood
from gradcal_jax.design.cycle_plan import CyclePlan, RepeatedCycle
from gradcal_jax.design.pose_cycle import CycleCoordinates, CycleStructure, Ramp
from gradcal_jax.design.searching import Optimised, PlanOutcome, Price, PricedLimit, priced
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
    coordinates = CycleCoordinates(eased, plan.slots)
    return plan.objective.value(jnp.reshape(z[:count], (3, plan.slots)), of, ramps, _SHARPNESS, targets, coordinates)


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
        self._here, self._now = plan.start, math.inf

    def plan_of(self, point: RepeatedCycle) -> tuple[Spec, str]:
        """The plan of a cycle, and its structure in words."""
        return self._plan.spec_of(point), self._plan.in_words(point)

    def record(self, best: Optimised, point: RepeatedCycle | None, last: PlanOutcome) -> dict[str, Any]:
        """What the search took, and the limits that bind the cycle of the best plan."""
        del last
        plan, of = self._plan, {"evaluations": self.used}
        if point is not None and not self._stop():
            of |= {"active": active_limits(plan, point), "prices": shadow_prices(plan, point, best.now)}
        better = "" if best.kept else f"the geometric mean of all residuals is smaller by a factor of {best.gain:.2f}, "
        sentence = f"{better}after {self.used} gradients"
        return of | {"sentence": sentence}

    def run(self) -> Iterator[tuple[float, RepeatedCycle]]:
        """A cycle after every round of descents; before them, other courses of the chamber, which are plans too."""
        plan, rng = self._plan, self._rng
        begins = plan.starts()
        for start in begins[1:]:
            yield 0.0, start
        for sharpness, count in _FIRST:
            self._now, self._here = min(self._descents(begins, sharpness, count), key=lambda found: found[0])
            self.best, self._value = self._here, self._now
            begins = [self._here]
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
            ramps, targets = plan.course(cycle.cycles).ramps, plan.objective.targets
            args = (jax.tree.map(jnp.asarray, of), ramps, sharpness, targets)
            for reached in plan.descent(point, args, evaluations=evaluations, together=_LOOK):
                if self._stop() or reached.value > least + _HOPELESS * _LOOK / reached.evaluations:
                    break
            assert reached is not None
            return reached.value, plan.cycle_at(reached.point, of, cycle.cycles), reached.evaluations

        with ThreadPoolExecutor(len(cycles)) as pool:
            results = list(pool.map(descend, cycles))
        self.used += sum(count for *_, count in results)
        return [(value, cycle) for value, cycle, _ in results]
