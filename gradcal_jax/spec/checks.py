"""Checks between the sections of a spec: limits of rig and sensor, references, keys without effect."""

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final

from gradcal_jax.spec.design import design_problems
from gradcal_jax.spec.plan import StandardPlan
from gradcal_jax.spec.requirement import QUANTITIES, GyroScaleFactorRequirement
from gradcal_jax.spec.schedule import PlanSchedule, PlanStep, row_count
from gradcal_jax.spec.sensor import FULL_SCALE_MARGIN
from gradcal_jax.tables.problems import Key, Problem, SpecError, repeated_names
from gradcal_jax.tables.quantity import Quantity

if TYPE_CHECKING:
    from gradcal_jax.spec.spec_sections import Spec

# Rounded figures (a ramp rounded to hundredths of a second) may exceed a limit by this share.
_SLACK: Final = 1e-6
_MOST_READINGS: Final = 50_000_000


def problems_between(spec: "Spec") -> Iterator[Problem]:
    """Every problem between the sections of a spec."""
    steps: tuple[PlanStep, ...] = ()
    if isinstance(spec.plan, StandardPlan):
        yield from _standard(spec, spec.plan)
    try:
        if isinstance(schedule := spec.schedule, PlanSchedule):
            steps = schedule.steps
            yield from _readings(spec, schedule)
    except SpecError as error:
        yield from (problem.under("plan") for problem in error.problems)
    yield from _full_scale(spec, steps)
    yield from _requirements(spec)
    yield from _references(spec, steps)
    if spec.design is not None:
        names = [requirement.name for requirement in spec.requirement]
        problems = design_problems(spec.design, names, of_axis=spec.turns_one_gyro)
        yield from (problem.under("design") for problem in problems)


def _standard(spec: "Spec", plan: StandardPlan) -> Iterator[Problem]:
    """Where a standard plan exceeds chamber or table."""
    chamber, (axis, *others) = spec.rig.chamber, spec.rig.table.axis
    if others:
        yield Problem(("plan", "method"), "the standard method needs a table with one axis", "standard")
    low, high = chamber.range
    for i, goal in enumerate(plan.temperatures):
        if not low <= goal <= high:
            yield Problem(("plan", "temperatures", i), f"is outside the chamber's range, {low} to {high}", goal.text)
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


def _readings(spec: "Spec", schedule: PlanSchedule) -> Iterator[Problem]:
    """A plan without readings, or with too many."""
    rows = row_count(schedule, spec.rig.table)
    key = ("plan", "cycle") if schedule.steps else ("rig", "table", "axis", 0, "angle", "read_every")
    if rows > _MOST_READINGS:
        yield Problem(key, f"the plan has {rows} readings, and at most {_MOST_READINGS} are possible: read less often")
    elif rows == 0:
        yield Problem(key, "the plan has no readings")


def _full_scale(spec: "Spec", steps: Sequence[PlanStep]) -> Iterator[Problem]:
    """Where a plan turns an axis faster than a gyro along it would measure."""
    gyro, plan = spec.sensor.gyro, spec.plan
    if gyro is None or gyro.usable_rate is None:
        return
    turns: list[tuple[Key, float, str]] = [
        (("plan", "cycle", "moves", step.source), step.move.fastest, step.move.words) for step in steps
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
        key, quantity = ("requirement", i), requirement.quantity
        needed = ["{}.{}".format(*QUANTITIES[quantity])]
        internal = getattr(requirement, "relative_to", "") == "internal"
        if quantity == "accelerometer_misalignment" and internal:
            needed.append("gyro.misalignment")
        tables = {name: _table_of(spec, name) for name in needed}
        if missing := next((name for name, table in tables.items() if table is None), None):
            yield Problem((*key, "quantity"), f"needs [sensor.{missing}], which the spec does not estimate", quantity)
            continue
        # Of another sensor's axes, an internal misalignment would count as known exactly.
        kinds = [name.split(".")[0] for name in needed]
        wanted = "xyz" if internal else requirement.axis if requirement.axis in ("x", "y", "z") else ""
        absent = [f"{kind} {axis}" for kind in kinds for axis in wanted if axis not in _table_of(spec, kind).axes]
        if absent:
            where, value = ("quantity", quantity) if internal else ("axis", requirement.axis)
            yield Problem((*key, where), f"needs {', '.join(absent)}, but the sensor has no such axis", value)
        for table in tables.values():
            if (basis := getattr(table, "temperature", None)) is not None:
                yield from _inside(requirement.temperature, basis.span, (*key, "temperature"))
        if isinstance(requirement, GyroScaleFactorRequirement):
            yield from _inside(requirement.rate, tables["gyro.scale_factor"].rate.span, (*key, "rate"))


def _inside(box: tuple[Quantity, Quantity], span: tuple[float, float] | None, key: Key) -> list[Problem]:
    message = f"is outside the range of the {key[-1]} basis (from its first to its last entry)"
    low, high = span or (-math.inf, math.inf)
    return [Problem((*key, i), message, end.text) for i, end in enumerate(box) if not low <= end <= high]


def _references(spec: "Spec", steps: Sequence[PlanStep]) -> Iterator[Problem]:
    """What accelerometers, the case, the Earth, and gravity as the only reference of the angle need."""
    sensor, table, site = spec.sensor, spec.rig.table, spec.rig.site
    accelerometer, of_case = sensor.accelerometer, sensor.frame == "case"
    if (site.latitude is None or site.is_unknown) and not spec.is_one_axis:
        message = "this key is missing: the latitude determines the Earth's rate and gravity at the table"
        yield Problem(("rig", "site", "latitude"), message)
    if len(table.mounting) > 1 and not of_case:
        message = 'with several mountings, the misalignments refer to the case: expected frame = "case"'
        yield Problem(("sensor", "frame"), message, sensor.frame)
    for i, mounting in enumerate(table.mounting):
        if of_case and not mounting.accuracy:
            message = 'must be above zero, because the misalignments refer to the case (sensor.frame = "case")'
            yield Problem(("rig", "table", "mounting", i, "accuracy"), message, "0 deg")
    if accelerometer is not None and steps and all(step.axis >= 0 for step in steps):
        message = "the cycle has no rest, and accelerometers are read only at rest: add { rest = … }"
        yield Problem(("plan", "cycle", "moves"), message)
    if not table.by_gravity:
        return
    reference: Key = ("rig", "table", "axis", 0, "angle", "reference")
    if sensor.gyro is None or accelerometer is None or len(accelerometer.axes) < 3:
        message = '"gravity" needs a gyro (to count whole turns) and accelerometers along x, y and z'
        yield Problem(reference, message, "gravity")
    if isinstance(spec.plan, StandardPlan):
        message = 'a plan with held rates needs an encoder: expected "encoder", or a plan with method = "gradient"'
        yield Problem(reference, message, "gravity")
    turned: set[int] = set()
    # The cycle begins anew where it ends.
    for step in (*steps, *steps):
        if step.axis in turned:
            message = (
                "there is no rest between this turn and another turn of the same axis: without an encoder the "
                "angle in between is not known; add { rest = … }"
            )
            yield Problem(("plan", "cycle", "moves", step.source), message)
            return
        turned = {*turned, step.axis} if step.axis >= 0 else set()
