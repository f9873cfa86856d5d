"""Bases over temperature and rate: powers of (x − centre)/scale, or B-splines where a table has `knots`."""

from collections.abc import Iterable, Sequence
from typing import Annotated

from pydantic import Field

from gradcal_jax import formulas
from gradcal_jax.formulas import Array
from gradcal_jax.tables import quantity as q
from gradcal_jax.tables.problems import Problem
from gradcal_jax.tables.section import Section, by_key

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
    """B-splines of `degree` on increasing knots, both ends included; of degree 0 one constant between each pair of
    neighbouring knots."""

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
        knots = tuple(float(k) for k in self.knots)
        return formulas.b_spline(x, knots, self.degree) if self.degree else formulas.bins(x, knots)


class TemperatureSpline(SplineKeys):
    """B-splines of `degree` on increasing knots, both ends included."""

    knots: Annotated[tuple[q.Temperature, ...], Field(min_length=2, max_length=_MOST_PIECES)]
    """Knots (temperatures at which pieces meet), increasing, with the first and last temperature of the spline."""


class RateSpline(SplineKeys):
    """B-splines of `degree` on increasing knots, both ends included."""

    knots: Annotated[tuple[q.Rate, ...], Field(min_length=2, max_length=_MOST_PIECES)]
    """Knots (rates at which pieces meet), increasing, with the first and last rate of the spline."""


TemperatureBasis = Annotated[
    TemperaturePolynomial | TemperatureSpline, by_key({"knots": TemperatureSpline}, default=TemperaturePolynomial)
]
RateBasis = Annotated[RatePolynomial | RateSpline, by_key({"knots": RateSpline}, default=RatePolynomial)]
