"""The `temperature` and `rate` bases of `[sensor.bias]` and `[sensor.scale_factor]`."""

from collections.abc import Iterable, Sequence
from typing import Annotated, Literal

from pydantic import Field

from gradcal_jax.files.problems import Problem
from gradcal_jax.files.quantity import (
    PositiveRate,
    PositiveTemperatureDifference,
    Quantity,
    Rate,
    Temperature,
    Whole,
)
from gradcal_jax.files.section import Section, chosen_by

Degree = Annotated[Whole, Field(le=15)]
SplineDegree = Annotated[int, Field(strict=True, ge=0, le=5)]
_MOST_PIECES = 200


def increasing(values: Sequence[float], key: str) -> list[Problem]:
    """A problem for the first entry not above the one before it."""
    for i in range(1, len(values)):
        if values[i] <= values[i - 1]:
            return [Problem((key, i), "must be above the entry before it", str(values[i]))]
    return []


class _Polynomial(Section):
    basis: Literal["polynomial"]
    """Kind of functions."""
    degree: Degree
    """Highest power."""
    centre: Quantity
    scale: Quantity
    internal: Literal["legendre", "chebyshev"] = "legendre"
    """Orthogonal polynomials in which it is computed; results are in powers."""

    @property
    def size(self) -> int:
        """Number of basis functions."""
        return self.degree + 1

    @property
    def span(self) -> tuple[float, float] | None:
        """Where the basis is defined (°C or rad/s); None: everywhere."""
        return None


class TemperaturePolynomial(_Polynomial):
    """Powers of (T − centre)/scale."""

    centre: Temperature = Quantity(20.0, "20 degC", "temperature")
    """Temperature at which x is 0."""
    scale: PositiveTemperatureDifference
    """Temperature difference at which x is 1."""


class RatePolynomial(_Polynomial):
    """Powers of (ω − centre)/scale."""

    centre: Rate = Quantity(0.0, "0 deg/s", "angular rate")
    """Rate at which x is 0."""
    scale: PositiveRate
    """Rate at which x is 1."""


class _Spline(Section):
    basis: Literal["b-spline"]
    """Kind of functions."""
    degree: SplineDegree = 3
    """Degree of the pieces."""
    knots: tuple[Quantity, ...]

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


class TemperatureSpline(_Spline):
    """B-splines of `degree` on increasing knots, both ends included."""

    knots: Annotated[tuple[Temperature, ...], Field(min_length=2, max_length=_MOST_PIECES)]
    """Temperatures at which pieces meet, both ends included, rising."""


class RateSpline(_Spline):
    """B-splines of `degree` on increasing knots, both ends included."""

    knots: Annotated[tuple[Rate, ...], Field(min_length=2, max_length=_MOST_PIECES)]
    """Rates at which pieces meet, both ends included, rising."""


class _Bins(Section):
    basis: Literal["bins"]
    """Kind of functions."""
    edges: tuple[Quantity, ...]

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


class TemperatureBins(_Bins):
    """One constant between each two neighbouring edges."""

    edges: Annotated[tuple[Temperature, ...], Field(min_length=2, max_length=_MOST_PIECES)]
    """Temperatures between which the value is constant, rising."""


class RateBins(_Bins):
    """One constant between each two neighbouring edges."""

    edges: Annotated[tuple[Rate, ...], Field(min_length=2, max_length=_MOST_PIECES)]
    """Rates between which the value is constant, rising."""


TemperatureBasis = Annotated[
    TemperaturePolynomial | TemperatureSpline | TemperatureBins,
    chosen_by("basis", {"polynomial": TemperaturePolynomial, "b-spline": TemperatureSpline, "bins": TemperatureBins}),
]
RateBasis = Annotated[
    RatePolynomial | RateSpline | RateBins,
    chosen_by("basis", {"polynomial": RatePolynomial, "b-spline": RateSpline, "bins": RateBins}),
]
