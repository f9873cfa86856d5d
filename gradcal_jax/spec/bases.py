"""The `temperature` and `rate` bases of `[sensor.bias]` and `[sensor.scale_factor]`."""

from collections.abc import Iterable, Sequence
from typing import Annotated, Literal

from pydantic import Field

from gradcal_jax import formulas
from gradcal_jax.formulas import Array
from gradcal_jax.tables import quantity as q
from gradcal_jax.tables.problems import Problem
from gradcal_jax.tables.section import Section, chosen_by

Degree = Annotated[q.Whole, Field(le=15)]
SplineDegree = Annotated[int, Field(strict=True, ge=0, le=5)]
_MOST_PIECES = 200


def increasing(values: Sequence[float], key: str) -> list[Problem]:
    """A problem for the first entry not above the one before it."""
    for i in range(1, len(values)):
        if values[i] <= values[i - 1]:
            return [Problem((key, i), "must be larger than the entry before it", str(values[i]))]
    return []


class PolynomialKeys(Section):
    """Powers of (x − centre)/scale."""

    basis: Literal["polynomial"] = "polynomial"
    """Kind of functions."""
    degree: Degree
    """Highest power."""
    centre: q.Quantity
    scale: q.Quantity

    @property
    def size(self) -> int:
        """Number of basis functions."""
        return self.degree + 1

    @property
    def span(self) -> tuple[float, float] | None:
        """Where the basis is defined (°C or rad/s); None: everywhere."""
        return None

    def values(self, x: Array) -> Array:
        """Values of its *reported* functions, `(n,) -> (n, size)`."""
        return formulas.monomials((x - float(self.centre)) / float(self.scale), self.degree)


class TemperaturePolynomial(PolynomialKeys):
    """Powers of (T − centre)/scale."""

    centre: q.Temperature = q.Quantity(20.0, "20 degC", "temperature")
    """Temperature at which x is 0."""
    scale: q.PositiveTemperatureDifference
    """Temperature difference at which x is 1."""


class RatePolynomial(PolynomialKeys):
    """Powers of (ω − centre)/scale."""

    centre: q.Rate = q.Quantity(0.0, "0 deg/s", "angular rate")
    """Rate at which x is 0."""
    scale: q.PositiveRate
    """Rate at which x is 1."""


class SplineKeys(Section):
    """B-splines of `degree` on increasing knots, both ends included."""

    basis: Literal["b-spline"]
    """Kind of functions."""
    degree: SplineDegree = 3
    """Degree of the pieces."""
    knots: tuple[q.Quantity, ...]

    def _problems(self) -> Iterable[Problem]:
        return increasing(self.knots, "knots")

    @property
    def size(self) -> int:
        """Number of basis functions."""
        return len(self.knots) - 1 + self.degree

    @property
    def span(self) -> tuple[float, float] | None:
        """Where the basis is defined (°C or rad/s)."""
        return (self.knots[0], self.knots[-1])

    def values(self, x: Array) -> Array:
        """Values of its functions, `(n,) -> (n, size)`."""
        return formulas.b_spline(x, tuple(float(k) for k in self.knots), self.degree)


class TemperatureSpline(SplineKeys):
    """B-splines of `degree` on increasing knots, both ends included."""

    knots: Annotated[tuple[q.Temperature, ...], Field(min_length=2, max_length=_MOST_PIECES)]
    """Knots (temperatures at which pieces meet), increasing, with the first and last temperature of the spline."""


class RateSpline(SplineKeys):
    """B-splines of `degree` on increasing knots, both ends included."""

    knots: Annotated[tuple[q.Rate, ...], Field(min_length=2, max_length=_MOST_PIECES)]
    """Knots (rates at which pieces meet), increasing, with the first and last rate of the spline."""


class BinsKeys(Section):
    """One constant between each pair of neighbouring edges."""

    basis: Literal["bins"]
    """Kind of functions."""
    edges: tuple[q.Quantity, ...]

    def _problems(self) -> Iterable[Problem]:
        return increasing(self.edges, "edges")

    @property
    def size(self) -> int:
        """Number of basis functions."""
        return len(self.edges) - 1

    @property
    def span(self) -> tuple[float, float] | None:
        """Where the basis is defined (°C or rad/s)."""
        return (self.edges[0], self.edges[-1])

    def values(self, x: Array) -> Array:
        """Values of its functions, `(n,) -> (n, size)`."""
        return formulas.bins(x, tuple(float(e) for e in self.edges))


class TemperatureBins(BinsKeys):
    """One constant between each pair of neighbouring edges."""

    edges: Annotated[tuple[q.Temperature, ...], Field(min_length=2, max_length=_MOST_PIECES)]
    """Edges of the bins: temperatures, increasing."""


class RateBins(BinsKeys):
    """One constant between each pair of neighbouring edges."""

    edges: Annotated[tuple[q.Rate, ...], Field(min_length=2, max_length=_MOST_PIECES)]
    """Edges of the bins: rates, increasing."""


TemperatureBasis = Annotated[
    TemperaturePolynomial | TemperatureSpline | TemperatureBins,
    chosen_by(
        "basis",
        {"polynomial": TemperaturePolynomial, "b-spline": TemperatureSpline, "bins": TemperatureBins},
        default="polynomial",
    ),
]
RateBasis = Annotated[
    RatePolynomial | RateSpline | RateBins,
    chosen_by("basis", {"polynomial": RatePolynomial, "b-spline": RateSpline, "bins": RateBins}, default="polynomial"),
]
