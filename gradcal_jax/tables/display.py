"""How objects show themselves: as `repr` at most 15 lines of 80 columns. Imports nothing that takes time, and
computes nothing."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final
from unicodedata import category

WIDTH: Final = 80
LINES: Final = 15
# Longest sequence whose entries are shown.
_FEW: Final = 6


def printable(text: str) -> str:
    """A text of a file as it may be shown: control characters, except ends of lines and tabs, become "?"."""
    return "".join("?" if category(letter) == "Cc" and letter not in "\n\t" else letter for letter in text)


def summary(self: object) -> str:
    """The `__repr__` of a class: the lines of its `_shown`, or else its fields that have a value."""
    shown = getattr(self, "_shown", None)
    return "\n".join(_fitted(_listing(self) if shown is None else shown()))


def amount(value: float | None, unit: str) -> str:
    """A value with its unit, or the words that it cannot be observed."""
    return "not observable" if value is None else f"{value:.4g} {unit}"


def _fitted(lines: Sequence[str]) -> list[str]:
    lines = [_cut(line) for text in lines for line in text.split("\n")]
    if len(lines) > LINES:
        lines = [*lines[: LINES - 1], f"… {len(lines) - LINES + 1} more lines"]
    return lines


def _cut(text: str, width: int = WIDTH) -> str:
    return text if len(text) <= width else text[: width - 1] + "…"


def _listing(value: object) -> list[str]:
    """Class and fields: on one line, or else a line for each field."""
    name, fields = type(value).__name__, dict(_fields(value))
    whole = f"{name}({', '.join(f'{key}={_brief(entry)}' for key, entry in fields.items())})"
    if len(whole) <= WIDTH:
        return [whole]
    title = fields.pop("title", None)
    margin = max((len(key) for key in fields), default=0)
    rows = [f"  {key:<{margin}}  {_brief(entry)}" for key, entry in fields.items()]
    return [name if title is None else f"{name}: {title}", *rows]


def _fields(value: object) -> Iterator[tuple[str, Any]]:
    """The public fields of a named tuple, a dataclass or a model, except those that are empty, and the numbers and
    texts that equal the default of a model."""
    kind: Any = type(value)
    model = getattr(kind, "model_fields", {})
    names = getattr(kind, "_fields", None) or model or [field.name for field in dataclasses.fields(kind)]
    for name in names:
        entry = getattr(value, name)
        absent = entry is None or (isinstance(entry, str | tuple | list | dict) and not entry)
        if not absent and name in model and isinstance(entry, str | float | int):
            absent = entry == model[name].default
        if not absent and not name.startswith("_"):
            yield name, entry


def _brief(value: Any) -> str:
    """A value in less than a line."""
    if isinstance(value, float):
        return getattr(value, "text", None) or f"{float(value):.6g}"
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        return f"{value.dtype}[{', '.join(map(str, value.shape))}]"
    if isinstance(value, Mapping | Sequence) and not isinstance(value, str | bytes):
        if len(value) > _FEW:
            return f"{len(value)} entries"
        return _cut(f"({', '.join(_brief(entry) for entry in value)})")
    if value is None or isinstance(value, bool | int | complex | bytes | str):
        return _cut(repr(value))
    return getattr(value, "name", None) or getattr(value, "__qualname__", None) or type(value).__name__
