"""How objects show themselves: as `repr` at most 15 lines of 80 columns, Imports nothing
that takes time, and computes nothing."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from enum import Enum
from importlib import import_module
from pathlib import PurePath
from textwrap import wrap
from typing import Any, Final
from unicodedata import category

WIDTH: Final = 80
LINES: Final = 15
_NARROWEST: Final = 20
# Longest sequence whose entries are shown, and the columns for the value of a key within a value.
_FEW, _INNER = 6, 24


def printable(text: str) -> str:
    """A text of a file as it may be shown: control characters, except ends of lines and tabs, become "?"."""
    return "".join("?" if category(letter) == "Cc" and letter not in "\n\t" else letter for letter in text)


def summary(self: object) -> str:
    """The `__repr__` of a class: the lines of its `_shown`, or else its fields that have a value."""
    shown = getattr(self, "_shown", None)
    return "\n".join(_fitted(_listing(self) if shown is None else shown()))


def whole_text(self: object) -> str:
    """The `__str__` of a recipe: the whole sheet that `gradcal check` prints."""
    return import_module("gradcal_jax.pages.bench_sheet").show(self)


def amount(value: float | None, unit: str) -> str:
    """A value with its unit, or the words that it cannot be observed."""
    return "not observable" if value is None else f"{value:.4g} {unit}"


def columns(rows: Sequence[Sequence[str]], *, indent: str = "  ", right: Sequence[int] = (), width: int = WIDTH) -> str:
    """Rows as aligned text; the columns numbered in `right` are flush right.

    Where a row is wider than `width`, its last column, if it has several words, is wrapped into further lines.
    """
    if not rows:
        return ""
    widths = [max(len(row[i]) for row in rows if i < len(row)) for i in range(max(len(row) for row in rows))]
    before = len(indent) + sum(widths[:-1]) + 2 * (len(widths) - 1)
    lines: list[str] = []
    for row in rows:
        parts = [row[-1]]
        if len(row) == len(widths) > 1 and before + len(row[-1]) > width and width - before >= _NARROWEST:
            parts = wrap(row[-1], width - before, break_long_words=False, break_on_hyphens=False) or [""]
        for k, part in enumerate(parts):
            texts = [*(row[:-1] if k == 0 else [""] * (len(row) - 1)), part]
            cells = [cell.rjust(widths[i]) if i in right else cell.ljust(widths[i]) for i, cell in enumerate(texts)]
            lines.append((indent + "  ".join(cells)).rstrip())
    return "\n".join(lines)


def _fitted(lines: Sequence[str]) -> list[str]:
    lines = [_cut(line) for text in lines for line in text.split("\n")]
    if len(lines) > LINES:
        lines = [*lines[: LINES - 1], f"… {len(lines) - LINES + 1} more lines"]
    return lines


def _cut(text: str, width: int = WIDTH) -> str:
    return text if len(text) <= width else text[: width - 1] + "…"


def _listing(value: object) -> list[str]:
    """Class and fields: on one line, or else a line for each field."""
    name = type(value).__name__
    fields = dict(_fields(value))
    whole = f"{name}({_arguments(fields, WIDTH)})"
    if len(whole) <= WIDTH:
        return [whole]
    title = fields.pop("title", None)
    margin = max((len(key) for key in fields), default=0) + 4
    rows = [f"  {key:<{margin - 2}}{_brief(entry, WIDTH - margin)}" for key, entry in fields.items()]
    if len(rows) >= LINES:
        others = ", ".join(list(fields)[LINES - 2 :])
        rows = [*rows[: LINES - 2], f"  and {others}"]
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


def _has_fields(value: object) -> bool:
    kind = type(value)
    return dataclasses.is_dataclass(kind) or hasattr(kind, "model_fields") or hasattr(kind, "_fields")


def _arguments(fields: Mapping[str, Any], width: int) -> str:
    return ", ".join(f"{key}={_brief(entry, width)}" for key, entry in fields.items())


def _brief(value: Any, width: int) -> str:
    """A value in at most `width` columns."""
    return _cut(_text(value, width), width)


def _text(value: Any, width: int) -> str:
    if isinstance(value, Enum):
        return value.name
    if isinstance(value, str):
        first, *more = value.splitlines() or [""]
        return f"{_cut(repr(first), width - 12)} ({len(more) + 1} lines)" if more else repr(value)
    if isinstance(value, float):
        return getattr(value, "text", None) or f"{float(value):.6g}"
    if value is None or isinstance(value, bool | int | complex | bytes):
        return repr(value)
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        return _array(value)
    if _has_fields(value):
        return f"{type(value).__name__}({_arguments(dict(_fields(value)), _INNER)})"
    if isinstance(value, Mapping):
        return _mapping(value, width)
    if isinstance(value, Sequence):
        return _sequence(value, width)
    if isinstance(value, PurePath):
        return str(value)
    return getattr(value, "__qualname__", None) or f"<{type(value).__name__}>"


def _array(value: Any) -> str:
    shape = tuple(value.shape)
    if type(value).__module__ == "numpy" and len(shape) <= 1 and value.size <= _FEW and value.dtype.kind in "biuf":
        texts = [f"{number:.6g}" for number in value.ravel().tolist()]
        return texts[0] if shape == () else f"[{', '.join(texts)}]"
    return f"{value.dtype}[{', '.join(map(str, shape))}]"


def _mapping(value: Mapping[Any, Any], width: int) -> str:
    if len(value) <= _FEW:
        text = ", ".join(f"{key}: {_brief(entry, _INNER)}" for key, entry in value.items())
        if len(text) + 2 <= width:
            return f"{{{text}}}"
    return f"{len(value)} entries: {', '.join(str(key) for key, _ in zip(value, range(_FEW + 2), strict=False))}"


def _sequence(value: Sequence[Any], width: int) -> str:
    if len(value) <= _FEW:
        text = ", ".join(_brief(entry, width) for entry in value)
        if len(text) + 2 <= width:
            return f"({text})"
    names = [getattr(entry, "name", None) for entry in value[: _FEW + 2]]
    what = f"{len(value)} × {type(value[0]).__name__}" if value else "none"
    return f"{what}: {', '.join(map(str, names))}" if all(isinstance(name, str) for name in names) else what
