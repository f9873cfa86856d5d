"""The track that the runner executes: its steps, and that of a recipe.

A run resumes at a step: each has the temperature and the axes' angles at its beginning. A recipe's ramp of hours is cut
into the repetitions of its cycle, or into pieces of ten minutes where the table only stands. A step begins when the one
before ends, unless it waits for a stable temperature.
"""

import itertools
import math
from bisect import bisect
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, TypeVar

import numpy as np

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

    "turn" moves by `angle_deg` from where the last turn was to end, so that errors do not add up; "go" is such a turn
    to the start of a step; "spin" turns at the signed `rate_dps`; "stop" ends a spin. `answer_s`: what the plan gives
    an operator beside the turning.
    """

    start_s: float
    axis: str
    kind: Literal["go", "turn", "spin", "stop"]
    angle_deg: float = 0.0
    rate_dps: float = 0.0
    acceleration_dps2: float = 0.0
    answer_s: float = 0.0

    @property
    def _peak_dps(self) -> float:
        return min(abs(self.rate_dps), math.sqrt(abs(self.angle_deg) * self.acceleration_dps2))

    @property
    def duration_s(self) -> float:
        """Duration of a turn; 0 of any other command."""
        peak = self._peak_dps
        return abs(self.angle_deg) / peak + peak / self.acceleration_dps2 if peak > 0.0 else 0.0

    def turned_deg(self, after_s: float) -> float:
        """How far a turn is planned to have gone so long after its beginning, with its sign."""
        left_s, peak = self.duration_s - after_s, self._peak_dps
        if left_s < after_s:
            # It ends as it begins.
            return self.angle_deg - self.turned_deg(left_s)
        going_s, ramp_s = max(after_s, 0.0), peak / self.acceleration_dps2
        ramps = going_s < ramp_s
        done = 0.5 * self.acceleration_dps2 * going_s**2 if ramps else peak * (going_s - 0.5 * ramp_s)
        return math.copysign(done, self.angle_deg)


@dataclass(frozen=True)
class Course:
    """A command to the chamber, `start_s` into a step; `ramp_k_per_min` None: as fast as it can."""

    start_s: float
    temperature_c: float
    ramp_k_per_min: float | None = None


@dataclass(frozen=True)
class TrackStep:
    """A stretch of time with its moves and its commands to the chamber.

    If it waits to be `stable`, the axes first go to `start_deg` and the chamber to `start_c`, and its own time begins
    when the temperature is stable there. So it does by the track's `again` where the step before was interrupted or
    belongs to another session. The last `slack_s` make up for late turns by hand. All angles are read at `read_at_s`,
    and after every turn when the axis stands; where `read_at_s` is empty, every `read_every_s`. `data`: its samples are
    used.
    """

    name: str
    duration_s: float = 0.0
    start_c: float | None = None
    stable: Stable | None = None
    courses: tuple[Course, ...] = ()
    moves: tuple[AxisCommand, ...] = ()
    start_deg: Mapping[str, float] = field(default_factory=dict[str, float])
    read_at_s: tuple[float, ...] = ()
    read_every_s: float = 1.0
    slack_s: float = 0.0
    data: bool = False

    @property
    def turned_deg(self) -> float | None:
        """How far the axes turn in the step, all turns added up; None: nothing turns."""
        total = 0.0
        for number, move in enumerate(self.moves):
            later = [after.start_s for after in self.moves[number + 1 :] if after.axis == move.axis]
            lasts_s = min(later, default=self.duration_s) - move.start_s
            total += abs(move.angle_deg) if move.kind == "turn" else abs(move.rate_dps) * lasts_s
        return total if self.moves else None


@dataclass(frozen=True)
class Ask(TrackStep):
    """The operator is asked to change the mounting, with the axes at zero and the chamber at a temperature safe for
    hands. The time of the step begins with the question."""

    hang: str = ""
    mounting: int = 0


@dataclass(frozen=True)
class GyroErrors:
    """By how much a unit's gyros may differ from the table: a share of the angle, and a bias, deg/s."""

    share: float = 0.1
    bias_dps: float = 1.0


@dataclass(frozen=True)
class Track:
    """The whole run. `again`: how the temperature is stable before a step that is begun anew; `gyros`: None where the
    unit has none; `read_at_rest`: axes are read while they stand."""

    steps: tuple[TrackStep, ...]
    again: Stable | None = None
    gyros: GyroErrors | None = GyroErrors()
    read_at_rest: bool = False

    @property
    def duration_s(self) -> float:
        """The steps' own time, without waiting for their conditions."""
        return sum(step.duration_s for step in self.steps)

    @property
    def moved(self) -> list[str]:
        """The axes that a run moves."""
        moved = {move.axis for step in self.steps for move in step.moves}
        return sorted(moved.union(*(step.start_deg for step in self.steps)))

    def courses_from(self, number: int) -> list[Course]:
        """The commands to the chamber of a step that begins anew: what is in force at its beginning comes first."""
        step = self.steps[number]
        courses = list(step.courses)
        before = [course for step in self.steps[:number] for course in step.courses]
        if before and step.stable is None and not (courses and courses[0].start_s <= 0.0):
            courses.insert(0, replace(before[-1], start_s=0.0))
        return courses


_LONGEST_STAND_S = 600.0
_BETWEEN_READINGS_S = 10.0
_HAIR_S = 1e-6
_SPIN_ACCELERATION_DPS2 = 100.0


def track_of(recipe: Recipe, axes: Sequence[str]) -> Track:
    """The track of a recipe for a rig whose axes have these names.

    Axes of recipe and rig match by name; where both have one axis only, these match whatever their names. Raises
    `HardwareError` where an axis is missing.
    """
    placed = {name for block in recipe.motion for name in block.start}
    moves = [move for block in recipe.motion for move in block.moves if move.do not in ("rest", "wait")]
    turned = sorted(placed | {move.axis for move in moves})
    names = dict(zip(turned, axes if len(turned) == len(axes) == 1 else turned, strict=True))
    if missing := [name for name in names.values() if name not in axes]:
        raise HardwareError(
            f"The recipe turns axis {', '.join(missing)}, and the rig's axes are {', '.join(axes) or 'none'}: use "
            "the names of the recipe for the rig's axes."
        )
    blocks = {block.begins_with: block for block in recipe.motion}
    stretches: list[tuple[MotionBlock | None, list[ChamberSegment]]] = []
    for segment in recipe.chamber:
        block = blocks.get(segment.name)
        if block is None and segment.used and stretches and stretches[-1][0] is not None:
            stretches[-1][1].append(segment)
        else:
            stretches.append((block, [segment]))
    alone = recipe.spec.rig.chamber.control == "none"
    steps: list[TrackStep] = []
    for block, segments in stretches:
        if block is not None and block.hang:
            # A temperature that nobody controls does not wait: the question takes of the unread part before.
            unread = alone and bool(steps) and not steps[-1].data
            before = steps.pop() if unread else TrackStep(f"{block.name}: mounting")
            steps.append(Ask(before.name, before.duration_s, hang=block.hang, mounting=block.mounting or 0))
        steps += _stretch(recipe, block, segments, names)
    if alone:
        steps = [replace(step, start_c=None, stable=None, courses=()) for step in steps]
    again = None if alone else _stable(recipe.stability, first=True)
    return Track(tuple(steps), again, _gyro_errors(recipe.spec.sensor), read_at_rest(recipe.motion))


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


def _stable(stability: Stability, *, first: bool) -> Stable:
    timeout = stability.first_timeout if first else stability.timeout
    return Stable(float(stability.within), float(stability.for_at_least), float(timeout))


def _stretch(
    recipe: Recipe, block: MotionBlock | None, segments: Sequence[ChamberSegment], names: Mapping[str, str]
) -> Iterator[TrackStep]:
    """The steps of a stretch of data, which the cycles of its motion cut; without a block one step, whose samples are
    not used and whose axes stand."""
    begins_s = list(itertools.accumulate((float(segment.duration) for segment in segments), initial=0.0))
    courses: list[Course] = []
    for begin, segment in zip(begins_s, segments, strict=False):
        ramp = None if segment.slope is None else abs(float(segment.slope)) * 60.0
        courses.append(Course(begin, float(segment.temperature_end), ramp))
    knots_c = [float(segments[0].temperature_start), *(course.temperature_c for course in courses)]
    total, stable = begins_s[-1], None
    if segments[0].begins == "when stable":
        stable = _stable(recipe.stability, first=segments[0] is recipe.chamber[0])
    if block is None:
        yield TrackStep(segments[0].name, total, knots_c[0], stable, tuple(courses), read_every_s=_BETWEEN_READINGS_S)
        return
    cuts, moves, reads = _motion(block, total, names, ends=recipe.spec.rig.table.standing == "read")
    at = {name: math.degrees(block.start.get(of, 0.0)) for of, name in names.items()}
    busy = math.fsum(float(move.duration) for move in block.moves if move.do != "wait")
    read = 0
    for number, (begin, end) in enumerate(itertools.pairwise([*cuts, total]), 1):
        # A reading at the end of a turn comes before the turn that begins then: both are the same number.
        first, read = read, bisect(reads, end + _HAIR_S)
        step = TrackStep(
            f"{block.name}, {number} of {len(cuts)}" if len(cuts) > 1 else block.name,
            end - begin,
            float(np.interp(begin, begins_s, knots_c)),
            stable if number == 1 else None,
            _within(courses, begin, end),
            _within(moves, begin, end),
            dict(at),
            tuple(round(time_s - begin, 9) for time_s in reads[first:read]),
            slack_s=float(block.standing_after) if number == len(cuts) else max(0.0, float(block.period) - busy),
            data=True,
        )
        yield step
        for move in step.moves:
            at[move.axis] += move.angle_deg


Timed = TypeVar("Timed", AxisCommand, Course)


def _within(commands: list[Timed], begin: float, end: float) -> tuple[Timed, ...]:
    """The commands of a part, with their times from its beginning on."""
    first, last = (bisect(commands, cut - _HAIR_S, key=lambda command: command.start_s) for cut in (begin, end))
    inside = commands[first:last]
    return tuple(replace(command, start_s=max(round(command.start_s - begin, 9), 0.0)) for command in inside)


def _motion(
    block: MotionBlock, total: float, names: Mapping[str, str], *, ends: bool
) -> tuple[list[float], list[AxisCommand], list[float]]:
    """The moves and readings of a block, and where it is cut: where a cycle or a rate begins, or at even parts of a
    long rest. `ends`: rests are read at their ends; else a table that stands while others move is read at even
    intervals all the time."""
    after = float(block.standing_after)
    rests = block.repeat == 1 and len(block.moves) == 1 and block.moves[0].do in ("rest", "wait")
    spins = any(move.do == "spin" for move in block.moves)
    cycles = [number * float(block.period) for number in range(block.repeat)]
    moves: list[AxisCommand] = []
    reads = [0.0]
    for cycle, move in itertools.product(cycles, block.moves):
        if cycle == cycles[-1] and move.do == "wait" and not rests:
            continue
        start, lasts_s = cycle + float(move.start), float(move.duration)
        moves += _commands(move, start, names, spins=spins)
        every = 1.0 if spins else None if move.read_every is None else float(move.read_every)
        reads += _reads(start, lasts_s, every, ends=ends or spins)
        at_end = move.read == "end" if every is None else ends and move.do == "rest"
        if at_end and not (rests or spins or math.isclose(reads[-1], start + lasts_s, abs_tol=1e-9)):
            reads.append(start + lasts_s)
    if after > 0.0 and block.read_every_after is not None:
        reads += _reads(total - after, after, float(block.read_every_after), ends=ends)
    if spins:
        cycles = [float(move.start) for move in block.moves]
    elif rests:
        count = max(1, math.ceil(total / _LONGEST_STAND_S - 1e-9))
        cycles = [k * (total / count) for k in range(count)]
    return cycles, moves, sorted(reads)


def _reads(start: float, duration: float, every: float | None, *, ends: bool) -> list[float]:
    if ends or every is None:
        return [start + time for time in reading_times(duration, every)]
    before, after = (reading_count(time, every) for time in (start, start + duration))
    return [k * every for k in range(before + 1, after + 1)]


def _commands(move: TrackMove, start: float, names: Mapping[str, str], *, spins: bool) -> list[AxisCommand]:
    rate = to_unit(float(move.rate or 0.0), "deg/s")
    if spins:
        # The standard method's rates; a standstill begins with a stop.
        if rate:
            return [AxisCommand(start, names[move.axis], "spin", 0.0, rate, _SPIN_ACCELERATION_DPS2)]
        return [AxisCommand(start, names[move.axis], "stop")] if start > 0.0 else []
    if move.angle is None or move.acceleration is None:
        return []
    angle, acceleration = to_unit(float(move.angle), "deg"), to_unit(float(move.acceleration), "deg/s^2")
    turn = AxisCommand(start, names[move.axis], "turn", angle, abs(rate), acceleration)
    # Beyond the rounding of the recipe's numbers.
    more_s = round(float(move.duration) - turn.duration_s, 3)
    return [replace(turn, answer_s=max(0.0, more_s)) if move.do == "turn by hand" else turn]
