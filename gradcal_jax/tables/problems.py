"""Problems of a file: all at once, each with its key, its value and the expected value."""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from gradcal_jax.tables.display import cut
from gradcal_jax.units.spelling import nearest

Key = tuple[str | int, ...]

_SHOWN: Final = 60
# Of the faults of one file, and of the letters of a key.
_MOST: Final = 30
_LONGEST: Final = 120
_PART: Final = re.compile(r"(?:^|\.)([A-Za-z_][A-Za-z0-9_-]*)|\[([0-9]{1,9})\]")


class _Absent:
    def __repr__(self) -> str:
        return "absent"


ABSENT: Final = _Absent()
"""The value of a problem of an absent key, or of several keys together."""


@dataclass(frozen=True)
class Problem:
    """One fault. `key` is the path (names and list positions), `value` the file's value there (or `ABSENT`)."""

    key: Key
    message: str
    value: object = ABSENT
    kind: str = "value"

    @property
    def dotted(self) -> str:
        """The key as text: ``plan.cycle.moves[2].peak_rate``."""
        return dotted(self.key)

    def under(self, *prefix: str | int) -> "Problem":
        """The same problem, with its key relative to an outer table."""
        return replace(self, key=(*prefix, *self.key))

    def __str__(self) -> str:
        where = cut(self.dotted, _LONGEST)
        if where and self.value is not ABSENT:
            where += f" = {shown(self.value)}"
        return f"{where}: {self.message}" if where else self.message


class SpecError(ValueError):
    """A file that cannot be used. `problems` lists every fault; the message has them all, one a line.

    A `ValueError`. Each `Problem` has the key, the value with the unit of the file, and the expected value.
    Errors: none.
    """

    def __init__(self, problems: Iterable[Problem], source: str = "") -> None:
        unique = {str(problem): problem for problem in problems}
        self.problems = tuple(unique.values())
        count, lines = len(unique), list(unique)
        if count != 1:
            lines = [f"{count} problems", *lines[:_MOST]]
        if count > _MOST:
            lines.append(f"… and {count - _MOST} more")
        text = "\n  ".join(lines)
        super().__init__(f"{source}: {text}" if source else text)


def dotted(key: Key) -> str:
    """``("moves", 2, "peak_rate")`` -> ``moves[2].peak_rate``."""
    text = ""
    for part in key:
        text += f"[{part}]" if isinstance(part, int) else (f".{part}" if text else part)
    return text


def split_key(text: str) -> Key:
    """``"plan.cycle.moves[2].rest"`` -> ``("plan", "cycle", "moves", 2, "rest")``. Raises `ValueError`."""
    found = _PART.finditer(text)
    parts = tuple(int(part[2]) if part[1] is None else part[1] for part in found)
    if not parts or isinstance(parts[0], int) or dotted(parts) != text:
        raise ValueError(f"'{text}' is not a key; expected one such as 'plan.gradient'")
    return parts


def shown(value: object) -> str:
    """A value of the file, short enough for a line."""
    if isinstance(value, Mapping):
        return "{…}" if value else "{}"
    if isinstance(value, bool):
        text = "true" if value else "false"
    elif isinstance(value, str):
        text = '"' + "".join(c if c.isprintable() else "?" for c in value) + '"'
    else:
        text = str(value)
    return cut(text, _SHOWN)


def hint(word: object, known: Iterable[str], otherwise: str = "") -> str:
    """``; nearest: "gyro_x"``, or `otherwise` where nothing is near."""
    close = nearest(word, known) if isinstance(word, str) else None
    return otherwise if close is None else f'; nearest: "{close}"'


def repeated_names(of: str, name: str, values: Sequence[str], message: str) -> list[Problem]:
    """A problem for the `name` of every entry `of` which has the value of one before it."""
    return [Problem((of, i, name), message, value) for i, value in enumerate(values) if value in values[:i]]


def instead(word: str, known: Iterable[str]) -> str:
    """``nearest: 'gyro_x'``, or what there is."""
    names = list(known)
    if (close := nearest(word, names)) is not None:
        return f"nearest: '{close}'"
    return f"there are: {', '.join(names[:12])}" + (", …" if len(names) > 12 else "") if names else "there are none"


def one_of(known: Iterable[str]) -> str:
    """``"a", "b" or "c"``."""
    *most, last = (f'"{name}"' for name in known)
    return ", ".join(most) + " or " * bool(most) + last


def from_validation(error: ValidationError) -> list[Problem]:
    """All problems of pydantic's error, including nested `SpecError`s, in this program's words."""
    problems = [problem for details in error.errors(include_url=False) for problem in _translate(details)]
    # A list of which every entry was refused is also "too short": that is no fault of its own.
    above = {other.key[:n] for other in problems for n in range(len(other.key))}
    return [p for p in problems if p.kind != "short" or p.key not in above]


# Pydantic's kinds of error -> the expected value, in this program's words; the braces take the error's context.
_EXPECTED: Final[Mapping[str, str]] = {
    "string_type": "expected text in quotes",
    "int_type": "expected a whole number",
    "int_from_float": "expected a whole number",
    "int_parsing_size": "this number is too large",
    "float_type": "expected a number without unit",
    "finite_number": "expected a finite number",
    "bool_type": "expected true or false",
    "list_type": "expected a list",
    "tuple_type": "expected a list",
    "dict_type": "expected a table",
    "model_type": "expected a table",
    "model_attributes_type": "expected a table",
    "greater_than": "must be above {gt}",
    "greater_than_equal": "must be at least {ge}",
    "less_than": "must be below {lt}",
    "less_than_equal": "must be at most {le}",
    "too_short": "expected at least {min_length} entries, found {actual_length}",
    "too_long": "expected at most {max_length} entries, found {actual_length}",
    "string_too_short": "must not be empty",
    "string_too_long": "the text is too long",
    "missing": "this key is missing",
    "extra_forbidden": "this key is unknown",
}


_KINDS: Final = {"missing": "missing", "extra_forbidden": "unknown", "too_short": "short"}


def _translate(details: ErrorDetails) -> list[Problem]:
    # Of a key with several forms, pydantic names the form that it has tried ("<each>"), which is no key of the file.
    key: Key = tuple(part for part in details["loc"] if not str(part).startswith("<"))
    value, kind, context = details["input"], details["type"], details.get("ctx") or {}
    inner = context.get("error")
    if isinstance(inner, ValidationError):
        inner = SpecError(from_validation(inner))
    if isinstance(inner, SpecError):
        return [problem.under(*key) for problem in inner.problems]
    if kind == "literal_error":
        message = _enumeration(value, str(context.get("expected", "")))
    else:
        message = str(inner) if isinstance(inner, ValueError) else _EXPECTED.get(kind, details["msg"])
    if kind in _EXPECTED:
        message = message.format(**context)
    return [Problem(key, message, ABSENT if kind == "missing" else value, _KINDS.get(kind, "value"))]


def _enumeration(value: object, expected: str) -> str:
    # pydantic gives "'a', 'b' or 'c'"
    names = expected.split("'")[1::2]
    listed = f"expected {one_of(names)}" if names else f"expected {expected}"
    return listed + (hint(value, names) if len(names) > 1 else "")
