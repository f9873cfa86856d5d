"""The rows of a unit, and the executed motion as pieces between them.

Row `i` of a log represents the time from row `i − 1` to itself.
"""

from typing import NamedTuple

import equinox as eqx
import numpy as np

from gradcal_jax.motion import Geometry, TableMotion, held

# A rest is one row of each channel, as in a plan, but its temperature is followed in pieces of this duration.
PIECE_S = 60.0
# Largest angle between nodes of a move (rad), and the fewest of them.
_NODE, FEWEST_NODES = np.radians(3.0), 16


class ImuRows(NamedTuple):
    """One unit's rows of a log, `(n,)` unless stated. `rates` `(n, 3)` rad/s and `force` `(n, 3)` m/s² along the body's
    axes, NaN for missing ones; `angles` `(n, L)` rad of the table's axes, NaN where not read; `standing`: all of them
    stand; `usable`: the row may be integrated; `mounting`: its number; `at_a_stop`: the row's angles are readings of
    axes that stand there, if only for an instant. `worth`: the readings of the spec's noise that a row's are worth
    (None: one); `at_end`: whether they are of the row's end, not of an instant near it (None: they are not);
    `table_rate`: the rate held by the table's only axis, rad/s.
    """

    time_s: np.ndarray
    rates: np.ndarray
    force: np.ndarray
    temperature_c: np.ndarray
    angles: np.ndarray
    standing: np.ndarray
    usable: np.ndarray
    mounting: np.ndarray
    at_a_stop: np.ndarray
    worth: np.ndarray | None = None
    table_rate: np.ndarray | None = None
    at_end: np.ndarray | None = None

    @property
    def stretch_starts(self) -> np.ndarray:
        """The rows at which the temperature may begin anew."""
        lost = np.flatnonzero(~self.usable & (np.diff(self.time_s, prepend=-np.inf) > 0.0))
        return np.union1d([0], lost)


class ExecutedImu(NamedTuple):
    """`motion` of `P` pieces, a rest or a move each; `rows` `(P + 1,)`: piece k is the log's rows `rows[k] + 1 …
    rows[k+1]`; `travelled`: of every move the angle (rad) since its beginning, at the edges of equal parts of its time;
    `averaged`: of every axis, after each of its moves, the number of readings `(m, 2)` in the mean, and the time from
    the first to the last, s (none: the angle was not read by events).
    """

    motion: TableMotion
    rows: np.ndarray
    travelled: tuple[np.ndarray | None, ...]
    averaged: tuple[np.ndarray, ...] = ()


class PieceBuilder:
    """The pieces of a motion, added in order of time, from row `first` on."""

    def __init__(self, log: ImuRows, first: int) -> None:
        self.log, self.rows = log, [first]
        self.axes, self.ways = list[int](), list[np.ndarray | None]()
        self._read, self._lost = list[bool](), list[bool]()
        # Between two rows of equal counts every row may be integrated.
        self._unusable = np.cumsum(~log.usable)

    def whole(self, row: int) -> bool:
        """Whether every row up to this one may be integrated, in one mounting."""
        last = self.rows[-1]
        return bool(self._unusable[last] == self._unusable[row] and self.log.mounting[last] == self.log.mounting[row])

    def add(self, row: int, axis: int = -1, way: np.ndarray | None = None, *, read: bool = True, lost: bool = False):
        """The piece up to a row, in which one axis moves over its `way` (None: all stand). `read`: a reading of the
        table ends it; a `lost` one is a gap."""
        self._lost.append(lost or not self.whole(row))
        self._read.append(read and not self._lost[-1])
        self.rows.append(row)
        self.axes.append(axis)
        self.ways.append(way)

    def rest(self, until: int, longest: float = PIECE_S, *, read_each: bool = True, read: bool = True) -> None:
        """A rest up to a row, in pieces of this time (s) at most, of which each is read, or the last alone."""
        time, first = self.log.time_s, self.rows[-1]
        parts = max(1, int(np.ceil((time[until] - time[first]) / longest - 1e-9)))
        times = np.linspace(time[first], time[until], parts + 1)[1:-1]
        # A table may stand through a part without rows.
        breaks = first + 1 + np.flatnonzero(np.diff(time[first : until + 1]) > PIECE_S)
        for row in np.union1d([*np.searchsorted(time[:until], times - 1e-9), until], [breaks - 1, breaks]).tolist():
            if row > self.rows[-1]:
                self.add(int(row), read=read_each or (read and row == until))

    def executed(self, geometry: Geometry, start: np.ndarray) -> ExecutedImu:
        """All of it as a motion, each piece at its mean rate; `start` `(L,)` rad."""
        log, rows, axis, lost = self.log, np.array(self.rows), np.array(self.axes), np.array(self._lost)
        duration, warm = np.diff(log.time_s[rows]), log.temperature_c[rows]
        turned = np.array([0.0 if way is None else way[-1] for way in self.ways])
        mean = turned / np.where(duration > 0.0, duration, 1.0)
        # Every move ends at a standstill.
        flags = {"read": np.array(self._read), "at_rest": np.ones(len(axis), bool), "moving": axis >= 0, "gap": lost}
        line = held(log.time_s[rows[:-1]], duration, mean, warm[:-1], warm[1:], **flags)
        return executed(log, geometry, line, rows, axis, tuple(self.ways), start)


def executed(log: ImuRows, geometry: Geometry, line, rows: np.ndarray, axis, ways, start: np.ndarray) -> ExecutedImu:
    """The motion of pieces that end at these rows. Neighbouring pieces of a rest are one segment, as far as no reading
    of the table between them divides it."""
    lost = np.asarray(line.gap)
    goes_on = (axis[1:] < 0) & (axis[:-1] < 0) & ~lost[1:] & ~lost[:-1]
    line = eqx.tree_at(lambda x: x.segment, line, np.concatenate([[0], np.cumsum(~goes_on)]))
    each = np.arange(len(axis))
    # The mounting changes only in pieces that are not read.
    return ExecutedImu(TableMotion(line, axis, log.mounting[rows[1:]], geometry, start, each, each, each), rows, ways)


def way_of(time_s: np.ndarray, turned: np.ndarray, path: float) -> np.ndarray:
    """The angle (rad) of a move since its begin, at the edges of equal parts of its time, by that at its rows `(n,)`;
    `path`: its whole path."""
    count = FEWEST_NODES
    while count * _NODE < path:
        count *= 2
    return np.interp(np.linspace(time_s[0], time_s[-1], count + 1), time_s, turned)


def mean_angles(log: ImuRows, spans: list[tuple[int, int]]) -> list[np.ndarray]:
    """The mean angles (rad) of all axes in every standstill. An axis that is not read there stands as it was last read,
    while another one turned, or as in the standstill before."""
    result: list[np.ndarray] = []
    after = 0
    for first, last in spans:
        mean = mean_known(log.angles[first : last + 1])
        unknown = np.flatnonzero(np.isnan(mean))
        if len(unknown) and not (result and log.at_a_stop.any()):
            raise ValueError(
                f"the table's angles are not known at the standstill {log.time_s[first]:.6g} s after the "
                "start of the log"
            )
        for k in unknown:
            stops = np.flatnonzero(np.isfinite(log.angles[after:first, k]))
            mean[k] = log.angles[after + stops[-1], k] if len(stops) else result[-1][k]
        result.append(mean)
        after = last + 1
    return result


def mean_known(values: np.ndarray) -> np.ndarray:
    """The mean of the finite values of each column; NaN where there is none."""
    known = np.isfinite(values)
    count = np.sum(known, axis=0)
    return np.where(count > 0, np.sum(np.where(known, values, 0.0), axis=0) / np.maximum(count, 1), np.nan)
