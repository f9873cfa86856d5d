"""Temperature programmes: soaks, ramps and steps of the chamber, and what the sensor's die makes of them."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


class Trail(NamedTuple):
    """Sensor temperature on each stretch: `trail + slope·t + excess·exp(−lag_rate·t)`, t from the stretch's start."""

    times: Float[Array, " knots"]
    trail: Float[Array, " S"]
    slope: Float[Array, " S"]
    excess: Float[Array, " S"]
    lag_rate: Float[Array, ""]


class Programme(eqx.Module):
    """Stretches on which the chamber moves at a constant slope: `durations` s, `slopes` K/s, from `start` °C.

    A soak has slope 0; a step is a ramp as fast as the chamber goes.
    """

    start: Float[Array | np.ndarray, ""]
    durations: Float[Array | np.ndarray, " S"]
    slopes: Float[Array | np.ndarray, " S"]

    def __check_init__(self):
        if self.durations.shape != self.slopes.shape:
            raise ValueError("a temperature programme needs one slope for each duration")

    @property
    def total(self) -> Float[Array, ""]:
        return jnp.sum(self.durations)

    def knots(self) -> tuple[Float[Array, " knots"], Float[Array, " knots"]]:
        """Times (s) and chamber temperatures (°C) at the ends of the stretches."""
        zero = jnp.zeros(1)
        times = jnp.concatenate([zero, jnp.cumsum(self.durations)])
        temperatures = jnp.asarray(self.start) + jnp.concatenate([zero, jnp.cumsum(self.durations * self.slopes)])
        return times, temperatures

    def trail(self, thermal_lag: Float[Array, ""] | float | None = None) -> Trail:
        """What the sensor follows, for a first-order lag (s) between chamber and die; in equilibrium at the start."""
        times, chamber = self.knots()
        slopes = jnp.asarray(self.slopes)
        if thermal_lag is None:
            return Trail(times, chamber[:-1], slopes, jnp.zeros_like(slopes), jnp.zeros(()))
        lag = jnp.asarray(thermal_lag, dtype=self.durations.dtype)
        trail = chamber[:-1] - slopes * lag
        sensor, excess = chamber[0], []
        for k in range(self.durations.shape[0]):
            excess.append(sensor - trail[k])
            sensor = trail[k] + slopes[k] * self.durations[k] + excess[k] * jnp.exp(-self.durations[k] / lag)
        return Trail(times, trail, slopes, jnp.stack(excess), 1.0 / lag)


def programme(start: float, stretches: list[tuple[float, float]]) -> Programme:
    """A temperature programme from `start` (°C): `stretches` of (duration s, slope K/s).

    Errors: `ValueError` without any stretch.
    """
    durations, slopes = zip(*stretches, strict=True)
    as_array = lambda v: np.asarray(v, dtype=float)  # noqa: E731
    return Programme(as_array(start), as_array(durations), as_array(slopes))
