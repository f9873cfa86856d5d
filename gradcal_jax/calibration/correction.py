"""Correction of data by a calibration, in NumPy, by the same formulas as the estimator.

    measured = s + Σ map(T, s) · signals,        s = input + Σ misalignment(T) · inputs across it

with s as the channel's own signal, is solved for the inputs of all channels together: the residual of the equation at
the corrected values is divided by the linear part and added to them, until nothing changes. The error shrinks in each
iteration by a factor of the size of the terms that are not linear, or that differ from their value at the middle
temperature; so raw counts converge, too. Outside the range of the data, the maps keep their values at its edge.

Plays ([[path]] of a calibration) follow the temperature along a log, row by row. Until it has traversed twice their
half-width, their state at the log's beginning counts, of which the middle of what it may be is taken. Lags begin in
equilibrium, and the difference of two thermometers is that of the log.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gradcal_jax import formulas
from gradcal_jax.calibration.file import (
    TEMPERATURE_RATE,
    CalibratedChannel,
    CalibratedTerm,
    Calibration,
    PathCoefficient,
    at_rates,
    at_temperatures,
    term_values,
)
from gradcal_jax.records.log import Floats, Log, LogError
from gradcal_jax.spec.bases import SplineKeys
from gradcal_jax.tables.display import summary

_ROUNDS, _SETTLED, _DIVERGED = 60, 1e-14, 1e-9
# Larger forces (m/s²) are wrong samples.
_LARGEST_FORCE = 1000.0
_ROWS_AT_ONCE = 1 << 15
_SLOPE_WINDOW_S = 60.0
# SI units of sensitivities to dT/dt of biases and of scale factors; difference of two states of a play that are one, K.
_BIAS_BY_SLOPE, _SCALE_BY_SLOPE, _KNOWN_K = ("rad/K", "m/s/K"), "s/K", 1e-6
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
    unknown_branch: int = 0
    """Number of rows at the beginning for which the state of a hysteresis is not known."""
    left_in: tuple[str, ...] = ()
    """Coefficients under [[path]], as gyro_x.NAME, that the correction does not subtract: errors of the user's own
    classes."""

    __repr__ = summary


class OnPath(NamedTuple):
    """What the path of temperature adds to a channel at every row `(n,)`: to its bias, SI, and to its scale factor;
    and whether it is `known`. `late` °C: the temperatures of maps that follow by lags (s) of their own."""

    bias: Floats
    scale: Floats
    known: NDArray[np.bool_]
    late: Mapping[float, Floats]

    def of_rows(self, rows: slice) -> "OnPath":
        """Of some rows."""
        late = {lag: of[rows] for lag, of in self.late.items()}
        return OnPath(self.bias[rows], self.scale[rows], self.known[rows], late)


def channel_error(
    channel: CalibratedChannel,
    temperature_c: Floats,
    signals: Mapping[str, Floats],
    maps: Sequence[Floats] | None = None,
    path: OnPath | None = None,
) -> Floats:
    """The error of a channel's output, `(n,)`, for the true inputs `signals` ("rate x" rad/s, "force z" m/s²; an
    unknown input counts as zero). `maps`: of each term, `at_temperatures`; `path`: what is added to the maps."""
    at = np.clip(temperature_c, *channel.valid_temperature)
    known = [
        (term, at_temperatures(term, at) if maps is None else maps[k])
        for k, term in enumerate(channel.term)
        if all(name.strip("|") in signals for name in term.signals)
    ]
    total = np.zeros(len(at))
    for term, of_temperature in known:
        if channel.misaligns(term):
            total += of_temperature[:, 0] * signals[term.signals[0]]
    sensed = signals[channel.input] + total
    signals = {**signals, channel.input: sensed}
    for term, of_temperature in known:
        if not channel.misaligns(term):
            own = np.clip(sensed, *channel.valid_rate) if term.rate is not None else at
            product = at_rates(term, of_temperature, own)
            for name in term.signals:
                signal = signals[name.strip("|")]
                product = product * (np.abs(signal) if name.startswith("|") else signal)
            total += product
    return total if path is None else total + path.bias + path.scale * sensed


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
        if channel.input in inputs:
            place, gain, others = inputs.index(channel.input), 1.0, np.zeros(len(inputs))
            for term in channel.term:
                value = value_at(channel, term, temperature_c, mean_over_rates=mean_over_rates)
                if not term.signals:
                    bias[place] += value
                elif term.signals == (channel.input,):
                    gain += value
                elif len(term.signals) == 1 and term.signals[0] in inputs:
                    to = matrix[place] if channel.misaligns(term) else others
                    to[inputs.index(term.signals[0])] += value
            matrix[place] = gain * matrix[place] + others
    return matrix, bias


def value_at(
    channel: CalibratedChannel, term: CalibratedTerm, temperature_c: float, *, mean_over_rates: bool = False
) -> float:
    """A term's map at one temperature, for slow rates or as its mean over the rates that it covers."""
    slow, fast = channel.valid_rate
    rates = np.linspace(float(slow), float(fast), 201) if mean_over_rates and term.rate else np.zeros(1)
    return float(np.mean(term_values(term, np.full(len(rates), temperature_c), rates)))


def correct(
    channels: Sequence[CalibratedChannel],
    readings: Mapping[str, Floats],
    temperature_c: Floats,
    temperature_rate: Floats | None = None,
    on_paths: Sequence[OnPath | None] | None = None,
) -> dict[str, Floats]:
    """True inputs `(n,)` by name for measured ones ("rate x": rad/s, "force z": m/s²; NaN: not known).

    `temperature_c`: `(n,)`, or `(channels, n)` where they lag; `temperature_rate`: K/s, where a term needs it;
    `on_paths`: of the channels. Readings without a channel count as true. Raises `ValueError` where a map is so steep
    that it cannot be inverted.
    """
    channels_at = np.broadcast_to(temperature_c, (len(channels), temperature_c.shape[-1]))
    paths = on_paths or [None] * len(channels)
    known = [(c, at, path) for c, at, path in zip(channels, channels_at, paths, strict=True) if c.input in readings]
    inputs = list(readings)
    result = np.stack([readings[name] for name in inputs])
    for begin in range(0, result.shape[1], _ROWS_AT_ONCE):
        rows = slice(begin, begin + _ROWS_AT_ONCE)
        slope = {} if temperature_rate is None else {TEMPERATURE_RATE: temperature_rate[rows]}
        result[:, rows] = _correct(
            [(c, at[rows], None if path is None else path.of_rows(rows)) for c, at, path in known],
            inputs,
            result[:, rows],
            slope,
        )
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
    channels: Sequence[tuple[CalibratedChannel, Floats, OnPath | None]],
    inputs: list[str],
    measured: Floats,
    slope: Mapping[str, Floats],
) -> Floats:
    middle = float(np.median(np.concatenate([np.clip(at, *c.valid_temperature) for c, at, _ in channels])))
    matrix, _ = linear_part([c for c, *_ in channels], middle, inputs)
    inverse = np.linalg.inv(matrix)
    # The temperature stays as it is from round to round.
    maps = [
        [at_temperatures(term, np.clip(_followed_by(term, at, path), *c.valid_temperature)) for term in c.term]
        for c, at, path in channels
    ]
    now, change = 0.0 * measured, 0.0 * measured
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(_ROUNDS):
            signals = {**dict(zip(inputs, now, strict=True)), **slope}
            left = measured - now
            for (channel, at, path), of_temperature in zip(channels, maps, strict=True):
                own = inputs.index(channel.input)
                left[own] -= channel_error(channel, at, signals, of_temperature, path)
            settled = True
            for k in range(len(inputs)):
                # Only channels with an effect: a missing reading does not affect the other triad.
                acts = np.flatnonzero(inverse[k])
                change[k] = inverse[k, acts] @ left[acts]
                now[k] += change[k]
                size = float(np.nanmax(np.abs(now[k]), initial=1e-300))
                settled &= bool(np.nanmax(np.abs(change[k]), initial=0.0) <= _SETTLED * size)
            if settled:
                return now
        for channel, at, _ in channels:
            _refuse_or_leave(channel, at, *(rows[inputs.index(channel.input)] for rows in (measured, change, now)))
    return now


def _followed_by(term: CalibratedTerm, at: Floats, path: OnPath | None) -> Floats:
    """The temperature that a map follows."""
    return at if term.lag is None or path is None else path.late[float(term.lag)]


def _refuse_or_leave(channel: CalibratedChannel, at: Floats, measured: Floats, change: Floats, now: Floats) -> None:
    """Set to NaN what has no solution, far beyond what the sensor measures; raise `ValueError` within that."""
    # Next to a jump of the map (bins) two values may alternate: both are within the jump.
    bins = any(isinstance(term.rate, SplineKeys) and not term.rate.degree for term in channel.term)
    if bins or not np.isfinite(measured).any():
        return
    limit = 2.0 * max(abs(float(r)) for r in channel.valid_rate) if channel.kind == "gyro" else _LARGEST_FORCE
    size = np.maximum(np.abs(now), np.nanmedian(np.abs(now)))
    unsolved = np.isfinite(measured) & ~(np.abs(change) <= _DIVERGED * size)
    if len(rows := np.flatnonzero(unsolved & (np.abs(measured) <= limit))):
        raise ValueError(
            f"the calibration of {channel.label} is too steep to be inverted at {measured[rows[0]]:.4g} (SI), "
            f"{at[rows[0]]:.4g} degC: is it the calibration of another sensor?"
        )
    now[unsolved] = np.nan


def temperature_slope(temperature_c: Floats, time_s: Floats) -> Floats:
    """dT/dt, K/s, over a minute about each row."""
    half = _SLOPE_WINDOW_S / 2
    after = np.interp(time_s + half, time_s, temperature_c)
    before = np.interp(time_s - half, time_s, temperature_c)
    span = np.minimum(time_s + half, time_s[-1]) - np.maximum(time_s - half, time_s[0])
    return (after - before) / np.maximum(span, np.finfo(np.float64).tiny)


def known_temperature(log: Log, unit: int, *, second: bool = False) -> Floats:
    """A unit's temperature at every row, missing ones interpolated linearly. Raises `LogError` without any."""
    values = log.bridged_temperature(unit, second=second)
    if values is None:
        which = "second temperature" if second else "temperature"
        raise LogError(f"the log has no {which} of IMU {log.units[unit]}, but the calibration needs it")
    return values


def needs_temperature(calibration: Calibration) -> bool:
    """Whether any term changes with temperature."""
    terms = [term for channel in calibration.channel for term in channel.term]
    changing = (TEMPERATURE_RATE in t.signals or (t.temperature is not None and t.temperature.size > 1) for t in terms)
    return any(changing) or any(map(_follows, calibration.path))


def _follows(one: PathCoefficient) -> bool:
    """Whether it is a function of temperatures that is known here, and not of a class of the user's own."""
    of_slope = one.unit in (*_BIAS_BY_SLOPE, _SCALE_BY_SLOPE)
    return not one.own and (one.width is not None or one.second_thermometer or of_slope)


def on_path(calibration: Calibration, channel: CalibratedChannel, own: Floats, log: Log, unit: int) -> OnPath | None:
    """What the path of a channel's temperature `own` `(n,)` adds, of what a calibration has under [[path]], and of lags
    of its maps; None without any. Raises `LogError` without a second temperature that is needed."""
    here = [one for one in calibration.path if one.channel == channel.name and _follows(one)]
    lags = {float(term.lag) for term in channel.term if term.lag is not None}
    if not here and not lags:
        return None

    def later(lag: float) -> Floats:
        return formulas.followed(own, log.time_s, log.stretch_starts, lag)

    bias, scale = np.zeros((2, len(own)))
    known = np.ones(len(own), bool)
    for one in here:
        if one.width is not None:
            low, high = formulas.play_states(own, float(one.width))
            function = 0.5 * (low + high) - own
            known &= high - low <= _KNOWN_K
        elif one.second_thermometer:
            function = known_temperature(log, unit, second=True) - own
        else:
            function = temperature_slope(own, log.time_s)
        to = scale if one.unit in ("1/K", _SCALE_BY_SLOPE) else bias
        to += one.value * function
    return OnPath(bias, scale, known, {lag: later(lag) for lag in lags})


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
    rates, forces = log.rate_rad_per_s[number].copy(), log.specific_force_m_per_s2
    forces = None if forces is None else forces[number].copy()
    columns = {f"gyro {axis}": rates[:, k] for k, axis in enumerate(log.axes)}
    if forces is not None:
        columns |= {f"accelerometer {axis}": forces[:, k] for k, axis in enumerate(log.force_axes)}
    common = _common(calibration, columns)
    at = np.full((len(common), len(log.time_s)), float(common[0].valid_temperature[0]))
    slope, paths = None, None
    if needs_temperature(calibration):
        temperature = known_temperature(log, number)
        lags = [float(channel.thermal_lag or 0.0) for channel in common]
        lagged = {lag: formulas.followed(temperature, log.time_s, log.stretch_starts, lag) for lag in set(lags)}
        at = np.stack([lagged[lag] for lag in lags])
        if any(TEMPERATURE_RATE in term.signals for channel in common for term in channel.term):
            slope = temperature_slope(temperature, log.time_s)
        paths = [on_path(calibration, c, own, log, number) for c, own in zip(common, at, strict=True)]
    readings = {_input(name): values for name, values in columns.items() if np.isfinite(values).any()}
    corrected = correct(common, readings, at, slope, paths)
    usable = log.usable(number)
    beyond, outside_rate = np.zeros(len(log.time_s), bool), 0
    for channel, of_channel in zip(common, at, strict=True):
        columns[channel.label][:] = corrected[channel.input]
        beyond |= _outside(of_channel, channel.valid_temperature)
        if channel.kind == "gyro":
            outside_rate += int(np.count_nonzero(_outside(corrected[channel.input][usable], channel.valid_rate)))
    known = {channel.label for channel in common}
    done = replace(
        log,
        rate_rad_per_s=rates[None],
        specific_force_m_per_s2=None if forces is None else forces[None],
        units=(log.units[number],),
        temperature_c=None if log.temperature_c is None else log.temperature_c[number][None],
        status=None if log.status is None else log.status[number][None],
        simulated=log.simulated or calibration.simulated,
        provenance={**log.provenance, "corrected": f"by the calibration of {calibration.serial_number}"},
    )
    alone = tuple(label for label in columns if label not in known)
    open_at = np.any([~path.known for path in paths or () if path is not None], axis=0) & usable
    names = {channel.name for channel in common}
    left_in = tuple(f"{p.channel}.{p.name}" for p in calibration.path if p.channel in names and not _follows(p))
    counts = int(np.count_nonzero(beyond[usable])), outside_rate, alone, int(np.count_nonzero(open_at))
    return Corrected(done, *counts, left_in)


def _input(label: str) -> str:
    kind, _, axis = label.partition(" ")
    return f"{'rate' if kind == 'gyro' else 'force'} {axis}"


def _common(calibration: Calibration, columns: Mapping[str, Floats]) -> list[CalibratedChannel]:
    """The calibration's channels that a log has. Raises `LogError` where it has none, or not all that these need."""
    has = {label for label, values in columns.items() if np.isfinite(values).any()}
    common = [channel for channel in calibration.channel if channel.label in has]
    if not common:
        raise LogError(
            f"none of the log's channels ({', '.join(columns)}) is in the calibration "
            f"({', '.join(channel.label for channel in calibration.channel)})"
        )
    needed = {name.strip("|") for channel in common for term in channel.term for name in term.signals}
    for channel in calibration.channel:
        if channel.label not in has and channel.input in needed:
            raise LogError(f"the log has no {channel.label}, but the correction of other channels needs it")
    return common


def _outside(values: Floats, bounds: tuple[float, float]) -> NDArray[np.bool_]:
    low, high = float(bounds[0]), float(bounds[1])
    slack = 1e-9 * max(abs(low), abs(high))
    return (values < low - slack) | (values > high + slack)
