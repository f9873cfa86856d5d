"""Parser of unit expressions (grammar: see the package): "deg/h/(K/min)" to its SI value and exponents."""

import difflib
import re
from decimal import Decimal, localcontext
from functools import lru_cache
from typing import Final, NamedTuple

from gradcal_jax.units.symbols import CELSIUS, FAHRENHEIT, PRECISE, SYMBOLS, Powers

_SUPERSCRIPTS: Final = str.maketrans("⁻¹²³", "-123")
# Other ways to write a power and a root.
_POWER: Final = re.compile(r"\*\*|⁻?[¹²³]")
_ROOT: Final = re.compile(r"(?<![A-Za-z])(?:sqrt(?= *\()|rt-|rt(?=(?:hr?|Hz)(?![A-Za-z])))")
_TOKEN: Final = re.compile(
    r" *(√|°[CF](?![A-Za-z])|[A-Za-z]+|[°′'″\"%‰]|1(?![0-9.])|[*/()]"
    r"|\^ *(?:\( *[+-]?[0-9]/[0-9] *\)|[+-]?[0-9](?:\.[05])?(?![0-9.])))"
)
_DEEPEST: Final = 6


class Unit(NamedTuple):
    """SI value of one unit (decimal, 60 digits), its exponents, its spelling where it is one bare name, and the number
    that is the SI zero: 32 of a Fahrenheit."""

    factor: Decimal
    powers: Powers
    bare: str | None = None
    zero: int = 0

    @property
    def has_offset(self) -> bool:
        """Whether it is a point on a scale of temperature."""
        return self.bare in CELSIUS or self.bare in FAHRENHEIT

    def times(self, other: "Unit", power: int) -> "Unit":
        """The product with another unit to a power of 1 or -1."""
        powers = Powers(*(a + power * b for a, b in zip(self.powers, other.powers, strict=True)))
        return Unit(self.factor * other.factor if power > 0 else self.factor / other.factor, powers)

    def raised(self, doubled: int) -> "Unit":
        """The unit to half of a power that is `doubled`. Raises `Refusal` for a root of a root."""
        if any(doubled * power % 2 for power in self.powers):
            raise Refusal("a root of a root is not understood")
        value = self.factor.sqrt() ** doubled if doubled % 2 else self.factor ** (doubled // 2)
        return Unit(value, Powers(*(doubled * power // 2 for power in self.powers)))


class Refusal(Exception):
    """Why a unit is not understood; becomes part of a UnitError's sentence."""


def _doubled(power: str) -> int:
    """Twice the exponent of a token such as ^-2, ^0.5 or ^(1/2)."""
    body = power.lstrip("^").replace(" ", "").strip("()")
    top, _, bottom = body.partition("/")
    if bottom not in ("", "2"):
        raise Refusal(f"the power '{body}' must be a multiple of one half")
    doubled = int(2 * Decimal(top)) // (2 if bottom else 1)
    if doubled == 0 or not -6 <= doubled <= 6:
        raise Refusal(f"the power '{body}' is out of range")
    return doubled


class _Reader:
    """Recursive descent over the tokens of one unit."""

    def __init__(self, text: str) -> None:
        text = _POWER.sub(lambda power: "^" + power.group().strip("*").translate(_SUPERSCRIPTS), text)
        text = _ROOT.sub("√", text).rstrip(" ")
        self.tokens: list[str] = []
        at = 0
        while at < len(text):
            match = _TOKEN.match(text, at)
            if match is None:
                raise Refusal(f"'{text[at:].strip()}' is not understood")
            self.tokens.append(match.group(1))
            at = match.end()
        self.tokens.append("")
        self.at = 0

    @property
    def next(self) -> str:
        return self.tokens[self.at]

    def take(self) -> str:
        token = self.next
        self.at += 1
        return token

    def unit(self, depth: int = 0) -> Unit:
        if depth > _DEEPEST:
            raise Refusal("the parentheses nest too deeply")
        result, divided = self.factor(depth, first=depth == 0), False
        while self.next in ("*", "/"):
            operator = self.take()
            if operator == "*" and divided:
                raise Refusal("a product after a division is ambiguous: put the denominator into parentheses")
            divided = operator == "/"
            result = result.times(self.factor(depth), -1 if divided else 1)
        return result

    def factor(self, depth: int, *, first: bool = False) -> Unit:
        root = self.next == "√"
        if root:
            self.take()
        result = self.atom(depth, first=first, root=root)
        if self.next.startswith("^"):
            if root:
                raise Refusal("a power of a root is not understood")
            return result.raised(_doubled(self.take()))
        return result.raised(1) if root else result

    def atom(self, depth: int, *, first: bool, root: bool) -> Unit:
        token = self.take()
        if token == "(":
            result = self.unit(depth + 1)
            if self.take() != ")":
                raise Refusal("a parenthesis is not closed")
            return result
        if token in SYMBOLS:
            if token == "1" and not first:
                raise Refusal("'1' is allowed only at the beginning")
            if token in FAHRENHEIT and len(self.tokens) > 2:
                raise Refusal(
                    "Fahrenheit is allowed only for absolute temperatures; for a temperature difference, write K"
                )
            return Unit(*SYMBOLS[token], token, 32 if token in FAHRENHEIT else 0)
        if token.isalpha():
            raise Refusal(f"unit '{token}' is unknown{_nearest(token)}")
        if root:
            raise Refusal("a root must be followed by a unit, as in 'deg/sqrt(h)'")
        raise Refusal(f"'{token}' stands where a unit is expected" if token else "the unit is incomplete")


def _nearest(text: str) -> str:
    folded = [name for name in SYMBOLS if name.casefold() == text.casefold()]
    close = folded or difflib.get_close_matches(text, [name for name in SYMBOLS if name.isalpha()], n=1, cutoff=0.6)
    return f" (nearest: '{close[0]}')" if close else ""


@lru_cache(maxsize=512)
def read_unit(text: str) -> Unit:
    if not text:
        raise Refusal("the unit is missing")
    reader = _Reader(text)
    with localcontext(PRECISE):
        result = reader.unit()
    if reader.next:
        raise Refusal(f"'{reader.next}' does not belong to the unit before it: join units with '/' or '·'")
    return result
