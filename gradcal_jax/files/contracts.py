"""Contracts for other programs: gradcal-prediction/1, rows of gradcal-timeline/3. SI unless a name ends in its unit.

Other programs read them, so every number is plain. An unobservable value is null, with a warning; no value is nan or
infinite.
"""

from collections.abc import Sequence
from itertools import groupby
from typing import Annotated, Literal

from pydantic import Field

from gradcal_jax.display import WIDTH, amount, columns, html
from gradcal_jax.files.section import Section
from gradcal_jax.units import times_text

Finite = Annotated[float, Field(allow_inf_nan=False)]
Size = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Axis = Literal["x", "y", "z"]
ImuQuantity = Literal[
    "gyro_bias", "gyro_scale_factor", "gyro_misalignment", "g_sensitivity", "accelerometer_bias",
    "accelerometer_scale_factor", "accelerometer_misalignment", "second_order", "position", "tilt", "heading",
    "mission_heading", "north",
]  # fmt: skip

Functions = Literal["monomial", "legendre", "chebyshev", "b-spline", "bins"]


class BasisRow(Section):
    """A basis: polynomials in x = (value − centre)/scale, splines or bins.

    B-splines are clamped: the end knots are repeated, and beyond them the value at the end applies; beyond the outer
    edges the outer bins apply.
    """

    basis: Literal["polynomial", "b-spline", "bins"]
    """Kind of functions."""
    degree: int | None = None
    """Highest power, or degree of the pieces."""
    centre: Finite | None = None
    """Value at which x is 0 (°C or rad/s)."""
    scale: Size | None = None
    """Difference at which x is 1 (K or rad/s)."""
    knots: tuple[Finite, ...] | None = None
    """Where pieces meet (°C or rad/s)."""
    edges: tuple[Finite, ...] | None = None
    """Where bins meet (°C or rad/s)."""
    prior_functions: Functions
    """Functions whose coefficients have the map's `prior` and the prediction's `std`."""
    smoothness_functions: Functions | None = None
    """Functions whose coefficients have its `smoothness`; null without one."""


class ProcessRow(Section):
    """A first-order Gauss–Markov process."""

    sigma: Size
    """Stationary standard deviation (rad/s, a ratio, or m/s²)."""
    tau: Size
    """Correlation time (s)."""


class DiscrepancyRow(Section):
    """Polynomials beyond the structure: products of functions of the map's own x in both directions."""

    sigma: Size
    """Prior standard deviation of each coefficient."""
    functions: Literal["legendre"]
    """Kind of polynomials."""
    temperature_degree: int
    """Highest degree in temperature."""
    rate_degree: int | None = None
    """Highest degree in rate; null for B."""


class MapRow(Section):
    """B(T) in rad/s, or M(T, ω) as a ratio, in products of the two bases."""

    temperature: BasisRow
    """Basis over temperature."""
    rate: BasisRow | None = None
    """Basis over rate; null for B."""
    prior: Size | None = None
    """Standard deviation of each coefficient, independent; null: flat."""
    shapes: tuple[tuple[Finite, ...], ...] | None = None
    """Instead of `prior`: coefficients of functions whose amplitudes are independent with variance 1; null:
    none."""
    smoothness: Size | None = None
    """Standard deviation of each difference of neighbouring coefficients; null: flat."""
    smoothness_along: tuple[Literal["temperature", "rate"], ...] = ()
    """Axes along which neighbours count."""
    discrepancy: DiscrepancyRow | None = None
    """Structure beyond the map."""


class TemperatureErrorRow(Section):
    """Error of the temperature measurement."""

    sigma: Size
    """Standard deviation (K)."""
    tau: Size | None = None
    """Correlation time (s); null: constant."""
    bias_slope: Finite | None = None
    """Slope of the bias (rad/s/K)."""
    scale_factor_slope: Finite | None = None
    """Slope of the scale factor (1/K)."""


class GradientSensitivityRow(Section):
    """Bias sensitivity to dT/dt, estimated."""

    prior: Size | None = None
    """Standard deviation (rad/K); null: flat."""


class CourseRow(Section):
    """A motion, and the chamber's course meanwhile."""

    start: Finite
    """Beginning (s)."""
    duration: Size
    """Length (s)."""
    shape: str
    """"rest", "constant" or a motion shape."""
    peak_rate: Finite = 0.0
    """Largest rate, signed (rad/s)."""
    angle: Finite = 0.0
    """Angle turned, signed (rad)."""
    ramp: Size | None = None
    """Time from rest to the peak rate (s); for a turn by hand, the rest before and after turning."""
    unevenness: Size | None = None
    """For a turn by hand, as a fraction of the rate."""
    used: bool = True
    """False if the data are not part of the calibration."""
    temperature_start: Finite
    """The chamber's at the start (°C); where it differs from that at the end of the previous one, it steps."""
    temperature_end: Finite
    """The chamber's at the end (°C), linear in between."""
    temperature_bends: tuple[tuple[Finite, Finite], ...] | None = None
    """Points (time in s, °C) in between."""


class HarmonicRow(Section):
    """Repeatable angle error."""

    order: int
    """Periods in one turn."""
    sigma: Size
    """Standard deviation of the cosine and of the sine (rad)."""


class CheckRow(Section):
    """Probabilities, before either run, for a test of one sensor's calibration by a second run of the same plan."""

    accepted: Size
    """Chance that it is accepted."""
    false_accept: Size
    """Probability that it is accepted although its error exceeds the target (global risk)."""
    false_reject: Size
    """Probability that it is rejected although its error is within the target (global risk)."""


class MissionRow(Section):
    """One mission of a requirement on the heading."""

    file: str
    """Its table."""
    weight: Size
    """Its weight."""
    after_s: Size
    """When its error is taken (s)."""
    left: Size | None = None
    """Error of the calibration at this time (deg, 1σ)."""
    own: Size
    """Error from the IMU's own noise at this time (deg, 1σ)."""


class RequirementRow(Section):
    """The residual of a requirement, in `unit`. Null: this plan cannot observe it, or it was not requested.

    The statistics are for this run, with the terms that the spec names. The verdict and the risks also include the
    terms that it omits (`with_typical`) and the bias of another power-on (`another_run`).
    """

    name: str
    """Of the requirement."""
    quantity: Literal["scale_factor", "bias"] | ImuQuantity
    """Which quantity."""
    unit: Literal["ppm", "deg/h", "urad", "deg/h/g", "ug", "ug/g^2", "m", "deg"]
    """Unit of all figures."""
    axis: Axis | Literal["all", "worst"] = "x"
    """Axis; for an IMU also how its elements are combined."""
    temperature_c: tuple[Finite, Finite]
    """Range of temperature (°C)."""
    rate_dps: tuple[Finite, Finite] | None = None
    """Range of rate (deg/s); null without one."""
    grid: tuple[int, ...]
    """Number of points at which it was evaluated."""
    statistic: Literal["mean of max", "max", "mean", "rms"]
    """The one that decides."""
    mean_of_max: Size | None = None
    """Maximum over temperature, averaged over rate."""
    max: Size | None = None
    """Largest."""
    mean: Size | None = None
    """Mean."""
    rms: Size | None = None
    """Root mean square."""
    target: Size | None = None
    """Limit on the error."""
    verdict: Literal["met", "missed", "unobservable", "not covered", "not valid"] | None = None
    """Whether the target is met; "not covered": the data of an estimate lack part of the requirement's range."""
    coverage: Size = 1.0
    """Number of standard deviations that must be within the target."""
    risk: Size | None = None
    """Largest probability that a sensor beyond the target passes; null: simple acceptance."""
    rule: str | None = None
    """Rule of the verdict, in words."""
    specific_risk: Size | None = None
    """Probability that the error exceeds the target at the worst point of the box."""
    chance: Size | None = None
    """Probability that the error of a sensor meets the target by the requirement's statistic."""
    chance_everywhere: Size | None = None
    """Probability that it meets the target at every point of the box."""
    check: CheckRow | None = None
    """Global risks (JCGM 106) of a second run."""
    limited_by: str | None = None
    """The limiting errors of the residual, in words."""
    uncertain: tuple[Size, Size] | None = None
    """Smallest and largest value of the deciding statistic if noise figures are uncertain."""
    with_typical: Size | None = None
    """The deciding statistic with every omitted term at the typical value of its class; null: none is omitted."""
    another_run: Size | None = None
    """The same with the bias of another power-on; null: none counts (`of = "this run"`, or no turn-on bias)."""
    worst: Size | None = None
    """Largest standard deviation of the quantity that the verdict judges."""
    own: Size | None = None
    """For heading and north: the contribution of the IMU's own noise (root sum of squares), which remains."""
    own_sources: dict[str, Size] | None = None
    """Its parts."""
    missions: tuple[MissionRow, ...] | None = None
    """Each mission alone."""

    @property
    def decisive(self) -> float | None:
        """The value of the requirement's own statistic, by the spec's terms alone; None: not observable."""
        return {"mean of max": self.mean_of_max, "max": self.max, "mean": self.mean, "rms": self.rms}[self.statistic]

    @property
    def judged(self) -> float | None:
        """The value that the verdict judges; None: not observable."""
        return next((v for v in (self.another_run, self.with_typical) if v is not None), self.decisive)


class AbsentRow(Section):
    """An error term that the spec omits, and that counts with the typical value of its class."""

    key: str
    """Its key."""
    typical: str
    """The class's typical value."""
    source: str
    """Its source."""


class ParameterRow(Section):
    """A coefficient in the paper's names: ``a0…`` (bias), ``b{rate power}{temperature power}`` (scale factor).

    For an IMU, `axis` is "unit", and the name begins with that of the channel: ``gyro_x.b00``.
    """

    name: str
    """Name of the coefficient."""
    axis: Axis | Literal["unit"] = "x"
    """Axis, or "unit"."""
    std: Size | None
    """Standard deviation; null: cannot be observed."""
    unit: str
    """Its unit."""


class NoticeRow(Section):
    """Detection of structure that the model lacks (the next polynomials of the map) by a test of the log."""

    quantity: Literal["scale_factor", "bias"]
    """Which map."""
    axis: Axis = "x"
    """Axis of the sensor."""
    unit: Literal["ppm", "deg/h"]
    """Unit of the sizes."""
    temperature_degree: int
    """Highest degree in temperature."""
    rate_degree: int | None = None
    """Highest degree in rate."""
    components: int
    """Observable combinations of the coefficients: the test's degrees of freedom."""
    false_alarm: Size
    """Level of the test."""
    standard_deviation: Size | None = None
    """Size of each coefficient for `power`; null if the spec has none."""
    power: Size | None = None
    """Probability of detection."""
    sure_power: Size
    """Probability that counts as sure."""
    sure_from: Size | None = None
    """Smallest size with this probability; null: none."""

    @property
    def sentence(self) -> str:
        """In words."""
        return notice_sentences([self])[0]


def _shape(row: NoticeRow) -> tuple[str, int, int]:
    return row.quantity, row.temperature_degree, -1 if row.rate_degree is None else row.rate_degree


def notice_sentences(rows: Sequence[NoticeRow]) -> list[str]:
    """In words, what tests of a log detect: one sentence for each map, with the sizes of all axes."""

    def sizes(of: Sequence[NoticeRow], attribute: str) -> str:
        values = [f"{getattr(row, attribute):.4g} {row.unit}" for row in of]
        return ", ".join(f"{v} ({row.axis})" if len(rows) > 1 else v for v, row in zip(values, of, strict=True))

    sentences: list[str] = []
    for (what, degree, rate), group in groupby(sorted(rows, key=_shape), _shape):
        of = list(group)
        hidden = f"structure of the {what.replace('_', ' ')} that the model lacks (polynomials up to degree {degree}"
        hidden += " in temperature)" if rate < 0 else f" in temperature and {rate} in rate)"
        if seen := [row for row in of if row.sure_from is not None]:
            words = f"{hidden}: a test of the log detects it with {seen[0].sure_power:.0%} probability if each "
            words += f"coefficient is at least {sizes(seen, 'sure_from')}"
            if stated := [row for row in seen if row.power is not None]:
                powers = ", ".join(f"{row.power:.0%}" for row in stated)
                words += f", with {powers} if it is {sizes(stated, 'standard_deviation')}"
            sentences.append(f"{words}; false alarms: {of[0].false_alarm:.2g}")
        if len(seen) < len(of):
            where = ", ".join(row.axis for row in of if row.sure_from is None)
            sentences.append(f"{hidden}: no test of the log detects it" + f" (axis {where})" * (len(of) > 1))
    return sentences


class PlaceRow(Section):
    """The residual of the IMU at one place of a fixture."""

    name: str
    """Of the place."""
    values: dict[str, Finite | None]
    """The residual of each requirement, by its name, in its unit; null: not observable."""
    alone: dict[str, Finite | None] | None = None
    """The same for an IMU that is estimated without the others."""


class Prediction(Section):
    """gradcal-prediction/1: the residual that a plan leaves."""

    format: Literal["gradcal-prediction/1"] = "gradcal-prediction/1"
    """Name and version of this contract."""
    title: str | None = None
    """Of the spec."""
    duration_s: Size
    """Duration of the whole plan (s)."""
    soak_s: Size
    """Duration of its soaks (s)."""
    motion_s: Size
    """Duration of its ramp (s)."""
    requirements: tuple[RequirementRow, ...]
    """Residuals, by requirement."""
    parameters: tuple[ParameterRow, ...]
    """Coefficients."""
    covariance: tuple[tuple[Finite | None, ...], ...] | None
    """Of the coefficients, in the units of the parameters; null entries cannot be observed."""
    notices: tuple[NoticeRow, ...] = ()
    """Detection by tests of the log."""
    warnings: tuple[str, ...] = ()
    """Warnings, in sentences."""
    omitted: tuple[AbsentRow, ...] = ()
    """Error terms that the spec omits; they count in the verdicts."""
    places: tuple[PlaceRow, ...] = ()
    """For a fixture of several IMUs: every place; all other results are for the worst place."""
    place: str | None = None
    """Its name."""
    minutes_per_imu: Size | None = None
    """Duration of the plan over the number of places (min)."""
    imus_per_shift: Size | None = None
    """Number of IMUs in a shift: from complete runs, without changing times, or the fraction of a longer run."""

    _repr_html_ = html

    def _shown(self) -> list[str]:

        hidden = [row.name for row in self.parameters if row.std is None]
        counts = {"parameter": self.parameters, "omitted error term": self.omitted, "warning": self.warnings}
        numbers = [f"{len(rows)} {name}{'s' * (len(rows) != 1)}" for name, rows in counts.items() if rows]
        return [
            f"Prediction: {self.title}" if self.title else "Prediction",
            times_text(self.duration_s, self.soak_s, self.motion_s),
            ", ".join(numbers),
            *([f"not observable: {', '.join(hidden)}"] if hidden else []),
            narrow_table(self.requirements),
        ]


def requirement_table(rows: Sequence[RequirementRow], names: Sequence[str] | None = None) -> list[tuple[str, ...]]:
    """A row for each requirement after a head; "as named", by the terms of the spec alone, only where it differs.

    `names`: of the rows, instead of the requirement's name and, where there are several, its axis.
    """
    several = len({row.axis for row in rows} & {"x", "y", "z"}) > 1
    head = ("requirement", "statistic", "residual 1σ", "as named", "at worst", "target", "verdict")
    names = names or [f"{row.name}, axis {row.axis}" if several else row.name for row in rows]
    shown = [head, *(_row(name, row) for name, row in zip(names, rows, strict=True))]
    if all(row.judged == row.decisive for row in rows):
        return [(*cells[:3], *cells[4:]) for cells in shown]
    return shown


def narrow_table(rows: Sequence[RequirementRow]) -> str:
    """The table as text, without the columns that matter least if it is too wide otherwise."""
    table = requirement_table(rows) if rows else [("no requirement",)]
    for least in ("as named", "at worst", "statistic"):
        text = columns(table, indent="")
        if max(map(len, text.splitlines())) > WIDTH and least in table[0]:
            at = table[0].index(least)
            table = [(*cells[:at], *cells[at + 1 :]) for cells in table]
    return columns(table, indent="")


def _row(name: str, row: RequirementRow) -> tuple[str, ...]:
    left = amount(row.judged, row.unit)
    if row.uncertain is not None:
        left += f" ({row.uncertain[0]:.4g} … {row.uncertain[1]:.4g})"
    target = "" if row.target is None else amount(row.target, row.unit)
    worst = "" if row.worst is None else amount(row.worst, row.unit)
    return (name, row.statistic, left, amount(row.decisive, "").strip(), worst, target, row.verdict or "")
