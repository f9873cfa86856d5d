"""gradcal-calibration/3: the estimated terms of a sensor's channels, their covariance, and the range of validity.

    measured = s + Σ map(T, s) · signals,   s = input + Σ misalignment(T) · inputs across it       of each channel

with rates in rad/s and specific forces in m/s². A channel is a gyro or an accelerometer; one gyro axis is a file with
one channel. Its terms are maps over temperature (of a gyro's scale factor over its own rate, too) times a product of
signals: none for a bias, "rate x" for the scale factor of gyro x, "force y" for its sensitivity to acceleration, "rate
y" for its misalignment. Signals are true inputs, in the frame that the file names, but the channel's own, which is s:
its input along its own axis of sensitivity. "temperature rate" is dT/dt. Coefficients are those of the paper: `a{k}`
multiplies the k-th power of `(T − centre)/scale` in a bias, `b{j}{i}` the j-th power of `(ω − centre)/scale` and the
i-th of the temperature's in a scale factor; other bases count their functions. Numbers without a unit are SI.
"""

import itertools
import math
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import numpy as np
from pydantic import Field

from gradcal_jax.records.log import Floats
from gradcal_jax.spec.bases import PolynomialKeys, RateBasis, SplineKeys, TemperatureBasis, increasing
from gradcal_jax.tables import quantity as q
from gradcal_jax.tables.document import TitledFile, parsed, read_text
from gradcal_jax.tables.problems import Problem, repeated_names
from gradcal_jax.tables.section import Section
from gradcal_jax.tables.writing import write_toml

ORDER: Final = (
    "measured = s + sum of map(T) * signals, over all terms except misalignments; s = input + sum of misalignment(T) * "
    "inputs across it, and s also replaces the channel's own input among the signals. To correct: compute the sums "
    "from the corrected values, subtract them, and iterate until convergence (three iterations for errors of a per "
    "cent), before any rotation"
)
FRAME_OF_CASE: Final = "the case, as accurately as its mounting is known"
"""Frame of an estimate that the mounting limits."""
TEMPERATURE_RATE: Final = "temperature rate"
"""Name of the signal dT/dt, K/s."""
LOG_HASH: Final = "log_sha256"
"""Name under which the provenance has the fingerprint of the calibration's log."""


_CONSTANT: Final = PolynomialKeys.model_construct(degree=0, centre=0.0, scale=1.0)


class CalibratedTerm(Section):
    """One term of a channel; coefficients in `unit` (SI). Without `temperature` the term is constant; with `rate` it
    depends on the channel's own rate."""

    name: q.Text
    """Name of the term, such as scale_factor."""
    unit: q.Text
    """SI unit of the coefficients."""
    signals: Annotated[tuple[q.Text, ...], Field(max_length=4)] = ()
    """Signals that multiply the term, such as "rate x", "force z", "|force z|" or "temperature rate"; none: the term
    stands alone."""
    temperature: TemperatureBasis | None = None
    """Basis over temperature; absent: constant."""
    rate: RateBasis | None = None
    """Basis over the channel's own rate; absent: the same at every rate."""
    coefficients: dict[str, q.Number]
    """Coefficients by name, in SI: for each function of temperature, in order, those of all functions of rate."""

    def _problems(self) -> Iterator[Problem]:
        functions = list(itertools.product(*(range(basis.size) for basis in self.bases)))
        if len(self.coefficients) != len(functions):
            message = f"expected {len(functions)} coefficients, one for each function of the bases"
            yield Problem(("coefficients",), message, len(self.coefficients))
        elif self.name in ("bias", "scale_factor") and self.temperature is not None and len(functions) > 1:
            for name, (i, j) in zip(self.coefficients, functions, strict=True):
                if _function_of(name) != (i, j):
                    message = (
                        f"expected here the coefficient that multiplies function {i} and {j} of temperature and rate"
                    )
                    yield Problem(("coefficients", name), message)
                    break

    @property
    def bases(self) -> tuple[PolynomialKeys | SplineKeys, PolynomialKeys | SplineKeys]:
        """Those over temperature and rate; one that is absent is a constant."""
        return self.temperature or _CONSTANT, self.rate or _CONSTANT

    @property
    def table(self) -> Floats:
        """The coefficients `(functions of temperature, functions of rate)`."""
        return np.array(list(self.coefficients.values())).reshape(self.bases[0].size, -1)


class PathCoefficient(Section):
    """An error that depends on past temperatures (hysteresis, dT/dt), in addition to the maps, which are the mean
    of heating and cooling. `apply` subtracts what follows dT/dt; exports contain none of it."""

    channel: q.Text
    """Name of the channel, such as gyro_x."""
    name: q.Text
    """Name of the coefficient, such as hysteresis_20K."""
    value: q.Number
    """Estimate (SI)."""
    standard_deviation: q.Number
    """Standard deviation of the estimate (SI)."""
    unit: q.Text
    """SI unit of the estimate and its standard deviation."""
    width: q.PositiveTemperatureDifference | None = None
    """Half-width of the hysteresis (of its play); absent: the term is not a hysteresis."""
    own: q.Flag = False
    """Whether the coefficient belongs to an error class of your own; neither `apply` nor exports correct such
    errors."""

    @property
    def label(self) -> str:
        """Its name for people, as in "gyro x hysteresis 20K" or "gyro x bias by rate y times rate z"."""
        words = re.sub(r"^ww_(\w)(\w)$", r"bias by rate \1 times rate \2", self.name)
        return f"{self.channel} {words}".replace("_", " ")


class Residuals(Section):
    """Whitened residuals of the fit, in standard deviations: independent and normal if the model is correct."""

    counts: Annotated[tuple[q.Whole, ...], Field(min_length=18, max_length=18)]
    """Histogram: number of residuals below -4, in bins of 0.5 from -4 to 4, and above 4."""
    rms: tuple[q.Number, ...] = ()
    """Root mean square of the residuals in each tenth of the run, in the order of time."""


class CalibratedChannel(Section):
    """A gyro or an accelerometer. Outside `valid_temperature` and `valid_rate`, its maps keep the values at the edge of
    the range."""

    kind: Literal["gyro", "accelerometer"]
    """Kind of sensor."""
    axis: q.Text
    """Axis of the body along which the sensor measures."""
    valid_temperature: tuple[q.Temperature, q.Temperature]
    """Lowest and highest temperature in the data of the calibration."""
    valid_rate: tuple[q.Rate, q.Rate]
    """Lowest and highest rate in the data of the calibration."""
    thermal_lag: q.Time | None = None
    """Time constant of the maps' lag behind the measured temperature; absent: no lag."""
    term: tuple[CalibratedTerm, ...] = ()
    """Error terms of the channel; their sum is its error."""
    residuals: Residuals | None = None
    """Residuals of this channel's fit."""

    def _problems(self) -> Iterator[Problem]:
        for key in ("valid_temperature", "valid_rate"):
            low, high = getattr(self, key)
            if low != high:
                yield from increasing((low, high), key)

    @property
    def name(self) -> str:
        """As in `gyro_x`."""
        return f"{self.kind}_{self.axis}"

    @property
    def label(self) -> str:
        """Its name for people, as in "gyro x"."""
        return f"{self.kind} {self.axis}"

    @property
    def input(self) -> str:
        """The signal that it measures, as in "rate x"."""
        return signal_of(self.label)

    def term_of(self, name: str) -> CalibratedTerm | None:
        """The term of that name, if there is one."""
        return next((term for term in self.term if term.name == name), None)


def signal_of(label: str) -> str:
    """The signal that a channel measures: "rate x" for the label "gyro x"."""
    kind, _, axis = label.partition(" ")
    return f"{'rate' if kind == 'gyro' else 'force'} {axis}"


class Covariance(Section):
    """Covariance of the observable coefficients."""

    names: tuple[q.Text, ...]
    """Names of the coefficients, such as gyro_x.b00."""
    matrix: tuple[tuple[q.Number, ...], ...]
    """Covariance of these coefficients, row by row, in the coefficients' units."""

    def _problems(self) -> Iterator[Problem]:
        count = len(self.names)
        if [len(row) for row in self.matrix] != [count] * count:
            yield Problem(("matrix",), f"expected {count} rows of {count} numbers, as many as there are names")
        elif any(self.matrix[i][i] < 0.0 for i in range(count)):
            yield Problem(("matrix",), "a variance on the diagonal is negative")


class UnseenError(Section):
    """An error that the residuals of the fit cannot show: from a term of the spec or, with a typical figure of the
    class, from a term that the spec omits. The covariance with all these errors is `covariance` plus the sum of their
    outer products."""

    name: q.Text
    """Name of the error."""
    coefficients: dict[str, q.Number]
    """Change of each coefficient that one standard deviation of this error causes, in the coefficients' units."""


class FitTest(Section):
    """A test of the fit."""

    name: q.Text
    """Channel and name of the test, such as "gyro_x: chi-squared"."""
    statistic: q.Number
    """Value of χ²."""
    degrees: q.Whole
    """Degrees of freedom."""
    chance: q.Number
    """Probability of a χ² of this size or larger, if the model is correct."""


class TableError(Section):
    """An estimated error of the *table's* installation, SI, and its prior standard deviation."""

    name: q.Text
    """Name of the error."""
    value: q.Number
    """Estimate (SI)."""
    standard_deviation: q.Number
    """Standard deviation of the estimate (SI)."""
    prior: q.Number
    """Prior standard deviation, from the spec (SI)."""
    unit: q.Text
    """SI unit of the estimate, its standard deviation and its prior."""


class Result(Section):
    """The result for one requirement of the spec; figures in `unit`."""

    name: q.Text
    """Name of the requirement."""
    axis: q.Text
    """Axis to which the result applies, or how the axes are combined ("worst", "all")."""
    quantity: q.Text
    """Quantity that the requirement limits."""
    statistic: q.Text
    """The statistic that decides the verdict."""
    value: q.Number | None = None
    """The value of this statistic (1σ), including omitted terms and, for "any run", the turn-on bias; absent: not
    observable."""
    named: q.Number | None = None
    """The same statistic for this run, from the terms named in the spec alone; absent: the same value."""
    worst: q.Number | None = None
    """The standard deviation at the worst point of the requirement's temperatures and rates."""
    unit: q.Text
    """Unit of all figures."""
    target: q.Number | None = None
    """Limit on the error."""
    verdict: q.Text | None = None
    """Whether the limit is met: "met", "missed", "not covered", "unobservable" or "not valid"."""
    coverage: q.Number | None = None
    """Number of standard deviations that must be within the target."""
    rule: q.Text | None = None
    """Rule of the verdict, in words."""


class Noise(Section):
    """The noise that the estimate assumed, for use in the filters of other programs."""

    angle_random_walk: q.AngleRandomWalk | None = None
    """White noise of the rate."""
    rate_random_walk: q.RateRandomWalk | None = None
    """Random walk that equals the gyros' drifts over times much shorter than the correlation time of these drifts."""
    velocity_random_walk: q.VelocityRandomWalk | None = None
    """White noise of the specific force."""
    sample_rate: q.Frequency | None = None
    """Sample rate of the log."""


class Calibration(TitledFile):
    """A calibration file, in SI (and °C), with the channels of one sensor: one gyro axis, or an IMU. Made by
    `estimate`, `estimate_by_hand` and `read_calibration`. Errors: `SpecError` from `read_calibration`.
    """

    format: Literal["gradcal-calibration/3"]
    serial_number: q.Text
    """Serial number of the sensor."""
    simulated: q.Flag
    """Whether the data are simulated."""
    frame: q.Text
    """Frame in which the axes are given."""
    order: q.Text
    """What the numbers mean, and in which order a correction uses them."""
    channel: Annotated[tuple[CalibratedChannel, ...], Field(min_length=1)]
    """Gyros and accelerometers, one table for each."""
    covariance: Covariance | None = None
    """Covariance of the observed coefficients from the fit; absent: it was not kept."""
    path: tuple[PathCoefficient, ...] = ()
    """Errors that depend on past temperatures, in addition to the maps."""
    unseen: tuple[UnseenError, ...] = ()
    """Errors that the residuals of the fit cannot show; the results and every stated uncertainty include them."""
    table: tuple[TableError, ...] = ()
    """Estimated errors of the table."""
    fit: tuple[FitTest, ...] = ()
    """Tests of the fit."""
    contradicted: tuple[q.Text, ...] = ()
    """Tests of the fit that fail: the data contradict the model, and the stated uncertainties are not valid."""
    unobservable: tuple[q.Text, ...] = ()
    """Coefficients and combinations of coefficients that the data do not determine."""
    noise: Noise | None = None
    """The noise that the estimate assumed."""
    lacks: q.Text | None = None
    """The part of the plan that is missing in the log, and the prediction for the executed part alone, in words."""
    result: tuple[Result, ...] = ()
    """Results for the requirements of the spec."""
    provenance: dict[str, q.Text] = Field(default_factory=dict)
    """Texts by name: versions, sources, the log's hash."""

    def _problems(self) -> Iterator[Problem]:
        names = [channel.name for channel in self.channel]
        yield from repeated_names("channel", "axis", names, "two channels have the same kind and the same axis")
        axes = {"x", "y", "z", *(channel.axis for channel in self.channel)}
        known = {f"{kind} {axis}" for kind in ("rate", "force") for axis in axes}
        known |= {TEMPERATURE_RATE, *(f"|{name}|" for name in known)}
        for i, channel in enumerate(self.channel):
            for j, term in enumerate(channel.term):
                for signal in set(term.signals) - known:
                    message = 'is not a signal; expected a text such as "rate x", "force z", "|force z|"'
                    yield Problem(("channel", i, "term", j, "signals"), message, signal)
        if self.covariance is not None and (strange := set(self.covariance.names) - self.values().keys()):
            text = f"names coefficients that no channel has: {', '.join(sorted(strange)[:5])}"
            yield Problem(("covariance", "names"), text)

    def values(self) -> dict[str, float]:
        """Every coefficient by its name, as in gyro_x.b00."""
        return {f"{c.name}.{name}": v for c in self.channel for t in c.term for name, v in t.coefficients.items()}

    def deviations(self) -> dict[str, float]:
        """One sigma by the fit of every coefficient that has one."""
        if (known := self.covariance) is None:
            return {}
        return {name: math.sqrt(known.matrix[k][k]) for k, name in enumerate(known.names)}

    @property
    def valid_temperature(self) -> tuple[q.Temperature, q.Temperature]:
        """Temperatures that the data covered for every channel (the second may be below the first: none)."""
        lows, highs = zip(*(channel.valid_temperature for channel in self.channel), strict=True)
        return max(lows), min(highs)

    @property
    def valid_rate(self) -> tuple[q.Rate, q.Rate]:
        """Rates that the data covered for every channel (the second may be below the first: none)."""
        lows, highs = zip(*(channel.valid_rate for channel in self.channel), strict=True)
        return max(lows), min(highs)

    @property
    def valid_range(self) -> str:
        """The range of temperature and rate that the data covered, in words."""
        low, high = self.valid_temperature
        return f"covers {low} … {high}, up to {math.degrees(float(self.valid_rate[1])):.4g} deg/s"

    def _shown(self) -> list[str]:
        name = f"Calibration of {self.serial_number}" + ", SIMULATED" * self.simulated
        return [name, self.valid_range, *(f"contradicted: {test}" for test in self.contradicted)]


def is_calibration(document: Mapping[str, Any]) -> bool:
    """Whether tables are those of a calibration file."""
    return document.get("format") == FORMAT


def parse_calibration(text: str, source: str = "") -> Calibration:
    """The calibration in a TOML text; `source` names it in messages. Raises `SpecError` with every fault."""
    return parsed(Calibration, text, FORMAT, source)


def read_calibration(path: str | Path) -> Calibration:
    """Read a calibration file: coefficients and covariance in SI (rad/s, m/s², ratios), range of validity, residuals.

    Errors: `SpecError` with every fault.
    """
    return parse_calibration(read_text(path), str(path))


def write_calibration(calibration: Calibration, path: str | Path) -> None:
    """Write a calibration, atomically; the head of the file explains its numbers and units.

    Errors: `OSError` where it cannot be written.
    """
    write_toml(calibration, path, header=_HEADER + _SIMULATED * calibration.simulated)


def build_term(
    name: str, unit: str, signals: tuple[str, ...], coefficients: Mapping[str, float], **bases: Any
) -> CalibratedTerm:
    """A term from plain numbers; bases that are None are left out."""
    present = {key: basis for key, basis in bases.items() if basis is not None}
    return CalibratedTerm(name=name, unit=unit, signals=signals, coefficients=dict(coefficients), **present)


_HEADER: Final = """\
A calibration of gyros and accelerometers. Apply it with `gradcal apply`, check it with `gradcal validate`.
    measured = s + sum of map(T) * signals           rates in rad/s, specific force in m/s^2
    s = input + sum of misalignment(T) * inputs      of the other axes; s is the channel's own signal
A bias is a sum: a{k} multiplies the k-th power of (T - centre)/scale.
A scale factor is a sum: b{j}{i} multiplies the j-th power of (rate - centre)/scale and the i-th of (T - centre)/scale.
Numbers without a unit are SI: rad, s, m, degC."""
_SIMULATED: Final = "\nSIMULATED: made from simulated data, not from a real sensor."


FORMAT: Final = "gradcal-calibration/3"


def _function_of(name: str) -> tuple[int, ...]:
    """The functions of temperature and of rate that a coefficient multiplies: (3, 0) for a3, (2, 1) for b12, (11, 2)
    for b2_11, (4, 0) for b_bin0_spline4."""
    digits = re.findall(r"\d" if re.fullmatch(r"b\d\d", name) else r"\d+", name)
    functions = [int(digit) for digit in reversed(digits)]
    return (*functions, 0) if len(functions) == 1 else tuple(functions)
