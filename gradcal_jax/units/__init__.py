"""Text with units <-> SI numbers, for files, devices and messages only.

The grammar is strict: a text that does not follow it *exactly* is refused, with the nearest right spelling. (General
unit libraries read ``0.1 °/√h`` as degrees per hour, ``10 mg`` as milligrams and ``30″`` as a pure number.)

    quantity := number unit                                       "0.1 deg/sqrt(h)"
    unit     := factor ("·" factor)* ("/" factor)*                a product after a division needs parentheses
    factor   := (name | "(" unit ")") power? | "√" name | "√(" unit ")" | "sqrt(" unit ")" | "rt-" name
    power    := "^" k | superscript                               k a multiple of one half between -3 and 3

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

Arithmetic is decimal, with one rounding at the end: `parse` gives the float nearest to the text, and `format_quantity`
the shortest text that `parse` reads back as the same float.
"""

import math
import re
from decimal import Context, Decimal, localcontext
from fractions import Fraction
from functools import lru_cache
from typing import Final, NamedTuple

from gradcal_jax.units.spelling import nearest
from gradcal_jax.units.symbols import DIMENSIONS, PRECISE, SYMBOLS, ZERO_OF_SCALE, Dimension, Powers

# Factors from SI (ratios, rad/s, rad/√s, rad) to the units of reports.
PPM: Final = 1e6
# m/s² in one g (BIPM, CGPM 1901).
G: Final = 9.80665
DEG_PER_S: Final = 180.0 / math.pi
DEG_PER_H: Final = 3600.0 * 180.0 / math.pi
DEG_PER_SQRT_H: Final = 60.0 * 180.0 / math.pi
ARCSEC: Final = 3600.0 * 180.0 / math.pi


# Other code points of the same characters only: micro (twice), minus, middle dots, hard and thin spaces, and °C and °F
# of one character.
_SAME: Final = str.maketrans(
    dict(zip("\u00b5\u03bc\u2212\u00b7\u22c5\u00a0\u202f\u2009", "uu-**   ", strict=True))
    | {"\u2103": "°C", "\u2109": "°F"}
)
_SUPERSCRIPTS: Final = str.maketrans("⁻¹²³", "-123")
# Other ways to write a power and a root.
_POWER: Final = re.compile(r"⁻?[¹²³]")
_ROOT: Final = re.compile(r"(?<![A-Za-z])(?:sqrt(?= *\()|rt-|rt(?=(?:hr?|Hz)(?![A-Za-z])))")
_TOKEN: Final = re.compile(
    r" *(√|°[CF](?![A-Za-z])|[A-Za-z]+|[°′'″\"%‰]|1(?![0-9.])|[*/()]"
    r"|\^ *(?:\( *[+-]?[0-9]/[0-9] *\)|[+-]?[0-9](?:\.[05])?(?![0-9.])))"
)
_NUMBER: Final = re.compile(r"[+-]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?([0-9]+))?")
_MISTAKES: Final = (
    (r"[+-]?[0-9]+,[0-9]", "write decimals with a point, not a comma"),
    (r"[+-]?[0-9]+_[0-9]|[+-]?[0-9]+ [0-9]{3}\b", "write digits without separators"),
    (r"[+-]? *(?:[nN][aA][nN]|[iI][nN][fF])", "the number must be finite"),
    ("±", "write only the size, without '±'"),
)
_LONGEST: Final = 120
_TEMPERATURE: Final = DIMENSIONS["temperature"]


class UnitError(ValueError):
    """A text that is not a quantity of the expected dimension; the message says what was expected."""


class Unit(NamedTuple):
    """SI value of one unit (decimal, 60 digits), its exponents, and, if it is a scale of temperature, the number that
    is its SI zero: 32 of a Fahrenheit."""

    factor: Decimal
    powers: Powers
    zero: int | None = None


def _product(tokens: list[str]) -> Unit:
    """The unit at the begin of the tokens, which it takes from them."""
    (factor, powers, _), divided = _factor(tokens), False
    while tokens[0] in ("*", "/"):
        if tokens[0] == "*" and divided:
            raise UnitError("a product after a division is ambiguous: put the denominator into parentheses")
        divided = tokens.pop(0) == "/"
        sign, more = -1 if divided else 1, _factor(tokens)
        factor *= more.factor**sign
        powers = tuple(one + sign * other for one, other in zip(powers, more.powers, strict=True))
    return Unit(factor, powers)


def _factor(tokens: list[str]) -> Unit:
    """A name or a unit in parentheses, with its root or its power."""
    token, exponent = tokens.pop(0), Fraction(1)
    if token == "√":
        token, exponent = tokens.pop(0), Fraction(1, 2)
    if token == "(":
        unit = _product(tokens)
        if tokens.pop(0) != ")":
            raise UnitError("a parenthesis is not closed")
    elif token in SYMBOLS:
        unit = Unit(*SYMBOLS[token])
    elif token.isalpha():
        near = nearest(token, filter(str.isalpha, SYMBOLS))
        raise UnitError(f"unit '{token}' is unknown" + (f" (nearest: '{near}')" if near else ""))
    else:
        raise UnitError(f"'{token}' stands where a unit is expected" if token else "the unit is incomplete")
    if tokens[0].startswith("^"):
        if exponent != 1:
            raise UnitError("a power of a root is not understood")
        exponent = _exponent(tokens.pop(0))
    powers = tuple(exponent * power for power in unit.powers)
    if any(power.denominator > 2 for power in powers):
        raise UnitError("a root of a root is not understood")
    return Unit(unit.factor.sqrt() ** int(2 * exponent), powers)


def _exponent(power: str) -> Fraction:
    """The exponent of a token such as ^-2, ^0.5 or ^(1/2)."""
    body = power.strip("^()").replace(" ", "").strip("()")
    exponent = Fraction(0 if body.endswith("/0") else body)
    if exponent == 0 or exponent.denominator > 2 or abs(exponent) > 3:
        raise UnitError(f"the power '{body}' is not a multiple of one half between -3 and 3")
    return exponent


@lru_cache(maxsize=512)
def _read_unit(text: str) -> Unit:
    if not text:
        raise UnitError("the unit is missing")
    plain = _POWER.sub(lambda power: "^" + power.group().translate(_SUPERSCRIPTS), text)
    plain = _ROOT.sub("√", plain)
    tokens: list[str] = _TOKEN.findall(plain)
    if "".join(tokens).replace(" ", "") != plain.replace(" ", ""):
        raise UnitError(f"'{text}' is not understood")
    if tokens[1:] and any(token.endswith("F") for token in tokens):
        raise UnitError("Fahrenheit is allowed only for absolute temperatures; for a difference, write K")
    zero = ZERO_OF_SCALE.get(tokens[0]) if len(tokens) == 1 else None
    tokens.append("")
    with localcontext(PRECISE):
        unit = _product(tokens)
    if tokens[0]:
        raise UnitError(f"'{tokens[0]}' does not belong to the unit before it: join units with '/' or '·'")
    return unit._replace(zero=zero)


@lru_cache(maxsize=512)
def _measured(unit: Unit) -> Dimension | None:
    """What a unit measures, if anything."""
    if unit.zero is not None:
        return _TEMPERATURE
    known = (dimension for dimension in DIMENSIONS.values() if dimension != _TEMPERATURE)
    return next((dimension for dimension in known if _read_unit(dimension.si).powers == unit.powers), None)


def _check(unit: Unit, dimension: Dimension) -> None:
    """Refuse a unit that does not measure the dimension."""
    measured = _measured(unit)
    if measured == dimension:
        return
    if measured is not None and unit.powers == _read_unit(dimension.si).powers:
        raise UnitError("write an absolute temperature in degC, and a temperature difference in K")
    raise UnitError(f"that is {measured.described}" if measured else f"that is not {dimension.described}")


def _finite(value: Decimal) -> float:
    result = float(value)
    if math.isinf(result) or (result == 0.0 and value != 0):
        raise UnitError("the number is out of range")
    return result + 0.0  # no negative zero


def _split(text: str) -> tuple[Decimal, str]:
    """The number of a quantity, and its unit."""
    plain = text.strip(" ").translate(_SAME)
    if len(plain) > _LONGEST:
        raise UnitError("the text is too long")
    for mistake, hint in _MISTAKES:
        if re.match(mistake, plain):
            raise UnitError(hint)
    match = _NUMBER.match(plain)
    if match is None:
        raise UnitError("the text must begin with a number")
    # Longer exponents are refused before they cost time.
    if len((match.group(1) or "").lstrip("0")) > 3:
        raise UnitError("the number is out of range")
    return Decimal(match.group()), plain[match.end() :].lstrip(" ")


@lru_cache(maxsize=4096)
def _read(text: str, dimension: Dimension) -> float:
    number, rest = _split(text)
    unit = _read_unit(rest)
    _check(unit, dimension)
    value = _converted(number, unit, _SI)
    if dimension == _TEMPERATURE and value < Decimal("-273.15"):
        raise UnitError("the temperature is below absolute zero")
    return _finite(value)


def parse(text: str, dimension: str) -> float:
    """The SI value of a text such as ``"0.1 deg/sqrt(h)"``.

    `dimension` is a name from `DIMENSIONS`. Absolute temperatures are returned in °C. Raises `UnitError`, whose message
    names the text, the reason, and an example of what was expected.

    >>> round(parse("20 degC", "temperature"), 9), parse("2 min", "time")
    (20.0, 120.0)
    """
    if dimension not in DIMENSIONS:
        raise UnitError(f"'{dimension}' is not a dimension; nearest: '{nearest(dimension, DIMENSIONS)}'")
    known = DIMENSIONS[dimension]
    try:
        return _read(text, known)
    except UnitError as refusal:
        shown = text if len(text) <= _LONGEST else text[: _LONGEST - 1] + "…"
        expected = f"expected {known.described} such as '{known.example}'"
        raise UnitError(f"'{shown}' is not understood: {refusal}; {expected}") from None


def _lookup(unit: str) -> Unit:
    try:
        return _read_unit(unit[: _LONGEST + 1].strip(" ").translate(_SAME))
    except UnitError as refusal:
        raise UnitError(f"unit '{unit[:_LONGEST]}' is not understood: {refusal}") from None


def dimension_of(unit: str) -> str:
    """The name of the dimension that a unit measures: ``dimension_of("deg/sqrt(h)") == "angle random walk"``."""
    dimension = _measured(_lookup(unit))
    if dimension is None:
        raise UnitError(f"'{unit}' is not the unit of any quantity that this program knows")
    return dimension.name


def unit_of(text: str) -> str:
    """The unit of a quantity's text: ``unit_of("0.05 deg") == "deg"``."""
    _, unit = _split(text)
    dimension_of(unit)
    return unit


_SI: Final = Unit(Decimal(1), ())


def _converted(value: float | Decimal, source: Unit, target: Unit) -> Decimal:
    """A number of one unit as one of another."""
    if not math.isfinite(value):
        raise UnitError(f"{value} is not a quantity: the number must be finite")
    with localcontext(PRECISE):
        return (Decimal(value) - (source.zero or 0)) * source.factor / target.factor + (target.zero or 0)


def to_unit(value: float, unit: str) -> float:
    """An SI value as a number of `unit`: ``to_unit(math.pi, "deg") == 180.0``."""
    return _finite(_converted(value, _SI, _lookup(unit)))


def convert(value: float, from_unit: str, to: str) -> float:
    """`value` of `from_unit` as a number of `to`; both must measure the same dimension.

    >>> convert(1.0, "deg/s", "deg/h")
    3600.0
    """
    have, wanted = DIMENSIONS[dimension_of(from_unit)], DIMENSIONS[dimension_of(to)]
    if have != wanted:
        raise UnitError(f"'{from_unit}' is {have.described}, '{to}' is {wanted.described}")
    return _finite(_converted(value, _lookup(from_unit), _lookup(to)))


def parse_in(text: str, unit: str) -> float:
    """A text such as "5 ppm/(K/min)" as a number of `unit`, of any dimension. Errors: `UnitError` for another one."""
    number, rest = _split(text)
    source, target = _lookup(rest), _lookup(unit)
    if source.powers != target.powers:
        raise UnitError(f"'{text}' has another unit than expected; its SI unit must be {unit}")
    return _finite(_converted(number, source, target))


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
    number, dimension = _converted(value, _SI, _lookup(unit)), dimension_of(unit)
    texts = (f"{_rounded(number, digits)} {unit}" for digits in range(1, 26))
    exact = next((text for text in texts if parse(text, dimension) == value), None)
    # 25 digits suffice for every unit without an offset; with one, a tiny number would need hundreds.
    return exact or format_quantity(value, "degC")


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


def count_text(number: int, noun: str) -> str:
    """A number of things: '1 step', '17 steps'."""
    return f"{number} {noun}" + "s" * (number != 1)


def times_text(duration_s: float, soak_s: float, motion_s: float, motion: str = "motion") -> str:
    """Durations of a plan, its soaks and its motion."""
    return f"{time_text(duration_s)} in all: soak {time_text(soak_s)}, {motion} {time_text(motion_s)}"
