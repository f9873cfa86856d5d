"""Correction of data by a whole unit's calibration, in NumPy, by the same formulas as the estimator.

    measured = input + Σ map(T) · signals

is solved for the inputs of all channels together: the residual of the equation at the corrected values is divided by
the linear part and added to them, until nothing changes. The error shrinks in each iteration by a factor of the size of
the terms that are not linear, or that differ from their value at the middle temperature; so raw counts converge, too.
"""

from collections.abc import Sequence

import numpy as np

from gradcal_jax.files.correction import (
    Corrected,
    basis_values,
    count_outside,
    followed,
    known_temperature,
    log_corrected,
)
from gradcal_jax.files.log import Floats, Log, LogError
from gradcal_jax.files.unit_calibration import SIGNALS, CalibratedChannel, CalibratedTerm, UnitCalibration

_ROWS_AT_ONCE = 1 << 15
_ROUNDS = 60
_SETTLED = 1e-14


def term_values(term: CalibratedTerm, temperature_c: Floats, rate: Floats | None = None) -> Floats:
    """The map of a term, `(n,)`, in its unit; `rate` rad/s, of its channel's axis."""
    return _at_rates(term, _at_temperatures(term, temperature_c), rate)


def _at_temperatures(term: CalibratedTerm, temperature_c: Floats) -> Floats:
    """`(n, functions of the rate)`: their coefficients, or the map itself."""
    coefficients = np.array(list(term.coefficients.values()))
    one = np.ones((len(temperature_c), 1))
    basis = one if term.temperature is None else basis_values(term.temperature, temperature_c)
    return basis @ coefficients.reshape(basis.shape[1], -1)


def _at_rates(term: CalibratedTerm, of_temperature: Floats, rate: Floats | None) -> Floats:
    if term.rate is None or rate is None:
        return of_temperature[:, 0]
    return np.einsum("nk,nk->n", of_temperature, basis_values(term.rate, rate))


def channel_error(
    channel: CalibratedChannel, temperature_c: Floats, signals: dict[str, Floats], maps: Sequence[Floats] | None = None
) -> Floats:
    """The error of a channel's output, `(n,)`, for the true inputs `signals` ("rate x" rad/s, "force z" m/s²; an
    unknown input counts as zero). `maps`: of each term, `_at_temperatures`."""
    total = np.zeros(len(temperature_c))
    for k, term in enumerate(channel.term):
        of_temperature = _at_temperatures(term, temperature_c) if maps is None else maps[k]
        product = _at_rates(term, of_temperature, None if term.rate is None else signals[f"rate {channel.axis}"])
        for name in term.signals:
            signal = signals.get(name.strip("|"))
            if signal is None:
                break
            product = product * (np.abs(signal) if name.startswith("|") else signal)
        else:
            total += product
    return total


def linear_part(channels: Sequence[CalibratedChannel], temperature_c: float) -> tuple[Floats, Floats]:
    """At one temperature, for slow rates: measured = matrix (6, 6) · (rates x, y, z, forces x, y, z) + bias (6,), SI.
    Absent terms count as zero."""
    at, matrix, bias = np.array([temperature_c]), np.eye(6), np.zeros(6)
    for channel in channels:
        for term in channel.term:
            value = float(term_values(term, at, np.zeros(1))[0])
            if not term.signals:
                bias[channel.place] += value
            elif len(term.signals) == 1 and not term.signals[0].startswith("|"):
                matrix[channel.place, SIGNALS.index(term.signals[0])] += value
    return matrix, bias


def correct_unit(
    channels: Sequence[CalibratedChannel],
    rate: Floats,
    force: Floats,
    temperature_c: Floats,
    *,
    temperatures: tuple[float, float] = (-np.inf, np.inf),
    rates: tuple[float, float] = (-np.inf, np.inf),
) -> tuple[Floats, Floats]:
    """True rates and specific forces `(n, 3)` along x, y, z from measured ones (rad/s, m/s²; NaN where there is none).

    Beyond `temperatures` (°C) and `rates` (rad/s) the maps' values at the edge hold. Other channels stay as they are.
    """
    (low, high), (slow, fast) = temperatures, rates
    own_rate, own_force = rate.copy(), force.copy()
    for begin in range(0, len(rate), _ROWS_AT_ONCE):
        rows = slice(begin, begin + _ROWS_AT_ONCE)
        at = np.clip(temperature_c[rows], low, high)
        measured = np.concatenate([rate[rows].T, force[rows].T])
        there = np.asarray(np.any(np.isfinite(measured), axis=1))
        matrix, _ = linear_part(channels, float(np.median(at)))
        inverse = np.linalg.inv(matrix)
        # The temperature stays as it is from round to round.
        maps = [[_at_temperatures(term, at) for term in channel.term] for channel in channels]
        now = 0.0 * measured
        for _ in range(_ROUNDS):
            signals = {name: now[k] for k, name in enumerate(SIGNALS) if there[k]}
            left = measured - now
            for channel, of_temperature in zip(channels, maps, strict=True):
                own, name = signals, f"rate {channel.axis}"
                beyond = np.zeros(0)
                if channel.kind == "gyro" and name in signals:
                    # The map is constant beyond its edge; the rate that it multiplies is not limited.
                    own = signals | {name: np.clip(signals[name], slow, fast)}
                    beyond = signals[name] - own[name]
                error = channel_error(channel, at, own, of_temperature)
                if np.any(beyond) and (scale := channel.term_of("scale_factor")) is not None:
                    error = error + term_values(scale, at, own[name]) * beyond
                left[channel.place] -= error
            moved = 0.0
            for k in np.flatnonzero(there):
                # Only channels with an effect: a missing reading does not affect the other triad.
                acts = np.flatnonzero(there & (inverse[k] != 0.0))
                change = inverse[k, acts] @ left[acts]
                now[k] += change
                size = max(float(np.nanmax(np.abs(now[k]), initial=0.0)), 1e-300)
                moved = max(moved, float(np.nanmax(np.abs(change), initial=0.0)) / size)
            if moved <= _SETTLED:
                break
        own_rate[rows], own_force[rows] = now[:3].T, now[3:].T
    return own_rate, own_force


def triad_of(log: Log, unit: int) -> tuple[Floats, Floats]:
    """A unit's rates and specific forces `(n, 3)` along x, y, z; NaN for axes absent in the log."""
    count = len(log.time_s)
    rate, force = np.full((count, 3), np.nan), np.full((count, 3), np.nan)
    for into, labels, values in (
        (rate, log.axes, log.rate_rad_per_s),
        (force, log.force_axes, log.specific_force_m_per_s2),
    ):
        for k, label in enumerate(labels):
            if values is not None and label in ("x", "y", "z"):
                into[:, "xyz".index(label)] = values[unit, :, k]
    return rate, force


def apply_unit(calibration: UnitCalibration, log: Log, unit: str | int = 0) -> Corrected:
    """The log of one unit with corrected rates (rad/s) and specific forces (m/s²) along x, y, z.

    `unit`: its name or number in the log. Solves measured = input + Σ map(T)·signals, row by row; beyond what is
    covered the values at the edge hold, and `Corrected` counts such rows. Masked rows are corrected, and stay masked.

    Errors: `LogError` where a channel of the calibration, or a temperature that it needs, is not in the log.
    """
    number = log.unit_index(unit)
    rate, force = triad_of(log, number)
    for channel in calibration.channel:
        values = rate if channel.kind == "gyro" else force
        if not np.isfinite(values[:, "xyz".index(channel.axis)]).any():
            raise LogError(f"the log has no {channel.kind} {channel.axis}, which the calibration corrects")
    if any(term.temperature is not None for channel in calibration.channel for term in channel.term):
        temperature = known_temperature(log, number)
        at = followed(temperature, log.time_s, log.stretch_starts, float(calibration.thermal_lag or 0.0))
    else:
        at = np.full(len(log.time_s), float(calibration.valid_temperature[0]))
    usable = log.usable(number)
    temperatures, covered = calibration.valid_temperature, calibration.valid_rate
    own_rate, own_force = correct_unit(calibration.channel, rate, force, at, temperatures=temperatures, rates=covered)
    gyros = ["xyz".index(c.axis) for c in calibration.channel if c.kind == "gyro"]
    outside_rate = count_outside(own_rate[usable][:, gyros], covered)
    known = {(c.kind, c.axis) for c in calibration.channel}
    alone: list[str] = []
    rates, forces = log.rate_rad_per_s[number].copy(), None
    if log.specific_force_m_per_s2 is not None:
        forces = log.specific_force_m_per_s2[number].copy()
    for kind, labels, into, corrections in (
        ("gyro", log.axes, rates, own_rate),
        ("accelerometer", log.force_axes, forces, own_force),
    ):
        for k, label in enumerate(labels):
            if (kind, label) not in known:
                alone.append(f"{kind} {label}")
            elif into is not None:
                into[:, k] = corrections[:, "xyz".index(label)]
    corrected = log_corrected(log, number, calibration, rates, forces)
    return Corrected(corrected, count_outside(at[usable], temperatures), outside_rate, tuple(alone))
