"""A plan resolved for its rig: the chamber's temperature over time, repetitions of the cycle, number of readings.

There are no arrays here; `gradcal_jax.model` turns a schedule into the core's objects, `check` prints it. Temperatures
are the *chamber's*; the core applies a sensor's thermal lag.
"""

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

from gradcal_jax.formulas import repetitions
from gradcal_jax.spec.bench import Chamber
from gradcal_jax.spec.plan import ChamberCourse, RampItem, SoakItem, StandardPlan
from gradcal_jax.tables.problems import Problem
from gradcal_jax.tables.section import refuse


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


def standard_schedule(plan: StandardPlan) -> StandardSchedule:
    """The points in order: temperatures outside, rates inside; a single rate of zero where the plan has none."""
    rates = (0.0,) if plan.rates is None else tuple(float(rate) for rate in plan.rates)
    temperatures = tuple(float(temperature) for temperature in plan.temperatures)
    return StandardSchedule(float(plan.soak), temperatures, rates, float(plan.integration), plan.points)


def programme_of(
    plan: ChamberCourse, chamber: Chamber, cycle: tuple[float, float] | None
) -> tuple[tuple[TemperatureSegment, ...], tuple[Stretch, ...]]:
    """The chamber's segments, and the stretches of used data with the cycles that fit. `cycle`: durations of its moves
    and of all of it, s. Raises `SpecError`."""
    segments = _programme(plan, chamber) if plan.programme is not None else _ramp(plan)
    return segments, _stretches(segments, cycle)


def _ramp(plan: ChamberCourse) -> tuple[TemperatureSegment, ...]:
    assert plan.temperature is not None
    assert plan.gradient is not None
    segments: list[TemperatureSegment] = []
    clock, here = 0.0, float(plan.temperature[0])
    if plan.soak is not None:
        clock = float(plan.soak)
        segments.append(TemperatureSegment("soak", 0.0, clock, here, here, False))
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
                message = (
                    f"at this point of the programme, the chamber is at {here:.6g} degC: ramp or step to the "
                    "temperature of this soak first"
                )
                problems.append(Problem(("programme", i, "at"), message, item.at.text))
            segments.append(TemperatureSegment("soak", clock, float(item.soak), here, here, item.used))
        else:
            kind, goal = ("ramp", item.ramp_to) if isinstance(item, RampItem) else ("step", item.step_to)
            end = float(goal)
            if end == here:
                problems.append(
                    Problem(("programme", i, f"{kind}_to"), "the chamber is already at this temperature", str(goal))
                )
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
