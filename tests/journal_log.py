"""The log of a journal's records, without the folder of a run."""

import tempfile
from pathlib import Path

import numpy as np

from gradcal_jax.hardware.journal import JournalContents
from gradcal_jax.recipe.recipe import Recipe
from gradcal_jax.records.log import Log
from gradcal_jax.records.run_log import log_of_records
from gradcal_jax.spec.rig import RigFile


def log_of(contents: JournalContents, recipe: Recipe, rig: RigFile, unit: str | None = None) -> Log:
    """The log of one IMU (by name; None: the rig's only one), decoded with the configuration in the journal."""
    return log_of_records(contents.records, recipe, rig, unit, Path(tempfile.gettempdir()))


def angles_of_rests(log: Log, axis: int = 0) -> np.ndarray:
    """`(standstills,)`: the angle of a table axis at which each standstill was read last, or that it has kept since
    it was read, rad."""
    assert log.standstill is not None
    assert log.readings is not None
    readings = log.readings.of_axis(axis)
    ends = [np.flatnonzero(log.standstill == number)[-1] for number in range(int(log.standstill.max()) + 1)]
    latest = np.searchsorted(readings.row, ends, side="right") - 1
    return readings.angle_rad[latest]
