"""Reading the transcripts of benches, as `record_bench` writes them."""

import json
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gradcal_jax.hardware.journal import Direction
from gradcal_jax.hardware.transcript import HEADER, RIG

_ESCAPE = re.compile(r"\\(x[0-9a-f]{2}|[rn\\])")
_LINE = re.compile(r"(?P<time>-?\d+\.\d+) (?P<line>\S+) (?P<direction>[<>#]) (?P<text>.*)")


@dataclass(frozen=True)
class TranscriptEntry:
    """One chunk of a transcript."""

    time_s: float
    direction: Direction
    data: bytes
    line: str = "line"


def decode(text: str) -> bytes:
    """The bytes of an encoded text; a ValueError names what is no escape of this format."""
    out = bytearray()
    position = 0
    while (backslash := text.find("\\", position)) >= 0:
        escape = _ESCAPE.match(text, backslash)
        if escape is None:
            raise ValueError(
                f"{text[backslash : backslash + 4]!r} is no escape of a transcript; use \\xNN, \\r, \\n, \\\\"
            )
        out += text[position:backslash].encode("latin-1")
        word = escape.group(1)
        out.append({"r": 13, "n": 10, "\\": 92}[word] if word[0] != "x" else int(word[1:], 16))
        position = escape.end()
    return bytes(out + text[position:].encode("latin-1"))


def parse(lines: Iterable[str]) -> list[TranscriptEntry]:
    """The chunks of a transcript; a last line that was torn by a crash is left out.

    Raises ValueError for a line that no version of this format can have, with its number.
    """
    entries: list[TranscriptEntry] = []
    numbered = [(number, line) for number, line in enumerate(lines, 1) if line.strip()]
    if not numbered or numbered[0][1].rstrip("\n") != HEADER:
        raise ValueError(f"This is no transcript: its first line must be {HEADER!r}.")
    for number, line in numbered[1:]:
        whole, text = line.endswith("\n"), line.rstrip("\n")
        if text.startswith("#"):
            continue
        match = _LINE.fullmatch(text)
        try:
            if match is None:
                raise ValueError("a line is `seconds line > bytes` or `seconds line < bytes`")
            direction: Direction = ">" if match["direction"] == ">" else "<" if match["direction"] == "<" else "#"
            entries.append(TranscriptEntry(float(match["time"]), direction, decode(match["text"]), match["line"]))
        except ValueError as problem:
            if not whole and number == numbered[-1][0]:
                break
            raise ValueError(f"Line {number} of the transcript cannot be read: {problem}.") from None
    return entries


def read(path: Path) -> list[TranscriptEntry]:
    with path.open(encoding="ascii") as file:
        return parse(file)


def rig_in(path: Path) -> dict[str, Any]:
    """The rig file's tables in a transcript. Raises `ValueError` where there are none."""
    with path.open(encoding="ascii") as file:
        for line in file:
            if line.startswith(RIG):
                return json.loads(line.removeprefix(RIG))
    raise ValueError(f"{path} has no line {RIG!r}: `record_bench` did not write it")
