"""Quantities in models of files: SI numbers that keep their text.

A `Quantity` *is* its SI value (a float; °C for absolute temperatures) and keeps the text it was read from, so that
writing a file back changes nothing. `Quantity.of` gives a computed number a unit and a text.
"""

import math
from dataclasses import dataclass
from typing import Annotated, Any, TypeVar

from pydantic import AfterValidator, Discriminator, Field, GetCoreSchemaHandler, GetJsonSchemaHandler, Strict, Tag
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, core_schema

from gradcal_jax import units
from gradcal_jax.tables.display import printable

# SI sizes that no sensor, rig or plan has; inside them no product of a few quantities overflows.
_SMALLEST, _LARGEST = 1e-30, 1e15


class Quantity(float):
    """An SI value with its text and the name of its dimension (see `gradcal_jax.units.DIMENSIONS`)."""

    text: str
    dimension: str

    def __new__(cls, value: float, text: str, dimension: str) -> "Quantity":
        self = super().__new__(cls, value)
        self.text = text
        self.dimension = dimension
        return self

    @classmethod
    def read(cls, text: str, dimension: str) -> "Quantity":
        """``Quantity.read("30 arcsec", "angle")``. Raises `gradcal_jax.units.UnitError`."""
        return cls(units.parse(text, dimension), text, dimension)

    @classmethod
    def of(cls, value: float, unit: str) -> "Quantity":
        """An SI value with a text in `unit`, which reads back as exactly this value."""
        text = units.format_quantity(value, unit)
        return cls(value, text, units.dimension_of(unit))

    def __reduce__(self) -> tuple[Any, ...]:
        return (type(self), (float(self), self.text, self.dimension))

    def __repr__(self) -> str:
        return f"Quantity({float(self)!r}, {self.text!r})"

    def __str__(self) -> str:
        return self.text


@dataclass(frozen=True)
class Of:
    """Marks a field as a quantity of a dimension; `infinite` is the word for no limit."""

    dimension: str
    infinite: str | None = None

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_plain_validator_function(
            self.read,
            serialization=core_schema.plain_serializer_function_ser_schema(str, return_schema=core_schema.str_schema()),
        )

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        dimension = units.DIMENSIONS[self.dimension]
        words = f"{dimension.described}, such as '{dimension.example}'"
        word = "" if self.infinite is None else f", or '{self.infinite}'"
        return {"type": "string", "description": words + word, "examples": [dimension.example]}

    def read(self, value: object) -> Quantity:
        """The quantity in a file's value. Raises `ValueError` with the expected value."""
        if self.infinite is not None and value in (self.infinite, math.inf):
            return Quantity(math.inf, self.infinite, self.dimension)
        if isinstance(value, Quantity) and value.dimension == self.dimension:
            quantity = value
        elif isinstance(value, str):
            quantity = Quantity.read(value, self.dimension)
        else:
            dimension = units.DIMENSIONS[self.dimension]
            named = f' or "{self.infinite}"' if self.infinite else ""
            raise ValueError(
                f'expected {dimension.described} as text with a unit, such as "{dimension.example}"{named}'
            )
        if quantity != 0.0 and not _SMALLEST <= abs(quantity) <= _LARGEST:
            raise ValueError("is outside the range of this program")
        return quantity


def _positive(value: Quantity) -> Quantity:
    """The value, if it is above zero."""
    if not value > 0.0:
        raise ValueError(f"must be above 0 {units.DIMENSIONS[value.dimension].usual}")
    return value


def _not_negative(value: Quantity) -> Quantity:
    """The value, if it is not below zero."""
    if not value >= 0.0:
        raise ValueError(f"must be at least 0 {units.DIMENSIONS[value.dimension].usual}")
    return value


def _latitude(value: Quantity) -> Quantity:
    if math.isfinite(value) and abs(value) > 0.5 * math.pi:
        raise ValueError("must be from -90 deg to 90 deg")
    return value


_Of = TypeVar("_Of")
Positive = Annotated[_Of, AfterValidator(_positive)]
"""`Positive[Rate]`: above zero."""
Size = Annotated[_Of, AfterValidator(_not_negative)]
"""`Size[Rate]`: at least zero."""
OneOrEach = Annotated[
    Annotated[_Of, Tag("<one>")] | Annotated[tuple[_Of, ...], Field(min_length=1), Tag("<each>")],
    Discriminator(lambda value: "<each>" if isinstance(value, list | tuple) else "<one>"),
]
"""`OneOrEach[Rate]`: one quantity, or a list of them."""

Angle = Annotated[Quantity, Of("angle")]
Rate = Annotated[Quantity, Of("angular rate")]
Temperature = Annotated[Quantity, Of("temperature")]
TemperatureDifference = Annotated[Quantity, Of("temperature difference")]
TemperatureSlope = Annotated[Quantity, Of("temperature slope")]
Acceleration = Annotated[Quantity, Of("acceleration")]
ScaleFactor = Annotated[Quantity, Of("scale factor")]
ScaleFactorSlope = Annotated[Quantity, Of("scale factor slope")]
BiasSlope = Annotated[Quantity, Of("bias slope")]
AccelerationSlope = Annotated[Quantity, Of("acceleration slope")]
BiasByGradient = Annotated[Quantity, Of("bias temperature-gradient sensitivity")]
AccelerationByGradient = Annotated[Quantity, Of("acceleration temperature-gradient sensitivity")]
AnyTime = Annotated[Quantity, Of("time")]
SizeOfAngle = Size[Angle]
PositiveAngle = Positive[Angle]
Travel = Positive[Annotated[Quantity, Of("angle", infinite="unlimited")]]
Latitude = Annotated[Quantity, Of("angle", infinite="unknown"), AfterValidator(_latitude)]
PositiveRate = Positive[Rate]
PositiveAcceleration = Positive[Annotated[Quantity, Of("angular acceleration")]]
Time = Positive[AnyTime]
SizeOfTime = Size[AnyTime]
SizeOfTemperatureDifference = Size[TemperatureDifference]
PositiveTemperatureDifference = Positive[TemperatureDifference]
PositiveTemperatureSlope = Positive[TemperatureSlope]
AngleRandomWalk = Positive[Annotated[Quantity, Of("angle random walk")]]
RateRandomWalk = Size[Annotated[Quantity, Of("rate random walk")]]
VelocityRandomWalk = Positive[Annotated[Quantity, Of("velocity random walk")]]
PositiveScaleFactor = Positive[ScaleFactor]
SizeOfScaleFactor = Size[ScaleFactor]
PositiveAccelerationSensitivity = Positive[Annotated[Quantity, Of("acceleration-sensitive drift")]]
SecondOrder = Annotated[Quantity, Of("second-order coefficient")]
PositiveSpecificForce = Positive[Acceleration]
SizeOfSpecificForce = Size[Acceleration]
PositiveLength = Positive[Annotated[Quantity, Of("length")]]
Frequency = Positive[Annotated[Quantity, Of("frequency")]]

Whole = Annotated[int, Strict(), Field(ge=0, le=10**9)]
Count = Annotated[int, Strict(), Field(ge=1, le=10**6)]
Number = Annotated[float, Strict(), Field(allow_inf_nan=False)]
Flag = Annotated[bool, Strict()]


def _printable(text: str) -> str:
    """A text that can be shown: a control character in it could steer the terminal."""
    if printable(text) != text:
        raise ValueError("expected a text without control characters")
    return text


AnyText = Annotated[str, Strict(), Field(min_length=1, max_length=2000)]
"""A text that is sent to a device, which may have control characters."""
Text = Annotated[AnyText, AfterValidator(_printable)]
