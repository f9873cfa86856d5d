"""The executed plan: a log's standstills and moves as a trajectory of the prediction's kind.

A reading is taken at the first and the last row of every standstill and every `read_every` between. The pieces between
readings are those of a plan's trajectory. Consecutive moves without a rest stop for an instant between them, and the
row of that instant is read, too. Moves are divided for the noise that the rate drives. Only the noise depends on the
motion within a piece (mean rates suffice); the regressors come from the samples themselves (`estimation.samples`).

Row `i` of a log represents the time from row `i − 1` to itself. Where rows are missing or masked the integral is
interrupted: a new origin of the angle is read at the first row of rest after it (a gap piece).
"""

from typing import NamedTuple

import numpy as np

from gradcal_jax.formulas import runs
from gradcal_jax.trajectory import Trajectory, held

_MOVE_PARTS = 8
# The speed at a stop is this many times below that on both sides; speeds below this share of the fastest are noise.
_DIP = 10.0
_SLOWEST = 1e-4
# Largest difference between the angles of table and sensor on the move, as a share of the move's extent.
_FOLLOWS = 0.02


class Executed(NamedTuple):
    """`line` of `P` pieces; `rows` `(P + 1,)`: piece k is rows `rows[k] + 1 … rows[k+1]`, unused where `broken[k]`."""

    line: Trajectory
    rows: np.ndarray
    broken: np.ndarray


def executed(
    time_s: np.ndarray,
    temperature_c: np.ndarray,
    rate_rad_per_s: np.ndarray,
    angle_rad: np.ndarray | None,
    standing: np.ndarray,
    usable: np.ndarray,
    *,
    read_every: float = 1.0,
    longest_piece: float = np.inf,
    reading_rows: np.ndarray | None = None,
) -> Executed:
    """The timeline of a log's rows, all arrays `(n,)`.

    `standing`: whether the axis stands (rows of one standstill are neighbours); `usable`: whether the row's sample may
    be integrated (false also where rows are missing before it); `angle_rad` of the table, None if unknown: then moves
    have no reference and are gaps. `rate_rad_per_s` is used for the noise only. `reading_rows` `(n,)`: the rows at
    which the table was read, if known; a standstill without any is read at its first row. Errors: `ValueError` where
    the log never stands for two readings.
    """
    if not read_every > 0.0:
        raise ValueError(f"the spacing of readings must be positive, not {read_every}")
    spans = _runs(standing)
    if not spans or not any(last > first for first, last in spans):
        raise ValueError("the log never stands still for two rows, so nothing can be read from it")
    at = [_readings(time_s, first, last, read_every, reading_rows) for first, last in spans]
    rows, flags = [at[0][0]], list[tuple[bool, ...]]()

    def add(row: int, *, reads: bool, stands: bool, is_gap: bool = False, moves: bool = False, lost: bool = False):
        rows.append(row)
        flags.append((reads, stands, is_gap, moves, lost))

    # Between two rows of equal counts every row may be integrated.
    unusable = np.cumsum(~usable)
    for number, (first, *others) in enumerate(at):
        if number:
            before = rows[-1]
            if angle_rad is not None and unusable[before] == unusable[first]:
                for row in _parts(time_s, before, first, longest_piece):
                    add(row, reads=row == first, stands=row == first, moves=True)
            else:
                # The move draws the offset of the next standstill; a new origin is read after it.
                add(first, reads=False, stands=True, moves=True, lost=True)
                add(first, reads=False, stands=True, is_gap=True, lost=True)
        for row in others:
            unbroken = unusable[rows[-1]] == unusable[row]
            add(row, reads=unbroken, stands=True, is_gap=not unbroken, lost=not unbroken)
    where, (read, rest, gap, moving, broken) = np.array(rows), np.array(flags, bool).reshape(-1, 5).T
    line = _line(time_s, temperature_c, rate_rad_per_s, angle_rad, where, read, rest, gap, moving)
    return Executed(line, where, broken)


def momentary_stops(
    rate_rad_per_s: np.ndarray, standing: np.ndarray, angle_rad: np.ndarray, step_s: np.ndarray
) -> np.ndarray:
    """`(n,)`: rows within moves at which the table stops for an instant between two turns.

    Those are the slowest rows of minima from which the speed rises tenfold on both sides. The integrated error is read
    there as accurately as at rest, since it hardly changes within a row. Moves in which the table's angle does not
    follow the sensor's (it was interpolated between readings) have none.
    """
    result = np.zeros(len(standing), bool)
    speed = np.abs(rate_rad_per_s)
    moving = speed[~standing]
    if not len(moving):
        return result
    slowest = _SLOWEST * float(moving.max()) + np.finfo(float).tiny
    for first, last in _runs(~standing):
        stops = valleys(speed[first : last + 1], slowest)
        if len(stops):
            turned = np.cumsum(rate_rad_per_s[first : last + 1] * step_s[first : last + 1])
            apart = angle_rad[first : last + 1] - turned
            apart = apart - np.linspace(apart[0], apart[-1], len(apart))
            if np.all(np.abs(apart) < _FOLLOWS * np.ptp(turned)):
                result[first + stops] = True
    return result


def valleys(speed: np.ndarray, slowest: float) -> np.ndarray:
    """Rows of the minima from which a speed rises tenfold on both sides; speeds below `slowest` count as equal."""
    # Imported where it is used: it imports all of SciPy's statistics.
    from scipy.signal import find_peaks

    return find_peaks(-np.log(np.maximum(speed, slowest)), prominence=np.log(_DIP))[0]


def _line(time, temperature, rate, angle, at, read, rest, gap, moves) -> Trajectory:
    duration = np.diff(time[at])
    mean = np.zeros(len(moves))
    if moves.any():
        steps = np.diff(time, prepend=time[0])
        turned = np.diff(np.cumsum(rate * steps)[at])
        if angle is not None:
            turned = _as_the_table(turned, angle[at], moves)
        mean = np.where(moves, turned / np.where(duration > 0, duration, 1.0), 0.0)
    cold = temperature[at]
    return held(time[at[:-1]], duration, mean, cold[:-1], cold[1:], read=read, at_rest=rest, moving=moves, gap=gap)


def _as_the_table(turned: np.ndarray, angle: np.ndarray, moves: np.ndarray) -> np.ndarray:
    """The angles of each move's pieces, corrected to sum to the table's angle."""
    result = turned.copy()
    for first, last in _runs(moves):
        total = angle[last + 1] - angle[first]
        ours = turned[first : last + 1].sum()
        result[first : last + 1] += (total - ours) / (last + 1 - first)
    return result


def _readings(time: np.ndarray, first: int, last: int, every: float, known: np.ndarray | None) -> list[int]:
    """Rows of one standstill that are read: first, last and those `every` apart between; or the `known` ones."""
    if known is not None:
        readings = np.flatnonzero(known[first : last + 1]) + first
        return [int(r) for r in readings] or [first]
    if last == first:
        return [first]
    goals = np.arange(time[first] + every, time[last] - 0.5 * every, every) if np.isfinite(every) else np.zeros(0)
    rows = np.searchsorted(time[first : last + 1], goals - 1e-9) + first
    return [first, *dict.fromkeys(int(r) for r in rows if first < r < last), last]


def distinct_readings(time_s: np.ndarray, angle_rad: np.ndarray, standing: np.ndarray, read_every: float) -> np.ndarray:
    """`(n,)`: one row for each reading of the table, in a log that repeats every reading in neighbouring rows.

    Rows that repeat one reading share its error and must not count separately. But two readings may agree to the last
    digit: a value that lasts twice as long as usual counts as two readings (counted as one it would increase the
    scatter of the others by some per cent). A value that is repeated for more than three times `read_every` is read at
    its first and last row.
    """
    result = np.zeros(len(time_s), bool)
    repeats: list[tuple[int, int]] = []
    for first, last in _runs(standing):
        begins = np.flatnonzero(np.diff(angle_rad[first : last + 1], prepend=np.nan) != 0.0) + first
        repeats += zip(begins.tolist(), np.append(begins[1:] - 1, last).tolist(), strict=True)
    usual = float(np.median([b + 1 - a for a, b in repeats])) if repeats else 1.0
    for a, b in repeats:
        if time_s[b] - time_s[a] > 3.0 * read_every:
            result[[a, b]] = True
        else:
            # At ends of standstills a value may last 1.5 times as long and is still one reading.
            count = max(int((b + 1 - a) / usual + 0.25), 1)
            result[a + (np.arange(count) * 2 + 1) * (b + 1 - a) // (2 * count)] = True
    return result


def _parts(time: np.ndarray, before: int, after: int, longest: float) -> list[int]:
    """The rows at which a move is divided, its end included."""
    lasts = time[after] - time[before]
    count = min(max(_MOVE_PARTS, int(np.ceil(lasts / longest))), after - before)
    goals = np.linspace(time[before], time[after], count + 1)[1:-1]
    rows = np.searchsorted(time[before : after + 1], goals - 1e-9) + before
    return [*dict.fromkeys(int(r) for r in rows if before < r < after), after]


def _runs(where: np.ndarray) -> list[tuple[int, int]]:
    """First and last row of every run of true values."""
    return [(int(first), int(end) - 1) for first, end in runs(where)]
