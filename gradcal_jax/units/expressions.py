"""Parser of unit expressions (grammar: see the package): "deg/h/(K/min)" to its SI value and exponents."""

import difflib
import re
from decimal import Decimal, localcontext
from functools import lru_cache
from typing import Final, NamedTuple

from gradcal_jax.units.symbols import FAHRENHEIT, PRECISE, SYMBOLS, Powers

_TOKEN: Final = re.compile(
    r" *(?:(?P<power>(?:\^|\*\*) *(?:\( *[+-]?[0-9]/[0-9] *\)|[+-]?[0-9](?:\.[05])?(?![0-9.]))|⁻?[¹²³])"
    r"|(?P<root>√|sqrt(?= *\()|rt-|rt(?=(?:h|hr|Hz)(?![A-Za-z])))"
    r"|(?P<name>°[CF](?![A-Za-z])|[A-Za-z]+|[°′'″\"%‰]|1(?![0-9.]))"
    r"|(?P<sign>[*/()]))"
)
_SUPERSCRIPT: Final = {"¹": 1, "²": 2, "³": 3}
_DEEPEST: Final = 6


class Unit(NamedTuple):
    """SI value of one unit (decimal, 60 digits), its exponents, and its spelling where it is one bare name."""

    factor: Decimal
    powers: Powers
    bare: str | None


class Refusal(Exception):
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
            raise Refusal(f"the power '{body}' must be a multiple of one half")
        doubled = int(top)
    else:
        doubled = int(2 * Decimal(body))
    if doubled == 0 or not -6 <= doubled <= 6:
        raise Refusal(f"the power '{body}' is out of range")
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
                raise Refusal(f"'{text[at:].strip()}' is not understood")
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

    def unit(self, depth: int) -> Unit:
        if depth > _DEEPEST:
            raise Refusal("the parentheses nest too deeply")
        result = self.factor(depth, first=True)
        divided = False
        while self.next()[1] in ("*", "/"):
            _, operator = self.take()
            if operator == "*" and divided:
                raise Refusal("a product after a division is ambiguous: put the denominator into parentheses")
            divided = divided or operator == "/"
            right = self.factor(depth, first=False)
            sign = 1 if operator == "*" else -1
            factor = result.factor * right.factor if sign == 1 else result.factor / right.factor
            powers = Powers(*(a + sign * b for a, b in zip(result.powers, right.powers, strict=True)))
            result = Unit(factor, powers, None)
        return result

    def factor(self, depth: int, first: bool) -> Unit:
        kind, text = self.take()
        if kind == "root":
            return self.root(depth)
        if text == "(":
            result = self.closed(depth)
        elif kind == "name":
            if text == "1" and not (first and depth == 0):
                raise Refusal("'1' is allowed only at the beginning")
            result = self.named(text)
        elif kind == "end":
            raise Refusal("the unit is incomplete")
        else:
            raise Refusal(f"'{text}' stands where a unit is expected")
        if self.next()[0] == "power":
            doubled = _power(self.take()[1])
            if any(doubled * power % 2 for power in result.powers):
                raise Refusal("a root of a root is not understood")
            powers = Powers(*(doubled * power // 2 for power in result.powers))
            value = result.factor ** (doubled // 2) if doubled % 2 == 0 else result.factor.sqrt() ** doubled
            result = Unit(value, powers, None)
        return result

    def root(self, depth: int) -> Unit:
        kind, text = self.take()
        if text == "(":
            inside = self.closed(depth)
        elif kind == "name" and text != "1":
            inside = self.named(text)
        else:
            raise Refusal("a root must be followed by a unit, as in 'deg/sqrt(h)'")
        if self.next()[0] == "power":
            raise Refusal("a power of a root is not understood")
        if any(power % 2 for power in inside.powers):
            raise Refusal("a root of a root is not understood")
        return Unit(inside.factor.sqrt(), Powers(*(power // 2 for power in inside.powers)), None)

    def closed(self, depth: int) -> Unit:
        result = self.unit(depth + 1)
        if self.take()[1] != ")":
            raise Refusal("a parenthesis is not closed")
        return result

    def named(self, text: str) -> Unit:
        if text not in SYMBOLS:
            raise Refusal(f"unit '{text}' is unknown{_nearest(text)}")
        if text in FAHRENHEIT and len(self.tokens) > 1:
            raise Refusal("Fahrenheit is allowed only for absolute temperatures; for a temperature difference, write K")
        factor, powers = SYMBOLS[text]
        return Unit(factor, powers, text)


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
        result = reader.unit(0)
    if reader.at != len(reader.tokens):
        rest = reader.next()[1]
        raise Refusal(f"'{rest}' does not belong to the unit before it: join units with '/' or '·'")
    return result
