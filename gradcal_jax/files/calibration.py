"""gradcal-calibration/1: the estimated coefficients of one unit, their covariance, and the range of validity.

    measured = (1 + M(T, ω))·ω + B(T) [+ g·dT/dt]          on each axis, in the sensor's own frame

The coefficients are those of the paper: `a{k}` multiplies the k-th power of `(T − centre)/scale` in B (rad/s),
`b{j}{i}` the j-th power of `(ω − centre)/scale` and the i-th of the temperature's in M (a ratio). Other bases count
their functions: `a_bin3`, `b_spline2_1`. Numbers without a unit are SI.
"""

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Final, Literal

from pydantic import Field

from gradcal_jax.files.bases import RateBasis, RatePolynomial, TemperatureBasis, TemperaturePolynomial, increasing
from gradcal_jax.files.document import TitledFile, parsed, read_text
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
    Whole,
)
from gradcal_jax.files.section import Section
from gradcal_jax.files.writing import write_toml

FORMAT: Final = "gradcal-calibration/1"
ORDER: Final = "measured = (1 + M(T, rate)) * rate + B(T); on each axis alone, in the frame above, before any rotation"
Coefficients = Annotated[dict[str, Number], Field(min_length=1, max_length=40_000)]


class BiasMap(Section):
    """B(T)."""

    temperature: TemperatureBasis
    """Basis over temperature."""
    coefficients: Coefficients
    """By name, rad/s."""

    def _problems(self) -> Iterable[Problem]:
        return _mismatch(self.coefficients, bias_names(self.temperature))


class ScaleFactorMap(Section):
    """M(T, ω)."""

    temperature: TemperatureBasis
    """Basis over temperature."""
    rate: RateBasis
    """Basis over rate."""
    coefficients: Coefficients
    """By name, a ratio."""

    def _problems(self) -> Iterable[Problem]:
        return _mismatch(self.coefficients, scale_factor_names(self.temperature, self.rate))


LOG_HASH: Final = "log_sha256"
"""The provenance has the fingerprint of the calibration's log under this name."""


class Covariance(Section):
    """Covariance of the observable coefficients."""

    names: Annotated[tuple[Text, ...], Field(max_length=5000)]
    """Names of the coefficients."""
    matrix: tuple[tuple[Number, ...], ...]
    """Their covariance, row by row, in their units."""

    def _problems(self) -> Iterator[Problem]:
        count = len(self.names)
        if len(self.matrix) != count or any(len(row) != count for row in self.matrix):
            yield Problem(("matrix",), f"expected {count} rows of {count} numbers, as many as there are names")
        elif any(self.matrix[i][i] < 0.0 for i in range(count)):
            yield Problem(("matrix",), "a variance on its diagonal is negative")


class UnseenError(Section):
    """An error that no residual of the fit shows: of a term of the spec or, with a figure typical of the class, of one
    that it omits. The covariance with all of them is `covariance` plus the sum of their squares."""

    name: Annotated[Text, Field(max_length=200)]
    """Which error."""
    coefficients: dict[str, Number]
    """One standard deviation of it in each coefficient, in the coefficients' units."""


class FitTest(Section):
    """A test of the fit."""

    name: Text
    """Which test."""
    statistic: Number
    """Its χ²."""
    degrees: Whole
    """Degrees of freedom."""
    chance: Number
    """Chance of a value as large or larger."""


class Residuals(Section):
    """Whitened residuals of the fit, in standard deviations: independent and normal where the model is true."""

    counts: Annotated[tuple[Whole, ...], Field(min_length=18, max_length=18)]
    """Counts below -4, in steps of one half from there to 4, and above."""
    rms: Annotated[tuple[Number, ...], Field(max_length=10)] = ()
    """Root mean square of each tenth of them, in the order of time."""


class AxisCalibration(Section):
    """One axis."""

    name: Annotated[Text, Field(max_length=100)]
    """Of the axis."""
    bias: BiasMap | None = None
    """The map B."""
    scale_factor: ScaleFactorMap | None = None
    """The map M."""
    bias_temperature_gradient: Number | None = None
    """Bias in proportion to dT/dt (rad/K)."""
    thermal_lag: Time | None = None
    """Time by which B and M follow the temperature."""
    valid_temperature: tuple[Temperature, Temperature]
    """Temperatures that the data covered; beyond, the values at the edge hold."""
    valid_rate: tuple[Rate, Rate]
    """Rates that the data covered; beyond, the values at the edge hold."""
    covariance: Covariance | None = None
    """Of the coefficients, by the fit."""
    unseen: Annotated[tuple[UnseenError, ...], Field(max_length=5000)] = ()
    """Errors that no residual shows, and that the results and every stated uncertainty count."""
    fit: Annotated[tuple[FitTest, ...], Field(max_length=100)] = ()
    """Tests of the fit."""
    contradicted: Annotated[tuple[Text, ...], Field(max_length=100)] = ()
    """Tests of the fit that fail: the data contradict the model, and no stated uncertainty is valid."""
    residuals: Residuals | None = None
    """Residuals of the fit."""
    unobservable: tuple[Text, ...] = ()
    """Combinations of coefficients that the data do not determine."""

    def _problems(self) -> Iterator[Problem]:
        if self.bias is None and self.scale_factor is None:
            yield Problem((), 'holds nothing; give "bias", "scale_factor" or both')
        for key, span in (("valid_temperature", self.valid_temperature), ("valid_rate", self.valid_rate)):
            yield from increasing(span, key) if span[0] != span[1] else []
        if self.covariance is not None:
            known = self.values()
            if strange := [name for name in self.covariance.names if name not in known]:
                text = f"names coefficients that this axis does not have: {', '.join(strange[:5])}"
                yield Problem(("covariance", "names"), text)

    def values(self) -> dict[str, float]:
        """Every coefficient by name."""
        parts = [part.coefficients for part in (self.bias, self.scale_factor) if part is not None]
        gradient = self.bias_temperature_gradient
        own = {} if gradient is None else {"bias_temperature_gradient": gradient}
        return {name: value for part in (*parts, own) for name, value in part.items()}


class Result(Section):
    """The result for a requirement of the spec, in `unit`."""

    name: Text
    """Of the requirement."""
    axis: Text
    """Of the sensor."""
    quantity: Literal["scale_factor", "bias", "heading", "north"]
    """Which quantity."""
    statistic: Text
    """The one that decides."""
    value: Number | None = None
    """Its value, one sigma, with terms that the spec omits and, in any run, the turn-on bias; absent: not
    observable."""
    named: Number | None = None
    """Its value by the terms that the spec names, in this run, where it is another."""
    worst: Number | None = None
    """The standard deviation at the worst place of the box."""
    unit: Text
    """Unit of all figures."""
    target: Number | None = None
    """Limit on the error."""
    verdict: Text | None = None
    """Whether it is met."""
    coverage: Number | None = None
    """Standard deviations that must be within the target."""
    risk: Annotated[Number, Field(gt=0.0, le=0.5)] | None = None
    """Largest chance that a unit beyond the target passes; absent: simple acceptance."""
    rule: Text | None = None
    """Rule of the verdict, in words."""


class Noise(Section):
    """The noise that the estimate assumed, for programs that filter."""

    angle_random_walk: AngleRandomWalk
    """White noise of the rate."""
    rate_random_walk: RateRandomWalk | None = None
    """Random walk of the rate."""
    sample_rate: Frequency | None = None
    """Of the log."""


class Calibration(TitledFile):
    """A whole calibration file."""

    format: Literal["gradcal-calibration/1"]
    serial_number: Text
    """Of the unit."""
    quantity: Literal["gyro"]
    """What the sensor measures."""
    simulated: Flag
    """Whether no real sensor made the data."""
    frame: Text
    """In which frame the axes are."""
    order: Text
    """In which order the correction is applied, in words."""
    axis: Annotated[tuple[AxisCalibration, ...], Field(min_length=1, max_length=20)]
    """Calibrations by axis."""
    noise: Noise | None = None
    """The assumed noise."""
    lacks: Text | None = None
    """What part of the plan the log lacks, and what the executed part alone predicts."""
    result: Annotated[tuple[Result, ...], Field(max_length=1000)] = ()
    """The results for the requirements."""
    provenance: dict[str, Text] = Field(default_factory=dict)
    """Texts by name: versions, sources, the log's hash."""

    def _problems(self) -> Iterator[Problem]:
        names = [axis.name for axis in self.axis]
        if len(set(names)) < len(names):
            yield Problem(("axis",), "two axes have the same name")

    def axis_of(self, name: str) -> AxisCalibration:
        """The axis of that name. Raises `ValueError`."""
        axes = {axis.name: axis for axis in self.axis}
        if name not in axes:
            raise ValueError(f"the calibration has no axis '{name}': it has {', '.join(axes)}")
        return axes[name]


def bias_names(temperature: TemperatureBasis) -> list[str]:
    """Names of B's coefficients, in order."""
    if isinstance(temperature, TemperaturePolynomial):
        return [f"a{i}" for i in range(temperature.size)]
    return [f"a_{_kind(temperature.basis)}{i}" for i in range(temperature.size)]


def scale_factor_names(temperature: TemperatureBasis, rate: RateBasis) -> list[str]:
    """Names of M's coefficients, in the order temperature slow, rate fast."""
    both = isinstance(temperature, TemperaturePolynomial) and isinstance(rate, RatePolynomial)
    if both and max(temperature.size, rate.size) <= 10:
        return [f"b{j}{i}" for i in range(temperature.size) for j in range(rate.size)]

    def ordinal(basis: TemperatureBasis | RateBasis, index: int) -> str:
        return str(index) if basis.basis == "polynomial" else f"_{_kind(basis.basis)}{index}"

    return [f"b{ordinal(rate, j)}_{ordinal(temperature, i)}" for i in range(temperature.size) for j in range(rate.size)]


def _kind(basis: str) -> str:
    return {"b-spline": "spline", "bins": "bin"}[basis]


def _mismatch(coefficients: Mapping[str, float], expected: list[str]) -> Iterator[Problem]:
    if missing := [name for name in expected if name not in coefficients]:
        yield Problem(("coefficients",), f"lacks {', '.join(missing[:8])}", kind="missing")
    if strange := [name for name in coefficients if name not in set(expected)]:
        yield Problem(("coefficients",), f"has {', '.join(strange[:8])}, which the basis does not")


def read_calibration(path: str | Path) -> Calibration:
    """Read a calibration file: coefficients and covariance in SI (rad/s, ratios), range of validity, residuals.

    Errors: `SpecError` with every fault.
    """
    return parse_calibration(read_text(path), str(path))


def parse_calibration(text: str, source: str = "") -> Calibration:
    """The calibration in a TOML text; `source` names it in messages. Raises `SpecError` with every fault."""
    return parsed(Calibration, text, FORMAT, source)


def write_calibration(calibration: Calibration, path: str | Path) -> None:
    """Write a calibration, atomically; the head of the file explains its numbers and units.

    Errors: `OSError` where it cannot be written.
    """
    write_toml(calibration, path, header=_HEADER + (SIMULATED if calibration.simulated else ""))


_HEADER: Final = """\
The calibration of one unit. Apply it with `gradcal apply`, check it with `gradcal validate`.
    measured = (1 + M(T, rate)) * rate + B(T)
a{k}: rad/s, times the k-th power of (T - centre)/scale, in B.
b{j}{i}: ratio, times the j-th power of (rate - centre)/scale and the i-th of the temperature's, in M.
Numbers without a unit are SI: rad, s, degC."""
SIMULATED: Final = "\nSIMULATED: made from simulated data, of no real unit."
