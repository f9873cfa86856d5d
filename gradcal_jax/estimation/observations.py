"""What estimation works on: readings of the integrated error, with the regressors and the noise steps of a prediction.

Symbols: `N` steps (one for each piece of a trajectory, some without a reading), `p` parameters of the model, `U` units
on one table. `y_k = Φ_k β + noise` is the integrated rate of the sensor less the angle of the reference, from the
angle's origin on: exactly what `information.at_readings` and `information.noise_steps` describe.
"""

from typing import NamedTuple

import numpy as np

from gradcal_jax.information import NoiseSteps


class Observations(NamedTuple):
    """Readings of one channel of `U` units, which share the table and so the noise's timing.

    `columns` `(N, p)`, common to the units, or `(U, N, p)`, one for each (their temperatures differ); rad per unit of
    each parameter. `readings` `(N, U)`, rad; what stands at a step without a reading is not used. `time_s` `(N,)`: of
    each step's end. `temperature_c`, `rate_rad_per_s` `(N,)`: means over the step, for reports.
    """

    steps: NoiseSteps
    columns: np.ndarray
    readings: np.ndarray
    time_s: np.ndarray
    temperature_c: np.ndarray
    rate_rad_per_s: np.ndarray

    @property
    def unit_count(self) -> int:
        return self.readings.shape[1]

    def columns_of(self, unit: int) -> np.ndarray:
        """`(N, p)` of one unit."""
        return self.columns if self.columns.ndim == 2 else self.columns[unit]

    @property
    def used(self) -> np.ndarray:
        """`(N,)`: the steps that have a reading."""
        return self.steps.used
