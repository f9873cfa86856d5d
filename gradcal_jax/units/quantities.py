"""A number with a unit, to SI and back."""

import difflib
import math
import re
from decimal import Context, Decimal, localcontext
from functools import lru_cache
from typing import Final

from gradcal_jax.units.dimensions import DIMENSIONS, Dimension
from gradcal_jax.units.expressions import Refusal, Unit, read_unit
from gradcal_jax.units.symbols import PRECISE, SYMBOLS

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
_NUMBER: Final = re.compile(r"[+-]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?([0-9]+))?")
_LONGEST: Final = 120
# Longer exponents are refused before they cost time.
_EXPONENT_DIGITS: Final = 3
_TEMPERATURE: Final = "temperature"


class UnitError(ValueError):
    """A text that is not a quantity of the expected dimension; the message says what was expected."""


def _dimension_of_unit(unit: Unit) -> Dimension | None:
    """What a unit measures, if anything."""
    if unit.has_offset:
        return DIMENSIONS[_TEMPERATURE]
    known = (dimension for dimension in DIMENSIONS.values() if dimension.name != _TEMPERATURE)
    return next((dimension for dimension in known if dimension.powers == unit.powers), None)


def _check(unit: Unit, dimension: Dimension) -> None:
    """Refuse a unit that does not measure the dimension."""
    measured = _dimension_of_unit(unit)
    if measured == dimension:
        return
    if measured is not None and measured.powers == dimension.powers:
        if dimension.name == _TEMPERATURE:
            raise Refusal("write an absolute temperature in degC; K is only for temperature differences")
        raise Refusal("write a temperature difference in K; degC is only for absolute temperatures")
    raise Refusal(f"that is {measured.described}" if measured else f"that is not {dimension.described}")


def _finite(value: Decimal) -> float:
    result = float(value)
    if math.isinf(result) or (result == 0.0 and value != 0):
        raise Refusal("the number is out of range")
    return result + 0.0  # no negative zero


_STEPS: Final = {
    "time": (("h", "hr"), ("min",), ("s", "sec")),
    "angle": (("°", "deg"), ("′", "'", "arcmin"), ("″", '"', "arcsec")),
}
_PART: Final = re.compile(r" *([0-9]+(?:\.[0-9]+)?) *([A-Za-z]+|[°′'″\"])")
_PARTS: Final = re.compile(f"[+-]?((?:{_PART.pattern}){{2,}})")


def _compound(text: str, dimension: Dimension) -> Decimal | None:
    """'2 h 40 min', '1° 30′ 15″': falling units, whole numbers but for the last, each below 60; None if it is none."""
    steps, match = _STEPS.get(dimension.name, ()), _PARTS.fullmatch(text)
    levels = {name: level for level, names in enumerate(steps) for name in names}
    parts: list[tuple[str, str]] = _PART.findall(match.group(1)) if match else []
    if not parts or any(name not in levels for _, name in parts):
        return None
    total, previous = Decimal(0), -1
    for number, name in parts:
        if levels[name] <= previous:
            raise Refusal("the units of the parts must become smaller, as in '2 h 40 min' or '1° 30′ 15″'")
        if previous >= 0 and Decimal(number) >= 60:
            raise Refusal(f"'{number} {name}' must be below 60 after a larger unit")
        total += Decimal(number) * SYMBOLS[name][0]
        previous = levels[name]
    if any("." in number for number, _ in parts[:-1]):
        raise Refusal("only the last part may have decimals")
    return -total if text[0] == "-" else total


_MISTAKES: Final = (
    (r"[+-]?[0-9]+,[0-9]", "write decimals with a point, not a comma"),
    (r"[+-]?[0-9]+_[0-9]|[+-]?[0-9]+ [0-9]{3}\b", "write digits without separators"),
    (r"[+-]? *(?:[nN][aA][nN]|[iI][nN][fF])", "the number must be finite"),
    ("±", "write only the size, without '±'"),
)


def _hint(text: str) -> str:
    """Why the number could not be read, for the usual mistakes."""
    hints = (hint for mistake, hint in _MISTAKES if re.match(mistake, text))
    return next(hints, "the text must begin with a number")


@lru_cache(maxsize=4096)
def _read(text: str, dimension: Dimension) -> float:
    plain = text.strip(" ").translate(_SAME)
    if len(plain) > _LONGEST:
        raise Refusal("the text is too long")
    match = _NUMBER.match(plain)
    if match is None or plain[match.end() : match.end() + 1] in (",", "_"):
        raise Refusal(_hint(plain))
    rest = plain[match.end() :].lstrip(" ")
    if not rest:
        raise Refusal("the unit is missing")
    with localcontext(PRECISE):
        if (total := _compound(plain, dimension)) is not None:
            return _finite(total)
        if rest[0].isdigit() and rest != "1" and not rest.startswith("1/"):
            raise Refusal(_hint(plain) if re.match(r"[0-9]{3}\b", rest) else f"'{rest}' is not a unit")
        if len((match.group(1) or "").lstrip("0")) > _EXPONENT_DIGITS:
            raise Refusal("the number is out of range")
        unit = read_unit(rest)
        _check(unit, dimension)
        value = (Decimal(match.group()) - unit.zero) * unit.factor
        if dimension.name == _TEMPERATURE and value < Decimal("-273.15"):
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
        expected = f"expected {known.described} such as '{known.example}'"
        raise UnitError(f"'{shown}' is not understood: {refusal}; {expected}") from None


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


_SI: Final = Unit(Decimal(1), DIMENSIONS["angle"].powers)


def _in_unit(value: float, target: Unit, source: Unit = _SI) -> Decimal:
    """A number of one unit (absent: SI) as one of another."""
    if not math.isfinite(value):
        raise UnitError(f"{value} is not a quantity: the number must be finite")
    with localcontext(PRECISE):
        return (Decimal(value) - source.zero) * source.factor / target.factor + target.zero


def to_unit(value: float, unit: str) -> float:
    """An SI value as a number of `unit`: ``to_unit(math.pi, "deg") == 180.0``."""
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
    source, target = _lookup(from_unit), _lookup(to)
    have, wanted = _dimension(source, from_unit), _dimension(target, to)
    if have != wanted:
        raise UnitError(f"'{from_unit}' is {have.described}, '{to}' is {wanted.described}")
    return _representable(_in_unit(value, target, source), value, to)


def parse_in(text: str, unit: str) -> float:
    """A text such as "5 ppm/(K/min)" as a number of `unit`, of any dimension. Errors: `UnitError` for another one."""
    plain = text.strip(" ").translate(_SAME)
    number = _NUMBER.match(plain)
    if number is None:
        raise UnitError(f"'{text}' is not understood: {_hint(plain)}; expected a number with a unit such as {unit}")
    source, target = _lookup(plain[number.end() :]), _lookup(unit)
    if source.powers != target.powers:
        raise UnitError(f"'{text}' has another unit than expected; its SI unit must be {unit}")
    with localcontext(PRECISE):
        return _representable(Decimal(number.group()) * source.factor / target.factor, 0.0, unit)


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
    source = _lookup(unit)
    dimension, number = _dimension(source, unit).name, _in_unit(value, source)
    if source.zero:
        # Near 0 degF the offset leaves only rounding errors: the short decimal is used where it parses alike.
        number = min((round(number, 9), number), key=lambda n: parse(f"{n:f} {unit}", dimension) != value)
    for digits in range(1, 26):
        text = f"{_rounded(number, digits)} {unit}"
        if parse(text, dimension) == value:
            return text
    # 25 digits suffice for every unit without an offset; with one, a tiny number would need hundreds.
    return format_quantity(value, "degC")
