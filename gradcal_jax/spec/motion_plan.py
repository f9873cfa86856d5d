"""`[plan]` of a whole unit: the chamber's course, and a cycle of rests, turns of one axis, and poses.

A pose has the final angles of axes; it becomes one move of each axis that is elsewhere, outermost first, as fast as the
rig allows (or at `peak_rate`), with cosine ramps. A turn moves one axis by an angle, in any of the shapes of a single
axis; without a shape it has cosine ramps, and without rate and duration it is as fast as the rig allows. A `peak_rate`
without shape and duration is a limit: a short turn does not reach it.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal, cast

from pydantic import BeforeValidator, Field, GetJsonSchemaHandler, ValidationError, model_serializer
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

from gradcal_jax.spec.bench import Rig, RigTable, TableAxis
from gradcal_jax.spec.moves import FULL_TURN, Angled, CosineRamps, Move, ResolvedMove, Rest
from gradcal_jax.spec.plan import ChamberCourse, OtherAxes, StandardPlan
from gradcal_jax.spec.schedule import CourseTimes, Stretch, TemperatureSegment, programme_of
from gradcal_jax.tables.problems import Problem, SpecError, from_validation, hint
from gradcal_jax.tables.quantity import Angle, Count, PositiveRate, Quantity, Temperature, Text, Time
from gradcal_jax.tables.section import Section, chosen_by, read_by, refuse, refuse_misspelt

_SLACK = 1e-6
_HELD = 'has no effect if the table holds its angle at rest: leave this key out, or set rig.table.standing = "read"'
_ONE_REST = "during a rest, all axes rest: leave this key out"
# Spacing of the readings of a rest that is read at its end alone.
_AT_END = math.inf
# A quarter of a period of cosine ramps: peak acceleration times ramp over peak rate.
_STEEPNESS = math.pi / 2.0


class Pose(Section):
    """Move the named axes to these angles, one axis after the other, outermost first."""

    pose: dict[Text, Angle]
    """Angles that the named axes move to; other axes do not move."""
    peak_rate: PositiveRate | None = None
    """Largest rate of the moves; absent: the maximum rate of each axis."""
    rest: Time | None = None
    """Duration of the rest after the moves."""


class QuickTurn(Angled):
    """A turn of one axis with cosine ramps, as fast as the axis's maximum rate and acceleration allow."""

    axis: Text | None = None
    """Name of the table axis; may be absent if the table has only one."""
    peak_rate: PositiveRate | None = None
    """Largest rate of the turn (a short turn can end before it reaches this rate); absent: the maximum rate of the
    axis."""
    repeat: Count = 1
    """Number of times that the turn is made."""


class AxisMove(Section):
    """A rest, or one move of one axis."""

    axis: Text | None = None
    """Name of the table axis; may be absent if the table has only one."""
    move: Move
    """The rest or the turn; in the file, its keys stand in the same table as `axis`."""

    @model_serializer(mode="wrap")
    def _as_written(self, handler: Callable[[Any], Any]) -> dict[str, Any]:
        """The table of the file: the move's own keys beside "axis", without defaults."""
        tables: dict[str, Any] = handler(self)
        return tables.pop("move") | tables

    @classmethod
    def __get_pydantic_json_schema__(cls, schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        """The file's table: a move's keys beside the name of the axis."""
        moves: dict[str, Any] = handler.resolve_ref_schema(handler(schema))["properties"]["move"]
        kinds: list[dict[str, Any]] = []
        for ref in moves["anyOf"]:
            kind = dict(handler.resolve_ref_schema(ref))
            kind["properties"] = kind["properties"] | {"axis": {"type": "string", "minLength": 1}}
            kinds.append(kind)
        return {"anyOf": kinds}


def _choose(whole: Mapping[str, object]) -> object:
    table = dict(whole)
    if "pose" in table:
        return Pose.model_validate(table)
    axis = table.pop("axis", None)
    plain = "rest" not in table and "shape" not in table
    if plain and not {"turn", "turns"} & set(table):
        refuse_misspelt(table, ["rest", "turn", "pose"])
        raise ValueError('expected a rest ("rest"), a turn ("turn", "axis") or a pose ("pose")')
    if plain and not {"duration", "ramp"} & set(table):
        return QuickTurn.model_validate(dict(whole))
    try:
        tables: dict[str, Any] = {"move": CosineRamps.model_validate(table) if plain else table}
        return AxisMove.model_validate(tables if axis is None else {**tables, "axis": axis})
    except ValidationError as error:
        # The move's keys stand in the file beside "axis".
        problems = from_validation(error)
        raise SpecError(replace(p, key=p.key[1:]) if p.key[:1] == ("move",) else p for p in problems) from None


PlanMove = Annotated[Pose | QuickTurn | AxisMove, read_by(_choose)]


class MotionCycle(Section):
    """The motion of the table that is repeated."""

    moves: Annotated[tuple[PlanMove, ...], Field(min_length=1, max_length=2000)]
    """Rests, turns and poses, in the order in which they are made."""
    start: dict[Text, Angle] = Field(default_factory=dict)
    """Angles of the axes at the start of the cycle, by name; absent: zero."""
    other_axes: OtherAxes | None = None
    """Time for which the table serves other sensors at the end of each cycle; only for a table with standing =
    "read"."""
    duration: Time | None = None
    """Duration of a cycle; absent: the sum of its moves and `other_axes`. If the duration is longer than this sum, the
    table rests for the remaining time (without readings if standing = "read")."""


# A list of moves may stand for the cycle.
_of_moves = BeforeValidator(
    lambda value: {"moves": cast("object", value)} if isinstance(value, list) else value,
    json_schema_input_type=MotionCycle | tuple[PlanMove, ...] | None,
)


class MotionPlan(ChamberCourse):
    """The plan of an IMU. If there are several mountings, the mounting changes to the next one before each further part
    of the programme whose data are used. If the programme is a single ramp, it is repeated for each mounting; in
    between, the chamber returns to the start of the ramp."""

    method: Literal["gradient"] = "gradient"
    """The method of the plan."""
    cycle: Annotated[MotionCycle | None, _of_moves] = None
    """Motion that is repeated; absent: the table is at rest, and each axis is read at intervals of its `read_every`."""
    before: Annotated[tuple[Temperature, ...], Field(max_length=100)] = ()
    """Turning points of the sensor's temperature before the plan, in order, such as room temperature; they determine
    the initial state of a hysteresis. Absent: the initial state is unknown."""

    def _problems(self) -> Iterable[Problem]:
        return self.course_problems(with_cycle=self.cycle is not None)


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
    def every_step(self) -> tuple[PlanStep, ...]:
        """The steps one by one, repeated ones as often as they are made."""
        return tuple(step for step in self.steps for _ in range(step.move.repeat))

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
        return sum(step.move.repeat * _rows(step.move, spacing, table) for step in steps)

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
    return math.fsum(step.move.repeat * step.move.duration for step in steps)


def plan_schedule(plan: MotionPlan, rig: Rig) -> PlanSchedule:
    """Resolve a unit's plan. Raises `SpecError` with all problems, keys relative to the plan."""
    if plan.cycle is None:
        segments, stretches = programme_of(plan, rig.chamber, None)
        return PlanSchedule(segments, stretches, (), (0.0,) * len(rig.table.axis))
    steps, start, problems = resolve_steps(plan.cycle, rig)
    refuse(*problems)
    moving, after = duration_of(steps), _after(plan.cycle, duration_of(steps), rig)
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
        turned = ([s.move.repeat * s.move.angle for s in steps if s.axis == k] for k in range(len(start)))
        ends = [math.fsum([angle, *turns]) for angle, turns in zip(start, turned, strict=True)]
        names = [axis.name for axis in rig.table.axis]
        problems += _unclosed(ends, start, names, "the cycle starts again in every part with used data")
    refuse(*problems)
    return schedule


def _after(cycle: MotionCycle, moving: float, rig: Rig) -> tuple[PlanStep, ...]:
    """What fills a cycle behind its moves: the time of other axes, and idle standing. Raises `SpecError`."""
    rests: list[PlanStep] = []
    other, read = 0.0, rig.table.standing == "read"
    if cycle.other_axes is not None:
        refuse(*([] if read else [Problem(("cycle", "other_axes"), _HELD)]))
        other, every = float(cycle.other_axes.duration), cycle.other_axes.read_every
        spacing = float(rig.table.axis[0].angle.read_every if every is None else every)
        move = ResolvedMove("rest", other, read_end=False)
        if cycle.other_axes.read:
            move = replace(move, read_end=math.isinf(spacing), read_every=spacing)
        rests.append(PlanStep(-1, move, -1))
    if cycle.duration is not None:
        idle = cycle.duration - moving - other
        if idle < -_SLACK * cycle.duration:
            message = f"is shorter than the {moving + other:.6g} s of the moves and of the other axes together"
            refuse(Problem(("cycle", "duration"), message, cycle.duration.text))
        if idle > 0.0:
            rests.append(PlanStep(-1, ResolvedMove("rest", idle, read_end=not read), -1))
    return tuple(rests)


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
        if isinstance(item, Pose):
            poses = True
            for name in item.pose:
                known(name, "moves", i, "pose", name)
            for k, axis in enumerate(rig.table.axis):
                goal = item.pose.get(axis.name)
                if goal is not None and abs(goal - here[k]) > 1e-9:
                    if by_hand:
                        problems.append(_beyond_drive(rig.table.drive, (*key, "pose"), "pose"))
                    steps.append(PlanStep(k, quickest_turn(float(goal) - here[k], axis, item.peak_rate), i))
                    here[k] = float(goal)
            if item.rest is not None:
                steps.append(PlanStep(-1, ResolvedMove("rest", float(item.rest)), i))
            continue
        if isinstance(item, AxisMove):
            problems += _unread(item, rig, key)
        if isinstance(item, AxisMove) and isinstance(item.move, Rest):
            move = item.move.resolve(math.inf)
            steps.append(PlanStep(-1, replace(move, read_every=_AT_END) if item.move.read == "end" else move, i))
            continue
        if item.axis is None and len(axes) > 1:
            message = f"this key is missing: which axis turns? {', '.join(axes)}"
            problems.append(Problem((*key, "axis"), message, kind="missing"))
            continue
        name = item.axis if item.axis is not None else next(iter(axes))
        if not known(name, "moves", i, "axis"):
            continue
        axis = rig.table.axis[axes[name]]
        try:
            if isinstance(item, QuickTurn):
                if item.peak_rate is not None and item.peak_rate > axis.max_rate * (1.0 + _SLACK):
                    message = (
                        f'exceeds the maximum rate of axis "{axis.name}", {axis.max_rate}: lower this rate, or '
                        "leave the key out"
                    )
                    problems.append(Problem((*key, "peak_rate"), message, str(item.peak_rate)))
                assert item.angle is not None
                move = replace(quickest_turn(item.angle, axis, item.peak_rate), repeat=item.repeat)
            else:
                move = cast("Any", item.move).resolve(float(axis.max_acceleration))
                move = cast("ResolvedMove", move).answered(float(rig.table.answer_time))
        except SpecError as error:
            problems += [p.under(*key) for p in error.problems]
            continue
        if (move.shape == "hand") != by_hand:
            problems.append(_beyond_drive(rig.table.drive, (*key, "shape"), move.shape))
        problems += [p.under(*key) for p in _limits(move, axis)]
        steps.append(PlanStep(axes[name], move, i))
        here[axes[name]] += move.repeat * move.angle
    if poses:
        problems += _unclosed(here, start, axes, "the angles of poses count from zero")
    return tuple(steps), tuple(start), problems


def _unread(item: AxisMove, rig: Rig, key: tuple[str | int, ...]) -> Iterator[Problem]:
    """Keys of a rest or turn that have no effect."""
    if isinstance(item.move, Rest) and item.axis is not None:
        yield Problem((*key, "axis"), _ONE_REST, item.axis)
    if rig.table.standing == "read":
        return
    for name in ("read", "read_every", "other_axes"):
        if (value := getattr(item.move, name, None)) not in (None, False):
            yield Problem((*key, name), _HELD, str(value))


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


def quickest_turn(angle: float, axis: TableAxis, peak_rate: float | None = None) -> ResolvedMove:
    """A turn with cosine ramps by `angle` (rad), as fast as the axis goes, or at `peak_rate` where it gets that far."""
    size, acceleration = abs(angle), float(axis.max_acceleration)
    most = float(axis.max_rate if peak_rate is None else min(peak_rate, axis.max_rate))
    # Without a flat part θ = A·ramp, ramp = (π/2)·A/a.
    peak = min(most, math.sqrt(size * acceleration / _STEEPNESS))
    ramp = _STEEPNESS * peak / acceleration
    duration, signed = size / peak + ramp, math.copysign(peak, angle)
    sizes: dict[str, Any] = {"ramp": ramp, "peak_acceleration": acceleration, "fastest": peak}
    sizes |= {"low": min(0.0, angle), "high": max(0.0, angle)}
    return ResolvedMove("cosine ramps", max(duration, 2.0 * ramp), angle=angle, peak_rate=signed, **sizes)


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
    """Every axis must stay within its travel either way of zero, and outside forbidden angles, in every cycle: the
    first and the last are the farthest. Each move that does not, at its farthest."""
    cycles = sum(stretch.cycles for stretch in schedule.stretches)
    for k, axis in enumerate(rig.table.axis):
        lowest, highest = axis.reach
        if math.isinf(highest):
            continue
        steps = [step for step in schedule.steps if step.axis == k]
        net = math.fsum(step.move.repeat * step.move.angle for step in steps)
        farthest: dict[int, tuple[float, float, int]] = {}
        for cycle in sorted({0, cycles - 1}):
            at = schedule.start[k] + cycle * net
            for step in steps:
                turned = (step.move.repeat - 1) * step.move.angle
                # Where it begins is where the move before it ends.
                ends = [side for side in (step.move.low, step.move.high) if side]
                for far in (at + begin + end for begin in (0.0, turned) for end in ends):
                    beyond = max(far - highest, lowest - far)
                    if beyond > farthest.get(step.source, (_SLACK * (highest - lowest),))[0] and (
                        cycle == 0 or step.source not in farthest
                    ):
                        farthest[step.source] = beyond, far, cycle
                at += step.move.repeat * step.move.angle
        free = f"the travel of this axis is {axis.travel} in each direction"
        if axis.keep_out is not None:
            low, high = map(math.degrees, axis.reach)
            free = f"this axis must stay between {low:.6g} and {high:.6g} deg"
        for source, (_, reach, cycle) in sorted(farthest.items()):
            later = f" in cycle {cycle + 1} (each cycle ends {math.degrees(net):.6g} deg further)" if cycle else ""
            message = f'takes axis "{axis.name}" {math.degrees(abs(reach)):.6g} deg from zero{later}; {free}'
            yield Problem(("cycle", "moves", source), message)


def _beyond_drive(drive: str, key: tuple[str | int, ...], shape: str) -> Problem:
    if shape == "hand":
        return Problem(key, f'needs a table that is turned by hand, and rig.table.drive is "{drive}"', shape)
    message = (
        'this shape cannot be turned by hand, and rig.table.drive is "hand": expected a turn with shape = "hand" '
        "and a duration"
    )
    return Problem(key, message, shape)
