"""`[plan]` of a whole unit: the chamber's course, and a cycle of rests, turns of one axis, and poses.

A pose has the final angles of axes; it becomes one move of each axis that is elsewhere, outermost first, as fast as the
rig allows (or at `peak_rate`), with cosine ramps.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Literal

from pydantic import Field

from gradcal_jax.spec.bench import Rig, RigTable, TableAxis
from gradcal_jax.spec.moves import FULL_TURN, Move, Pose, ResolvedMove, Rest, Turn
from gradcal_jax.spec.plan import ChamberCourse, OtherAxes, StandardPlan
from gradcal_jax.spec.schedule import CourseTimes, Stretch, TemperatureSegment, programme_of
from gradcal_jax.tables.problems import Problem, SpecError, hint
from gradcal_jax.tables.quantity import Angle, Quantity, Temperature, Text
from gradcal_jax.tables.section import Section, chosen_by, refuse

_SLACK = 1e-6
_HELD = 'has no effect if the table holds its angle at rest: leave this key out, or set rig.table.standing = "read"'


class MotionCycle(Section):
    """The motion of the table that is repeated."""

    moves: Annotated[tuple[Move, ...], Field(min_length=1, max_length=2000)]
    """Rests, turns and poses, in the order in which they are made."""
    start: dict[Text, Angle] = Field(default_factory=dict)
    """Angles of the axes at the start of the cycle, by name; absent: zero."""
    other_axes: OtherAxes | None = None
    """Time for which the table serves other sensors at the end of each cycle; only for a table with standing =
    "read"."""


class MotionPlan(ChamberCourse):
    """The plan of an IMU. If there are several mountings, the mounting changes to the next one before each further part
    of the programme whose data are used. If the programme is a single ramp, it is repeated for each mounting; in
    between, the chamber returns to the start of the ramp."""

    method: Literal["gradient"] = "gradient"
    """The method of the plan."""
    cycle: MotionCycle | None = None
    """Motion that is repeated; absent: the table is at rest, and each axis is read at intervals of its `read_every`."""
    before: Annotated[tuple[Temperature, ...], Field(max_length=100)] = ()
    """Turning points of the sensor's temperature before the plan, in order, such as room temperature; they determine
    the initial state of a hysteresis. Absent: the initial state is unknown."""


AnyPlan = Annotated[
    MotionPlan | StandardPlan,
    chosen_by("method", {"gradient": MotionPlan, "standard": StandardPlan}, default="gradient"),
]


@dataclass(frozen=True)
class PlanStep:
    """A step of the cycle in SI: `axis` is the table axis's number, −1 for a rest. `source`: which move of the file."""

    axis: int
    move: ResolvedMove
    source: int


@dataclass(frozen=True)
class PlanSchedule(CourseTimes):
    """A unit's plan in SI: the chamber's segments, stretches of used data, and the cycle's steps.

    `start`: angles of the axes (rad) as each stretch begins. `after`: rests behind the steps, in all cycles of a
    stretch but the last.
    """

    segments: tuple[TemperatureSegment, ...]
    stretches: tuple[Stretch, ...]
    steps: tuple[PlanStep, ...]
    start: tuple[float, ...]
    after: tuple[PlanStep, ...] = ()

    @property
    def period(self) -> float:
        """Of one cycle (s)."""
        return duration_of((*self.steps, *self.after))

    @property
    def is_plain(self) -> bool:
        """Whether there is a cycle, all of whose rests and moves are read as the table is."""
        own = (not s.move.read_end or s.move.read_every is not None for s in self.steps)
        return bool(self.steps) and not self.after and not any(own)


def row_count(schedule: PlanSchedule, table: RigTable) -> int:
    """Rows of data of each channel: of a table that is read while it stands the readings of its angle, else a row for
    each rest and turn; the first reading of each stretch not counted."""
    spacing = min(float(axis.angle.read_every) for axis in table.axis)

    def rows(steps: Iterable[PlanStep]) -> int:
        return sum(_rows(step.move, spacing, table) for step in steps)

    cycle, after = rows(schedule.steps), rows(schedule.after)
    total = 0
    for stretch in schedule.stretches:
        total += stretch.cycles * cycle + max(0, stretch.cycles - 1) * after
        stands = stretch.leftover if stretch.cycles else stretch.duration
        if stands > 0.0 and (table.standing == "held" or not table.typed):
            # What no cycle fills has no reading at its end beside spaced ones.
            rest = ResolvedMove("rest", stands, read_end=math.isinf(spacing), read_every=spacing)
            total += _rows(rest, spacing, table)
    return total


def _rows(move: ResolvedMove, spacing: float, table: RigTable) -> int:
    if table.standing == "held":
        return 1
    return (replace(move, read_every=spacing) if move.reads_as_table else move).readings


def duration_of(steps: Iterable[PlanStep]) -> float:
    """Duration of steps (s)."""
    return math.fsum(step.move.duration for step in steps)


def plan_schedule(plan: MotionPlan, rig: Rig) -> PlanSchedule:
    """Resolve a unit's plan. Raises `SpecError` with all problems, keys relative to the plan."""
    if plan.cycle is None:
        segments, stretches = programme_of(plan, rig.chamber, None)
        return PlanSchedule(segments, stretches, (), (0.0,) * len(rig.table.axis))
    steps, start, problems = resolve_steps(plan.cycle, rig)
    refuse(*problems)
    moving, after = duration_of(steps), _after(plan.cycle, rig)
    segments, stretches = programme_of(plan, rig.chamber, (moving, moving + duration_of(after)))
    mountings = len(rig.table.mounting)
    if mountings > 1 and len(stretches) == 1 and plan.programme is None:
        segments, stretches = _once_each(segments, stretches, mountings, rig)
    elif mountings > 1 and len(stretches) != mountings:
        message = (
            f"has {len(stretches)} parts with used data, and there are {mountings} mountings: expected one part for "
            "each mounting"
        )
        refuse(Problem(("programme",), message))
    if not any(stretch.cycles for stretch in stretches):
        longest = max(stretch.duration for stretch in stretches)
        message = (
            f"the moves of a cycle take {moving:.4g} s, longer than every part with used data; the longest has "
            f"{longest:.4g} s"
        )
        refuse(Problem(("cycle",), message))
    if sum(s.cycles for s in stretches) * len(steps) > 200_000:
        message = "the plan makes more than 200000 moves in total: lengthen the rests or turns of the cycle"
        refuse(Problem(("cycle",), message))
    schedule = PlanSchedule(segments, stretches, steps, start, after)
    problems = [*_travel(schedule, rig)]
    if len(stretches) > 1 and (mountings > 1 or len(rig.table.axis) > 1):
        turned = ([s.move.angle for s in steps if s.axis == k] for k in range(len(start)))
        ends = [math.fsum([angle, *turns]) for angle, turns in zip(start, turned, strict=True)]
        names = [axis.name for axis in rig.table.axis]
        problems += _unclosed(ends, start, names, "the cycle starts again in every part with used data")
    refuse(*problems)
    return schedule


def _after(cycle: MotionCycle, rig: Rig) -> tuple[PlanStep, ...]:
    """The time of other axes behind a cycle's moves. Raises `SpecError`."""
    if cycle.other_axes is None:
        return ()
    if rig.table.standing != "read":
        refuse(Problem(("cycle", "other_axes"), _HELD))
    move, every = ResolvedMove("rest", float(cycle.other_axes.duration), read_end=False), cycle.other_axes.read_every
    if every is not None:
        move = replace(move, read_end=math.isinf(every), read_every=float(every))
    return (PlanStep(-1, move, -1),)


def _once_each(
    segments: tuple[TemperatureSegment, ...], stretches: tuple[Stretch, ...], mountings: int, rig: Rig
) -> tuple[tuple[TemperatureSegment, ...], tuple[Stretch, ...]]:
    """The course once with each mounting; the chamber returns as fast as it can."""
    first, last = segments[0], segments[-1]
    change = first.temperature_start - last.temperature_end
    pace = rig.chamber.max_heating if change > 0.0 else rig.chamber.max_cooling
    ends = last.temperature_end, first.temperature_start
    back = TemperatureSegment("step", last.end, abs(change) / pace, *ends, False)
    whole, (stretch,) = back.end, stretches
    course = [replace(s, start=s.start + k * whole) for k in range(mountings) for s in (*segments, back)]
    # After the last mounting the chamber need not return.
    return tuple(course[:-1]), tuple(replace(stretch, start=stretch.start + k * whole) for k in range(mountings))


def resolve_steps(cycle: MotionCycle, rig: Rig) -> tuple[tuple[PlanStep, ...], tuple[float, ...], list[Problem]]:
    """The steps of a cycle, the angles (rad) at which it begins, and the problems of moves that are left out, with keys
    relative to the plan."""
    axes = {axis.name: k for k, axis in enumerate(rig.table.axis)}
    problems: list[Problem] = []
    start = [0.0] * len(axes)

    def known(name: str, *key: str | int) -> bool:
        """Whether the table has an axis of this name; a problem where it does not."""
        if name not in axes:
            ending = hint(name, axes, f"; known: {', '.join(axes)}")
            problems.append(Problem(("cycle", *key), f"the table has no axis of this name{ending}", name))
        return name in axes

    for name, angle in cycle.start.items():
        if known(name, "start", name):
            start[axes[name]] = float(angle)
    here, poses, by_hand = list(start), False, rig.table.drive == "hand"
    steps: list[PlanStep] = []
    for i, item in enumerate(cycle.moves):
        key = ("cycle", "moves", i)
        if isinstance(item, Rest):
            problems += _unread(item, rig, key)
            steps.append(PlanStep(-1, item.resolve(), i))
            continue
        if isinstance(item, Pose):
            poses = True
            for name in item.pose:
                known(name, "moves", i, "pose", name)
            for k, axis in enumerate(rig.table.axis):
                goal = item.pose.get(axis.name)
                if goal is not None and abs(goal - here[k]) > 1e-9:
                    if by_hand:
                        problems.append(_beyond_drive(rig.table.drive, (*key, "pose"), "pose"))
                    steps.append(PlanStep(k, _quickest(float(goal) - here[k], axis, item.peak_rate), i))
                    here[k] = float(goal)
            if item.rest is not None:
                steps.append(PlanStep(-1, ResolvedMove("rest", float(item.rest)), i))
            continue
        problems += _unread(item, rig, key)
        if item.axis is None and len(axes) > 1:
            message = f"this key is missing: which axis turns? {', '.join(axes)}"
            problems.append(Problem((*key, "axis"), message, kind="missing"))
            continue
        name = item.axis if item.axis is not None else next(iter(axes))
        if not known(name, "moves", i, "axis"):
            continue
        axis = rig.table.axis[axes[name]]
        if (item.shape == "hand") != by_hand:
            problems.append(_beyond_drive(rig.table.drive, (*key, "shape"), item.shape or "cosine ramps"))
        try:
            move = item.resolve(axis, float(rig.table.answer_time))
        except SpecError as error:
            problems += [p.under(*key) for p in error.problems]
            continue
        problems += [p.under(*key) for p in _limits(move, axis)]
        steps.append(PlanStep(axes[name], move, i))
        here[axes[name]] += move.angle
    if poses:
        problems += _unclosed(here, start, axes, "the angles of poses count from zero")
    return tuple(steps), tuple(start), problems


def _unread(item: Section, rig: Rig, key: tuple[str | int, ...]) -> Iterator[Problem]:
    """Keys of a rest or turn that have no effect."""
    if rig.table.standing == "read":
        return
    for name in ("read_every", "other_axes"):
        value = getattr(item, name, None)
        if value is not None and value is not False:
            yield Problem((*key, name), _HELD, str(value))


def _quickest(angle: float, axis: TableAxis, peak_rate: Quantity | None) -> ResolvedMove:
    """The turn of a pose by `angle` (rad)."""
    most = peak_rate if peak_rate is None or peak_rate < axis.max_rate else axis.max_rate
    return Turn(turn=Quantity.of(angle, "rad"), peak_rate=most).resolve(axis, 0.0)


def _unclosed(ends: Sequence[float], start: Sequence[float], axes: Iterable[str], why: str) -> list[Problem]:
    """Problems of axes whose final angle in a cycle differs from the first."""
    problems: list[Problem] = []
    for name, begin, end in zip(axes, start, ends, strict=True):
        if abs((end - begin) / FULL_TURN - round((end - begin) / FULL_TURN)) > 1e-6:
            message = (
                f'the cycle begins with axis "{name}" at {math.degrees(begin):.5g} deg and ends at '
                f"{math.degrees(end):.5g} deg: {why}, so a cycle must return to its initial angle (or end whole turns "
                "away from it): add a pose"
            )
            problems.append(Problem(("cycle", "moves"), message))
    return problems


def _limits(move: ResolvedMove, axis: TableAxis) -> Iterator[Problem]:
    for value, does, unit, name in (
        (move.fastest, "reaches", "deg/s", "max_rate"),
        (move.peak_acceleration, "accelerates at", "deg/s^2", "max_acceleration"),
    ):
        limit: Quantity = getattr(axis, name)
        if value > limit * (1.0 + _SLACK):
            reached = f"{math.degrees(value):.5g} {unit}"
            yield Problem((), f'{does} {reached}, which exceeds {name} of axis "{axis.name}", {limit}', move.words)


def _travel(schedule: PlanSchedule, rig: Rig) -> Iterator[Problem]:
    """Every axis must stay within its travel either way of zero, in every cycle: the first and the last are the
    farthest. Each move that does not, at its farthest."""
    cycles = sum(stretch.cycles for stretch in schedule.stretches)
    for k, axis in enumerate(rig.table.axis):
        steps = [step for step in schedule.steps if step.axis == k]
        net = math.fsum(step.move.angle for step in steps)
        farthest: dict[int, tuple[float, int]] = {}
        for cycle in sorted({0, cycles - 1}):
            at = schedule.start[k] + cycle * net
            for step in steps:
                at += step.move.angle
                most, when = farthest.get(step.source, (axis.travel * (1.0 + 2.0 * _SLACK), cycle))
                if abs(at) > most and when == cycle:
                    farthest[step.source] = abs(at), cycle
        for source, (reach, cycle) in sorted(farthest.items()):
            later = f" in cycle {cycle + 1} (each cycle ends {math.degrees(net):.6g} deg further)" if cycle else ""
            message = (
                f'takes axis "{axis.name}" {math.degrees(reach):.6g} deg from zero{later}; its travel is {axis.travel}'
            )
            yield Problem(("cycle", "moves", source), message)


def _beyond_drive(drive: str, key: tuple[str | int, ...], shape: str) -> Problem:
    if shape == "hand":
        return Problem(key, f'needs a table that is turned by hand, and rig.table.drive is "{drive}"', shape)
    message = (
        'this shape cannot be turned by hand, and rig.table.drive is "hand": expected a turn with shape = "hand" '
        "and a duration"
    )
    return Problem(key, message, shape)
