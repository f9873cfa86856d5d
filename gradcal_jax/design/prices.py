"""What the limits that bind a plan are worth: by how much an objective changes if a limit of the rig is eased."""

import math
from copy import copy
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gradcal_jax.design.compiling import compiler_options
from gradcal_jax.design.cycle_plan import CyclePlan, RepeatedCycle
from gradcal_jax.design.free_course import Ramp
from gradcal_jax.design.slots import CycleStructure

# Sharpness of the maxima of an optimum; step of a derivative, as a share of the limit.
_SHARPNESS = 100.0
_STEP = 1e-4
# A limit restricts a plan if the objective changes by this share or more where the limit does by all of it.
_RESTRICTS = 1e-3
_DEGREE = math.pi / 180.0


class Price(NamedTuple):
    """The shadow price of a limit: the change of the objective for each `per` by which the limit is eased, zero or
    less. `restricts`: whether it is more than rounding."""

    limit: str
    per: str
    change: float
    restricts: bool = True


class _Limit(NamedTuple):
    """A limit of a rig: the unit `per` which it is priced, that unit and the limit's size in SI; a size that is zero or
    not finite: there is no such limit."""

    name: str
    per: str
    unit: float
    size: float


def shadow_prices(plan: CyclePlan, cycle: RepeatedCycle, value: float) -> tuple[Price, ...]:
    """The derivatives in the limits of the objective `value` at an optimal cycle, where that through the free numbers
    vanishes (envelope theorem), with the cost of exceeded targets; by central differences of a compiled value.

    A plan within a limit is within an eased one, so that no price is positive: where a slope is, the point is not quite
    an optimum, or the limit does not bind.
    """
    of = plan.structure(cycle)
    args = plan.point(cycle, of), jax.tree.map(jnp.asarray, of), plan.course(cycle.cycles).ramps, plan.objective.targets
    quickly = compiler_options() | {"xla_backend_optimization_level": 0}
    log = jax.jit(partial(_eased, plan), compiler_options=quickly)
    limits, prices = _limits_of(plan), list[Price]()
    for by, (name, per, unit, size) in zip(np.eye(len(limits)), limits, strict=True):
        if not 0.0 < size < math.inf:
            continue
        step = _STEP * size * by
        slope = min(float(log(*args, step) - log(*args, -step)) / (2.0 * _STEP * size), 0.0)
        prices.append(Price(name, per, value * slope * unit, slope * size < -_RESTRICTS))
    return tuple(prices)


def _limits_of(plan: CyclePlan) -> list[_Limit]:
    """Every limit, in the order of `_eased`."""
    limits, turns = plan.limits, float(plan.turns_free)
    axes = [axis.name for axis in plan.spec.rig.table.axis]
    spans = np.where(turns, limits.reach[:, 1] - limits.reach[:, 0], 0.0)
    rests = turns * limits.shortest * any(t.rest > 0.0 for t in plan.start.turns)
    slope = float(plan.spec.rig.chamber.max_heating) if plan.free_course is not None else 0.0
    rows = [_Limit("time (every cycle longer in proportion)", "minute", 60.0, plan.motion)]
    for words, per, sizes in (
        ("largest rate of {}", "deg/s", turns * limits.rates),
        ("largest acceleration of {}", "deg/s^2", turns * limits.accelerations),
        ("travel of {}, at each end", "deg", spans),
    ):
        rows += [_Limit(words.format(n), per, _DEGREE, float(of)) for n, of in zip(axes, sizes, strict=True)]
    return [*rows, _Limit("shortest rest", "s", 1.0, rests), _Limit("chamber slope", "K/min", 1.0 / 60.0, slope)]


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
    of, course = of._replace(period=of.period * longer), plan.free_course
    if ramps is not None:
        ramps = ramps._replace(slope=ramps.slope / longer, elapsed=ramps.elapsed * longer)
    elif course is not None:
        old = course.coordinates
        steeper = {"heating": old.heating + slope[0], "cooling": old.cooling + slope[0]}
        course = course._replace(coordinates=replace(old, time=old.time * longer, **steeper))
    objective, visits = copy(plan.objective), plan.coordinates.visits
    visits = None if visits is None else visits._replace(stretch=longer)
    objective.coordinates = plan.coordinates._replace(limits=eased, visits=visits)
    return objective.value_at(z, (of, ramps, _SHARPNESS, targets), course)
