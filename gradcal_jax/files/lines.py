"""The line of each key of a TOML text, for error messages; `tomllib` does not give it.

The text is known to be valid TOML, so the scanner only follows strings, comments and brackets.
"""

import re
import tomllib
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import replace
from typing import Final

from gradcal_jax.files.problems import Key, SpecError

_KEY_PART: Final = re.compile(r"""\s*(?:"((?:[^"\\]|\\.)*)"|'([^']*)'|([A-Za-z0-9_-]+))\s*(\.?)""")
_BLANK: Final = re.compile(r"(?:[ \t\r\n]|#[^\n]*)*")
_STRING: Final = re.compile(r'"""(?:[^\\]|\\.)*?"{3,5}|\'\'\'.*?\'{3,5}|"(?:[^"\\\n]|\\.)*"|\'[^\'\n]*\'', re.DOTALL)
_PLAIN: Final = re.compile(r"[^,\]}\n#]*")


@contextmanager
def with_lines(text: str) -> Generator[None]:
    """Context that adds the line of its key to every problem of a file read from `text`."""
    try:
        yield
    except SpecError as error:
        if not any(problem.key for problem in error.problems):
            raise  # of the text as a whole, which may be no TOML
        known = lines_of(text)
        raise SpecError((replace(p, line=_nearest_line(known, p.key)) for p in error.problems), error.source) from None


def _nearest_line(known: dict[Key, int], key: Key) -> int | None:
    """The line of the key or, where it is missing, of the innermost table around it."""
    return next((known[key[:n]] for n in range(len(key), 0, -1) if key[:n] in known), None)


def lines_of(text: str) -> dict[Key, int]:
    """The line, from 1, of every key, table and list entry of a valid TOML text."""
    return _Scanner(text.replace("\r\n", "\n")).all()


def _unescaped(text: str) -> str:
    return text if "\\" not in text else next(iter(tomllib.loads(f'"{text}" = 0')))


class _Scanner:
    def __init__(self, text: str) -> None:
        self.text, self.at, self.lines = text, 0, dict[Key, int]()
        self.counts: dict[Key, int] = {}
        self._line, self._counted = 1, 0

    def all(self) -> dict[Key, int]:
        prefix: Key = ()
        while self.blank():
            if self.text[self.at] == "[":
                several = self.text.startswith("[[", self.at)
                self.at += 2 if several else 1
                prefix = self.header(self.key(), several)
                self.at = self.text.index("]", self.at) + (2 if several else 1)
            else:
                self.pair(prefix)
        return self.lines

    def header(self, key: Key, several: bool) -> Key:
        """The path of a header's table, with the number of the last entry of each list of tables."""
        place: Key = ()
        for depth, part in enumerate(key):
            place = (*place, part)
            last = depth == len(key) - 1
            if last and several:
                self.counts[place] = self.counts.get(place, -1) + 1
            self.note(place)
            if place in self.counts and (several or not last):
                place = (*place, self.counts[place])
        self.note(place)
        return place

    def pair(self, prefix: Key) -> None:
        key = (*prefix, *self.key())
        for n in range(len(prefix) + 1, len(key) + 1):
            self.note(key[:n])
        self.at = self.text.index("=", self.at) + 1
        self.value(key)

    def value(self, key: Key) -> None:
        self.blank()
        self.note(key)
        opened = self.text[self.at]
        if opened in "[{":
            self.at += 1
            number = 0
            while self.blank() and self.text[self.at] not in "]}":
                if opened == "[":
                    self.value((*key, number))
                    number += 1
                else:
                    self.pair(key)
                self.blank()
                self.at += self.text[self.at] == ","
            self.at += 1
            return
        match = _STRING.match(self.text, self.at) or _PLAIN.match(self.text, self.at)
        assert match is not None
        self.at = match.end()

    def key(self) -> Key:
        parts: list[str] = []
        while (match := _KEY_PART.match(self.text, self.at)) is not None:
            quoted, literal, bare = match.groups()[:3]
            parts.append(_unescaped(quoted) if quoted is not None else bare if literal is None else literal)
            self.at = match.end()
            if not match.group(4):
                break
        return tuple(parts)

    def blank(self) -> bool:
        """Skip blanks and comments; whether text remains."""
        match = _BLANK.match(self.text, self.at)
        assert match is not None
        self.at = match.end()
        return self.at < len(self.text)

    def note(self, key: Key) -> None:
        self._line += self.text.count("\n", self._counted, self.at)
        self._counted = self.at
        self.lines.setdefault(key, self._line)
