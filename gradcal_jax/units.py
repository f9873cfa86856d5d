"""Text with units <-> SI numbers, at the edge of the house only.

A strict grammar of our own: what is not understood *exactly* is refused, with the nearest right spelling. (General unit
libraries read ``0.1 °/√h`` as degrees per hour, ``10 mg`` as milligrams and ``30″`` as a pure number.)

    quantity := number unit | duration | sexagesimal angle        "0.1 deg/sqrt(h)"   "2 h 40 min"   "1° 30′ 15″"
    unit     := factor ("·" factor)* ("/" factor)*                a product after a division needs parentheses
    factor   := (name | "(" unit ")") power? | "√" name | "√(" unit ")" | "sqrt(" unit ")" | "rt-" name
    power    := "^" k | "**" k | superscript                      k a multiple of one half between -3 and 3

Every quantity has a *dimension*, one of the names in `DIMENSIONS`; angle is a dimension of its own, so that ``Hz`` is
no angular rate. SI means rad, s, m, K and °C for absolute temperatures; scale factors are plain ratios.

Decisions where practice is divided:

* Absolute temperatures are written in degC or degF. ``K`` is refused there, since a number in K next to a ``scale`` in
  K is nearly always a slip; differences are written in K, and ``degC`` is refused there for the same reason. Inside a
  compound (``ppm/°C``, ``degC/min``) K and °C mean the same.
* ``deg/h/sqrt(Hz)`` is 1/60 of ``deg/sqrt(h)``, as in IEEE 952 and all data sheets.
* ``g`` is standard gravity, ``mg`` and ``µg`` its parts; ``m`` is the metre, never the minute.
* A scale factor needs its unit too: ``ppm``, ``ppb``, ``%``, ``‰``, or ``1`` for a plain ratio (``0.01 1``).
* Zero needs a unit like any other number; nan and infinity are no quantities.

Numbers are multiplied out in decimal arithmetic and rounded once, so `parse` gives the float nearest to what was
written, and `format_quantity` the shortest text that `parse` reads back as the very same float.
"""

import difflib
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from decimal import Context, Decimal, localcontext
from functools import lru_cache
from types import MappingProxyType
from typing import Final, NamedTuple

__all__ = [
    "ARCSEC",
    "DEG_PER_H",
    "DEG_PER_S",
    "DEG_PER_SQRT_H",
    "DIMENSIONS",
    "PPM",
    "Dimension",
    "UnitError",
    "convert",
    "dimension_of",
    "format_quantity",
    "parse",
    "to_unit",
    "unit_of",
]

# What SI numbers (ratios, rad/s, rad/√s, rad) are multiplied by for people to read.
PPM: Final = 1e6
DEG_PER_S: Final = 180.0 / math.pi
DEG_PER_H: Final = 3600.0 * 180.0 / math.pi
DEG_PER_SQRT_H: Final = 60.0 * 180.0 / math.pi
ARCSEC: Final = 3600.0 * 180.0 / math.pi


class UnitError(ValueError):
    """A text that is not a quantity of the expected dimension; the message says what was expected."""


class _Powers(NamedTuple):
    """Exponents of rad, s, K and m, each *doubled* so that square roots stay whole numbers."""

    angle: int = 0
    time: int = 0
    temperature: int = 0
    length: int = 0


@dataclass(frozen=True)
class Dimension:
    """A kind of quantity: its name with an article, the SI unit it is returned in, the unit people like, an example."""

    name: str
    described: str
    si: str
    usual: str
    example: str
    powers: _Powers


def _table(*dimensions: Dimension) -> Mapping[str, Dimension]:
    return MappingProxyType({dimension.name: dimension for dimension in dimensions})


# Temperatures proper and temperature differences share their exponents; `parse` tells them apart by name.
DIMENSIONS: Final = _table(
    Dimension("angle", "an angle", "rad", "deg", "30 arcsec", _Powers(2)),
    Dimension("angular rate", "an angular rate", "rad/s", "deg/s", "10 deg/s", _Powers(2, -2)),
    Dimension("angular acceleration", "an angular acceleration", "rad/s^2", "deg/s^2", "300 deg/s^2", _Powers(2, -4)),
    Dimension("time", "a time", "s", "s", "10 s", _Powers(0, 2)),
    Dimension("temperature", "a temperature", "degC", "degC", "20 degC", _Powers(0, 0, 2)),
    Dimension("temperature difference", "a temperature difference", "K", "K", "50 K", _Powers(0, 0, 2)),
    Dimension("temperature slope", "a temperature slope", "K/s", "K/min", "1 K/min", _Powers(0, -2, 2)),
    Dimension(
        "angle random walk", "an angle random walk", "rad/sqrt(s)", "deg/sqrt(h)", "0.1 deg/sqrt(h)", _Powers(2, -1)
    ),
    Dimension(
        "rate random walk", "a rate random walk", "rad/s/sqrt(s)", "deg/h/sqrt(h)", "2 deg/h/sqrt(h)", _Powers(2, -3)
    ),
    Dimension("scale factor", "a scale factor", "1", "ppm", "80 ppm", _Powers()),
    Dimension("scale factor slope", "a scale-factor slope", "1/K", "ppm/K", "10 ppm/K", _Powers(0, 0, -2)),
    Dimension("bias slope", "a bias slope", "rad/s/K", "deg/h/K", "5 deg/h/K", _Powers(2, -2, -2)),
    Dimension(
        "bias temperature-gradient sensitivity",
        "a bias temperature-gradient sensitivity",
        "rad/K",
        "deg/h/(K/min)",
        "5 deg/h/(K/min)",
        _Powers(2, 0, -2),
    ),
    Dimension(
        "acceleration-sensitive drift",
        "an acceleration-sensitive drift",
        "rad/s/(m/s^2)",
        "deg/h/g",
        "10 deg/h/g",
        _Powers(2, 2, 0, -2),
    ),
    Dimension("acceleration", "an acceleration", "m/s^2", "mg", "5 mg", _Powers(0, -4, 0, 2)),
    Dimension(
        "velocity random walk", "a velocity random walk", "m/s/sqrt(s)", "m/s/sqrt(h)", "0.1 m/s/sqrt(h)",
        _Powers(0, -3, 0, 2),
    ),
    Dimension("frequency", "a frequency", "Hz", "Hz", "100 Hz", _Powers(0, -2)),
    Dimension("length", "a length", "m", "m", "0.1 m", _Powers(0, 0, 0, 2)),
)  # fmt: skip

_PRECISE: Final = Context(prec=60)
_PI: Final = Decimal("3.14159265358979323846264338327950288419716939937510582097494459")
_G: Final = Decimal("9.80665")


def _names() -> dict[str, tuple[Decimal, _Powers]]:
    angle, time, temperature, length = _Powers(2), _Powers(0, 2), _Powers(0, 0, 2), _Powers(0, 0, 0, 2)
    rate, acceleration, frequency, ratio = _Powers(2, -2), _Powers(0, -4, 0, 2), _Powers(0, -2), _Powers()
    with localcontext(_PRECISE):
        degree = _PI / 180
        rows: list[tuple[str, Decimal, _Powers]] = [
            ("rad", Decimal(1), angle),
            ("mrad", Decimal("1e-3"), angle),
            ("urad", Decimal("1e-6"), angle),
            ("° deg degree degrees", degree, angle),
            ("mdeg", degree / 1000, angle),
            ("′ ' arcmin", degree / 60, angle),
            ('″ " arcsec', degree / 3600, angle),
            ("mas", degree / 3600000, angle),
            ("rev turn turns", 2 * _PI, angle),
            ("s sec second seconds", Decimal(1), time),
            ("ms", Decimal("1e-3"), time),
            ("us", Decimal("1e-6"), time),
            ("ns", Decimal("1e-9"), time),
            ("min minute minutes", Decimal(60), time),
            ("h hr hour hours", Decimal(3600), time),
            ("d day days", Decimal(86400), time),
            ("K degC °C", Decimal(1), temperature),
            ("degF °F", Decimal(5) / 9, temperature),
            ("mK", Decimal("1e-3"), temperature),
            ("m", Decimal(1), length),
            ("cm", Decimal("1e-2"), length),
            ("mm", Decimal("1e-3"), length),
            ("um", Decimal("1e-6"), length),
            ("dps", degree, rate),
            ("mdps", degree / 1000, rate),
            ("rpm", 2 * _PI / 60, rate),
            ("g", _G, acceleration),
            ("mg", _G / 1000, acceleration),
            ("ug", _G / 1000000, acceleration),
            ("Hz", Decimal(1), frequency),
            ("mHz", Decimal("1e-3"), frequency),
            ("kHz", Decimal("1e3"), frequency),
            ("MHz", Decimal("1e6"), frequency),
            ("ppm", Decimal("1e-6"), ratio),
            ("ppb", Decimal("1e-9"), ratio),
            ("%", Decimal("1e-2"), ratio),
            ("‰", Decimal("1e-3"), ratio),
            ("1", Decimal(1), ratio),
        ]
    return {name: (factor, powers) for names, factor, powers in rows for name in names.split()}


_NAMES: Final = _names()
# Alone, these are points on a scale with an offset; inside a compound they are differences.
_CELSIUS: Final = frozenset({"degC", "°C"})
_FAHRENHEIT: Final = frozenset({"degF", "°F"})

# Only what is the same character in another coat: micro, minus, middle dots, hard spaces, the one-character °C and °F.
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
_TOKEN: Final = re.compile(
    r" *(?:(?P<power>(?:\^|\*\*) *(?:\( *[+-]?[0-9]/[0-9] *\)|[+-]?[0-9](?:\.[05])?(?![0-9.]))|⁻?[¹²³])"
    r"|(?P<root>√|sqrt(?= *\()|rt-|rt(?=(?:h|hr|Hz)(?![A-Za-z])))"
    r"|(?P<name>°[CF](?![A-Za-z])|[A-Za-z]+|[°′'″\"%‰]|1(?![0-9.]))"
    r"|(?P<sign>[*/()]))"
)
_SUPERSCRIPT: Final = {"¹": 1, "²": 2, "³": 3}
_LONGEST: Final = 120
_DEEPEST: Final = 6


class _Unit(NamedTuple):
    """SI value of one unit (decimal, 60 digits), its exponents, and its spelling where it is one bare name."""

    factor: Decimal
    powers: _Powers
    bare: str | None


class _Refusal(Exception):
    """Why a unit is not understood; becomes part of a UnitError's sentence."""


def _power(text: str) -> int:
    """Twice the exponent."""
    if text[0] in "⁻¹²³":
        sign = -1 if text[0] == "⁻" else 1
        return 2 * sign * _SUPERSCRIPT[text[-1]]
    body = text.lstrip("^*").replace(" ", "").strip("()")
    if "/" in body:
        top, bottom = body.split("/")
        if bottom != "2":
            raise _Refusal(f"the power '{body}' is not a multiple of one half")
        doubled = int(top)
    else:
        doubled = int(2 * Decimal(body))
    if doubled == 0 or not -6 <= doubled <= 6:
        raise _Refusal(f"the power '{body}' is out of range")
    return doubled


class _Reader:
    """Recursive descent over the tokens of one unit."""

    def __init__(self, text: str) -> None:
        self.text = text
        self.tokens: list[tuple[str, str]] = []
        at = 0
        while at < len(text.rstrip(" ")):
            match = _TOKEN.match(text, at)
            if match is None or match.end() == at:
                raise _Refusal(f"'{text[at:].strip()}' is not understood")
            kind = str(match.lastgroup)
            self.tokens.append((kind, match.group(kind)))
            at = match.end()
        self.at = 0

    def next(self) -> tuple[str, str]:
        return self.tokens[self.at] if self.at < len(self.tokens) else ("end", "")

    def take(self) -> tuple[str, str]:
        token = self.next()
        self.at += 1
        return token

    def unit(self, depth: int) -> _Unit:
        if depth > _DEEPEST:
            raise _Refusal("the parentheses nest too deeply")
        result = self.factor(depth, first=True)
        divided = False
        while self.next()[1] in ("*", "/"):
            _, operator = self.take()
            if operator == "*" and divided:
                raise _Refusal("a product after a division is ambiguous; put the denominator into parentheses")
            divided = divided or operator == "/"
            right = self.factor(depth, first=False)
            sign = 1 if operator == "*" else -1
            factor = result.factor * right.factor if sign == 1 else result.factor / right.factor
            powers = _Powers(*(a + sign * b for a, b in zip(result.powers, right.powers, strict=True)))
            result = _Unit(factor, powers, None)
        return result

    def factor(self, depth: int, first: bool) -> _Unit:
        kind, text = self.take()
        if kind == "root":
            return self.root(depth)
        if text == "(":
            result = self.closed(depth)
        elif kind == "name":
            if text == "1" and not (first and depth == 0):
                raise _Refusal("'1' may only stand first")
            result = self.named(text)
        elif kind == "end":
            raise _Refusal("the unit is not complete")
        else:
            raise _Refusal(f"'{text}' stands where a unit is expected")
        if self.next()[0] == "power":
            doubled = _power(self.take()[1])
            if any(doubled * power % 2 for power in result.powers):
                raise _Refusal("a root of a root is not understood")
            powers = _Powers(*(doubled * power // 2 for power in result.powers))
            value = result.factor ** (doubled // 2) if doubled % 2 == 0 else result.factor.sqrt() ** doubled
            result = _Unit(value, powers, None)
        return result

    def root(self, depth: int) -> _Unit:
        kind, text = self.take()
        if text == "(":
            inside = self.closed(depth)
        elif kind == "name" and text != "1":
            inside = self.named(text)
        else:
            raise _Refusal("a root must be followed by a unit, as in 'deg/sqrt(h)'")
        if self.next()[0] == "power":
            raise _Refusal("a power of a root is not understood")
        if any(power % 2 for power in inside.powers):
            raise _Refusal("a root of a root is not understood")
        return _Unit(inside.factor.sqrt(), _Powers(*(power // 2 for power in inside.powers)), None)

    def closed(self, depth: int) -> _Unit:
        result = self.unit(depth + 1)
        if self.take()[1] != ")":
            raise _Refusal("a parenthesis is not closed")
        return result

    def named(self, text: str) -> _Unit:
        if text not in _NAMES:
            raise _Refusal(f"unit '{text}' is unknown{_nearest(text)}")
        if text in _FAHRENHEIT and len(self.tokens) > 1:
            raise _Refusal("Fahrenheit is understood for absolute temperatures only; write K")
        factor, powers = _NAMES[text]
        return _Unit(factor, powers, text)


def _nearest(text: str) -> str:
    folded = [name for name in _NAMES if name.casefold() == text.casefold()]
    close = folded or difflib.get_close_matches(text, [name for name in _NAMES if name.isalpha()], n=1, cutoff=0.6)
    return f" (nearest: '{close[0]}')" if close else ""


@lru_cache(maxsize=512)
def _unit(text: str) -> _Unit:
    if not text:
        raise _Refusal("the unit is missing")
    reader = _Reader(text)
    with localcontext(_PRECISE):
        result = reader.unit(0)
    if reader.at != len(reader.tokens):
        rest = reader.next()[1]
        raise _Refusal(f"'{rest}' is left over; join units with '/' or '·'")
    return result


def _kind(unit: _Unit) -> str | None:
    """What a unit measures, in words, or None."""
    if unit.bare in _CELSIUS or unit.bare in _FAHRENHEIT:
        return "a temperature"
    for dimension in DIMENSIONS.values():
        if dimension.powers == unit.powers and dimension.name != "temperature":
            return dimension.described
    return None


def _known(dimension: str) -> Dimension:
    if dimension not in DIMENSIONS:
        close = difflib.get_close_matches(dimension, DIMENSIONS, n=1, cutoff=0.0)
        raise UnitError(f"'{dimension}' is not a dimension; nearest: '{close[0]}'")
    return DIMENSIONS[dimension]


def _expected(dimension: Dimension) -> str:
    return f"expected {dimension.described} such as '{dimension.example}'"


def _check(unit: _Unit, dimension: Dimension) -> None:
    """Refuse a unit that does not measure the dimension."""
    offset = unit.bare in _CELSIUS or unit.bare in _FAHRENHEIT
    if dimension.name == "temperature":
        if offset:
            return
        if unit.powers == dimension.powers:
            raise _Refusal("an absolute temperature is written in degC; K is for differences")
    elif offset and dimension.name == "temperature difference":
        raise _Refusal("a temperature difference is written in K; degC is for absolute temperatures")
    elif unit.powers == dimension.powers:
        return
    described = _kind(unit)
    raise _Refusal(f"that is {described}" if described else f"that is not {dimension.described}")


# Decimal exponents beyond any float are refused before they cost time.
_EXPONENT_DIGITS: Final = 4


def _number(text: str) -> Decimal:
    exponent = re.split("[eE]", text)[1:]
    if exponent and len(exponent[0].lstrip("+-0")) > _EXPONENT_DIGITS - 1:
        raise _Refusal("the number is out of range")
    return Decimal(text)


def _finite(value: Decimal) -> float:
    result = float(value)
    if math.isinf(result) or (result == 0.0 and value != 0):
        raise _Refusal("the number is out of range")
    return result + 0.0  # no negative zero


_DURATION: Final = (("h", "hr"), ("min",), ("s", "sec"))
_ARC: Final = (("°", "deg"), ("′", "'", "arcmin"), ("″", '"', "arcsec"))
_PART: Final = re.compile(r" *([0-9]+(?:\.[0-9]+)?) *([A-Za-z]+|[°′'″\"])")


def _compound(text: str, dimension: Dimension) -> Decimal | None:
    """'2 h 40 min', '1° 30′ 15″': falling units, whole numbers but for the last, each below 60; None if it is none."""
    steps = {"time": _DURATION, "angle": _ARC}.get(dimension.name)
    if steps is None:
        return None
    negative = text[:1] == "-"
    body = text[1:] if text[:1] in ("-", "+") else text
    parts: list[tuple[str, str]] = []
    at = 0
    while at < len(body):
        match = _PART.match(body, at)
        if match is None:
            return None
        parts.append((match.group(1), match.group(2)))
        at = match.end()
    if len(parts) < 2:
        return None
    total = Decimal(0)
    previous = -1
    for index, (number, name) in enumerate(parts):
        level = next((i for i, names in enumerate(steps) if name in names), None)
        if level is None:
            return None
        if level <= previous:
            raise _Refusal("the parts must fall in size, as in '2 h 40 min' or '1° 30′ 15″'")
        if "." in number and index < len(parts) - 1:
            raise _Refusal("only the last part may have decimals")
        if index > 0 and Decimal(number) >= 60:
            raise _Refusal(f"'{number} {name}' must be below 60 after a larger unit")
        total += Decimal(number) * _NAMES[name][0]
        previous = level
    return -total if negative else total


def _hint(text: str) -> str:
    """Why the number could not be read, in the cases that people fall into."""
    if re.match(r"[+-]?[0-9]+,[0-9]", text):
        return "decimals take a point, not a comma"
    if re.match(r"[+-]?[0-9]+_[0-9]", text) or re.match(r"[+-]?[0-9]+ [0-9]{3}\b", text):
        return "digits are written without separators"
    if re.match(r"[+-]? *(nan|inf)", text, re.IGNORECASE):
        return "the number must be finite"
    if text.startswith("±"):
        return "write the size alone, without '±'"
    return "it must begin with a number"


def _read(text: str, dimension: Dimension) -> float:
    plain = text.strip(" ").translate(_SAME)
    if len(plain) > _LONGEST:
        raise _Refusal("the text is too long")
    match = _NUMBER.match(plain)
    if match is None or re.match(r"[,_]", plain[match.end() :]):
        raise _Refusal(_hint(plain))
    rest = plain[match.end() :].lstrip(" ")
    if not rest:
        raise _Refusal("the unit is missing")
    with localcontext(_PRECISE):
        total = _compound(plain, dimension)
        if total is not None:
            return _finite(total)
        if rest[0].isdigit() and rest != "1" and not rest.startswith("1/"):
            raise _Refusal(_hint(plain) if re.match(r"[0-9]{3}\b", rest) else f"'{rest}' is not a unit")
        number = _number(match.group())
        unit = _unit(rest)
        _check(unit, dimension)
        if unit.bare in _FAHRENHEIT:
            number -= 32
        value = number * unit.factor
        if dimension.name == "temperature" and value < Decimal("-273.15"):
            raise _Refusal("that is below absolute zero")
        return _finite(value)


def parse(text: str, dimension: str) -> float:
    """The SI value of a text such as ``"0.1 deg/sqrt(h)"``.

    `dimension` is a name from `DIMENSIONS`. Absolute temperatures are returned in °C. Raises `UnitError`, whose message
    names the text, the reason, and an example of what was expected.
    """
    known = _known(dimension)
    try:
        return _read(text, known)
    except _Refusal as refusal:
        shown = text if len(text) <= _LONGEST else text[: _LONGEST - 1] + "…"
        raise UnitError(f"'{shown}' is not understood: {refusal}; {_expected(known)}") from None


def _lookup(unit: str) -> _Unit:
    if len(unit) > _LONGEST:
        raise UnitError(f"'{unit[:_LONGEST]}…' is not a unit")
    try:
        return _unit(unit.strip(" ").translate(_SAME))
    except _Refusal as refusal:
        raise UnitError(f"unit '{unit}' is not understood: {refusal}") from None


def dimension_of(unit: str) -> str:
    """The name of the dimension that a unit measures: ``dimension_of("deg/sqrt(h)") == "angle random walk"``."""
    found = _lookup(unit)
    if found.bare in _CELSIUS or found.bare in _FAHRENHEIT:
        return "temperature"
    for dimension in DIMENSIONS.values():
        if dimension.powers == found.powers and dimension.name != "temperature":
            return dimension.name
    raise UnitError(f"unit '{unit}' measures no quantity of this program")


def unit_of(text: str) -> str:
    """The unit of a quantity's text: ``unit_of("0.05 deg") == "deg"``; that of the first part of '2 h 40 min'."""
    plain = text.strip(" ").translate(_SAME)
    number = _NUMBER.match(plain)
    unit = plain[number.end() :].lstrip(" ") if number else ""
    compound = re.match(r"([A-Za-z]+|[°′'″\"]) *[0-9]", unit)
    unit = compound.group(1) if compound else unit
    dimension_of(unit)
    return unit


def _in_unit(value: float, unit: _Unit) -> Decimal:
    with localcontext(_PRECISE):
        quotient = Decimal(value) / unit.factor
        return quotient + 32 if unit.bare in _FAHRENHEIT else quotient


def to_unit(value: float, unit: str) -> float:
    """An SI value as a number of `unit`: ``to_unit(math.pi, "deg") == 180.0``."""
    if not math.isfinite(value):
        raise UnitError(f"{value} cannot be given in '{unit}': the number must be finite")
    return _representable(_in_unit(value, _lookup(unit)), value, unit)


def _representable(number: Decimal, value: float, unit: str) -> float:
    try:
        return _finite(number)
    except _Refusal:
        raise UnitError(f"{value} is out of range in '{unit}'") from None


def convert(value: float, from_unit: str, to: str) -> float:
    """`value` of `from_unit` as a number of `to`; both must measure the same dimension."""
    if not math.isfinite(value):
        raise UnitError(f"{value} cannot be converted: the number must be finite")
    source, target = _lookup(from_unit), _lookup(to)
    if dimension_of(from_unit) != dimension_of(to):
        raise UnitError(f"'{from_unit}' is {_kind(source)}, '{to}' is {_kind(target)}")
    with localcontext(_PRECISE):
        number = Decimal(value) - 32 if source.bare in _FAHRENHEIT else Decimal(value)
        quotient = number * source.factor / target.factor
        return _representable(quotient + 32 if target.bare in _FAHRENHEIT else quotient, value, to)


def _written(number: Decimal, digits: int) -> str:
    rounded = Context(prec=digits).create_decimal(number)
    if rounded == 0:
        return "0"
    exponent = rounded.adjusted()
    if -5 < exponent < 9:
        text = format(rounded, "f")
        return text.rstrip("0").rstrip(".") if "." in text else text
    mantissa = format(rounded.scaleb(-exponent), "f")
    mantissa = mantissa.rstrip("0").rstrip(".") if "." in mantissa else mantissa
    return f"{mantissa}e{exponent}"


def format_quantity(value: float, unit: str) -> str:
    """The shortest text in `unit` that `parse` reads back as exactly `value` (SI; °C for absolute temperatures).

    A Fahrenheit that cannot be exact (within some 1e-20 of 0 °C) is written in degC.
    """
    if not math.isfinite(value):
        raise UnitError(f"{value} is not a quantity: the number must be finite")
    found = _lookup(unit)
    dimension = dimension_of(unit)
    number = _in_unit(value, found)
    if found.bare in _FAHRENHEIT:
        # Near 0 degF the offset leaves only digits of rounding: take the plain decimal where it says the same.
        number = min((round(number, 9), number), key=lambda n: parse(f"{n:f} {unit}", dimension) != value)
    for digits in range(1, 26):
        text = f"{_written(number, digits)} {unit}"
        if parse(text, dimension) == value:
            return text
    # 25 digits suffice for every unit without an offset; with one, a tiny number would need hundreds.
    return format_quantity(value, "degC")


def time_text(seconds: float) -> str:
    """Hours, minutes and seconds as people say them: '2 h 40 min', '45.45 s'."""
    if seconds < 120.0:
        return f"{seconds:.4g} s"
    whole = round(seconds)
    hours, rest = divmod(whole, 3600)
    minutes, left = divmod(rest, 60)
    parts = [f"{hours} h"] if hours else []
    parts += [f"{minutes} min"] if minutes else []
    parts += [f"{left} s"] if left and hours < 10 else []
    return " ".join(parts) if parts else "0 s"
