"""`[rig]`: the table, its angle reference, and the chamber, as far as a plan must respect them."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from gradcal_jax.files.bases import increasing
from gradcal_jax.files.problems import Problem
from gradcal_jax.files.quantity import (
    Count,
    PositiveAcceleration,
    PositiveRate,
    PositiveTemperatureDifference,
    PositiveTemperatureSlope,
    Quantity,
    SizeOfAngle,
    SizeOfScaleFactor,
    SizeOfTime,
    Temperature,
    Text,
    Time,
    Travel,
)
from gradcal_jax.files.section import Section, refuse


class Harmonic(Section):
    """Repeatable error of the encoder: the angle's error repeats with the angle."""

    order: Annotated[Count, Field(le=100_000)]
    """Periods in one turn."""
    amplitude: SizeOfAngle
    """Standard deviation of the cosine part and of the sine part."""


class AngleReference(Section):
    """Error budget of the angle: white per reading, one draw a standstill, by angle, and by time on the move."""

    reading_noise: SizeOfAngle = Quantity(0.0, "0 deg", "angle")
    """Standard deviation of each reading, independent of all others."""
    standstill_offset: SizeOfAngle = Quantity(0.0, "0 deg", "angle")
    """Standard deviation of what is common to all readings of one standstill and new in the next."""
    timing_error: SizeOfTime = Quantity(0.0, "0 s", "time")
    """Standard deviation of the time of a reading on the move, which the rate turns into angle."""
    harmonics: Annotated[tuple[Harmonic, ...], Field(max_length=50)] = ()
    """Errors that repeat with the angle."""

    @model_validator(mode="after")
    def _once_each(self) -> "AngleReference":
        orders = [harmonic.order for harmonic in self.harmonics]
        again = [i for i, order in enumerate(orders) if order in orders[:i]]
        message = "this order stands above already: give one amplitude for each order"
        refuse(*(Problem(("harmonics", i, "order"), message, str(orders[i])) for i in again))
        return self


class Table(Section):
    """The rate table."""

    max_rate: PositiveRate
    """Largest rate of the axis."""
    max_acceleration: PositiveAcceleration
    """Largest acceleration of the axis."""
    travel: Travel = Quantity(float("inf"), "unlimited", "angle")
    """How far it may turn each way from where it starts; "unlimited" where no cable winds up."""
    rate_accuracy: SizeOfScaleFactor | None = None
    """Standard deviation of the reference rate of the standard method, a ratio; absent: exact."""
    drive: Literal["motor", "hand"] = "motor"
    """Whether a motor or a hand turns it."""
    angle: AngleReference = AngleReference()
    """Error budget of the angle."""


class Chamber(Section):
    """The climatic chamber: where it can go and how fast."""

    range: tuple[Temperature, Temperature]
    """Coldest and hottest temperature of the chamber."""
    max_heating: PositiveTemperatureSlope
    """Steepest slope upwards."""
    max_cooling: PositiveTemperatureSlope
    """Steepest slope downwards, as a size."""

    @model_validator(mode="after")
    def _ordered(self) -> "Chamber":
        refuse(*increasing(self.range, "range"))
        return self


class Resolution(Section):
    """What the controllers can be told: recipes are rounded to these steps."""

    temperature: PositiveTemperatureDifference | None = None
    """Step of a temperature set point."""
    time: Time | None = None
    """Step of a duration."""
    rate: PositiveRate | None = None
    """Step of a rate."""
    angle: SizeOfAngle | None = None
    """Step of an angle."""


class Rig(Section):
    """The bench: table, chamber, and the steps of their controllers."""

    name: Text | None = None
    """A name for people."""
    table: Table
    """The table."""
    chamber: Chamber
    """The climatic chamber."""
    resolution: Resolution | None = None
    """Steps of the controllers; absent: those of the drivers here."""
