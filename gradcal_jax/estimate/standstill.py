"""Where a gyro stands still, from its own rates: for recordings without a table that says so.

Two quantities are looked at over a window about each row: the spread of the rates in it, and how far its mean is from
the mean at rest. At rest the first is the noise, whose level is taken from the quietest tenth of the record; a row
stands still where the spread of *every* axis is below `factor` times that level and the mean rate is within what a
bias may be. Runs that are too short are no standstills.
"""

import numpy as np
from scipy.ndimage import uniform_filter1d

_QUIETEST = 0.10


def find_standstills(
    rate_rad_per_s: np.ndarray,
    sample_interval_s: float,
    *,
    window_s: float = 0.5,
    shortest_s: float = 1.0,
    factor: float = 3.0,
    largest_bias: float = np.radians(10.0),
    valid: np.ndarray | None = None,
) -> np.ndarray:
    """`(n,)`: the number of the standstill of each row, counted from 0; −1 while moving. Rates `(n, axes)`, rad/s.

    Errors: `ValueError` where the window holds fewer than four rows, or nothing is quiet enough.
    """
    width = round(window_s / sample_interval_s)
    if width < 4:
        raise ValueError(f"a window of {window_s:g} s holds fewer than four rows: take a longer one")
    if len(rate_rad_per_s) < 2 * width:
        raise ValueError("the record is shorter than two windows: nothing can be said of standstills")
    usable = np.ones(len(rate_rad_per_s), bool) if valid is None else valid
    rates = np.where(usable[:, None], rate_rad_per_s, 0.0)
    share = np.maximum(uniform_filter1d(usable.astype(float), width), 1.0 / width)[:, None]
    mean = uniform_filter1d(rates, width, axis=0) / share
    square = uniform_filter1d((rates - np.median(rates[usable], axis=0)) ** 2, width, axis=0) / share
    spread = np.sqrt(np.maximum(square - (mean - np.median(rates[usable], axis=0)) ** 2, 0.0))
    level = np.quantile(spread[usable], _QUIETEST, axis=0)
    # A quantised sensor may be perfectly quiet: then one count is the level.
    counts = np.array([_least_step(rates[usable, k]) for k in range(rates.shape[1])])
    level = np.maximum(level, 0.3 * counts)
    still = usable & np.all(spread <= factor * level, axis=1) & np.all(np.abs(mean) <= largest_bias, axis=1)
    # A window that touches a move is restless half its width too early and too late, on the safe side.
    number = np.full(len(still), -1, np.int64)
    padded = np.zeros(len(still) + 2, np.int8)
    padded[1:-1] = still
    edges = np.flatnonzero(np.diff(padded)).reshape(-1, 2)
    lasting = [(a, b) for a, b in edges if (b - a) * sample_interval_s >= shortest_s]
    if not lasting:
        raise ValueError(
            f"nothing in the record is quiet for {shortest_s:g} s: is the sensor ever at rest? Otherwise mark the "
            "standstills yourself"
        )
    for k, (a, b) in enumerate(lasting):
        number[a:b] = k
    return number


def _least_step(values: np.ndarray) -> float:
    """The smallest difference between values of one axis: a count of a quantised sensor, or nearly nothing."""
    distinct = np.unique(values[: 1 << 16])
    return float(np.min(np.diff(distinct))) if len(distinct) > 1 else 0.0
