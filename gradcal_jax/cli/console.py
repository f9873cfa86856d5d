"""Printing: plain text unless a terminal asks for more; answers on stdout, complaints on stderr."""

import os
import sys
from collections.abc import Sequence
from typing import Any

from gradcal_jax.units import time_text as time_text


def is_plain(stream: Any) -> bool:
    """Whether a stream gets text without any escape sequences."""
    if os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb":
        return True
    return not stream.isatty()


def strong(text: str) -> str:
    """Bold on a terminal."""
    return text if is_plain(sys.stdout) else f"\x1b[1m{text}\x1b[0m"


def complain(text: str) -> None:
    """An error's sentence on stderr."""
    mark = "gradcal: " if is_plain(sys.stderr) else "\x1b[1;31mgradcal:\x1b[0m "
    print(mark + text, file=sys.stderr, flush=True)


def amount(value: float | None, unit: str) -> str:
    """A value with its unit, or the words that it cannot be observed."""
    return "not observable" if value is None else f"{value:.4g} {unit}"


def columns(rows: Sequence[Sequence[str]], *, indent: str = "  ", right: Sequence[int] = ()) -> str:
    """Rows as aligned text; the columns numbered in `right` are flush right."""
    if not rows:
        return ""
    widths = [max(len(row[i]) for row in rows if i < len(row)) for i in range(max(len(row) for row in rows))]
    lines: list[str] = []
    for row in rows:
        cells = [cell.rjust(widths[i]) if i in right else cell.ljust(widths[i]) for i, cell in enumerate(row)]
        lines.append((indent + "  ".join(cells)).rstrip())
    return "\n".join(lines)
