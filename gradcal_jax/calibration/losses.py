"""What a target cannot carry, by one rule: the target's own function is evaluated on readings of the calibration, over
its range, and the largest difference from the true inputs is the loss, by channel.

Three conditions: at rest over temperature, within the ranges of rates and of ±1 g, and while the temperature changes by
1 K/min (dT/dt and lags). What a calibration has under [[path]] depends on the past, and is stated as notes.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from gradcal_jax.calibration.correction import channel_error
from gradcal_jax.calibration.file import (
    TEMPERATURE_RATE,
    CalibratedChannel,
    Calibration,
    PathCoefficient,
    at_temperatures,
)
from gradcal_jax.records.log import Floats
from gradcal_jax.units import DEG_PER_H, PPM, G

Corrected = Callable[[Floats, Floats], Floats]
"""A target's function: readings `(n, inputs)` and temperatures `(n,)`, °C, to true inputs."""
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
    low, high = (float(end) for end in calibration.valid_temperature)
    warm = np.linspace(low, high, _TEMPERATURES)
    rng = np.random.default_rng(0)
    at, true = rng.uniform(low, high, _POINTS), rng.uniform(-1.0, 1.0, (_POINTS, len(inputs)))
    spans = {c.input: c.valid_rate for c in calibration.channel if c.kind == "gyro"}
    for k, name in enumerate(inputs):
        slow, fast = (float(v) for v in spans.get(name, calibration.valid_rate)) if "rate" in name else (-G, G)
        true[:, k] = 0.5 * (slow + fast) + 0.5 * (fast - slow) * true[:, k]

    def left(temperature: Floats, true: Floats, slope: float = 0.0) -> Floats:
        return corrected(readings(calibration, inputs, temperature, true, slope), temperature) - true

    nothing = np.zeros((_TEMPERATURES, len(inputs)))
    resting = left(warm, nothing)
    moving = left(at, true) - left(at, 0.0 * true)
    warming = left(warm, nothing, _PER_MINUTE) - resting
    losses: list[Loss] = []
    for channel in calibration.channel:
        k = inputs.index(channel.input)
        unit, factor = _unit(channel)
        largest = max(abs(float(v)) for v in channel.valid_rate) if channel.kind == "gyro" else G
        of = f"{np.degrees(largest):.4g} deg/s" if channel.kind == "gyro" else "1 g"
        for what, values, scale, words in (
            ("at rest", resting, factor, unit),
            ("within the ranges of rates and forces", moving, PPM / max(largest, _NOTHING), f"ppm of {of}"),
            ("while the temperature changes", warming, factor, f"{unit} at 1 K/min"),
        ):
            size = float(np.max(np.abs(values[:, k])))
            covered = largest > 0.0 or values is not moving  # data at rest cover no rates
            if size > _NOTHING and covered:
                losses.append(Loss(channel.label, what, size * scale, words))
    return losses


def readings(
    calibration: Calibration, inputs: Sequence[str], temperature_c: Floats, true: Floats, slope: float = 0.0
) -> Floats:
    """What the sensor reads `(n, inputs)` for true inputs, while the temperature changes by `slope` (K/s)."""
    raw = true.copy()
    signals = dict(zip(inputs, true.T, strict=True)) | {TEMPERATURE_RATE: np.full(len(true), slope)}
    for channel in calibration.channel:
        lag = float(channel.thermal_lag or 0.0)
        maps = [
            at_temperatures(
                term, np.clip(temperature_c - slope * (lag + float(term.lag or 0.0)), *channel.valid_temperature)
            )
            for term in channel.term
        ]
        raw[:, inputs.index(channel.input)] += channel_error(channel, temperature_c, signals, maps)
    return raw


def path_notes(calibration: Calibration) -> Iterator[str]:
    """What [[path]] of a calibration knows and no target carries."""
    for one in calibration.path:
        channel = one.channel.replace("_", " ")
        if one.own:
            yield f"{one.name} of {channel}, {one.value:.3g} {one.unit}, a term of your own, is lost"
            continue
        size, condition = _size(one)
        unit, factor = ("ppm", PPM) if one.unit in ("1/K", "s/K") else _unit(one)
        name = one.name.replace("_", " ")
        yield f"{name} of {channel}, up to {abs(one.value) * size * factor:.3g} {unit}{condition}, is lost"


def _size(one: PathCoefficient) -> tuple[float, str]:
    """Of a coefficient of the path: what multiplies it at most, and under which condition."""
    if one.width is not None:
        return float(one.width), " on either branch of heating and cooling"
    return (1.0, " for each K") if one.second_thermometer else (_PER_MINUTE, " at 1 K/min")


def _unit(of: CalibratedChannel | PathCoefficient) -> tuple[str, float]:
    name = of.name if isinstance(of, CalibratedChannel) else of.channel
    return ("deg/h", DEG_PER_H) if name.startswith("gyro") else ("ug", 1e6 / G)
