"""`[[requirement]]`: the errors that a calibration limits, and their statistics."""

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Final, Literal, NamedTuple, cast, get_args

from pydantic import Field, Strict, model_validator

from gradcal_jax.spec.bases import increasing
from gradcal_jax.tables import quantity as q
from gradcal_jax.tables.problems import Problem
from gradcal_jax.tables.section import OneOrMore, Section, chosen_by
from gradcal_jax.units import DEG_PER_H, PPM, G

Coverage = Annotated[float, Strict(), Field(gt=0.0, le=10.0, allow_inf_nan=False)]
Points = Annotated[int, Field(strict=True, ge=2, le=5001)]


class LimitedQuantity(NamedTuple):
    """A quantity of requirements: the `kind` of its channels; the table [sensor.kind.section] that estimates it; the
    name of its terms in the model, with {} one for each axis; its unit in output, and the number of these units in one
    SI unit."""

    kind: Literal["gyro", "accelerometer"]
    section: str
    term: str
    unit: str
    factor: float


QUANTITIES: Final = {
    "gyro_bias": LimitedQuantity("gyro", "bias", "bias", "deg/h", DEG_PER_H),
    "gyro_scale_factor": LimitedQuantity("gyro", "scale_factor", "scale_factor", "ppm", PPM),
    "gyro_misalignment": LimitedQuantity("gyro", "misalignment", "misalignment_{}", "urad", 1e6),
    "g_sensitivity": LimitedQuantity("gyro", "g_sensitivity", "g_sensitivity_{}", "deg/h/g", DEG_PER_H * G),
    "accelerometer_bias": LimitedQuantity("accelerometer", "bias", "bias", "ug", 1e6 / G),
    "accelerometer_scale_factor": LimitedQuantity("accelerometer", "scale_factor", "scale_factor", "ppm", PPM),
    "accelerometer_misalignment": LimitedQuantity("accelerometer", "misalignment", "misalignment_{}", "urad", 1e6),
    "second_order": LimitedQuantity("accelerometer", "second_order", "second_order", "ug/g^2", 1e6 * G),
}
"""What a requirement may limit, by the name in its class; everything else reads these rows."""
Statistic = Literal["mean of max", "max", "mean", "rms"]
Over = Literal["mean", "max", "rms"]
Elements = Literal["all", "worst", "x", "y", "z"]


class _OfElements(Section):
    name: q.Text
    """Name of the requirement, used in verdicts and in [design]; absent: its quantity in words."""
    quantity: Any
    """Quantity that the requirement limits."""
    axis: Elements = "worst"
    """One axis, the worst of all axes, or the root mean square over all axes."""
    target: Any = None
    """Limit on the error; absent: there is no verdict."""
    coverage: Coverage = 1.0
    """Number of standard deviations that must be within the target."""
    temperature: tuple[q.Temperature, q.Temperature]
    """Lowest and highest temperature of the requirement."""

    @model_validator(mode="before")
    @classmethod
    def _named(cls, value: object) -> object:
        if not isinstance(value, Mapping):
            return value
        table = cast("Mapping[str, object]", value)
        quantity = table.get("quantity")
        return {"name": str(quantity).replace("_", " "), **table} if isinstance(quantity, str) else table

    def _problems(self) -> Iterator[Problem]:
        yield from increasing(self.temperature, "temperature")


class _OverTemperature(_OfElements):
    """A requirement over temperature: a statistic over temperature for each axis, and then a combination of the
    axes."""

    grid: tuple[Points] = (101,)
    """Number of temperatures at which the error is evaluated, ends included."""
    statistic: Over = "mean"
    """Statistic over temperature of the standard deviation of each axis."""


class _OnAPath(Section):
    """The change of temperature for which the requirement holds."""

    branch: Literal["heating", "cooling", "both"] | None = None
    """Direction of the temperature's change for which the error counts; "both": at every temperature, the larger of the
    two errors. Absent: the mean of heating and cooling, without hysteresis."""
    slope: tuple[q.TemperatureSlope, q.TemperatureSlope] | None = None
    """Lowest and highest dT/dt in service; the errors that dT/dt causes are included. Absent: the temperature is
    constant in service."""

    def _problems(self) -> Iterator[Problem]:
        low, high = self.slope or (0.0, 0.0)
        if low > high:
            yield Problem(("slope",), "expected [lowest, highest]", [str(low), str(high)])
        elif (self.branch == "heating" and high < 0.0) or (self.branch == "cooling" and low > 0.0):
            message = f'this range of slopes contains no {self.branch}, but branch = "{self.branch}" needs it'
            yield Problem(("slope",), message, [str(low), str(high)])

    def service(self) -> tuple[tuple[float, float], ...]:
        """States in which the error may be largest: the sign of T less the play (1: heating, −1: cooling, 0: the mean
        of both), and dT/dt (K/s)."""
        signs = {None: (0.0,), "both": (1.0, -1.0), "heating": (1.0,), "cooling": (-1.0,)}[self.branch]
        low, high = (0.0, 0.0) if self.slope is None else (float(s) for s in self.slope)
        ends = {1.0: (max(low, 0.0), max(high, 0.0)), -1.0: (min(low, 0.0), min(high, 0.0)), 0.0: (low, high)}
        return tuple(dict.fromkeys((sign, end) for sign in signs for end in ends[sign]))


class _BiasRequirement(_OverTemperature, _OnAPath):
    of: Literal["any run", "this run"] = "any run"
    """Whether the turn-on bias of another power-on counts: with "any run" it does, with "this run" it does not."""


class GyroBiasRequirement(_BiasRequirement):
    """Bias of the gyros, over temperature."""

    quantity: Literal["gyro_bias"]
    target: q.PositiveRate | None = None


class GyroScaleFactorRequirement(_OfElements, _OnAPath):
    """Scale factor of the gyros over ranges of temperature and rate."""

    quantity: Literal["gyro_scale_factor"]
    rate: tuple[q.Rate, q.Rate]
    """Lowest and highest rate of the requirement."""
    grid: tuple[Points, Points] = (101, 121)
    """Number of temperatures and number of rates at which the error is evaluated, ends included."""
    statistic: Literal["mean of max", "mean", "max", "rms"] = "mean of max"
    """Statistic of the standard deviation over temperature and rate."""
    target: q.PositiveScaleFactor | None = None

    def _problems(self) -> Iterator[Problem]:
        yield from increasing(self.rate, "rate")
        if self.grid[0] * self.grid[1] > 1_000_000:
            yield Problem(("grid",), "must have at most 1000000 points in all", list(self.grid))


class MisalignmentRequirement(_OverTemperature):
    """Misalignments of gyros or accelerometers."""

    quantity: Literal["gyro_misalignment", "accelerometer_misalignment"]
    relative_to: Literal["table", "case", "internal"] = "table"
    """Reference of the misalignments: the table's axes, the case (which adds the mounting's accuracy), or the IMU
    itself (misalignments of its axes relative to each other)."""
    axis: Elements = "all"
    target: q.PositiveAngle | None = None


class SensitivityRequirement(_OverTemperature):
    """Bias of the gyros in proportion to the specific force (g-sensitivity)."""

    quantity: Literal["g_sensitivity"]
    axis: Elements = "all"
    target: q.PositiveAccelerationSensitivity | None = None


class AccelerometerBiasRequirement(_BiasRequirement):
    """Bias of the accelerometers."""

    quantity: Literal["accelerometer_bias"]
    target: q.PositiveSpecificForce | None = None


class AccelerometerScaleFactorRequirement(_OverTemperature, _OnAPath):
    """Scale factor of the accelerometers."""

    quantity: Literal["accelerometer_scale_factor"]
    target: q.PositiveScaleFactor | None = None


class SecondOrderRequirement(_OverTemperature):
    """K2 of the accelerometers: output in proportion to the square of the specific force."""

    quantity: Literal["second_order"]
    target: q.Positive[q.SecondOrder] | None = None


Requirement = (
    GyroBiasRequirement
    | GyroScaleFactorRequirement
    | MisalignmentRequirement
    | SensitivityRequirement
    | AccelerometerBiasRequirement
    | AccelerometerScaleFactorRequirement
    | SecondOrderRequirement
)
_CLASSES: Final = {name: of for of in get_args(Requirement) for name in get_args(of.__annotations__["quantity"])}
_One = Annotated[Requirement, chosen_by("quantity", _CLASSES)]
Requirements = Annotated[tuple[_One, ...], Field(max_length=100), OneOrMore()]
