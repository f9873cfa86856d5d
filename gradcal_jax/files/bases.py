"""The `temperature` and `rate` bases of `[sensor.bias]` and `[sensor.scale_factor]`."""

from collections.abc import Sequence
from typing import Annotated, Literal

from pydantic import BeforeValidator, Field, model_validator

from gradcal_jax.files.problems import Problem
from gradcal_jax.files.quantity import (
    PositiveRate,
    PositiveTemperatureDifference,
    Quantity,
    Rate,
    Temperature,
    Whole,
)
from gradcal_jax.files.section import Section, choose, refuse

Degree = Annotated[Whole, Field(le=15)]
SplineDegree = Annotated[int, Field(strict=True, ge=0, le=5)]
_MOST_PIECES = 200


def increasing(values: Sequence[float], key: str) -> list[Problem]:
    """A problem for the first entry that does not exceed the one before it."""
    for i in range(1, len(values)):
        if values[i] <= values[i - 1]:
            return [Problem((key, i), "must be above the entry before it", str(values[i]))]
    return []


class TemperaturePolynomial(Section):
    """Powers of (T − centre)/scale."""

    basis: Literal["polynomial"]
    """Kind of functions."""
    degree: Degree
    """Highest power."""
    centre: Temperature = Quantity(20.0, "20 degC", "temperature")
    """Temperature at which x is 0."""
    scale: PositiveTemperatureDifference
    """Temperature difference at which x is 1."""
    internal: Literal["legendre", "chebyshev"] = "legendre"
    """Orthogonal polynomials in which it is computed; results are in powers."""

    @property
    def size(self) -> int:
        """Number of basis functions."""
        return self.degree + 1

    @property
    def span(self) -> tuple[float, float] | None:
        """Where the basis is defined (°C); None: everywhere."""
        return None


class RatePolynomial(Section):
    """Powers of (ω − centre)/scale."""

    basis: Literal["polynomial"]
    """Kind of functions."""
    degree: Degree
    """Highest power."""
    centre: Rate = Quantity(0.0, "0 deg/s", "angular rate")
    """Rate at which x is 0."""
    scale: PositiveRate
    """Rate at which x is 1."""
    internal: Literal["legendre", "chebyshev"] = "legendre"
    """Orthogonal polynomials in which it is computed; results are in powers."""

    @property
    def size(self) -> int:
        """Number of basis functions."""
        return self.degree + 1

    @property
    def span(self) -> tuple[float, float] | None:
        """Where the basis is defined (rad/s); None: everywhere."""
        return None


class TemperatureSpline(Section):
    """B-splines of `degree` on increasing knots, both ends included."""

    basis: Literal["b-spline"]
    """Kind of functions."""
    degree: SplineDegree = 3
    """Degree of the pieces."""
    knots: Annotated[tuple[Temperature, ...], Field(min_length=2, max_length=_MOST_PIECES)]
    """Temperatures at which pieces meet, both ends included, rising."""

    @model_validator(mode="after")
    def _ordered(self) -> "TemperatureSpline":
        refuse(*increasing(self.knots, "knots"))
        return self

    @property
    def size(self) -> int:
        """Number of basis functions."""
        return len(self.knots) - 1 + self.degree

    @property
    def span(self) -> tuple[float, float] | None:
        """Where the basis is defined (°C)."""
        return (self.knots[0], self.knots[-1])


class RateSpline(Section):
    """B-splines of `degree` on increasing knots, both ends included."""

    basis: Literal["b-spline"]
    """Kind of functions."""
    degree: SplineDegree = 3
    """Degree of the pieces."""
    knots: Annotated[tuple[Rate, ...], Field(min_length=2, max_length=_MOST_PIECES)]
    """Rates at which pieces meet, both ends included, rising."""

    @model_validator(mode="after")
    def _ordered(self) -> "RateSpline":
        refuse(*increasing(self.knots, "knots"))
        return self

    @property
    def size(self) -> int:
        """Number of basis functions."""
        return len(self.knots) - 1 + self.degree

    @property
    def span(self) -> tuple[float, float] | None:
        """Where the basis is defined (rad/s)."""
        return (self.knots[0], self.knots[-1])


class TemperatureBins(Section):
    """One constant between each two neighbouring edges."""

    basis: Literal["bins"]
    """Kind of functions."""
    edges: Annotated[tuple[Temperature, ...], Field(min_length=2, max_length=_MOST_PIECES)]
    """Temperatures between which the value is constant, rising."""

    @model_validator(mode="after")
    def _ordered(self) -> "TemperatureBins":
        refuse(*increasing(self.edges, "edges"))
        return self

    @property
    def size(self) -> int:
        """Number of basis functions."""
        return len(self.edges) - 1

    @property
    def span(self) -> tuple[float, float] | None:
        """Where the basis is defined (°C)."""
        return (self.edges[0], self.edges[-1])


class RateBins(Section):
    """One constant between each two neighbouring edges."""

    basis: Literal["bins"]
    """Kind of functions."""
    edges: Annotated[tuple[Rate, ...], Field(min_length=2, max_length=_MOST_PIECES)]
    """Rates between which the value is constant, rising."""

    @model_validator(mode="after")
    def _ordered(self) -> "RateBins":
        refuse(*increasing(self.edges, "edges"))
        return self

    @property
    def size(self) -> int:
        """Number of basis functions."""
        return len(self.edges) - 1

    @property
    def span(self) -> tuple[float, float] | None:
        """Where the basis is defined (rad/s)."""
        return (self.edges[0], self.edges[-1])


def _temperature_basis(value: object) -> object:
    return choose(
        value, "basis", {"polynomial": TemperaturePolynomial, "b-spline": TemperatureSpline, "bins": TemperatureBins}
    )


def _rate_basis(value: object) -> object:
    return choose(value, "basis", {"polynomial": RatePolynomial, "b-spline": RateSpline, "bins": RateBins})


TemperatureBasis = Annotated[
    TemperaturePolynomial | TemperatureSpline | TemperatureBins, BeforeValidator(_temperature_basis)
]
RateBasis = Annotated[RatePolynomial | RateSpline | RateBins, BeforeValidator(_rate_basis)]
