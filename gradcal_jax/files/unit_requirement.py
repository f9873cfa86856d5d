"""`[[requirement]]` of a whole unit: which quantity, of which axis, over which temperatures, summed up how."""

from typing import Annotated, ClassVar, Literal

from pydantic import BeforeValidator, Field, model_validator

from gradcal_jax.files.bases import increasing
from gradcal_jax.files.problems import Problem, one_of
from gradcal_jax.files.quantity import (
    PositiveAccelerationSensitivity,
    PositiveAngle,
    PositiveLength,
    PositiveRate,
    PositiveScaleFactor,
    PositiveSecondOrder,
    PositiveSpecificForce,
    Rate,
    Temperature,
    Text,
    Time,
)
from gradcal_jax.files.requirement import Points
from gradcal_jax.files.section import Section, choose, refuse

Over = Literal["mean", "max", "rms"]


Elements = Literal["all", "worst", "x", "y", "z"]


class _OfUnit(Section):
    ELEMENTS: ClassVar[tuple[Elements, ...]] = ("all", "worst", "x", "y", "z")

    name: Text
    """Its name, by which verdicts and [design] speak of it."""
    temperature: tuple[Temperature, Temperature]
    """Lowest and highest temperature."""
    axis: Elements = "worst"
    """One element, the worst of them, or all (root mean square)."""

    @model_validator(mode="after")
    def _ordered(self) -> "_OfUnit":
        problems = increasing(self.temperature, "temperature")
        if self.axis not in self.ELEMENTS:
            problems.append(Problem(("axis",), f"expected {one_of(self.ELEMENTS)}", self.axis))
        refuse(*problems)
        return self


class _OverTemperature(_OfUnit):
    """A requirement over temperature, summed up first of each element, then over the elements."""

    grid: tuple[Points] = (101,)
    """Number of temperatures, ends included."""
    statistic: Over = "mean"
    """How the standard deviation of each element is summed up over temperature."""


class GyroBiasRequirement(_OverTemperature):
    """Bias of the gyros, over temperature."""

    quantity: Literal["gyro_bias"]
    """What must be good."""
    target: PositiveRate | None = None
    """Limit on the standard deviation, which gives a verdict."""


class GyroScaleFactorRequirement(_OfUnit):
    """Scale factor of the gyros over a box of temperature and rate."""

    quantity: Literal["gyro_scale_factor"]
    """What must be good."""
    rate: tuple[Rate, Rate]
    """Lowest and highest rate."""
    grid: tuple[Points, Points] = (101, 121)
    """Numbers of temperatures and of rates, ends included."""
    statistic: Literal["mean of max", "mean", "max", "rms"] = "mean of max"
    """How the standard deviation is summed up over the box."""
    target: PositiveScaleFactor | None = None
    """Limit on the standard deviation, which gives a verdict."""

    @model_validator(mode="after")
    def _rates(self) -> "GyroScaleFactorRequirement":
        refuse(*increasing(self.rate, "rate"))
        return self


class MisalignmentRequirement(_OverTemperature):
    """Misalignments of gyros or accelerometers."""

    quantity: Literal["gyro_misalignment", "accelerometer_misalignment"]
    """What must be good."""
    relative_to: Literal["table", "case", "internal"] = "table"
    """The table's axes, the case (adds the mounting's accuracy), or the unit itself."""
    axis: Elements = "all"
    """One element, the worst of them, or all (root mean square)."""
    target: PositiveAngle | None = None
    """Limit on the standard deviation, which gives a verdict."""


class SensitivityRequirement(_OverTemperature):
    """Drift of the gyros for a unit of specific force."""

    quantity: Literal["g_sensitivity"]
    """What must be good."""
    axis: Elements = "all"
    """One element, the worst of them, or all (root mean square)."""
    target: PositiveAccelerationSensitivity | None = None
    """Limit on the standard deviation, which gives a verdict."""


class AccelerometerBiasRequirement(_OverTemperature):
    """Bias of the accelerometers."""

    quantity: Literal["accelerometer_bias"]
    """What must be good."""
    target: PositiveSpecificForce | None = None
    """Limit on the standard deviation, which gives a verdict."""


class AccelerometerScaleFactorRequirement(_OverTemperature):
    """Scale factor of the accelerometers."""

    quantity: Literal["accelerometer_scale_factor"]
    """What must be good."""
    target: PositiveScaleFactor | None = None
    """Limit on the standard deviation, which gives a verdict."""


class SecondOrderRequirement(_OverTemperature):
    """K2 of the accelerometers."""

    quantity: Literal["second_order"]
    """What must be good."""
    target: PositiveSecondOrder | None = None
    """Limit on the standard deviation, which gives a verdict."""


class PositionRequirement(_OfUnit):
    """Horizontal position after free-inertial navigation at rest, level: the calibration's part."""

    ELEMENTS: ClassVar[tuple[Elements, ...]] = ("all", "worst", "x", "y")

    quantity: Literal["position"]
    """What must be good."""
    after: Time
    """How long the navigation lasts."""
    grid: tuple[Points] = (101,)
    """Number of temperatures, ends included."""
    statistic: Over = "mean"
    """How the standard deviation is summed up over temperature."""
    target: PositiveLength | None = None
    """Limit on the standard deviation, which gives a verdict."""


class TiltRequirement(_OfUnit):
    """Error of the vertical that levelled accelerometers give, the worse of two directions."""

    ELEMENTS: ClassVar[tuple[Elements, ...]] = ("all", "worst", "x", "y")

    quantity: Literal["tilt"]
    """What must be good."""
    grid: tuple[Points] = (101,)
    """Number of temperatures, ends included."""
    statistic: Over = "mean"
    """How the standard deviation is summed up over temperature."""
    target: PositiveAngle | None = None
    """Limit on the standard deviation, which gives a verdict."""


class TurnRequirement(_OfUnit):
    """Heading error after a level turn about the body's z axis."""

    ELEMENTS: ClassVar[tuple[Elements, ...]] = ("all", "worst", "z")

    quantity: Literal["heading"]
    """What must be good."""
    turn: PositiveAngle
    """Angle of the turn."""
    rate: PositiveRate
    """Rate of the turn."""
    grid: tuple[Points] = (101,)
    """Number of temperatures, ends included."""
    statistic: Over = "mean"
    """How the standard deviation is summed up over temperature."""
    target: PositiveAngle | None = None
    """Limit on the standard deviation, which gives a verdict."""


def _requirement(value: object) -> object:
    classes: dict[str, type[Section]] = {
        "gyro_bias": GyroBiasRequirement,
        "gyro_scale_factor": GyroScaleFactorRequirement,
        "gyro_misalignment": MisalignmentRequirement,
        "g_sensitivity": SensitivityRequirement,
        "accelerometer_bias": AccelerometerBiasRequirement,
        "accelerometer_scale_factor": AccelerometerScaleFactorRequirement,
        "accelerometer_misalignment": MisalignmentRequirement,
        "second_order": SecondOrderRequirement,
        "position": PositionRequirement,
        "tilt": TiltRequirement,
        "heading": TurnRequirement,
    }
    return choose(value, "quantity", classes)


UnitRequirement = Annotated[
    GyroBiasRequirement
    | GyroScaleFactorRequirement
    | MisalignmentRequirement
    | SensitivityRequirement
    | AccelerometerBiasRequirement
    | AccelerometerScaleFactorRequirement
    | SecondOrderRequirement
    | PositionRequirement
    | TiltRequirement
    | TurnRequirement,
    BeforeValidator(_requirement),
]
UnitRequirements = Annotated[tuple[UnitRequirement, ...], Field(max_length=100)]
