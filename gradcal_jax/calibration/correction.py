"""Correction of data by a calibration, in NumPy, by the same formulas as the estimator.

The equation of all channels is solved together, until nothing changes. Outside the range of the data, the maps keep
their values at its edge.

Of what a calibration has under [[path]], only what follows dT/dt is subtracted; plays and the difference of two
thermometers stay, and are named. Lags begin in equilibrium.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from gradcal_jax import formulas
from gradcal_jax.calibration.equation import SIGNALS, clipped, equation, linear_part
from gradcal_jax.calibration.file import (
    TEMPERATURE_RATE,
    CalibratedChannel,
    Calibration,
    PathCoefficient,
    build_term,
    signal_of,
)
from gradcal_jax.records.log import Bools, Floats, Log, LogError, variables_of
from gradcal_jax.spec.bases import SplineKeys
from gradcal_jax.tables.display import summary

_ROUNDS, _SETTLED, _DIVERGED = 60, 1e-14, 1e-9
# Larger forces (m/s²) are wrong samples.
_LARGEST_FORCE = 1000.0
_ROWS_AT_ONCE = 1 << 15
# Half of the time over which dT/dt is taken.
_HALF_WINDOW_S = 30.0
# SI units of coefficients under [[path]] that multiply dT/dt, and whether they also multiply the channel's own input.
_BY_SLOPE = {"rad/K": False, "m/s/K": False, "s/K": True}


class Corrected(NamedTuple):
    """A log with corrected rates and specific forces, how many of its rows have a temperature outside what the
    calibration covers, and how many rates of all gyros are outside."""

    log: Log
    outside_temperature: int
    outside_rate: int
    left_alone: tuple[str, ...]
    """Channels of the log that the calibration does not have, and that are therefore not corrected."""
    left_in: tuple[str, ...]
    """Coefficients under [[path]], as gyro_x.NAME, that the correction does not subtract."""

    __repr__ = summary


def correct(
    channels: Sequence[CalibratedChannel],
    inputs: Sequence[str],
    measured: Floats,
    followed: Floats | Sequence[Floats],
) -> Floats:
    """True inputs `(inputs, n)` for measured ones ("rate x": rad/s, "force z": m/s²; NaN: not known).

    `followed`: temperatures `(n,)`, °C, or those of each channel. Readings without a channel count as true, such as
    "temperature rate", K/s. Raises `ValueError` where a map is so steep that it cannot be inverted.
    """
    known: list[int] = np.flatnonzero(np.isfinite(measured).any(axis=1)).tolist()
    names, result = [inputs[k] for k in known], measured.copy()
    temperatures = np.broadcast_to(followed, (len(channels), measured.shape[1]))
    for begin in range(0, measured.shape[1], _ROWS_AT_ONCE):
        rows = slice(begin, begin + _ROWS_AT_ONCE)
        result[known, rows] = _solved(channels, names, measured[known, rows], temperatures[:, rows])
    return result


def correct_triads(
    channels: Sequence[CalibratedChannel], rate: Floats, force: Floats, temperature_c: Floats
) -> tuple[Floats, Floats]:
    """True rates and specific forces `(n, 3)` along x, y, z from measured ones; NaN where there is none."""
    true = correct(channels, SIGNALS, np.hstack([rate, force]).T, temperature_c).T
    return true[:, :3], true[:, 3:]


def _solved(
    channels: Sequence[CalibratedChannel], inputs: Sequence[str], measured: Floats, temperature_c: Floats
) -> Floats:
    """The true inputs `(inputs, n)`; `temperature_c`: `(channels, n)`."""
    inverse = np.linalg.inv(linear_part(channels, float(np.median(temperature_c)), inputs)[0])
    with np.errstate(over="ignore", invalid="ignore"):
        solving = equation(channels, inputs, temperature_c)
        true, change, rounds = solving.solve(measured, inverse, fewest=1, most=_ROUNDS, settled=_SETTLED)
        if rounds == _ROUNDS:
            for channel, at in zip(channels, temperature_c, strict=True):
                if channel.input in inputs:
                    k = inputs.index(channel.input)
                    true[k, _unsolved(channel, at, measured[k], change[k], true[k])] = np.nan
    return true


def _unsolved(channel: CalibratedChannel, at: Floats, measured: Floats, change: Floats, now: Floats) -> Bools:
    """Rows without a solution, far beyond what the sensor measures. Raises `ValueError` for one within that."""
    # Next to a jump of the map (bins) two values may alternate: both are within the jump.
    if any(isinstance(term.rate, SplineKeys) and not term.rate.degree for term in channel.term):
        return np.zeros(len(now), bool)
    limit = 2.0 * max(map(abs, channel.valid_rate)) if channel.kind == "gyro" else _LARGEST_FORCE
    size = np.maximum(np.abs(now), np.nanmedian(np.abs(now)) if np.isfinite(now).any() else 0.0)
    unsolved = np.isfinite(measured) & ~(change <= _DIVERGED * size)
    for row in np.flatnonzero(unsolved & (np.abs(measured) <= limit)):
        raise ValueError(
            f"the calibration of {channel.label} is too steep to be inverted at {measured[row]:.4g} (SI), "
            f"{at[row]:.4g} degC: is it the calibration of another sensor?"
        )
    return unsolved


def temperature_slope(temperature_c: Floats, time_s: Floats) -> Floats:
    """dT/dt, K/s, over a minute about each row."""
    ends = np.clip([time_s - _HALF_WINDOW_S, time_s + _HALF_WINDOW_S], time_s[0], time_s[-1])
    before, after = np.interp(ends, time_s, temperature_c)
    return (after - before) / (ends[1] - ends[0])


def apply(calibration: Calibration, log: Log, unit: str | int = 0) -> Corrected:
    """The log of one sensor with corrected rates (rad/s) and specific forces (m/s²); channels that the calibration
    does not have stay as they are.

    `unit`: its name or number in the log. Solves the calibration's equation, row by row; beyond the
    calibration's range its value at the edge holds, and `Corrected` counts such rows. Masked rows are corrected too,
    and stay masked.

    Errors: `LogError` where no channel of the log is calibrated, and where a temperature or another channel's reading
    is needed that is not there.
    """
    number = log.unit_index(unit)
    measured = {name: of for name, of in log.channels(number).items() if np.isfinite(of).any()}
    common = _common(calibration, measured)
    subtracted = [one for one in calibration.path if one.unit in _BY_SLOPE and not one.own]
    channels = [_with_gradient(channel, subtracted) for channel in common]
    temperature = _temperature(channels, log, number)
    lags = [channel.thermal_lag or 0.0 for channel in channels]
    followed = [formulas.followed(temperature, log.time_s, log.stretch_starts, lag) for lag in lags]
    inputs = [*map(signal_of, measured), TEMPERATURE_RATE]
    rows = np.stack([*measured.values(), temperature_slope(temperature, log.time_s)])
    corrected = dict(zip(inputs, correct(channels, inputs, rows, followed), strict=True))
    usable = log.usable(number)
    too_warm = [_outside(of, channel.valid_temperature) for channel, of in zip(channels, followed, strict=True)]
    too_fast = [
        _outside(corrected[channel.input], channel.valid_rate) for channel in channels if channel.kind == "gyro"
    ]
    result = _of_unit(log, number, calibration)
    for channel in channels:
        result.channel(channel.label)[:] = corrected[channel.input]  # (a copy of the log's)
    labels, names = [channel.label for channel in channels], [channel.name for channel in channels]
    return Corrected(
        result,
        outside_temperature=int(np.sum(np.any(too_warm, axis=0) & usable)),
        outside_rate=sum(int(np.sum(beyond & usable)) for beyond in too_fast),
        left_alone=tuple(label for label in log.channels() if label not in labels),
        left_in=tuple(
            f"{one.channel}.{one.name}" for one in calibration.path if one.channel in names and one not in subtracted
        ),
    )


def _common(calibration: Calibration, has: Mapping[str, Floats]) -> list[CalibratedChannel]:
    """The calibration's channels that a log has. Raises `LogError` where it has none, or not all that these need."""
    common = [channel for channel in calibration.channel if channel.label in has]
    if not common:
        raise LogError(
            f"none of the log's channels ({', '.join(has)}) is in the calibration "
            f"({', '.join(channel.label for channel in calibration.channel)})"
        )
    needed = {name.strip("|") for channel in common for term in channel.term for name in term.signals}
    for channel in calibration.channel:
        if channel.label not in has and channel.input in needed:
            raise LogError(f"the log has no {channel.label}, but the correction of other channels needs it")
    return common


def _with_gradient(channel: CalibratedChannel, gradients: Sequence[PathCoefficient]) -> CalibratedChannel:
    """The channel with what its bias and scale factor add with dT/dt as terms."""
    terms = list(channel.term)
    for one in gradients:
        if one.channel == channel.name:
            own = (channel.input,) if _BY_SLOPE[one.unit] else ()
            terms.append(build_term(one.name, one.unit, (TEMPERATURE_RATE, *own), {one.name: one.value}))
    return channel.model_copy(update={"term": tuple(terms)})


def _temperature(channels: Sequence[CalibratedChannel], log: Log, number: int) -> Floats:
    """The log's temperature `(n,)`, °C; any, where no term depends on it. Raises `LogError` where one does."""
    temperature = log.bridged_temperature(number)
    if temperature is not None:
        return temperature
    for channel in channels:
        for term in channel.term:
            if term.bases[0].size > 1 or TEMPERATURE_RATE in term.signals:
                raise LogError(f"the log has no temperature of IMU {log.units[number]}, but the calibration needs it")
    return np.full(len(log.time_s), float(channels[0].valid_temperature[0]))


def _of_unit(log: Log, number: int, calibration: Calibration) -> Log:
    """A log of one unit alone, to be corrected; its values are copies."""
    parts: dict[str, Any] = {"units": (log.units[number],), "simulated": log.simulated or calibration.simulated}
    for name, variable in variables_of(Log).items():
        if "unit" in variable.dimensions and (values := getattr(log, name)) is not None:
            parts[name] = values[[number]]
    by = f"by the calibration of {calibration.serial_number}"
    return replace(log, **parts, provenance={**log.provenance, "corrected": by})


def _outside(values: Floats, bounds: tuple[float, float]) -> Bools:
    return np.abs(values - clipped(values, bounds)) > 1e-9 * max(map(abs, bounds))
