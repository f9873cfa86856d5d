"""The executed motion of a table of one axis that is read while it stands, or that holds rates: a log's rows as pieces.

A segment is what lies between two readings, as in a plan: a rest, or moves with the rests beside them. It is divided
where the axis begins and ends to move. The readings tell the angle of each segment; the gyros tell how it is divided
between its moves, and the course of each. Where rows are missing or masked, or the mounting changes, the segment is a
gap: a new origin of the angle is read behind it.
"""

import itertools

import equinox as eqx
import numpy as np

from gradcal_jax.estimation.imu_executed import PIECE_S, SEEN, ExecutedImu, ImuRows, mean_motion, nodes_of_way
from gradcal_jax.estimation.plateaus import TablePoints
from gradcal_jax.formulas import runs
from gradcal_jax.motion import Geometry, TableMotion, frames

# A standstill between two moves is a piece of its own where it lasts longer; its rows next to a move may contain some
# of the move.
_STANDS_S, _GUARD_S = 1.0, 0.1
# Readings of a standing axis with less between them (rad) are of one standstill, whatever other axes do.
_SAME_STANDSTILL = np.radians(0.5)
# A value that a column repeats for longer than this many spacings of readings was read at its end, too.
_HELD = 3.0


def motion_by_readings(log: ImuRows, geometry: Geometry) -> ExecutedImu:
    """The motion in a log's rows of a table of one axis, whose angles count where `log.at_a_stop`.

    Where none is known, nothing is read of the moves. Errors: `ValueError` where there are fewer than two readings.
    """
    unknown = not np.isfinite(log.angles[:, 0]).any()
    read = log.at_a_stop & (np.isfinite(log.angles[:, 0]) | unknown)
    groups = [np.flatnonzero(read[a:b]) + a for a, b in runs(log.standing | read)]
    unusable = np.cumsum(~log.usable)
    groups = [part for rows in groups if len(rows) for part in _divided(log, rows, unusable)]
    if sum(map(len, groups)) < 2:
        raise ValueError("nothing can be estimated: the log has fewer than two readings while the table is at rest")
    worth = np.ones(len(read)) if log.worth is None else log.worth
    angles = np.zeros(len(read)) if unknown else log.angles[:, 0]
    stands = [float(np.average(angles[rows], weights=worth[rows])) for rows in groups]
    speed = _speed(log, geometry)
    rows, axes, flags, ways = [int(groups[0][0])], list[int](), list[tuple[bool, bool]](), list[np.ndarray | None]()

    def add(row: int, way: np.ndarray | None = None, *, reads: bool = False, lost: bool = False) -> None:
        if row > rows[-1]:
            rows.append(row)
            axes.append(-1 if way is None else 0)
            flags.append((reads, lost))
            ways.append(way)

    def stand(until: int, *, reads: bool) -> None:
        """A rest, in pieces in which the temperature is followed."""
        parts = int(np.ceil((log.time_s[until] - log.time_s[rows[-1]]) / PIECE_S - 1e-9))
        times = np.linspace(log.time_s[rows[-1]], log.time_s[until], max(parts, 1) + 1)[1:-1]
        for row in np.searchsorted(log.time_s[:until], times - 1e-9).tolist():
            add(row)
        add(until, reads=reads)

    for number, (first, *others) in enumerate(groups):
        if number:
            last, angle = rows[-1], stands[number] - stands[number - 1]
            if unknown or unusable[last] != unusable[first] or log.mounting[last] != log.mounting[first]:
                add(int(first), np.linspace(0.0, angle, 3), lost=True)
            else:
                still = _still(log, last, int(first))
                turned, path = _turned(log, speed, last, int(first), still, angle)
                for begin, end in itertools.pairwise([(last, last), *still, (int(first), int(first))]):
                    moves = np.arange(begin[1], end[0] + 1)
                    if len(moves) > 1:
                        time, way = log.time_s[moves], turned[moves - last] - turned[begin[1] - last]
                        count = nodes_of_way(path[end[0] - last] - path[begin[1] - last])
                        way = np.interp(np.linspace(time[0], time[-1], count + 1), time, way)
                        add(end[0], way, reads=end[0] == first)
                    stand(end[1], reads=end[1] == first)
        for row in others:
            whole = unusable[rows[-1]] == unusable[row]
            stand(int(row), reads=True) if whole else add(int(row), lost=True)
    at = np.array(rows)
    reads, lost = np.array(flags, bool).reshape(-1, 2).T
    turned = np.array([0.0 if way is None else way[-1] for way in ways])
    line = mean_motion(log, at, turned, np.array(axes) >= 0, reads, lost)
    line = eqx.tree_at(lambda x: x.share, line, worth[at[1:]])
    return _executed(line, log, geometry, at, np.array(axes), np.array([stands[0]]), tuple(ways))


def _divided(log: ImuRows, rows: np.ndarray, unusable: np.ndarray) -> list[np.ndarray]:
    """Readings of the only axis at rest, by standstills: it may stand elsewhere where another mounting begins, or
    after a part of a run that was not recorded."""
    turned = np.abs(np.diff(log.angles[rows, 0])) > _SAME_STANDSTILL
    other = (np.diff(log.mounting[rows]) != 0) | ((np.diff(unusable[rows]) > 0) & turned)
    return np.split(rows, np.flatnonzero(other) + 1)


def motion_at_points(points: TablePoints, log: ImuRows, geometry: Geometry) -> ExecutedImu:
    """The motion of the points of the standard method, each at a held rate of the only axis."""
    line = points.line
    moving = np.asarray(line.moving & ~line.gap)
    rates = np.where(moving, line.terms[:, 0], 0.0) * line.duration
    ways = tuple(np.linspace(0.0, way, 3) if moves else None for way, moves in zip(rates, moving, strict=True))
    return _executed(line, log, geometry, points.rows, np.where(moving, 0, -1), np.zeros(1), ways)


def _executed(line, log: ImuRows, geometry: Geometry, rows: np.ndarray, axis: np.ndarray, start: np.ndarray, ways):
    each = np.arange(len(axis))
    return ExecutedImu(TableMotion(line, axis, log.mounting[rows[1:]], geometry, start, each, each, each), rows, ways)


def _speed(log: ImuRows, geometry: Geometry) -> np.ndarray:
    """The axis's rate by the gyros `(n,)`, rad/s, less what they show at rest; constant where they do not see it."""
    axes = frames(geometry, np.zeros((len(geometry.mountings), 1)), np.arange(len(geometry.mountings))).axes[:, 0]
    still, known = log.standing & log.usable, np.isfinite(log.rates)
    rest = np.sum(np.where(known[still], log.rates[still], 0.0), axis=0) / np.maximum(known[still].sum(axis=0), 1)
    direction = axes[log.mounting] * known
    size = np.sum(direction**2, axis=1)
    along = np.sum(np.where(known, log.rates - rest, 0.0) * direction, axis=1)
    return np.where(size > SEEN**2, along / np.maximum(size, SEEN**2), 1.0)


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


def _turned(
    log: ImuRows, speed: np.ndarray, last: int, first: int, still: list[tuple[int, int]], angle: float
) -> tuple[np.ndarray, np.ndarray]:
    """What the axis has turned since row `last` by every row up to `first`, and its path (rad): by the gyros where it
    moves, adjusted to the `angle` by the readings in proportion to the path."""
    own = speed[last : first + 1].copy()
    own[0] = 0.0
    for a, b in still:
        own[a + 1 - last : b + 1 - last] = 0.0
    step = np.diff(log.time_s[last : first + 1], prepend=log.time_s[last])
    turned, path = np.cumsum(own * step), np.cumsum(np.abs(own) * step)
    return (turned + (angle - turned[-1]) * path / path[-1] if path[-1] > 0.0 else turned), path


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
