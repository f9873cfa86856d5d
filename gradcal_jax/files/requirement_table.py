"""Requirements as a table: what a plan is predicted to leave, or an estimate leaves."""

from collections.abc import Sequence

from gradcal_jax.display import WIDTH, amount, columns
from gradcal_jax.files.contracts import RequirementRow


def requirement_table(rows: Sequence[RequirementRow], names: Sequence[str] | None = None) -> list[tuple[str, ...]]:
    """A row for each requirement after a head; "as named", by the terms of the spec alone, only where it differs.

    `names`: of the rows, instead of the requirement's name and, where there are several, its axis.
    """
    several = len({row.axis for row in rows} & {"x", "y", "z"}) > 1
    head = ("requirement", "statistic", "residual 1σ", "as named", "at worst", "target", "verdict")
    names = names or [f"{row.name}, axis {row.axis}" if several else row.name for row in rows]
    shown = [head, *(_row(name, row) for name, row in zip(names, rows, strict=True))]
    if all(row.judged == row.decisive for row in rows):
        return [(*cells[:3], *cells[4:]) for cells in shown]
    return shown


def narrow_table(rows: Sequence[RequirementRow]) -> str:
    """The table as text, without the columns that matter least if it is too wide otherwise."""
    table = requirement_table(rows) if rows else [("no requirement",)]
    for least in ("as named", "at worst", "statistic"):
        text = columns(table, indent="")
        if max(map(len, text.splitlines())) > WIDTH and least in table[0]:
            at = table[0].index(least)
            table = [(*cells[:at], *cells[at + 1 :]) for cells in table]
    return columns(table, indent="")


def _row(name: str, row: RequirementRow) -> tuple[str, ...]:
    left = amount(row.judged, row.unit)
    if row.uncertain is not None:
        left += f" ({row.uncertain[0]:.4g} … {row.uncertain[1]:.4g})"
    target = "" if row.target is None else amount(row.target, row.unit)
    worst = "" if row.worst is None else amount(row.worst, row.unit)
    return (name, row.statistic, left, amount(row.decisive, "").strip(), worst, target, row.verdict or "")
