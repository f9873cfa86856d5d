"""A plan resolved for its rig: the chamber's temperature over time, the steps of the cycle and its repetitions.

There are no arrays here; `gradcal_jax.model` turns a schedule into the core's objects, `check` prints it. Temperatures
are the *chamber's*; the core applies a sensor's thermal lag. A pose becomes one move of each axis that is elsewhere,
outermost first, as fast as the rig allows (or at `peak_rate`), with cosine ramps.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

from gradcal_jax.formulas import repetitions
from gradcal_jax.spec.bench import Chamber, Rig, RigTable, TableAxis
from gradcal_jax.spec.moves import FULL_TURN, Pose, ResolvedMove, Rest, Turn
from gradcal_jax.spec.plan import MotionCycle, MotionPlan, RampItem, SoakItem, StandardPlan
from gradcal_jax.tables.problems import Key, Problem, SpecError, hint
from gradcal_jax.tables.quantity import Quantity
from gradcal_jax.tables.section import refuse

_SLACK = 1e-6


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
class StandardSchedule:
    """A standard plan in SI; each temperature begins with `soak` seconds of waiting."""

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
        return self.integration * self.readings

    @property
    def readings(self) -> int:
        """One mean rate for each point."""
        return len(self.temperatures) * len(self.rates)


@dataclass(frozen=True)
class PlanStep:
    """A step of the cycle in SI: `axis` is the table axis's number, −1 for a rest. `source`: which move of the file."""

    axis: int
    move: ResolvedMove
    source: int


@dataclass(frozen=True)
class PlanSchedule:
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

    def rows(*moves: ResolvedMove) -> int:
        if table.standing == "held":
            return len(moves)
        return sum((replace(m, read_every=spacing) if m.reads_as_table else m).readings for m in moves)

    cycle, after = (rows(*(step.move for step in steps)) for steps in (schedule.steps, schedule.after))
    total = 0
    for stretch in schedule.stretches:
        total += stretch.cycles * cycle + max(0, stretch.cycles - 1) * after
        stands = stretch.leftover if stretch.cycles else stretch.duration
        if stands > 0.0 and (table.standing == "held" or not table.typed):
            # What no cycle fills has no reading at its end beside spaced ones.
            total += rows(ResolvedMove("rest", stands, read_end=math.isinf(spacing), read_every=spacing))
    return total


def duration_of(steps: Iterable[PlanStep]) -> float:
    """Duration of steps (s)."""
    return math.fsum(step.move.duration for step in steps)


def standard_schedule(plan: StandardPlan) -> StandardSchedule:
    """The points in order: temperatures outside, rates inside; a single rate of zero where the plan has none."""
    rates = (0.0,) if plan.rates is None else tuple(float(rate) for rate in plan.rates)
    temperatures = tuple(float(temperature) for temperature in plan.temperatures)
    return StandardSchedule(float(plan.soak), temperatures, rates, float(plan.integration), plan.points)


def plan_schedule(plan: MotionPlan, rig: Rig) -> PlanSchedule:
    """Resolve a unit's plan. Raises `SpecError` with all problems, keys relative to the plan."""
    segments, problems = _segments(plan, rig.chamber)
    if plan.cycle is None:
        refuse(*problems)
        return PlanSchedule(segments, _stretches(segments, None), (), (0.0,) * len(rig.table.axis))
    steps, after, start, of_cycle = _steps(plan.cycle, rig)
    refuse(*problems, *of_cycle)
    moving, mountings = duration_of(steps), len(rig.table.mounting)
    stretches = _stretches(segments, (moving, moving + duration_of(after)))
    if mountings > 1 and len(stretches) == 1 and plan.programme is None:
        segments, stretches = _once_each(segments, stretches[0], mountings, rig.chamber)
    elif mountings > 1 and len(stretches) != mountings:
        message = (
            f"has {len(stretches)} parts with used data, and there are {mountings} mountings: expected one part for "
            "each mounting"
        )
        refuse(Problem(("programme",), message))
    cycles = sum(stretch.cycles for stretch in stretches)
    if not cycles:
        longest = max(stretch.duration for stretch in stretches)
        message = (
            f"the moves of a cycle take {moving:.4g} s, longer than every part with used data; the longest has "
            f"{longest:.4g} s"
        )
        refuse(Problem(("cycle",), message))
    if cycles * len(steps) > 200_000:
        message = "the plan makes more than 200000 moves in total: lengthen the rests or turns of the cycle"
        refuse(Problem(("cycle",), message))
    schedule = PlanSchedule(segments, stretches, steps, start, after)
    again = len(stretches) > 1 and (mountings > 1 or len(start) > 1)
    if any(isinstance(move, Pose) for move in plan.cycle.moves):
        problems += _unclosed(schedule, rig, "the angles of poses count from zero")
    elif again:
        problems += _unclosed(schedule, rig, "the cycle starts again in every part with used data")
    refuse(*_travel(schedule, rig, cycles), *problems)
    return schedule


def _segments(plan: MotionPlan, chamber: Chamber) -> tuple[tuple[TemperatureSegment, ...], list[Problem]]:
    """The chamber's segments, and where they contradict the chamber or each other."""
    problems: list[Problem] = []
    (low, high), clock = chamber.range, 0.0

    def check_range(goal: Quantity, *key: str | int) -> None:
        if not low <= goal <= high:
            problems.append(Problem(key, f"is outside the chamber's range, {low} to {high}", goal.text))

    if plan.programme is not None:
        items = list(plan.programme)
        here = items[0].at if isinstance(items[0], SoakItem) else None
        assert here is not None
        check_range(here, "programme", 0, "at")
    else:
        assert plan.temperature is not None
        assert plan.gradient is not None
        here, end = plan.temperature
        check_range(here, "temperature", 0)
        soaks = [] if plan.soak is None else [SoakItem(soak=plan.soak)]
        items = [*soaks, RampItem(ramp_to=end, rate=plan.gradient)]
    segments: list[TemperatureSegment] = []
    for i, item in enumerate(items):
        key: Key = ("programme", i)
        if isinstance(item, SoakItem):
            kind, goal, lasts = "soak", here, float(item.soak)
            if item.at is not None and item.at != here:
                message = (
                    f"at this point of the programme, the chamber is at {here:.6g} degC: ramp or step to the "
                    "temperature of this soak first"
                )
                problems.append(Problem((*key, "at"), message, item.at.text))
        else:
            kind, goal = ("ramp", item.ramp_to) if isinstance(item, RampItem) else ("step", item.step_to)
            of_goal, of_slope = (*key, f"{kind}_to"), (*key, "rate")
            if plan.programme is None:
                of_goal, of_slope = ("temperature", 1), ("gradient",)
            check_range(goal, *of_goal)
            if goal == here:
                problems.append(Problem(of_goal, "the chamber is already at this temperature", goal.text))
                continue
            name = "max_heating" if goal > here else "max_cooling"
            limit: Quantity = getattr(chamber, name)
            slope = item.rate if isinstance(item, RampItem) else limit
            if slope > limit * (1.0 + _SLACK):
                problems.append(Problem(of_slope, f"exceeds rig.chamber.{name}, {limit}", slope.text))
            lasts = abs(goal - here) / slope
        segments.append(TemperatureSegment(kind, clock, lasts, float(here), float(goal), item.used))
        clock, here = segments[-1].end, goal
    return tuple(segments), problems


def _stretches(segments: Sequence[TemperatureSegment], cycle: tuple[float, float] | None) -> tuple[Stretch, ...]:
    """The stretches of used data with the cycles that fit. `cycle`: durations of its moves and of all of it, s."""
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


def _once_each(
    segments: tuple[TemperatureSegment, ...], stretch: Stretch, mountings: int, chamber: Chamber
) -> tuple[tuple[TemperatureSegment, ...], tuple[Stretch, ...]]:
    """The course once with each mounting; the chamber returns as fast as it can."""
    first, last = segments[0], segments[-1]
    change = first.temperature_start - last.temperature_end
    pace = chamber.max_heating if change > 0.0 else chamber.max_cooling
    ends = last.temperature_end, first.temperature_start
    back = TemperatureSegment("step", last.end, abs(change) / pace, *ends, False)
    whole = back.end
    course = [replace(s, start=s.start + k * whole) for k in range(mountings) for s in (*segments, back)]
    # After the last mounting the chamber need not return.
    return tuple(course[:-1]), tuple(replace(stretch, start=stretch.start + k * whole) for k in range(mountings))


def _steps(
    cycle: MotionCycle, rig: Rig
) -> tuple[tuple[PlanStep, ...], tuple[PlanStep, ...], tuple[float, ...], list[Problem]]:
    """The steps of a cycle, those behind them, the angles (rad) at which it begins, and what is wrong with them."""
    table, problems, after = rig.table, list[Problem](), tuple[PlanStep, ...]()
    axes, by_hand = {axis.name: k for k, axis in enumerate(table.axis)}, table.drive == "hand"
    start, steps = [0.0] * len(axes), list[PlanStep]()

    def number(name: str, *key: str | int) -> int | None:
        """The number of the axis of this name; a problem where there is none."""
        if name not in axes:
            ending = hint(name, axes, f"; known: {', '.join(axes)}")
            problems.append(Problem(("cycle", *key), f"the table has no axis of this name{ending}", name))
        return axes.get(name)

    for name, angle in cycle.start.items():
        if (k := number(name, "start", name)) is not None:
            start[k] = float(angle)
    here = list(start)
    for i, item in enumerate(cycle.moves):
        key: Key = ("cycle", "moves", i)
        for name in ("read_every", "other_axes") if table.standing == "held" else ():
            if value := getattr(item, name, None):
                problems.append(Problem((*key, name), _HELD, str(value)))
        if isinstance(item, Rest):
            steps.append(PlanStep(-1, item.resolve(), i))
        elif isinstance(item, Pose):
            if by_hand:
                problems.append(Problem((*key, "pose"), _BY_HAND, "pose"))
            goals = {number(name, "moves", i, "pose", name): float(goal) for name, goal in item.pose.items()}
            for k, axis in enumerate(table.axis):
                if k in goals and abs(goals[k] - here[k]) > 1e-9:
                    steps.append(PlanStep(k, _quickest(goals[k] - here[k], axis, item.peak_rate), i))
                    here[k] = goals[k]
            if item.rest is not None:
                steps.append(PlanStep(-1, ResolvedMove("rest", float(item.rest)), i))
        elif item.axis is None and len(axes) > 1:
            message = f"this key is missing: which axis turns? {', '.join(axes)}"
            problems.append(Problem((*key, "axis"), message, kind="missing"))
        elif (k := number(item.axis or table.axis[0].name, "moves", i, "axis")) is not None:
            if (item.shape == "hand") != by_hand:
                message = _BY_HAND if by_hand else 'needs a table that is turned by hand: rig.table.drive = "hand"'
                problems.append(Problem((*key, "shape"), message, item.shape or "cosine ramps"))
            try:
                steps.append(PlanStep(k, item.resolve(table.axis[k], float(table.answer_time)), i))
            except SpecError as error:
                problems += [problem.under(*key) for problem in error.problems]
            here[k] += float(item.turn)
    if (others := cycle.other_axes) is not None:
        if table.standing == "held":
            problems.append(Problem(("cycle", "other_axes"), _HELD))
        every = others.read_every
        move = ResolvedMove("rest", float(others.duration), read_end=every is not None and math.isinf(every))
        after = (PlanStep(-1, replace(move, read_every=None if every is None else float(every)), -1),)
    return tuple(steps), after, tuple(start), problems


_HELD = 'has no effect if the table holds its angle at rest: leave this key out, or set rig.table.standing = "read"'
_BY_HAND = 'cannot be turned by hand, and rig.table.drive is "hand": expected a turn with shape = "hand" and a duration'


def _quickest(angle: float, axis: TableAxis, peak_rate: Quantity | None) -> ResolvedMove:
    """The turn of a pose by `angle` (rad)."""
    most = peak_rate if peak_rate is None or peak_rate < axis.max_rate else axis.max_rate
    return Turn(turn=Quantity.of(angle, "rad"), peak_rate=most).resolve(axis, 0.0)


def _unclosed(schedule: PlanSchedule, rig: Rig, why: str) -> Iterator[Problem]:
    """Axes whose final angle in a cycle differs from the first."""
    for k, (axis, begin) in enumerate(zip(rig.table.axis, schedule.start, strict=True)):
        end = math.fsum([begin, *(step.move.angle for step in schedule.steps if step.axis == k)])
        if abs((end - begin) / FULL_TURN - round((end - begin) / FULL_TURN)) > 1e-6:
            message = (
                f'the cycle begins with axis "{axis.name}" at {math.degrees(begin):.5g} deg and ends at '
                f"{math.degrees(end):.5g} deg: {why}, so a cycle must return to its initial angle (or end whole turns "
                "away from it): add a pose"
            )
            yield Problem(("cycle", "moves"), message)


def _travel(schedule: PlanSchedule, rig: Rig, cycles: int) -> Iterator[Problem]:
    """Every axis must stay within its travel either way of zero, in every cycle: the first and the last are the
    farthest."""
    for k, axis in enumerate(rig.table.axis):
        steps, refused = [step for step in schedule.steps if step.axis == k], set[int]()
        net = math.fsum(step.move.angle for step in steps)
        for cycle in sorted({0, cycles - 1}):
            at = schedule.start[k] + cycle * net
            for step in steps:
                at += step.move.angle
                if step.source in refused or abs(at) <= axis.travel * (1.0 + 2.0 * _SLACK):
                    continue
                refused.add(step.source)
                later = f" in cycle {cycle + 1} (each cycle ends {math.degrees(net):.6g} deg further)" if cycle else ""
                message = (
                    f'takes axis "{axis.name}" {math.degrees(abs(at)):.6g} deg from zero{later}; its travel is '
                    f"{axis.travel}"
                )
                yield Problem(("cycle", "moves", step.source), message)
