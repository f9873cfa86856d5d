"""The executed motion of a table of one axis that is read while it stands: a log's rows as pieces.

A segment is what lies between two readings, as in a plan: a rest, or moves with the rests beside them. It is divided
where the axis begins and ends to move. The readings tell the angle of each segment; the gyros tell how it is divided
between its moves, and the course of each. Where rows are missing or masked, or the mounting changes, the segment is a
gap: a new origin of the angle is read behind it.
"""

import itertools

import equinox as eqx
import numpy as np

from gradcal_jax.estimation.gyro_stops import SEEN
from gradcal_jax.estimation.imu_rows import ExecutedImu, ImuRows, PieceBuilder, mean_known, way_of
from gradcal_jax.formulas import runs
from gradcal_jax.motion import Geometry, frames

# A standstill between two moves is a piece of its own where it lasts longer; its rows next to a move may contain some
# of the move.
_STANDS_S, _GUARD_S = 1.0, 0.1
# Readings of a standing axis with less between them (rad) are of one standstill, whatever other axes do.
_SAME_STANDSTILL = np.radians(0.5)
# A value that a column repeats for longer than this many spacings of readings was read at its end, too.
_HELD = 3.0


def motion_by_readings(log: ImuRows, geometry: Geometry) -> ExecutedImu:
    """The motion in a log's rows of a table of one axis, whose angles count where `log.at_a_stop`.

    Errors: `ValueError` where there are fewer than two readings.
    """
    read = log.at_a_stop & np.isfinite(log.angles[:, 0])
    groups = [np.flatnonzero(read[a:b]) + a for a, b in runs(log.standing | read)]
    unusable = np.cumsum(~log.usable)
    groups = [part for rows in groups if len(rows) for part in _divided(log, rows, unusable)]
    if sum(map(len, groups)) < 2:
        raise ValueError("nothing can be estimated: the log has fewer than two readings while the table is at rest")
    worth = np.ones(len(read)) if log.worth is None else log.worth
    stands = [float(np.average(log.angles[rows, 0], weights=worth[rows])) for rows in groups]
    speed, pieces = _speed(log, geometry), PieceBuilder(log, int(groups[0][0]))
    for number, (first, *others) in enumerate(groups):
        if number and not pieces.whole(first):
            pieces.add(int(first), 0, np.linspace(0.0, stands[number] - stands[number - 1], 3), lost=True)
        elif number:
            _move(log, pieces, speed, int(first), stands[number] - stands[number - 1])
        for row in others:
            pieces.rest(int(row), read_each=False) if pieces.whole(row) else pieces.add(int(row))
    done = pieces.executed(geometry, np.array([stands[0]]))
    return done._replace(motion=eqx.tree_at(lambda m: m.line.share, done.motion, worth[done.rows[1:]]))


def _divided(log: ImuRows, rows: np.ndarray, unusable: np.ndarray) -> list[np.ndarray]:
    """Readings of the only axis at rest, by standstills: it may stand elsewhere where another mounting begins, or
    after a part of a run that was not recorded."""
    turned = np.abs(np.diff(log.angles[rows, 0])) > _SAME_STANDSTILL
    other = (np.diff(log.mounting[rows]) != 0) | ((np.diff(unusable[rows]) > 0) & turned)
    return np.split(rows, np.flatnonzero(other) + 1)


def _speed(log: ImuRows, geometry: Geometry) -> np.ndarray:
    """The axis's rate by the gyros `(n,)`, rad/s, less what they show at rest; constant where they do not see it."""
    axes = frames(geometry, np.zeros((len(geometry.mountings), 1)), np.arange(len(geometry.mountings))).axes[:, 0]
    rest, known = np.nan_to_num(mean_known(log.rates[log.standing & log.usable])), np.isfinite(log.rates)
    direction = axes[log.mounting] * known
    size = np.sum(direction**2, axis=1)
    along = np.sum(np.where(known, log.rates - rest, 0.0) * direction, axis=1)
    return np.where(size > SEEN**2, along / np.maximum(size, SEEN**2), 1.0)


def _move(log: ImuRows, pieces: PieceBuilder, speed: np.ndarray, first: int, angle: float) -> None:
    """Add what lies between the last reading and that of the row `first`: moves by the gyros, adjusted to the `angle`
    by the readings in proportion to the path, with the rests between them."""
    last = pieces.rows[-1]
    still, own = _still(log, last, first), speed[last : first + 1].copy()
    own[0] = 0.0
    for a, b in still:
        own[a + 1 - last : b + 1 - last] = 0.0
    step = np.diff(log.time_s[last : first + 1], prepend=log.time_s[last])
    turned, path = np.cumsum(own * step), np.cumsum(np.abs(own) * step)
    if path[-1] > 0.0:
        turned = turned + (angle - turned[-1]) * path / path[-1]
    for begin, end in itertools.pairwise([(last, last), *still, (first, first)]):
        moves = np.arange(begin[1], end[0] + 1)
        if len(moves) > 1:
            inside = moves - last
            way = turned[inside] - turned[inside[0]]
            way = way_of(log.time_s[moves], way, float(path[inside[-1]] - path[inside[0]]))
            pieces.add(end[0], 0, way, read=end[0] == first)
        pieces.rest(end[1], read_each=False, read=end[1] == first)


def _still(log: ImuRows, last: int, first: int) -> list[tuple[int, int]]:
    """First and last row of the standstills between two readings, those at the readings themselves included."""
    result: list[tuple[int, int]] = []
    for a, b in runs(log.standing[last : first + 1]).tolist():
        begin, end = last + a, last + b - 1
        if begin > last:
            begin = int(np.searchsorted(log.time_s, log.time_s[begin] + _GUARD_S))
        if end < first:
            end = int(np.searchsorted(log.time_s, log.time_s[end] - _GUARD_S))
        if end > begin and log.time_s[end] - log.time_s[begin] > _STANDS_S:
            result.append((begin, end))
    return result


def standing_with(standing: np.ndarray, rows: np.ndarray, angle_rad: np.ndarray) -> np.ndarray:
    """`(n,)`: rows at which an axis stands: those `standing`, and those between two of its readings, at `rows` `(R,)`
    in a standstill, without a turn between them (other axes may move there). `angle_rad` `(R,)`: of the readings."""
    result = standing.copy()
    for k in np.flatnonzero(np.abs(np.diff(angle_rad)) < _SAME_STANDSTILL):
        result[rows[k] : rows[k + 1] + 1] = True
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
        # The nearest poll, not the next one: one that came just before its goal would be lost.
        nearest = np.searchsorted((time[polls[1:]] + time[polls[:-1]]) / 2.0, goals)
        result[first + polls[np.concatenate([[0], nearest, [len(polls) - 1]])]] = True
    return result


def within(spans: np.ndarray, count: int) -> np.ndarray:
    """`(count,)`: whether a row is one of `first + 1 … last` of any of the `spans` `(k, 2)`."""
    change = np.zeros(count + 1, np.int64)
    np.add.at(change, spans[:, 0] + 1, 1)
    np.add.at(change, spans[:, 1] + 1, -1)
    return np.cumsum(change[:-1]) > 0
