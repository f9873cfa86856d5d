"""Temperature programmes: soaks, ramps and steps of the chamber, and the temperature of the sensor's die."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from gradcal_jax.arrays import AnyArray, PytreeModule, namespace, running_sum


class RampTemperature(NamedTuple):
    """Sensor temperature on each stretch: `level + slope·t + excess·exp(−lag_rate·t)`, t from the stretch's start.

    `times` are the ends of the stretches, the first one's start included.
    """

    times: Float[AnyArray, " knots"]
    level: Float[AnyArray, " S"]
    slope: Float[AnyArray, " S"]
    excess: Float[AnyArray, " S"]
    lag_rate: Float[AnyArray, ""]


class Programme(PytreeModule):
    """Stretches on which the chamber moves at a constant slope: `durations` s, `slopes` K/s, from `start` °C.

    `jumps` K: instantaneous changes at the begin of each stretch (the plateaus of the standard method).
    """

    start: Float[AnyArray, ""]
    durations: Float[AnyArray, " S"]
    slopes: Float[AnyArray, " S"]
    jumps: Float[AnyArray, " S"]

    def __check_init__(self):
        if not self.durations.shape == self.slopes.shape == self.jumps.shape:
            raise ValueError("a temperature programme must have one slope for each duration")

    def times(self) -> Float[AnyArray, " knots"]:
        """Times (s) at which stretches begin and the last one ends."""
        xp = namespace(self.durations)
        return xp.concatenate([xp.zeros(1), running_sum(self.durations)])

    def chamber(self) -> tuple[Float[AnyArray, " S"], Float[AnyArray, " S"]]:
        """The chamber's temperature (°C) as each stretch begins and as it ends."""
        end = self.start + running_sum(self.durations * self.slopes) + running_sum(self.jumps)
        return end - self.durations * self.slopes, end

    def sensor(self, thermal_lag: Float[AnyArray, ""] | float | None = None) -> RampTemperature:
        """Sensor temperature for a first-order lag (s) between chamber and die, in equilibrium at the start."""
        begin, _ = self.chamber()
        xp = namespace(self.start, self.durations, self.slopes, thermal_lag)
        if thermal_lag is None:
            return RampTemperature(self.times(), begin, self.slopes, xp.zeros(self.slopes.shape), xp.zeros(()))
        level = begin - self.slopes * thermal_lag
        # At the begin of each stretch the steady state jumps; the deviation decays through all later stretches.
        times = self.times()
        left = xp.concatenate([begin[:1], level[:-1] + self.slopes[:-1] * self.durations[:-1]]) - level
        since = xp.tril(times[:-1, None] - times[None, :-1])
        excess = xp.tril(xp.exp(-since / thermal_lag)) @ left
        return RampTemperature(times, level, self.slopes, excess, xp.asarray(1.0 / thermal_lag))


def programme(start: float, stretches: list[tuple[float, float]]) -> Programme:
    """A temperature programme from `start` (°C): `stretches` of (duration s, slope K/s).

    Errors: `ValueError` without any stretch.
    """
    durations, slopes = (np.asarray(v, dtype=float) for v in zip(*stretches, strict=True))
    return Programme(np.asarray(start, dtype=float), durations, slopes, np.zeros(len(durations)))
