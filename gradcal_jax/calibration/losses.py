"""What a target cannot carry, by one rule: the target's own function is evaluated on readings of the calibration, over
its range, and the largest difference from the true inputs is the loss, by channel.

Three conditions: at rest over temperature, within the ranges of rates and of ±1 g, and while the temperature changes by
1 K/min (dT/dt and lags). What a calibration has under [[path]] depends on the past, and is named in a note.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from gradcal_jax.calibration.correction import SIGNALS, error_function
from gradcal_jax.calibration.file import TEMPERATURE_RATE, Calibration
from gradcal_jax.records.log import Floats
from gradcal_jax.units import DEG_PER_H, PPM, G

Corrected = Callable[[Floats, Floats], Floats]
"""A target's function: readings `(n, inputs)` and temperatures `(n,)`, °C, to true inputs."""


class ExportOptions(NamedTuple):
    """What a target may need: one temperature (°C), the number of the sensor on the controller, PX4's device id, and
    the text of a template."""

    temperature_c: float | None
    instance: int
    device_id: int | None
    template: str | None


class Target(NamedTuple):
    """A calibration for a target: its text, its function of readings of `inputs` (None: nothing that could be
    evaluated), and notes for the user."""

    text: str
    corrected: Corrected | None
    notes: tuple[str, ...]
    inputs: Sequence[str] = SIGNALS


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


def losses_of(calibration: Calibration, inputs: Sequence[str], corrected: Corrected) -> list[Loss]:
    """The largest differences that a target leaves, by channel and condition; `inputs`: the columns of its readings."""
    at, true = within_ranges(calibration, inputs, _POINTS)
    warm = np.linspace(*calibration.valid_temperature, _TEMPERATURES)
    still = np.zeros((_TEMPERATURES, len(inputs)))

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
        conditions = [("at rest", resting, factor, unit)]
        if largest > 0.0:  # data at rest cover no rates
            conditions.append(("within the ranges of rates and forces", moving, PPM / largest, f"ppm of {of}"))
        conditions.append(("while the temperature changes", warming, factor, f"{unit} at 1 K/min"))
        for what, values, scale, words in conditions:
            size = float(np.max(np.abs(values[:, inputs.index(channel.input)])))
            if size > _NOTHING:
                losses.append(Loss(channel.label, what, size * scale, words))
    return losses


def within_ranges(calibration: Calibration, inputs: Sequence[str], count: int) -> tuple[Floats, Floats]:
    """Temperatures `(count,)` and true inputs `(count, inputs)` drawn within the ranges of the data, and ±1 g."""
    rng = np.random.default_rng(0)
    at = rng.uniform(*calibration.valid_temperature, count)
    true = rng.uniform(-1.0, 1.0, (count, len(inputs)))
    spans = {channel.input: channel.valid_rate for channel in calibration.channel if channel.kind == "gyro"}
    for k, name in enumerate(inputs):
        slow, fast = spans.get(name, calibration.valid_rate) if "rate" in name else (-G, G)
        true[:, k] = 0.5 * (slow + fast) + 0.5 * (fast - slow) * true[:, k]
    return at, true


def readings(
    calibration: Calibration, inputs: Sequence[str], temperature_c: Floats, true: Floats, slope: float = 0.0
) -> Floats:
    """What the sensor reads `(n, inputs)` for true inputs, while the temperature changes by `slope` (K/s)."""
    raw = true.copy()
    signals = dict(zip(inputs, true.T, strict=True)) | {TEMPERATURE_RATE: np.full(len(true), slope)}
    for channel in calibration.channel:
        own = temperature_c - slope * float(channel.thermal_lag or 0.0)
        raw[:, inputs.index(channel.input)] += error_function(channel, own)(signals)
    return raw
