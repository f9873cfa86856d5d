"""Checks between the sections of a spec: limits of rig and sensor, references, keys without effect.

A section that could not be read is None; a check that needs it is left out, so that all other problems come at once.
"""

import contextlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final

from gradcal_jax.spec.bench import Chamber, Mounting, RigTable
from gradcal_jax.spec.design import design_problems
from gradcal_jax.spec.motion_plan import PlanStep, resolve_steps, row_count
from gradcal_jax.spec.plan import ChamberCourse, RampItem, StandardPlan
from gradcal_jax.spec.requirement import GyroScaleFactorRequirement, MissionHeadingRequirement, Requirement
from gradcal_jax.spec.sensor import FULL_SCALE_MARGIN, GyroTriad
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
    """Every problem between the sections of a spec, of which some may be None."""
    for needed, check in _CHECKS:
        if all(getattr(spec, name) is not None for name in needed.split()):
            yield from check(spec)


def _steps(spec: "Spec") -> tuple[PlanStep, ...]:
    """The steps of the cycle that have no problems themselves."""
    if isinstance(spec.plan, StandardPlan) or spec.plan.cycle is None:
        return ()
    return resolve_steps(spec.plan.cycle, spec.rig)[0]


def _plan_on_rig(spec: "Spec") -> Iterator[Problem]:
    plan, table, chamber, schedule = spec.plan, spec.rig.table, spec.rig.chamber, None
    problems: list[Problem] = []
    if isinstance(plan, StandardPlan):
        problems += _standard(plan, table, chamber)
    else:
        try:
            schedule = spec.gradient_schedule
        except SpecError as error:
            problems += error.problems
        problems += _course(plan, chamber)
    yield from (p.under("plan") for p in problems)
    if schedule is None or isinstance(plan, StandardPlan):
        return
    rows = row_count(schedule, table)
    key = ("rig", "table", "axis", 0, "angle", "read_every") if plan.cycle is None else ("plan", "cycle")
    if rows > _MOST_READINGS:
        yield Problem(key, f"the plan has {rows} readings, and at most {_MOST_READINGS} are possible: read less often")
    elif rows == 0:
        yield Problem(key, "the plan has no readings")


def _full_scale(spec: "Spec") -> Iterator[Problem]:
    """Where a plan turns a gyro faster than it measures."""
    gyro, table = spec.sensor.gyro, spec.rig.table
    if gyro is None or gyro.usable_rate is None:
        return
    angles = [0.0] * len(table.axis)
    turns: list[tuple[Key, float, str]] = []
    if isinstance(spec.plan, StandardPlan):
        part = _part_along(gyro, table, 0, angles)
        turns += [(("plan", "rates", i), part * abs(rate), rate.text) for i, rate in enumerate(spec.plan.rates or ())]
    elif spec.plan.cycle is not None:
        steps, start, _ = resolve_steps(spec.plan.cycle, spec.rig)
        angles = list(start)
        # Axes move one after the other: those inside stand at known angles.
        for step in (step for step in steps if step.axis >= 0):
            rate = step.move.fastest * _part_along(gyro, table, step.axis, angles)
            turns.append((("plan", "cycle", "moves", step.source), rate, step.move.words))
            angles[step.axis] += step.move.repeat * step.move.angle
    for key, rate, text in turns:
        if rate > gyro.usable_rate * (1.0 + _SLACK):
            message = (
                f"reaches {math.degrees(rate):.5g} deg/s, which exceeds the sensor's full scale, {gyro.full_scale}, "
                f"less {100.0 * FULL_SCALE_MARGIN:g} %"
            )
            yield Problem(key, message, text)


def _part_along(gyro: GyroTriad, table: RigTable, turning: int, angles: Sequence[float]) -> float:
    """The largest part of a table axis's rate that any gyro measures, for angles (rad) of the axes inside."""
    direction = table.axis[turning].unit_vector
    for inner, angle in zip(table.axis[turning + 1 :], angles[turning + 1 :], strict=True):
        direction = _turned(direction, inner.unit_vector, -angle)
    return max(abs(_in_body(direction, mounting)["xyz".index(a)]) for mounting in table.mounting for a in gyro.axes)


def _in_body(vector: Sequence[float], mounting: Mounting) -> Sequence[float]:
    """A vector of the innermost axis's frame in the body's."""
    body = [sum(c * v for c, v in zip(column, vector, strict=True)) for column in mounting.columns]
    size = math.hypot(*(mounting.rotation or ()))
    return _turned(body, [float(r) / size for r in mounting.rotation or ()], -size) if size else body


def _turned(vector: Sequence[float], axis: Sequence[float], angle: float) -> tuple[float, ...]:
    """A vector turned by an angle (rad) about a unit vector (Rodrigues)."""
    (a, b, c), (x, y, z) = axis, vector
    cross, along = (b * z - c * y, c * x - a * z, a * y - b * x), a * x + b * y + c * z
    cosine, sine = math.cos(angle), math.sin(angle)
    return tuple(
        v * cosine + w * sine + n * along * (1.0 - cosine) for v, w, n in zip(vector, cross, axis, strict=True)
    )


def _missions_on_plan(spec: "Spec") -> Iterator[Problem]:
    """Where missions leave the temperatures that the plan visits."""
    ends: list[float] = []
    if isinstance(spec.plan, StandardPlan):
        ends += spec.plan.temperatures
    else:
        with contextlib.suppress(SpecError):
            used = (segment for segment in spec.gradient_schedule.segments if segment.used)
            ends += [end for s in used for end in (s.temperature_start, s.temperature_end)]
    if ends:
        for i, requirement in enumerate(spec.requirement):
            yield from _missions(i, requirement, (min(ends), max(ends)), "the plan")


def _missions(
    i: int, requirement: Requirement, span: tuple[float, float] | None, whose: str, column: str = "temperature"
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
                f"outside the range of {whose}, {low} to {high} {unit}"
            )
            yield Problem(("requirement", i, "mission", k), message)


def _names(spec: "Spec") -> Iterator[Problem]:
    names = [requirement.name for requirement in spec.requirement]
    yield from repeated_names("requirement", "name", names, "two requirements have this name; names must differ")


def _requirements_of_sensor(spec: "Spec") -> Iterator[Problem]:
    """Requirements of what is not estimated, of axes that there are not, or beyond what the bases cover."""
    for i, requirement in enumerate(spec.requirement):
        key: Key = ("requirement", i)
        needed = _NEEDED[requirement.quantity]
        if requirement.quantity == "accelerometer_misalignment" and requirement.relative_to == "internal":
            needed = (*needed, "gyro.misalignment")
        tables = {name: _table_of(spec, name) for name in needed}
        of = needed[0].split(".")[0]
        if missing := next((name for name, table in tables.items() if table is None), None):
            message = f"needs [sensor.{missing}], which the spec does not estimate"
            yield Problem((*key, "quantity"), message, requirement.quantity)
            continue
        if absent := [f"{kind} {a}" for kind, a in _needed_axes(requirement) if a not in _table_of(spec, kind).axes]:
            message = f"needs {', '.join(absent)}, but the sensor has no such axis"
            yield Problem((*key, "quantity"), message, requirement.quantity)
        elif requirement.axis in ("x", "y", "z") and requirement.axis not in _table_of(spec, of).axes:
            yield Problem((*key, "axis"), "the sensor has no such axis", requirement.axis)
        if isinstance(requirement, MissionHeadingRequirement):
            maps = (_table_of(spec, "gyro.bias"), _table_of(spec, "gyro.scale_factor"))
            for part in (part for part in maps if part is not None):
                yield from _missions(i, requirement, part.temperature.span, "the temperature basis")
            if (scale := _table_of(spec, "gyro.scale_factor")) is not None:
                yield from _missions(i, requirement, scale.rate.span, "the rate basis", "rate")
            continue
        for table in tables.values():
            if (basis := getattr(table, "temperature", None)) is not None:
                yield from _inside(requirement.temperature, basis.span, (*key, "temperature"))
        if isinstance(requirement, GyroScaleFactorRequirement):
            yield from _inside(requirement.rate, tables["gyro.scale_factor"].rate.span, (*key, "rate"))


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


def _needed_axes(requirement: Requirement) -> list[tuple[str, str]]:
    """Sensors without which a requirement's quantity would count as known exactly."""
    if getattr(requirement, "relative_to", "") != "internal":
        return []
    kinds = ("gyro", *(("accelerometer",) if requirement.quantity.startswith("accelerometer") else ()))
    return [(kind, axis) for kind in kinds for axis in "xyz"]


def _inside(box: tuple[Quantity, Quantity], span: tuple[float, float] | None, key: Key) -> list[Problem]:
    message = f"is outside the range of the {key[-1]} basis (from its first to its last entry)"
    low, high = span or (-math.inf, math.inf)
    return [Problem((*key, i), message, end.text) for i, end in enumerate(box) if not low <= end <= high]


def _standard(plan: StandardPlan, table: RigTable, chamber: Chamber) -> Iterator[Problem]:
    """Where a standard plan exceeds chamber or table; keys relative to the plan."""
    axis, *others = table.axis
    if others:
        yield Problem(("method",), "the standard method needs a table with one axis", "standard")
    for i, temperature in enumerate(plan.temperatures):
        yield from _in_chamber(temperature, chamber, ("temperatures", i))
    for before, after in pairwise(plan.temperatures):
        slope = chamber.max_heating if after > before else chamber.max_cooling
        needed = abs(after - before) / slope
        if needed > plan.soak * (1.0 + _SLACK):
            message = f"is too short: from {before} to {after} the chamber needs at least {needed / 60.0:.4g} min"
            yield Problem(("soak",), message, plan.soak.text)
            break
    for i, rate in enumerate(plan.rates or ()):
        swept = abs(rate) * plan.integration
        if swept > axis.travel * (1.0 + _SLACK):
            message = (
                f"turns {math.degrees(swept):.6g} deg in {plan.integration}, more than the table's travel, "
                f"{axis.travel}"
            )
            yield Problem(("rates", i), message, rate.text)
        if abs(rate) > axis.max_rate * (1.0 + _SLACK):
            message = (
                f'reaches {math.degrees(abs(rate)):.5g} deg/s, which exceeds max_rate of axis "{axis.name}", '
                f"{axis.max_rate}"
            )
            yield Problem(("rates", i), message, rate.text)


def _course(plan: ChamberCourse, chamber: Chamber) -> Iterator[Problem]:
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
    if plan.gradient is not None and plan.temperature is not None:
        yield from _slope(plan.gradient, plan.temperature[1] > plan.temperature[0], chamber, ("gradient",))


def _in_chamber(value: Quantity, chamber: Chamber, key: Key) -> Iterator[Problem]:
    low, high = chamber.range
    if not low <= value <= high:
        yield Problem(key, f"is outside the chamber's range, {low} to {high}", value.text)


def _slope(slope: Quantity, heats: bool, chamber: Chamber, key: Key) -> Iterator[Problem]:
    name = "max_heating" if heats else "max_cooling"
    limit: Quantity = getattr(chamber, name)
    if abs(slope) > limit * (1.0 + _SLACK):
        yield Problem(key, f"exceeds rig.chamber.{name}, {limit}", slope.text)


def _site(spec: "Spec") -> Iterator[Problem]:
    """The latitude may be absent where the Earth's rate is the same all the time."""
    if (spec.rig.site.latitude is None or spec.rig.site.is_unknown) and not spec.is_one_axis:
        message = "this key is missing: the latitude determines the Earth's rate and gravity at the table"
        yield Problem(("rig", "site", "latitude"), message, kind="missing")


def _frame(spec: "Spec") -> Iterator[Problem]:
    frame, mountings = spec.sensor.frame, spec.rig.table.mounting
    of_case = frame == "case"
    if len(mountings) > 1 and not of_case:
        message = 'with several mountings, the misalignments refer to the case: expected frame = "case"'
        yield Problem(("sensor", "frame"), message, frame)
    for i, mounting in enumerate(mountings):
        if of_case and not mounting.accuracy:
            message = 'must be above zero, because the misalignments refer to the case (sensor.frame = "case")'
            yield Problem(("rig", "table", "mounting", i, "accuracy"), message, "0 deg")


def _accelerometer(spec: "Spec") -> Iterator[Problem]:
    accelerometer, steps = spec.sensor.accelerometer, _steps(spec)
    if accelerometer is None or not steps:
        return
    if all(step.axis >= 0 for step in steps):
        message = "the cycle has no rest, and accelerometers are read only at rest: add { rest = … }"
        yield Problem(("plan", "cycle", "moves"), message)


def _without_encoder(spec: "Spec") -> Iterator[Problem]:
    """What gravity as the only reference of the angle needs."""
    if not spec.rig.table.by_gravity:
        return
    key, sensor = ("rig", "table", "axis", 0, "angle", "reference"), spec.sensor
    if sensor.gyro is None or sensor.accelerometer is None or len(sensor.accelerometer.axes) < 3:
        message = '"gravity" needs a gyro (to count whole turns) and accelerometers along x, y and z'
        yield Problem(key, message, "gravity")
    if isinstance(spec.plan, StandardPlan):
        message = 'a plan with held rates needs an encoder: expected "encoder", or a plan with method = "gradient"'
        yield Problem(key, message, "gravity")
    turned: set[int] = set()
    # The cycle begins anew where it ends.
    for step in _steps(spec) * 2:
        if step.axis in turned or (step.axis >= 0 and step.move.repeat > 1):
            message = (
                "there is no rest between this turn and another turn of the same axis: without an encoder the "
                "angle in between is not known; add { rest = … }"
            )
            yield Problem(("plan", "cycle", "moves", step.source), message)
            return
        turned = {*turned, step.axis} if step.axis >= 0 else set()


def _design(spec: "Spec") -> Iterator[Problem]:
    assert spec.design is not None
    names = [requirement.name for requirement in spec.requirement]
    problems = design_problems(spec.design, names, of_axis=spec.turns_one_gyro)
    yield from (p.under("design") for p in problems)


_CHECKS: Final[tuple[tuple[str, Callable[["Spec"], Iterator[Problem]]], ...]] = (
    ("rig plan", _plan_on_rig),
    ("sensor rig plan", _full_scale),
    ("requirement rig plan", _missions_on_plan),
    ("requirement", _names),
    ("requirement sensor", _requirements_of_sensor),
    ("sensor rig", _site),
    ("sensor rig", _frame),
    ("sensor rig plan", _accelerometer),
    ("sensor rig plan", _without_encoder),
    ("design requirement sensor rig plan", _design),
)
"""The checks, by the sections that they need."""
