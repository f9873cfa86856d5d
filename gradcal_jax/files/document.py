"""Reading a TOML document from a path or a text, with one sentence for a problem of the whole document."""

import tomllib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError

from gradcal_jax.files.lines import with_lines
from gradcal_jax.files.problems import Problem, SpecError, from_validation, hint
from gradcal_jax.files.quantity import Text
from gradcal_jax.files.section import Section

Model = TypeVar("Model", bound=Section)
Result = TypeVar("Result")
_LARGEST = 20_000_000


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
            raise SpecError([Problem((), f"is a directory; give a {what}")], name)
        if path.stat().st_size > _LARGEST:
            raise SpecError([Problem((), f"is larger than {_LARGEST // 1_000_000} MB; give a {what}")], name)
        raw = path.read_bytes()
    except SpecError:
        raise
    except FileNotFoundError:
        raise SpecError([Problem((), "does not exist" + _neighbour(path))], name) from None
    except OSError as error:
        raise SpecError([Problem((), f"cannot be read: {error.strerror or error}")], name) from None
    except ValueError:
        raise SpecError([Problem((), "is not a path that can exist")], repr(name)) from None
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise SpecError([Problem((), f"is not text in UTF-8; give a {what}")], name) from None


def _neighbour(path: Path) -> str:
    try:
        names = [entry.name for entry in path.parent.iterdir() if entry.suffix == (path.suffix or ".toml")]
    except (OSError, ValueError):
        return ""
    return hint(path.name, names)


def read_toml(text: str, source: str = "") -> dict[str, Any]:
    """The tables of a TOML text. Raises `SpecError` with line and column."""
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


def model_of(
    kind: type[Model],
    document: Mapping[str, Any],
    expected: str,
    source: str,
    further: Callable[[list[Problem]], Sequence[Problem]] | None = None,
) -> Model:
    """A document of the format `expected` as the model of it. Raises `SpecError` that lists everything wrong.

    A wrong kind or version of file is the only problem reported. With `further`, which adds to the list of problems,
    this is so for a wrong `format`; without it, for a missing one, too.
    """
    problem = format_problem(document, expected)
    if problem is not None and (further is None or isinstance(document.get("format"), str)):
        raise SpecError([problem], source)
    try:
        return kind.model_validate(document)
    except ValidationError as error:
        problems = [p for p in from_validation(error) if p.key != ("format",)]
    if problem is not None:
        problems.insert(0, problem)
    raise SpecError([*problems, *(further(problems) if further else ())], source)


def parsed(kind: type[Model], text: str, expected: str, source: str) -> Model:
    """As `model_of`, for a TOML text; problems have the number of their line."""
    return from_text(lambda document, _: model_of(kind, document, expected, source), text, source)


def from_text(of: Callable[[dict[str, Any], str], Result], text: str, source: str) -> Result:
    """The result of `of` for the tables of a TOML text; problems have the number of their line."""
    with with_lines(text):
        return of(read_toml(text, source), source)
