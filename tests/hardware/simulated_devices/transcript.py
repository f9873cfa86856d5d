"""Every byte of a line with its time and direction: bug report, evidence, and the source of a replayed test.

One line of text a chunk, append-only, readable without this program:

    # gradcal-transcript/1
    12.345678 > TEMP?\\r\\n
    12.361402 < 26.4,0.0,140.0,-50.0\\r\\n

`>` goes to the device, `<` comes from it, `#` is a remark; seconds are those of the clock of the run. Bytes other than
printable ASCII are written `\\xNN`, `\\r`, `\\n`, the backslash itself `\\\\`.
"""

import re
import threading
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

from gradcal_jax.hardware.journal import Direction

HEADER = "# gradcal-transcript/1"

_ENCODED = [chr(b) if 32 <= b < 127 else f"\\x{b:02x}" for b in range(256)]
_ENCODED[ord("\r")], _ENCODED[ord("\n")], _ENCODED[ord("\\")] = "\\r", "\\n", "\\\\"
_ESCAPE = re.compile(r"\\(x[0-9a-f]{2}|[rn\\])")
_LINE = re.compile(r"(?P<time>-?\d+\.\d+) (?P<direction>[<>#]) (?P<text>.*)")


@dataclass(frozen=True)
class Entry:
    """One chunk of a transcript."""

    time_s: float
    direction: Direction
    data: bytes


def encode(data: bytes) -> str:
    return "".join([_ENCODED[byte] for byte in data])


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


class TextTranscript:
    """Append-only transcript file. Each chunk reaches the operating system before `record` returns."""

    def __init__(self, path: Path, remark: str = "") -> None:
        fresh = not path.exists() or path.stat().st_size == 0
        self._file: TextIO = path.open("a", encoding="ascii", errors="backslashreplace", newline="\n")
        self._lock = threading.Lock()
        if fresh:
            self._file.write(HEADER + "\n")
        if remark:
            self._file.write(f"# {remark}\n")
        self._file.flush()

    def record(self, time_s: float, direction: Direction, data: bytes) -> None:
        with self._lock:
            if not self._file.closed:
                self._file.write(f"{time_s:.6f} {direction} {encode(data)}\n")
                self._file.flush()

    def close(self) -> None:
        with self._lock:
            self._file.close()

    def __enter__(self) -> "TextTranscript":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def parse(lines: Iterable[str]) -> list[Entry]:
    """The chunks of a transcript; a last line that was torn by a crash is left out.

    Raises ValueError for a line that no version of this format can have, with its number.
    """
    entries: list[Entry] = []
    numbered = [(number, line) for number, line in enumerate(lines, 1) if line.strip()]
    if not numbered or numbered[0][1].rstrip("\n") != HEADER:
        raise ValueError(f"This is no transcript: its first line must be {HEADER!r}.")
    for number, line in numbered[1:]:
        whole = line.endswith("\n")
        text = line.rstrip("\n")
        if text.startswith("#"):
            continue
        match = _LINE.fullmatch(text)
        try:
            if match is None:
                raise ValueError("a line is `seconds > bytes` or `seconds < bytes`")
            direction: Direction = ">" if match["direction"] == ">" else "<" if match["direction"] == "<" else "#"
            entries.append(Entry(float(match["time"]), direction, decode(match["text"])))
        except ValueError as problem:
            if not whole and number == numbered[-1][0]:
                break
            raise ValueError(f"Line {number} of the transcript cannot be read: {problem}.") from None
    return entries


def read(path: Path) -> list[Entry]:
    with path.open(encoding="ascii") as file:
        return parse(file)
