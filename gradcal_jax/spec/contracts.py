"""Contracts for other programs: gradcal-prediction/1. SI unless a name ends in its unit.

Other programs read them, so every number is plain. An unobservable value is null, with a warning; no value is nan or
infinite.
"""

from collections.abc import Sequence
from typing import Annotated, Literal

from pydantic import Field

from gradcal_jax.spec.requirement import QUANTITIES, Statistic
from gradcal_jax.tables.display import amount
from gradcal_jax.tables.section import OneOf, Section
from gradcal_jax.tables.table import Table
from gradcal_jax.units import times_text

Finite = Annotated[float, Field(allow_inf_nan=False)]
Size = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Axis = Literal["x", "y", "z"]


class RequirementRow(Section):
    """The error that remains after the calibration in the quantity of a requirement (the residual; one standard
    deviation), in `unit`. A figure is null if this plan cannot observe it, or if it was not requested. The statistics
    are for this run, with the terms that the spec names. The verdict also includes the terms that the spec
    omits (`with_typical`) and the bias of another power-on (`another_run`)."""

    name: str
    """Name of the requirement."""
    quantity: Annotated[str, OneOf(QUANTITIES)]
    """Quantity that the requirement limits."""
    unit: Annotated[str, OneOf(of.unit for of in QUANTITIES.values())]
    """Unit of all figures."""
    axis: Axis | Literal["all", "worst"] = "x"
    """Axis; for an IMU, also how the elements of the quantity are combined."""
    temperature_c: tuple[Finite, Finite]
    """Lowest and highest temperature (°C)."""
    rate_dps: tuple[Finite, Finite] | None = None
    """Lowest and highest rate (deg/s); null: the quantity does not depend on rate."""
    grid: tuple[int, ...]
    """Number of temperatures (and of rates) at which the residual was evaluated."""
    statistic: Statistic
    """The statistic that decides the verdict."""
    mean_of_max: Size | None = None
    """Statistic "mean of max": maximum over temperature, averaged over rate."""
    max: Size | None = None
    """Largest value over temperature and rate."""
    mean: Size | None = None
    """Mean over temperature and rate."""
    rms: Size | None = None
    """Root mean square over temperature and rate."""
    target: Size | None = None
    """Limit on the error."""
    verdict: Literal["met", "missed", "unobservable", "not covered", "not valid"] | None = None
    """Whether the target is met; "not covered": the data of an estimate do not cover all temperatures and rates of the
    requirement."""
    coverage: Size = 1.0
    """Number of standard deviations that must be within the target."""
    rule: str | None = None
    """Rule of the verdict, in words."""
    limited_by: str | None = None
    """The largest sources of the residual, in words."""
    with_typical: Size | None = None
    """The deciding statistic with every omitted term at the typical value of its class; null: the spec omits no
    term."""
    another_run: Size | None = None
    """The same statistic including the bias of another power-on; null: no turn-on bias counts (`of = "this run"`, or
    the sensor has none)."""
    worst: Size | None = None
    """Largest standard deviation, over temperature and rate, of the quantity that the verdict judges."""

    @property
    def decisive(self) -> float | None:
        """The value of the requirement's own statistic, by the spec's terms alone; None: not observable."""
        return getattr(self, self.statistic.replace(" ", "_"))

    @property
    def judged(self) -> float | None:
        """The value that the verdict judges; None: not observable."""
        return next((v for v in (self.another_run, self.with_typical) if v is not None), self.decisive)


class AbsentRow(Section):
    """An error term that the spec omits; it counts with the typical value of its class."""

    key: str
    """Key of the term in the spec."""
    typical: str
    """Typical value of the class."""
    source: str
    """Source of this value."""


class ParameterRow(Section):
    """A coefficient, named as in the paper: ``a0…`` (bias), ``b{rate power}{temperature power}`` (scale factor). For an
    IMU, `axis` is "unit", and the name begins with that of the channel: ``gyro_x.b00``."""

    name: str
    """Name of the coefficient."""
    axis: Axis | Literal["unit"] = "x"
    """Axis of the sensor, or "unit" for an IMU."""
    std: Size | None = None
    """Standard deviation after the calibration; null: this plan cannot observe the coefficient."""
    unit: str
    """Unit of the coefficient."""


class PlaceRow(Section):
    """The residuals of the IMU at one place of a fixture."""

    name: str
    """Name of the place."""
    values: dict[str, Finite | None]
    """Residual of each requirement, by the requirement's name, in the requirement's unit; null: not observable."""


class Prediction(Section):
    """gradcal-prediction/1: the residual that a plan leaves."""

    format: Literal["gradcal-prediction/1"] = "gradcal-prediction/1"
    """Name and version of this contract."""
    title: str | None = None
    """Title of the spec."""
    duration_s: Size
    """Duration of the whole plan (s)."""
    soak_s: Size
    """Total duration of the soaks (s)."""
    motion_s: Size
    """Duration of the ramp (s)."""
    requirements: tuple[RequirementRow, ...] = ()
    """Residuals, one entry for each requirement."""
    parameters: tuple[ParameterRow, ...] = ()
    """Coefficients with their standard deviations."""
    covariance: tuple[tuple[Finite | None, ...], ...] | None = None
    """Covariance of the coefficients, in the units of `parameters`; null entries belong to coefficients that cannot be
    observed."""
    warnings: tuple[str, ...] = ()
    """Warnings, in sentences."""
    omitted: tuple[AbsentRow, ...] = ()
    """Error terms that the spec omits; they count in the verdicts with typical values."""
    places: tuple[PlaceRow, ...] = ()
    """For a fixture of several IMUs: residuals at every place; all other results are for the worst place."""
    place: str | None = None
    """For a fixture of several IMUs: name of the worst place."""

    def _shown(self) -> list[str]:
        hidden = [row.name for row in self.parameters if row.std is None]
        counts = {"parameter": self.parameters, "omitted error term": self.omitted, "warning": self.warnings}
        numbers = [f"{len(rows)} {name}{'s' * (len(rows) != 1)}" for name, rows in counts.items() if rows]
        return [
            f"Prediction: {self.title}" if self.title else "Prediction",
            times_text(self.duration_s, self.soak_s, self.motion_s),
            ", ".join(numbers),
            *([f"not observable: {', '.join(hidden)}"] if hidden else []),
            outcomes(self.requirements, limits=False).text(),
        ]


def outcomes(rows: Sequence[RequirementRow], *, limits: bool = True) -> Table:
    """A row for each requirement: the residual that its verdict judges (1σ), the target, and what `limits` it."""
    several = len({row.axis for row in rows} & {"x", "y", "z"}) > 1
    heads = ["requirement", "statistic", "residual 1σ", "target", "verdict"]
    cells: list[tuple[str, ...]] = []
    for row in rows:
        name = f"{row.name}, axis {row.axis}" if several else row.name
        target = "" if row.target is None else amount(row.target, row.unit)
        cell = (name, row.statistic, amount(row.judged, row.unit), target, row.verdict or "")
        cells.append((*cell, row.limited_by or "") if limits else cell)
    return Table.of([*heads, "limited by"] if limits else heads, cells)
