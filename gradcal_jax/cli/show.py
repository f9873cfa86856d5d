"""`gradcal show`: a recipe as a table, for whoever stands at the bench with only the paper in hand."""

from pathlib import Path

from gradcal_jax.cli.console import strong
from gradcal_jax.cli.output import Json
from gradcal_jax.cli.status import DONE


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
    from gradcal_jax.pages.bench_sheet import show as sheet

    found = read_recipe(recipe)
    print(found.model_dump_json(indent=2, exclude_none=True) if json else sheet(found, heading=strong))
    return DONE
