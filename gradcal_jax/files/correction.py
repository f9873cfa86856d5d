"""Correction of data by a calibration, in NumPy, by the same formulas as the estimator.

    measured = (1 + M(T, ω))·ω + B(T) [+ g·dT/dt]

is solved for ω to rounding: `ω ← (measured − B)/(1 + M(T, ω))`, whose error shrinks by a factor |ω ∂M/∂ω| per
iteration. Outside the range of the data, the maps keep their values at its edge.
"""

import importlib
import itertools
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gradcal_jax import formulas
from gradcal_jax.files.bases import (
    RateBasis,
    RateBins,
    RatePolynomial,
    RateSpline,
    TemperatureBasis,
    TemperatureBins,
    TemperaturePolynomial,
    TemperatureSpline,
)
from gradcal_jax.files.calibration import AxisCalibration, Calibration, ScaleFactorMap, bias_names, scale_factor_names
from gradcal_jax.files.log import Floats, Log, LogError
from gradcal_jax.files.unit_calibration import UnitCalibration

_ROUNDS = 200
_ROWS_AT_ONCE = 1 << 16
_SLOPE_WINDOW_S = 60.0
# Over a shorter break the temperature is continuous; after a longer one a run begins with a stable chamber, and the
# lag has decayed.
_BRIDGED_S = 60.0


class Corrected(NamedTuple):
    """A log with corrected rates, and how many rows of each (unit, axis) lay outside what the calibration covers."""

    log: Log
    outside_temperature: int
    outside_rate: int
    left_alone: tuple[str, ...]
    """Axes of the log that the calibration does not have."""


def basis_values(basis: TemperatureBasis | RateBasis, x: Floats) -> Floats:
    """Values of a basis's *reported* functions, `(n,) -> (n, size)`."""
    if isinstance(basis, TemperaturePolynomial | RatePolynomial):
        return formulas.monomials((x - float(basis.centre)) / float(basis.scale), basis.degree)
    if isinstance(basis, TemperatureSpline | RateSpline):
        return formulas.b_spline(x, tuple(float(k) for k in basis.knots), basis.degree)
    assert isinstance(basis, TemperatureBins | RateBins)
    return formulas.bins(x, tuple(float(e) for e in basis.edges))


def bias(axis: AxisCalibration, temperature_c: Floats) -> Floats:
    """B(T), rad/s; zero where the calibration has none."""
    if axis.bias is None:
        return np.zeros_like(temperature_c)
    values = np.array([axis.bias.coefficients[name] for name in bias_names(axis.bias.temperature)])
    return basis_values(axis.bias.temperature, _within(temperature_c, axis.valid_temperature)) @ values


def scale_factor(axis: AxisCalibration, temperature_c: Floats, rate_rad_per_s: Floats) -> Floats:
    """M(T, ω), a ratio; zero where the calibration has none."""
    part = axis.scale_factor
    if part is None:
        return np.zeros_like(rate_rad_per_s)
    at_temperature = basis_values(part.temperature, _within(temperature_c, axis.valid_temperature))
    return formulas.scale_factor_map(
        at_temperature, basis_values(part.rate, _within(rate_rad_per_s, axis.valid_rate)), scale_factor_table(part)
    )


def scale_factor_table(part: ScaleFactorMap) -> Floats:
    """The coefficients of a map M, `(n_T, n_ω)`."""
    names = scale_factor_names(part.temperature, part.rate)
    return np.array([part.coefficients[name] for name in names]).reshape(part.temperature.size, part.rate.size)


def _within(x: Floats, bounds: tuple[float, float]) -> Floats:
    return np.clip(x, float(bounds[0]), float(bounds[1]))


def measured(axis: AxisCalibration, rate_rad_per_s: Floats, temperature_c: Floats) -> Floats:
    """The sensor's output for true rates, `(n,)`: the calibration forwards."""
    return (1.0 + scale_factor(axis, temperature_c, rate_rad_per_s)) * rate_rad_per_s + bias(axis, temperature_c)


def correct(axis: AxisCalibration, measured_rad_per_s: Floats, temperature_c: Floats) -> Floats:
    """True rates `(n,)` for the sensor's output: `measured` solved to rounding.

    Raises `ValueError` where the map is so steep that it cannot be inverted there.
    """
    result = np.empty_like(measured_rad_per_s)
    for begin in range(0, len(result), _ROWS_AT_ONCE):
        part = slice(begin, begin + _ROWS_AT_ONCE)
        result[part] = _correct(axis, measured_rad_per_s[part], temperature_c[part])
    return result


def _correct(axis: AxisCalibration, output: Floats, temperature: Floats) -> Floats:
    without_bias = output - bias(axis, temperature)
    scale = axis.scale_factor
    if scale is None:
        return without_bias
    by_rate = basis_values(scale.temperature, _within(temperature, axis.valid_temperature)) @ scale_factor_table(scale)
    rate = without_bias.copy()
    left = np.arange(len(rate))
    tolerance = 4.0 * np.finfo(np.float64).eps
    for _ in range(_ROUNDS):
        now = rate[left]
        map_values = (by_rate[left] * basis_values(scale.rate, _within(now, axis.valid_rate))).sum(axis=-1)
        new = without_bias[left] / (1.0 + map_values)
        rate[left] = new
        left = left[np.abs(new - now) > tolerance * np.maximum(np.abs(new), np.finfo(np.float64).tiny)]
        if not len(left):
            return rate
    # Next to a jump of the map (bins) two values may alternate: both are within the jump.
    if isinstance(scale.rate, RateBins):
        return rate
    first = int(left[0])
    raise ValueError(
        f"the scale-factor map of axis {axis.name} is too steep to be inverted at {np.degrees(output[first]):.4g} "
        f"deg/s, {temperature[first]:.4g} degC: is this calibration of another sensor?"
    )


def followed(temperature_c: Floats, time_s: Floats, starts: NDArray[np.int64], lag_s: float) -> Floats:
    """The temperature of the maps: the measured one `(n,)`, whose unbroken stretches begin at the rows `starts`, with a
    first-order lag. It begins in equilibrium, also after every long break; over a short break the temperature is
    interpolated linearly."""
    if lag_s <= 0.0:
        return temperature_c
    signal: Any = importlib.import_module("scipy.signal")
    result = np.empty_like(temperature_c)
    for first, end in itertools.pairwise([*starts.tolist(), len(temperature_c)]):
        result[first] = temperature_c[first]
        if first and (gap := float(time_s[first] - time_s[first - 1])) <= _BRIDGED_S:
            (now, before), (_, kept) = formulas.lag_filter(gap, lag_s)
            result[first] = now * temperature_c[first] + before * temperature_c[first - 1] - kept * result[first - 1]
        if end - first > 1:
            interval = float(time_s[end - 1] - time_s[first]) / (end - 1 - first)
            numerator, denominator = formulas.lag_filter(interval, lag_s)
            state = numerator[1] * temperature_c[first] - denominator[1] * result[first]
            late: Any = signal.lfilter(numerator, denominator, temperature_c[first + 1 : end], zi=np.array([state]))
            result[first + 1 : end] = late[0]
    return result


def temperature_slope(temperature_c: Floats, time_s: Floats) -> Floats:
    """dT/dt, K/s, over a minute about each row."""
    half = _SLOPE_WINDOW_S / 2
    after = np.interp(time_s + half, time_s, temperature_c)
    before = np.interp(time_s - half, time_s, temperature_c)
    span = np.minimum(time_s + half, time_s[-1]) - np.maximum(time_s - half, time_s[0])
    return (after - before) / np.maximum(span, np.finfo(np.float64).tiny)


def known_temperature(log: Log, unit: int) -> Floats:
    """A unit's temperature at every row, missing ones interpolated linearly. Raises `LogError` without any."""
    if log.temperature_c is None or not np.isfinite(log.temperature_c[unit]).any():
        raise LogError(f"the log has no temperature of unit {log.units[unit]}, and the calibration depends on it")
    values = log.temperature_c[unit]
    known = np.isfinite(values)
    if known.all():
        return values
    return np.asarray(np.interp(log.time_s, log.time_s[known], values[known]), np.float64)


def needs_temperature(calibration: Calibration) -> bool:
    """Whether any map changes with temperature."""
    maps = [m for axis in calibration.axis for m in (axis.bias, axis.scale_factor) if m is not None]
    gradients = any(axis.bias_temperature_gradient for axis in calibration.axis)
    return gradients or any(m.temperature.size > 1 for m in maps)


def apply(calibration: Calibration, log: Log, unit: str | int = 0) -> Corrected:
    """The log of one unit with corrected rates (rad/s); axes that the calibration does not have stay as they are.

    Solves measured = (1 + M(T, ω))·ω + B(T) for ω, row by row; beyond the calibration's range its value at the edge
    holds, and `Corrected` counts such rows. Masked rows are corrected too, and stay masked.

    Errors: `LogError` where a temperature is needed that is not there, and where no axis of the log is calibrated.
    """
    number = log.unit_index(unit)
    common = [name for name in log.axes if name in {axis.name for axis in calibration.axis}]
    if not common:
        raise LogError(
            f"the log's axes ({', '.join(log.axes)}) are none of the calibration's "
            f"({', '.join(axis.name for axis in calibration.axis)})"
        )
    if needs_temperature(calibration):
        temperature = known_temperature(log, number)
    else:
        low, high = calibration.axis[0].valid_temperature
        temperature = np.full(len(log.time_s), 0.5 * (float(low) + float(high)))
    rates = log.rate_rad_per_s[number].copy()
    usable = log.usable(number)
    outside_temperature = outside_rate = 0
    for name in common:
        axis = calibration.axis_of(name)
        column = log.axis_index(name)
        at = followed(temperature, log.time_s, log.stretch_starts, float(axis.thermal_lag or 0.0))
        output = rates[:, column]
        if axis.bias_temperature_gradient is not None:
            output = output - axis.bias_temperature_gradient * temperature_slope(temperature, log.time_s)
        readable = np.isfinite(output)
        rate = np.full_like(output, np.nan)
        rate[readable] = correct(axis, output[readable], at[readable])
        rates[:, column] = rate
        if needs_temperature(calibration):
            outside_temperature += count_outside(at[usable], axis.valid_temperature)
        outside_rate += count_outside(rate[usable & readable], axis.valid_rate)
    forces = None if log.specific_force_m_per_s2 is None else log.specific_force_m_per_s2[number]
    corrected = log_corrected(log, number, calibration, rates, forces)
    alone = tuple(name for name in log.axes if name not in common)
    return Corrected(corrected, outside_temperature, outside_rate, alone)


def log_corrected(
    log: Log, number: int, calibration: Calibration | UnitCalibration, rates: Floats, forces: Floats | None
) -> Log:
    """The log of one unit alone, with these rates and specific forces `(n, axes)`."""
    return replace(
        log,
        rate_rad_per_s=rates[None],
        specific_force_m_per_s2=None if forces is None else forces[None],
        units=(log.units[number],),
        temperature_c=None if log.temperature_c is None else log.temperature_c[number][None],
        status=None if log.status is None else log.status[number][None],
        simulated=log.simulated or calibration.simulated,
        provenance={**log.provenance, "corrected": f"by the calibration of {calibration.serial_number}"},
    )


def count_outside(values: Floats, bounds: tuple[float, float]) -> int:
    low, high = float(bounds[0]), float(bounds[1])
    slack = 1e-9 * max(abs(low), abs(high))
    return int(np.count_nonzero((values < low - slack) | (values > high + slack)))
