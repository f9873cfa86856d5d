"""What a target cannot carry, by one rule: the target's own function is evaluated on readings of the calibration, over
its range, and the largest difference from the true inputs is the loss, by channel.

Three conditions: at rest over temperature, within the ranges of rates and of ±1 g, and while the temperature changes by
1 K/min (dT/dt and lags). What a calibration has under [[path]] depends on the past, and is named in a note.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from gradcal_jax.calibration.equation import equation
from gradcal_jax.calibration.file import TEMPERATURE_RATE, Calibration
from gradcal_jax.records.log import Floats
from gradcal_jax.tables.display import summary
from gradcal_jax.units import DEG_PER_H, PPM, G

TargetFunction = Callable[[Floats, Floats], Floats]
"""What a target computes: from readings `(inputs, n)` and temperatures `(n,)`, °C, true inputs."""


_PER_MINUTE = 1.0 / 60.0  # K/s
_TEMPERATURES, _POINTS = 1001, 400
# Smaller losses are the rounding of numbers of 64 bits: rad/s or m/s².
_NOTHING = 1e-12


class Loss(NamedTuple):
    """One thing that the target cannot carry: at most `value` in `unit`, on `channel` ("gyro x"), under the condition
    `what`."""

    channel: str
    what: str
    value: float
    unit: str


class Export(NamedTuple):
    """`text` for the target's file, the losses, and notes for the user."""

    text: str
    losses: tuple[Loss, ...]
    notes: tuple[str, ...]

    __repr__ = summary


def losses_of(calibration: Calibration, inputs: Sequence[str], corrected: TargetFunction) -> tuple[Loss, ...]:
    """The largest differences that a target leaves, by channel and condition; `inputs`: those of its readings."""
    at, true = within_ranges(calibration, inputs, _POINTS)
    warm = np.linspace(*calibration.valid_temperature, _TEMPERATURES)
    still = np.zeros((len(inputs), _TEMPERATURES))

    def left(temperature: Floats, true: Floats, slope: float = 0.0) -> Floats:
        return corrected(readings(calibration, inputs, temperature, true, slope), temperature) - true

    resting = left(warm, still)
    moving = left(at, true) - left(at, 0.0 * true)
    warming = left(warm, still, _PER_MINUTE) - resting
    losses: list[Loss] = []
    for channel in calibration.channel:
        largest, of, unit, factor = G, "1 g", "ug", 1e6 / G
        if channel.kind == "gyro":
            largest = max(map(abs, channel.valid_rate))
            of, unit, factor = f"{np.degrees(largest):.4g} deg/s", "deg/h", DEG_PER_H
        for what, values, scale, words in (
            ("at rest", resting, factor, unit),
            ("within the ranges of rates and forces", moving, PPM / (largest or np.inf), f"ppm of {of}"),
            ("while the temperature changes", warming, factor, f"{unit} at 1 K/min"),
        ):
            size = float(np.max(np.abs(values[inputs.index(channel.input)])))
            if size > _NOTHING and scale > 0.0:  # (data at rest cover no rates)
                losses.append(Loss(channel.label, what, size * scale, words))
    return tuple(losses)


def within_ranges(calibration: Calibration, inputs: Sequence[str], count: int) -> tuple[Floats, Floats]:
    """Temperatures `(count,)` and true inputs `(inputs, count)` drawn within the ranges of the data, and ±1 g."""
    rng = np.random.default_rng(0)
    at = rng.uniform(*calibration.valid_temperature, count)
    ranges = {name: calibration.valid_rate if "rate" in name else (-G, G) for name in inputs}
    ranges |= {channel.input: channel.valid_rate for channel in calibration.channel if channel.kind == "gyro"}
    lowest, highest = np.array([ranges[name] for name in inputs]).T
    return at, rng.uniform(lowest, highest, (count, len(inputs))).T


def readings(
    calibration: Calibration, inputs: Sequence[str], temperature_c: Floats, true: Floats, slope: float = 0.0
) -> Floats:
    """What the sensor reads `(inputs, n)` for true inputs, while the temperature changes by `slope` (K/s)."""
    own = [temperature_c - slope * float(channel.thermal_lag or 0.0) for channel in calibration.channel]
    of_sensor = equation(calibration.channel, [*inputs, TEMPERATURE_RATE], own)
    errors = of_sensor.errors(np.vstack([true, np.full_like(temperature_c, slope)]))
    return true + errors[:-1]
