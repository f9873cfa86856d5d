"""The branches of the temperature: where it heats, cools, or neither."""

import numpy as np

from gradcal_jax.files.calibration.correction import temperature_slope

# dT/dt of a temperature that neither heats nor cools, K/s.
_STEADY = 0.1 / 60.0
BRANCHES = {1: "heating", -1: "cooling", 0: "steady"}
"""Names of the branches by their numbers."""


def branch_of(temperature_c: np.ndarray, time_s: np.ndarray) -> np.ndarray:
    """The number of the branch at every row `(n,)`, by dT/dt over a minute; 0 where no temperature is known."""
    known = np.isfinite(temperature_c) & np.isfinite(time_s)
    if not known.any():
        return np.zeros(len(temperature_c), int)
    slope = np.zeros(len(temperature_c))
    slope[known] = temperature_slope(temperature_c[known], time_s[known])
    return np.where(np.abs(slope) < _STEADY, 0, np.sign(slope)).astype(int)
