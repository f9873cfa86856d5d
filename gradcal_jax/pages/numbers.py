"""Format of numbers on pages."""

import math
import re

from markupsafe import Markup, escape

_SIGNS = {
    r"degC": "°C",
    r"\bu(g|rad)\b": r"µ\1",
    r"(?<=[a-z])\^2\b": "²",
    r"\bsqrt\((\w+)\)": r"√\1",
}
_NOT_PROSE = re.compile(r"(<(style|script|svg|pre|code)\b.*?</\2>|<[^>]*>)", re.S)


def figures(value: float, digits: int = 4) -> str:
    """A number with `digits` significant digits, without powers of ten and with a typographic minus."""
    text = f"{value:.{digits}g}"
    if "e+" in text:
        text = f"{float(text):.0f}"
    return text.replace("-", "−")


def with_uncertainty(value: float, deviation: float) -> str:
    """ "1.23 ± 0.12": two significant digits of the uncertainty, and the value to the same decimal place."""
    if not (math.isfinite(value) and math.isfinite(deviation) and deviation > 0.0):
        return f"{figures(value, 5)} ± {figures(deviation, 2)}"
    # (Rounded first: 0.0996 is 0.10.)
    decimals = 1 - math.floor(math.log10(float(f"{deviation:.1e}")))
    shown = [f"{round(number, decimals) + 0.0:.{max(decimals, 0)}f}" for number in (value, deviation)]
    return " ± ".join(shown).replace("-", "−")


def unbroken_options(command: str) -> Markup:
    """A command whose options, with their values ("--format csv"), a browser keeps on one line."""
    html = re.sub(r"--[a-z-]+(?: [^\s-]\S*)?", r'<span class="option">\g<0></span>', str(escape(command)))
    return Markup(html)


def percent(chance: float, least: float = 1e-4) -> str:
    """A chance in per cent; within `least` of zero or one, only as a bound."""
    if chance < least:
        return f"< {100.0 * least:g} %"
    return f"> {100.0 * (1.0 - least):g} %" if chance > 1.0 - least else f"{100.0 * chance:.3g} %"


def typographic_units(text: str) -> str:
    """Units as print has them, "°C", "µrad", "µg/g²", "deg/√h", where files and commands have ASCII alone."""
    for pattern, sign in _SIGNS.items():
        text = re.sub(pattern, sign, text)
    return text


def one_sign(html: str) -> str:
    """The page with typographic minus and units and without powers of ten in its prose; files and commands have
    `-25 degC`."""
    parts = _NOT_PROSE.split(html)
    for place in range(0, len(parts), 3):
        plain = re.sub(r"\b\d(\.\d+)?e\+\d\d\b", lambda number: f"{float(number[0]):.0f}", parts[place])
        parts[place] = typographic_units(re.sub(r"(?<![\w.-])-(?=\d)", "−", plain))
    # Every third part is the name of an element, which the second contains, too.
    return "".join(part for place, part in enumerate(parts) if place % 3 != 2)
