"""`[sensor]` of a whole unit: three gyros and three accelerometers, their errors, noise and frame."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from gradcal_jax.files.bases import TemperatureBasis
from gradcal_jax.files.problems import Problem
from gradcal_jax.files.quantity import (
    AngleRandomWalk,
    Margin,
    PositiveAccelerationSensitivity,
    PositiveAngle,
    PositiveLength,
    PositiveRate,
    PositiveScaleFactor,
    PositiveSecondOrder,
    PositiveSpecificForce,
    PositiveSquareSensitivity,
    PositiveThirdOrder,
    Quantity,
    RateRandomWalk,
    SizeOfScaleFactor,
    Text,
    Time,
    VelocityRandomWalk,
)
from gradcal_jax.files.section import Section, refuse
from gradcal_jax.files.sensor import Bias, Drift, ScaleFactor, ScaleFactorInstability

BodyAxis = Literal["x", "y", "z"]
BodyAxes = Annotated[tuple[BodyAxis, ...], Field(min_length=1, max_length=3)]


class Misalignment(Section):
    """Small angles of an input axis towards the two others. `temperature` absent: constant; `prior` absent: flat."""

    temperature: TemperatureBasis | None = None
    prior: PositiveAngle | None = None


class AccelerationSensitivity(Section):
    """Drift of a gyro in proportion to the specific force, three coefficients each (IEEE 528)."""

    temperature: TemperatureBasis | None = None
    prior: PositiveAccelerationSensitivity | None = None


class SquaredSensitivity(Section):
    """Drift of a gyro in proportion to the square of the specific force along each axis."""

    temperature: TemperatureBasis | None = None
    prior: PositiveSquareSensitivity | None = None


class SpecificForceDrift(Section):
    """Instability of an accelerometer's bias: a first-order Gauss–Markov process."""

    standard_deviation: PositiveSpecificForce
    correlation_time: Time


class SpecificForceBias(Section):
    """An accelerometer's bias over temperature."""

    temperature: TemperatureBasis | None = None
    prior: PositiveSpecificForce | None = None


class SpecificForceScale(Section):
    """An accelerometer's scale factor, or its asymmetry, over temperature."""

    temperature: TemperatureBasis | None = None
    prior: PositiveScaleFactor | None = None


class SecondOrder(Section):
    """An accelerometer's K2, or its cross-coupling of two axes, over temperature."""

    temperature: TemperatureBasis | None = None
    prior: PositiveSecondOrder | None = None


class ThirdOrder(Section):
    """An accelerometer's K3 over temperature."""

    temperature: TemperatureBasis | None = None
    prior: PositiveThirdOrder | None = None


class LeverArm(Section):
    """Where an accelerometer sits, from where the table's axes meet: three coordinates, each with the prior `prior`."""

    prior: PositiveLength | None = None


class GyroTriad(Section):
    """`[sensor.gyro]`: what is the same for every gyro of the unit. A table that is absent is not estimated: known."""

    axes: BodyAxes = ("x", "y", "z")
    angle_random_walk: AngleRandomWalk
    rate_random_walk: RateRandomWalk | None = None
    full_scale: PositiveRate | None = None
    full_scale_margin: Margin = Quantity(0.05, "5 %", "scale factor")
    drift: Annotated[tuple[Drift, ...], Field(max_length=20)] = ()
    scale_factor_instability: Annotated[tuple[ScaleFactorInstability, ...], Field(max_length=20)] = ()
    bias: Bias
    scale_factor: ScaleFactor | None = None
    misalignment: Misalignment | None = None
    g_sensitivity: AccelerationSensitivity | None = None
    g_squared: SquaredSensitivity | None = None

    @property
    def usable_rate(self) -> float | None:
        """Full scale less its margin (rad/s); None where the sheet gives no full scale."""
        return None if self.full_scale is None else self.full_scale * (1.0 - self.full_scale_margin)


class AccelerometerTriad(Section):
    """`[sensor.accelerometer]`: what is the same for every accelerometer of the unit. Read where the table stands, and
    on moves no faster than `read_on_moves_below`."""

    axes: BodyAxes = ("x", "y", "z")
    velocity_random_walk: VelocityRandomWalk
    drift: Annotated[tuple[SpecificForceDrift, ...], Field(max_length=20)] = ()
    bias: SpecificForceBias
    scale_factor: SpecificForceScale | None = None
    misalignment: Misalignment | None = None
    second_order: SecondOrder | None = None
    third_order: ThirdOrder | None = None
    asymmetry: SpecificForceScale | None = None
    read_on_moves_below: PositiveRate | None = None
    lever_arm: LeverArm | None = None
    cross_coupling: SecondOrder | None = None

    @model_validator(mode="after")
    def _seen(self) -> "AccelerometerTriad":
        if self.lever_arm is not None and self.read_on_moves_below is None:
            message = "has no effect at rest, where alone accelerometers are read; leave it out, or read them on slow "
            refuse(Problem(("lever_arm",), message + 'moves, too: read_on_moves_below = "5 deg/s"'))
        if self.asymmetry is not None and self.read_on_moves_below is not None:
            message = "is told at rest alone, where the force keeps its sign; leave it out, or read_on_moves_below"
            refuse(Problem(("asymmetry",), message))
        return self


class UnitFrame(Section):
    """What the misalignments count from. "table axes": the table's at zero, through the nominal mounting; "case": the
    case, whose mounting is only known to its accuracy."""

    fixed_by: Literal["table axes", "case"] = "table axes"


class UnitSensor(Section):
    """A whole unit: gyros, accelerometers, or both. `thermal_lag` between chamber and dies; one clock stamps all."""

    name: Text | None = None
    thermal_lag: Time | None = None
    sample_clock_error: SizeOfScaleFactor | None = None
    gyro: GyroTriad | None = None
    accelerometer: AccelerometerTriad | None = None
    frame: UnitFrame | None = None

    @model_validator(mode="after")
    def _something_to_find(self) -> "UnitSensor":
        problems: list[Problem] = []
        for name, triad in (("gyro", self.gyro), ("accelerometer", self.accelerometer)):
            if triad is not None and len(set(triad.axes)) < len(triad.axes):
                problems.append(Problem((name, "axes"), "names an axis twice", list(triad.axes)))
        if self.gyro is None and self.accelerometer is None:
            problems.append(Problem((), "there is nothing to calibrate; add [sensor.gyro] or [sensor.accelerometer]"))
        refuse(*problems)
        return self
