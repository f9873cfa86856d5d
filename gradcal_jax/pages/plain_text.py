"""Values and tables as plain text: on a terminal, on paper, in a notebook."""

from collections.abc import Sequence
from textwrap import wrap
from typing import Final

from gradcal_jax.units import time_text

WIDTH: Final = 80
_NARROWEST: Final = 20


def amount(value: float | None, unit: str) -> str:
    """A value with its unit, or the words that it cannot be observed."""
    return "not observable" if value is None else f"{value:.4g} {unit}"


def times_text(duration_s: float, soak_s: float, motion_s: float, motion: str = "motion") -> str:
    """Durations of a plan, its soaks and its motion."""
    return f"{time_text(duration_s)} in all: soak {time_text(soak_s)}, {motion} {time_text(motion_s)}"


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
