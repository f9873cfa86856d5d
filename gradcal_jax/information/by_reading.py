"""The filter of the noise and its derivative in NumPy, reading by reading, as `whitening` and `adjoint` say them.

A reading takes some ten microseconds, and nothing is compiled: for single predictions that is the quickest way, and
on a machine without a compiler the one there is.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from gradcal_jax.information.noise_steps import NoiseSteps


class Readings(NamedTuple):
    """Whitened `rows`; `gain`, `P Hᵀ/S`, and `per_std`, `1/√S`, of each reading; `mean` and `covariance` after all."""

    rows: Float[np.ndarray, "N p"]
    gain: Float[np.ndarray, "N n"]
    per_std: Float[np.ndarray, " N"]
    mean: Float[np.ndarray, "n p"]
    covariance: Float[np.ndarray, "n n"]


def filter_readings(
    mean: Float[np.ndarray, "n p"],
    covariance: Float[np.ndarray, "n n"],
    steps: NoiseSteps,
    columns: Float[np.ndarray, "N p"],
) -> Readings:
    """All columns through the filter, from a state before the first step."""
    transition, noise, observation, variance, used = steps[:5]
    rows, gain, per_std = np.empty_like(columns), np.zeros(observation.shape), np.zeros(len(columns))
    stays = np.zeros(len(columns), bool) if steps.stays is None else steps.stays
    for k, (f, h, y) in enumerate(zip(transition, observation, columns, strict=True)):
        if not stays[k]:
            mean, covariance = f @ mean, f @ covariance @ f.T + noise[k]
        cross = covariance @ h
        spread = h @ cross + variance[k]
        innovation = y - h @ mean
        if used[k] and spread > 0.0:
            gain[k], per_std[k] = cross / spread, spread**-0.5
            mean, covariance = mean + gain[k, :, None] * innovation, covariance - gain[k, :, None] * cross
        rows[k] = per_std[k] * innovation
    return Readings(rows, gain, per_std, mean, covariance)


def of_noise(
    steps: NoiseSteps, readings: Readings, of_gram: Float[np.ndarray, "p p"]
) -> tuple[Float[np.ndarray, "N n n"], Float[np.ndarray, " N"], Float[np.ndarray, "n n"]]:
    """Of what has the derivative `of_gram` in `rowsᵀ rows`, the derivative in the covariance of every step, in the
    variance of every reading, and in the initial covariance.
    """
    count, p = readings.rows.shape
    us, rhos = np.empty((count, p)), np.empty((*steps.observation.shape, p))
    later = np.zeros(rhos.shape[1:])
    for k in range(count - 1, -1, -1):
        us[k] = readings.per_std[k] * readings.rows[k] - readings.gain[k] @ later
        rhos[k] = steps.observation[k, :, None] * us[k] + later
        later = steps.transition[k].T @ rhos[k]
    inner = (of_gram + of_gram.T) / 2
    of_steps = -(rhos @ inner) @ rhos.swapaxes(1, 2)
    return of_steps, -np.sum((us @ inner) * us, axis=1), -(later @ inner) @ later.T
