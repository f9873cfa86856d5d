"""Contracts for other programs: gradcal-timeline/2 and gradcal-prediction/1. SI unless a name ends in its unit.

They are written by the program and read by others, so every number is plain. What cannot be observed is null, with a
warning; nothing is ever nan or infinite.
"""

from typing import Annotated, Literal

from pydantic import Field

from gradcal_jax.files.section import Section

Finite = Annotated[float, Field(allow_inf_nan=False)]
Size = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Axis = Literal["x", "y", "z"]
UnitQuantity = Literal[
    "gyro_bias", "gyro_scale_factor", "gyro_misalignment", "g_sensitivity", "accelerometer_bias",
    "accelerometer_scale_factor", "accelerometer_misalignment", "second_order", "position", "tilt", "heading",
]  # fmt: skip

Functions = Literal["monomial", "legendre", "chebyshev", "b-spline", "bins"]


class BasisRow(Section):
    """A basis: `centre` and `scale` in °C and K, or in rad/s; `knots` or `edges` likewise.

    Functions of x = (value − centre)/scale for polynomials. B-splines are clamped: the end knots are repeated, and
    beyond them the value at the end holds; beyond the outer edges the outer bins hold. `prior_functions`: the functions
    whose coefficients the map's `prior` is on, and a prediction's `std`; `smoothness_functions`: those whose
    coefficients its `smoothness` is on (null without one).
    """

    basis: Literal["polynomial", "b-spline", "bins"]
    degree: int | None = None
    centre: Finite | None = None
    scale: Size | None = None
    knots: tuple[Finite, ...] | None = None
    edges: tuple[Finite, ...] | None = None
    prior_functions: Functions
    smoothness_functions: Functions | None = None


class ProcessRow(Section):
    """A first-order Gauss–Markov process: stationary standard deviation and correlation time (s)."""

    sigma: Size
    tau: Size


class DiscrepancyRow(Section):
    """Prior standard deviation of each of the polynomials that the structure leaves out, up to these degrees.

    Products of the `functions` of the map's own x in temperature and in rate, those of the structure excepted.
    """

    sigma: Size
    functions: Literal["legendre"]
    temperature_degree: int
    rate_degree: int | None = None


class MapRow(Section):
    """B(T) in rad/s, or M(T, ω) as a ratio, in products of the two bases. Standard deviations, null is flat:

    `prior` of each coefficient, independent; `smoothness` of each difference of coefficients that are neighbours along
    the axes `smoothness_along`.
    """

    temperature: BasisRow
    rate: BasisRow | None = None
    prior: Size | None = None
    smoothness: Size | None = None
    smoothness_along: tuple[Literal["temperature", "rate"], ...] = ()
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


class StartsRow(Section):
    """How each slow error begins with the first segment whose data are used: of each that the sensor has, null for the
    others.

    "stationary": a Gauss–Markov process in its stationary state; "zero": a walk from 0; "constant": one draw that
    stays; "prior": no noise, but a part of B's prior, where B has one: its variance is added to that of the
    coefficients of the function that is 1 everywhere, all together.
    """

    drift: Literal["stationary"] | None = None
    rate_random_walk: Literal["zero"] | None = None
    scale_factor_instability: Literal["stationary"] | None = None
    temperature_error: Literal["stationary", "constant"] | None = None
    sample_clock_error: Literal["constant"] | None = None
    turn_on_bias: Literal["constant", "prior"] | None = None


class SensorRow(Section):
    """The error model. `arw` in rad/√s, `rate_random_walk` in rad/s/√s, `turn_on_bias` in rad/s.

    `drift`, `rate_random_walk` and `turn_on_bias` are rate errors; `scale_factor_instability` and `sample_clock_error`
    are multiplied by the rate. `thermal_lag` (s): first order, between the chamber and what the maps and
    `bias_temperature_gradient` see; sensor and chamber are in equilibrium at the start of the first segment.
    """

    quantity: Literal["gyro"] = "gyro"
    arw: Size
    rate_random_walk: Size = 0.0
    turn_on_bias: Size | None = None
    drift: tuple[ProcessRow, ...] = ()
    scale_factor_instability: tuple[ProcessRow, ...] = ()
    thermal_lag: Size | None = None
    sample_clock_error: Size | None = None
    starts: StartsRow
    temperature_error: TemperatureErrorRow | None = None
    bias_temperature_gradient: GradientSensitivityRow | None = None
    bias: MapRow | None = None
    scale_factor: MapRow | None = None


class SegmentRow(Section):
    """What one sensor axis and the chamber do from `start` for `duration` (s).

    `shape` is "rest", "constant" or a motion shape, with the shape's own parameters: `ramp` (s), `cycles`, `controls`
    (rates relative to `peak_rate`), `unevenness`. `peak_rate` (rad/s) and `angle` (rad) are signed. Temperatures
    (°C) are the chamber's, linear from start to end, or through `temperature_bends` (time s, °C); where a segment
    begins elsewhere than the one before it ended, the chamber steps.
    `standstill_id` numbers the times that the axis stands; null while it moves. `table_axis`: the axis that the table
    turns meanwhile; null: none. `read`: whether a reading of this axis falls into the segment, its start excepted.
    `used`: false where the data are not part of the calibration; a reading that ends it is the angle's new origin.
    """

    axis: Axis
    table_axis: Axis | None = None
    read: bool
    used: bool = True
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

    `origin`: the angle is counted from this reading on; of what was turned before it nothing is known. The first
    reading of an axis is one.

    `white_std`: of this reading alone; `offset_std`: common to the standstill (or the set point) `standstill_id`;
    rad for angles, rad/s for rates. `timing_std` in s. A rate reading's `rate` is the reference in rad/s.
    """

    time: Finite
    kind: Literal["angle", "rate"]
    axis: Axis
    origin: bool = False
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
    """gradcal-timeline/2: all that another program needs to compute the information matrix by itself.

    `estimator`: "best linear" is generalised least squares with all priors; "least squares" weighs the mean rate errors
    of all readings alike and uses no prior. `points`, of the standard method: "independent" where every rate reading
    has noise of its own, begun anew; "one run" where all share what `starts` begins, over the run's time, and only the
    reference (`offset_std`) is drawn anew at each set point. Axes share nothing.
    """

    format: Literal["gradcal-timeline/2"] = "gradcal-timeline/2"
    title: str | None = None
    estimator: Literal["best linear", "least squares"] = "best linear"
    points: Literal["independent", "one run"] | None = None
    sensor: SensorRow
    harmonics: tuple[HarmonicRow, ...] = ()
    segments: tuple[SegmentRow, ...]
    readings: tuple[ReadingRow, ...]


class CheckRow(Section):
    """Holding one unit's calibration against a second run of the same plan, at the worst place of the box: the chances,
    before either run, that it is accepted, accepted although its error is beyond the target, rejected although within.
    """

    accepted: Size
    false_accept: Size
    false_reject: Size


class MissionRow(Section):
    """One mission, its weight, and `after_s` the error (deg, 1σ) that the calibration leaves, and the `own` noise's."""

    file: str
    weight: Size
    after_s: Size
    left: Size | None = None
    own: Size


class RequirementRow(Section):
    """What is left, in `unit`: ppm for a scale factor, deg/h for a bias, deg for the heading in missions and for north.
    Null: cannot be observed by this plan.

    `own`, of heading and north: what the unit's own noise adds (root sum of squares), which no calibration takes off;
    `own_sources`: its parts; `missions`: each alone.

    Of a whole unit, `axis` says how its elements are summed up: "all" together, or the "worst".
    `uncertain`: the least and the largest of the deciding statistic, where noise figures are uncertain.
    `rule`: of the verdict, in words. `specific_risk`: chance that the error is beyond the target at the box's worst
    place. `chance`, `chance_everywhere`: that a unit's error keeps the target, by the requirement's statistic, and at
    every place of the box; `check`: global risks (JCGM 106) of a second run; `with_typical`: the residual with every
    absent error term at what is typical of its class. Null where they were not asked for.
    """

    name: str
    quantity: Literal["scale_factor", "bias", "north"] | UnitQuantity
    unit: Literal["ppm", "deg/h", "urad", "deg/h/g", "ug", "ug/g^2", "m", "deg"]
    axis: Axis | Literal["all", "worst"] = "x"
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
    coverage: Size = 1.0
    rule: str | None = None
    specific_risk: Size | None = None
    chance: Size | None = None
    chance_everywhere: Size | None = None
    check: CheckRow | None = None
    limited_by: str | None = None
    uncertain: tuple[Size, Size] | None = None
    with_typical: Size | None = None
    own: Size | None = None
    own_sources: dict[str, Size] | None = None
    missions: tuple[MissionRow, ...] | None = None

    @property
    def decisive(self) -> float | None:
        """The value of the requirement's own statistic; None: not observable."""
        return {"mean of max": self.mean_of_max, "max": self.max, "mean": self.mean, "rms": self.rms}[self.statistic]


class AbsentRow(Section):
    """An error term that the spec does not name and the prediction counts as zero: its key, and what is typical."""

    key: str
    typical: str
    source: str


class ParameterRow(Section):
    """A coefficient in the paper's names: ``a0…`` (bias), ``b{rate power}{temperature power}`` (scale factor).

    Of a whole unit, `axis` is "unit", and the name begins with the channel's: ``gyro_x.b00``.
    """

    name: str
    axis: Axis | Literal["unit"] = "x"
    std: Size | None
    unit: str


class NoticeRow(Section):
    """What a test of the log, whose level is `false_alarm`, notices of structure that a map has and the model lacks:
    the polynomials after the map's, up to these degrees.

    `power`: the probability where the coefficient of each has the `standard_deviation` (`unit`; both null where the
    spec has no size for it); `sure_from`: the size from which on it is `sure_power`; null: never. `components`: how
    many combinations of the coefficients the plan sees, the test's degrees of freedom.
    """

    quantity: Literal["scale_factor", "bias"]
    axis: Axis = "x"
    unit: Literal["ppm", "deg/h"]
    temperature_degree: int
    rate_degree: int | None = None
    components: int
    false_alarm: Size
    standard_deviation: Size | None = None
    power: Size | None = None
    sure_power: Size
    sure_from: Size | None = None

    @property
    def sentence(self) -> str:
        """As people read it."""
        shape = f"up to degree {self.temperature_degree}"
        shape += " in temperature" if self.rate_degree is None else f" in temperature by {self.rate_degree} in rate"
        hidden = f"structure of the {self.quantity.replace('_', ' ')} that the model lacks (polynomials {shape})"
        if self.sure_from is None:
            words = "goes unnoticed, whatever its size"
        else:
            words = f"with a probability of {self.sure_power:.0%} from {self.sure_from:.3g} {self.unit} each on"
            if self.power is not None:
                size = f"{self.standard_deviation:.4g} {self.unit}"
                words = f"with a probability of {self.power:.0%} where each has {size}, and {words}"
            words = f"is noticed {words}"
        return f"{hidden} {words}; false alarms: {self.false_alarm:.2g}"


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
    notices: tuple[NoticeRow, ...] = ()
    warnings: tuple[str, ...] = ()
    counted_as_zero: tuple[AbsentRow, ...] = ()
