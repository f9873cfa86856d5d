"""Reading a TOML document from a path or a text, with one sentence for a problem of the whole document."""

import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, TypeVar

from pydantic import ValidationError

from gradcal_jax.tables.problems import Problem, SpecError, from_validation, hint
from gradcal_jax.tables.quantity import Text
from gradcal_jax.tables.section import Section

Model = TypeVar("Model", bound=Section)
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


def model_of(kind: type[Model], document: Mapping[str, Any], expected: str, source: str) -> Model:
    """A document of the format `expected` as the model of it. Raises `SpecError` that lists everything wrong; a missing
    or wrong format is the only problem reported."""
    version = document.get("format")
    if version is None:
        message = f'this key is missing; expected "{expected}"{hint("format", document)}'
        raise SpecError([Problem(("format",), message, kind="missing")], source)
    if version != expected:
        of_kind = isinstance(version, str) and version.split("/")[0] == expected.split("/")[0]
        wanted = "this version of the program reads" if of_kind else "expected"
        raise SpecError([Problem(("format",), f'{wanted} "{expected}"', version)], source)
    try:
        return kind.model_validate(document)
    except ValidationError as error:
        raise SpecError(from_validation(error), source) from None


def parsed(kind: type[Model], text: str, expected: str, source: str) -> Model:
    """As `model_of`, for a TOML text."""
    return model_of(kind, read_toml(text, source), expected, source)
