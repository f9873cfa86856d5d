"""The readings of a log: which rows a standing axis is read at, and the pieces of time between them."""

from typing import NamedTuple

import numpy as np

from gradcal_jax.formulas import runs
from gradcal_jax.trajectory import Trajectory

# Readings of a standing axis with less between them (rad) are of one standstill, whatever other axes do.
_SAME_STANDSTILL = np.radians(0.5)
# A value that a column repeats for longer than this many spacings of readings was read at its end, too.
_HELD = 3.0


class Executed(NamedTuple):
    """`line` of `P` pieces; `rows` `(P + 1,)`: piece k is rows `rows[k] + 1 … rows[k+1]`, unused where `broken[k]`."""

    line: Trajectory
    rows: np.ndarray
    broken: np.ndarray


def standing_with(standing: np.ndarray, rows: np.ndarray, angle_rad: np.ndarray) -> np.ndarray:
    """`(n,)`: rows at which an axis stands: those `standing`, and those between two of its readings, at `rows` `(R,)`
    in a standstill, without a turn between them (other axes may move there). `angle_rad` `(R,)`: of the readings."""
    result = standing.copy()
    for first, last, change in zip(rows[:-1], rows[1:], np.diff(angle_rad), strict=True):
        if abs(change) < _SAME_STANDSTILL:
            result[first : last + 1] = True
    return result


def column_readings(
    time_s: np.ndarray, angle_rad: np.ndarray | None, standing: np.ndarray, read_every: float
) -> np.ndarray:
    """`(n,)`: the rows to read in a log with the table's angle at every row, or without any: in each standstill the
    first and the last, and between them those `read_every` s apart.

    A value equal to that of the row before was not polled again and is no reading, but one that stays for more than
    three times `read_every` is read at its last row, too. An angle that never changes in the whole log says that the
    table stands, and shows no polls. Errors: `ValueError` where `read_every` is not positive.
    """
    if not read_every > 0.0:
        raise ValueError(f"the spacing of readings must be positive, not {read_every}")
    result = np.zeros(len(time_s), bool)
    if angle_rad is not None and np.all(angle_rad[standing] == angle_rad[standing][:1]):
        angle_rad = None
    for first, end in runs(standing).tolist():
        time = time_s[first:end]
        polled = np.ones(end - first, bool)
        if angle_rad is not None:
            polled[1:] = np.diff(angle_rad[first:end]) != 0.0
            begins = np.flatnonzero(polled)
            lasts = np.append(begins[1:], end - first) - 1
            polled[lasts[time[lasts] - time[begins] > _HELD * read_every]] = True
        polls = np.flatnonzero(polled)
        between = np.isfinite(read_every)
        goals = np.arange(time[0] + read_every, time[-1] - 0.5 * read_every, read_every) if between else np.zeros(0)
        after = np.searchsorted(time[polls], goals - 1e-9)
        result[first + polls[np.concatenate([[0], after[after < len(polls)], [len(polls) - 1]])]] = True
    return result


def within(spans: np.ndarray, count: int) -> np.ndarray:
    """`(count,)`: whether a row is one of `first + 1 … last` of any of the `spans` `(k, 2)`."""
    change = np.zeros(count + 1, np.int64)
    np.add.at(change, spans + 1, [1, -1])
    return np.cumsum(change[:-1]) > 0
