"""The log of a journal's records, without the folder of a run."""

import contextlib

from gradcal_jax.hardware.journal import JournalContents
from gradcal_jax.recipe.recipe import Recipe
from gradcal_jax.records.log import Log
from gradcal_jax.records.run_log import _of_unit
from gradcal_jax.spec.rig import RigFile


def log_of(contents: JournalContents, recipe: Recipe, rig: RigFile, unit: str | None = None) -> Log:
    """The log of one IMU (by name; None: the rig's only one), decoded with the configuration in the journal."""
    with contextlib.ExitStack() as stack:
        return _of_unit(stack, None, contents, recipe, rig, unit, contents.records).whole()
