"""`[plan]`: the course of the chamber, the motion of the table, and the readings.

Two methods. "standard": stable temperatures one after the other, each with a soak, a reference rate (or standstill) at
each. "gradient": the temperature keeps changing, the table turns and rests, and the only reference is the angle.

The temperature of a gradient plan is written in one of two ways:

* `temperature = [start, end]` with one `gradient` (a size; `start` may be the warmer), after an optional `soak`;
* `programme`, a list of soaks, ramps and steps, of which the first is a soak with `at`.
"""

from collections.abc import Iterator
from itertools import pairwise
from typing import Annotated, Literal

from pydantic import Field

from gradcal_jax.spec.bench import Spacing
from gradcal_jax.spec.moves import Move
from gradcal_jax.tables import quantity as q
from gradcal_jax.tables.problems import Problem
from gradcal_jax.tables.section import Section, by_key, chosen_by


class SoakItem(Section):
    """An item of a programme: stay at the temperature."""

    soak: q.Time
    """Duration of the stay."""
    at: q.Temperature | None = None
    """Temperature of the stay; only for the first item."""
    used: q.Flag = False
    """Whether the readings taken during the stay are part of the data."""


class RampItem(Section):
    """An item of a programme: go to another temperature at a constant slope."""

    ramp_to: q.Temperature
    """Temperature at the end of the ramp."""
    rate: q.PositiveTemperatureSlope
    """Slope, as a positive number."""
    used: q.Flag = True
    """Whether the readings taken during the ramp are part of the data."""


class StepItem(Section):
    """An item of a programme: go to another temperature at the chamber's maximum rate."""

    step_to: q.Temperature
    """Temperature at the end of the step."""
    used: q.Flag = False
    """Whether the readings taken during the step are part of the data."""


_EXPECTED = "{ soak = …, at = … }, { ramp_to = …, rate = … } or { step_to = … }"
ProgrammeItem = Annotated[
    SoakItem | RampItem | StepItem,
    by_key({"soak": SoakItem, "ramp_to": RampItem, "step_to": StepItem}, _EXPECTED),
]


class OtherAxes(Section):
    """The time for which the table serves other sensors in each cycle; the axis of this plan is then at rest."""

    duration: q.Time
    """Duration of this time."""
    read_every: Spacing | None = None
    """Time between readings of this axis, or "rest" for one at the end; absent: it is not read."""


class MotionCycle(Section):
    """The motion of the table that is repeated."""

    moves: Annotated[tuple[Move, ...], Field(min_length=1, max_length=2000)]
    """Rests, turns and poses, in the order in which they are made."""
    start: dict[q.Text, q.Angle] = Field(default_factory=dict)
    """Angles of the axes at the start of the cycle, by name; absent: zero."""
    other_axes: OtherAxes | None = None
    """Time for which the table serves other sensors at the end of each cycle; only for a table with standing =
    "read"."""


class MotionPlan(Section):
    """The plan of an IMU. If there are several mountings, the mounting changes to the next one before each further part
    of the programme whose data are used. If the programme is a single ramp, it is repeated for each mounting; in
    between, the chamber returns to the start of the ramp."""

    method: Literal["gradient"] = "gradient"
    """The method of the plan."""
    temperature: tuple[q.Temperature, q.Temperature] | None = None
    """[start, end] of the ramp."""
    gradient: q.PositiveTemperatureSlope | None = None
    """Slope of the ramp, as a positive number."""
    soak: q.Time | None = None
    """Waiting time at the start temperature, whose readings are not part of the data."""
    programme: Annotated[tuple[ProgrammeItem, ...], Field(min_length=1, max_length=10_000)] | None = None
    """Soaks, ramps and steps in their order, instead of the keys above."""
    cycle: MotionCycle | None = None
    """Motion that is repeated; absent: the table is at rest, and each axis is read at intervals of its `read_every`."""
    before: Annotated[tuple[q.Temperature, ...], Field(max_length=100)] = ()
    """Turning points of the sensor's temperature before the plan, in order, such as room temperature; they determine
    the initial state of a hysteresis. Absent: the initial state is unknown."""

    def _problems(self) -> Iterator[Problem]:
        of_ramp = {key: getattr(self, key) for key in ("temperature", "gradient", "soak")}
        if self.programme is None:
            for key in ("temperature", "gradient"):
                if of_ramp[key] is None:
                    yield Problem((key,), 'this key is missing (or give a "programme")', kind="missing")
            if self.temperature is not None and self.temperature[0] == self.temperature[1]:
                yield Problem(("temperature",), "start and end must differ", [t.text for t in self.temperature])
            return
        for key, value in of_ramp.items():
            if value is not None:
                yield Problem((key,), 'cannot be combined with "programme"')
        first = self.programme[0]
        if not isinstance(first, SoakItem) or first.at is None:
            message = 'the first item must be a soak with a temperature: { soak = "1 h", at = "-30 degC" }'
            yield Problem(("programme", 0), message)
        elif not any(item.used for item in self.programme):
            yield Problem(("programme",), "the plan would have no data: set used = true in at least one item")


class StandardPlan(Section):
    """The standard method: stable temperatures, and at each of them several reference rates."""

    method: Literal["standard"]
    """The method of the plan."""
    temperatures: Annotated[tuple[q.Temperature, ...], Field(min_length=1, max_length=1000)]
    """Temperature set points, in their order."""
    soak: q.Time
    """Waiting time at each temperature before data are taken."""
    integration: q.Time
    """Averaging time of each mean rate."""
    rates: Annotated[tuple[q.Rate, ...], Field(min_length=1, max_length=1000)] | None = None
    """Reference rates at each set point; absent: the axis is at rest."""
    estimator: Literal["best linear", "least squares"] = "best linear"
    """"best linear": generalised least squares with all priors; "least squares": unweighted, as in the paper."""
    points: Literal["one run", "independent"] = "one run"
    """"one run": all points share the clock error, the turn-on bias, drifts and random walks; "independent": the errors
    of different points are independent (as in the paper)."""

    def _problems(self) -> Iterator[Problem]:
        for i, (before, after) in enumerate(pairwise(self.temperatures), 1):
            if before == after:
                message = "repeats the previous temperature; lengthen the integration instead"
                yield Problem(("temperatures", i), message, after.text)


AnyPlan = Annotated[
    MotionPlan | StandardPlan,
    chosen_by("method", {"gradient": MotionPlan, "standard": StandardPlan}, default="gradient"),
]
