"""Correction of data by a calibration, in NumPy, by the same formulas as the estimator.

    measured = s + Σ map(T, s) · signals,        s = input + Σ misalignment(T) · inputs across it

with s as the channel's own signal, is solved for the inputs of all channels together: the residual of the equation at
the corrected values is divided by the linear part and added to them, until nothing changes. The error shrinks in each
iteration by a factor of the size of the terms that are not linear, or that differ from their value at the middle
temperature; so raw counts converge, too. Outside the range of the data, the maps keep their values at its edge.

Of what a calibration has under [[path]], only what follows dT/dt is subtracted; plays and the difference of two
thermometers stay, and are named. Lags begin in equilibrium.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from gradcal_jax import formulas
from gradcal_jax.calibration.file import (
    TEMPERATURE_RATE,
    CalibratedChannel,
    Calibration,
    PathCoefficient,
    at_rates,
    at_temperatures,
    build_term,
    term_values,
)
from gradcal_jax.records.log import Bools, Floats, Log, LogError, variables_of
from gradcal_jax.spec.bases import SplineKeys
from gradcal_jax.tables.display import summary

_ROUNDS, _SETTLED, _DIVERGED = 60, 1e-14, 1e-9
# Larger forces (m/s²) are wrong samples.
_LARGEST_FORCE = 1000.0
_ROWS_AT_ONCE = 1 << 15
_SLOPE_WINDOW_S = 60.0
# SI units of coefficients under [[path]] that multiply dT/dt: those of a bias, and of a scale factor.
_BY_SLOPE, _SCALE_BY_SLOPE = ("rad/K", "m/s/K"), "s/K"
SIGNALS = tuple(f"{kind} {axis}" for kind in ("rate", "force") for axis in "xyz")
"""The inputs of an IMU, in the order of its matrices."""


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


def error_function(channel: CalibratedChannel, followed: Floats) -> Callable[[Mapping[str, Floats]], Floats]:
    """The error of a channel's output at these temperatures, `(n,)`, as a function of the true inputs by signal ("rate
    x" rad/s, "force z" m/s²); an unknown input counts as zero."""
    within = np.clip(followed, *channel.valid_temperature)
    maps = [(term, at_temperatures(term, within)) for term in channel.term]

    def error(signals: Mapping[str, Floats]) -> Floats:
        known = [of for of in maps if all(name.strip("|") in signals for name in of[0].signals)]
        total = np.zeros_like(followed)
        for term, of_temperature in known:
            if channel.misaligns(term):
                total += of_temperature[:, 0] * signals[term.signals[0]]
        sensed = signals[channel.input] + total
        signals = {**signals, channel.input: sensed}
        own = np.clip(sensed, *channel.valid_rate)
        for term, of_temperature in known:
            if not channel.misaligns(term):
                product = at_rates(term, of_temperature, own)
                for name in term.signals:
                    signal = signals[name.strip("|")]
                    product = product * (np.abs(signal) if name.startswith("|") else signal)
                total += product
        return total

    return error


def linear_part(
    channels: Sequence[CalibratedChannel],
    temperature_c: float,
    inputs: Sequence[str] = SIGNALS,
    *,
    mean_over_rates: bool = False,
) -> tuple[Floats, Floats]:
    """At one temperature: measured = matrix (n, n) · inputs + bias (n,), SI, for slow rates or with the mean of the
    maps over the rates that they cover. Absent terms count as zero."""
    matrix, bias = np.eye(len(inputs)), np.zeros(len(inputs))
    for channel in channels:
        if channel.input not in inputs:
            continue
        place, gain, others = inputs.index(channel.input), 1.0, np.zeros(len(inputs))
        for term in channel.term:
            rates = np.linspace(*channel.valid_rate, 201) if mean_over_rates and term.rate else np.zeros(1)
            value = float(np.mean(term_values(term, np.full(len(rates), temperature_c), rates)))
            if not term.signals:
                bias[place] += value
            elif term.signals == (channel.input,):
                gain += value
            elif len(term.signals) == 1 and term.signals[0] in inputs:
                to = matrix[place] if channel.misaligns(term) else others
                to[inputs.index(term.signals[0])] += value
        matrix[place] = gain * matrix[place] + others
    return matrix, bias


def correct(
    channels: Sequence[CalibratedChannel],
    readings: Mapping[str, Floats],
    followed: Floats | Sequence[Floats],
    temperature_rate: Floats | None = None,
) -> dict[str, Floats]:
    """True inputs `(n,)` by name for measured ones ("rate x": rad/s, "force z": m/s²; NaN: not known).

    `followed`: temperatures `(n,)`, °C, or those of each channel; `temperature_rate`: K/s, where a term needs
    it. Readings without a channel count as true. Raises `ValueError` where a map is so steep that it cannot be
    inverted.
    """
    of_each = [followed] * len(channels) if isinstance(followed, np.ndarray) else followed
    inputs, result = list(readings), np.stack(list(readings.values()))
    for begin in range(0, result.shape[1], _ROWS_AT_ONCE):
        rows = slice(begin, begin + _ROWS_AT_ONCE)
        slope = {} if temperature_rate is None else {TEMPERATURE_RATE: temperature_rate[rows]}
        part = [(channel, of[rows]) for channel, of in zip(channels, of_each, strict=True) if channel.input in readings]
        result[:, rows] = _correct(part, inputs, result[:, rows], slope)
    return dict(zip(inputs, result, strict=True))


def correct_triads(
    channels: Sequence[CalibratedChannel], rate: Floats, force: Floats, temperature_c: Floats
) -> tuple[Floats, Floats]:
    """True rates and specific forces `(n, 3)` along x, y, z from measured ones; NaN where there is none."""
    measured = dict(zip(SIGNALS, (*rate.T, *force.T), strict=True))
    there = {name: values for name, values in measured.items() if np.isfinite(values).any()}
    done = np.stack(list((measured | correct(channels, there, temperature_c)).values()), axis=1)
    return done[:, :3], done[:, 3:]


def _correct(
    channels: Sequence[tuple[CalibratedChannel, Floats]],
    inputs: list[str],
    measured: Floats,
    slope: Mapping[str, Floats],
) -> Floats:
    middle = float(np.median([np.clip(of, *channel.valid_temperature) for channel, of in channels]))
    inverse = np.linalg.inv(linear_part([channel for channel, _ in channels], middle, inputs)[0])
    errors = {inputs.index(channel.input): error_function(channel, of) for channel, of in channels}
    now, change = 0.0 * measured, 0.0 * measured
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(_ROUNDS):
            signals = {**dict(zip(inputs, now, strict=True)), **slope}
            left = measured - now
            for k, error in errors.items():
                left[k] -= error(signals)
            for k, row in enumerate(inverse):
                # Only channels with an effect: a missing reading does not affect the other triad.
                acts = np.flatnonzero(row)
                change[k] = row[acts] @ left[acts]
            now = now + change
            size = np.nanmax(np.abs(now), axis=1, initial=1e-300)
            if np.all(np.nanmax(np.abs(change), axis=1, initial=0.0) <= _SETTLED * size):
                return now
        for channel, of in channels:
            k = inputs.index(channel.input)
            now[k, _unsolved(channel, of, measured[k], change[k], now[k])] = np.nan
    return now


def _unsolved(channel: CalibratedChannel, at: Floats, measured: Floats, change: Floats, now: Floats) -> Bools:
    """Rows without a solution, far beyond what the sensor measures. Raises `ValueError` for one within that."""
    limit = 2.0 * max(map(abs, channel.valid_rate)) if channel.kind == "gyro" else _LARGEST_FORCE
    size = np.maximum(np.abs(now), np.nanmedian(np.abs(now)) if np.isfinite(now).any() else 0.0)
    unsolved = np.isfinite(measured) & ~(np.abs(change) <= _DIVERGED * size)
    # Next to a jump of the map (bins) two values may alternate: both are within the jump.
    if any(isinstance(term.rate, SplineKeys) and not term.rate.degree for term in channel.term):
        unsolved[:] = False
    for row in np.flatnonzero(unsolved & (np.abs(measured) <= limit)):
        raise ValueError(
            f"the calibration of {channel.label} is too steep to be inverted at {measured[row]:.4g} (SI), "
            f"{at[row]:.4g} degC: is it the calibration of another sensor?"
        )
    return unsolved


def temperature_slope(temperature_c: Floats, time_s: Floats) -> Floats:
    """dT/dt, K/s, over a minute about each row."""
    half = _SLOPE_WINDOW_S / 2
    after = np.interp(time_s + half, time_s, temperature_c)
    before = np.interp(time_s - half, time_s, temperature_c)
    span = np.minimum(time_s + half, time_s[-1]) - np.maximum(time_s - half, time_s[0])
    return (after - before) / np.maximum(span, np.finfo(np.float64).tiny)


def _with_gradient(channel: CalibratedChannel, gradients: Sequence[PathCoefficient]) -> CalibratedChannel:
    """The channel with what its bias and scale factor add with dT/dt as terms."""
    terms = list(channel.term)
    for one in gradients:
        if one.channel == channel.name:
            own = (channel.input,) if one.unit == _SCALE_BY_SLOPE else ()
            terms.append(build_term(one.name, one.unit, (TEMPERATURE_RATE, *own), {one.name: one.value}))
    return channel.model_copy(update={"term": tuple(terms)})


def apply(calibration: Calibration, log: Log, unit: str | int = 0) -> Corrected:
    """The log of one sensor with corrected rates (rad/s) and specific forces (m/s²); channels that the calibration
    does not have stay as they are.

    `unit`: its name or number in the log. Solves the equation at the module's head, row by row; beyond the
    calibration's range its value at the edge holds, and `Corrected` counts such rows. Masked rows are corrected too,
    and stay masked.

    Errors: `LogError` where no channel of the log is calibrated, and where a temperature or another channel's reading
    is needed that is not there.
    """
    number = log.unit_index(unit)
    usable, columns = log.usable(number), log.channels(number)
    gradients = [one for one in calibration.path if one.unit in (*_BY_SLOPE, _SCALE_BY_SLOPE) and not one.own]
    seen = {name: values for name, values in columns.items() if np.isfinite(values).any()}
    channels = [_with_gradient(channel, gradients) for channel in _common(calibration, seen)]
    terms = [term for channel in channels for term in channel.term]
    slopes = any(TEMPERATURE_RATE in term.signals for term in terms)
    temperature = log.bridged_temperature(number)
    if temperature is None:
        if slopes or any(term.temperature is not None and term.temperature.size > 1 for term in terms):
            raise LogError(f"the log has no temperature of IMU {log.units[number]}, but the calibration needs it")
        temperature = np.full(len(log.time_s), float(channels[0].valid_temperature[0]))
    slope = temperature_slope(temperature, log.time_s) if slopes else None
    lags = [float(channel.thermal_lag or 0.0) for channel in channels]
    followed = [formulas.followed(temperature, log.time_s, log.stretch_starts, lag) for lag in lags]
    corrected = correct(channels, {_input(name): values for name, values in seen.items()}, followed, slope)
    beyond, outside_rate = np.zeros(len(usable), bool), 0
    for channel, of in zip(channels, followed, strict=True):
        beyond |= _outside(of, channel.valid_temperature)
        if channel.kind == "gyro":
            outside_rate += int(np.sum(_outside(corrected[channel.input], channel.valid_rate) & usable))
    done = {channel.label: corrected[channel.input] for channel in channels}
    names = {channel.name for channel in channels}
    left_in = [f"{one.channel}.{one.name}" for one in calibration.path if one.channel in names and one not in gradients]
    result = replace(
        _of_unit(log, number, done),
        simulated=log.simulated or calibration.simulated,
        provenance={**log.provenance, "corrected": f"by the calibration of {calibration.serial_number}"},
    )
    left_alone = tuple(label for label in columns if label not in done)
    return Corrected(result, int(np.sum(beyond & usable)), outside_rate, left_alone, tuple(left_in))


def _of_unit(log: Log, number: int, channels: Mapping[str, Floats]) -> Log:
    """The log of one unit, with these rates and specific forces in place of its own."""
    parts: dict[str, Any] = {"units": (log.units[number],)}
    for name, variable in variables_of(Log).items():
        if "unit" in variable.dimensions and (values := getattr(log, name)) is not None:
            parts[name] = values[[number]]
    result = replace(log, **parts)
    of_unit = result.channels()
    for label, values in channels.items():
        of_unit[label][:] = values  # (a copy of the log's)
    return result


def _input(label: str) -> str:
    kind, _, axis = label.partition(" ")
    return f"{'rate' if kind == 'gyro' else 'force'} {axis}"


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


def _outside(values: Floats, bounds: tuple[float, float]) -> Bools:
    low, high = bounds
    slack = 1e-9 * max(abs(low), abs(high))
    return (values < low - slack) | (values > high + slack)
