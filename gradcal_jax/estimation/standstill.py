"""Standstills of a gyro from its own rates, for recordings without a table's angle.

Two quantities are computed in a window about each row: the spread and the mean of the rates. The spread at rest is the
noise or the vibration of a drive that holds its position, and differs between standstills; the spread of moves is
larger by orders of magnitude. So there are two criteria:

1. quiet stretches: the spread of all axes together is below the geometric mean of the quietest tenth and the largest
   spread (but not below `factor` times the quiet level, since a record may contain no move), and the mean is within the
   largest bias;
2. begin and end of each: the spread stays within `factor` times the stretch's own.

Stretches that are too short are not standstills.
"""

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.special import gammaincinv

from gradcal_jax import formulas

_QUIETEST = 0.10
# Rows of the shortest window; of one whose spread scatters itself.
_FEWEST_ROWS, _FEW_ROWS = 4, 10
# Spread of a quantised sensor that changes between two values half of the time or less, in counts.
_FLICKER = 0.3


def find_standstills(
    rate_rad_per_s: np.ndarray,
    sample_interval_s: float,
    *,
    window_s: float = 0.5,
    shortest_s: float = 1.0,
    factor: float = 3.0,
    largest_bias: float = np.radians(10.0),
    valid: np.ndarray | None = None,
    divide: bool = False,
) -> np.ndarray:
    """`(n,)`: the number of the standstill of each row, counted from 0; −1 while moving. Rates `(n, axes)`, rad/s.
    `divide`: a turn within a quiet stretch that is slow beside others divides it.

    A window has four rows at least, whatever the sample rate. Errors: `ValueError` where the record is shorter than two
    windows, or nothing is quiet enough.
    """
    width = max(round(window_s / sample_interval_s), _FEWEST_ROWS)
    if len(rate_rad_per_s) < 2 * width:
        raise ValueError("the record is shorter than two windows: nothing can be said of standstills")
    usable = np.ones(len(rate_rad_per_s), bool) if valid is None else valid
    mean, spread = _about_each_row(rate_rad_per_s, usable, width)
    # The output of a quantised sensor may be constant: then a share of one count is the level.
    counts = [_least_step(rate_rad_per_s[usable, k]) for k in range(rate_rad_per_s.shape[1])]
    least = _FLICKER * float(np.linalg.norm(counts))
    level = float(np.quantile(spread[usable], _QUIETEST))
    if width < _FEW_ROWS:
        # The spread of so few rows scatters itself: its quietest tenth is far below the usual.
        half = 0.5 * (width - 1) * rate_rad_per_s.shape[1]
        level *= float(np.sqrt(gammaincinv(half, 0.5) / gammaincinv(half, _QUIETEST)))
    level = max(level, least)
    quiet = max(factor * level, float(np.sqrt(level * np.max(spread[usable]))))
    still = usable & (spread <= quiet) & np.all(np.abs(mean) <= largest_bias, axis=1)
    number = np.full(len(still), -1, np.int64)
    count = 0
    for first, end in formulas.runs(still):
        calm = spread[first:end] <= factor * max(float(np.median(spread[first:end])), least)
        # A window that overlaps a move shortens the standstill by half its width at both ends, on the safe side.
        parts = formulas.runs(calm) if divide else np.flatnonzero(calm)[[0, -1]][None] + np.array([0, 1])
        for begin, stop in (first + parts).tolist():
            if (stop - begin) * sample_interval_s >= shortest_s:
                number[begin:stop] = count
                count += 1
    if not count:
        raise ValueError(
            f"nothing in the record is quiet for {shortest_s:g} s: is the sensor ever at rest? Otherwise mark the "
            "standstills yourself"
        )
    return number


def _about_each_row(rate: np.ndarray, usable: np.ndarray, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Means `(n, axes)` and standard deviation of all axes `(n,)` of the usable rates in a window about each row."""
    share = np.maximum(uniform_filter1d(usable.astype(float), width), 1.0 / width)[:, None]
    # About the median, since squares of a large constant would lose digits.
    middle = np.median(rate[usable], axis=0)
    apart = np.where(usable[:, None], rate - middle, 0.0)
    mean = uniform_filter1d(apart, width, axis=0) / share
    square = uniform_filter1d(apart**2, width, axis=0) / share
    return mean + middle, np.sqrt(np.sum(np.maximum(square - mean**2, 0.0), axis=1))


def _least_step(values: np.ndarray) -> float:
    """The smallest difference between values of one axis: a count of a quantised sensor, or almost zero."""
    distinct = np.unique(values[: 1 << 16])
    return float(np.min(np.diff(distinct))) if len(distinct) > 1 else 0.0
