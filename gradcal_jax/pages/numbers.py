"""Format of numbers on pages."""

import re

_NOT_PROSE = re.compile(r"(<(style|script|svg|pre|code)\b.*?</\2>|<[^>]*>)", re.S)


def figures(value: float, digits: int = 4) -> str:
    """A number with `digits` significant digits, without powers of ten and with a typographic minus."""
    text = f"{value:.{digits}g}"
    if "e+" in text:
        text = f"{float(text):.0f}"
    return text.replace("-", "−")


def percent(chance: float, least: float = 1e-4) -> str:
    """A chance in per cent; within `least` of zero or one, only as a bound."""
    if chance < least:
        return f"< {100.0 * least:g} %"
    return f"> {100.0 * (1.0 - least):g} %" if chance > 1.0 - least else f"{100.0 * chance:.3g} %"


def one_sign(html: str) -> str:
    """The page with typographic minus and degree signs in its prose, where files and commands have `-25 degC`."""
    parts = _NOT_PROSE.split(html)
    parts[::3] = [re.sub(r"(?<![\w.-])-(?=\d)", "−", part).replace("degC", "°C") for part in parts[::3]]
    # Every third part is the name of an element, which the second contains, too.
    return "".join(part for place, part in enumerate(parts) if place % 3 != 2)
