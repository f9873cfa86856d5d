"""A plan resolved for its rig: the chamber's temperature over time, repetitions of the cycle, number of readings.

There are no arrays here; `gradcal_jax.api` turns a schedule into the core's objects, `check` prints it. Temperatures
are the *chamber's*; the core applies a sensor's thermal lag.
"""

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

from gradcal_jax.files.bench import Chamber, Rig
from gradcal_jax.files.moves import ResolvedMove
from gradcal_jax.files.plan import ChamberCourse, Cycle, GradientPlan, RampItem, SoakItem, StandardPlan
from gradcal_jax.files.problems import Problem, SpecError
from gradcal_jax.files.section import refuse
from gradcal_jax.formulas import reading_count, repetitions

_ROUNDING = 1e-9
MOST_READINGS = 50_000_000
MOST_CYCLES = 1_000_000


@dataclass(frozen=True)
class TemperatureSegment:
    """A stretch of constant slope of the chamber. `start` counts from the beginning of the plan (s)."""

    kind: Literal["soak", "ramp", "step"]
    start: float
    duration: float
    temperature_start: float
    temperature_end: float
    used: bool

    @property
    def end(self) -> float:
        """When the segment ends (s)."""
        return self.start + self.duration

    @property
    def slope(self) -> float:
        """K/s, signed."""
        return (self.temperature_end - self.temperature_start) / self.duration


@dataclass(frozen=True)
class Stretch:
    """Consecutive segments whose data are used. The cycle starts with it and repeats as long as the axis's own moves
    still fit; the axis stands for the rest of the stretch (`leftover`, s)."""

    start: float
    duration: float
    cycles: int
    leftover: float


@dataclass(frozen=True)
class ResolvedCycle:
    """One cycle in SI: the moves one after the other, then the other axes' time, then idle standing (not read).

    `other_read_every` is None where the axis is not read while the others turn; `left_read_every`, of the rest of a
    stretch that no cycle fills, where it is read at its end alone; infinite where it is not read.
    """

    moves: tuple[ResolvedMove, ...]
    moving: float
    other: float
    other_read_every: float | None
    left_read_every: float | None
    idle: float

    @property
    def duration(self) -> float:
        """Duration of the whole cycle (s)."""
        return self.moving + self.other + self.idle


class CourseTimes:
    """Durations of a course of the chamber."""

    segments: tuple[TemperatureSegment, ...]

    @property
    def duration(self) -> float:
        """Of the whole plan (s)."""
        return math.fsum(segment.duration for segment in self.segments)

    @property
    def soak(self) -> float:
        """Time at constant temperature (s)."""
        return math.fsum(segment.duration for segment in self.segments if segment.kind == "soak")

    @property
    def motion(self) -> float:
        """Time of changing temperature (s); `max_motion` of [design] limits it."""
        return self.duration - self.soak


@dataclass(frozen=True)
class GradientSchedule(CourseTimes):
    """A gradient plan in SI. `read_every`: spacing of readings of a standing axis; None where there is a cycle."""

    segments: tuple[TemperatureSegment, ...]
    stretches: tuple[Stretch, ...]
    cycle: ResolvedCycle | None
    read_every: float | None

    @property
    def cycles(self) -> int:
        """Number of cycles in all stretches together."""
        return sum(stretch.cycles for stretch in self.stretches)

    @property
    def readings(self) -> int:
        """Angle readings of the plan, of all axes that turn, the first of each stretch not counted."""
        if self.cycle is None:
            every = self.read_every
            return 0 if every is None else sum(reading_count(stretch.duration, every) for stretch in self.stretches)
        cycle, total = self.cycle, 0

        def while_standing(duration: float) -> int:
            return 0 if cycle.other_read_every is None else reading_count(duration, cycle.other_read_every)

        axes = {move.axis for move in cycle.moves if not move.is_rest} or {"x"}
        for axis in axes:
            stands = [not move.is_rest and move.axis != axis for move in cycle.moves]
            own = sum(
                move.repeat * (while_standing(move.duration) if still else move.readings)
                for move, still in zip(cycle.moves, stands, strict=True)
            )
            for stretch in self.stretches:
                between = max(0, stretch.cycles - 1) * while_standing(cycle.other)
                left = cycle.left_read_every
                after = int(stretch.leftover > 0.0) if left is None else reading_count(stretch.leftover, left)
                total += stretch.cycles * own + between + after
        return total


@dataclass(frozen=True)
class Point:
    """One point of the standard method: `integration` seconds at `temperature` (°C) and `rate` (rad/s)."""

    start: float
    temperature: float
    rate: float
    integration: float


@dataclass(frozen=True)
class StandardSchedule:
    """A standard plan in SI; each temperature begins with `soak` seconds of waiting."""

    points: tuple[Point, ...]
    soak_each: float
    temperatures: tuple[float, ...]
    rates: tuple[float, ...]
    integration: float
    shared: Literal["one run", "independent"] = "one run"

    @property
    def duration(self) -> float:
        """Of the whole plan (s)."""
        return self.soak + self.motion

    @property
    def soak(self) -> float:
        """All soaks together (s)."""
        return self.soak_each * len(self.temperatures)

    @property
    def motion(self) -> float:
        """All integrations together (s)."""
        return self.integration * len(self.points)

    @property
    def readings(self) -> int:
        """One mean rate for each point."""
        return len(self.points)


Schedule = GradientSchedule | StandardSchedule


def standard_schedule(plan: StandardPlan) -> StandardSchedule:
    """The points in order: temperatures outside, rates inside; a single rate of zero where the plan has none."""
    rates = (0.0,) if plan.rates is None else tuple(float(rate) for rate in plan.rates)
    points: list[Point] = []
    clock = 0.0
    for temperature in plan.temperatures:
        clock += plan.soak
        for rate in rates:
            points.append(Point(clock, float(temperature), rate, float(plan.integration)))
            clock += plan.integration
    temperatures = tuple(float(temperature) for temperature in plan.temperatures)
    return StandardSchedule(tuple(points), float(plan.soak), temperatures, rates, float(plan.integration), plan.points)


def gradient_schedule(plan: GradientPlan, rig: Rig) -> GradientSchedule:
    """Resolve a gradient plan. Raises `SpecError` with all problems, keys relative to the plan."""
    cycle = None if plan.cycle is None else resolve_cycle(plan.cycle, rig)
    times = None if cycle is None else (cycle.moving, cycle.duration)
    segments, stretches = programme_of(plan, rig.chamber, times)
    result = GradientSchedule(segments, stretches, cycle, None if plan.read_every is None else float(plan.read_every))
    problems: list[Problem] = []
    key = ("cycle",) if cycle is not None else ("read_every",)
    if cycle is not None and result.cycles == 0:
        longest = max(stretch.duration for stretch in stretches)
        message = f"its moves take {cycle.moving:.4g} s; the longest stretch of used data is {longest:.4g} s"
        problems.append(Problem(("cycle",), message))
    if result.cycles > MOST_CYCLES:
        problems.append(Problem(("cycle",), f"repeats {result.cycles} times; at most {MOST_CYCLES}"))
    elif result.readings > MOST_READINGS:
        message = f"the plan has {result.readings} readings; at most {MOST_READINGS}: read less often"
        problems.append(Problem(key, message))
    elif result.readings == 0:
        problems.append(Problem(key, "the plan has no readings"))
    refuse(*problems)
    return result


def resolve_cycle(cycle: Cycle, rig: Rig) -> ResolvedCycle:
    """Complete the moves and the cycle's time. Raises `SpecError`, keys relative to the plan."""
    moves: list[ResolvedMove] = []
    problems: list[Problem] = []
    for i, move in enumerate(cycle.moves):
        try:
            resolved = move.resolve(float(rig.table.max_acceleration))
            moves.append(resolved.answered(float(rig.table.answer_time)))
        except SpecError as error:
            problems += [problem.under("cycle", "moves", i) for problem in error.problems]
    other, every = 0.0, None
    rests = [move for move in moves if move.is_rest]
    spacings = [move.read_every for move in rests if move.read_every is not None]
    if cycle.other_axes is not None:
        other = float(cycle.other_axes.duration)
        if cycle.other_axes.read:
            if cycle.other_axes.read_every is not None:
                every = float(cycle.other_axes.read_every)
            elif spacings:
                every = spacings[0]
            elif not problems:
                message = "this key is missing: no rest of the cycle says how often a standing axis is read"
                problems.append(Problem(("cycle", "other_axes", "read_every"), message, kind="missing"))
    moving = math.fsum(move.repeat * move.duration for move in moves)
    idle = 0.0
    if cycle.duration is not None and not problems:
        idle = cycle.duration - moving - other
        if idle < -_ROUNDING * cycle.duration:
            message = f"is shorter than the moves and the other axes together, {moving + other:.6g} s"
            problems.append(Problem(("cycle", "duration"), message, cycle.duration.text))
        idle = max(0.0, idle)
    refuse(*problems)
    # An operator types an angle after each turn, and nothing while the axis stands.
    typed = rig.table.drive == "hand" and all(move.read_every is None and not move.read_end for move in rests)
    left = every if every is not None else next(iter(spacings), math.inf if typed else None)
    return ResolvedCycle(tuple(moves), moving, other, every, left, idle)


def programme_of(
    plan: ChamberCourse, chamber: Chamber, cycle: tuple[float, float] | None
) -> tuple[tuple[TemperatureSegment, ...], tuple[Stretch, ...]]:
    """The chamber's segments, and the stretches of used data with the cycles that fit. `cycle`: durations of its moves
    and of all of it, s. Raises `SpecError`."""
    segments = _programme(plan, chamber) if plan.programme is not None else _ramp(plan, cycle)
    return segments, _stretches(segments, cycle)


def _ramp(plan: ChamberCourse, cycle: tuple[float, float] | None) -> tuple[TemperatureSegment, ...]:
    assert plan.temperature is not None
    assert plan.gradient is not None
    segments: list[TemperatureSegment] = []
    clock, here = 0.0, float(plan.temperature[0])
    if plan.soak is not None:
        segments.append(TemperatureSegment("soak", 0.0, float(plan.soak.duration), here, here, plan.soak.used))
        clock = float(plan.soak.duration)
    if isinstance(plan.gradient, tuple):
        assert cycle is not None
        for slope in plan.gradient:
            end = here + slope * cycle[1]
            segments.append(TemperatureSegment("ramp", clock, cycle[1], here, end, True))
            clock, here = clock + cycle[1], end
    else:
        end = float(plan.temperature[1])
        segments.append(TemperatureSegment("ramp", clock, abs(end - here) / plan.gradient, here, end, True))
    return tuple(segments)


def _programme(plan: ChamberCourse, chamber: Chamber) -> tuple[TemperatureSegment, ...]:
    assert plan.programme is not None
    segments: list[TemperatureSegment] = []
    problems: list[Problem] = []
    clock = 0.0
    first = plan.programme[0]
    assert isinstance(first, SoakItem)
    assert first.at is not None
    here = float(first.at)
    for i, item in enumerate(plan.programme):
        if isinstance(item, SoakItem):
            if item.at is not None and item.at != here:
                message = f"the chamber is at {here:.6g} degC by then; ramp or step there first"
                problems.append(Problem(("programme", i, "at"), message, item.at.text))
            segments.append(TemperatureSegment("soak", clock, float(item.soak), here, here, item.used))
        else:
            kind, goal = ("ramp", item.ramp_to) if isinstance(item, RampItem) else ("step", item.step_to)
            end = float(goal)
            if end == here:
                problems.append(Problem(("programme", i, f"{kind}_to"), "the chamber is there already", str(goal)))
                continue
            fastest = chamber.max_heating if end > here else chamber.max_cooling
            slope = item.rate if isinstance(item, RampItem) else fastest
            segments.append(TemperatureSegment(kind, clock, abs(end - here) / slope, here, end, item.used))
        clock, here = segments[-1].end, segments[-1].temperature_end
    refuse(*problems)
    return tuple(segments)


def _stretches(segments: tuple[TemperatureSegment, ...], cycle: tuple[float, float] | None) -> tuple[Stretch, ...]:
    bounds: list[list[float]] = []
    for before, segment in pairwise((None, *segments)):
        assert segment is not None
        if not segment.used:
            continue
        if before is not None and before.used:
            bounds[-1][1] += segment.duration
        else:
            bounds.append([segment.start, segment.duration])
    return tuple(
        Stretch(start, lasts, *((0, lasts) if cycle is None else repetitions(lasts, *cycle))) for start, lasts in bounds
    )
