"""Checks of a plan against chamber, table and sensor, and of requirements against the maps."""

import math
from collections.abc import Iterator

from gradcal_jax.files.bench import Chamber, TableAxis
from gradcal_jax.files.plan import ChamberCourse, RampItem, StandardPlan
from gradcal_jax.files.problems import Key, Problem
from gradcal_jax.files.quantity import Quantity
from gradcal_jax.files.schedule import TemperatureSegment
from gradcal_jax.files.sensor import GyroTriad

# Rounded figures (a ramp rounded to hundredths of a second) may exceed a limit by this share.
_SLACK = 1e-6


def inside_basis(box: tuple[Quantity, Quantity], span: tuple[float, float] | None, key: Key) -> list[Problem]:
    """Ends of a requirement's box that lie outside a basis's span."""
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
                f"turns {math.degrees(swept):.6g} deg in {plan.integration}, "
                f"and the table's travel is {axis.travel}"
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
