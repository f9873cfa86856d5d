"""Values and tables as plain text: on a terminal, on paper, in a notebook."""

from collections.abc import Sequence


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
