"""Reading a TOML document from a path or a text, with one sentence for a problem of the whole document.

**The line of each key**, for error messages, is found by a scanner of our own (`tomllib` does not give it). The text is
known to be valid TOML, so that it only follows strings, comments and brackets.
"""

import re
import tomllib
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, TypeVar

from pydantic import ValidationError

from gradcal_jax.tables.problems import Key, Problem, SpecError, from_validation, hint
from gradcal_jax.tables.quantity import Text
from gradcal_jax.tables.section import Section

Model = TypeVar("Model", bound=Section)
Result = TypeVar("Result")
_LARGEST = 20_000_000
_MOST_PARTS = 50
_PART = r"(?:[\w-]++|\"[^\"\n]*+\"|'[^'\n]*+')"
_LONG_KEY: Final = re.compile(rf"(?<![\w-]){_PART}(?:[ \t]*+\.[ \t]*+{_PART}){{{_MOST_PARTS}}}")


class TitledFile(Section):
    """A whole file: its format, and a name for people."""

    format: Any
    """Name and version of this file format."""
    title: Text | None = None
    """A title for tables and pages."""


def read_text(path: str | Path, what: str = "TOML file") -> str:
    """The text of a file. Raises `SpecError` where there is none: missing, a directory, unreadable, not text."""
    path = Path(path)
    name = str(path)
    try:
        if path.is_dir():
            problem = f"is a directory; expected a {what}"
        elif path.stat().st_size > _LARGEST:
            problem = f"is larger than {_LARGEST // 1_000_000} MB; expected a {what}"
        else:
            return path.read_bytes().decode("utf-8-sig")
    except FileNotFoundError:
        problem = "does not exist" + _neighbour(path)
    except OSError as error:
        problem = f"cannot be read: {error.strerror or error}"
    except UnicodeDecodeError:
        problem = f"is not text in UTF-8; expected a {what}"
    except ValueError:
        name, problem = repr(name), "is not a possible path"
    raise SpecError([Problem((), problem)], name)


def _neighbour(path: Path) -> str:
    try:
        names = [entry.name for entry in path.parent.iterdir() if entry.suffix == (path.suffix or ".toml")]
    except (OSError, ValueError):
        return ""
    return hint(path.name, names)


def read_toml(text: str, source: str = "") -> dict[str, Any]:
    """The tables of a TOML text. Raises `SpecError` with line and column."""
    if _LONG_KEY.search(text):
        raise SpecError([Problem((), f"has a key of more than {_MOST_PARTS} parts")], source)
    try:
        return tomllib.loads(text.replace("\r\n", "\n"))
    except (tomllib.TOMLDecodeError, RecursionError, ValueError) as error:
        reason = "the brackets nest too deeply" if isinstance(error, RecursionError) else str(error)
        raise SpecError([Problem((), f"is not valid TOML: {reason}")], source) from None


def format_problem(document: Mapping[str, Any], expected: str) -> Problem | None:
    """The problem of the `format` key, if there is one."""
    if "format" not in document:
        return Problem(("format",), f'this key is missing; expected "{expected}"', kind="missing")
    version = document["format"]
    if version == expected:
        return None
    of_kind = isinstance(version, str) and version.split("/")[0] == expected.split("/")[0]
    wanted = "this version of the program reads" if of_kind else "expected"
    return Problem(("format",), f'{wanted} "{expected}"', version)


def model_of(kind: type[Model], document: Mapping[str, Any], expected: str, source: str) -> Model:
    """A document of the format `expected` as the model of it. Raises `SpecError` that lists everything wrong; a missing
    or wrong format is the only problem reported."""
    problem = format_problem(document, expected)
    if problem is not None:
        raise SpecError([problem], source)
    try:
        return kind.model_validate(document)
    except ValidationError as error:
        raise SpecError(from_validation(error), source) from None


def parsed(kind: type[Model], text: str, expected: str, source: str) -> Model:
    """As `model_of`, for a TOML text; problems have the number of their line."""
    return from_text(lambda document, _: model_of(kind, document, expected, source), text, source)


def from_text(of: Callable[[dict[str, Any], str], Result], text: str, source: str) -> Result:
    """The result of `of` for the tables of a TOML text; problems have the number of their line."""
    with with_lines(text):
        return of(read_toml(text, source), source)


_KEY_PART: Final = re.compile(r"""\s*("(?:[^"\\]|\\.)*"|'[^']*'|[A-Za-z0-9_-]+)\s*(\.?)""")
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

        def line(key: Key) -> int | None:
            """The line of the key or, where it is missing, of the innermost table around it."""
            return next((known[key[:n]] for n in range(len(key), 0, -1) if key[:n] in known), None)

        raise SpecError((replace(p, line=line(p.key)) for p in error.problems), error.source) from None


def lines_of(text: str) -> dict[Key, int]:
    """The line, from 1, of every key, table and list entry of a valid TOML text."""
    return _Scanner(text.replace("\r\n", "\n")).all()


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
        opened, number = self.text[self.at], 0
        if opened not in "[{":
            self.skip(_STRING)
            self.skip(_PLAIN)
            return
        self.at += 1
        while self.blank() and self.text[self.at] not in "]}":
            if opened == "[":
                self.value((*key, number))
                number += 1
            else:
                self.pair(key)
            self.blank()
            self.at += self.text[self.at] == ","
        self.at += 1

    def key(self) -> Key:
        parts: list[str] = []
        more = "."
        while more and (match := _KEY_PART.match(self.text, self.at)) is not None:
            part, more = match.groups()
            parts += tomllib.loads(f"{part} = 0") if part[0] in "\"'" else [part]
            self.at = match.end()
        return tuple(parts)

    def blank(self) -> bool:
        """Skip blanks and comments; whether text remains."""
        self.skip(_BLANK)
        return self.at < len(self.text)

    def skip(self, pattern: re.Pattern[str]) -> None:
        match = pattern.match(self.text, self.at)
        self.at = self.at if match is None else match.end()

    def note(self, key: Key) -> None:
        self._line += self.text.count("\n", self._counted, self.at)
        self._counted = self.at
        self.lines.setdefault(key, self._line)
