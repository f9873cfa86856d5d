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
    """Repeatable error of the encoder, `order` periods a turn; `amplitude`: std of the cosine and of the sine part."""

    order: Annotated[Count, Field(le=100_000)]
    amplitude: SizeOfAngle


class AngleReference(Section):
    """Error budget of the angle: white per reading, one draw a standstill, by angle, and by time on the move."""

    reading_noise: SizeOfAngle = Quantity(0.0, "0 deg", "angle")
    standstill_offset: SizeOfAngle = Quantity(0.0, "0 deg", "angle")
    timing_error: SizeOfTime = Quantity(0.0, "0 s", "time")
    harmonics: Annotated[tuple[Harmonic, ...], Field(max_length=50)] = ()

    @model_validator(mode="after")
    def _once_each(self) -> "AngleReference":
        orders = [harmonic.order for harmonic in self.harmonics]
        again = [i for i, order in enumerate(orders) if order in orders[:i]]
        message = "this order stands above already: give one amplitude for each order"
        refuse(*(Problem(("harmonics", i, "order"), message, str(orders[i])) for i in again))
        return self


class Table(Section):
    """The rate table. `travel` counts each way from the axis's start; `rate_accuracy` absent: an exact reference."""

    max_rate: PositiveRate
    max_acceleration: PositiveAcceleration
    travel: Travel = Quantity(float("inf"), "unlimited", "angle")
    rate_accuracy: SizeOfScaleFactor | None = None
    drive: Literal["motor", "hand"] = "motor"
    angle: AngleReference = AngleReference()


class Chamber(Section):
    """The climatic chamber: where it can go and how fast."""

    range: tuple[Temperature, Temperature]
    max_heating: PositiveTemperatureSlope
    max_cooling: PositiveTemperatureSlope

    @model_validator(mode="after")
    def _ordered(self) -> "Chamber":
        refuse(*increasing(self.range, "range"))
        return self


class Resolution(Section):
    """What the controllers can be told: recipes are rounded to these steps."""

    temperature: PositiveTemperatureDifference | None = None
    time: Time | None = None
    rate: PositiveRate | None = None
    angle: SizeOfAngle | None = None


class Rig(Section):
    """The bench: table, chamber, and the steps of their controllers."""

    name: Text | None = None
    table: Table
    chamber: Chamber
    resolution: Resolution | None = None
