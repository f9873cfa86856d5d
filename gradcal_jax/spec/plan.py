"""`[plan]`: the course of the chamber, the motion of the table, and the readings.

Two methods. "standard": stable temperatures one after the other, each with a soak, a reference rate (or standstill) at
each. "gradient": the temperature keeps changing, the table turns and rests, and the only reference is the angle.

The temperature of a gradient plan is written in one of three ways:

* `temperature = [start, end]` with one `gradient` (a size; `start` may be the warmer), after an optional `soak`;
* `temperature = [start]` with a list of signed gradients, one a cycle: the ramp ends where they take it;
* `programme`, a list of soaks, ramps and steps, of which the first is a soak with `at`.
"""

from collections.abc import Iterator, Mapping
from itertools import pairwise
from typing import Annotated, Literal

from pydantic import Field

from gradcal_jax.tables import quantity as q
from gradcal_jax.tables.problems import Problem
from gradcal_jax.tables.section import Section, read_by, refuse_misspelt


class Soak(Section):
    """Waiting time at the start temperature."""

    duration: q.Time
    """Duration of the wait."""
    used: q.Flag = False
    """Whether the readings taken during the wait are part of the data."""


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


_ITEMS: dict[str, type[Section]] = {"soak": SoakItem, "ramp_to": RampItem, "step_to": StepItem}


def _choose_item(item: Mapping[str, object]) -> object:
    kinds = [key for key in _ITEMS if key in item]
    if len(kinds) == 1:
        return _ITEMS[kinds[0]].model_validate(item)
    if not kinds:
        refuse_misspelt(item, _ITEMS)
    raise ValueError("expected one of { soak = …, at = … }, { ramp_to = …, rate = … } or { step_to = … }")


ProgrammeItem = Annotated[SoakItem | RampItem | StepItem, read_by(_choose_item)]


class OtherAxes(Section):
    """The time for which the table serves other sensors in each cycle; the axis of this plan is then at rest."""

    duration: q.Time
    """Duration of this time."""
    read: q.Flag = False
    """Whether this axis is read during this time."""
    read_every: q.Time | None = None
    """Time between these readings; absent: the `read_every` of the table axis."""

    def _problems(self) -> Iterator[Problem]:
        if self.read_every is not None and not self.read:
            yield Problem(("read_every",), "has an effect only if read = true", self.read_every.text)


Slopes = Annotated[
    q.Quantity | tuple[q.Quantity, ...],
    q.OneOrList(q.Of("temperature slope", above="0 K/min"), q.Of("temperature slope"), "one for each cycle"),
]


class ChamberCourse(Section):
    """The temperature of the chamber over time: a ramp, a list of slopes, or a programme."""

    temperature: Annotated[tuple[q.Temperature, ...], Field(min_length=1, max_length=2)] | None = None
    """[start, end] of the ramp, or [start] if `gradient` is a list of slopes."""
    gradient: Slopes | None = None
    """Slope of the ramp as a positive number, or a list of signed slopes, one for each cycle."""
    soak: Soak | None = None
    """Waiting time at the start temperature."""
    programme: Annotated[tuple[ProgrammeItem, ...], Field(min_length=1, max_length=10_000)] | None = None
    """Soaks, ramps and steps in their order, instead of the keys above."""

    def course_problems(self, *, with_cycle: bool) -> Iterator[Problem]:
        """Problems of the course. `with_cycle`: whether there may be a slope for each cycle."""
        if self.programme is not None:
            for key in ("temperature", "gradient", "soak"):
                if getattr(self, key) is not None:
                    yield Problem((key,), 'cannot be combined with "programme"')
            first = self.programme[0]
            if not isinstance(first, SoakItem) or first.at is None:
                message = 'the first item must be a soak with a temperature: { soak = "1 h", at = "-30 degC" }'
                yield Problem(("programme", 0), message)
            elif not any(item.used for item in self.programme):
                yield Problem(("programme",), "the plan would have no data: set used = true in at least one item")
            return
        missing = [key for key in ("temperature", "gradient") if getattr(self, key) is None]
        yield from (Problem((key,), 'this key is missing (or give a "programme")', kind="missing") for key in missing)
        if self.temperature is None or missing:
            return
        if isinstance(self.gradient, tuple):
            if not with_cycle:
                message = "a list gives one slope for each cycle, and this plan has no cycle: give one slope"
                yield Problem(("gradient",), message)
            if len(self.temperature) == 2:
                message = "a list of slopes determines the end of the ramp: give only the start, as [start]"
                yield Problem(("temperature",), message, [t.text for t in self.temperature])
        elif len(self.temperature) == 1:
            yield Problem(("temperature",), "expected [start, end]", [t.text for t in self.temperature])
        elif self.temperature[0] == self.temperature[1]:
            yield Problem(("temperature",), "start and end must differ", [t.text for t in self.temperature])


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
