"""What estimation works on: readings of the integrated error, with the regressors and the noise steps of a prediction.

Symbols: `N` steps (one for each piece of a timeline, some without a reading), `p` parameters of the model, `U` units on
one table. `y_k = Φ_k β + noise` is the integrated rate of the sensor less the angle of the reference, from the
angle's origin on: exactly what `information.at_readings` and `information.noise_steps` describe.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gradcal_jax.errormodel import GyroModel
from gradcal_jax.information import NoiseSteps, at_readings, noise_steps
from gradcal_jax.plans import Timeline

# Timelines are filled up to whole multiples of this many pieces, so that logs of about one length compile once.
PIECES_AT_ONCE = 256


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
        return np.asarray(self.steps.used)


def steps_of(timeline: Timeline, model: GyroModel) -> NoiseSteps:
    """`noise_steps` of a timeline, computed on one that is filled up with pieces of no duration."""
    count = timeline.piece_count
    extra = -count % PIECES_AT_ONCE
    if not extra:
        return noise_steps(timeline, model)

    def longer(name: str) -> Any:
        values = getattr(timeline, name)
        if not isinstance(values, jax.Array) or values.ndim == 0 or values.shape[0] != count:
            return values
        filling = np.zeros((extra, *values.shape[1:]), values.dtype) + (name in ("at_rest", "u_end"))
        return jnp.asarray(np.concatenate([np.asarray(values), filling.astype(values.dtype)]))

    filled = Timeline(**{field.name: longer(field.name) for field in dataclasses.fields(timeline)})
    steps = noise_steps(filled, model)
    return NoiseSteps._make([*(jnp.asarray(np.asarray(field)[:count]) for field in steps[:-1]), steps.initial])


def on_timeline(timeline: Timeline, model: GyroModel, readings: np.ndarray) -> Observations:
    """Readings `(N, U)` taken on a plan's own timeline: the regressors and steps are those of its prediction."""
    middle = jnp.full((timeline.piece_count, 1), 0.5)
    duration = np.asarray(timeline.duration)
    turned = np.asarray(timeline.turned())
    return Observations(
        steps_of(timeline, model),
        np.asarray(at_readings(timeline, model)),
        readings,
        np.asarray(timeline.start) + duration,
        np.asarray(timeline.temperature(middle))[:, 0],
        np.divide(turned, duration, out=np.zeros_like(turned), where=duration > 0),
    )
