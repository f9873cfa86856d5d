"""How objects show themselves: as `repr` at most 15 lines of 80 columns. Imports nothing that takes time, and
computes nothing."""

from collections.abc import Mapping, Sequence
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
    lines = [cut(line) for text in lines for line in text.split("\n")]
    if len(lines) > LINES:
        lines = [*lines[: LINES - 1], f"… {len(lines) - LINES + 1} more lines"]
    return lines


def cut(text: str, width: int = WIDTH) -> str:
    """The text, of at most `width` letters."""
    return text if len(text) <= width else text[: width - 1] + "…"


def _listing(value: object) -> list[str]:
    """Class and fields: on one line, or else a line for each field."""
    name, fields = type(value).__name__, _fields(value)
    whole = f"{name}({', '.join(f'{key}={_brief(entry)}' for key, entry in fields.items())})"
    if len(whole) <= WIDTH:
        return [whole]
    title = fields.pop("title", None)
    margin = max((len(key) for key in fields), default=0)
    rows = [f"  {key:<{margin}}  {_brief(entry)}" for key, entry in fields.items()]
    return [name if title is None else f"{name}: {title}", *rows]


def _fields(value: Any) -> dict[str, Any]:
    """The public fields of a named tuple, a dataclass or a model that are not empty; of a model those that were set."""
    kind: Any = type(value)
    names = getattr(kind, "__dataclass_fields__", None) or getattr(kind, "_fields", None)
    names = names or [name for name in kind.model_fields if name in value.model_fields_set]
    entries = {name: getattr(value, name) for name in names if not name.startswith("_")}
    empty = (None, "", (), [], {})
    return {name: entry for name, entry in entries.items() if hasattr(entry, "shape") or entry not in empty}


def _brief(value: Any) -> str:
    """A value in less than a line."""
    if isinstance(value, float):
        return getattr(value, "text", None) or f"{float(value):.6g}"
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        return f"{value.dtype}[{', '.join(map(str, value.shape))}]"
    if isinstance(value, Mapping | Sequence) and not isinstance(value, str | bytes):
        if len(value) > _FEW:
            return f"{len(value)} entries"
        return cut(f"({', '.join(_brief(entry) for entry in value)})")
    if value is None or isinstance(value, bool | int | complex | bytes | str):
        return cut(repr(value))
    return getattr(value, "name", None) or getattr(value, "__qualname__", None) or type(value).__name__
