"""Contracts for other programs: gradcal-timeline/1 and gradcal-prediction/1. SI unless a name ends in its unit.

They are written by the program and read by others, so every number is plain. What cannot be observed is null, with a
warning; nothing is ever nan or infinite.
"""

from typing import Annotated, Literal

from pydantic import Field

from gradcal_jax.files.section import Section

Finite = Annotated[float, Field(allow_inf_nan=False)]
Size = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Axis = Literal["x", "y", "z"]


class BasisRow(Section):
    """A basis: `centre` and `scale` in °C and K, or in rad/s; `knots` or `edges` likewise."""

    basis: Literal["polynomial", "b-spline", "bins"]
    degree: int | None = None
    centre: Finite | None = None
    scale: Size | None = None
    knots: tuple[Finite, ...] | None = None
    edges: tuple[Finite, ...] | None = None


class ProcessRow(Section):
    """A first-order Gauss–Markov process: stationary standard deviation and correlation time (s)."""

    sigma: Size
    tau: Size


class DiscrepancyRow(Section):
    """Prior standard deviation of the polynomials that the structure leaves out, up to these degrees."""

    sigma: Size
    temperature_degree: int
    rate_degree: int | None = None


class MapRow(Section):
    """B(T) in rad/s, or M(T, ω) as a ratio. `prior`, `smoothness`: standard deviations; null is flat."""

    temperature: BasisRow
    rate: BasisRow | None = None
    prior: Size | None = None
    smoothness: Size | None = None
    discrepancy: DiscrepancyRow | None = None


class TemperatureErrorRow(Section):
    """Error of the temperature measurement (K; `tau` null: constant) and the maps' slopes (rad/s/K, 1/K)."""

    sigma: Size
    tau: Size | None = None
    bias_slope: Finite | None = None
    scale_factor_slope: Finite | None = None


class GradientSensitivityRow(Section):
    """Bias sensitivity to dT/dt, estimated; `prior` in rad/K, null is flat."""

    prior: Size | None = None


class SensorRow(Section):
    """The error model. `arw` in rad/√s, `rate_random_walk` in rad/s/√s, `turn_on_bias` in rad/s, `thermal_lag` in s."""

    quantity: Literal["gyro"] = "gyro"
    arw: Size
    rate_random_walk: Size = 0.0
    turn_on_bias: Size | None = None
    drift: tuple[ProcessRow, ...] = ()
    scale_factor_instability: tuple[ProcessRow, ...] = ()
    thermal_lag: Size | None = None
    sample_clock_error: Size | None = None
    temperature_error: TemperatureErrorRow | None = None
    bias_temperature_gradient: GradientSensitivityRow | None = None
    bias: MapRow | None = None
    scale_factor: MapRow | None = None


class SegmentRow(Section):
    """What one axis and the chamber do from `start` for `duration` (s).

    `shape` is "rest", "constant" or a motion shape, with the shape's own parameters: `ramp` (s), `cycles`, `controls`
    (rates relative to `peak_rate`), `unevenness`. `peak_rate` (rad/s) and `angle` (rad) are signed. Temperatures
    (°C) are the chamber's, linear from start to end, or through `temperature_bends` (time s, °C).
    `standstill_id` numbers the times that the axis stands; null while it moves.
    """

    axis: Axis
    start: Finite
    duration: Size
    shape: str
    peak_rate: Finite = 0.0
    angle: Finite = 0.0
    ramp: Size | None = None
    cycles: int | None = None
    controls: tuple[Finite, ...] | None = None
    unevenness: Size | None = None
    temperature_start: Finite
    temperature_end: Finite
    temperature_bends: tuple[tuple[Finite, Finite], ...] | None = None
    standstill_id: int | None = None


class ReadingRow(Section):
    """One reading. "angle": at `time` (s). "rate": the mean over `duration` up to `time`.

    `white_std`: of this reading alone; `offset_std`: common to the standstill (or the set point) `standstill_id`;
    rad for angles, rad/s for rates. `timing_std` in s. A rate reading's `rate` is the reference in rad/s.
    """

    time: Finite
    kind: Literal["angle", "rate"]
    axis: Axis
    white_std: Size
    standstill_id: int | None = None
    offset_std: Size = 0.0
    timing_std: Size = 0.0
    duration: Size | None = None
    rate: Finite | None = None


class HarmonicRow(Section):
    """Repeatable angle error: standard deviation (rad) of the cosine and of the sine of `order` periods a turn."""

    order: int
    sigma: Size


class Timeline(Section):
    """gradcal-timeline/1: all that another program needs to compute the information matrix by itself."""

    format: Literal["gradcal-timeline/1"] = "gradcal-timeline/1"
    title: str | None = None
    sensor: SensorRow
    harmonics: tuple[HarmonicRow, ...] = ()
    segments: tuple[SegmentRow, ...]
    readings: tuple[ReadingRow, ...]


class RequirementRow(Section):
    """What is left, in `unit`: ppm for a scale factor, deg/h for a bias. Null: cannot be observed by this plan."""

    name: str
    quantity: Literal["scale_factor", "bias"]
    unit: Literal["ppm", "deg/h"]
    axis: Axis = "x"
    temperature_c: tuple[Finite, Finite]
    rate_dps: tuple[Finite, Finite] | None = None
    grid: tuple[int, ...]
    statistic: Literal["mean of max", "max", "mean", "rms"]
    mean_of_max: Size | None = None
    max: Size | None = None
    mean: Size | None = None
    rms: Size | None = None
    target: Size | None = None
    verdict: Literal["met", "missed", "unobservable"] | None = None
    limited_by: str | None = None

    @property
    def decisive(self) -> float | None:
        """The value of the requirement's own statistic; None: not observable."""
        return {"mean of max": self.mean_of_max, "max": self.max, "mean": self.mean, "rms": self.rms}[self.statistic]


class ParameterRow(Section):
    """A coefficient in the paper's names: ``a0…`` (bias), ``b{rate power}{temperature power}`` (scale factor)."""

    name: str
    axis: Axis = "x"
    std: Size | None
    unit: str


class Prediction(Section):
    """gradcal-prediction/1: the residual that a plan leaves. `covariance` is in the units of the parameters."""

    format: Literal["gradcal-prediction/1"] = "gradcal-prediction/1"
    title: str | None = None
    duration_s: Size
    soak_s: Size
    motion_s: Size
    requirements: tuple[RequirementRow, ...]
    parameters: tuple[ParameterRow, ...]
    covariance: tuple[tuple[Finite | None, ...], ...] | None
    warnings: tuple[str, ...] = ()
