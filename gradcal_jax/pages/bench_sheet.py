"""A recipe as plain text, for the operator at the bench."""

from collections.abc import Callable
from typing import Any

from gradcal_jax.recipe.bench_tables import (
    CHAMBER_HEAD,
    MOVES_HEAD,
    block_heading,
    chamber_rows,
    chamber_words,
    move_rows,
)
from gradcal_jax.recipe.recipe import Recipe
from gradcal_jax.tables.display import amount, columns


def show(recipe: Recipe, *, heading: Callable[[str], str] = str) -> str:
    """A recipe as a table in plain text: the steps of the chamber, those of the table, and the predicted residuals.

    Every step with its time (h:min:s on the plan's clock), temperature (°C), angle (deg) and rate (deg/s) as the
    controllers take them, then the residual of every requirement (ppm or deg/h, 1σ) and the changes by rounding.
    `heading` formats headings, as the command does on a terminal.

    Errors: none; `read_recipe` has validated the recipe.
    """
    lines = [heading(recipe.title or "recipe")]
    lines += [f"{recipe.made.by}; {recipe.status}", f"recipe {recipe.fingerprint[:12]}"]
    lines += [f"note: {note}" for note in recipe.notes]
    lines += ["", heading("Chamber"), columns([CHAMBER_HEAD, *chamber_rows(recipe)])]
    lines += [*(f"  {line}" for line in chamber_words(recipe)), ""]
    for block in recipe.motion:
        lines += [] if block.hang is None else [f"mount the IMU as follows: {block.hang}"]
        lines += [heading("Table, " + block_heading(block)), columns([MOVES_HEAD, *move_rows(block)]), ""]
    left: list[tuple[str, ...]] = []
    for row in recipe.prediction.requirements:
        target = "" if row.target is None else f"target {amount(row.target, row.unit)}: {row.verdict}"
        value = amount(row.judged, row.unit)
        left.append((row.name, f"axis {row.axis}", row.statistic, value, target, row.limited_by or ""))
    lines += [heading("What it leaves (1σ)"), columns(left)]
    lines += [f"note: {warning}" for warning in recipe.prediction.warnings]
    if recipe.optimisation is not None:
        lines += ["", heading("Optimisation"), *_free(recipe.optimisation, "  ")]
    if recipe.rounded:
        lines += ["", heading("Rounded to the controllers' steps"), *(f"  {change}" for change in recipe.rounded)]
    return "\n".join(lines)


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
