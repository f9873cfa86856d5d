"""The temperature of the regressors: a thermometer's readings without their noise and quantisation steps.

The column of dB/dṪ is the temperature's change from reading to reading. With a raw thermometer it contains every
quantisation step and all noise, which the bias does not follow (errors in variables): the estimate of the gradient is
biased towards zero, and its uncertainty too small. A die cannot follow such steps. So a parabola is fitted about every
instant, over a window that is long compared with the noise and short compared with the die's dynamics. With a minute at
100 samples/s, steps of 1/256 K leave about 0.1 mK, and the error for a die that follows a ramp of 1 K/min with a lag of
3 min is no larger (0.15 mK at the begin of the ramp). A corner without any lag is rounded by a tenth of the ramp's
change in 30 s.
"""

import numpy as np
from scipy.interpolate import CubicHermiteSpline

SMOOTHED_OVER_S = 60.0
# Rows are first averaged in bins, this number in a window; a window with fewer bins stays as measured.
_BINS = 60
_FEWEST_BINS = 8
# Stretches separated by more than this share of a window are smoothed separately.
_BREAK = 0.25


def smoothed_temperature(time_s: np.ndarray, temperature_c: np.ndarray, over_s: float = SMOOTHED_OVER_S) -> np.ndarray:
    """Temperatures `(n,)`, °C, at the instants `time_s` `(n,)`: a least-squares parabola
    through the readings within ± `over_s`/2 of each (a Savitzky–Golay filter for arbitrary times).

    Breaks longer than a quarter of the window are not bridged; at ends and breaks the window is cut.
    Stretches with too few readings for that (fewer than eight a window) stay as measured. `over_s` = 0 changes
    nothing. Errors: `ValueError` for a window that is negative or not finite.
    """
    if not 0.0 <= over_s < np.inf:
        raise ValueError(f"temperatures are smoothed over a time of 0 s or more, not {over_s}")
    if over_s == 0.0 or len(time_s) < _FEWEST_BINS:
        return temperature_c
    result = np.array(temperature_c, float)
    begins = np.flatnonzero(np.diff(time_s) > _BREAK * over_s) + 1
    for part in np.split(np.arange(len(time_s)), begins):
        rows = slice(int(part[0]), int(part[-1]) + 1)
        result[rows] = _smoothed(time_s[rows], result[rows], over_s)
    return result


def _smoothed(time: np.ndarray, temperature: np.ndarray, over: float) -> np.ndarray:
    """One unbroken stretch."""
    count, at, mean = _binned(time, temperature, over / _BINS)
    if len(at) < _FEWEST_BINS or len(at) < _FEWEST_BINS * (at[-1] - at[0]) / over:
        return temperature
    value, slope = _parabolas(count, at, mean, 0.5 * over)
    # Between the bins' centres the parabolas hardly differ; beyond the outer ones the last one is extrapolated.
    return CubicHermiteSpline(at, value, slope)(time)


def _binned(time: np.ndarray, temperature: np.ndarray, width: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows, mean time and mean temperature of the bins that hold any; the median is subtracted against rounding."""
    number = ((time - time[0]) / width).astype(np.int64)
    starts = np.flatnonzero(np.diff(number, prepend=-1))
    count = np.diff(starts, append=len(time)).astype(float)
    begin, middle = time[starts], float(np.median(temperature))
    into = np.add.reduceat(time - np.repeat(begin, count.astype(np.int64)), starts) / count
    return count, begin + into, middle + np.add.reduceat(temperature - middle, starts) / count


def _parabolas(count: np.ndarray, at: np.ndarray, mean: np.ndarray, half: float) -> tuple[np.ndarray, np.ndarray]:
    """Value and slope, at each bin, of the parabola fitted to the bins within ± `half`, weighted by their rows."""
    moments, sums = np.zeros((len(at), 5)), np.zeros((len(at), 3))
    first, last = np.searchsorted(at, at - half), np.searchsorted(at, at + half, side="right")
    # At the ends the window extends inwards until it has enough bins for a parabola.
    first = np.minimum(first, np.maximum(last - _FEWEST_BINS, 0))
    last = np.maximum(last, np.minimum(first + _FEWEST_BINS, len(at)))
    for ahead in range(int(np.max(last - first))):
        other = first + ahead
        inside = np.flatnonzero(other < last)
        other = other[inside]
        u = (at[other] - at[inside]) / half
        powers = count[other, None] * u[:, None] ** np.arange(5)
        moments[inside] += powers
        sums[inside] += powers[:, :3] * (mean[other] - mean[inside])[:, None]
    normal = moments[:, np.arange(3)[:, None] + np.arange(3)[None]]
    line = np.linalg.solve(normal, sums[:, :, None])[..., 0]
    return mean + line[:, 0], line[:, 1] / half
