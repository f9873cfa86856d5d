"""The filter of the noise and its derivative in NumPy, reading by reading; see `whitening` and `adjoint`.

A reading takes about ten microseconds and nothing is compiled: the fastest way for single predictions, and the only one
without a compiler.
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
    """Filter all columns, from the state before the first step."""
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


def noise_cotangents(
    steps: NoiseSteps, readings: Readings, of_gram: Float[np.ndarray, "p p"]
) -> tuple[Float[np.ndarray, "N n n"], Float[np.ndarray, " N"], Float[np.ndarray, "n n"]]:
    """Derivatives with respect to the covariance of every step, the variance of every reading and the initial
    covariance, of a function whose derivative with respect to `rowsᵀ rows` is `of_gram`.
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
