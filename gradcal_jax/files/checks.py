"""Checks of a plan against chamber, table and sensor, and of requirements against the maps."""

import math
from collections.abc import Iterator, Sequence

from gradcal_jax.files.bench import Chamber, TableAxis
from gradcal_jax.files.plan import ChamberCourse, RampItem, StandardPlan
from gradcal_jax.files.problems import Key, Problem
from gradcal_jax.files.quantity import Quantity
from gradcal_jax.files.requirement import GyroScaleFactorRequirement, MissionHeadingRequirement, UnitRequirement
from gradcal_jax.files.schedule import TemperatureSegment
from gradcal_jax.files.sensor import GyroTriad

# Rounded figures (a ramp rounded to hundredths of a second) may exceed a limit by this share.
_SLACK = 1e-6
# Quantities of a gyro's maps.
_OF_MAPS = frozenset({"gyro_scale_factor", "gyro_bias", "north"})
# Tolerance (K) of a mission's range beyond the plan's, whose ends are rounded to the chamber's steps.
_NEARLY = 0.5


def visited_temperatures(
    plan: ChamberCourse | StandardPlan, segments: Sequence[TemperatureSegment]
) -> tuple[float, float] | None:
    """The coldest and the warmest chamber temperature of used data (°C); None where nothing is used."""
    if isinstance(plan, StandardPlan):
        return min(plan.temperatures), max(plan.temperatures)
    ends = [t for s in segments if s.used for t in (s.temperature_start, s.temperature_end)]
    return (min(ends), max(ends)) if ends else None


def missions_within(requirements: Sequence[UnitRequirement], visited: tuple[float, float] | None) -> Iterator[Problem]:
    """Where missions leave the temperatures that a plan visits (°C)."""
    for i, requirement in enumerate(requirements):
        yield from _missions(i, requirement, visited, "the plan")


def _missions(
    i: int,
    requirement: UnitRequirement,
    span: tuple[float, float] | None,
    whose: str,
    column: str = "temperature",
) -> Iterator[Problem]:
    """Where the i-th requirement's missions leave the calibrated range (°C, or rad/s)."""
    if span is None or not isinstance(requirement, MissionHeadingRequirement):
        return
    slack, factor, unit = (_NEARLY, 1.0, "degC") if column == "temperature" else (_SLACK, math.degrees(1.0), "deg/s")
    low, high = (f"{factor * end:.5g}" for end in span)
    for k, mission in enumerate(requirement.mission):
        values = getattr(mission.rows, column)
        outside = (n for n, value in enumerate(values) if not span[0] - slack <= value <= span[1] + slack)
        if (n := next(outside, None)) is not None:
            message = (
                f"{mission.file}, line {mission.rows.line[n]}: the {column} is {factor * values[n]:.5g} {unit}, "
                f"outside {whose}, {low} to {high} {unit}"
            )
            yield Problem(("requirement", i, "mission", k), message)


def boxes_within(requirements: Sequence[UnitRequirement], gyro: GyroTriad) -> Iterator[Problem]:
    """Where boxes and missions leave what the bases of a gyro's maps cover."""
    maps = [section for section in (gyro.bias, gyro.scale_factor) if section is not None]
    for i, requirement in enumerate(requirements):
        if isinstance(requirement, MissionHeadingRequirement):
            for part in maps:
                yield from _missions(i, requirement, part.temperature.span, "the temperature basis")
            if gyro.scale_factor is not None:
                yield from _missions(i, requirement, gyro.scale_factor.rate.span, "the rate basis", "rate")
            continue
        key = ("requirement", i)
        scaled = isinstance(requirement, GyroScaleFactorRequirement)
        section = gyro.scale_factor if scaled else gyro.bias
        if section is None or requirement.quantity not in _OF_MAPS:
            continue
        yield from _inside(requirement.temperature, section.temperature.span, (*key, "temperature"))
        if scaled and gyro.scale_factor is not None:
            yield from _inside(requirement.rate, gyro.scale_factor.rate.span, (*key, "rate"))


def _inside(box: tuple[Quantity, Quantity], span: tuple[float, float] | None, key: Key) -> list[Problem]:
    if span is None:
        return []
    return [
        Problem((*key, i), f"lies outside the {key[-1]} basis (its first and last entries)", end.text)
        for i, end in enumerate(box)
        if not span[0] <= end <= span[1]
    ]


def standard_within(plan: StandardPlan, axis: TableAxis, chamber: Chamber, gyro: GyroTriad | None) -> Iterator[Problem]:
    """Where a standard plan exceeds chamber, table or the gyros' full scale; keys relative to the plan."""
    for i, temperature in enumerate(plan.temperatures):
        yield from _in_chamber(temperature, chamber, ("temperatures", i))
    for before, after in zip(plan.temperatures, plan.temperatures[1:], strict=False):
        slope = chamber.max_heating if after > before else chamber.max_cooling
        needed = abs(after - before) / slope
        if needed > plan.soak * (1.0 + _SLACK):
            message = f"is too short: from {before} to {after} the chamber alone needs {needed / 60.0:.4g} min"
            yield Problem(("soak",), message, plan.soak.text)
            break
    for i, rate in enumerate(plan.rates or ()):
        swept = abs(rate) * plan.integration
        if swept > axis.travel * (1.0 + _SLACK):
            message = (
                f"turns {math.degrees(swept):.6g} deg in {plan.integration}, and the table's travel is {axis.travel}"
            )
            yield Problem(("rates", i), message, rate.text)
        if abs(rate) > axis.max_rate * (1.0 + _SLACK):
            message = f"reaches {math.degrees(abs(rate)):.5g} deg/s and exceeds rig.table.max_rate, {axis.max_rate}"
            yield Problem(("rates", i), message, rate.text)
        yield from beyond_full_scale(abs(rate), gyro, ("rates", i), rate.text)


def beyond_full_scale(rate: float, gyro: GyroTriad | None, key: Key, text: str) -> Iterator[Problem]:
    """Where a rate (rad/s) is beyond what a gyro measures."""
    if gyro is not None and gyro.usable_rate is not None and rate > gyro.usable_rate * (1.0 + _SLACK):
        message = (
            f"reaches {math.degrees(rate):.5g} deg/s and exceeds the sensor's full scale, {gyro.full_scale}, "
            f"less its margin, {gyro.full_scale_margin}"
        )
        yield Problem(key, message, text)


def course_within(
    plan: ChamberCourse, chamber: Chamber, segments: tuple[TemperatureSegment, ...] | None
) -> Iterator[Problem]:
    """Where a course leaves the chamber's range or exceeds its slopes; keys relative to the plan."""
    if plan.programme is not None:
        here: Quantity | None = None
        for i, item in enumerate(plan.programme):
            key = next(name for name in ("at", "ramp_to", "step_to") if name in type(item).model_fields)
            goal: Quantity | None = getattr(item, key)
            if goal is None:
                continue
            yield from _in_chamber(goal, chamber, ("programme", i, key))
            if isinstance(item, RampItem) and here is not None:
                yield from _slope(item.rate, goal > here, chamber, ("programme", i, "rate"))
            here = goal
        return
    for i, temperature in enumerate(plan.temperature or ()):
        yield from _in_chamber(temperature, chamber, ("temperature", i))
    if isinstance(plan.gradient, tuple):
        low, high = chamber.range
        for i, slope in enumerate(plan.gradient):
            yield from _slope(slope, slope > 0, chamber, ("gradient", i))
        if segments is not None:
            for i, segment in enumerate(s for s in segments if s.kind == "ramp"):
                end = segment.temperature_end
                if not low - 1e-6 <= end <= high + 1e-6:
                    message = f"takes the chamber to {end:.4g} degC, outside its range, {low} to {high}"
                    yield Problem(("gradient", i), message, plan.gradient[i].text)
                    break
    elif plan.gradient is not None and plan.temperature is not None and len(plan.temperature) == 2:
        yield from _slope(plan.gradient, plan.temperature[1] > plan.temperature[0], chamber, ("gradient",))


def _in_chamber(value: Quantity, chamber: Chamber, key: Key) -> Iterator[Problem]:
    low, high = chamber.range
    if not low <= value <= high:
        yield Problem(key, f"lies outside the chamber's range, {low} to {high}", value.text)


def _slope(slope: Quantity, heats: bool, chamber: Chamber, key: Key) -> Iterator[Problem]:
    name = "max_heating" if heats else "max_cooling"
    limit: Quantity = getattr(chamber, name)
    if abs(slope) > limit * (1.0 + _SLACK):
        yield Problem(key, f"exceeds rig.chamber.{name}, {limit}", slope.text)
