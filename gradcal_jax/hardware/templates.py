"""Lines with fields in braces: the pattern of a line that is read, and a line that is written with its values.

In a line that is read `{name}` is a number, `{name:text}` the text up to the next character of the template,
`{name:char}` one character; a field without a name is ignored. In a line that is written `{name:.1f}` is a number.
"""

import re
from collections.abc import Iterator, Mapping
from typing import Final

FIELD: Final = re.compile(r"\{([a-z_]*)(?::(text|char))?\}")
VALUE: Final = re.compile(r"\{([a-z]+):(0?\d{0,2}(?:\.\d)?f|g)\}")
NUMBER: Final = r"[-+]?+\d++(?:\.\d*+)?+"
# Further decimals of a device are rounding errors.
_FINEST_DECIMALS: Final = 3
# Possessive repetitions of blanks: at least one, or any number.
_SOME, _ANY = "++", "*+"
_BLANK: Final = r"[ \t]"


def reply_pattern(template: str, number: str = NUMBER) -> re.Pattern[str]:
    """The pattern of a line, with the fields as named groups.

    Blanks and tabs stand for blanks of the template, and may also surround numbers, commas and colons. Every part is
    possessive and no two neighbours accept the same blank, so that a line that does not match is refused in a time that
    is linear in its length, whatever the template.
    """
    pattern, gap = "", ""
    for part in ("", *_parts(template, number), ""):
        if part in (_SOME, _ANY):
            gap = _SOME if _SOME in (gap, part) else _ANY
            continue
        pattern += (gap and _BLANK + gap) + part
        gap = ""
    return re.compile(pattern, re.DOTALL)


def _parts(template: str, number: str) -> Iterator[str]:
    """The pattern's parts, and between them the repetitions of blanks."""
    place = 0
    for match in FIELD.finditer(template):
        yield from _literal(template[place : match.start()])
        place = match.end()
        name = f"?P<{match[1]}>" if match[1] else ""
        if match[2] == "text":
            end = template[place : place + 1]
            other = r" \t" if end == " " else re.escape(end)
            yield f"({name}[^{other}]*+)" if end else f"({name}.*+)"
        elif match[2] == "char":
            yield f"({name}.)"
        else:
            yield from (_ANY, f"({name}{number})", _ANY)
    yield from _literal(template[place:])


def _literal(text: str) -> Iterator[str]:
    for piece in re.findall(r" +|[,:]|[^ ,:]+", text):
        if piece[0] == " ":
            yield _SOME
        elif piece in ",:":
            yield from (_ANY, piece, _ANY)
        else:
            yield re.escape(piece)


def formatted(template: str, values: Mapping[str, float]) -> tuple[str, dict[str, str]]:
    """A command with its values, and the text of each value."""
    written: dict[str, str] = {}

    def write(match: re.Match[str]) -> str:
        text = format(values[match[1]], match[2])
        # No minus sign before zero.
        written[match[1]] = text if float(text) else format(0.0, match[2])
        return written[match[1]]

    return VALUE.sub(write, template), written


def shows(sent: str, reply: str) -> bool:
    """Whether a text that is read back is the one sent, or its number to half a step of the device's own decimals."""
    decimals = min(len(reply.partition(".")[2]), _FINEST_DECIMALS)
    try:
        return sent == reply or abs(float(sent) - float(reply)) <= 0.51 * 10.0**-decimals
    except ValueError:
        return False
