"""gradcal-spec/1: `[sensor.gyro]` and `[sensor.accelerometer]` on a table of one to three axes."""

import math
from collections.abc import Iterator
from functools import cached_property
from typing import Any, Final, Literal

from pydantic import model_validator

from gradcal_jax.spec.bench import Rig
from gradcal_jax.spec.checks import problems_between
from gradcal_jax.spec.design import Design
from gradcal_jax.spec.plan import AnyPlan, MotionPlan, StandardPlan
from gradcal_jax.spec.requirement import Requirements
from gradcal_jax.spec.schedule import PlanSchedule, StandardSchedule, plan_schedule, standard_schedule
from gradcal_jax.spec.sensor import Sensor
from gradcal_jax.spec.typical import with_classes
from gradcal_jax.tables.document import TitledFile
from gradcal_jax.tables.problems import Problem

FORMAT: Final = "gradcal-spec/1"


class Spec(TitledFile):
    """Sensor, rig, requirements, plan, and what `optimise` may change. In Python, a read-only object, whose quantities
    are numbers in SI (and °C) with the text from which they were read.

        `schedule` is the plan resolved for the rig. From `read_spec` or `parse_spec`. Errors: their `SpecError`.
    """

    format: Literal["gradcal-spec/1"]
    sensor: Sensor
    """The device that is calibrated."""
    rig: Rig
    """Site, table and chamber."""
    requirement: Requirements = ()
    """Requirements on the calibration."""
    plan: AnyPlan
    """Temperature profile of the chamber, and motion of the table."""
    design: Design | None = None
    """What `optimise` minimises, and what it may change; other commands do not use it."""

    @model_validator(mode="after")
    def _with_figures_of_classes(self) -> "Spec":
        whole = with_classes(self)
        vars(self).update(sensor=whole.sensor, rig=whole.rig)
        return self

    def _problems(self) -> Iterator[Problem]:
        return problems_between(self)

    def __reduce__(self) -> Any:
        # Classes of generic tables cannot be pickled by name.
        return Spec.model_validate, (self.model_dump(mode="json", exclude_unset=True),)

    @property
    def is_one_axis(self) -> bool:
        """Whether there is nothing but a gyro along the only axis of a table: its rate and bias are all that counts."""
        gyro, table = self.sensor.gyro, self.rig.table
        first, hung = table.axis[0], table.mounting[0]
        several = len(table.axis) > 1 or len(table.mounting) > 1 or hung.rotation is not None
        if gyro is None or self.sensor.accelerometer is not None or several:
            return False
        signals = (gyro.misalignment, gyro.g_sensitivity)
        along = {a: abs(first.unit_vector["xyz".index(getattr(hung, a)[1])]) for a in gyro.axes}
        return all(signal is None for signal in signals) and all(part == 1.0 for part in along.values())

    @property
    def turns_one_gyro(self) -> bool:
        """Whether one gyro along the only axis of a table, read as it stands, is all that there is: `optimise` then
        searches the course of its turns, else a cycle of turns and poses."""
        gyro, table, frame = self.sensor.gyro, self.rig.table, self.sensor.frame
        if gyro is None or not self.is_one_axis:
            return False
        simple = not gyro.on_path
        level = not table.tilt and not table.azimuth
        begins = 0.0
        if isinstance(self.plan, MotionPlan) and self.plan.cycle is not None:
            begins = next(iter(map(float, self.plan.cycle.start.values())), 0.0)
        read = table.standing == "read" or isinstance(self.plan, StandardPlan)
        return simple and level and read and not begins and frame != "case"

    @cached_property
    def schedule(self) -> PlanSchedule | StandardSchedule:
        """The plan in SI."""
        if isinstance(self.plan, StandardPlan):
            return standard_schedule(self.plan)
        return plan_schedule(self.plan, self.rig)

    @property
    def gradient_schedule(self) -> PlanSchedule:
        """The schedule of a gradient plan. Raises `ValueError` for a standard one."""
        if isinstance(self.schedule, StandardSchedule):
            raise ValueError('this is only possible for a plan with method = "gradient"')
        return self.schedule

    @property
    def executable_schedule(self) -> PlanSchedule:
        """A schedule that can be made into a recipe. Raises `ValueError` for one whose readings no estimate knows: of a
        table of several axes that is read while it stands, other than as its `read_every` says."""
        return self.gradient_schedule if len(self.rig.table.axis) == 1 else self.plain_schedule

    @property
    def plain_schedule(self) -> PlanSchedule:
        """A schedule of nothing but a cycle that is read as the table is. Raises `ValueError` for any other."""
        table = self.rig.table
        once = [math.isinf(axis.angle.read_every) for axis in table.axis]
        # An operator types one angle in each rest.
        spaced = not any(once) or (all(once) and table.drive == "hand" and table.standing == "held")
        if not ((schedule := self.gradient_schedule).is_plain and spaced):
            raise ValueError(
                "a run of an IMU needs a plan whose cycle has none of the keys read_every and other_axes; "
                'read_every of every table axis must be a time (or "rest", if the table has drive = '
                '"hand" and holds its angle). Other plans can be predicted, but not executed yet'
            )
        return schedule
