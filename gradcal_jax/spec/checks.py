"""Checks between the sections of a spec: limits of rig and sensor, references, keys without effect."""

import contextlib
import math
from collections.abc import Iterator, Mapping
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final

from gradcal_jax.spec.design import design_problems
from gradcal_jax.spec.motion_plan import PlanSchedule, PlanStep, resolve_steps, row_count
from gradcal_jax.spec.plan import RampItem, StandardPlan
from gradcal_jax.spec.requirement import GyroScaleFactorRequirement, MissionHeadingRequirement, Requirement
from gradcal_jax.spec.sensor import FULL_SCALE_MARGIN
from gradcal_jax.tables.problems import Key, Problem, SpecError, repeated_names
from gradcal_jax.tables.quantity import Quantity

if TYPE_CHECKING:
    from gradcal_jax.spec.spec_sections import Spec

# Rounded figures (a ramp rounded to hundredths of a second) may exceed a limit by this share.
_SLACK: Final = 1e-6
# Tolerance (K) of a mission's range beyond the plan's, whose ends are rounded to the chamber's steps.
_NEARLY: Final = 0.5
_MOST_READINGS: Final = 50_000_000


def problems_between(spec: "Spec") -> Iterator[Problem]:
    """Every problem between the sections of a spec."""
    for check in (_chamber, _standard, _schedule, _full_scale, _requirements, _missions, _references):
        yield from check(spec)
    if spec.design is not None:
        names = [requirement.name for requirement in spec.requirement]
        problems = design_problems(spec.design, names, of_axis=spec.turns_one_gyro)
        yield from (problem.under("design") for problem in problems)


def _steps(spec: "Spec") -> tuple[PlanStep, ...]:
    """The steps of the cycle that have no problems themselves."""
    if isinstance(spec.plan, StandardPlan) or spec.plan.cycle is None:
        return ()
    return resolve_steps(spec.plan.cycle, spec.rig)[0]


def _chamber(spec: "Spec") -> Iterator[Problem]:
    """Where a plan leaves the chamber's range or exceeds its slopes."""
    plan, chamber = spec.plan, spec.rig.chamber
    goals: list[tuple[Key, Quantity]] = []
    slopes: list[tuple[Key, Quantity, bool]] = []
    if isinstance(plan, StandardPlan):
        goals += [(("temperatures", i), goal) for i, goal in enumerate(plan.temperatures)]
    elif plan.programme is None:
        goals += [(("temperature", i), goal) for i, goal in enumerate(plan.temperature or ())]
        if plan.gradient is not None and plan.temperature is not None:
            slopes.append((("gradient",), plan.gradient, plan.temperature[1] > plan.temperature[0]))
    else:
        for i, item in enumerate(plan.programme):
            key = next(name for name in ("at", "ramp_to", "step_to") if name in type(item).model_fields)
            goal: Quantity | None = getattr(item, key)
            if goal is None:
                continue
            if isinstance(item, RampItem) and goals:
                slopes.append((("programme", i, "rate"), item.rate, goal > goals[-1][1]))
            goals.append((("programme", i, key), goal))
    low, high = chamber.range
    for key, goal in goals:
        if not low <= goal <= high:
            yield Problem(("plan", *key), f"is outside the chamber's range, {low} to {high}", goal.text)
    for key, slope, heats in slopes:
        name = "max_heating" if heats else "max_cooling"
        limit: Quantity = getattr(chamber, name)
        if abs(slope) > limit * (1.0 + _SLACK):
            yield Problem(("plan", *key), f"exceeds rig.chamber.{name}, {limit}", slope.text)


def _standard(spec: "Spec") -> Iterator[Problem]:
    """Where a standard plan exceeds chamber or table."""
    plan, chamber = spec.plan, spec.rig.chamber
    if not isinstance(plan, StandardPlan):
        return
    axis, *others = spec.rig.table.axis
    if others:
        yield Problem(("plan", "method"), "the standard method needs a table with one axis", "standard")
    for before, after in pairwise(plan.temperatures):
        needed = abs(after - before) / (chamber.max_heating if after > before else chamber.max_cooling)
        if needed > plan.soak * (1.0 + _SLACK):
            message = f"is too short: from {before} to {after} the chamber needs at least {needed / 60.0:.4g} min"
            yield Problem(("plan", "soak"), message, plan.soak.text)
            break
    for i, rate in enumerate(plan.rates or ()):
        swept = abs(rate) * plan.integration
        if swept > axis.travel * (1.0 + _SLACK):
            message = (
                f"turns {math.degrees(swept):.6g} deg in {plan.integration}, and the table's travel is {axis.travel}"
            )
            yield Problem(("plan", "rates", i), message, rate.text)
        if abs(rate) > axis.max_rate * (1.0 + _SLACK):
            yield Problem(("plan", "rates", i), f'exceeds max_rate of axis "{axis.name}", {axis.max_rate}', rate.text)


def _schedule(spec: "Spec") -> Iterator[Problem]:
    """A plan that cannot be resolved, or that has no readings, or too many."""
    try:
        schedule = spec.schedule
    except SpecError as error:
        yield from (problem.under("plan") for problem in error.problems)
        return
    if not isinstance(schedule, PlanSchedule):
        return
    rows = row_count(schedule, spec.rig.table)
    key = ("plan", "cycle") if schedule.steps else ("rig", "table", "axis", 0, "angle", "read_every")
    if rows > _MOST_READINGS:
        yield Problem(key, f"the plan has {rows} readings, and at most {_MOST_READINGS} are possible: read less often")
    elif rows == 0:
        yield Problem(key, "the plan has no readings")


def _full_scale(spec: "Spec") -> Iterator[Problem]:
    """Where a plan turns an axis faster than a gyro along it would measure."""
    gyro, plan = spec.sensor.gyro, spec.plan
    if gyro is None or gyro.usable_rate is None:
        return
    turns: list[tuple[Key, float, str]] = [
        (("plan", "cycle", "moves", step.source), step.move.fastest, step.move.words) for step in _steps(spec)
    ]
    if isinstance(plan, StandardPlan):
        turns += [(("plan", "rates", i), abs(rate), rate.text) for i, rate in enumerate(plan.rates or ())]
    for key, rate, text in turns:
        if rate > gyro.usable_rate * (1.0 + _SLACK):
            message = (
                f"reaches {math.degrees(rate):.5g} deg/s, which exceeds the sensor's full scale, {gyro.full_scale}, "
                f"less {100.0 * FULL_SCALE_MARGIN:g} %"
            )
            yield Problem(key, message, text)


_NEEDED: Final[Mapping[str, tuple[str, ...]]] = {
    **{f"gyro_{name}": (f"gyro.{name}",) for name in ("bias", "scale_factor", "misalignment")},
    **{f"accelerometer_{n}": (f"accelerometer.{n}",) for n in ("bias", "scale_factor", "misalignment")},
    "g_sensitivity": ("gyro.g_sensitivity",),
    "second_order": ("accelerometer.second_order",),
    "mission_heading": ("gyro",),
}
"""The tables of [sensor] that a quantity needs."""


def _table_of(spec: "Spec", dotted: str) -> Any:
    """A table below [sensor]; None where it or one above is absent."""
    value: Any = spec.sensor
    for name in dotted.split("."):
        value = None if value is None else getattr(value, name)
    return value


def _requirements(spec: "Spec") -> Iterator[Problem]:
    """Requirements of what is not estimated, of axes that there are not, or beyond what the bases cover."""
    names = [requirement.name for requirement in spec.requirement]
    yield from repeated_names("requirement", "name", names, "two requirements have this name; names must differ")
    for i, requirement in enumerate(spec.requirement):
        key, needed = ("requirement", i), _NEEDED[requirement.quantity]
        internal = getattr(requirement, "relative_to", "") == "internal"
        if requirement.quantity == "accelerometer_misalignment" and internal:
            needed = (*needed, "gyro.misalignment")
        tables = {name: _table_of(spec, name) for name in needed}
        if missing := next((name for name, table in tables.items() if table is None), None):
            message = f"needs [sensor.{missing}], which the spec does not estimate"
            yield Problem((*key, "quantity"), message, requirement.quantity)
            continue
        # Of another sensor's axes, an internal misalignment would count as known exactly.
        kinds = [name.split(".")[0] for name in needed]
        wanted = "xyz" if internal else requirement.axis if requirement.axis in ("x", "y", "z") else ""
        absent = [f"{kind} {axis}" for kind in kinds for axis in wanted if axis not in _table_of(spec, kind).axes]
        if absent:
            where, value = ("quantity", requirement.quantity) if internal else ("axis", requirement.axis)
            yield Problem((*key, where), f"needs {', '.join(absent)}, but the sensor has no such axis", value)
        if isinstance(requirement, MissionHeadingRequirement):
            continue
        for table in tables.values():
            if (basis := getattr(table, "temperature", None)) is not None:
                yield from _inside(requirement.temperature, basis.span, (*key, "temperature"))
        if isinstance(requirement, GyroScaleFactorRequirement):
            yield from _inside(requirement.rate, tables["gyro.scale_factor"].rate.span, (*key, "rate"))


def _inside(box: tuple[Quantity, Quantity], span: tuple[float, float] | None, key: Key) -> list[Problem]:
    message = f"is outside the range of the {key[-1]} basis (from its first to its last entry)"
    low, high = span or (-math.inf, math.inf)
    return [Problem((*key, i), message, end.text) for i, end in enumerate(box) if not low <= end <= high]


def _missions(spec: "Spec") -> Iterator[Problem]:
    """Where missions leave the temperatures of the plan, or the ranges of the maps."""
    gyro, ends = spec.sensor.gyro, list[float]()
    if isinstance(spec.plan, StandardPlan):
        ends += spec.plan.temperatures
    else:
        with contextlib.suppress(SpecError):
            used = (segment for segment in spec.gradient_schedule.segments if segment.used)
            ends += [end for s in used for end in (s.temperature_start, s.temperature_end)]
    spans: list[tuple[str, str, Any]] = [("temperature", "the plan", (min(ends), max(ends)) if ends else None)]
    for part in (getattr(gyro, name, None) for name in ("bias", "scale_factor")):
        spans += [("temperature", "the temperature basis", part.temperature.span)] if part is not None else []
    if gyro is not None and gyro.scale_factor is not None:
        spans.append(("rate", "the rate basis", gyro.scale_factor.rate.span))
    for i, requirement in enumerate(spec.requirement):
        for column, whose, span in spans if isinstance(requirement, MissionHeadingRequirement) else ():
            yield from _mission(("requirement", i), requirement, column, whose, span)


def _mission(
    key: Key, requirement: Requirement, column: str, whose: str, span: tuple[float, float] | None
) -> Iterator[Problem]:
    low, high = getattr(requirement, column)
    slack = _NEARLY if column == "temperature" else _SLACK
    if span is not None and not span[0] - slack <= low <= high <= span[1] + slack:
        factor, unit = (1.0, "degC") if column == "temperature" else (math.degrees(1.0), "deg/s")
        least, most, low, high = (f"{factor * end:.5g} {unit}" for end in (*span, low, high))
        message = f"the {column} goes from {low} to {high}, outside the range of {whose}, {least} to {most}"
        yield Problem((*key, "mission"), message)


def _references(spec: "Spec") -> Iterator[Problem]:
    """What accelerometers, the case, the Earth, and gravity as the only reference of the angle need."""
    sensor, table, site, steps = spec.sensor, spec.rig.table, spec.rig.site, _steps(spec)
    accelerometer, of_case, by_gravity = sensor.accelerometer, sensor.frame == "case", table.by_gravity
    reference: Key = ("rig", "table", "axis", 0, "angle", "reference")
    lacks_axes = sensor.gyro is None or accelerometer is None or len(accelerometer.axes) < 3
    rules: list[tuple[bool, Key, str, object]] = [
        (
            (site.latitude is None or site.is_unknown) and not spec.is_one_axis,
            ("rig", "site", "latitude"),
            "this key is missing: the latitude determines the Earth's rate and gravity at the table",
            None,
        ),
        (
            len(table.mounting) > 1 and not of_case,
            ("sensor", "frame"),
            'with several mountings, the misalignments refer to the case: expected frame = "case"',
            sensor.frame,
        ),
        *(
            (
                of_case and not mounting.accuracy,
                ("rig", "table", "mounting", i, "accuracy"),
                'must be above zero, because the misalignments refer to the case (sensor.frame = "case")',
                "0 deg",
            )
            for i, mounting in enumerate(table.mounting)
        ),
        (
            accelerometer is not None and bool(steps) and all(step.axis >= 0 for step in steps),
            ("plan", "cycle", "moves"),
            "the cycle has no rest, and accelerometers are read only at rest: add { rest = … }",
            None,
        ),
        (
            by_gravity and lacks_axes,
            reference,
            '"gravity" needs a gyro (to count whole turns) and accelerometers along x, y and z',
            "gravity",
        ),
        (
            by_gravity and isinstance(spec.plan, StandardPlan),
            reference,
            'a plan with held rates needs an encoder: expected "encoder", or a plan with method = "gradient"',
            "gravity",
        ),
    ]
    for holds, key, message, value in rules:
        if holds:
            yield Problem(key, message) if value is None else Problem(key, message, value)
    turned: set[int] = set()
    # The cycle begins anew where it ends.
    for step in steps * 2 if by_gravity else ():
        if step.axis in turned:
            message = (
                "there is no rest between this turn and another turn of the same axis: without an encoder the "
                "angle in between is not known; add { rest = … }"
            )
            yield Problem(("plan", "cycle", "moves", step.source), message)
            return
        turned = {*turned, step.axis} if step.axis >= 0 else set()
