"""The log of a journal's records, without the folder of a run."""

import contextlib

from gradcal_jax.decoding.run_log import _of_unit
from gradcal_jax.files.log.log import Log
from gradcal_jax.files.run.recipe import Recipe
from gradcal_jax.files.spec.rig import RigFile
from gradcal_jax.hardware.journal import JournalContents


def log_of(contents: JournalContents, recipe: Recipe, rig: RigFile, unit: str | None = None) -> Log:
    """The log of one IMU (by name; None: the rig's only one), decoded with the configuration in the journal."""
    with contextlib.ExitStack() as stack:
        return _of_unit(stack, None, contents, recipe, rig, unit, contents.records).whole()
