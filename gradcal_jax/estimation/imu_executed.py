"""The executed motion of a unit on a table of several axes: a log's standstills and moves as a `TableMotion`.

Between two standstills of the whole table one axis after the other turns. Where the log has the readings of the
encoders, those of an instant between two moves show which one. Otherwise the gyros do: their rate has a minimum at such
an instant, and their integral between two minima points along the axis that turned; two moves of one axis are then one.
The angle of an axis at rest is the mean of its readings between two of its own moves. Within a move
the gyros give the angle, adjusted to the encoder's angles at its ends.

Row `i` of a log represents the time from row `i − 1` to itself.
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np

from gradcal_jax.formulas import followed, runs
from gradcal_jax.model import SECOND, OtherTemperature
from gradcal_jax.motion import Geometry, TableMotion, Trajectory, frames, held

# A rest is one row of each channel, as in a plan, but its temperature is followed in pieces of this duration.
PIECE_S = 60.0
_GUARD_S = 0.1
# Rows further apart than this (s) do not show when a move begins and ends.
_SLOW_S = 0.06
# The speed at a stop is this many times below that on both sides; speeds below this share of the fastest are noise.
_DIP, _SLOWEST = 10.0, 1e-3
# A stop is read within this time of where the gyros see it.
_LATE_S = 0.5
# Least change of an axis's angle (rad) that counts as a turn.
_LEAST_TURN = np.radians(0.05)
# ... and that of two single readings, which have their own noise.
_TURNED = np.radians(1.0)
# The gyros' integral over a move differs from the table's angle by at most this share and this angle (rad).
_FOLLOWS, _BIAS = 0.05, np.radians(3.0)
# Largest angle between nodes of a move (rad).
_NODE = np.radians(3.0)
_FEWEST_NODES = 16
# Least share of an axis's rate along the gyros at which it is observable.
SEEN = 0.3


class ImuRows(NamedTuple):
    """One unit's rows of a log, `(n,)` unless stated. `rates` `(n, 3)` rad/s and `force` `(n, 3)` m/s² along the body's
    axes, NaN for missing ones; `angles` `(n, L)` rad of the table's axes, NaN where not read; `standing`: all of them
    stand; `usable`: the row may be integrated; `mounting`: its number; `at_a_stop`: the row's angles are readings of
    axes that stand there, if only for an instant. `worth`: the readings of the spec's noise that a row's are worth
    (None: one); `at_end`: whether they are of the row's end, not of an instant near it (None: they are not);
    `table_rate`: the rate held by the table's only axis, rad/s. `second_c`: the second thermometer's temperatures.
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
    second_c: np.ndarray | None = None

    @property
    def stretch_starts(self) -> np.ndarray:
        """The rows at which the temperature may begin anew."""
        lost = np.flatnonzero(~self.usable & (np.diff(self.time_s, prepend=-np.inf) > 0.0))
        return np.union1d([0], lost)

    def others(self, of: Sequence[OtherTemperature], temperature_c: np.ndarray) -> dict[str, np.ndarray]:
        """Other temperatures (°C) of every row by name, beside `temperature_c`, that of the maps."""
        return {
            name: followed(temperature_c, self.time_s, self.stretch_starts, lag)
            if name != SECOND or self.second_c is None
            else self.second_c
            for name, lag in of
        }


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


def executed_imu(
    log: ImuRows,
    geometry: Geometry,
    read_every: float = PIECE_S,
) -> ExecutedImu:
    """The motion in a log's rows. `read_every` s: the spacing of readings of a table that is read while it stands.

    Errors: `ValueError` where rows are too far apart, where the table never stands, where its angles are not known
    there, or where the gyros' integral over a move is not a sequence of turns of single axes.
    """
    spacing = float(np.median(np.diff(log.time_s)))
    moving = ~log.standing
    if spacing > _SLOW_S and np.any(moving[1:] & moving[:-1]):
        raise ValueError(
            f"the log has {1.0 / spacing:.3g} rows/s, too few to see the moves of several axes: record at least 20"
        )
    stands = [(int(a), int(b) - 1) for a, b in runs(log.standing) if b - a > 1]
    # Standstills of a run, whose readings are events, have margins already.
    spans = stands if log.at_a_stop.any() else [_inner(log.time_s, *stand) for stand in stands]
    if len(spans) < 2:
        raise ValueError("the log has fewer than two standstills, so there are no poses to compare")
    if read_every < PIECE_S and log.at_a_stop.any():
        # Every reading is a reference: a standstill is that from its first to its last.
        read = [np.flatnonzero(log.at_a_stop[a : b + 1]) + a for a, b in stands]
        spans = [(int(rows[0]), int(rows[-1])) for rows in read if len(rows)]
    # A reading has the row at which its axis stands; of an angle at every row those at the ends do not count.
    means = mean_angles(log, spans)
    legs = _legs(log, geometry, spans, means)
    angles, averaged = _own_angles(log, spans, legs)
    done = _pieces(log, geometry, spans, legs, angles, read_every)
    return done._replace(averaged=averaged) if log.at_a_stop.any() else done


class _Leg(NamedTuple):
    """A move of one axis (−1: unknown or none), rows `begin + 1 … end`, after standstill `span`."""

    span: int
    axis: int
    begin: int
    end: int


def mean_angles(log: ImuRows, spans: list[tuple[int, int]]) -> list[np.ndarray]:
    """The mean angles (rad) of all axes in every standstill. An axis that is not read there stands as it was last read,
    while another one turned, or as in the standstill before."""
    result: list[np.ndarray] = []
    after = 0
    for first, last in spans:
        read = log.angles[first : last + 1]
        known = np.isfinite(read)
        mean = np.sum(np.where(known, read, 0.0), axis=0) / np.maximum(known.sum(axis=0), 1)
        if not known.any(axis=0).all() and not (result and log.at_a_stop.any()):
            raise ValueError(
                f"the table's angles are not known at the standstill {log.time_s[first]:.6g} s after the "
                "start of the log"
            )
        for k in np.flatnonzero(~known.any(axis=0)):
            stops = np.flatnonzero(np.isfinite(log.angles[after:first, k]))
            mean[k] = log.angles[after + stops[-1], k] if len(stops) else result[-1][k]
        result.append(mean)
        after = last + 1
    return result


def _inner(time: np.ndarray, first: int, last: int) -> tuple[int, int]:
    """A standstill without its ends: a row marked as standing may contain the begin of a move, some µrad at 25 rows/s,
    which the encoder counts to the move. Rows of rest that are counted to a move do no harm.
    """
    rows = last - first
    guard = min(max(1, int(np.searchsorted(time[first : last + 1] - time[first], _GUARD_S))), rows // 10)
    return first + guard, last - guard


def _legs(
    log: ImuRows,
    geometry: Geometry,
    spans: list[tuple[int, int]],
    means: list[np.ndarray],
) -> list[_Leg]:
    """Every move between standstills."""
    step = np.diff(log.time_s, prepend=log.time_s[0])
    seen = np.flatnonzero(np.isfinite(log.rates).any(axis=0))
    quiet = np.array([_mean_rates(log.rates[a : b + 1]) for a, b in spans]) if len(seen) else None
    stops = np.isfinite(log.angles) & log.at_a_stop[:, None]
    result: list[_Leg] = []
    for k, ((_, last), (first, _)) in enumerate(itertools.pairwise(spans)):
        at, legs = means[k].copy(), [_Leg(k, -1, last, last)]
        if not (log.usable[last + 1 : first + 1].all() and log.mounting[last] == log.mounting[first]):
            # This move is not read; only its final angles count. Where rows are missing, as in a resumed run, an axis
            # at its former angle may have moved.
            result.append(_Leg(k, -1, last, first))
            continue
        rows = np.arange(last, first + 1)
        still = None
        for since, axis in np.argwhere(stops[last + 1 : first]):
            row = int(since) + last + 1
            if abs(log.angles[row, axis] - at[axis]) > _TURNED:
                if still is None and quiet is not None:
                    speed = np.linalg.norm((log.rates[rows[1:]] - 0.5 * (quiet[k] + quiet[k + 1]))[:, seen], axis=1)
                    still = last + 1 + np.array(_valleys(speed), int)
                legs.append(_Leg(k, int(axis), legs[-1].end, _stop_near(log.time_s, row, legs[-1].end, still)))
                at[axis] = log.angles[row, axis]
        rest, turned = _Leg(k, -1, legs[-1].end, first), np.flatnonzero(np.abs(means[k + 1] - at) > _LEAST_TURN)
        if len(turned) == 1 or quiet is None:
            legs.append(rest._replace(axis=int(turned[0]) if len(turned) == 1 else -1))
        elif len(turned) == 0 and len(legs) > 1:
            legs[-1] = legs[-1]._replace(end=first)
        else:
            rates = (log.rates[rest.begin + 1 : first + 1] - 0.5 * (quiet[k] + quiet[k + 1]))[:, seen]
            legs += _felt_legs(log, geometry, rest, rates, at, means[k + 1], seen)
            size = max(float(step[rest.begin + 1 : first + 1] @ np.linalg.norm(rates, axis=1)), 1e-9)
            if np.max(np.abs(at - means[k + 1])) > _FOLLOWS * size + _BIAS:
                raise ValueError(
                    f"between {log.time_s[last]:.6g} and {log.time_s[first]:.6g} s the gyros and the table's "
                    "angles do not agree: the axes must turn one after the other; does the log have the table of "
                    "the spec, with its axes in the same order, and the mounting of the spec?"
                )
        result += legs[1:]
    return result


def _stop_near(time_s: np.ndarray, row: int, after: int, still: np.ndarray | None) -> int:
    """The row at which the gyros see the stop that was read at `row`: stamps of readings and of samples are late by
    different times. `still`: rows at which the gyros see a stop."""
    if still is None or not len(near := still[(still > after) & (np.abs(time_s[still] - time_s[row]) < _LATE_S)]):
        return row
    return int(near[np.argmin(np.abs(near - row))])


def _felt_legs(
    log: ImuRows,
    geometry: Geometry,
    whole: _Leg,
    rates: np.ndarray,
    at: np.ndarray,
    goal: np.ndarray,
    seen: np.ndarray,
) -> list[_Leg]:
    """The moves that the gyros feel in the rows of `whole`, with their `rates` (rad/s): from the angles `at` (rad),
    which are set to those at the end, to the angles `goal`."""
    step = np.diff(log.time_s[whole.begin : whole.end + 1])
    legs: list[_Leg] = []
    edges = [0, *stops_between(rates), len(rates)]
    for a, b in itertools.pairwise(edges):
        axis, angle = _which(geometry, at, goal - at, int(log.mounting[whole.begin]), step[a:b] @ rates[a:b], seen)
        at[axis] += angle
        if legs and legs[-1].axis == axis:
            legs[-1] = legs[-1]._replace(end=whole.begin + b)
        else:
            legs.append(_Leg(whole.span, axis, whole.begin + a, whole.begin + b))
    return legs


def _mean_rates(rates: np.ndarray) -> np.ndarray:
    """The mean of each column; NaN where no row is finite."""
    known = np.isfinite(rates)
    count = np.sum(known, axis=0)
    return np.where(count > 0, np.sum(np.where(known, rates, 0.0), axis=0) / np.maximum(count, 1), np.nan)


def stops_between(rates: np.ndarray) -> list[int]:
    """Rows `(n, axes)` at which the table stops for an instant between two turns, counted from the end of each."""
    return [1 + row for row in _valleys(np.linalg.norm(rates, axis=1))]


def _valleys(speed: np.ndarray) -> list[int]:
    """Rows at which the table stops for an instant."""
    top = float(np.max(speed, initial=0.0))
    if top == 0.0:
        return []
    # Noise at a minimum must not divide it into two.
    width = max(len(speed) // 400, 1)
    smooth = np.convolve(np.pad(speed, width, mode="edge"), np.ones(2 * width + 1) / (2 * width + 1), mode="valid")
    # Imported where it is used: it imports all of SciPy's statistics.
    from scipy.signal import find_peaks

    prominence = np.log(_DIP)
    stops = find_peaks(-np.log(np.maximum(smooth, _SLOWEST * top)), prominence=prominence)[0]
    # The mean over several rows is least beside the stop, towards the slower move.
    around = [np.arange(max(stop - width, 0), min(stop + width + 1, len(speed))) for stop in stops]
    return [int(rows[np.argmin(speed[rows])]) for rows in around]


def _which(
    geometry: Geometry, at: np.ndarray, left: np.ndarray, mounting: int, total: np.ndarray, seen: np.ndarray
) -> tuple[int, float]:
    """Axis (and angle, rad) along which the gyros' integral points; of several the one with the angle `left`."""
    axes = frames(geometry, at[None], np.array([mounting])).axes[0][:, seen]
    angle = (axes @ total) / np.maximum(np.sum(axes**2, axis=1), SEEN**2)
    missed = np.linalg.norm(total[None] - angle[:, None] * axes, axis=1)
    along = missed <= np.min(missed) + _FOLLOWS * np.linalg.norm(total)
    best = int(np.argmin(np.where(along, np.abs(angle - left), np.inf)))
    return best, float(angle[best])


def _own_angles(
    log: ImuRows, spans: list[tuple[int, int]], legs: list[_Leg]
) -> tuple[list[np.ndarray], tuple[np.ndarray, ...]]:
    """Angles (rad) of each axis before its first move and after each of its moves, means of its readings from the end
    of one to the begin of the next, also while other axes move; and what was averaged, as in `ExecutedImu`.

    Time stamps of a busy computer are late, so that rows next to another axis's move may belong to this axis's own
    move: readings count between the first and the last row at which all axes stand, or else in the middle half.
    """
    standing = np.zeros(len(log.time_s), bool)
    for first, last in spans:
        standing[first : last + 1] = True
    result: list[np.ndarray] = []
    averaged: list[np.ndarray] = []
    for axis in range(log.angles.shape[1]):
        own = [leg for leg in legs if leg.axis in (axis, -1)]
        begins = [spans[0][0], *(leg.end for leg in own)]
        ends = [*(leg.begin for leg in own), spans[-1][1]]
        # It is read as soon as it stands, which may be a row of its move.
        stops = [begins[0], *(leg.end if leg.axis < 0 else leg.begin + 1 for leg in own)]
        read: list[np.ndarray] = []
        places: list[int] = []
        for a, b, since in zip(begins, ends, stops, strict=True):
            rows, quarter = np.arange(a, max(b, a) + 1), max(b - a, 0) // 4
            rest = rows[standing[rows]]
            rows = np.arange(rest[0], rest[-1] + 1) if len(rest) else rows[quarter : len(rows) - quarter]
            places.append(int(rows[0]))
            rows = rows[np.isfinite(log.angles[rows, axis])]
            if not len(rows):
                # A reading behind its next move, of another session even, may be nearer than its own last one.
                rows = (since + np.flatnonzero(np.isfinite(log.angles[since : b + 1, axis])))[-1:]
            read.append(rows)
        if log.at_a_stop.any():
            _take_those_between(log, axis, read)
        known = (log.angles[rows, axis] if len(rows) else _nearest(log.angles[:, axis], place)
                 for rows, place in zip(read, places, strict=True))  # fmt: skip
        result.append(np.array([float(np.mean(angles)) for angles in known]))
        counted = [(max(len(rows), 1), float(np.ptp(log.time_s[rows])) if len(rows) else 0.0) for rows in read]
        averaged.append(np.array(counted[1:]).reshape(-1, 2))
    return result, tuple(averaged)


def _take_those_between(log: ImuRows, axis: int, read: list[np.ndarray]) -> None:
    """Add to the rows at which an axis is read in each of its standstills those between two, of its angle in one of
    them: it is read as soon as it stands, which the gyros see a little later, and while other axes move."""
    angles = log.angles[:, axis]
    events = np.flatnonzero(np.isfinite(angles) & log.at_a_stop)
    before = list(read)
    for k, (first, second) in enumerate(itertools.pairwise(before)):
        if not (len(first) and len(second)):
            continue
        means = np.array([np.mean(angles[first]), np.mean(angles[second])])
        between = events[np.searchsorted(events, first[-1], "right") : np.searchsorted(events, second[0])]
        apart = np.abs(angles[between, None] - means)
        if abs(means[1] - means[0]) > _TURNED:
            near = np.min(apart, axis=1) < 0.5 * _TURNED
            for place, own in ((k, apart[:, 0] < apart[:, 1]), (k + 1, apart[:, 0] > apart[:, 1])):
                read[place] = np.union1d(read[place], between[near & own])


def _nearest(angles: np.ndarray, row: int) -> np.ndarray:
    """The known angle nearest to a row."""
    known = np.flatnonzero(np.isfinite(angles))
    return angles[known[[int(np.argmin(np.abs(known - row)))]]]


def _pieces(
    log: ImuRows,
    geometry: Geometry,
    spans: list[tuple[int, int]],
    legs: list[_Leg],
    angles: list[np.ndarray],
    longest: float,
) -> ExecutedImu:
    rows, axes, lost, travelled = [spans[0][0]], list[int](), list[bool](), list[np.ndarray | None]()
    goals = [iter(own[1:]) for own in angles]
    start = np.array([own[0] for own in angles])
    # Between two rows of equal counts every row may be integrated.
    at, unusable = start.copy(), np.cumsum(~log.usable)

    def add(row: int, axis: int = -1, way: np.ndarray | None = None, *, read: bool = True) -> None:
        """The piece up to a row, in which one axis moves."""
        whole = all(of[rows[-1]] == of[row] for of in (unusable, log.mounting))
        lost.append(not (read and whole))
        rows.append(row)
        axes.append(axis)
        travelled.append(way)

    def next_angle(axis: int) -> float:
        """The angle (rad) of an axis's next move."""
        return float(next(goals[axis]) - at[axis])

    of_span: dict[int, list[_Leg]] = {}
    for leg in legs:
        of_span.setdefault(leg.span, []).append(leg)
    for k, (first, last) in enumerate(spans):
        parts = max(1, int(np.ceil((log.time_s[last] - log.time_s[first]) / longest - 1e-9)))
        times = np.linspace(log.time_s[first], log.time_s[last], parts + 1)[1:-1]
        # A table may stand through a part without rows.
        breaks = first + 1 + np.flatnonzero(np.diff(log.time_s[first : last + 1]) > PIECE_S)
        for row in np.union1d([*np.searchsorted(log.time_s[:last], times - 1e-9), last], [breaks - 1, breaks]).tolist():
            if row > rows[-1]:
                add(int(row))
        for leg in of_span.get(k, []):
            if leg.axis >= 0:
                angle = next_angle(leg.axis)
                add(leg.end, leg.axis, _way(log, geometry, at, leg, angle))
                at[leg.axis] += angle
                continue
            # Several axes, or none: the move is not read; every axis goes to its next angle.
            ends = np.linspace(leg.begin, leg.end, len(angles) + 1).round().astype(int).tolist()[1:]
            for l, row in enumerate(ends):
                angle = next_angle(l)
                add(row, l, np.linspace(0.0, angle, _FEWEST_NODES + 1), read=False)
                at[l] += angle
    turned = np.array([0.0 if way is None else way[-1] for way in travelled])
    motion = _motion(log, geometry, np.array(rows), np.array(axes), np.array(lost), turned, start)
    return ExecutedImu(motion, np.array(rows), tuple(travelled))


def _way(log: ImuRows, geometry: Geometry, at: np.ndarray, leg: _Leg, whole: float) -> np.ndarray:
    """The angle (rad) of a move by the gyros, adjusted to the encoder's, at the edges of equal parts of its time."""
    time = log.time_s[leg.begin : leg.end + 1]
    direction = frames(geometry, at[None], log.mounting[[leg.begin]]).axes[0][leg.axis]
    rates = log.rates[leg.begin + 1 : leg.end + 1]
    direction = np.where(np.isfinite(rates).all(axis=0), direction, 0.0)
    size = float(direction @ direction)
    speed = np.nan_to_num(rates) @ direction / size if size > SEEN**2 else np.full(len(rates), whole)
    turned = np.concatenate([[0.0], np.cumsum(speed * np.diff(time))])
    path = np.concatenate([[0.0], np.cumsum(np.abs(speed) * np.diff(time))])
    if path[-1] > 0.0:
        turned = turned + (whole - turned[-1]) * path / path[-1]
    count = nodes_of_way(path[-1])
    return np.interp(np.linspace(time[0], time[-1], count + 1), time, turned)


def nodes_of_way(path: float) -> int:
    """The number of nodes of a move over a path (rad)."""
    count = _FEWEST_NODES
    while count * _NODE < path:
        count *= 2
    return count


def across_stops(done: ExecutedImu, log: ImuRows) -> np.ndarray:
    """Corrections of the gyros' integrals over every piece `(P, 3)`, rad, where the table stopped for an instant.

    The row of the stop contains the end of one turn and the begin of the next, some tens or hundreds of µrad at 100
    rows/s. Of two axes their different directions separate them, of one axis the slopes of the rate on both sides.
    """
    result, axis, rows = np.zeros((len(done.motion.axis), 3)), done.motion.axis, done.rows
    step, seen = np.diff(log.time_s, prepend=log.time_s[0]), np.isfinite(log.rates).any(axis=0)
    before, _ = done.motion.angles()
    rests = np.flatnonzero(axis < 0)
    for k in np.flatnonzero((axis[:-1] >= 0) & (axis[1:] >= 0)):
        stop = int(rows[k + 1])
        if log.at_end is not None and log.at_end[stop]:
            continue
        around = [j for j in (np.searchsorted(rests, k) - 1, np.searchsorted(rests, k)) if 0 <= j < len(rests)]
        still = [np.mean(log.rates[rows[j] + 1 : rows[j + 1] + 1], axis=0) for j in rests[around]]
        if axis[k] == axis[k + 1]:
            near = slice(stop - 3, stop + 4)
            if rows[k] + 3 < stop < rows[k + 2] - 3:
                # The lines of the rate meet at the bias, 0.3 deg/s of which are 0.1 mrad.
                moved = log.rates[near] - (np.mean(still, axis=0) if still else 0.0)
                late = _too_much(log.time_s[near], moved)
                result[k] -= late
                result[k + 1] += late
            continue
        near = np.arange(max(rows[k] + 1, stop - 1), min(rows[k + 2], stop + 1) + 1)
        if not still or not len(near):
            continue
        whole = slice(rows[k] + 1, rows[k + 2] + 1)
        turned = (log.rates[whole] - np.mean(still, axis=0)) * step[whole, None]
        mounting = done.motion.mounting[[k + 1]]
        axes = frames(done.motion.geometry, before[[k + 1]], mounting).axes[0][[axis[k], axis[k + 1]]] * seen
        both = turned[near - rows[k] - 1]
        if not np.isfinite(both[:, seen]).all() or np.linalg.svd(axes, compute_uv=False)[-1] < SEEN:
            continue
        ended, begun = np.linalg.lstsq(axes.T[seen], both[:, seen].T)[0]
        late = np.sum(begun[near <= stop]) * axes[1] - np.sum(ended[near > stop]) * axes[0]
        result[k] -= late
        result[k + 1] += late
    return result


def _too_much(time_s: np.ndarray, rates: np.ndarray) -> np.ndarray:
    """Of two moves of one axis, what the rows up to a stop hold of the second, less what the rows after it hold of the
    first, rad `(3,)`. `time_s` `(7,)`, `rates` `(7, 3)`, less the bias: of the row of the stop, in the middle, and of
    those beside it.

    Controllers brake and start at constant accelerations: straight lines of the rate.
    """
    step = np.diff(time_s, prepend=2.0 * time_s[0] - time_s[1])
    result, end, middle = np.zeros(3), time_s[3], time_s - 0.5 * step
    main = int(np.nanargmax(np.nansum(np.abs(rates), axis=0))) if np.isfinite(rates).any() else 0
    for one, other, sign in ((0, 1, -1.0), (5, 6, 1.0)):
        slope = (rates[other] - rates[one]) / (middle[other] - middle[one])
        if not abs(slope[main]) > 0.0:
            continue
        # From the row's end to where the line is zero: past it on the side of the other move.
        beyond = (end - (middle[one] - rates[one, main] / slope[main])) * sign
        if 0.0 < beyond < 1.5 * step[3]:
            # Either way a part of one move is among the rows of the other.
            result += 0.5 * np.nan_to_num(slope) * beyond**2
    return result


def mean_motion(
    log: ImuRows, rows: np.ndarray, turned: np.ndarray, moving: np.ndarray, read: np.ndarray, lost: np.ndarray
) -> Trajectory:
    """Pieces between `rows`, each at its mean rate; all arrays `(P,)`, `turned` rad."""
    duration, at = np.diff(log.time_s[rows]), log.temperature_c[rows]
    mean = turned / np.where(duration > 0.0, duration, 1.0)
    # Every move ends at a standstill.
    ends = np.ones(len(moving), bool)
    return held(
        log.time_s[rows[:-1]], duration, mean, at[:-1], at[1:], read=read, at_rest=ends, moving=moving, gap=lost
    )


def _motion(
    log: ImuRows, geometry: Geometry, rows: np.ndarray, axis: np.ndarray, lost: np.ndarray, turned: np.ndarray, start
) -> TableMotion:
    line = mean_motion(log, rows, turned, axis >= 0, ~lost, lost)
    # Neighbouring pieces of a rest, both read, are one segment.
    goes_on = (axis[1:] < 0) & (axis[:-1] < 0) & ~lost[1:] & ~lost[:-1]
    line = eqx.tree_at(lambda x: x.segment, line, np.concatenate([[0], np.cumsum(~goes_on)]))
    each = np.arange(len(axis))
    # The mounting changes only in pieces that are not read.
    return TableMotion(line, axis, log.mounting[rows[1:]], geometry, start, each, each, each)
