"""`[sensor]`: the device under calibration, its noise, and its unknown error functions; one gyro axis or an IMU.

Gyros and accelerometers have the same tables, generic in the quantity of the error (`Value`: rad/s or m/s²), of its
slope over temperature and of its sensitivity to dT/dt.
"""

import math
from collections.abc import Iterator, Mapping
from typing import Annotated, ClassVar, Final, Generic, Literal, TypeVar, cast

from pydantic import Discriminator, Field, Tag

from gradcal_jax.spec import temperature_path as path_terms
from gradcal_jax.spec.bases import Degree, PolynomialKeys, RateBasis, TemperatureBasis, TemperaturePolynomial
from gradcal_jax.spec.temperature_path import Gradient, Slope, Value
from gradcal_jax.tables import quantity as q
from gradcal_jax.tables.problems import Problem
from gradcal_jax.tables.section import OneOrMore, Section

FULL_SCALE_MARGIN: Final = 0.05
"""Fraction of a gyro's full scale that plans leave unused."""
HOST_CLOCK: Final = 1e-6
"""Standard deviation, a ratio, of a sensor's clock after a run has compared it with the computer's. The comparison
itself (time stamps with errors of about 1 ms at both ends) is accurate to 0.1 ppm over hours; the computer's own clock,
kept by a time server, to 1 ppm."""
Grade = Literal["consumer", "tactical", "navigation"]
BodyAxis = Literal["x", "y", "z"]
BodyAxes = Annotated[tuple[BodyAxis, ...], Field(min_length=1, max_length=3)]


class DriftProcess(Section, Generic[Value]):
    """An in-run instability: a first-order Gauss–Markov process. That of a scale factor is multiplied by the rate or
    the force."""

    standard_deviation: q.Positive[Value]
    """Stationary standard deviation of the error; of a scale factor a ratio."""
    correlation_time: q.Time
    """Time constant of the autocorrelation."""


ScaleFactorInstability = DriftProcess[q.ScaleFactor]


class TemperatureError(Section):
    """Error of the temperature measurement; the slopes of the maps over temperature convert it into an error of the
    rate or the force."""

    standard_deviation: q.SizeOfTemperatureDifference
    """Standard deviation of the measured temperature's error; 0 K: there is no error."""
    correlation_time: q.Time | None = None
    """Time constant of the error's autocorrelation; absent: the error is constant during the run."""
    bias_slope: q.BiasSlope | None = None
    """Typical slope of the bias over temperature; the temperature error times this slope is the bias error."""
    scale_factor_slope: q.ScaleFactorSlope | None = None
    """Typical slope of the scale factor over temperature; the temperature error times this slope is the scale-factor
    error."""

    def _problems(self) -> Iterator[Problem]:
        if self.standard_deviation and self.bias_slope is None and self.scale_factor_slope is None:
            message = 'a temperature error acts through "bias_slope" or "scale_factor_slope"; give at least one'
            yield Problem((), message)


class BiasTemperatureGradient(Section, Generic[Gradient]):
    """Bias sensitivity to dT/dt; if this table is present, the sensitivity is estimated."""

    prior: q.Size[Gradient] | None = None
    """Standard deviation of the sensitivity before the calibration; absent: unknown; 0: there is no such
    sensitivity."""


class EstimatedTerm(Section, Generic[Value]):
    """An estimated error: a function of `temperature` and `rate`, as far as its table has these bases."""

    prior: q.OneOrEach[q.Positive[Value]] | None = None
    """Standard deviation of each coefficient before the calibration, or a list of them; absent: unknown."""

    @property
    def _bases(self) -> dict[str, TemperatureBasis | RateBasis]:
        bases = ((name, getattr(self, name, None)) for name in ("temperature", "rate"))
        return {name: basis for name, basis in bases if basis is not None}

    @property
    def size(self) -> int:
        """Number of coefficients."""
        return math.prod(basis.size for basis in self._bases.values())

    def _problems(self) -> Iterator[Problem]:
        prior: object = self.prior
        if isinstance(prior, tuple) and len(cast("tuple[object, ...]", prior)) != self.size:
            message = f"expected one figure for all coefficients, or {self.size}, one for each coefficient"
            yield Problem(("prior",), message)


class ConstantTerm(EstimatedTerm[Value], Generic[Value]):
    """An error that does not depend on temperature."""

    temperature: ClassVar[None] = None


class TemperatureTerm(EstimatedTerm[Value], Generic[Value]):
    """An error over temperature."""

    temperature: TemperaturePolynomial | None = None
    """Basis over temperature; absent: constant."""


class HiddenStructure(Section, Generic[Value]):
    """Structure of a map that the model lacks: the next orthogonal polynomials up to these degrees, with a prior for
    their coefficients."""

    standard_deviation: q.Positive[Value]
    """Prior standard deviation of each of the hidden coefficients; of a scale factor a ratio."""
    temperature_degree: Degree
    """Highest degree in temperature of the hidden polynomials."""


class ScaleFactorDiscrepancy(HiddenStructure[q.ScaleFactor]):
    """Structure of M(T, ω) that the model lacks."""

    rate_degree: Degree
    """Highest degree in rate of the hidden polynomials."""


Hidden = TypeVar("Hidden")


class GyroMap(EstimatedTerm[Value], Generic[Value, Hidden]):
    """A map of a gyro."""

    temperature: TemperatureBasis
    """Basis over temperature."""
    smoothness: q.Positive[Value] | None = None
    """Standard deviation of the difference of neighbouring coefficients; only for splines and bins."""
    discrepancy: Hidden | None = None
    """Possible structure of the map beyond its basis."""

    def _problems(self) -> Iterator[Problem]:
        polynomials = {name: of for name, of in self._bases.items() if isinstance(of, PolynomialKeys)}
        all_polynomials, hidden = polynomials == self._bases, self.discrepancy
        if self.smoothness is not None and all_polynomials:
            message = 'neighbouring coefficients exist only for "b-spline" and "bins"; leave this key out'
            yield Problem(("smoothness",), message, str(self.smoothness))
        if hidden is not None and not all_polynomials:
            message = 'is only for polynomials; for B-splines and bins, use "smoothness" instead'
            yield Problem(("discrepancy",), message)
        elif hidden is not None and all(getattr(hidden, f"{k}_degree") <= of.degree for k, of in polynomials.items()):
            yield Problem(("discrepancy",), "at least one of its degrees must exceed that of the map")


class Bias(GyroMap[q.Rate, HiddenStructure[q.Rate]]):
    """The estimated bias B(T)."""


class ScaleFactor(GyroMap[q.ScaleFactor, ScaleFactorDiscrepancy]):
    """The estimated scale-factor error M(T, ω): products of functions of temperature and functions of
    rate."""

    rate: RateBasis
    """Basis over rate."""


class GSensitivity(Section):
    """Bias of a gyro in proportion to the specific force, with three coefficients for each gyro (IEEE 528)."""

    temperature: ClassVar[None] = None

    prior: q.PositiveAccelerationSensitivity | None = None
    """Standard deviation of each coefficient before the calibration; absent: unknown."""
    lever_arm: q.PositiveLength | None = None
    """Standard deviation of each coordinate of the gyros' position, relative to the accelerometers or, without
    accelerometers, to the intersection of the table's axes. If the gyros are away from this point, rotation adds a
    specific force that is not measured. This force causes a bias for each product of two rates (`ww_xy`); the bias is
    estimated but is not part of the calibration."""

    def _problems(self) -> Iterator[Problem]:
        if self.lever_arm is not None and self.prior is None:
            message = "has an effect only through the g-sensitivity: also give the prior of g_sensitivity"
            yield Problem(("lever_arm",), message)

    @property
    def of_rotation(self) -> float:
        """Standard deviation of the bias for each product of two rates (s): of `g_j d_k + g_k d_j`, as of
        `g_y d_y + g_z d_z`, with the sensitivity g and the lever arm d."""
        return math.sqrt(2.0) * float(self.prior or 0.0) * float(self.lever_arm or 0.0)


Misalignment = TemperatureTerm[q.Angle]
SpecificForceBias = TemperatureTerm[q.Acceleration]
SpecificForceScale = TemperatureTerm[q.ScaleFactor]
SecondOrder = ConstantTerm[q.SecondOrder]


class Triad(path_terms.TemperaturePath[Slope], Generic[Value, Slope, Gradient]):
    """Common properties of the gyros, or of the accelerometers. If the key of an error term is absent, the error is
    assumed to be known, and is not estimated."""

    axes: BodyAxes = ("x", "y", "z")
    """Axes along which the IMU has a gyro or an accelerometer."""
    turn_on_bias: q.Size[Value] | None = None
    """Standard deviation of the part of the bias that takes a new value at every power-on and is not part of the
    map."""
    drift: Annotated[tuple[DriftProcess[Value], ...], Field(max_length=20), OneOrMore()] = ()
    """In-run bias instabilities; their sum is the error."""
    bias_temperature_gradient: (
        Annotated[
            Annotated[BiasTemperatureGradient[Gradient], Tag("<table>")] | Annotated[q.Size[Gradient], Tag("<figure>")],
            Discriminator(lambda value: "<table>" if isinstance(value, Mapping | Section) else "<figure>"),
        ]
        | None
    ) = None
    """Bias proportional to dT/dt. A table: the sensitivity is estimated. A single figure: the standard deviation of the
    sensitivity, which is then not estimated but is included in the uncertainty."""
    misalignment: Misalignment | None = None
    """Directions of the input axes: small angles towards the other two axes."""

    @property
    def gradient_sensitivity(self) -> BiasTemperatureGradient[Gradient] | None:
        """The sensitivity to dT/dt, where one is estimated."""
        of = cast("BiasTemperatureGradient[Gradient] | q.Quantity | None", self.bias_temperature_gradient)
        return of if isinstance(of, BiasTemperatureGradient) and of.prior != 0.0 else None

    @property
    def gradient_std(self) -> float:
        """Standard deviation of the sensitivity to dT/dt before any estimate, of the bias for K/s; 0: none, or
        unknown."""
        of = cast("BiasTemperatureGradient[q.Quantity] | q.Quantity | None", self.bias_temperature_gradient)
        return float((of.prior if isinstance(of, BiasTemperatureGradient) else of) or 0.0)


class GyroTriad(Triad[q.Rate, q.BiasSlope, q.BiasByGradient]):
    """`[sensor.gyro]`: noise and error functions of the gyros: every term of the error model (paper, eq. 1)."""

    angle_random_walk: q.AngleRandomWalk
    """White noise of the rate, stated as the growth of the integrated angle with the square root of time."""
    rate_random_walk: q.RateRandomWalk | None = None
    """Random walk of the rate."""
    full_scale: q.PositiveRate | None = None
    """Largest rate that the gyro measures; plans leave 5 % of it unused."""
    scale_factor_instability: Annotated[tuple[ScaleFactorInstability, ...], Field(max_length=20), OneOrMore()] = ()
    """In-run instabilities of the scale factor; their sum is the error."""
    temperature_error: TemperatureError | None = None
    """Error of the measured temperature."""
    bias: Bias | None = None
    """The estimated bias over temperature; absent: the bias is known."""
    scale_factor: ScaleFactor | None = None
    """The estimated scale factor over temperature and rate; absent: the scale factor is known."""
    g_sensitivity: GSensitivity | None = None
    """Bias in proportion to the specific force."""

    @property
    def usable_rate(self) -> float | None:
        """Full scale less its margin (rad/s); None where the sheet gives no full scale."""
        return None if self.full_scale is None else self.full_scale * (1.0 - FULL_SCALE_MARGIN)

    @property
    def thermometer_noise(self) -> TemperatureError | None:
        """The error of the measured temperature, where there is one."""
        of = self.temperature_error
        return None if of is None or of.standard_deviation == 0.0 else of

    def _problems(self) -> Iterator[Problem]:
        sections = (self.bias, self.scale_factor, self.misalignment, self.g_sensitivity)
        if all(section is None for section in sections):
            message = "there is nothing to calibrate; add [sensor.gyro.bias], [sensor.gyro.scale_factor] or both"
            yield Problem((), message)
        yield from path_terms.problems_of_terms(self.term, "rad/s")


class AccelerometerTriad(Triad[q.Acceleration, q.AccelerationSlope, q.AccelerationByGradient]):
    """`[sensor.accelerometer]`: noise and error functions of the accelerometers, which are read at rest."""

    scale_factor_instability: ClassVar[tuple[()]] = ()
    temperature_error: ClassVar[None] = None
    thermometer_noise: ClassVar[None] = None

    velocity_random_walk: q.VelocityRandomWalk
    """White noise of the specific force."""
    velocity_increments: bool = False
    """Whether the accelerometers output an increment of velocity for each sample. If they do, an error of the sample
    clock acts like a scale factor; otherwise, specific forces do not depend on the clock."""
    bias: SpecificForceBias
    """Bias over temperature."""
    scale_factor: SpecificForceScale | None = None
    """Scale factor over temperature."""
    second_order: SecondOrder | None = None
    """K2: output in proportion to the square of the force."""

    def _problems(self) -> Iterator[Problem]:
        yield from path_terms.problems_of_terms(self.term, "m/s^2")


class Sensor(Section):
    """An IMU: gyros, accelerometers, or both."""

    thermal_lag: q.SizeOfTime | None = None
    """Time constant of a first-order lag between the chamber's air and the sensor's dies."""
    clock: Literal["sensor", "host"] | None = None
    """Clock whose time is used to integrate rates. "sensor": the sensor's own; "host": the computer's, whose error is
    taken as 1 ppm instead of `sample_clock_error`; absent: the more accurate of the two, because a run's log has the
    times of both."""
    sample_clock_error: q.SizeOfScaleFactor | None = None
    """Standard deviation of the relative error of the sensor's sample clock; the error acts like a scale factor."""
    temperature_offset: q.SizeOfTemperatureDifference | None = None
    """Standard deviation of the constant difference between the temperature of the dies and the measured one."""
    temperature_lag: q.SizeOfTime | None = None
    """Standard deviation of the delay of the dies' temperature relative to the measured one."""
    grade: Grade | None = None
    """Class whose typical figures hold for all error terms that the spec does not state; absent: the class follows from
    the drift or, without drift, from the angle random walk, and its figures count only in verdicts."""
    gyro: GyroTriad | None = None
    """Common properties of the gyros."""
    accelerometer: AccelerometerTriad | None = None
    """Common properties of the accelerometers."""
    frame: Literal["table axes", "case"] = "table axes"
    """The frame to which the misalignments refer. "table axes": it follows from the table's axes at zero and the
    nominal mounting; "case": the frame of the IMU's case, whose orientation is known to within the error of the
    mounting."""

    @property
    def lag(self) -> float | None:
        """The thermal lag (s); None without one."""
        return float(self.thermal_lag or 0.0) or None

    @property
    def takes_host_clock(self) -> bool:
        """Whether rates are integrated over the computer's time: by the key, or else where that is the better clock."""
        if self.clock is not None:
            return self.clock == "host"
        return self.sample_clock_error is not None and float(self.sample_clock_error) > HOST_CLOCK

    @property
    def clock_error(self) -> float:
        """Standard deviation of the clock in use, a ratio."""
        return HOST_CLOCK if self.takes_host_clock else float(self.sample_clock_error or 0.0)

    def _problems(self) -> Iterator[Problem]:
        for name, triad in (("gyro", self.gyro), ("accelerometer", self.accelerometer)):
            if triad is not None and len(set(triad.axes)) < len(triad.axes):
                yield Problem((name, "axes"), "must not name an axis twice", list(triad.axes))
        if self.gyro is None and self.accelerometer is None:
            yield Problem((), "there is nothing to calibrate; add [sensor.gyro] or [sensor.accelerometer]")
