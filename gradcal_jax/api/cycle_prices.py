"""The limits that bind an optimal cycle of turns and poses, and what a limit is worth."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gradcal_jax.api.cycle_plan import CyclePlan, RepeatedCycle
from gradcal_jax.api.search_results import Price, PricedLimit, priced
from gradcal_jax.design.pose_cycle import CycleCoordinates, CycleStructure, Ramp

# A rate, pose, rest or slope within this share of its limit counts as limited.
_AT_LIMIT = 0.01
# Sharpness of the maxima of an optimum.
_SHARPNESS = 100.0
_DEGREE = np.pi / 180.0


def shadow_prices(plan: CyclePlan, cycle: RepeatedCycle, value: float) -> tuple[Price, ...]:
    """The derivatives in the limits of the objective `value` at an optimal cycle, where that through the free numbers
    vanishes (envelope theorem), with the cost of exceeded targets; by central differences of a compiled value."""
    of = plan.structure(cycle)
    args = plan.point(cycle, of), jax.tree.map(jnp.asarray, of), plan.course(cycle.cycles).ramps
    log = jax.jit(lambda by: _eased(plan, *args, by), compiler_options={"xla_backend_optimization_level": 0})
    return priced(value, [PricedLimit(*row) for row in _limits_of(plan)], lambda by: float(log(by)))


def _limits_of(plan: CyclePlan) -> list[tuple[str, str, float, float]]:
    """Name, the unit in which it is eased, that unit in SI, and size (SI) of every limit, in the order of `_eased`."""
    limits, turns = plan.limits, float(plan.turns_free)
    axes = [axis.name for axis in plan.spec.rig.table.axis]
    spans = limits.reach[:, 1] - limits.reach[:, 0]
    rests = turns * limits.shortest * any(t.rest > 0.0 for t in plan.start.turns)
    slope = float(plan.spec.rig.chamber.max_heating) if plan.free_course is not None else 0.0
    return [
        ("time, every cycle in proportion", "minute", 60.0, plan.motion),
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


def _eased(plan: CyclePlan, z: Any, of: CycleStructure, ramps: Ramp | None, by: Any) -> Any:
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
    return plan.objective.value(jnp.reshape(z[:count], (3, plan.slots)), of, ramps, _SHARPNESS, coordinates)


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
