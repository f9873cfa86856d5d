"""Quantities in models of files: SI numbers that keep their text.

A `Quantity` *is* its SI value (a float; °C for absolute temperatures) and keeps the text it was read from, so that
writing a file back changes nothing. `Quantity.of` gives a computed number a unit and a text.
"""

import math
import operator
from dataclasses import dataclass
from typing import Annotated, Any, cast

from pydantic import AfterValidator, Field, GetCoreSchemaHandler, GetJsonSchemaHandler, Strict
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, core_schema

from gradcal_jax import units
from gradcal_jax.tables.display import printable
from gradcal_jax.tables.problems import Problem, SpecError, one_of

# SI sizes that no sensor, rig or plan has; inside them no product of a few quantities overflows.
_SMALLEST, _LARGEST = 1e-30, 1e15
_BOUNDS = {"above": operator.gt, "at_least": operator.ge, "below": operator.lt, "at_most": operator.le}


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
    """Marks a field as a quantity of a dimension, with bounds (as texts); `infinite` is the word for no limit, `zero`
    that for none. `example`: a usual value of the field, if that of the dimension is none."""

    dimension: str
    above: str | None = None
    at_least: str | None = None
    below: str | None = None
    at_most: str | None = None
    infinite: str | None = None
    zero: str | None = None
    example: str | None = None

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_plain_validator_function(
            self.read,
            serialization=core_schema.plain_serializer_function_ser_schema(str, return_schema=core_schema.str_schema()),
        )

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        dimension = units.DIMENSIONS[self.dimension]
        example = self.example or dimension.example
        words = f"{dimension.described}, such as '{example}'"
        return {
            "type": "string",
            "description": words + "".join(f", or '{word}'" for word in self._words),
            "examples": [example],
        }

    @property
    def _words(self) -> list[str]:
        return [word for word in (self.infinite, self.zero) if word is not None]

    def read(self, value: object) -> Quantity:
        """The quantity in a file's value. Raises `ValueError` with the expected value."""
        if self.infinite is not None and value in (self.infinite, math.inf):
            return Quantity(math.inf, self.infinite, self.dimension)
        if self.zero is not None and value in (self.zero, 0.0):
            return Quantity(0.0, self.zero, self.dimension)
        if isinstance(value, Quantity) and value.dimension == self.dimension:
            quantity = value
        elif isinstance(value, str):
            quantity = Quantity.read(value, self.dimension)
        else:
            dimension = units.DIMENSIONS[self.dimension]
            example = self.example or dimension.example
            named = f" or {one_of(self._words)}" if self._words else ""
            raise ValueError(f'expected {dimension.described} as text with a unit, such as "{example}"{named}')
        if quantity != 0.0 and not _SMALLEST <= abs(quantity) <= _LARGEST:
            raise ValueError("is outside the range of this program")
        for name, holds in _BOUNDS.items():
            bound: str | None = getattr(self, name)
            if bound is not None and not holds(float(quantity), units.parse(bound, self.dimension)):
                raise ValueError(f"must be {name.replace('_', ' ')} {bound}")
        return quantity


@dataclass(frozen=True)
class OneOrList:
    """Marks a field as one quantity or a list of them; `meaning` of the list: "one for each cycle"."""

    one: Of
    each: Of
    meaning: str

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        def text(value: Quantity | tuple[Quantity, ...]) -> str | list[str]:
            return [str(one) for one in value] if isinstance(value, tuple) else str(value)

        writing = core_schema.plain_serializer_function_ser_schema(text)
        return core_schema.no_info_plain_validator_function(self.read, serialization=writing)

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        one = self.one.__get_pydantic_json_schema__(schema, handler)
        return {"anyOf": [one, {"type": "array", "items": one, "minItems": 1}]}

    def read(self, value: object) -> Quantity | tuple[Quantity, ...]:
        """The quantities in a file's value. Raises `ValueError` that lists every wrong entry."""
        if not isinstance(value, list | tuple):
            return self.one.read(value)
        quantities: list[Quantity] = []
        problems: list[Problem] = []
        for i, entry in enumerate(cast("list[object]", value)):
            try:
                quantities.append(self.each.read(entry))
            except ValueError as error:
                problems.append(Problem((i,), str(error), entry))
        if problems:
            raise SpecError(problems)
        if not quantities:
            described = units.DIMENSIONS[self.one.dimension].described
            raise ValueError(f"expected {described}, or a list of them, {self.meaning}")
        return tuple(quantities)


Angle = Annotated[Quantity, Of("angle")]
SizeOfAngle = Annotated[Quantity, Of("angle", at_least="0 deg")]
Travel = Annotated[Quantity, Of("angle", above="0 deg", infinite="unlimited")]
Rate = Annotated[Quantity, Of("angular rate")]
PositiveRate = Annotated[Quantity, Of("angular rate", above="0 deg/s")]
SizeOfRate = Annotated[Quantity, Of("angular rate", at_least="0 deg/s")]
PositiveAcceleration = Annotated[Quantity, Of("angular acceleration", above="0 deg/s^2")]
Time = Annotated[Quantity, Of("time", above="0 s")]
SizeOfTime = Annotated[Quantity, Of("time", at_least="0 s")]
Temperature = Annotated[Quantity, Of("temperature")]
SizeOfTemperatureDifference = Annotated[Quantity, Of("temperature difference", at_least="0 K")]
PositiveTemperatureDifference = Annotated[Quantity, Of("temperature difference", above="0 K")]
PositiveTemperatureSlope = Annotated[Quantity, Of("temperature slope", above="0 K/min")]
TemperatureSlope = Annotated[Quantity, Of("temperature slope")]
AngleRandomWalk = Annotated[Quantity, Of("angle random walk", above="0 deg/sqrt(h)")]
RateRandomWalk = Annotated[Quantity, Of("rate random walk", at_least="0 deg/h/sqrt(h)")]
PositiveScaleFactor = Annotated[Quantity, Of("scale factor", above="0 ppm")]
SizeOfScaleFactor = Annotated[Quantity, Of("scale factor", at_least="0 ppm")]
Probability = Annotated[Quantity, Of("scale factor", above="0 %", below="100 %", example="90 %")]
ScaleFactorSlope = Annotated[Quantity, Of("scale factor slope")]
PositiveScaleFactorSlope = Annotated[Quantity, Of("scale factor slope", above="0 ppm/K")]
PositiveScaleFactorGradient = Annotated[
    Quantity, Of("scale factor temperature-gradient sensitivity", above="0 ppm/(K/min)")
]
BiasSlope = Annotated[Quantity, Of("bias slope")]
PositiveAccelerationSensitivity = Annotated[Quantity, Of("acceleration-sensitive drift", above="0 deg/h/g")]
PositiveSecondOrder = Annotated[Quantity, Of("second-order coefficient", above="0 ug/g^2")]
PositiveSpecificForce = Annotated[Quantity, Of("acceleration", above="0 mg")]
SizeOfSpecificForce = Annotated[Quantity, Of("acceleration", at_least="0 mg")]
VelocityRandomWalk = Annotated[Quantity, Of("velocity random walk", above="0 m/s/sqrt(h)")]
PositiveAngle = Annotated[Quantity, Of("angle", above="0 deg")]
PositiveLength = Annotated[Quantity, Of("length", above="0 m")]
Latitude = Annotated[Quantity, Of("angle", at_least="-90 deg", at_most="90 deg", infinite="unknown")]
Frequency = Annotated[Quantity, Of("frequency", above="0 Hz")]
PositiveBiasSlope = Annotated[Quantity, Of("bias slope", above="0 deg/h/K")]
PositiveAccelerationSlope = Annotated[Quantity, Of("acceleration slope", above="0 ug/K")]
ForceGradientSensitivity = Annotated[
    Quantity, Of("acceleration temperature-gradient sensitivity", at_least="0 ug/(K/min)")
]
SizeOfGradientSensitivity = Annotated[Quantity, Of("bias temperature-gradient sensitivity", at_least="0 deg/h/(K/min)")]

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
