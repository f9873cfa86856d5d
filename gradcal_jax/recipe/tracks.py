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
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from decimal import Decimal
from typing import Any, Final, Literal, NamedTuple

from gradcal_jax.formulas import RAMPS
from gradcal_jax.spec.bench import Mounting, Rig
from gradcal_jax.spec.moves import ResolvedMove
from gradcal_jax.spec.plan import StandardPlan
from gradcal_jax.spec.schedule import PlanSchedule, TemperatureSegment
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.tables import quantity as q
from gradcal_jax.tables.quantity import Quantity
from gradcal_jax.tables.section import Section
from gradcal_jax.units import dimension_of

Begins = Literal["at its time", "when stable"]
Doing = Literal["rest", "turn", "spin", "turn by hand", "wait"]

_HAIR: Final = 1e-6  # of a step


class Stability(Section):
    """Conditions under which a temperature counts as stable."""

    within: q.PositiveTemperatureDifference = Quantity(0.5, "0.5 K", "temperature difference")
    """A temperature is stable if it deviates from the goal, and changes, by no more than this tolerance."""
    for_at_least: q.Time = Quantity(300.0, "5 min", "time")
    """Time for which the temperature must stay within this tolerance."""
    first_timeout: q.Time = Quantity(14400.0, "4 h", "time")
    """Longest wait before the first segment (the chamber is at room temperature when this wait begins)."""
    timeout: q.Time = Quantity(7200.0, "2 h", "time")
    """Longest wait before each of the other segments."""


@dataclass(frozen=True)
class ChamberSegment:
    """One segment of the chamber's programme. It `begins` at its time (`start` on the plan's clock, which stops while
    the run waits), or when the temperature is stable. `slope`: signed, of a ramp. `used`: its readings are data."""

    name: str
    kind: Literal["soak", "ramp", "step"]
    begins: Begins
    start: Quantity
    duration: Quantity
    temperature_start: Quantity
    temperature_end: Quantity
    used: bool
    slope: Quantity | None = None


@dataclass(frozen=True)
class TrackMove:
    """One move of a block of motion, which begins at `start` of the repetition; "wait": the axis is at rest because
    other axes turn, or because nothing is planned. `acceleration` is that of the trapezoid with the same angle, peak
    rate and duration."""

    start: Quantity
    duration: Quantity
    do: Doing
    axis: str = "x"
    angle: Quantity | None = None
    rate: Quantity | None = None
    acceleration: Quantity | None = None
    read: Literal["end", "none"] | None = None
    read_every: Quantity | None = None


@dataclass(frozen=True)
class MotionBlock:
    """A block of moves that is repeated; the last repetition does not include the waits at its end, but a rest of
    `standing_after`. Of several mountings, `mounting` is the number of this one, and `hang` says it to the operator.
    `start`: angles of the table's axes, outermost first."""

    name: str
    begins_with: str
    moves: tuple[TrackMove, ...]
    repeat: int
    period: Quantity
    standing_after: Quantity
    read_every_after: Quantity | None = None
    mounting: int | None = None
    hang: str | None = None
    start: Mapping[str, Quantity] = field(default_factory=dict[str, Quantity])


class Tracks(NamedTuple):
    """What the chamber does, and what the table does."""

    chamber: tuple[ChamberSegment, ...]
    motion: tuple[MotionBlock, ...]


class ControllerSteps(NamedTuple):
    """The steps of the controllers. The defaults suit this program's drivers; `[rig.resolution]` of a spec replaces
    them. Without a step, accelerations are not rounded."""

    temperature: Quantity = Quantity(0.1, "0.1 K", "temperature difference")
    slope: Quantity = Quantity(0.01 / 60.0, "0.01 K/min", "temperature slope")
    time: Quantity = Quantity(0.1, "0.1 s", "time")
    rate: Quantity = Quantity(math.radians(0.01), "0.01 deg/s", "angular rate")
    angle: Quantity = Quantity(math.radians(0.001), "0.001 deg", "angle")
    acceleration: Quantity | None = None


# A rotary stage that counts accelerations in units of 10 000/1.6384 microsteps/s² has coarse steps: one that divides
# a turn into 1 152 000 microsteps makes 1.907, 3.815, … deg/s².
_ACCELERATION: Final = Quantity.read("1.9073486328125 deg/s^2", "angular acceleration")


def steps_of(spec: Spec) -> ControllerSteps:
    """The steps that a spec's `[rig.resolution]` gives, defaults for the others."""
    own = {} if spec.rig.resolution is None else dict(spec.rig.resolution)
    return ControllerSteps(**{"acceleration": _ACCELERATION} | {k: v for k, v in own.items() if v is not None})


def tracks_of(spec: Spec) -> Tracks:
    """The two tracks of a spec's plan, with accelerations that the table's controller makes."""
    axes = spec.rig.table.axis
    if isinstance(spec.plan, StandardPlan):
        return _standard(spec.plan, axes[0].name)
    segments = _course(spec.executable_schedule.segments)
    strongest = {axis.name: float(axis.max_acceleration) for axis in axes}
    step = steps_of(spec).acceleration

    def makeable(move: TrackMove) -> TrackMove:
        if move.do != "turn" or move.acceleration is None:
            return move
        made = makeable_acceleration(float(move.acceleration), step, strongest[move.axis])
        return replace(move, acceleration=_in("deg/s^2", math.degrees(made)))

    blocks = _blocks(spec.executable_schedule, spec.rig, segments)
    return Tracks(tuple(segments), tuple(replace(b, moves=tuple(map(makeable, b.moves))) for b in blocks))


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
    before: TemperatureSegment | None = None
    for segment in course:
        settled = before is None or (segment.used and not before.used and before.kind in ("soak", "step"))
        segments.append(
            ChamberSegment(
                f"{segment.kind} {1 + sum(other.kind == segment.kind for other in segments)}",
                segment.kind,
                "when stable" if settled else "at its time",
                _in("s", segment.start),
                _in("s", segment.duration),
                _in("degC", segment.temperature_start),
                _in("degC", segment.temperature_end),
                segment.used,
                _in("K/min", 60.0 * segment.slope) if segment.kind == "ramp" else None,
            )
        )
        before = segment
    return segments


def _blocks(schedule: PlanSchedule, rig: Rig, segments: list[ChamberSegment]) -> list[MotionBlock]:
    axes, hung = rig.table.axis, rig.table.mounting
    spacing = min(float(axis.angle.read_every) for axis in axes)
    held, once, typed = rig.table.standing == "held", math.isinf(spacing), rig.table.typed
    moves: list[TrackMove] = []
    clock = 0.0
    for step in (*schedule.steps, *schedule.after):
        move = step.move
        every = spacing if held or move.reads_as_table else move.read_every
        read = _readings(every, at_end=move.read_end and not (held and typed and step.axis < 0))
        own: dict[str, Any] = {"do": "rest"} if step.axis < 0 else {"axis": axes[step.axis].name, **_motion(move)}
        own |= {"do": "wait"} if step.source < 0 else {}
        moves.append(TrackMove(_in("s", clock), _in("s", move.duration), **own, **read))
        clock += move.duration
    start = {axis.name: _in("deg", math.degrees(at)) for axis, at in zip(axes, schedule.start, strict=True)}
    blocks: list[MotionBlock] = []
    for number, stretch in enumerate(schedule.stretches):
        made, period, leftover = moves, schedule.period, stretch.leftover
        if not stretch.cycles:
            period, leftover = stretch.duration, 0.0
            read = _readings(spacing, at_end=not typed)
            made = [TrackMove(_in("s", 0.0), _in("s", period), "rest", **read)]
        left = stretch.leftover if once and not typed and stretch.leftover > 0.0 else spacing
        first = min(segments, key=lambda segment: abs(segment.start - stretch.start))
        place = min(number, len(hung) - 1)
        blocks.append(
            MotionBlock(
                f"motion {number + 1}",
                first.name,
                tuple(made),
                max(stretch.cycles, 1),
                _in("s", period),
                _in("s", leftover),
                None if math.isinf(left) else _in("s", left),
                place + 1 if len(hung) > 1 else None,
                hanging(hung[place], place + 1) if len(hung) > 1 else None,
                start,
            )
        )
    return blocks


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
    ramp = move.ramp
    if move.shape not in RAMPS:
        ramp = move.duration - 2.0 * move.ramp - abs(move.angle / move.peak_rate)
    return abs(move.peak_rate) / ramp


# ------------------------------------------------------------------------------------------------- standard method


def _standard(plan: StandardPlan, axis: str) -> Tracks:
    stay = len(plan.rates or (0.0,)) * plan.integration
    moves: list[TrackMove] = []
    for place, rate in enumerate(plan.rates or (0.0,)):
        what: dict[str, Any] = {"do": "spin", "rate": rate} if rate else {"do": "rest", "read": "end"}
        moves.append(TrackMove(_in("s", place * plan.integration), plan.integration, axis=axis, **what))
    segments: list[ChamberSegment] = []
    blocks: list[MotionBlock] = []
    clock = 0.0
    for number, at in enumerate(plan.temperatures, 1):
        for name, lasts, used in ((f"soak {number}", plan.soak, False), (f"points {number}", _in("s", stay), True)):
            begins: Begins = "when stable" if used or number == 1 else "at its time"
            segments.append(ChamberSegment(name, "soak", begins, _in("s", clock), lasts, at, at, used))
            clock += lasts
        blocks.append(MotionBlock(f"motion {number}", name, tuple(moves), 1, _in("s", stay), _in("s", 0.0)))
    return Tracks(tuple(segments), tuple(blocks))


def _in(unit: str, number: float) -> Quantity:
    """A computed number without its rounding errors (a billionth of the unit)."""
    text = format(Decimal(repr(round(number, 9) + 0.0)).normalize(), "f")
    return Quantity.read(f"{text} {unit}", dimension_of(unit))
