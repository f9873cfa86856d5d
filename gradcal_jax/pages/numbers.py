"""Numbers as pages write them."""

import re

_NOT_PROSE = re.compile(r"(<(style|script|svg|pre|code)\b.*?</\2>|<[^>]*>)", re.S)


def figures(value: float, digits: int = 4) -> str:
    """A number with so many digits, as people write it: no powers of ten, a minus that is one."""
    text = f"{value:.{digits}g}"
    if "e+" in text:
        text = f"{float(text):.0f}"
    return text.replace("-", "−")


def one_sign(html: str) -> str:
    """A page whose prose has one minus and one degree sign, where files and commands have `-25 degC`."""
    parts = _NOT_PROSE.split(html)
    parts[::3] = [re.sub(r"(?<![\w.-])-(?=\d)", "−", part).replace("degC", "°C") for part in parts[::3]]
    # Every third is the name of an element, which stands in the second, too.
    return "".join(part for place, part in enumerate(parts) if place % 3 != 2)
