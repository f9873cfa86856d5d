"""gradcal-spec/1 of a whole unit: `[sensor.gyro]` and `[sensor.accelerometer]` on a table of one to three axes."""

import math
from collections.abc import Iterator
from functools import cached_property
from typing import Annotated, Any, Final, Literal

from pydantic import Field

from gradcal_jax.files.bench import UnitRig
from gradcal_jax.files.checks import (
    beyond_full_scale,
    boxes_within,
    course_within,
    missions_within,
    standard_within,
    visited_temperatures,
)
from gradcal_jax.files.design import Design, design_problems, notice_problems
from gradcal_jax.files.document import TitledFile
from gradcal_jax.files.plan import StandardPlan
from gradcal_jax.files.problems import Problem, SpecError
from gradcal_jax.files.quantity import Quantity, SizeOfTime, Text, Time
from gradcal_jax.files.requirement import (
    MisalignmentRequirement,
    PositionRequirement,
    TiltRequirement,
    TurnRequirement,
    UnitRequirement,
    UnitRequirements,
)
from gradcal_jax.files.schedule import StandardSchedule, standard_schedule
from gradcal_jax.files.section import Section
from gradcal_jax.files.sensor import GyroTriad, UnitSensor
from gradcal_jax.files.unit_plan import AnyUnitPlan, UnitPlan, UnitSchedule, unit_schedule

FORMAT: Final = "gradcal-spec/1"


class ExecutedPart(Section):
    """The executed part of a plan before a run was broken off; `[[done]]`, which `gradcal replan` writes."""

    plan: UnitPlan
    """The plan that was executed then."""
    start: SizeOfTime
    """Its beginning, on that plan's clock."""
    end: Time
    """Until when."""
    pause: Time = Quantity.of(1800.0, "s")
    """Time until the next part or the plan begins; the device stays switched on. Absent: 30 min."""


class UnitSpec(TitledFile):
    """A spec of a whole unit; read-only. Quantities behave as numbers in SI (°C) and keep their text.

    `schedule` is the plan resolved for the rig. From `read_spec` or `parse_spec`. Errors: their `SpecError`.
    """

    format: Literal["gradcal-spec/1"]
    title: Text | None = None
    """A name for people; it heads tables and pages."""
    sensor: UnitSensor
    """The unit that is calibrated."""
    rig: UnitRig
    """Site, table and chamber."""
    requirement: UnitRequirements = ()
    """Requirements on the calibration."""
    plan: AnyUnitPlan
    """Course of the chamber, and motion of the table."""
    done: Annotated[tuple[ExecutedPart, ...], Field(max_length=1000)] = ()
    """The parts executed before the plan begins, in the same run; every prediction includes them."""
    design: Design | None = None
    """What `optimise` may change; no other command reads it."""

    def _problems(self) -> Iterator[Problem]:
        try:
            steps = () if isinstance(self.schedule, StandardSchedule) else self.schedule.steps
        except SpecError as error:
            yield from (p.under("plan") for p in error.problems)
            return
        along = self.sensor.gyro if self.is_one_axis else None
        if isinstance(self.plan, StandardPlan):
            segments = ()
            yield from (p.under("plan") for p in _standard(self.plan, self.rig, along))
            if self.done:
                yield Problem(("done",), 'what was done counts beside a plan of method = "gradient" alone')
        else:
            segments = self.gradient_schedule.segments
            yield from (p.under("plan") for p in course_within(self.plan, self.rig.chamber, segments))
            for step in (step for step in steps if step.axis >= 0):
                key = ("plan", "cycle", "moves", step.source)
                yield from beyond_full_scale(step.move.fastest, along, key, step.move.words)
        yield from missions_within(self.requirement, visited_temperatures(self.plan, segments))
        if self.sensor.gyro is not None:
            yield from boxes_within(self.requirement, self.sensor.gyro)
        yield from self._site()
        for kind in ("gyro", "accelerometer") if self.done else ():
            if (triad := getattr(self.sensor, kind)) is not None and triad.turn_on_transient:
                message = "the time since power-on is not known in a run that goes on ([[done]]); leave the key out"
                yield Problem(("sensor", kind, "turn_on_transient"), message)
        for number, part in enumerate(self.done):
            try:
                segments = unit_schedule(part.plan, self.rig).segments
            except SpecError as error:
                yield from (p.under("done", number, "plan") for p in error.problems)
                continue
            course = course_within(part.plan, self.rig.chamber, segments)
            yield from (p.under("done", number, "plan") for p in course)
            if part.end <= part.start:
                yield Problem(("done", number, "end"), "expected a time after its start", part.end.text)
        names = [r.name for r in self.requirement]
        for i, requirement in enumerate(self.requirement):
            if requirement.name in names[:i]:
                yield Problem(("requirement", i, "name"), "two requirements have this name", requirement.name)
            wanted = _needs(requirement)
            missing = next((key for key in wanted if self._absent(key)), None)
            if missing is not None:
                message = f"needs [sensor.{missing}], which the spec does not estimate"
                yield Problem(("requirement", i, "quantity"), message, requirement.quantity)
            elif absent := [f"{kind} {a}" for kind, a in _needed_axes(requirement) if a not in self._axes_of(kind)]:
                message = f"needs {', '.join(absent)}, which the unit has not"
                yield Problem(("requirement", i, "quantity"), message, requirement.quantity)
            elif requirement.axis in ("x", "y", "z"):
                triad = self.sensor.gyro if wanted[0].startswith("gyro") else self.sensor.accelerometer
                assert triad is not None
                if requirement.axis not in triad.axes:
                    yield Problem(("requirement", i, "axis"), "the unit has no such axis", requirement.axis)
        accelerometer, frame = self.sensor.accelerometer, self.sensor.frame
        slow = 0.0 if accelerometer is None else float(accelerometer.read_on_moves_below or 0.0)
        read = not steps or any(step.axis < 0 or step.move.fastest <= slow for step in steps)
        if accelerometer is not None and not read:
            message = "never rests, where accelerometers are read; add { rest = … }"
            yield Problem(("plan", "cycle", "moves"), message)
        turning = [float(step.move.fastest) for step in steps if step.axis >= 0]
        if accelerometer is not None and slow and turning and min(turning) > slow:
            message = f"has no effect: the slowest move reaches {math.degrees(min(turning)):.4g} deg/s; raise it, or "
            key = ("sensor", "accelerometer", "read_on_moves_below")
            limit = str(accelerometer.read_on_moves_below)
            yield Problem(key, message + "leave it out (and the lever arm)", limit)
        if self.design is not None:
            found = [*design_problems(self.design, names, of_axis=self.turns_one_gyro)]
            if (gyro := self.sensor.gyro) is not None and self.design.notice is not None:
                found += [p.under("notice") for p in notice_problems(self.design.notice, gyro.scale_factor)]
            yield from (p.under("design") for p in found)
        several = len(self.rig.table.mounting) > 1
        if several and (frame is None or frame.fixed_by != "case"):
            message = 'with several mountings the frame is the case\'s; expected fixed_by = "case"'
            yield Problem(("sensor", "frame", "fixed_by"), message, frame and frame.fixed_by)
        if frame is not None and frame.fixed_by == "case":
            for i, mounting in enumerate(self.rig.table.mounting):
                if not mounting.accuracy:
                    message = 'must be above zero: the frame is the case\'s (sensor.frame.fixed_by = "case")'
                    yield Problem(("rig", "table", "mounting", i, "accuracy"), message, "0 deg")

    def _site(self) -> Iterator[Problem]:
        """The latitude may be absent where the Earth's rate is the same all the time."""
        if (self.rig.site.latitude is None or self.rig.site.is_unknown) and not self.is_one_axis:
            message = "this key is missing: the Earth's rate and gravity change with the table's angles"
            yield Problem(("rig", "site", "latitude"), message, kind="missing")

    @property
    def is_one_axis(self) -> bool:
        """Whether there is nothing but a gyro along the only axis of a table: its rate and bias are all that counts."""
        gyro, table = self.sensor.gyro, self.rig.table
        first, hung = table.axis[0], table.mounting[0]
        several = len(table.axis) > 1 or len(table.mounting) > 1 or hung.rotation is not None
        if gyro is None or self.sensor.accelerometer is not None or several:
            return False
        signals = (gyro.misalignment, gyro.g_sensitivity, gyro.g_squared)
        along = {a: abs(first.unit_vector["xyz".index(getattr(hung, a)[1])]) for a in gyro.axes}
        return all(signal is None for signal in signals) and all(part == 1.0 for part in along.values())

    @property
    def turns_one_gyro(self) -> bool:
        """Whether one gyro along the only axis of a table, read as it stands, is all that there is: `optimise` then
        searches the course of its turns, else a cycle of turns and poses."""
        gyro, table, frame = self.sensor.gyro, self.rig.table, self.sensor.frame
        if gyro is None or not self.is_one_axis:
            return False
        on_paths = gyro.hysteresis, gyro.scale_factor_hysteresis, gyro.turn_on_transient
        simple = not any(on_paths) and gyro.scale_factor_temperature_gradient is None
        level = not table.tilt and not table.azimuth and table.axis[0].keep_out is None
        begins = 0.0
        if isinstance(self.plan, UnitPlan) and self.plan.cycle is not None:
            begins = next(iter(map(float, self.plan.cycle.start.values())), 0.0)
        read = table.standing == "read" or isinstance(self.plan, StandardPlan)
        return simple and level and read and not begins and (frame is None or frame.fixed_by != "case")

    def _axes_of(self, kind: str) -> tuple[str, ...]:
        triad = getattr(self.sensor, kind)
        return () if triad is None else triad.axes

    def _absent(self, dotted: str) -> bool:
        value: Any = self.sensor
        for name in dotted.split("."):
            value = getattr(value, name)
            if value is None:
                return True
        return False

    @cached_property
    def schedule(self) -> UnitSchedule | StandardSchedule:
        """The plan in SI."""
        if isinstance(self.plan, StandardPlan):
            return standard_schedule(self.plan)
        return unit_schedule(self.plan, self.rig)

    @property
    def gradient_schedule(self) -> UnitSchedule:
        """The schedule of a gradient plan. Raises `ValueError` for a standard one."""
        if isinstance(self.schedule, StandardSchedule):
            raise ValueError('this needs a plan of method = "gradient"')
        return self.schedule

    @property
    def executable_schedule(self) -> UnitSchedule:
        """A schedule that can be made into a recipe. Raises `ValueError` for one whose readings no estimate knows: of a
        table of several axes that is read while it stands, other than as its `read_every` says."""
        return self.gradient_schedule if len(self.rig.table.axis) == 1 else self.plain_schedule

    @property
    def plain_schedule(self) -> UnitSchedule:
        """A schedule of nothing but a cycle that is read as the table is. Raises `ValueError` for any other."""
        table = self.rig.table
        once = [math.isinf(axis.angle.read_every) for axis in table.axis]
        # An operator types one angle in each rest.
        spaced = not any(once) or (all(once) and table.drive == "hand" and table.standing == "held")
        if not ((schedule := self.gradient_schedule).is_plain and spaced):
            raise ValueError(
                "for an IMU this needs a plan with a cycle that leaves out read, read_every, other_axes and duration, "
                'on a table whose read_every is a time and not "rest" (or one that a hand turns and that is held, with '
                '"rest" for every axis); all else is predicted, and not executed yet'
            )
        return schedule


def _standard(plan: StandardPlan, rig: UnitRig, gyro: GyroTriad | None) -> Iterator[Problem]:
    """Problems of the standard method, keys relative to the plan."""
    axis, *others = rig.table.axis
    if others:
        yield Problem(("method",), "the standard method holds the rate of a table of one axis", "standard")
    yield from standard_within(plan, axis, rig.chamber, gyro)


def _needed_axes(requirement: UnitRequirement) -> list[tuple[str, str]]:
    """Sensors without which a requirement's quantity would count as known exactly."""
    if isinstance(requirement, TurnRequirement):
        return [("gyro", "z")]
    if isinstance(requirement, TiltRequirement):
        return [("accelerometer", a) for a in "xy"]
    if isinstance(requirement, PositionRequirement):
        return [(kind, a) for kind in ("gyro", "accelerometer") for a in "xy"]
    if isinstance(requirement, MisalignmentRequirement) and requirement.relative_to == "internal":
        kinds = ("gyro", "accelerometer") if requirement.quantity.startswith("accelerometer") else ("gyro",)
        return [(kind, a) for kind in kinds for a in "xyz"]
    return []


def _needs(requirement: UnitRequirement) -> tuple[str, ...]:
    """The tables of [sensor] that a requirement's quantity needs."""
    both = requirement.quantity == "accelerometer_misalignment" and requirement.relative_to == "internal"
    return {
        "gyro_bias": ("gyro.bias",),
        "gyro_scale_factor": ("gyro.scale_factor",),
        "gyro_misalignment": ("gyro.misalignment",),
        "g_sensitivity": ("gyro.g_sensitivity",),
        "accelerometer_bias": ("accelerometer.bias",),
        "accelerometer_scale_factor": ("accelerometer.scale_factor",),
        "accelerometer_misalignment": ("accelerometer.misalignment", *(["gyro.misalignment"] if both else [])),
        "second_order": ("accelerometer.second_order",),
        "position": ("gyro.bias", "accelerometer.bias"),
        "tilt": ("accelerometer.bias",),
        "heading": ("gyro.scale_factor",),
        "mission_heading": ("gyro",),
        "north": ("gyro.bias",),
    }[requirement.quantity]
