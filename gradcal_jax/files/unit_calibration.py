"""gradcal-calibration/1 of a whole unit: the coefficients of its gyros and accelerometers, and the table's errors.

    measured = input + Σ map(T) · signals          of each channel; rates in rad/s, specific force in m/s²

A channel's terms are maps over temperature (of a gyro's scale factor over its own rate, too) times a product of
signals: none for a bias, "rate x" for a gyro x's scale factor, "force y" for a sensitivity to acceleration. Signals are
true inputs, in the frame that the file names. Coefficients count powers of `(T − centre)/scale`, or functions.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import Field

from gradcal_jax.files.bases import RateBasis, TemperatureBasis
from gradcal_jax.files.calibration import FORMAT, SIMULATED, Calibration, Coefficients, Covariance, FitTest, UnseenError
from gradcal_jax.files.document import TitledFile, from_text, model_of, read_text
from gradcal_jax.files.problems import Problem
from gradcal_jax.files.quantity import (
    AngleRandomWalk,
    Flag,
    Frequency,
    Number,
    Rate,
    RateRandomWalk,
    Temperature,
    Text,
    Time,
    VelocityRandomWalk,
)
from gradcal_jax.files.section import Section
from gradcal_jax.files.sensor import BodyAxis
from gradcal_jax.files.writing import write_toml

UNIT_ORDER: Final = (
    "measured = input + sum of map(T) * signals, the signals being the true inputs; subtract the sum at the corrected "
    "values, again until they stay (three rounds for errors of a per cent), before any rotation"
)
SIGNALS: Final = tuple(f"{kind} {axis}" for kind in ("rate", "force") for axis in "xyz")
"""True inputs of a unit, in the order of its matrices."""


class CalibratedTerm(Section):
    """One term of a channel, in `unit` (SI). Without `temperature` it is constant; `rate`: of its own rate."""

    name: Text
    """Name of the term, such as scale_factor."""
    unit: Text
    """SI unit of its coefficients."""
    signals: Annotated[tuple[Text, ...], Field(max_length=4)] = ()
    """Its factors, true inputs such as "rate x" or "force z"; none: 1."""
    temperature: TemperatureBasis | None = None
    """Basis over temperature; absent: constant."""
    rate: RateBasis | None = None
    """Basis over the channel's own rate; absent: the same at every rate."""
    coefficients: Coefficients
    """By name, in SI; temperature slow, rate fast."""

    def _problems(self) -> Iterator[Problem]:
        for k, signal in enumerate(self.signals):
            if signal not in SIGNALS and signal not in [f"|{known}|" for known in SIGNALS]:
                message = 'is no signal; expected such as "rate x", "force z", "|force z|"'
                yield Problem(("signals", k), message, signal)
        if len(self.coefficients) != self.size:
            message = f"expected {self.size}, as many as the bases have functions"
            yield Problem(("coefficients",), message, len(self.coefficients))

    @property
    def size(self) -> int:
        """Number of its functions."""
        return (1 if self.temperature is None else self.temperature.size) * (1 if self.rate is None else self.rate.size)


class CalibratedChannel(Section):
    """A gyro or an accelerometer along an axis of the body."""

    kind: Literal["gyro", "accelerometer"]
    """Kind of sensor."""
    axis: BodyAxis
    """Its axis of the body."""
    term: Annotated[tuple[CalibratedTerm, ...], Field(max_length=40)] = ()
    """Its errors, which add."""

    @property
    def name(self) -> str:
        """As in `gyro_x`."""
        return f"{self.kind}_{self.axis}"

    @property
    def place(self) -> int:
        """The number of its own input among `SIGNALS`."""
        return SIGNALS.index(f"{'rate' if self.kind == 'gyro' else 'force'} {self.axis}")

    def term_of(self, name: str) -> CalibratedTerm | None:
        """The term of that name, if there is one."""
        return next((term for term in self.term if term.name == name), None)


class TableError(Section):
    """An estimated error of the *table's* installation, SI, with its prior."""

    name: Text
    """Of the error."""
    value: Number
    """Estimate (SI)."""
    standard_deviation: Number
    """Standard deviation of the estimate (SI)."""
    prior: Number
    """Standard deviation in the spec (SI)."""
    unit: Text
    """SI unit of all three."""


class UnitResult(Section):
    """The result for a requirement of the spec, in `unit`."""

    name: Text
    """Of the requirement."""
    quantity: Text
    """Which quantity."""
    axis: Text
    """Which axis, or how several are summed up."""
    statistic: Text
    """The one that decides."""
    value: Number | None = None
    """Its value, one sigma, with terms that the spec omits and, in any run, the turn-on bias; absent: not
    observable."""
    named: Number | None = None
    """Its value by the terms that the spec names, in this run, where it is another."""
    unit: Text
    """Unit of all figures."""
    target: Number | None = None
    """Limit on the error."""
    verdict: Text | None = None
    """Whether it is met."""
    coverage: Number | None = None
    """Standard deviations that must be within the target."""
    rule: Text | None = None
    """Rule of the verdict, in words."""


class UnitNoise(Section):
    """The noise that the estimate assumed, for programs that filter; random walks of drifts over short times."""

    angle_random_walk: AngleRandomWalk | None = None
    """White noise of the rate."""
    rate_random_walk: RateRandomWalk | None = None
    """Of the gyros' drifts, over times much shorter than their own."""
    velocity_random_walk: VelocityRandomWalk | None = None
    """White noise of the specific force."""
    sample_rate: Frequency | None = None
    """Of the log."""


class UnitCalibration(TitledFile):
    """The calibration file of a whole unit, SI (°C) inside. Beyond `valid_temperature` and `valid_rate` the values at
    the edge hold. Made by `estimate_units` and `read_any_calibration`. Errors: `SpecError` by those.
    """

    format: Literal["gradcal-calibration/1"]
    serial_number: Text
    """Of the unit."""
    quantity: Literal["unit"]
    """A whole unit."""
    simulated: Flag
    """Whether the log was simulated."""
    frame: Text
    """The reference of the misalignments."""
    order: Text
    """The meaning of the numbers, and the order of the correction."""
    thermal_lag: Time | None = None
    """Lag of all terms behind the thermometer; absent: none."""
    valid_temperature: tuple[Temperature, Temperature]
    """Temperatures that the data covered; beyond, the values at the edge hold."""
    valid_rate: tuple[Rate, Rate]
    """Rates that the data covered; beyond, the maps' values at the edge hold."""
    channel: Annotated[tuple[CalibratedChannel, ...], Field(min_length=1, max_length=6)]
    """Gyros and accelerometers."""
    covariance: Covariance | None = None
    """Of the coefficients that were observed, by the fit; absent: not kept."""
    unseen: Annotated[tuple[UnseenError, ...], Field(max_length=5000)] = ()
    """Errors that no residual shows, and that the results count."""
    table: Annotated[tuple[TableError, ...], Field(max_length=500)] = ()
    """Estimated errors of the table."""
    fit: Annotated[tuple[FitTest, ...], Field(max_length=100)] = ()
    """Tests of the fit."""
    contradicted: Annotated[tuple[Text, ...], Field(max_length=100)] = ()
    """Tests of the fit that fail: the data contradict the model, and no stated uncertainty is valid."""
    unobservable: Annotated[tuple[Text, ...], Field(max_length=5000)] = ()
    """Coefficients that the data hardly determine."""
    noise: UnitNoise | None = None
    """The noise that the estimate assumed."""
    lacks: Text | None = None
    """What part of the plan the log lacks, and what the executed part alone predicts."""
    result: Annotated[tuple[UnitResult, ...], Field(max_length=1000)] = ()
    """The results for the spec's requirements."""
    provenance: dict[str, Text] = Field(default_factory=dict)
    """Program, files and fingerprints of its origin."""

    def _problems(self) -> Iterator[Problem]:
        names = [channel.name for channel in self.channel]
        if len(set(names)) < len(names):
            yield Problem(("channel",), "two channels are of one kind and axis")
        for key, (low, high) in (("valid_temperature", self.valid_temperature), ("valid_rate", self.valid_rate)):
            if low > high:
                yield Problem((key,), "the second must not be below the first", [str(low), str(high)])
        if self.covariance is not None:
            known = {f"{c.name}.{name}" for c in self.channel for term in c.term for name in term.coefficients}
            if strange := [name for name in self.covariance.names if name not in known]:
                text = f"names coefficients that no channel has: {', '.join(strange[:5])}"
                yield Problem(("covariance", "names"), text)

    def channel_of(self, kind: str, axis: str) -> CalibratedChannel | None:
        """The channel of that kind and axis, if it has one."""
        return next((c for c in self.channel if (c.kind, c.axis) == (kind, axis)), None)


def parse_any_calibration(text: str, source: str = "") -> Calibration | UnitCalibration:
    """The calibration of a gyro's axes, or of a whole unit, in a TOML text. Raises `SpecError` with every fault."""

    def of(document: dict[str, Any], _: str) -> Calibration | UnitCalibration:
        kind = UnitCalibration if document.get("quantity") == "unit" else Calibration
        return model_of(kind, document, FORMAT, source)

    return from_text(of, text, source)


def read_any_calibration(path: str | Path) -> Calibration | UnitCalibration:
    """The calibration in a file, of a gyro's axes or of a whole unit: coefficients and covariance in SI.

    Errors: `SpecError` with every fault.
    """
    return parse_any_calibration(read_text(path), str(path))


def write_unit_calibration(calibration: UnitCalibration, path: str | Path) -> None:
    """Write a unit's calibration, atomically; the head of the file explains its numbers and units.

    Errors: `OSError` where it cannot be written.
    """
    write_toml(calibration, path, header=_HEADER + (SIMULATED if calibration.simulated else ""))


def expect_axes(calibration: Calibration | UnitCalibration, what: str) -> Calibration:
    """The calibration of a gyro's axes. Raises `ValueError` for a whole unit's, which `what` does not support."""
    if isinstance(calibration, UnitCalibration):
        raise ValueError(f"{what} is for calibrations of a gyro's axes, and this one is of a whole unit")
    return calibration


_HEADER: Final = """\
The calibration of a whole unit: three gyros, three accelerometers. Apply it with `gradcal apply`.
    measured = input + sum of map(T) * signals       rates in rad/s, specific force in m/s^2
[[channel]] has the unit's own terms, [[table]] the estimated errors of the table.
Numbers without a unit are SI: rad, s, m, degC."""


def term_of(name: str, unit: str, signals: tuple[str, ...], coefficients: dict[str, float], **bases: Any):
    """A term from plain numbers; bases that are None are left out."""
    bases_present = {key: value for key, value in bases.items() if value is not None}
    return CalibratedTerm(name=name, unit=unit, signals=signals, coefficients=coefficients, **bases_present)
