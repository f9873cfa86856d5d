"""A number with a unit, to SI and back."""

import contextlib
import difflib
import math
import re
from decimal import Context, Decimal, localcontext
from functools import lru_cache
from typing import Final

from gradcal_jax.units.dimensions import DIMENSIONS, Dimension
from gradcal_jax.units.expressions import Refusal, Unit, read_unit
from gradcal_jax.units.symbols import CELSIUS, FAHRENHEIT, PRECISE, SYMBOLS

# Other code points of the same characters only: micro, minus, middle dots, hard spaces, one-character °C and °F.
_SAME: Final = str.maketrans(
    {
        "\N{MICRO SIGN}": "u",
        "\N{GREEK SMALL LETTER MU}": "u",
        "\N{MINUS SIGN}": "-",
        "\N{MIDDLE DOT}": "*",
        "\N{DOT OPERATOR}": "*",
        "\N{NO-BREAK SPACE}": " ",
        "\N{NARROW NO-BREAK SPACE}": " ",
        "\N{THIN SPACE}": " ",
        "\N{DEGREE CELSIUS}": "°C",
        "\N{DEGREE FAHRENHEIT}": "°F",
    }
)
_NUMBER: Final = re.compile(r"[+-]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
_LONGEST: Final = 120
# "300 deg/s2", "20 C", "5 degrees C"; and of differences "5 C".
_SLIP_OF_POWER: Final = re.compile(r"([A-Za-z])\^?([23])\b")
_SLIP_OF_CELSIUS: Final = re.compile(r"(?:\bdeg(?:rees?)? ?)?\b(?:[Cc]|[Cc]elsius|[Cc]entigrade)\b")
_SLIP_OF_KELVIN: Final = re.compile(r"(?:\bdeg ?)?\b(?:[CckK]|[Kk]elvin)\b")


class UnitError(ValueError):
    """A text that is not a quantity of the expected dimension; the message says what was expected."""


def _dimension_of_unit(unit: Unit) -> Dimension | None:
    """What a unit measures, if anything."""
    if unit.bare in CELSIUS or unit.bare in FAHRENHEIT:
        return DIMENSIONS["temperature"]
    known = (dimension for dimension in DIMENSIONS.values() if dimension.name != "temperature")
    return next((dimension for dimension in known if dimension.powers == unit.powers), None)


def _check(unit: Unit, dimension: Dimension) -> None:
    """Refuse a unit that does not measure the dimension."""
    offset = unit.bare in CELSIUS or unit.bare in FAHRENHEIT
    if dimension.name == "temperature":
        if offset:
            return
        if unit.powers == dimension.powers:
            raise Refusal("write an absolute temperature in degC; K is only for temperature differences")
    elif offset and dimension.name == "temperature difference":
        raise Refusal("write a temperature difference in K; degC is only for absolute temperatures")
    elif unit.powers == dimension.powers:
        return
    other = _dimension_of_unit(unit)
    raise Refusal(f"that is {other.described}" if other else f"that is not {dimension.described}")


# Decimal exponents beyond any float are refused before they cost time.
_EXPONENT_DIGITS: Final = 4


def _number(text: str) -> Decimal:
    exponent = re.split("[eE]", text)[1:]
    if exponent and len(exponent[0].lstrip("+-0")) > _EXPONENT_DIGITS - 1:
        raise Refusal("the number is out of range")
    return Decimal(text)


def _finite(value: Decimal) -> float:
    result = float(value)
    if math.isinf(result) or (result == 0.0 and value != 0):
        raise Refusal("the number is out of range")
    return result + 0.0  # no negative zero


_DURATION: Final = (("h", "hr"), ("min",), ("s", "sec"))
_ARC: Final = (("°", "deg"), ("′", "'", "arcmin"), ("″", '"', "arcsec"))
_PART: Final = re.compile(r" *([0-9]+(?:\.[0-9]+)?) *([A-Za-z]+|[°′'″\"])")
_PARTS: Final = re.compile(f"(?:{_PART.pattern})+")


def _compound(text: str, dimension: Dimension) -> Decimal | None:
    """'2 h 40 min', '1° 30′ 15″': falling units, whole numbers but for the last, each below 60; None if it is none."""
    steps = {"time": _DURATION, "angle": _ARC}.get(dimension.name)
    if steps is None:
        return None
    negative = text[:1] == "-"
    body = text[1:] if text[:1] in ("-", "+") else text
    parts: list[tuple[str, str]] = _PART.findall(body) if _PARTS.fullmatch(body) else []
    if len(parts) < 2:
        return None
    total = Decimal(0)
    previous = -1
    for index, (number, name) in enumerate(parts):
        level = next((i for i, names in enumerate(steps) if name in names), None)
        if level is None:
            return None
        if level <= previous:
            raise Refusal("the units of the parts must become smaller, as in '2 h 40 min' or '1° 30′ 15″'")
        if "." in number and index < len(parts) - 1:
            raise Refusal("only the last part may have decimals")
        if index > 0 and Decimal(number) >= 60:
            raise Refusal(f"'{number} {name}' must be below 60 after a larger unit")
        total += Decimal(number) * SYMBOLS[name][0]
        previous = level
    return -total if negative else total


def _hint(text: str) -> str:
    """Why the number could not be read, for the usual mistakes."""
    if re.match(r"[+-]?[0-9]+,[0-9]", text):
        return "write decimals with a point, not a comma"
    if re.match(r"[+-]?[0-9]+_[0-9]", text) or re.match(r"[+-]?[0-9]+ [0-9]{3}\b", text):
        return "write digits without separators"
    if re.match(r"[+-]? *(nan|inf)", text, re.IGNORECASE):
        return "the number must be finite"
    if text.startswith("±"):
        return "write only the size, without '±'"
    return "the text must begin with a number"


@lru_cache(maxsize=4096)
def _read(text: str, dimension: Dimension) -> float:
    plain = text.strip(" ").translate(_SAME)
    if len(plain) > _LONGEST:
        raise Refusal("the text is too long")
    match = _NUMBER.match(plain)
    if match is None or re.match(r"[,_]", plain[match.end() :]):
        raise Refusal(_hint(plain))
    rest = plain[match.end() :].lstrip(" ")
    if not rest:
        raise Refusal("the unit is missing")
    with localcontext(PRECISE):
        total = _compound(plain, dimension)
        if total is not None:
            return _finite(total)
        if rest[0].isdigit() and rest != "1" and not rest.startswith("1/"):
            raise Refusal(_hint(plain) if re.match(r"[0-9]{3}\b", rest) else f"'{rest}' is not a unit")
        number = _number(match.group())
        unit = read_unit(rest)
        _check(unit, dimension)
        if unit.bare in FAHRENHEIT:
            number -= 32
        value = number * unit.factor
        if dimension.name == "temperature" and value < Decimal("-273.15"):
            raise Refusal("the temperature is below absolute zero")
        return _finite(value)


def parse(text: str, dimension: str) -> float:
    """The SI value of a text such as ``"0.1 deg/sqrt(h)"``.

    `dimension` is a name from `DIMENSIONS`. Absolute temperatures are returned in °C. Raises `UnitError`, whose message
    names the text, the reason, and an example of what was expected.

    >>> round(parse("20 degC", "temperature"), 9), parse("2 min", "time")
    (20.0, 120.0)
    """
    if dimension not in DIMENSIONS:
        close = difflib.get_close_matches(dimension, DIMENSIONS, n=1, cutoff=0.0)
        raise UnitError(f"'{dimension}' is not a dimension; nearest: '{close[0]}'")
    known = DIMENSIONS[dimension]
    try:
        return _read(text, known)
    except Refusal as refusal:
        shown = text if len(text) <= _LONGEST else text[: _LONGEST - 1] + "…"
        meant = _corrected(text, known)
        hint = f"; nearest: '{meant}'" if meant else ""
        expected = f"expected {known.described} such as '{known.example}'"
        raise UnitError(f"'{shown}' is not understood: {refusal}; {expected}{hint}") from None


def _corrected(text: str, dimension: Dimension) -> str | None:
    """The text with the usual mistakes corrected, where that is a quantity of the dimension."""
    if len(text) > _LONGEST:
        return None
    for mended in (
        _SLIP_OF_POWER.sub(r"\1^\2", text),
        _SLIP_OF_CELSIUS.sub("degC", text),
        _SLIP_OF_KELVIN.sub("K", text),
    ):
        if mended != text:
            with contextlib.suppress(Refusal):
                _read(mended, dimension)
                return mended
    return None


def _lookup(unit: str) -> Unit:
    if len(unit) > _LONGEST:
        raise UnitError(f"'{unit[:_LONGEST]}…' is not a unit")
    try:
        return read_unit(unit.strip(" ").translate(_SAME))
    except Refusal as refusal:
        raise UnitError(f"unit '{unit}' is not understood: {refusal}") from None


def dimension_of(unit: str) -> str:
    """The name of the dimension that a unit measures: ``dimension_of("deg/sqrt(h)") == "angle random walk"``."""
    return _dimension(_lookup(unit), unit).name


def _dimension(unit: Unit, text: str) -> Dimension:
    dimension = _dimension_of_unit(unit)
    if dimension is None:
        raise UnitError(f"'{text}' is not the unit of any quantity that this program knows")
    return dimension


def unit_of(text: str) -> str:
    """The unit of a quantity's text: ``unit_of("0.05 deg") == "deg"``; that of the first part of '2 h 40 min'."""
    plain = text.strip(" ").translate(_SAME)
    number = _NUMBER.match(plain)
    unit = plain[number.end() :].lstrip(" ") if number else ""
    compound = re.match(r"([A-Za-z]+|[°′'″\"]) *[0-9]", unit)
    unit = compound.group(1) if compound else unit
    dimension_of(unit)
    return unit


def _in_unit(value: float, unit: Unit) -> Decimal:
    with localcontext(PRECISE):
        quotient = Decimal(value) / unit.factor
        return quotient + 32 if unit.bare in FAHRENHEIT else quotient


def to_unit(value: float, unit: str) -> float:
    """An SI value as a number of `unit`: ``to_unit(math.pi, "deg") == 180.0``."""
    if not math.isfinite(value):
        raise UnitError(f"{value} cannot be given in '{unit}': the number must be finite")
    return _representable(_in_unit(value, _lookup(unit)), value, unit)


def _representable(number: Decimal, value: float, unit: str) -> float:
    try:
        return _finite(number)
    except Refusal:
        raise UnitError(f"{value} is out of range in '{unit}'") from None


def convert(value: float, from_unit: str, to: str) -> float:
    """`value` of `from_unit` as a number of `to`; both must measure the same dimension.

    >>> convert(1.0, "deg/s", "deg/h")
    3600.0
    """
    if not math.isfinite(value):
        raise UnitError(f"{value} cannot be converted: the number must be finite")
    source, target = _lookup(from_unit), _lookup(to)
    have, wanted = _dimension(source, from_unit), _dimension(target, to)
    if have != wanted:
        raise UnitError(f"'{from_unit}' is {have.described}, '{to}' is {wanted.described}")
    with localcontext(PRECISE):
        number = Decimal(value) - 32 if source.bare in FAHRENHEIT else Decimal(value)
        quotient = number * source.factor / target.factor
        return _representable(quotient + 32 if target.bare in FAHRENHEIT else quotient, value, to)


def _rounded(number: Decimal, digits: int) -> str:
    context = Context(prec=digits)
    rounded = context.create_decimal(number).normalize(context)
    if rounded == 0:
        return "0"
    exponent = rounded.adjusted()
    if -5 < exponent < 9:
        return format(rounded, "f")
    return f"{rounded.scaleb(-exponent, context):f}e{exponent}"


def format_quantity(value: float, unit: str) -> str:
    """The shortest text in `unit` that `parse` reads back as exactly `value` (SI; °C for absolute temperatures).

    A Fahrenheit that cannot be exact (within some 1e-20 of 0 °C) is written in degC.
    """
    if not math.isfinite(value):
        raise UnitError(f"{value} is not a quantity: the number must be finite")
    source = _lookup(unit)
    dimension = dimension_of(unit)
    number = _in_unit(value, source)
    if source.bare in FAHRENHEIT:
        # Near 0 degF the offset leaves only rounding errors: the short decimal is used where it parses alike.
        number = min((round(number, 9), number), key=lambda n: parse(f"{n:f} {unit}", dimension) != value)
    for digits in range(1, 26):
        text = f"{_rounded(number, digits)} {unit}"
        if parse(text, dimension) == value:
            return text
    # 25 digits suffice for every unit without an offset; with one, a tiny number would need hundreds.
    return format_quantity(value, "degC")
