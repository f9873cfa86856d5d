"""`gradcal show`: a recipe as a table, for whoever stands at the bench with only the paper in hand."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from cyclopts import App

from gradcal_jax.cli.console import amount, columns, strong
from gradcal_jax.cli.output import Json
from gradcal_jax.cli.status import DONE

if TYPE_CHECKING:
    from gradcal_jax.files.contracts import RequirementRow
    from gradcal_jax.files.recipe import Recipe


def register(app: App) -> None:
    """Add the commands of this family."""
    app.command(show)


def show(recipe: Path, /, *, json: Json = False) -> int:
    """Print a recipe as a table: what the chamber does, what the table does, and what it will leave.

    Parameters
    ----------
    recipe
        The recipe file.
    json
        Print it as JSON instead.
    """
    from gradcal_jax.files.recipe import read_recipe

    found = read_recipe(recipe)
    print(found.model_dump_json(indent=2, exclude_none=True) if json else text(found, str(recipe)))
    return DONE


def text(recipe: "Recipe", name: str) -> str:
    """The whole table."""
    from gradcal_jax.files.bench_tables import (
        CHAMBER_HEAD,
        MOVES_HEAD,
        block_heading,
        chamber_rows,
        chamber_words,
        move_rows,
    )

    lines = [strong(recipe.title or name)]
    lines += [f"{recipe.made.by}; {recipe.status}", f"recipe {recipe.fingerprint[:12]}"]
    lines += [f"note: {note}" for note in recipe.notes]
    lines += ["", strong("Chamber"), columns([CHAMBER_HEAD, *chamber_rows(recipe)])]
    lines += [*(f"  {said}" for said in chamber_words(recipe)), ""]
    for block in recipe.motion:
        lines += [strong("Table, " + block_heading(block)), columns([MOVES_HEAD, *move_rows(block)]), ""]
    lines += [strong("What it leaves (1σ)"), columns([_left(row) for row in recipe.prediction.requirements])]
    lines += [f"note: {warning}" for warning in recipe.prediction.warnings]
    if recipe.optimisation is not None:
        lines += ["", strong("Optimisation"), *_free(recipe.optimisation, "  ")]
    if recipe.rounded:
        lines += ["", strong("Rounded to the controllers' steps"), *(f"  {change}" for change in recipe.rounded)]
    return "\n".join(lines)


def _left(row: "RequirementRow") -> tuple[str, ...]:
    target = "" if row.target is None else f"target {amount(row.target, row.unit)}: {row.verdict}"
    left = amount(row.decisive, row.unit)
    return (row.name, f"axis {row.axis}", row.statistic, left, target, row.limited_by or "")


def _free(table: dict[str, Any], indent: str) -> list[str]:
    lines: list[str] = []
    for name, entry in table.items():
        if isinstance(entry, dict):
            lines += [f"{indent}{name}:", *_free(entry, indent + "  ")]
        elif isinstance(entry, list) and entry and isinstance(entry[0], dict):
            rows = [tuple(f"{key} {_short(value)}" for key, value in row.items()) for row in entry]
            lines += [f"{indent}{name}:", columns(rows, indent=indent + "  ")]
        else:
            lines.append(f"{indent}{name}: {_short(entry)}")
    return lines


def _short(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list):
        return ", ".join(_short(entry) for entry in value)
    return str(value)
