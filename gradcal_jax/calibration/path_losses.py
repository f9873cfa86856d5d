"""What no target of an export carries: errors that depend on the path of temperature, and lags."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from gradcal_jax.calibration.correction import term_values
from gradcal_jax.calibration.file import Calibration
from gradcal_jax.units import DEG_PER_H, PPM, G

_PER_MINUTE = 1.0 / 60.0  # K/s
# Of the [[path]] of a calibration: what a loss is called, what its unit is for, and the sentence.
_HYSTERESIS = (
    "hysteresis", "", "only the mean of heating and cooling is exported; the hysteresis, up to {:.3g} {} on either "
    "branch, is lost",
)  # fmt: skip
_SECOND = (
    "follows the second thermometer", " for each K", "the part that depends on the second thermometer, {:.3g} {} for "
    "each K of its difference, is lost",
)  # fmt: skip
_DT_DT = "follows dT/dt", " at 1 K/min", "the part that depends on dT/dt, {:.3g} {} at 1 K/min, is lost"


class Loss(NamedTuple):
    """One thing that the target cannot carry: at most `value` in `unit`, of `what`, on `channel` ("gyro x")."""

    channel: str
    what: str
    value: float
    unit: str


def path_losses(calibration: Calibration) -> Iterator[tuple[Loss | None, str]]:
    """What [[path]] of a calibration knows and no target carries, each with its sentence; of an error class of the
    user's own nobody else knows the size."""
    sizes: dict[tuple[str, bool, tuple[str, str, str]], float] = {}
    varying: dict[tuple[str, bool, tuple[str, str, str]], float] = {}
    for one in calibration.path:
        if one.own:
            channel = one.channel.replace("_", " ")
            yield None, f"{one.name} of {channel}, {one.value:.3g} {one.unit}, a term of your own, is lost"
            continue
        if one.width is not None:
            kind, size = _HYSTERESIS, float(one.width)
        elif one.second_thermometer:
            kind, size = _SECOND, 1.0
        elif one.unit in ("rad/K", "m/s/K", "s/K"):
            kind, size = _DT_DT, _PER_MINUTE
        else:
            continue
        of = one.channel, one.unit in ("1/K", "s/K"), kind
        if one.polynomial is not None:
            # Legendre polynomials are within ±1 over the range that they are meant for.
            varying[of] = varying.get(of, 0.0) + abs(one.value) * size
            continue
        sizes[of] = sizes.get(of, 0.0) + one.value * size
    for key, size in sizes.items():
        name, of_scale, (what, condition, words) = key
        channel, of = name.replace("_", " "), "scale factor" if of_scale else "bias"
        unit, factor = _unit(name, of_scale)
        value = (abs(size) + varying.get(key, 0.0)) * factor
        yield Loss(channel, f"{of}: {what}", value, unit + condition), f"{of} of {channel}: {words.format(value, unit)}"


def lag_losses(calibration: Calibration) -> Iterator[Loss]:
    """What lags of biases and scale factors, which a target does not carry, leave while the temperature changes by
    1 K/min."""
    for c in calibration.channel:
        low, high = (float(t) for t in c.valid_temperature)
        for term in filter(None, map(c.term_of, ("bias", "scale_factor"))):
            if term.temperature is None or not (lag := float(c.thermal_lag or 0.0) + float(term.lag or 0.0)):
                continue
            slow, fast = (float(r) for r in c.valid_rate)
            t, w = np.meshgrid(np.linspace(low, high, 201), np.linspace(slow, fast, 21))
            t, w = t.ravel(), w.ravel()
            later = np.clip(t + lag * _PER_MINUTE, low, high)
            left = float(np.max(np.abs(term_values(term, later, w) - term_values(term, t, w))))
            unit, factor = _unit(c.name, term.name == "scale_factor")
            what = f"{term.name.replace('_', ' ')}: lag of {lag:.3g} s"
            yield Loss(c.label, what, left * factor, f"{unit} at 1 K/min")


def _unit(channel: str, of_scale: bool) -> tuple[str, float]:
    if of_scale:
        return "ppm", PPM
    return ("deg/h", DEG_PER_H) if channel.startswith("gyro") else ("ug", 1e6 / G)
