"""A recipe as plain text, for the operator at the bench."""

from collections.abc import Callable

from gradcal_jax.recipe.bench_tables import (
    CHAMBER_HEAD,
    MOVES_HEAD,
    block_heading,
    chamber_rows,
    chamber_words,
    move_rows,
)
from gradcal_jax.recipe.recipe import Recipe
from gradcal_jax.tables.contracts import outcomes
from gradcal_jax.tables.problems import dotted, leaves
from gradcal_jax.tables.table import Column, Table


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
    lines += ["", heading("Chamber"), Table.of(CHAMBER_HEAD, chamber_rows(recipe)).text(indent="  ")]
    lines += [*(f"  {line}" for line in chamber_words(recipe)), ""]
    for block in recipe.motion:
        lines += [] if block.hang is None else [f"mount the IMU as follows: {block.hang}"]
        lines += [
            heading("Table, " + block_heading(block)),
            Table.of(MOVES_HEAD, move_rows(block)).text(indent="  "),
            "",
        ]
    lines += [heading("What it leaves (1σ)"), outcomes(recipe.prediction.requirements).text(indent="  ")]
    lines += [f"note: {warning}" for warning in recipe.prediction.warnings]
    if recipe.optimisation is not None:
        figures = [
            (dotted(key), value if isinstance(value, float) else str(value))
            for key, value in leaves(recipe.optimisation)
        ]
        lines += ["", heading("Optimisation"), Table.of(["figure", Column("value", "", 6)], figures).text(indent="  ")]
    if recipe.rounded:
        lines += ["", heading("Rounded to the controllers' steps"), *(f"  {change}" for change in recipe.rounded)]
    return "\n".join(lines)
