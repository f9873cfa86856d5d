"""The filter of the noise and its adjoint states in NumPy, reading by reading; see `whitening`.

For what needs a gain or an adjoint state of every single reading; nothing is compiled.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from gradcal_jax.information.noise_steps import NoiseSteps

# Number of steps whose adjoint states are kept together.
_TOGETHER = 1024


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


def filtered_states(steps: NoiseSteps, values: Float[np.ndarray, " N"]) -> Float[np.ndarray, "N n"]:
    """The state after each reading, estimated from the `values` of all readings up to it."""
    n = steps.observation.shape[1]
    of = filter_readings(np.zeros((n, 1)), np.asarray(steps.initial), steps, values[:, None])
    innovation = np.divide(of.rows[:, 0], of.per_std, out=np.zeros(len(values)), where=of.per_std > 0.0)
    stays = np.zeros(len(values), bool) if steps.stays is None else steps.stays
    state, result = np.zeros(n), np.empty((len(values), n))
    for k, (f, gain) in enumerate(zip(steps.transition, of.gain, strict=True)):
        state = (state if stays[k] else f @ state) + gain * innovation[k]
        result[k] = state
    return result


def adjoint_parts(
    steps: NoiseSteps, readings: Readings
) -> Iterator[tuple[slice, Float[np.ndarray, "K p"], Float[np.ndarray, "K n p"]]]:
    """`V⁻¹ columns` of the readings, and what it adds to each step's state: `Σ (H F … F)ᵀ V⁻¹ columns` over all later
    readings. In parts, the last first, each with the place of its steps."""
    count, p = readings.rows.shape
    n, later = steps.observation.shape[1], np.zeros((steps.observation.shape[1], p))
    for begin in range((count - 1) // _TOGETHER * _TOGETHER, -1, -_TOGETHER):
        at = slice(begin, min(begin + _TOGETHER, count))
        us, rhos = np.empty((at.stop - begin, p)), np.empty((at.stop - begin, n, p))
        for k in range(at.stop - 1, begin - 1, -1):
            us[k - begin] = readings.per_std[k] * readings.rows[k] - readings.gain[k] @ later
            rhos[k - begin] = steps.observation[k, :, None] * us[k - begin] + later
            later = steps.transition[k].T @ rhos[k - begin]
        yield at, us, rhos
