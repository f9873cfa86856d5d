"""A plan as two executable tracks: the chamber's segments, and the table's blocks of motion.

A temperature segment begins at its time, which is the end of the one before, or when the temperature is stable: the
first one, and every one whose data are used and that follows a soak or a step. A block of motion begins with a segment
and repeats its moves; times in it count from the beginning of each repetition.

Axes of the table turn one at a time, and all are read at the shortest interval of their encoders; a block has their
first angles and, of several mountings, the device's.

The controllers of rotary stages turn by trapezoids of the rate. `acceleration` is that of the trapezoid with the move's
angle, peak rate and duration, or a spline's largest.
"""

import math
from collections.abc import Sequence
from decimal import Decimal
from typing import Annotated, Any, Final, Literal

from pydantic import Field

from gradcal_jax.spec.bench import Mounting, Rig
from gradcal_jax.spec.moves import ResolvedMove
from gradcal_jax.spec.plan import StandardPlan
from gradcal_jax.spec.rig import Name
from gradcal_jax.spec.schedule import PlanSchedule, Stretch, TemperatureSegment
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.tables import quantity as q
from gradcal_jax.tables.section import Section
from gradcal_jax.units import dimension_of

Begins = Literal["at its time", "when stable"]
Doing = Literal["rest", "turn", "spin", "turn by hand", "wait"]

_HAIR: Final = 1e-6  # of a step


class Stability(Section):
    """Conditions under which a temperature counts as stable."""

    within: q.PositiveTemperatureDifference = q.Quantity(0.5, "0.5 K", "temperature difference")
    """A temperature is stable if it deviates from the goal, and changes, by no more than this tolerance."""
    for_at_least: q.Time = q.Quantity(300.0, "5 min", "time")
    """Time for which the temperature must stay within this tolerance."""
    first_timeout: q.Time = q.Quantity(14400.0, "4 h", "time")
    """Longest wait before the first segment (the chamber is at room temperature when this wait begins)."""
    timeout: q.Time = q.Quantity(7200.0, "2 h", "time")
    """Longest wait before each of the other segments."""


class ChamberSegment(Section):
    """One segment of the chamber's programme."""

    name: q.Text
    """Name of the segment; blocks of motion refer to it."""
    kind: Literal["soak", "ramp", "step"]
    """What the chamber does: stay (soak), ramp, or step as fast as it can."""
    begins: Begins
    """Whether the segment begins at its time, or when the temperature is stable."""
    start: q.SizeOfTime
    """Start of the segment on the plan's clock (this clock stops while the run waits)."""
    duration: q.Time
    """Duration of the segment."""
    temperature_start: q.Temperature
    """Temperature at the start."""
    temperature_end: q.Temperature
    """Temperature at the end."""
    slope: q.TemperatureSlope | None = None
    """Signed slope of a ramp; absent: the temperature is constant, or changes at the chamber's maximum rate."""
    used: q.Flag
    """Whether the readings in this segment are part of the data."""


class TrackMove(Section):
    """One move of a block of motion."""

    start: q.SizeOfTime
    """Start of the move, counted from the start of the repetition."""
    do: Doing
    """What the axis does; "wait": the axis is at rest because other axes turn, or because nothing is planned."""
    duration: q.Time
    """Duration of the move."""
    axis: Name = "x"
    """Axis of the table."""
    angle: q.Angle | None = None
    """Angle by which the axis turns; its sign is the direction."""
    rate: q.Rate | None = None
    """Largest rate of the move."""
    acceleration: q.PositiveAcceleration | None = None
    """Acceleration of the trapezoid with the same angle, peak rate and duration."""
    shape: q.Text | None = None
    """Shape of the planned rate over time."""
    read: Literal["end", "none"] | None = None
    """"end": one reading at the end of the move; "none": no reading."""
    read_every: q.Time | None = None
    """Time between readings during the move."""


class MotionBlock(Section):
    """A block of moves that is repeated. The last repetition does not include the waits at its end."""

    name: q.Text
    """Name of the block."""
    begins_with: q.Text
    """Name of the chamber's segment with which the block begins."""
    repeat: q.Count
    """Number of repetitions."""
    period: q.Time
    """Time from the start of one repetition to the start of the next."""
    standing_after: q.SizeOfTime
    """Duration of the rest after the last repetition."""
    read_every_after: q.Time | None = None
    """Time between readings during this rest; absent: no readings."""
    mounting: q.Count | None = None
    """If there are several mountings: the index of the mounting, counted from 1."""
    hang: q.Text | None = None
    """The mounting on the table, in words, if it changes before this block; the operator is asked to change it."""
    start: dict[Name, q.Angle] = Field(default_factory=dict)
    """Angles of the table's axes at the start of the block, outermost first."""
    moves: Annotated[tuple[TrackMove, ...], Field(min_length=1)]
    """Moves, one after the other."""


class ChamberTrack(Section):
    """`[chamber]` of a recipe: what the chamber does."""

    programme: Annotated[tuple[ChamberSegment, ...], Field(min_length=1)]
    """Segments of the chamber, in order."""


def tracks_of(spec: Spec, acceleration_step: float | None = None) -> tuple[ChamberTrack, tuple[MotionBlock, ...]]:
    """The two tracks of a spec's plan. `acceleration_step` of the table's controller, rad/s²; None: it makes any."""
    axes = spec.rig.table.axis
    if isinstance(spec.plan, StandardPlan):
        return _standard(spec.plan, axes[0].name)
    segments = _course(spec.executable_schedule.segments)
    blocks = _blocks(spec.executable_schedule, spec.rig, segments)
    if acceleration_step is not None:
        strongest = {axis.name: float(axis.max_acceleration) for axis in axes}

        def makeable(move: TrackMove) -> TrackMove:
            """The move with an acceleration that the controller makes."""
            if move.do != "turn" or move.acceleration is None:
                return move
            made = makeable_acceleration(float(move.acceleration), acceleration_step, strongest[move.axis])
            return move.model_copy(update={"acceleration": _in("deg/s^2", math.degrees(made))})

        blocks = tuple(b.model_copy(update={"moves": tuple(map(makeable, b.moves))}) for b in blocks)
    return ChamberTrack(programme=tuple(segments)), blocks


def read_at_rest(blocks: Sequence[MotionBlock]) -> bool:
    """Whether axes are read while they stand: of one that an operator turns, that takes an encoder."""
    return any(
        block.read_every_after is not None
        or any(move.read_every is not None or (move.do == "rest" and move.read == "end") for move in block.moves)
        for block in blocks
    )


# ------------------------------------------------------------------------------------------------- gradient method


def _course(course: Sequence[TemperatureSegment]) -> list[ChamberSegment]:
    segments: list[ChamberSegment] = []
    counts: dict[str, int] = {}
    before: TemperatureSegment | None = None
    for segment in course:
        counts[segment.kind] = counts.get(segment.kind, 0) + 1
        settled = before is None or (segment.used and not before.used and before.kind in ("soak", "step"))
        slope: dict[str, Any] = {"slope": _in("K/min", 60.0 * segment.slope)} if segment.kind == "ramp" else {}
        segments.append(
            ChamberSegment(
                name=f"{segment.kind} {counts[segment.kind]}",
                kind=segment.kind,
                begins="when stable" if settled else "at its time",
                start=_in("s", segment.start),
                duration=_in("s", segment.duration),
                temperature_start=_in("degC", segment.temperature_start),
                temperature_end=_in("degC", segment.temperature_end),
                used=segment.used,
                **slope,
            )
        )
        before = segment
    return segments


def _block(
    number: int, begins_with: str, moves: Sequence[TrackMove], period: float, after: float = 0.0, **more: Any
) -> MotionBlock:
    """A block of `period` s, after which the axis stands for `after` s."""
    times: dict[str, Any] = {"repeat": 1, "period": _in("s", period), "standing_after": _in("s", after)}
    return MotionBlock(name=f"motion {number}", begins_with=begins_with, moves=tuple(moves), **times | more)


def _line(start: float, duration: float, **what: Any) -> TrackMove:
    return TrackMove(start=_in("s", start), duration=_in("s", duration), **what)


def _first(stretch: Stretch, segments: list[ChamberSegment]) -> str:
    return min(segments, key=lambda segment: abs(segment.start - stretch.start)).name


def _blocks(schedule: PlanSchedule, rig: Rig, segments: list[ChamberSegment]) -> tuple[MotionBlock, ...]:
    axes, hung = rig.table.axis, rig.table.mounting
    spacing = min(float(axis.angle.read_every) for axis in axes)
    held, once = rig.table.standing == "held", math.isinf(spacing)
    typed = rig.table.typed
    moves: list[TrackMove] = []
    clock = 0.0
    for step in (*schedule.steps, *schedule.after):
        move = step.move
        own: dict[str, Any] = {"do": "rest"} if step.axis < 0 else {"axis": axes[step.axis].name, **_motion(move)}
        if step.source < 0:
            own["do"] = "wait"
        every, ends = spacing if held or move.reads_as_table else move.read_every, move.read_end
        moves.append(
            _line(
                clock, move.duration, **own, **_readings(every, at_end=ends and not (held and typed and step.axis < 0))
            )
        )
        clock += move.duration
    blocks: list[MotionBlock] = []
    for number, stretch in enumerate(schedule.stretches):
        where = min(number, len(hung) - 1)
        hang: dict[str, Any] = {}
        if len(hung) > 1:
            hang = {"mounting": where + 1, "hang": hanging(hung[where], where + 1)}
        start = {axis.name: _in("deg", math.degrees(at)) for axis, at in zip(axes, schedule.start, strict=True)}
        left = stretch.leftover if once and not typed and stretch.leftover > 0.0 else spacing
        after: dict[str, Any] = {} if math.isinf(left) else {"read_every_after": _in("s", left)}
        more: dict[str, Any] = {**hang, "start": start, "repeat": max(stretch.cycles, 1), **after}
        first = _first(stretch, segments)
        if stretch.cycles:
            blocks.append(_block(number + 1, first, moves, schedule.period, stretch.leftover, **more))
        else:
            standing = _line(0.0, stretch.duration, do="rest", **_readings(spacing, at_end=not typed))
            blocks.append(_block(number + 1, first, [standing], stretch.duration, **more))
    return tuple(blocks)


def _readings(every: float | None, *, at_end: bool) -> dict[str, Any]:
    """The readings of a rest or turn: spaced, or one at its end (`every` None or infinite), or none."""
    if every is None or math.isinf(every):
        return {"read": "end" if at_end else "none"}
    return {"read_every": _in("s", every)}


def hanging(mounting: Mounting, number: int) -> str:
    """The mounting of a unit in words, for the operator; directions are the innermost axis's while all are at zero.

    ``mounting 2 (on its side): x along +y, y along -x, z along +z``
    """
    name = "" if mounting.name is None else f" ({mounting.name})"
    text = f"mounting {number}{name}: x along {mounting.x}, y along {mounting.y}, z along {mounting.z}"
    if mounting.rotation is None:
        return text
    return f"{text}, then rotated by {', '.join(angle.text for angle in mounting.rotation)} about its x, y and z"


def _motion(move: ResolvedMove) -> dict[str, Any]:
    return {
        "do": "turn by hand" if move.shape == "hand" else "turn",
        "angle": _in("deg", math.degrees(move.angle)),
        "rate": _in("deg/s", math.degrees(move.peak_rate)),
        "acceleration": _in("deg/s^2", trapezoid_acceleration(move) * 180.0 / math.pi),
        "shape": move.shape,
    }


def makeable_acceleration(acceleration: float, step: float | None, steepest: float = math.inf) -> float:
    """The next multiple of a controller's `step` up, the next down where that exceeds the `steepest`; unchanged where
    the table is weaker than a step. All in rad/s²."""
    if step is None or step > steepest:
        return acceleration
    # A multiple that rounding errors of the arithmetic raise or lower stays what it is.
    return step * min(math.ceil(acceleration / step - _HAIR), math.floor(min(steepest / step, 1e12) + _HAIR))


def trapezoid_acceleration(move: ResolvedMove) -> float:
    """Acceleration of the trapezoid with a move's angle, peak rate and duration (rad/s²)."""
    return abs(move.peak_rate) / (0.5 * move.duration - move.ramp if move.shape == "hand" else move.ramp)


# ------------------------------------------------------------------------------------------------- standard method


def _standard(plan: StandardPlan, axis: str) -> tuple[ChamberTrack, tuple[MotionBlock, ...]]:
    rates = plan.rates or (_in("deg/s", 0.0),)
    stay = len(rates) * plan.integration
    segments: list[ChamberSegment] = []
    blocks: list[MotionBlock] = []
    clock = 0.0
    for number, temperature in enumerate(plan.temperatures, 1):
        at: dict[str, Any] = {"kind": "soak", "temperature_start": temperature, "temperature_end": temperature}
        soak: Begins = "when stable" if number == 1 else "at its time"
        at |= {"start": _in("s", clock), "duration": plan.soak}
        segments.append(ChamberSegment(name=f"soak {number}", begins=soak, used=False, **at))
        clock += plan.soak
        points = f"points {number}"
        at |= {"start": _in("s", clock), "duration": _in("s", stay)}
        segments.append(ChamberSegment(name=points, begins="when stable", used=True, **at))
        clock += stay
        moves: list[TrackMove] = []
        for place, rate in enumerate(rates):
            what: dict[str, Any] = {"do": "spin", "rate": rate} if rate else {"do": "rest", "read": "end"}
            moves.append(
                TrackMove(axis=axis, start=_in("s", place * plan.integration), duration=plan.integration, **what)
            )
        blocks.append(_block(number, points, moves, stay))
    return ChamberTrack(programme=tuple(segments)), tuple(blocks)


def _in(unit: str, number: float) -> q.Quantity:
    """A computed number without its rounding errors (a billionth of the unit)."""
    text = format(Decimal(repr(round(number, 9) + 0.0)).normalize(), "f")
    return q.Quantity.read(f"{text} {unit}", dimension_of(unit))
