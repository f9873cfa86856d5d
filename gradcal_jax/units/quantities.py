"""A number with a unit, to SI and back (grammar: see the package)."""

import math
import re
from decimal import Context, Decimal, localcontext
from functools import lru_cache
from typing import Final, NamedTuple

from gradcal_jax.units.spelling import nearest
from gradcal_jax.units.symbols import DIMENSIONS, PRECISE, SYMBOLS, ZERO_OF_SCALE, Dimension, Powers

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

    def times(self, other: "Unit", power: int) -> "Unit":
        """The product with another unit to a power of 1 or -1."""
        a, b, c, d = (one + power * more for one, more in zip(self.powers, other.powers, strict=True))
        return Unit(self.factor * other.factor**power, (a, b, c, d))

    def raised(self, doubled: int) -> "Unit":
        """The unit to half of a power that is `doubled`."""
        a, b, c, d = (doubled * power for power in self.powers)
        if any(power % 2 for power in (a, b, c, d)):
            raise UnitError("a root of a root is not understood")
        return Unit(self.factor.sqrt() ** doubled, (a // 2, b // 2, c // 2, d // 2))


class _Reader:
    """Recursive descent over the tokens of one unit."""

    def __init__(self, text: str) -> None:
        text = _POWER.sub(lambda power: "^" + power.group().translate(_SUPERSCRIPTS), text)
        text = _ROOT.sub("√", text).rstrip(" ")
        self.tokens: list[str] = []
        at = 0
        while at < len(text):
            match = _TOKEN.match(text, at)
            if match is None:
                raise UnitError(f"'{text[at:].strip()}' is not understood")
            self.tokens.append(match.group(1))
            at = match.end()
        self.alone = len(self.tokens) == 1
        self.tokens.append("")

    def unit(self) -> Unit:
        result, divided = self.factor(), False
        while self.tokens[0] in ("*", "/"):
            operator = self.tokens.pop(0)
            if operator == "*" and divided:
                raise UnitError("a product after a division is ambiguous: put the denominator into parentheses")
            divided = operator == "/"
            result = result.times(self.factor(), -1 if divided else 1)
        return result

    def factor(self) -> Unit:
        root = self.tokens[0] == "√"
        if root:
            self.tokens.pop(0)
        result = self.atom()
        if self.tokens[0].startswith("^"):
            if root:
                raise UnitError("a power of a root is not understood")
            return result.raised(_doubled(self.tokens.pop(0)))
        return result.raised(1) if root else result

    def atom(self) -> Unit:
        token = self.tokens.pop(0)
        if token == "(":
            result = self.unit()
            if self.tokens.pop(0) != ")":
                raise UnitError("a parenthesis is not closed")
            return result
        if token in SYMBOLS:
            if token.endswith("F") and not self.alone:
                raise UnitError("Fahrenheit is allowed only for absolute temperatures; for a difference, write K")
            return Unit(*SYMBOLS[token], ZERO_OF_SCALE.get(token))
        if token.isalpha():
            near = nearest(token, filter(str.isalpha, SYMBOLS))
            raise UnitError(f"unit '{token}' is unknown" + (f" (nearest: '{near}')" if near else ""))
        raise UnitError(f"'{token}' stands where a unit is expected" if token else "the unit is incomplete")


def _doubled(power: str) -> int:
    """Twice the exponent of a token such as ^-2, ^0.5 or ^(1/2)."""
    body = power.lstrip("^").replace(" ", "").strip("()")
    top, _, bottom = body.partition("/")
    doubled = 2 * Decimal(top) / int(bottom or 1) if bottom != "0" else Decimal(0)
    if doubled != int(doubled) or doubled == 0 or abs(doubled) > 6:
        raise UnitError(f"the power '{body}' is not a multiple of one half between -3 and 3")
    return int(doubled)


@lru_cache(maxsize=512)
def _read_unit(text: str) -> Unit:
    if not text:
        raise UnitError("the unit is missing")
    reader = _Reader(text)
    with localcontext(PRECISE):
        result = reader.unit()
    if reader.tokens[0]:
        raise UnitError(f"'{reader.tokens[0]}' does not belong to the unit before it: join units with '/' or '·'")
    return result


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
        if dimension == _TEMPERATURE:
            raise UnitError("write an absolute temperature in degC; K is only for temperature differences")
        raise UnitError("write a temperature difference in K; degC is only for absolute temperatures")
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
    with localcontext(PRECISE):
        value = (number - (unit.zero or 0)) * unit.factor
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


_SI: Final = Unit(Decimal(1), (0, 0, 0, 0))


def _in_unit(value: float, target: Unit, source: Unit = _SI) -> Decimal:
    """A number of one unit (absent: SI) as one of another."""
    if not math.isfinite(value):
        raise UnitError(f"{value} is not a quantity: the number must be finite")
    with localcontext(PRECISE):
        return (Decimal(value) - (source.zero or 0)) * source.factor / target.factor + (target.zero or 0)


def to_unit(value: float, unit: str) -> float:
    """An SI value as a number of `unit`: ``to_unit(math.pi, "deg") == 180.0``."""
    return _finite(_in_unit(value, _lookup(unit)))


def convert(value: float, from_unit: str, to: str) -> float:
    """`value` of `from_unit` as a number of `to`; both must measure the same dimension.

    >>> convert(1.0, "deg/s", "deg/h")
    3600.0
    """
    have, wanted = DIMENSIONS[dimension_of(from_unit)], DIMENSIONS[dimension_of(to)]
    if have != wanted:
        raise UnitError(f"'{from_unit}' is {have.described}, '{to}' is {wanted.described}")
    return _finite(_in_unit(value, _lookup(to), _lookup(from_unit)))


def parse_in(text: str, unit: str) -> float:
    """A text such as "5 ppm/(K/min)" as a number of `unit`, of any dimension. Errors: `UnitError` for another one."""
    number, rest = _split(text)
    source, target = _lookup(rest), _lookup(unit)
    if source.powers != target.powers:
        raise UnitError(f"'{text}' has another unit than expected; its SI unit must be {unit}")
    with localcontext(PRECISE):
        return _finite(number * source.factor / target.factor)


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
    number, dimension = _in_unit(value, _lookup(unit)), dimension_of(unit)
    texts = (f"{_rounded(number, digits)} {unit}" for digits in range(1, 26))
    exact = next((text for text in texts if parse(text, dimension) == value), None)
    # 25 digits suffice for every unit without an offset; with one, a tiny number would need hundreds.
    return exact or format_quantity(value, "degC")
