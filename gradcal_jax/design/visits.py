"""When the axis of a gyro alone on a table has that table, and how long a plan may take.

The table is its axis's in *visits*; in between other axes turn. The numbers of visits and of turns in each have no
gradient: a search tries a few of them.
"""

import math
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from gradcal_jax.design.slots import EMPTY, LEAST_TURN, Cycle, SlotTurn, TableLimits, Visits
from gradcal_jax.formulas import repetitions
from gradcal_jax.recipe.tracks import steps_of
from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.design import Design
from gradcal_jax.spec.plan import MotionPlan, RampItem
from gradcal_jax.spec.schedule import PlanStep, duration_of
from gradcal_jax.spec.spec_sections import Spec

# A shorter time of other axes behind the last visit is none, s.
_LEFT: Final = 1e-3
# Largest number of visits with moves of their own; of more, a cycle repeats that has from so many to so many.
_LEAST_OWN: Final = 6
_MOST_OWN: Final = 20
# Turns of all visits together, about, and of each at least: one for every power of a cubic.
_TURNS: Final = 36
_LEAST_TURNS: Final = 4
# Numbers of visits that are searched where the cycle's length is free.
_FREE_VISITS: Final = (3, 4, 6)


def motion_time(spec: Spec, design: Design) -> float:
    """The duration of the ramp (s) by [design], else the plan's. Errors: `ValueError` where no time is left."""
    schedule = spec.gradient_schedule
    limits = [] if design.max_motion is None else [float(design.max_motion)]
    if design.max_total is not None:
        limits.append(float(design.max_total) - schedule.soak)
    limits = limits or [schedule.motion]
    if min(limits) <= 0.0:
        raise ValueError(
            f"design.max_total leaves no time for the ramp: the soak alone takes {schedule.soak / 60.0:.4g} min"
        )
    return min(limits)


def with_motion(spec: Spec, time: float) -> Spec:
    """The spec with ramps that last, with steps between them, `time` s in all: every slope by the same factor.

    Errors: `ValueError` for a plan without a ramp, or where the steps take longer; `SpecError` where the chamber or a
    cycle needs more.
    """
    schedule = spec.gradient_schedule
    ramps = math.fsum(s.duration for s in schedule.segments if s.kind == "ramp")
    left = time - (schedule.motion - ramps)
    if not ramps or left <= 0.0:
        raise ValueError(f"the plan has no ramp that could last {time / 60.0:.4g} min")

    def slower(slope: float) -> str:
        return f"{60.0 * slope * ramps / left:.12g} K/min"

    plan = spec.plan
    assert isinstance(plan, MotionPlan)
    if plan.programme is not None:
        keys: dict[str, Any] = {
            f"plan.programme[{k}].rate": slower(item.rate)
            for k, item in enumerate(plan.programme)
            if isinstance(item, RampItem)
        }
    else:
        keys = {"plan.gradient": slower(float(plan.gradient or 0.0))}
    return changed(spec, keys)


def slot_turns(steps: Sequence[PlanStep]) -> list[SlotTurn]:
    """Turns, each with the rest after it, behind a slot that rests before the first one."""
    turns = [EMPTY]
    for step in steps:
        if step.axis >= 0:
            turns.append(SlotTurn(step.axis, step.move.angle, step.move.fastest, 0.0))
        else:
            turns[-1] = turns[-1]._replace(rest=turns[-1].rest + step.move.duration)
    return turns


def _visits_of(spec: Spec) -> list[list[PlanStep]]:
    """The steps of each visit of a cycle."""
    visits: list[list[PlanStep]] = [[]]
    for step in spec.gradient_schedule.steps:
        if step.move.other_axes:
            visits.append([])
        else:
            visits[-1].append(step)
    return visits


class VisitTimes(NamedTuple):
    """A cycle of so many `visits` of `own` s, after each of which other axes have the table for `other` s; how many
    such `cycles` the plan has; and the number of `turns` in each visit."""

    visits: int
    own: float
    other: float
    cycles: int
    turns: int


def visit_choices(spec: Spec, design: Design) -> list[VisitTimes]:
    """The visits that a search tries for a plan that turns one gyro."""
    schedule, visits = spec.gradient_schedule, _visits_of(spec)
    time, waits = schedule.stretches[0].duration, [s.move.duration for s in schedule.steps if s.move.other_axes]
    own = duration_of([step for steps in visits for step in steps]) / len(visits)
    other = waits[0] if waits else duration_of(schedule.after)
    if "cycle" in design.free:
        # The axis keeps its share of the time. The last visit ends with the ramp.
        share = own / (own + other)
        options = [(n, share * time / n, (1.0 - share) * time / (n - 1), 1) for n in _FREE_VISITS]
    else:
        count, size = repetitions(time, own, own + other)[0], len(visits)
        if sum(s.kind == "ramp" for s in schedule.segments) == 1 == len(schedule.stretches):
            size = _visits_of_cycle(count)
        options = [(size, own, other, count // size)]
    choices, rest = [], shortest_rest(spec, design)
    for count, each, between, cycles in options:
        fitting = max(1, int(0.5 * each / (LEAST_TURN + rest)))
        wanted = max(_LEAST_TURNS, -(-_TURNS // count))
        if cycles > 1:
            wanted = min(wanted, 2 * _LEAST_TURNS)
        turns = design.moves or min(wanted, fitting)
        turns = max([turns, *(len(slot_turns(steps)) - 1 for steps in visits)])
        least = turns * (LEAST_TURN + rest)
        if least > each:
            raise ValueError(
                f"the moves need at least {least:.4g} s, but the axis may turn for only {each:.4g} s in each visit: "
                "use fewer moves or a longer cycle"
            )
        choices.append(VisitTimes(count, each, between, cycles, turns))
    return choices


def _visits_of_cycle(count: int) -> int:
    """How many of so many visits have moves of their own before these repeat: the largest number of those that leave
    the fewest visits without moves."""
    numbers = range(min(count, _LEAST_OWN), min(count, _MOST_OWN) + 1)
    return max(numbers, key=lambda number: (count // number * number, number))


def shortest_rest(spec: Spec, design: Design) -> float:
    """The shortest rest, s; of one axis, unless it is stated, no longer than until its angle is read."""
    least = float(design.shortest_rest)
    if spec.turns_one_gyro and "shortest_rest" not in design.model_fields_set:
        return min(least, float(spec.rig.table.axis[0].angle.read_every))
    return least


def cycle_in_visits(spec: Spec, times: VisitTimes, limits: TableLimits) -> tuple[Visits, Cycle]:
    """The slots of the visits: a rest before the first turn of all, then turns with rests between them and, where no
    other axis waits, behind the last; with the moves of the file's cycle, as many as it has, in every visit."""
    own, slots, group = _visits_of(spec), list[SlotTurn](), list[int]()
    whole = spec.gradient_schedule.stretches[0].duration
    tail = times.other if times.cycles > 1 else whole - times.visits * times.own - (times.visits - 1) * times.other
    tail = tail if tail > _LEFT else 0.0
    for visit in range(times.visits):
        first, *turns = slot_turns(own[visit % len(own)])
        turns = turns if visit else [first._replace(rest=first.rest + limits.shortest), *turns]
        if times.other and (visit < times.visits - 1 or tail):
            turns[-1] = turns[-1]._replace(rest=0.0)
        count = times.turns + (visit == 0)
        slots += turns + [EMPTY] * (count - len(turns))
        group += [visit] * count
    plan = spec.plan
    others = plan.cycle.other_axes if isinstance(plan, MotionPlan) and plan.cycle is not None else None
    every = limits.read_every if others is not None and others.read_every is not None else math.inf
    # For the steps of time to which turns are rounded.
    spare = 0.5 * float(steps_of(spec).time) * (times.turns + 1)
    other = times.other + spare if times.other else 0.0
    return Visits(np.array(group), times.own - spare, other, every, tail), tuple(slots)
