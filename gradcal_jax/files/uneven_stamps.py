"""Stamps that are not even though the sensor's clock is: bursts of a queue, pairs, whole milliseconds.

Such stamps come back to an even clock again and again, where lost rows leave it for ever:

    t_i             stamps;  a burst begins where an interval is longer than jitter
    P               median time from burst to burst;  m  rows of most bursts
    even            the line through all t_i, or its running mean over many bursts, if all t_i stay within a burst of it

A pause between two bursts of much more than P is a gap: it is taken out, the rest is looked at as one, and it is put
back. Where bursts come evenly and some have fewer than m rows, rows were lost within them: the clock has m rows in P.
"""

import importlib
from typing import Any, Final

import numpy as np

from gradcal_jax.files.log import Floats, Whole

_MANY, _MANY_ROWS = 0.005, 20
# Bursts over which a wandering clock is averaged, and bursts by which stamps may leave it.
_BURSTS, _WITHIN = 40, 1.5
# Times the usual, beyond which a pause between bursts is a gap; bursts come evenly within this share of their period.
_PAUSE, _EVENLY = 1.6, 0.02
# Least share of whole bursts from which their number of rows is known.
_WHOLE: Final = 0.3


def even_clock(time: Floats, suspects: Whole) -> tuple[Floats, Whole, int] | None:
    """Even times, rows at which stretches begin, and the number of lost rows, of stamps `(n,)` with seeming gaps after
    the rows `suspects`; None where they are not of an even clock."""
    count = len(suspects)
    if count < max(_MANY_ROWS, _MANY * len(time)):
        return None
    interval = np.diff(time)
    usual = float(np.median(interval[suspects]))
    # (Shorter ones are of rows lost within a burst.)
    suspects = suspects[interval[suspects] > 0.5 * usual]
    begins = np.concatenate([[0], suspects + 1])
    period = float(np.median(np.diff(time[begins])))
    pauses = suspects[interval[suspects] > usual + _PAUSE * period - min(period, usual)]
    shift = np.zeros(len(time))
    shift[pauses + 1] = interval[pauses] - usual
    shift = np.cumsum(shift)
    joined = time - shift
    rows, sizes, most, lost = _rows_of_clock(joined, begins, period)
    even = _even(joined, rows, count)
    if even is None:
        return None
    starts = np.concatenate([[0], pauses + 1])
    if lost:
        starts = np.union1d(starts, begins[1:][sizes[:-1] < most])
    return even + shift, starts.astype(np.int64), lost + round(float(shift[-1]) / (period / most))


def _rows_of_clock(time: Floats, begins: Whole, period: float) -> tuple[Floats, Whole, int, int]:
    """Ticks of the clock of each row, rows of each burst, of most bursts, and the number of those lost within."""
    sizes = np.diff(begins, append=len(time))
    most = int(np.bincount(sizes).argmax())
    apart = np.abs(np.diff(time[begins]) - period)
    rows = np.arange(len(time), dtype=np.float64)
    larger, smaller = np.mean(sizes[:-1] > most), np.mean(sizes[:-1] < most)
    evenly = float(np.quantile(apart, 0.9)) < _EVENLY * period
    # (A row that falls into the next burst is not lost.)
    if not (evenly and most > 1 and larger < 0.1 * smaller < 0.1 * (1.0 - _WHOLE)):
        return rows, sizes, max(most, 1), 0
    burst = np.repeat(np.arange(len(sizes)), sizes)
    return burst * most + rows - begins[burst], sizes, most, int(np.sum(most - sizes[:-1]))


def _even(time: Floats, rows: Floats, suspects: int) -> Floats | None:
    slope, first = np.polyfit(rows, time, 1)
    line = first + slope * rows
    burst = _WITHIN * float(np.max(np.diff(time)))
    # The clock may wander slowly: over many bursts.
    ndimage: Any = importlib.import_module("scipy.ndimage")
    width = 2 * (_BURSTS * len(time) // suspects // 2) + 1
    wander: Floats = ndimage.uniform_filter1d(time - line, width, mode="nearest")
    for even in (line, line + wander):
        if np.ptp(time - even) <= burst and np.all(np.diff(even) > 0.0):
            return even
    return None
