"""The executed plan: a log's standstills, moves and readings as a trajectory of the prediction's kind.

A reading is taken where the log has one. Pieces from one reading to the next are those of a plan's trajectory: a rest,
or a move with the rests beside it. Consecutive moves without a rest stop for an instant between them, and the row of
that instant is read, too, if the log has a reading there. Moves are divided for the noise that the rate drives. Only
the noise depends on the motion within a piece (mean rates suffice); the regressors come from the samples themselves
(`estimation.samples`).

Row `i` of a log represents the time from row `i − 1` to itself. Where rows are missing or masked the integral is
interrupted: a new origin of the angle is read at the first reading after it (a gap piece).
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from gradcal_jax.formulas import runs
from gradcal_jax.trajectory import Trajectory, held

_MOVE_PARTS = 8
# Readings of a standing axis with less between them (rad) are of one standstill, whatever other axes do.
_SAME_STANDSTILL = np.radians(0.5)
# A value that a column repeats for longer than this many spacings of readings was read at its end, too.
_HELD = 3.0


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
    reading: np.ndarray,
    *,
    longest_piece: float = np.inf,
    readings_in_row: np.ndarray | None = None,
) -> Executed:
    """The timeline of a log's rows, all arrays `(n,)`.

    `standing`: whether the axis stands (rows of one standstill are neighbours); `usable`: whether the row's sample may
    be integrated (false also where rows are missing before it); `reading`: the rows at whose ends the standing table
    was read, in a standstill or in an instant between two moves; `angle_rad` of the table there, None if unknown: then
    moves have no reference and are gaps. `rate_rad_per_s` is used for the noise only. `readings_in_row`: how many
    readings of the spec's noise a row's is worth. Errors: `ValueError` where there are fewer than two readings.
    """
    at = [np.flatnonzero(reading[a:b]) + a for a, b in runs(standing | reading)]
    at = [rows.tolist() for rows in at if len(rows)]
    if sum(map(len, at)) < 2:
        raise ValueError("nothing can be estimated: in this log the table never stands still for two readings")
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
    if readings_in_row is not None:
        line = replace(line, share=readings_in_row[where[1:]])
    return Executed(line, where, broken)


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


def within(rows: np.ndarray, pieces: np.ndarray, count: int) -> np.ndarray:
    """`(count,)`: whether a row lies in one of the chosen pieces."""
    change = np.zeros(count + 1, np.int64)
    np.add.at(change, rows[:-1][pieces] + 1, 1)
    np.add.at(change, rows[1:][pieces] + 1, -1)
    return np.cumsum(change[:-1]) > 0
