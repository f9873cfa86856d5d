"""`[sensor]`: the device under calibration, its noise, and its unknown error functions; one gyro axis or an IMU."""

import math
from collections.abc import Iterator, Mapping
from typing import Annotated, ClassVar, Final, Literal, cast

from pydantic import BeforeValidator, Field

from gradcal_jax.spec import temperature_path as path_terms
from gradcal_jax.spec.bases import Degree, PolynomialKeys, RateBasis, TemperatureBasis, TemperaturePolynomial
from gradcal_jax.tables import quantity as q
from gradcal_jax.tables.problems import Problem
from gradcal_jax.tables.section import Section, one_or_more


def _prior(dimension: str, above: str) -> q.OneOrList:
    one = q.Of(dimension, above=above)
    return q.OneOrList(one, one, "one for each coefficient")


Prior = q.Quantity | tuple[q.Quantity, ...]
RatePrior = Annotated[Prior, _prior("angular rate", "0 deg/s")]
ScaleFactorPrior = Annotated[Prior, _prior("scale factor", "0 ppm")]
SpecificForcePrior = Annotated[Prior, _prior("acceleration", "0 mg")]


class _Process(Section):
    standard_deviation: q.Quantity
    """Stationary standard deviation."""
    correlation_time: q.Time
    """Time constant of the autocorrelation."""


class Drift(_Process):
    """In-run bias instability: a first-order Gauss–Markov process (stationary standard deviation, correlation time)."""

    standard_deviation: q.PositiveRate
    """Stationary standard deviation of the rate error."""


class ScaleFactorInstability(_Process):
    """Scale-factor instability: a first-order Gauss–Markov process, multiplied by the rate or the force."""

    standard_deviation: q.PositiveScaleFactor
    """Stationary standard deviation of the scale factor's error, a ratio."""


_Drifts = Annotated[tuple[Drift, ...], Field(max_length=20)]
_Instabilities = Annotated[tuple[ScaleFactorInstability, ...], Field(max_length=20)]


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


class BiasTemperatureGradient(Section):
    """Bias sensitivity to dT/dt; if this table is present, the sensitivity is estimated."""

    prior: q.SizeOfGradientSensitivity | None = None
    """Standard deviation of the sensitivity before the calibration; absent: unknown; 0: there is no such
    sensitivity."""


class ForceTemperatureGradient(BiasTemperatureGradient):
    """Sensitivity of an accelerometer's bias to dT/dt; if this table is present, the sensitivity is estimated."""

    prior: q.ForceGradientSensitivity | None = None


def _gradient_of_bias(table: type[BiasTemperatureGradient], dimension: str, least: str) -> BeforeValidator:
    """Marks a sensitivity to dT/dt: a table is estimated, a figure alone is not."""

    def read(value: object) -> object:
        if isinstance(value, Mapping):
            return table.model_validate(value)
        return value if value is None or isinstance(value, Section) else q.Of(dimension, at_least=least).read(value)

    return BeforeValidator(read)


class _ErrorFunction(Section):
    """A function of `temperature` and `rate`, as far as a table has these bases; the keys `smoothness`, `discrepancy`
    and `prior` mean the same in every table that has them."""

    @property
    def _bases(self) -> dict[str, TemperatureBasis | RateBasis]:
        bases = ((name, getattr(self, name, None)) for name in ("temperature", "rate"))
        return {name: basis for name, basis in bases if basis is not None}

    @property
    def size(self) -> int:
        """Number of coefficients."""
        return math.prod(basis.size for basis in self._bases.values())

    def _problems(self) -> Iterator[Problem]:
        bases = self._bases
        polynomials = {name: basis for name, basis in bases.items() if isinstance(basis, PolynomialKeys)}
        if (lag := getattr(self, "lag", None)) is not None and "temperature" in bases.keys() - polynomials.keys():
            yield Problem(("lag",), "a map with its own lag must be a polynomial in temperature", lag.text)
        if (smoothness := getattr(self, "smoothness", None)) is not None and polynomials == bases:
            message = 'neighbouring coefficients exist only for "b-spline" and "bins"; leave this key out'
            yield Problem(("smoothness",), message, smoothness.text)
        hidden = getattr(self, "discrepancy", None)
        if hidden is not None and polynomials != bases:
            message = 'is only for polynomials; for B-splines and bins, use "smoothness" instead'
            yield Problem(("discrepancy",), message)
        elif hidden is not None and all(getattr(hidden, f"{k}_degree") <= of.degree for k, of in polynomials.items()):
            yield Problem(("discrepancy",), "at least one of its degrees must exceed that of the map")
        prior = getattr(self, "prior", None)
        if isinstance(prior, tuple) and len(cast("tuple[q.Quantity, ...]", prior)) != self.size:
            message = f"expected one figure for all coefficients, or {self.size}, one for each coefficient"
            yield Problem(("prior",), message)


class _LateFunction(_ErrorFunction):
    lag: q.Time | None = None
    """Known first-order lag of this map behind the sensor's temperature; absent: no lag. At the start, the lag is in
    equilibrium, as after a soak."""


class BiasDiscrepancy(Section):
    """Structure of B(T) that the model lacks: the next orthogonal polynomials, with a prior for their coefficients."""

    standard_deviation: q.PositiveRate
    """Prior standard deviation of each of the hidden coefficients."""
    temperature_degree: Degree
    """Highest degree in temperature of the hidden polynomials."""


class ScaleFactorDiscrepancy(Section):
    """Structure of M(T, ω) that the model lacks: the next orthogonal polynomials up to these degrees, with a prior for
    their coefficients."""

    standard_deviation: q.PositiveScaleFactor
    """Prior standard deviation of each of the hidden coefficients, a ratio."""
    temperature_degree: Degree
    """Highest degree in temperature of the hidden polynomials."""
    rate_degree: Degree
    """Highest degree in rate of the hidden polynomials."""


class Bias(_LateFunction):
    """The estimated bias B(T)."""

    temperature: TemperatureBasis
    """Basis over temperature."""
    prior: RatePrior | None = None
    """Standard deviation of each coefficient before the calibration, or a list of them; absent: unknown."""
    smoothness: q.PositiveRate | None = None
    """Standard deviation of the difference of neighbouring coefficients; only for splines and bins."""
    discrepancy: BiasDiscrepancy | None = None
    """Possible structure of the map beyond its basis."""


class ScaleFactor(_LateFunction):
    """The estimated scale-factor error M(T, ω): products of functions of temperature and functions of
    rate."""

    temperature: TemperatureBasis
    """Basis over temperature."""
    rate: RateBasis
    """Basis over rate."""
    prior: ScaleFactorPrior | None = None
    """Standard deviation of each coefficient before the calibration, a ratio, or a list of them;
    absent: unknown."""
    smoothness: q.PositiveScaleFactor | None = None
    """Standard deviation of the difference of neighbouring coefficients; only for splines and bins."""
    discrepancy: ScaleFactorDiscrepancy | None = None
    """Possible structure of the map beyond its basis."""


FULL_SCALE_MARGIN: Final = 0.05
"""Fraction of a gyro's full scale that plans leave unused."""
HOST_CLOCK: Final = 1e-6
"""Standard deviation, a ratio, of a sensor's clock after a run has compared it with the computer's. The comparison
itself (time stamps with errors of about 1 ms at both ends) is accurate to 0.1 ppm over hours; the computer's own clock,
kept by a time server, to 1 ppm."""


class _Instrument(Section):
    """Clock and thermometer of a device, which all of its channels share."""

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
    second_thermometer: path_terms.SecondThermometer | None = None
    """A second thermometer, required for terms by "T2 - T"; its column in logs is `second_temperature`."""

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

    @property
    def clock_text(self) -> str | None:
        """The same for people; None where the file names none."""
        if self.takes_host_clock:
            return f"{HOST_CLOCK * 1e6:g} ppm, the computer's"
        return None if self.sample_clock_error is None else str(self.sample_clock_error)


class _Channel(Section):
    """Errors that every channel may have."""

    turn_on_bias: q.Quantity | None = None
    """Standard deviation of the part of the bias that takes a new value at every power-on and is not part of the
    map."""
    bias_temperature_gradient: BiasTemperatureGradient | q.Quantity | None = None
    """Bias proportional to dT/dt. A table: the sensitivity is estimated. A single figure: the standard deviation of the
    sensitivity, which is then not estimated but is included in the uncertainty."""

    @property
    def gradient_sensitivity(self) -> BiasTemperatureGradient | None:
        """The sensitivity to dT/dt, where one is estimated."""
        of = self.bias_temperature_gradient
        return of if isinstance(of, BiasTemperatureGradient) and of.prior != 0.0 else None

    @property
    def gradient_std(self) -> float:
        """Standard deviation of the sensitivity to dT/dt before any estimate, of the bias for K/s; 0: none, or
        unknown."""
        of = self.bias_temperature_gradient
        return float((of.prior if isinstance(of, BiasTemperatureGradient) else of) or 0.0)


class _Gyro(_Channel):
    """Noise and error functions of a gyro: every term of the error model (paper, eq. 1)."""

    angle_random_walk: q.AngleRandomWalk
    """White noise of the rate, stated as the growth of the integrated angle with the square root of time."""
    rate_random_walk: q.RateRandomWalk | None = None
    """Random walk of the rate."""
    turn_on_bias: q.SizeOfRate | None = None
    full_scale: q.PositiveRate | None = None
    """Largest rate that the gyro measures; plans leave 5 % of it unused."""
    drift: Annotated[_Drifts, one_or_more(Drift | _Drifts)] = ()
    """In-run bias instabilities; their sum is the error."""
    scale_factor_instability: Annotated[_Instabilities, one_or_more(ScaleFactorInstability | _Instabilities)] = ()
    """In-run instabilities of the scale factor; their sum is the error."""
    temperature_error: TemperatureError | None = None
    """Error of the measured temperature."""
    bias_temperature_gradient: Annotated[
        BiasTemperatureGradient | q.SizeOfGradientSensitivity | None,
        _gradient_of_bias(BiasTemperatureGradient, "bias temperature-gradient sensitivity", "0 deg/h/(K/min)"),
    ] = None
    bias: Bias | None = None
    """The estimated bias over temperature; absent: the bias is known."""
    scale_factor: ScaleFactor | None = None
    """The estimated scale factor over temperature and rate; absent: the scale factor is known."""

    @property
    def usable_rate(self) -> float | None:
        """Full scale less its margin (rad/s); None where the sheet gives no full scale."""
        return None if self.full_scale is None else self.full_scale * (1.0 - FULL_SCALE_MARGIN)

    @property
    def thermometer_noise(self) -> TemperatureError | None:
        """The error of the measured temperature, where there is one."""
        of = self.temperature_error
        return None if of is None or of.standard_deviation == 0.0 else of


Grade = Literal["consumer", "tactical", "navigation"]


BodyAxis = Literal["x", "y", "z"]
BodyAxes = Annotated[tuple[BodyAxis, ...], Field(min_length=1, max_length=3)]


class Misalignment(_ErrorFunction):
    """Small angles between an input axis and its nominal direction, towards the other two axes."""

    temperature: TemperaturePolynomial | None = None
    """Basis over temperature; absent: constant."""
    prior: q.PositiveAngle | None = None
    """Standard deviation of each coefficient before the calibration; absent: unknown."""


class _Constant(_ErrorFunction):
    temperature: ClassVar[None] = None


class AccelerationSensitivity(_Constant):
    """Bias of a gyro in proportion to the specific force, with three coefficients for each gyro (IEEE 528)."""

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


class SpecificForceDrift(_Process):
    """Instability of an accelerometer's bias: a first-order Gauss–Markov process."""

    standard_deviation: q.PositiveSpecificForce


_DriftsOfForce = Annotated[tuple[SpecificForceDrift, ...], Field(max_length=20)]


class SpecificForceBias(_ErrorFunction):
    """An accelerometer's bias over temperature."""

    temperature: TemperaturePolynomial | None = None
    """Basis over temperature; absent: constant."""
    prior: SpecificForcePrior | None = None
    """Standard deviation of each coefficient before the calibration, or a list of them; absent: unknown."""


class SpecificForceScale(_ErrorFunction):
    """An accelerometer's scale factor over temperature."""

    temperature: TemperaturePolynomial | None = None
    """Basis over temperature; absent: constant."""
    prior: ScaleFactorPrior | None = None
    """Standard deviation of each coefficient before the calibration, a ratio, or a list of them;
    absent: unknown."""


class SecondOrder(_Constant):
    """An accelerometer's K2."""

    prior: q.PositiveSecondOrder | None = None
    """Standard deviation of each coefficient before the calibration; absent: unknown."""


class GyroTriad(_Gyro, path_terms.TemperaturePath):
    """`[sensor.gyro]`: common properties of the gyros. If the key of an error term is absent here, the error is assumed
    to be known, and is not estimated."""

    axes: BodyAxes = ("x", "y", "z")
    """Axes along which the IMU has a gyro."""
    misalignment: Misalignment | None = None
    """Directions of the input axes."""
    g_sensitivity: AccelerationSensitivity | None = None
    """Bias in proportion to the specific force."""

    def _problems(self) -> Iterator[Problem]:
        sections = (self.bias, self.scale_factor, self.misalignment, self.g_sensitivity)
        if all(section is None for section in sections):
            message = "there is nothing to calibrate; add [sensor.gyro.bias], [sensor.gyro.scale_factor] or both"
            yield Problem((), message)
        yield from path_terms.problems_of_terms(self.term, "rad/s")


class AccelerometerTriad(_Channel, path_terms.TemperaturePath):
    """`[sensor.accelerometer]`: common properties of the accelerometers, which are read at rest. If the key of an error
    term is absent here, the error is assumed to be known, and is not estimated."""

    scale_factor_instability: ClassVar[tuple[()]] = ()
    temperature_error: ClassVar[None] = None
    thermometer_noise: ClassVar[None] = None

    axes: BodyAxes = ("x", "y", "z")
    """Axes along which the IMU has an accelerometer."""
    velocity_random_walk: q.VelocityRandomWalk
    """White noise of the specific force."""
    drift: Annotated[_DriftsOfForce, one_or_more(SpecificForceDrift | _DriftsOfForce)] = ()
    """In-run bias instabilities; their sum is the error."""
    turn_on_bias: q.SizeOfSpecificForce | None = None
    bias_temperature_gradient: Annotated[  # pyright: ignore[reportIncompatibleVariableOverride]
        ForceTemperatureGradient | q.ForceGradientSensitivity | None,
        _gradient_of_bias(ForceTemperatureGradient, "acceleration temperature-gradient sensitivity", "0 ug/(K/min)"),
    ] = None
    hysteresis: Annotated[tuple[path_terms.PlayOfForce, ...], Field(max_length=10)] = ()  # pyright: ignore[reportIncompatibleVariableOverride]
    velocity_increments: bool = False
    """Whether the accelerometers output an increment of velocity for each sample. If they do, an error of the sample
    clock acts like a scale factor; otherwise, specific forces do not depend on the clock."""
    bias: SpecificForceBias
    """Bias over temperature."""
    scale_factor: SpecificForceScale | None = None
    """Scale factor over temperature."""
    misalignment: Misalignment | None = None
    """Directions of the input axes."""
    second_order: SecondOrder | None = None
    """K2: output in proportion to the square of the force."""

    def _problems(self) -> Iterator[Problem]:
        yield from path_terms.problems_of_terms(self.term, "m/s^2")


class Sensor(_Instrument):
    """An IMU: gyros, accelerometers, or both."""

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

    def _problems(self) -> Iterator[Problem]:
        for name, triad in (("gyro", self.gyro), ("accelerometer", self.accelerometer)):
            if triad is not None and len(set(triad.axes)) < len(triad.axes):
                yield Problem((name, "axes"), "must not name an axis twice", list(triad.axes))
            if triad is None or self.second_thermometer is not None:
                continue
            if any(path_terms.DIFFERENCE in one.factors for one in triad.term):
                message = (
                    '"T2 - T" needs a second thermometer, as in [sensor] second_thermometer = { lag = "5 min" } (the '
                    "lag is used in predictions)"
                )
                yield Problem((name, "term"), message)
        if self.gyro is None and self.accelerometer is None:
            yield Problem((), "there is nothing to calibrate; add [sensor.gyro] or [sensor.accelerometer]")
