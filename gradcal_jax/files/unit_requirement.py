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
    temperature: tuple[Temperature, Temperature]
    axis: Elements = "worst"

    @model_validator(mode="after")
    def _ordered(self) -> "_OfUnit":
        problems = increasing(self.temperature, "temperature")
        if self.axis not in self.ELEMENTS:
            problems.append(Problem(("axis",), f"expected {one_of(self.ELEMENTS)}", self.axis))
        refuse(*problems)
        return self


class _OverTemperature(_OfUnit):
    """`statistic`: of each element over temperature; then `axis`: the worst of them, or "all" (root mean square)."""

    grid: tuple[Points] = (101,)
    statistic: Over = "mean"


class GyroBiasRequirement(_OverTemperature):
    """Bias of the gyros, over temperature."""

    quantity: Literal["gyro_bias"]
    target: PositiveRate | None = None


class GyroScaleFactorRequirement(_OfUnit):
    """Scale factor of the gyros over a box of temperature and rate."""

    quantity: Literal["gyro_scale_factor"]
    rate: tuple[Rate, Rate]
    grid: tuple[Points, Points] = (101, 121)
    statistic: Literal["mean of max", "mean", "max", "rms"] = "mean of max"
    target: PositiveScaleFactor | None = None

    @model_validator(mode="after")
    def _rates(self) -> "GyroScaleFactorRequirement":
        refuse(*increasing(self.rate, "rate"))
        return self


class MisalignmentRequirement(_OverTemperature):
    """Misalignments of gyros or accelerometers, `relative_to` the table's axes, the case (adds
    the mounting's accuracy), or to the unit itself ("internal": non-orthogonality, and gyros to accelerometers)."""

    quantity: Literal["gyro_misalignment", "accelerometer_misalignment"]
    relative_to: Literal["table", "case", "internal"] = "table"
    axis: Elements = "all"
    target: PositiveAngle | None = None


class SensitivityRequirement(_OverTemperature):
    """Drift of the gyros for a unit of specific force."""

    quantity: Literal["g_sensitivity"]
    axis: Elements = "all"
    target: PositiveAccelerationSensitivity | None = None


class AccelerometerBiasRequirement(_OverTemperature):
    """Bias of the accelerometers."""

    quantity: Literal["accelerometer_bias"]
    target: PositiveSpecificForce | None = None


class AccelerometerScaleFactorRequirement(_OverTemperature):
    """Scale factor of the accelerometers."""

    quantity: Literal["accelerometer_scale_factor"]
    target: PositiveScaleFactor | None = None


class SecondOrderRequirement(_OverTemperature):
    """K2 of the accelerometers."""

    quantity: Literal["second_order"]
    target: PositiveSecondOrder | None = None


class PositionRequirement(_OfUnit):
    """Horizontal position after free-inertial navigation at rest, level, for `after`: the calibration's part."""

    ELEMENTS: ClassVar[tuple[Elements, ...]] = ("all", "worst", "x", "y")

    quantity: Literal["position"]
    after: Time
    grid: tuple[Points] = (101,)
    statistic: Over = "mean"
    target: PositiveLength | None = None


class TiltRequirement(_OfUnit):
    """Error of the vertical that levelled accelerometers give, the worse of two directions."""

    ELEMENTS: ClassVar[tuple[Elements, ...]] = ("all", "worst", "x", "y")

    quantity: Literal["tilt"]
    grid: tuple[Points] = (101,)
    statistic: Over = "mean"
    target: PositiveAngle | None = None


class TurnRequirement(_OfUnit):
    """Heading error after a level turn by `turn` at the rate `rate`, about the body's z axis."""

    ELEMENTS: ClassVar[tuple[Elements, ...]] = ("all", "worst", "z")

    quantity: Literal["heading"]
    turn: PositiveAngle
    rate: PositiveRate
    grid: tuple[Points] = (101,)
    statistic: Over = "mean"
    target: PositiveAngle | None = None


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
