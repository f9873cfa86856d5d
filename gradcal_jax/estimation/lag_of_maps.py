"""The lag of a sensor's maps behind the measured temperature: whether a log shows one, and how long it is."""

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np

from gradcal_jax.estimation import ExecutedImu, ImuEstimate, ImuReadings, ImuRows, chi_squared_test
from gradcal_jax.estimation.added_columns import Beside, Whitener
from gradcal_jax.formulas import BRIDGED_S, followed

_LONGEST_S: Final = 1800.0
# The reduction of χ² from which on a lag is used: of one whose size the spec states, χ² with that of the lag itself;
# otherwise minima far from zero may be deep.
_SURE, _EXPECTED = 25.0, 9.0
# Linearisations, until the lag changes by less than this share of its standard deviation.
_ROUNDS, _STANDS = 8, 0.1
# Another lag, for the slope: a share of it, and at least so much (s).
_APART, _APART_S = 0.05, 1.0
# The time (s) at a record's begin from which its slope is taken, the rows that it needs, and the square of the slope in
# standard deviations from which on it counts.
_BEGINS_S, _FEWEST_ROWS, _NO_CHANCE = 20.0, 8, 16.0
# How late the dies are at such a begin is uncertain by so many times what they are late after a long time.
_ANY_BEGIN = 10.0
# A fit with a lag holds from this chance of χ² on, or if it leaves at most this share of the excess of χ².
_HOLDS, _LEFT = 0.001, 0.1
# Lags (s) that are tried in the residuals, and the chance of such residuals without one.
_TRIED_S, _BY_CHANCE = (15.0, 60.0, 240.0), 0.01


class Fit(NamedTuple):
    """The executed motion, the readings of it, and the estimate. `rates` `(n, 3)`: the gyros', corrected, rad/s."""

    executed: ExecutedImu
    readings: ImuReadings
    solution: ImuEstimate
    rates: np.ndarray


class Lag(NamedTuple):
    """The lag of the maps, s; `std`: its standard deviation where it was fitted; `in_rows`: a possible lag is an error
    that all rows have in common."""

    seconds: float
    std: float | None = None
    in_rows: bool = False

    @property
    def uncounted(self) -> float | None:
        """The standard deviation that the covariance of the parameters does not contain; None: that of the spec."""
        return 0.0 if self.in_rows else self.std

    @property
    def sentences(self) -> list[str]:
        """What is said of a fitted lag."""
        if self.std is None:
            return []
        return [f"the maps lag behind the measured temperature by {self.seconds:.4g} s (1σ {self.std:.2g} s)"]


class LateTemperatures:
    """The temperature (°C) of all rows as a function of a lag (s). Where a record begins while the temperature changes,
    the dies are late, as after a long time of that change; but they may have rested until then, or settle more slowly
    than the thermometer, which is near its end already: the data tell by how much.

    `wander` (K²/s): the rate at which the variance of the thermometer's error grows in short times.
    """

    def __init__(self, rows: ImuRows, wander: float = 0.0) -> None:
        time, measured, starts = rows.time_s, rows.temperature_c, rows.stretch_starts
        self._of, begins = rows, [k for k in starts.tolist() if not k or time[k] - time[k - 1] > BRIDGED_S]
        records = [slice(*ends) for ends in pairwise([*begins, len(time)])]
        slopes = [(part, _first_slope(time[part], measured[part], wander)) for part in records]
        self._slopes = [(part, slope) for part, slope in slopes if slope]

    def __call__(self, lag: float) -> np.ndarray:
        rows = self._of
        settled = followed(rows.temperature_c, rows.time_s, rows.stretch_starts, lag)
        return sum((doubt / _ANY_BEGIN for doubt in self.doubts(lag)), settled)

    def doubts(self, lag: float) -> list[np.ndarray]:
        """Of each such record, the change (K) of all rows by one standard deviation of how late its dies are."""
        if not lag:
            return []
        changes, time = [np.zeros(len(self._of.time_s)) for _ in self._slopes], self._of.time_s
        for change, (part, slope) in zip(changes, self._slopes, strict=True):
            change[part] = -_ANY_BEGIN * lag * slope * np.exp(-(time[part] - time[part.start]) / lag)
        return changes


def _first_slope(time_s: np.ndarray, temperature_c: np.ndarray, wander: float) -> float:
    """dT/dt (K/s) of a record's first row, if it is not chance: of a parabola, as a ramp begins slowly."""
    count = int(np.searchsorted(time_s, time_s[0] + _BEGINS_S))
    if count < _FEWEST_ROWS:
        return 0.0
    powers = np.vander((time_s[:count] - time_s[0]) / _BEGINS_S, 3)
    inverse = np.linalg.inv(powers.T @ powers)
    parabola = inverse @ (powers.T @ temperature_c[:count])
    left = temperature_c[:count] - powers @ parabola
    # A parabola's slope at its end has four times the variance of a line's.
    variance = inverse[1, 1] * float(left @ left) / (count - 3) + 4.0 * wander * _BEGINS_S
    return float(parabola[1]) / _BEGINS_S if parabola[1] ** 2 > _NO_CHANCE * variance else 0.0


def fit_with_lag(
    fit_at: Callable[[float, Fit | None], Fit],
    temperature_of: Callable[[float], np.ndarray],
    size_s: float | None = None,
) -> tuple[Lag, Fit, tuple[str, ...]]:
    """The lag of the maps of all channels if the data show one, the fit with it, and messages. `fit_at`: with a lag
    (s), from another fit; `temperature_of` (°C, of all rows): with a lag; `size_s`: its standard deviation by the
    spec."""
    prompt = fit = fit_at(0.0, None)
    beside, columns = _changes(prompt, temperature_of, _TRIED_S)
    tried = beside.components(columns)
    if tried.test(prompt.solution.excess**0.5).probability >= _BY_CHANCE:
        return Lag(0.0), prompt, ()
    # The one that leaves the smallest residuals.
    best = int(np.argmin(np.sum((beside.left - beside.of(columns)) ** 2, axis=0)))
    lag, std, following = 0.0, 0.0, _TRIED_S[best]
    for _ in range(_ROUNDS):
        lag = following
        fit = fit_at(lag, fit)
        apart = max(_APART * lag, _APART_S)
        beside, columns = _changes(fit, temperature_of, [lag + apart])
        column = beside.of(columns)[:, 0]
        gain = max(float(column @ column), np.finfo(float).tiny)
        following = float(np.clip(lag + float(column @ beside.left[:, 0]) / gain * apart, 0.0, _LONGEST_S))
        # Larger if the fit does not hold.
        std = float(np.sqrt(fit.solution.excess / gain)) * apart
        if abs(following - lag) <= _STANDS * std:
            break
    before, after, degrees = prompt.solution.chi_squared, fit.solution.chi_squared, fit.solution.degrees
    least = _EXPECTED + (lag / size_s) ** 2 if size_s else _SURE
    unsure = lag > 0.99 * _LONGEST_S or lag < 2.0 * std
    if before - after <= least * fit.solution.excess or unsure:
        return Lag(0.0), prompt, ()
    holds = chi_squared_test(after, degrees).probability > _HOLDS
    if not holds and after - degrees > _LEFT * (before - degrees):
        # What contradicts the model is something else, which a lag may resemble.
        return Lag(0.0), prompt, (
            f"a lag of the maps of {lag:.3g} s would reduce χ² from {before:.0f} to {after:.0f} of {degrees}, "
            "but not explain it: zero lag is assumed",
        )  # fmt: skip
    return Lag(lag, std), fit, ()


def _changes(
    fit: Fit, temperature_of: Callable[[float], np.ndarray], lags: Sequence[float]
) -> tuple[Beside, np.ndarray]:
    """What the fit leaves of its data, and how its whitened readings would change with other lags (s)."""
    readings, parameters = fit.readings, fit.solution.parameters
    now = readings.expected(parameters)
    changes = [readings.at(temperature_of(lag), parameters) - now for lag in lags]
    return Beside(fit.solution.white), Whitener(readings)(np.stack(changes, axis=1))
