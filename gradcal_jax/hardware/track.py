"""The track that the runner executes: steps of temperature, each with its moves; and that of a recipe.

A run resumes at a step. A step sets the chamber's course and waits until its condition holds (or its time-out ends the
run); then its own time begins, on which its moves start and it ends. A recipe's ramp of hours is cut into the
repetitions of its cycle (or into pieces of ten minutes where the table only stands). Steps of one stretch of data
follow one another without a break; each has the angles, from the axes' zeros, and the temperature at its beginning.
"""

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from gradcal_jax.formulas import reading_count, reading_times
from gradcal_jax.hardware.errors import HardwareError
from gradcal_jax.recipe.recipe import Recipe
from gradcal_jax.recipe.tracks import ChamberSegment, MotionBlock, Stability, TrackMove, read_at_rest
from gradcal_jax.spec.sensor import Sensor
from gradcal_jax.units import to_unit


@dataclass(frozen=True)
class Stable:
    """The temperature (the load's where the chamber measures it, else the air's) stays within `band_k` of its goal and
    changes by at most `band_k` peak to peak, for `for_s`; not later than `timeout_s` after the waiting began."""

    band_k: float
    for_s: float
    timeout_s: float


@dataclass(frozen=True)
class AxisCommand:
    """One command to one axis, `start_s` after the step's own time began.

    "go" moves to the absolute `position_deg`; "turn" moves by `angle_deg` from where the last "go" or "turn" was to
    end, so that errors do not add up; "spin" turns at the signed `rate_dps`; "stop" ends a spin. `answer_s`: what the
    plan gives an operator beside the turning.
    """

    start_s: float
    axis: str
    kind: Literal["go", "turn", "spin", "stop"]
    position_deg: float = 0.0
    rate_dps: float = 0.0
    acceleration_dps2: float = 0.0
    angle_deg: float = 0.0
    answer_s: float = 0.0

    @property
    def duration_s(self) -> float:
        """Duration of a turn, or of a spin's run-up; 0 for a go, which depends on the position before it."""
        if self.acceleration_dps2 <= 0.0:
            return 0.0
        ramp = abs(self.rate_dps) / self.acceleration_dps2
        if self.kind != "turn":
            return ramp
        peak = min(abs(self.rate_dps), math.sqrt(abs(self.angle_deg) * self.acceleration_dps2))
        return abs(self.angle_deg) / peak + peak / self.acceleration_dps2 if peak > 0.0 else 0.0

    def turned_deg(self, after_s: float) -> float:
        """How far a turn is planned to have gone so long after its beginning, with its sign."""
        rest_s = self.duration_s - after_s
        if after_s <= 0.0 or rest_s <= 0.0:
            return 0.0 if after_s <= 0.0 else self.angle_deg
        way = abs(self.angle_deg)
        peak = min(abs(self.rate_dps), math.sqrt(way * self.acceleration_dps2))
        ramp_s = peak / self.acceleration_dps2
        if after_s < ramp_s:
            done = 0.5 * self.acceleration_dps2 * after_s**2
        elif rest_s < ramp_s:
            done = way - 0.5 * self.acceleration_dps2 * rest_s**2
        else:
            done = peak * (after_s - 0.5 * ramp_s)
        return math.copysign(done, self.angle_deg)


@dataclass(frozen=True)
class Course:
    """A command to the chamber, `start_s` into a step; `ramp_k_per_min` None: as fast as it can."""

    start_s: float
    temperature_c: float
    ramp_k_per_min: float | None = None


@dataclass(frozen=True)
class TrackStep:
    """`temperature_c` None leaves the chamber alone; `ramp_k_per_min` None goes there as fast as it can.

    With `ready` the step waits until the temperature is stable at `start_c` (None: at `temperature_c`); then its own
    time begins and the chamber gets its command. `courses` are further commands in the step's own time. A step that
    `follows` begins when the one before ends, and the chamber continues, unless there is a course; where it begins
    separately (after a pause, or when a run is resumed) the chamber first goes to `start_c` and is stable by `again`,
    and the axes go to `start_deg`, as they always do with `goes_there`.

    Of several mountings `hang` is the step's, with number `mounting`, from 1: where the units hang otherwise the
    operator is asked to change it, with the axes at zero and the chamber at a temperature safe for hands; the step's
    own time begins afterwards, or before it with `hangs_meanwhile`. The last `slack_s` make up for late turns by hand.

    The angles of all axes are read at `read_at_s`, and after every turn when the axis stands; where `read_at_s` is
    empty, every `read_every_s`.
    """

    name: str
    duration_s: float
    temperature_c: float | None = None
    ramp_k_per_min: float | None = None
    ready: Stable | None = None
    moves: tuple[AxisCommand, ...] = ()
    read_every_s: float = 1.0
    start_c: float | None = None
    courses: tuple[Course, ...] = ()
    follows: bool = False
    again: Stable | None = None
    start_deg: Mapping[str, float] = field(default_factory=dict[str, float])
    read_at_s: tuple[float, ...] = ()
    slack_s: float = 0.0
    goes_there: bool = False
    hang: str = ""
    mounting: int = 0
    hangs_meanwhile: bool = False
    used: bool = False

    @property
    def data(self) -> bool:
        """Whether its samples are data: also where no angle is read, as in a part of a long rest that is read at its
        end."""
        return self.used or bool(self.read_at_s)

    @property
    def begins_c(self) -> float | None:
        return self.start_c if self.start_c is not None else self.temperature_c

    @property
    def turned_deg(self) -> float | None:
        """How far the axes turn in the step, all turns added up; None where that depends on what was before."""
        if not self.moves or any(move.kind == "go" for move in self.moves):
            return None
        total = 0.0
        for number, move in enumerate(self.moves):
            later = [after.start_s for after in self.moves[number + 1 :] if after.axis == move.axis]
            lasts_s = min(later, default=self.duration_s) - move.start_s
            total += abs(move.angle_deg) if move.kind == "turn" else abs(move.rate_dps) * lasts_s
        return total


@dataclass(frozen=True)
class GyroErrors:
    """By how much a unit's gyros may differ from the table: a share of the angle, and a bias, deg/s."""

    share: float = 0.1
    bias_dps: float = 1.0


@dataclass(frozen=True)
class Track:
    """The whole run. `gyros`: None where the unit has none; `read_at_rest`: axes are read while they stand. Errors:
    `ValueError` for inconsistent times."""

    steps: tuple[TrackStep, ...]
    gyros: GyroErrors | None = GyroErrors()
    read_at_rest: bool = False

    def __post_init__(self) -> None:
        if not self.steps:
            raise ValueError("A track needs at least one step.")
        for step in self.steps:
            starts = [move.start_s for move in step.moves]
            if not (step.duration_s >= 0.0 and step.read_every_s > 0.0) or starts != sorted(starts):
                raise ValueError(
                    f"Step {step.name!r}: durations must not be negative, and moves must be in order of time."
                )
            if starts and not (starts[0] >= 0.0 and starts[-1] <= step.duration_s):
                raise ValueError(f"Step {step.name!r}: every move must start within the step's {step.duration_s:g} s.")
            if step.ready is not None and step.begins_c is None:
                raise ValueError(f"Step {step.name!r} waits for a temperature but sets none.")
            if step.ramp_k_per_min is not None and not step.ramp_k_per_min > 0.0:
                raise ValueError(
                    f"Step {step.name!r}: the rate of a ramp must be above zero; the target temperature gives its "
                    "direction."
                )
        if self.steps[0].follows:
            raise ValueError("The first step cannot follow another step.")

    @property
    def duration_s(self) -> float:
        """The steps' own time, without waiting for their conditions."""
        return sum(step.duration_s for step in self.steps)

    @property
    def moved(self) -> list[str]:
        moved = {move.axis for step in self.steps for move in step.moves}
        return sorted(moved | {name for step in self.steps if step.goes_there for name in step.start_deg})


_LONGEST_STAND_S = 600.0
_BETWEEN_READINGS_S = 10.0
_SPIN_ACCELERATION_DPS2 = 100.0


def track_of(recipe: Recipe, axes: Sequence[str]) -> Track:
    """The track of a recipe for a rig whose axes have these names.

    Axes of recipe and rig match by name; where both have one axis only, these match whatever their names. Raises
    `HardwareError` where an axis is missing.
    """
    names = _names(recipe, axes)
    blocks = {block.begins_with: block for block in recipe.motion}
    stretches: list[tuple[MotionBlock | None, list[ChamberSegment]]] = []
    for segment in recipe.chamber.programme:
        block = blocks.get(segment.name)
        if block is None and segment.used and stretches and stretches[-1][0] is not None:
            stretches[-1][1].append(segment)
        else:
            stretches.append((block, [segment]))
    # A table that is read while it stands is read at the end of its rests, too, as in the plan.
    ends = recipe.spec.rig.table.standing == "read"
    steps: list[TrackStep] = []
    for block, segments in stretches:
        steps += _stretch(block, segments, recipe.stability, names, first=not steps, ends=ends)
    if recipe.spec.rig.chamber.control == "none":
        alone: dict[str, Any] = {"temperature_c": None, "ramp_k_per_min": None, "ready": None, "start_c": None}
        steps = [replace(step, **alone, courses=(), again=None) for step in steps]
        # The temperature does not wait while the units are hung anew: that takes of the unread part before.
        for k, (step, after) in enumerate(itertools.pairwise(steps)):
            if after.mounting and not (step.data or step.mounting):
                own = {"hang": after.hang, "mounting": after.mounting, "start_deg": after.start_deg}
                steps[k] = replace(step, **own, hangs_meanwhile=True, follows=False)
    return Track(tuple(steps), _gyro_errors(recipe.spec.sensor), read_at_rest(recipe.motion))


def _gyro_errors(sensor: Sensor) -> GyroErrors | None:
    """Three standard deviations of what the spec says before the calibration, where that is more than usual."""
    if (gyro := sensor.gyro) is None:
        return None
    usual, bias, scale = GyroErrors(), 0.0, 0.0
    if gyro.bias is not None and isinstance(gyro.bias.prior, float):
        # Of three gyros.
        bias = 3.0 * 3.0**0.5 * to_unit(float(gyro.bias.prior), "deg/s")
    if (section := gyro.scale_factor) is not None and isinstance(section.prior, float):
        scale = 3.0 * float(section.prior) * (section.temperature.size * section.rate.size) ** 0.5
    return GyroErrors(max(usual.share, scale), max(usual.bias_dps, bias))


def _names(recipe: Recipe, axes: Sequence[str]) -> dict[str, str]:
    placed = {name for block in recipe.motion for name in block.start}
    moves = [move for block in recipe.motion for move in block.moves if move.do not in ("rest", "wait")]
    turned = sorted(placed | {move.axis for move in moves})
    if len(turned) == 1 and len(axes) == 1:
        return {turned[0]: axes[0]}
    if missing := [name for name in turned if name not in axes]:
        raise HardwareError(
            f"The recipe turns axis {', '.join(missing)}, and the rig's axes are {', '.join(axes) or 'none'}: use "
            "the names of the recipe for the rig's axes."
        )
    return {name: name for name in turned}


def _stable(stability: Stability, *, first: bool) -> Stable:
    timeout = stability.first_timeout if first else stability.timeout
    return Stable(float(stability.within), float(stability.for_at_least), float(timeout))


def _course(segment: ChamberSegment, start_s: float) -> Course:
    ramp = None if segment.slope is None else abs(float(segment.slope)) * 60.0
    return Course(start_s, float(segment.temperature_end), ramp)


Part = tuple[float, TrackStep]
"""The time at which a step begins (s), on the clock of its stretch, and the step without the chamber."""


def _stretch(
    block: MotionBlock | None,
    segments: Sequence[ChamberSegment],
    stability: Stability,
    names: dict[str, str],
    *,
    first: bool,
    ends: bool,
) -> list[TrackStep]:
    """The steps of a stretch of data; without a block one step, whose samples are not used and whose axes stand."""
    waits = segments[0].begins == "when stable"
    total = math.fsum(float(segment.duration) for segment in segments)
    unread: list[Part] = [(0.0, TrackStep(segments[0].name, total, read_every_s=_BETWEEN_READINGS_S))]
    ends_s = itertools.accumulate((float(segment.duration) for segment in segments), initial=0.0)
    knees = [_course(segment, begins_s) for segment, begins_s in zip(segments, ends_s, strict=False)]
    placed = {} if block is None else block.start
    at = {} if block is None else dict.fromkeys(names.values(), 0.0)
    at |= {names[name]: to_unit(float(angle), "deg") for name, angle in placed.items()}
    steps: list[TrackStep] = []
    for number, (begins_s, part) in enumerate(unread if block is None else _parts(block, total, names, ends=ends)):
        end = begins_s + part.duration_s
        target = [course for course in knees if course.start_s <= begins_s + 1e-6][-1]
        inside = [course for course in knees if not block or begins_s - 1e-6 <= course.start_s < end - 1e-6]
        step = replace(
            part,
            temperature_c=target.temperature_c,
            ramp_k_per_min=target.ramp_k_per_min,
            ready=_stable(stability, first=first) if waits and number == 0 else None,
            start_c=_temperature(segments, begins_s) if block else float(segments[0].temperature_start),
            courses=tuple(replace(course, start_s=course.start_s - begins_s) for course in inside),
            follows=number > 0 or (not waits and not first),
            again=_stable(stability, first=True),  # after a break the chamber may come from anywhere
            start_deg=dict(at),
            goes_there=bool(placed) and number == 0,
            hang=(block and block.hang) or "",
            mounting=(block and block.mounting) or 0,
            used=block is not None,
        )
        steps.append(step)
        for move in part.moves:
            at[move.axis] += move.angle_deg
    return steps


def _temperature(segments: Sequence[ChamberSegment], at_s: float) -> float:
    clock = 0.0
    for segment in segments:
        duration = float(segment.duration)
        if at_s <= clock + duration + 1e-6:
            share = min(max((at_s - clock) / duration, 0.0), 1.0)
            start, end = float(segment.temperature_start), float(segment.temperature_end)
            return start + (end - start) * share if segment.kind != "step" else end
        clock += duration
    return float(segments[-1].temperature_end)


def _parts(block: MotionBlock, total: float, names: dict[str, str], *, ends: bool) -> Iterator[Part]:
    if block.repeat == 1 and len(block.moves) == 1 and block.moves[0].do in ("rest", "wait"):
        yield from _standing(block, total)
        return
    if any(move.do == "spin" for move in block.moves):
        yield from _points(block, names)
        return
    period, after = float(block.period), float(block.standing_after)
    own = [move for move in block.moves if move.do != "wait"]
    busy = math.fsum(move.repeat * float(move.duration) for move in own)
    for number in range(block.repeat):
        last = number == block.repeat - 1
        start, lasts_s = number * period, total - number * period if last else period
        moves: list[AxisCommand] = []
        reads = [0.0] if number == 0 else list[float]()
        cycle_s = None if ends else start
        for move in own if last else block.moves:
            _add(moves, reads, move, names, cycle_s)
        if last and after > 0.0 and block.read_every_after is not None:
            reads += _reads(lasts_s - after, after, float(block.read_every_after), cycle_s)
        name = f"{block.name}, {number + 1} of {block.repeat}" if block.repeat > 1 else block.name
        slack_s = after if last else max(0.0, period - busy)
        yield start, TrackStep(name, lasts_s, moves=tuple(moves), read_at_s=tuple(sorted(reads)), slack_s=slack_s)


def _standing(block: MotionBlock, total: float) -> Iterator[Part]:
    every = block.moves[0].read_every
    times = [0.0, *reading_times(total, None if every is None else float(every))]
    count = max(1, math.ceil(total / _LONGEST_STAND_S - 1e-9))
    for number in range(count):
        start = number * (total / count)
        end = total if number == count - 1 else start + total / count
        inside = [t - start for t in times if start - 1e-9 < t <= end + 1e-9 and (t > start + 1e-9 or number == 0)]
        name = f"{block.name}, {number + 1} of {count}" if count > 1 else block.name
        yield start, TrackStep(name, end - start, read_at_s=tuple(inside))


def _points(block: MotionBlock, names: dict[str, str]) -> Iterator[Part]:
    """The standard method's rates: a step for each; a standstill begins with a stop."""
    axis = next(iter(names.values()), "")
    for number, move in enumerate(block.moves, 1):
        rate, duration = to_unit(float(move.rate or 0.0), "deg/s"), float(move.duration)
        moves: tuple[AxisCommand, ...] = ()
        if rate and axis:
            moves = (AxisCommand(0.0, axis, "spin", rate_dps=rate, acceleration_dps2=_SPIN_ACCELERATION_DPS2),)
        elif axis and number > 1:
            moves = (AxisCommand(0.0, axis, "stop"),)
        reads = (*([0.0] if number == 1 else []), *reading_times(duration, 1.0))
        name = f"{block.begins_with}, rate {number} of {len(block.moves)}"
        yield float(move.start), TrackStep(name, duration, moves=moves, read_at_s=reads)


def _add(
    moves: list[AxisCommand], reads: list[float], move: TrackMove, names: dict[str, str], cycle_s: float | None
) -> None:
    duration = float(move.duration)
    for repetition in range(move.repeat):
        start = float(move.start) + repetition * duration
        if move.do not in ("rest", "wait"):
            moves.append(_command(move, start, names[move.axis]))
        if move.read_every is not None:
            reads += _reads(start, duration, float(move.read_every), cycle_s)
            if cycle_s is None and move.do == "rest" and reads[-1:] != [start + duration]:
                reads.append(start + duration)
        elif move.read == "end":
            reads.append(start + duration)


def _reads(start: float, duration: float, every: float, cycle_s: float | None) -> list[float]:
    """The times of the readings of a move, on the clock of its cycle. `cycle_s`: the begin of the cycle, for a table
    that is held (None: one that is read at the end of its rests): an axis that stands while others move one after
    another is read at even intervals all the time."""
    if cycle_s is None:
        return [start + time for time in reading_times(duration, every)]
    before, after = (reading_count(cycle_s + time, every) for time in (start, start + duration))
    return [k * every - cycle_s for k in range(before + 1, after + 1)]


def _command(move: TrackMove, start: float, axis: str) -> AxisCommand:
    assert move.angle is not None
    assert move.rate is not None
    assert move.acceleration is not None
    angle, rate = to_unit(float(move.angle), "deg"), abs(to_unit(float(move.rate), "deg/s"))
    acceleration = to_unit(float(move.acceleration), "deg/s^2")
    turn = AxisCommand(start, axis, "turn", rate_dps=rate, acceleration_dps2=acceleration, angle_deg=angle)
    # Beyond the rounding of the recipe's numbers.
    more_s = round(float(move.duration) - turn.duration_s, 3)
    return replace(turn, answer_s=max(0.0, more_s)) if move.do == "turn by hand" else turn
