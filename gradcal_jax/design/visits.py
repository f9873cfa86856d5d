"""When the axis of a gyro alone on a table has that table, and how long a plan may take.

The table is its axis's in *visits*; in between other axes turn. The numbers of visits and of turns in each have no
gradient: a search tries a few of them.
"""

import math
from typing import Any, Final, NamedTuple

import numpy as np

from gradcal_jax.design.slots import EMPTY, LEAST_TURN, Cycle, SlotTurn, TableLimits, Visits
from gradcal_jax.formulas import repetitions
from gradcal_jax.recipe.tracks import steps_of
from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.design import Design
from gradcal_jax.spec.moves import ResolvedMove
from gradcal_jax.spec.plan import MotionPlan, RampItem
from gradcal_jax.spec.schedule import duration_of
from gradcal_jax.spec.spec_sections import Spec

# A shorter time of other axes behind the last visit is none, s.
_LEFT: Final = 1e-3
# Largest number of visits with moves of their own; beyond, the cycle repeats.
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


def moves_of_visits(spec: Spec) -> list[list[ResolvedMove]]:
    """The moves of each visit of a cycle."""
    visits: list[list[ResolvedMove]] = [[]]
    for step in spec.gradient_schedule.steps:
        if step.move.other_axes:
            visits.append([])
        else:
            visits[-1].append(step.move)
    return visits


def visit_times(spec: Spec) -> tuple[float, float]:
    """The duration (s) of one visit, and the time after it for other axes."""
    schedule, visits = spec.gradient_schedule, moves_of_visits(spec)
    others = [step.move.duration for step in schedule.steps if step.move.other_axes]
    own = math.fsum(move.duration for visit in visits for move in visit)
    return own / len(visits), others[0] if others else duration_of(schedule.after)


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
    time, visits = spec.gradient_schedule.stretches[0].duration, moves_of_visits(spec)
    own, other = visit_times(spec)
    if "cycle" in design.free:
        # The axis keeps its share of the time. The last visit ends with the ramp.
        share = own / (own + other)
        options = [(n, share * time / n, (1.0 - share) * time / (n - 1), 1) for n in _FREE_VISITS]
    else:
        count, each = repetitions(time, own, own + other)[0], len(visits)
        ramps = [s for s in spec.gradient_schedule.segments if s.kind == "ramp"]
        alone = len(ramps) == 1 and len(spec.gradient_schedule.stretches) == 1
        options = [(count, own, other, 1) if count <= _MOST_OWN and alone else (each, own, other, count // each)]
    choices = []
    for count, each, between, cycles in options:
        fitting = max(1, int(0.5 * each / (LEAST_TURN + shortest_rest(spec, design))))
        wanted = max(_LEAST_TURNS, -(-_TURNS // count)) if cycles == 1 else 2 * _LEAST_TURNS
        turns = design.moves or min(wanted, fitting)
        turns = max([turns, *(sum(not move.is_rest for move in moves) for moves in visits)])
        least = turns * (LEAST_TURN + shortest_rest(spec, design))
        if least > each:
            raise ValueError(
                f"the moves need at least {least:.4g} s, but the axis may turn for only {each:.4g} s in each visit: "
                "use fewer moves or a longer cycle"
            )
        choices.append(VisitTimes(count, each, between, cycles, turns))
    return choices


def shortest_rest(spec: Spec, design: Design) -> float:
    """The shortest rest, s; of one axis, unless it is stated, no longer than until its angle is read."""
    least = float(design.shortest_rest)
    if spec.turns_one_gyro and "shortest_rest" not in design.model_fields_set:
        return min(least, rest_spacing(spec))
    return least


def rest_spacing(spec: Spec) -> float:
    """How often a table of one axis is read at rest, s: as its first rest that is read so, or else the table."""
    table = float(spec.rig.table.axis[0].angle.read_every)
    rests = (step.move for step in spec.gradient_schedule.steps if step.move.is_rest)
    spacings = (table if rest.reads_as_table else rest.read_every for rest in rests)
    return next((float(every) for every in spacings if every and math.isfinite(every)), table)


def cycle_in_visits(spec: Spec, times: VisitTimes, limits: TableLimits) -> tuple[Visits, Cycle]:
    """The slots of the visits: a rest before the first turn of all, then turns with rests between them and, where no
    other axis waits, behind the last; with the moves of the file's cycle, as many as it has, in every visit."""
    own, slots, group = moves_of_visits(spec), list[SlotTurn](), list[int]()
    whole = spec.gradient_schedule.stretches[0].duration
    tail = times.other if times.cycles > 1 else whole - times.visits * times.own - (times.visits - 1) * times.other
    tail = tail if tail > _LEFT else 0.0
    for visit in range(times.visits):
        turns = [SlotTurn(-1, 0.0, 0.0, limits.shortest)]
        for move in own[visit % len(own)]:
            if move.is_rest:
                turns[-1] = turns[-1]._replace(rest=turns[-1].rest + move.duration)
            else:
                turns.append(SlotTurn(0, move.angle, move.fastest, 0.0))
        turns = turns if visit == 0 else turns[1:]
        if times.other and (visit < times.visits - 1 or tail):
            turns[-1] = turns[-1]._replace(rest=0.0)
        empty = times.turns + (visit == 0) - len(turns)
        slots += turns + [EMPTY] * empty
        group += [visit] * (times.turns + (visit == 0))
    plan = spec.plan
    others = plan.cycle.other_axes if isinstance(plan, MotionPlan) and plan.cycle is not None else None
    every = limits.read_every if others is not None and others.read_every is not None else math.inf
    # For the steps of time to which turns are rounded.
    spare = 0.5 * float(steps_of(spec).time) * (times.turns + 1)
    other = times.other + spare if times.other else 0.0
    return Visits(np.array(group), times.own - spare, other, every, tail), tuple(slots)
