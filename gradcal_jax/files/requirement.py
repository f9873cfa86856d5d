"""`[[requirement]]`: the errors that a calibration limits, and their statistics."""

from collections.abc import Iterator
from typing import Annotated, Any, ClassVar, Final, Literal, get_args

from pydantic import Field, Strict, model_validator

from gradcal_jax.files import quantity as q
from gradcal_jax.files.bases import increasing
from gradcal_jax.files.mission import Missions
from gradcal_jax.files.problems import Problem, one_of
from gradcal_jax.files.section import Section, chosen_by, refuse

Coverage = Annotated[float, Strict(), Field(gt=0.0, le=10.0, allow_inf_nan=False)]
Risk = Annotated[q.Quantity, q.Of("scale factor", above="0 %", at_most="50 %")]
Points = Annotated[int, Field(strict=True, ge=2, le=5001)]


class _OfRuns(Section):
    of: Literal["any run", "this run"] = "any run"
    """Whether the turn-on bias of another power-on counts: in "any run" it does, in "this run" it does not."""


Over = Literal["mean", "max", "rms"]
Elements = Literal["all", "worst", "x", "y", "z"]


class _OfElements(Section):
    ELEMENTS: ClassVar[tuple[Elements, ...]] = ("all", "worst", "x", "y", "z")

    name: q.Text
    """Name of the requirement in verdicts and [design]."""
    axis: Elements = "worst"
    """One element, the worst of them, or all (root mean square)."""
    target: Any = None
    """Limit on the error, which gives a verdict; absent: none."""
    coverage: Coverage = 1.0
    """Number of standard deviations that must be within the target."""
    risk: Risk | None = None
    """Largest probability that a sensor beyond the target passes; absent: simple acceptance."""

    def _problems(self) -> Iterator[Problem]:
        if self.axis not in self.ELEMENTS:
            yield Problem(("axis",), f"expected {one_of(self.ELEMENTS)}", self.axis)


class _InARange(_OfElements):
    temperature: tuple[q.Temperature, q.Temperature]
    """Lowest and highest temperature."""

    def _problems(self) -> Iterator[Problem]:
        yield from _OfElements._problems(self)
        yield from increasing(self.temperature, "temperature")


class _OverTemperature(_InARange):
    """A requirement over temperature, summed up first of each element, then over the elements."""

    grid: tuple[Points] = (101,)
    """Number of temperatures, ends included."""
    statistic: Over = "mean"
    """Statistic of each element's standard deviation over temperature."""
    quantity: Any
    """What must be good."""


class _OnAPath(Section):
    """On which path of the temperature a quantity must be good."""

    branch: Literal["heating", "cooling", "both"] | None = None
    """Branch of the temperature on which the error counts; "both": the larger error at every temperature. Absent: the
    mean of both, without hysteresis."""
    slope: tuple[q.TemperatureSlope, q.TemperatureSlope] | None = None
    """Lowest and highest dT/dt in service, whose errors count; absent: constant temperature."""

    @model_validator(mode="after")
    def _path(self) -> "_OnAPath":
        if self.slope is not None:
            low, high = self.slope
            if low > high:
                refuse(Problem(("slope",), "expected the lowest first", [str(low), str(high)]))
            if (self.branch == "heating" and high < 0.0) or (self.branch == "cooling" and low > 0.0):
                refuse(Problem(("slope",), f"this range has no {self.branch}", [str(low), str(high)]))
        return self

    def service(self) -> tuple[tuple[float, float], ...]:
        """States in which the error may be largest: the sign of T less the play (1: heating, −1: cooling, 0: the mean
        of both), and dT/dt (K/s)."""
        signs = {None: (0.0,), "both": (1.0, -1.0), "heating": (1.0,), "cooling": (-1.0,)}[self.branch]
        low, high = (0.0, 0.0) if self.slope is None else (float(s) for s in self.slope)
        ends = {1.0: (max(low, 0.0), max(high, 0.0)), -1.0: (min(low, 0.0), min(high, 0.0)), 0.0: (low, high)}
        return tuple(dict.fromkeys((sign, end) for sign in signs for end in ends[sign]))


class GyroBiasRequirement(_OverTemperature, _OfRuns, _OnAPath):
    """Bias of the gyros, over temperature."""

    quantity: Literal["gyro_bias"]
    target: q.PositiveRate | None = None


class GyroScaleFactorRequirement(_InARange, _OnAPath):
    """Scale factor of the gyros over a box of temperature and rate."""

    quantity: Literal["gyro_scale_factor"]
    """What must be good."""
    rate: tuple[q.Rate, q.Rate]
    """Lowest and highest rate."""
    grid: tuple[Points, Points] = (101, 121)
    """Numbers of temperatures and of rates, ends included."""
    statistic: Literal["mean of max", "mean", "max", "rms"] = "mean of max"
    """Statistic of the standard deviation over the box."""
    target: q.PositiveScaleFactor | None = None

    def _problems(self) -> Iterator[Problem]:
        yield from _InARange._problems(self)
        yield from increasing(self.rate, "rate")
        if self.grid[0] * self.grid[1] > 1_000_000:
            yield Problem(("grid",), "at most 1000000 points together", list(self.grid))


class MisalignmentRequirement(_OverTemperature):
    """Misalignments of gyros or accelerometers."""

    quantity: Literal["gyro_misalignment", "accelerometer_misalignment"]
    relative_to: Literal["table", "case", "internal"] = "table"
    """The table's axes, the case (adds the mounting's accuracy), or the IMU itself."""
    axis: Elements = "all"
    target: q.PositiveAngle | None = None


class SensitivityRequirement(_OverTemperature):
    """Drift of the gyros per unit of specific force."""

    quantity: Literal["g_sensitivity"]
    axis: Elements = "all"
    target: q.PositiveAccelerationSensitivity | None = None


class AccelerometerBiasRequirement(_OverTemperature, _OfRuns, _OnAPath):
    """Bias of the accelerometers."""

    quantity: Literal["accelerometer_bias"]
    target: q.PositiveSpecificForce | None = None


class AccelerometerScaleFactorRequirement(_OverTemperature, _OnAPath):
    """Scale factor of the accelerometers."""

    quantity: Literal["accelerometer_scale_factor"]
    target: q.PositiveScaleFactor | None = None


class SecondOrderRequirement(_OverTemperature):
    """K2 of the accelerometers."""

    quantity: Literal["second_order"]
    target: q.PositiveSecondOrder | None = None


class PositionRequirement(_OverTemperature, _OfRuns):
    """Horizontal position error after free-inertial navigation at rest and level, from the calibration alone."""

    ELEMENTS: ClassVar[tuple[Elements, ...]] = ("all", "worst", "x", "y")

    quantity: Literal["position"]
    after: q.Time
    """How long the navigation lasts."""
    target: q.PositiveLength | None = None


class TiltRequirement(_OverTemperature, _OfRuns):
    """Error of the vertical from levelled accelerometers, in the worse of two directions."""

    ELEMENTS: ClassVar[tuple[Elements, ...]] = ("all", "worst", "x", "y")

    quantity: Literal["tilt"]
    target: q.PositiveAngle | None = None


class TurnRequirement(_OverTemperature, _OfRuns):
    """Heading error after a level turn about the body's z axis."""

    ELEMENTS: ClassVar[tuple[Elements, ...]] = ("all", "worst", "z")

    quantity: Literal["heading"]
    turn: q.PositiveAngle
    """Angle of the turn."""
    rate: q.PositiveRate
    """Rate of the turn."""
    target: q.PositiveAngle | None = None


class MissionHeadingRequirement(_OfElements):
    """The calibration's error in the integrated rate of a gyro at the end of a `mission`, or `after` a time in it.

    For several missions the weighted root mean square, or the "max". `target` limits only the contribution of the
    calibration, because no calibration removes the sensor's own noise.
    """

    quantity: Literal["mission_heading"]
    """What must be good."""
    mission: Missions
    """Tables of rate and temperature over time, with weights."""
    after: q.Time | None = None
    """When the error is taken; absent: at the end of each mission."""
    statistic: Literal["rms", "max"] = "rms"
    """Statistic over several missions."""
    target: q.PositiveAngle | None = None

    def _problems(self) -> Iterator[Problem]:
        yield from _OfElements._problems(self)
        for i, mission in enumerate(self.mission):
            end = mission.rows.time[-1]
            if self.after is not None and self.after > end:
                message = f"is after the end of {mission.file}, which lasts {end:.6g} s"
                yield Problem(("after",), message, self.after.text)
            if self.statistic == "max" and "weight" in mission.model_fields_set:
                yield Problem(("mission", i, "weight"), 'has no effect on the statistic "max"', mission.weight)

    @property
    def grid(self) -> tuple[int]:
        """Number of missions."""
        return (len(self.mission),)

    @property
    def temperature(self) -> tuple[q.Quantity, q.Quantity]:
        """The coldest and the warmest of all missions."""
        every = [t for mission in self.mission for t in mission.rows.temperature]
        return q.Quantity.of(min(every), "degC"), q.Quantity.of(max(every), "degC")

    @property
    def rate(self) -> tuple[q.Quantity, q.Quantity]:
        """The least and the largest rate of all missions."""
        every = [w for mission in self.mission for w in mission.rows.rate]
        return q.Quantity.of(min(every), "deg/s"), q.Quantity.of(max(every), "deg/s")


class NorthRequirement(_OverTemperature):
    """The error of a gyrocompass: the error of a gyro's bias divided by the horizontal Earth rate at the `latitude`."""

    quantity: Literal["north"]
    latitude: Annotated[q.Quantity, q.Of("angle", at_least="-89 deg", at_most="89 deg")]
    """Where north is sought."""
    after: q.Time
    """Duration of the rest to find north, which determines the effect of the sensor's own noise."""
    target: q.PositiveAngle | None = None


Requirement = (
    GyroBiasRequirement
    | GyroScaleFactorRequirement
    | MisalignmentRequirement
    | SensitivityRequirement
    | AccelerometerBiasRequirement
    | AccelerometerScaleFactorRequirement
    | SecondOrderRequirement
    | PositionRequirement
    | TiltRequirement
    | TurnRequirement
    | MissionHeadingRequirement
    | NorthRequirement
)
_CLASSES: Final = {name: of for of in get_args(Requirement) for name in get_args(of.__annotations__["quantity"])}
Requirements = Annotated[tuple[Annotated[Requirement, chosen_by("quantity", _CLASSES)], ...], Field(max_length=100)]
