"""One table for terminal, notebook, page and certificate: columns with units, rows of numbers and words."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from textwrap import wrap
from typing import Any, Final, NamedTuple

from gradcal_jax.tables.display import WIDTH

Cell = str | float | None
_ABSENT: Final = "–"
# Columns of fewer letters are not wrapped.
_NARROWEST: Final = 20


class Column(NamedTuple):
    """The name of a column, the unit of its numbers, and their significant digits."""

    name: str
    unit: str = ""
    digits: int = 4

    @property
    def head(self) -> str:
        return f"{self.name}, {self.unit}" if self.unit else self.name


@dataclass(frozen=True)
class Table:
    """Rows of numbers (in the unit of their column) and words; None: there is no such value."""

    columns: tuple[Column, ...]
    rows: tuple[tuple[Cell, ...], ...]

    @classmethod
    def of(cls, heads: Iterable[str | Column], rows: Iterable[Sequence[Cell]]) -> "Table":
        """A table from names of columns (or columns) and rows."""
        columns = tuple(head if isinstance(head, Column) else Column(head) for head in heads)
        return cls(columns, tuple(tuple(row) for row in rows))

    def cells(self) -> list[tuple[str, ...]]:
        """Every row in words."""
        digits = [column.digits for column in self.columns]
        return [tuple(map(cell_text, row, digits)) for row in self.rows]

    def text(self, *, indent: str = "", width: int = WIDTH) -> str:
        """For a terminal: aligned columns, with numbers at the right, without columns that have no words; a last column
        of several words that is too wide is wrapped into further lines."""
        cells = [tuple(column.head for column in self.columns), *self.cells()]
        columns: list[list[str]] = []
        for texts, numeric in zip(zip(*cells, strict=True), self._numeric(), strict=True):
            if self.rows and not any(texts[1:]):
                continue
            size = max(map(len, texts))
            columns.append([text.rjust(size) if numeric else text.ljust(size) for text in texts])
        lines: list[str] = []
        for *before, last in zip(*columns, strict=True):
            start = indent + "".join(f"{text}  " for text in before)
            line = f"{start}{last}".rstrip()
            if len(line) > width >= len(start) + _NARROWEST:
                parts = wrap(last.strip(), width - len(start), break_long_words=False, break_on_hyphens=False)
                line = start + f"\n{' ' * len(start)}".join(parts)
            lines.append(line)
        return "\n".join(lines)

    def html(self) -> str:
        """For a page; on a narrow screen, each cell has the name of its column before it."""
        heads = [escape(column.head) for column in self.columns]
        marks = [' class="number"' if numeric else "" for numeric in self._numeric()]
        lines = ["<table><thead><tr>"]
        lines += [f'<th scope="col"{mark}>{head}</th>' for mark, head in zip(marks, heads, strict=True)]
        lines.append("</tr></thead><tbody>")
        for row in self.cells():
            parts = zip(heads, marks, row, strict=True)
            cells = [f'<td data-label="{head}"{mark}><span>{escape(cell)}</span></td>' for head, mark, cell in parts]
            lines.append(f"<tr>{''.join(cells)}</tr>")
        return "\n".join([*lines, "</tbody></table>"])

    _repr_html_ = html

    def json(self) -> list[dict[str, Any]]:
        """For other programs: an object for each row."""
        names = [column.name for column in self.columns]
        return [dict(zip(names, row, strict=True)) for row in self.rows]

    def _numeric(self) -> list[bool]:
        """Whether each column has only numbers."""
        kinds = [{type(row[k]) for row in self.rows if row[k] is not None} for k in range(len(self.columns))]
        return [set() < kind <= {float, int} for kind in kinds]


def cell_text(cell: Cell, digits: int = 4) -> str:
    """A cell in words: numbers to significant digits, without powers of ten below a million."""
    if cell is None:
        return _ABSENT
    if isinstance(cell, str):
        return cell
    if isinstance(cell, int):
        return str(cell)
    text = f"{cell:.{digits}g}"
    return f"{float(text):.0f}" if "e+" in text and abs(cell) < 1e9 else text
