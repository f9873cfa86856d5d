"""Gaps of one or two rows in a moving record, filled so that the motion can be integrated over them."""

from typing import NamedTuple

import numpy as np

from gradcal_jax import formulas

LONGEST = 2
"""Rows of a gap that is filled."""


class FilledRows(NamedTuple):
    """Rows on whole intervals: `time` `(n,)` s, `values` `(n, channels)`, `usable` `(n,)`, `standing` `(n,)` or None;
    `number` of filled rows, and the largest `error` `(channels,)` of a channel's integral over one gap: what the cubic
    through two rows on either side differs from the straight line, times the interval."""

    time: np.ndarray
    values: np.ndarray
    usable: np.ndarray
    standing: np.ndarray | None
    number: int
    error: np.ndarray


def fill_short_gaps(
    time: np.ndarray,
    values: np.ndarray,
    usable: np.ndarray,
    standing: np.ndarray | None,
    starts: np.ndarray,
    interval_s: float,
) -> FilledRows:
    """The rows with gaps of up to two of them filled by cubics, whether they are missing or not `usable`; `starts`:
    rows after gaps. Those after longer ones, and the first, are not usable: what lay before was not recorded."""
    after_gap = np.isin(np.arange(1, len(time)), starts)
    steps = np.where(after_gap, np.maximum(np.rint(np.diff(time) / interval_s), 1.0), 1.0).astype(np.int64)
    broken = after_gap & ((steps == 1) | (steps > LONGEST + 1))
    place = np.concatenate([[0], np.cumsum(np.where(broken, 1, steps))])
    size = int(place[-1]) + 1
    new_time = np.interp(np.arange(size), place, time)
    whole = np.full((size, values.shape[1]), np.nan)
    whole[place] = values
    good = np.zeros(size, bool)
    good[place] = usable
    begins = np.zeros(size, bool)
    begins[place[1:][broken]] = begins[0] = True
    numbers = None
    if standing is not None:
        before = np.searchsorted(place, np.arange(size), side="right") - 1
        after = np.minimum(before + 1, len(standing) - 1)
        inserted = place[before] != np.arange(size)
        numbers = np.where(inserted & (standing[before] != standing[after]), -1, standing[before])
    count, error = 0, np.zeros(values.shape[1])
    for start, stop in formulas.runs(~good).tolist():
        around = np.array([start - 2, start - 1, stop, stop + 1])
        if stop - start > LONGEST or around[0] < 0 or around[-1] >= size or begins[start - 1 : stop + 2].any():
            continue
        if not good[around].all():
            continue
        rows = np.arange(start, stop)
        # Lagrange's cubic, and the straight line.
        cubic = np.stack(
            [
                np.prod([(rows - m) / (k - m) for m in around if m != k], axis=0)
                for k in around
            ],
            axis=1,
        ) @ whole[around]  # fmt: skip
        share = ((rows - around[1]) / (around[2] - around[1]))[:, None]
        line = (1.0 - share) * whole[around[1]] + share * whole[around[2]]
        error = np.maximum(error, np.abs((cubic - line).sum(axis=0)) * interval_s)
        whole[rows], good[rows] = cubic, True
        count += len(rows)
    good[begins] = False
    return FilledRows(new_time, np.where(good[:, None], whole, np.nan_to_num(whole)), good, numbers, count, error)
