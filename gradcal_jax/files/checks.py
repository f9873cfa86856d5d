"""Checks between sections: limits of rig and sensor, and references.

A section that could not be read is None; the checks that depend on it are skipped, so that one run of `check` reports
all other problems.
"""

import contextlib
import math
from collections.abc import Iterator, Sequence

from gradcal_jax.files.bases import RatePolynomial, TemperaturePolynomial
from gradcal_jax.files.bench import Chamber, Rig
from gradcal_jax.files.design import OPTIMALITIES, TIMES, Design, Notice
from gradcal_jax.files.moves import AXES, ResolvedMove
from gradcal_jax.files.plan import ChamberCourse, GradientPlan, RampItem, StandardPlan
from gradcal_jax.files.problems import Key, Problem, SpecError, hint, one_of
from gradcal_jax.files.quantity import Quantity
from gradcal_jax.files.requirement import (
    GyroScaleFactorRequirement,
    MissionHeadingRequirement,
    Requirement,
    ScaleFactorRequirement,
    UnitRequirement,
)
from gradcal_jax.files.schedule import GradientSchedule, TemperatureSegment, gradient_schedule, resolve_cycle
from gradcal_jax.files.sensor import GyroTriad, ScaleFactor, Sensor

# Rounded figures (a ramp rounded to hundredths of a second) may exceed a limit by this share.
_SLACK = 1e-6
# Quantities of a gyro's maps.
_OF_MAPS = frozenset({"scale_factor", "bias", "gyro_scale_factor", "gyro_bias", "north"})
# Tolerance (K) of a mission's range beyond the plan's, whose ends are rounded to the chamber's steps.
_NEARLY = 0.5


def between_sections(
    sensor: Sensor | None,
    rig: Rig | None,
    requirements: Sequence[Requirement] | None,
    plan: GradientPlan | StandardPlan | None,
    design: Design | None,
) -> Iterator[Problem]:
    """Every problem between the sections, keys from the top of the file."""
    if requirements is not None:
        yield from _requirements(requirements, sensor)
        segments = ()
        if isinstance(plan, GradientPlan) and rig is not None:
            with contextlib.suppress(SpecError):  # said elsewhere
                segments = gradient_schedule(plan, rig).segments
        if plan is not None:
            yield from missions_within(requirements, visited_temperatures(plan, segments))
        if design is not None:
            yield from _design(design, [requirement.name for requirement in requirements])
    if design is not None and design.notice is not None and sensor is not None:
        yield from (p.under("design", "notice") for p in _notice(design.notice, sensor.scale_factor))
    if isinstance(plan, StandardPlan):
        yield from (p.under("plan") for p in standard_within(plan, rig, sensor))
    elif plan is not None and rig is not None:
        yield from (p.under("plan") for p in _gradient(plan, rig, sensor))


def _notice(notice: Notice, scale: ScaleFactor | None) -> Iterator[Problem]:
    if scale is None or not isinstance(scale.temperature, TemperaturePolynomial):
        yield Problem((), "is of a scale factor that is a polynomial; the sensor has none")
        return
    if not isinstance(scale.rate, RatePolynomial):
        yield Problem((), "is of a scale factor that is a polynomial in rate; the sensor's is not")
        return
    own = {"temperature_degree": scale.temperature.degree, "rate_degree": scale.rate.degree}
    for name, degree in own.items():
        hidden = getattr(notice, name)
        if hidden is None:
            continue
        if scale.discrepancy is not None and hidden != getattr(scale.discrepancy, name):
            yield Problem((name,), "must be that of the scale factor's discrepancy; leave it out", hidden)
        elif hidden <= degree:
            yield Problem((name,), f"must exceed the map's degree, {degree}: only what is beyond it is hidden", hidden)


def visited_temperatures(
    plan: ChamberCourse | StandardPlan, segments: Sequence[TemperatureSegment]
) -> tuple[float, float] | None:
    """The coldest and the warmest chamber temperature of used data (°C); None where nothing is used."""
    if isinstance(plan, StandardPlan):
        return min(plan.temperatures), max(plan.temperatures)
    ends = [t for s in segments if s.used for t in (s.temperature_start, s.temperature_end)]
    return (min(ends), max(ends)) if ends else None


def missions_within(
    requirements: Sequence[Requirement | UnitRequirement], visited: tuple[float, float] | None
) -> Iterator[Problem]:
    """Where missions leave the temperatures that a plan visits (°C)."""
    for i, requirement in enumerate(requirements):
        yield from _missions(i, requirement, visited, "the plan")


def _missions(
    i: int,
    requirement: Requirement | UnitRequirement,
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


def _requirements(requirements: Sequence[Requirement], sensor: Sensor | None) -> Iterator[Problem]:
    seen: dict[str, int] = {}
    for i, requirement in enumerate(requirements):
        if requirement.name in seen:
            message = f"is the name of requirement[{seen[requirement.name]}] too; names must differ"
            yield Problem(("requirement", i, "name"), message, requirement.name)
        seen.setdefault(requirement.name, i)
        name = "scale_factor" if requirement.quantity == "scale_factor" else "bias"
        if sensor is None or requirement.quantity == "heading" or getattr(sensor, name) is not None:
            continue
        message = f"is not estimated: there is no [sensor.{name}]"
        yield Problem(("requirement", i, "quantity"), message, requirement.quantity)
    if sensor is not None:
        yield from boxes_within(requirements, sensor)


def boxes_within(requirements: Sequence[Requirement | UnitRequirement], gyro: Sensor | GyroTriad) -> Iterator[Problem]:
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
        scaled = isinstance(requirement, ScaleFactorRequirement | GyroScaleFactorRequirement)
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


def _design(design: Design, names: Sequence[str]) -> list[Problem]:
    others = (*TIMES, *OPTIMALITIES)
    if design.minimise in names or design.minimise in others:
        return []
    ending = hint(design.minimise, [*names, *others])
    message = f"expected the name of a requirement ({one_of(names)}) or {one_of(others)}{ending}"
    return [Problem(("design", "minimise"), message, design.minimise)]


def standard_within(plan: StandardPlan, rig: Rig | None, sensor: Sensor | None) -> Iterator[Problem]:
    """Where a standard plan exceeds chamber, table or sensor; keys relative to the plan."""
    rates = plan.rates or ()
    if rig is not None:
        for i, temperature in enumerate(plan.temperatures):
            yield from _in_chamber(temperature, rig.chamber, ("temperatures", i))
        for before, after in zip(plan.temperatures, plan.temperatures[1:], strict=False):
            slope = rig.chamber.max_heating if after > before else rig.chamber.max_cooling
            needed = abs(after - before) / slope
            if needed > plan.soak * (1.0 + _SLACK):
                message = f"is too short: from {before} to {after} the chamber alone needs {needed / 60.0:.4g} min"
                yield Problem(("soak",), message, plan.soak.text)
                break
        for i, rate in enumerate(rates):
            swept = abs(rate) * plan.integration
            if swept > rig.table.travel * (1.0 + _SLACK):
                message = (
                    f"turns {math.degrees(swept):.6g} deg in {plan.integration}, "
                    f"and the table's travel is {rig.table.travel}"
                )
                yield Problem(("rates", i), message, rate.text)
    for i, rate in enumerate(rates):
        yield from _rate_limits(abs(rate), rig, sensor, ("rates", i), rate.text)


def _gradient(plan: GradientPlan, rig: Rig, sensor: Sensor | None) -> Iterator[Problem]:
    schedule: GradientSchedule | None = None
    try:
        schedule = gradient_schedule(plan, rig)
    except SpecError as error:
        yield from error.problems
    if plan.cycle is not None:
        with contextlib.suppress(SpecError):  # said above
            moves = resolve_cycle(plan.cycle, rig).moves
            yield from _motion(moves, rig, sensor)
            if schedule is not None:
                yield from _travel(moves, schedule.cycles, rig)
    yield from course_within(plan, rig.chamber, None if schedule is None else schedule.segments)


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


def _rate_limits(rate: float, rig: Rig | None, sensor: Sensor | None, key: Key, text: str) -> Iterator[Problem]:
    if rig is not None and rate > rig.table.max_rate * (1.0 + _SLACK):
        message = f"reaches {math.degrees(rate):.5g} deg/s and exceeds rig.table.max_rate, {rig.table.max_rate}"
        yield Problem(key, message, text)
    if sensor is not None and sensor.usable_rate is not None and rate > sensor.usable_rate * (1.0 + _SLACK):
        message = (
            f"reaches {math.degrees(rate):.5g} deg/s and exceeds the sensor's full scale, {sensor.full_scale}, "
            f"less its margin, {sensor.full_scale_margin}"
        )
        yield Problem(key, message, text)


def _motion(moves: Sequence[ResolvedMove], rig: Rig, sensor: Sensor | None) -> Iterator[Problem]:
    limit = rig.table.max_acceleration
    for i, move in enumerate(moves):
        key = ("cycle", "moves", i)
        if move.is_rest:
            continue
        if (move.shape == "hand") != (rig.table.drive == "hand"):
            wrong = "needs a table that is turned by hand" if move.shape == "hand" else "cannot be made by hand"
            message = f'{wrong}; rig.table.drive is "{rig.table.drive}"'
            yield Problem((*key, "shape"), message, move.shape)
        # Tolerance as a fraction of the peak: a ramp rounded to hundredths of a second may miss a limit.
        yield from _rate_limits(move.fastest, rig, sensor, key, move.words)
        if move.peak_acceleration > limit * (1.0 + _SLACK):
            message = (
                f"accelerates at up to {math.degrees(move.peak_acceleration):.5g} deg/s^2 and exceeds "
                f"rig.table.max_acceleration, {limit}"
            )
            yield Problem(key, message, move.words)


def _travel(moves: Sequence[ResolvedMove], cycles: int, rig: Rig) -> Iterator[Problem]:
    """The cable winds up over all cycles: each axis must stay within the travel either way of its start."""
    travel = rig.table.travel
    if math.isinf(travel):
        return
    for axis in AXES:
        mine = [(i, move) for i, move in enumerate(moves) if move.axis == axis and not move.is_rest]
        if not mine:
            continue
        net = math.fsum(move.repeat * move.angle for _, move in mine)
        for first in sorted({0, max(0, cycles - 1)}):
            at = first * net
            for i, move in mine:
                ends = (0.0, (move.repeat - 1) * move.angle)
                reach = max(abs(at + end + side) for end in ends for side in (move.low, move.high))
                if reach > travel * (1.0 + _SLACK):
                    message = f"takes the {axis} axis {math.degrees(reach):.6g} deg from its start"
                    if first > 0:
                        message += f" in cycle {first + 1} (each cycle ends {math.degrees(net):.6g} deg further)"
                    message += f"; rig.table.travel is {travel} each way"
                    yield Problem(("cycle", "moves", i), message, move.words)
                    return
                at += move.repeat * move.angle
