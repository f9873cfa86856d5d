"""The executed motion of a unit on a table of several axes: a log's standstills and moves as a `TableMotion`.

Between two standstills of the whole table one axis after the other turns. Where the log has the readings of the
encoders, those of an instant between two moves show which one. Otherwise the gyros do: their rate has a minimum at such
an instant, and their integral between two minima points along the axis that turned; two moves of one axis are then one.
The angle of an axis at rest is the mean of its readings between two of its own moves. Within a move
the gyros give the angle, adjusted to the encoder's angles at its ends.
"""

import itertools
from typing import NamedTuple

import numpy as np

from gradcal_jax.estimation.gyro_stops import FOLLOWS, SEEN, across_stops, stops_between, turned_axis
from gradcal_jax.estimation.imu_rows import (
    FEWEST_NODES,
    PIECE_S,
    ExecutedImu,
    ImuRows,
    PieceBuilder,
    mean_angles,
    mean_known,
    way_of,
)
from gradcal_jax.formulas import runs
from gradcal_jax.motion import Geometry, frames

__all__ = ["ExecutedImu", "ImuRows", "across_stops", "executed_imu", "mean_angles"]

_GUARD_S = 0.1
# Rows further apart than this (s) do not show when a move begins and ends.
_SLOW_S = 0.06
# Least change of an axis's angle (rad) that counts as a turn; and that of two single readings, which have their own
# noise.
_LEAST_TURN, _TURNED = np.radians(0.05), np.radians(1.0)
# A stop is read within this time of where the gyros see it.
_LATE_S = 0.5
# The gyros' integral over a move differs from the table's angle by at most a share and this angle (rad).
_BIAS = np.radians(3.0)


class _Leg(NamedTuple):
    """A move of one axis (−1: of several, or none, which is not read), rows `begin + 1 … end`."""

    axis: int
    begin: int
    end: int


def executed_imu(log: ImuRows, geometry: Geometry, read_every: float = PIECE_S) -> ExecutedImu:
    """The motion in a log's rows. `read_every` s: the spacing of readings of a table that is read while it stands.

    Errors: `ValueError` where rows are too far apart, where the table never stands, where its angles are not known
    there, or where the gyros' integral over a move is not a sequence of turns of single axes.
    """
    spacing, moving, events = float(np.median(np.diff(log.time_s))), ~log.standing, bool(log.at_a_stop.any())
    if spacing > _SLOW_S and np.any(moving[1:] & moving[:-1]):
        raise ValueError(
            f"the log has {1.0 / spacing:.3g} rows/s, too few to see the moves of several axes: record at least 20"
        )
    stands = [(int(a), int(b) - 1) for a, b in runs(log.standing) if b - a > 1]
    # Standstills of a run, whose readings are events, have margins already.
    spans = stands if events else [_inner(log.time_s, *stand) for stand in stands]
    if len(spans) < 2:
        raise ValueError("the log has fewer than two standstills, so there are no poses to compare")
    if events and read_every < PIECE_S:
        # Every reading is a reference: a standstill is that from its first to its last.
        read = [np.flatnonzero(log.at_a_stop[a : b + 1]) + a for a, b in stands]
        spans = [(int(rows[0]), int(rows[-1])) for rows in read if len(rows)]
    # A reading has the row at which its axis stands; of an angle at every row those at the ends do not count.
    means = mean_angles(log, spans)
    quiet = [mean_known(log.rates[a : b + 1]) for a, b in spans]
    legs = [
        _legs(log, geometry, (spans[k][1], spans[k + 1][0]), means[k].copy(), means[k + 1], 0.5 * (quiet[k] + after))
        for k, after in enumerate(quiet[1:])
    ]
    angles, averaged = _own_angles(log, spans, [leg for between in legs for leg in between])
    goals, at = [iter(own[1:]) for own in angles], np.array([own[0] for own in angles])
    start, pieces = at.copy(), PieceBuilder(log, spans[0][0])
    for (_, last), between in itertools.zip_longest(spans, legs, fillvalue=[]):
        pieces.rest(last, read_every)
        for leg in between:
            if leg.axis >= 0:
                angle = float(next(goals[leg.axis]) - at[leg.axis])
                pieces.add(leg.end, leg.axis, _way(log, geometry, at, leg, angle))
                at[leg.axis] += angle
                continue
            # The move is not read; every axis goes to its next angle.
            ends = np.linspace(leg.begin, leg.end, len(angles) + 1).round().astype(int).tolist()[1:]
            for axis, row in enumerate(ends):
                angle = float(next(goals[axis]) - at[axis])
                pieces.add(row, axis, np.linspace(0.0, angle, FEWEST_NODES + 1), lost=True)
                at[axis] += angle
    done = pieces.executed(geometry, start)
    return done._replace(averaged=averaged) if events else done


def _inner(time: np.ndarray, first: int, last: int) -> tuple[int, int]:
    """A standstill without its ends: a row marked as standing may contain the begin of a move, some µrad at 25 rows/s,
    which the encoder counts to the move. Rows of rest that are counted to a move do no harm.
    """
    rows = last - first
    guard = min(max(1, int(np.searchsorted(time[first : last + 1] - time[first], _GUARD_S))), rows // 10)
    return first + guard, last - guard


def _legs(
    log: ImuRows, geometry: Geometry, between: tuple[int, int], at: np.ndarray, goal: np.ndarray, quiet: np.ndarray
) -> list[_Leg]:
    """The moves between two standstills, at whose inner rows the table has the angles `at` and `goal` (rad); `quiet`
    `(3,)`: what the gyros show at rest, rad/s."""
    last, first = between
    if not (log.usable[last + 1 : first + 1].all() and log.mounting[last] == log.mounting[first]):
        # Only its final angles count. Where rows are missing, as in a resumed run, an axis at its former angle may have
        # moved.
        return [_Leg(-1, last, first)]
    legs, begin, seen = list[_Leg](), last, np.isfinite(quiet)
    read = np.argwhere(np.isfinite(log.angles[last + 1 : first]) & log.at_a_stop[last + 1 : first, None])
    moved = log.rates[last + 1 : first + 1, seen] - quiet[seen]
    still = last + np.array(stops_between(moved) if len(read) else [], np.int64)
    for since, axis in read.tolist():
        row = since + last + 1
        if abs(log.angles[row, axis] - at[axis]) > _TURNED:
            at[axis] = log.angles[row, axis]
            end = _stop_near(log.time_s, row, still[still > begin])
            legs.append(_Leg(axis, begin, end))
            begin = end
    turned = np.flatnonzero(np.abs(goal - at) > _LEAST_TURN)
    if len(turned) == 1 or not seen.any():
        return [*legs, _Leg(int(turned[0]) if len(turned) == 1 else -1, begin, first)]
    if len(turned) == 0 and legs:
        return [*legs[:-1], legs[-1]._replace(end=first)]
    rates, step = log.rates[begin + 1 : first + 1] - quiet, np.diff(log.time_s[begin : first + 1])
    felt = list[_Leg]()
    for a, b in itertools.pairwise([0, *stops_between(rates[:, seen]), len(rates)]):
        axis, angle = turned_axis(geometry, at, int(log.mounting[begin]), step[a:b] @ rates[a:b], goal)
        at[axis] += angle
        if felt and felt[-1].axis == axis:
            felt[-1] = felt[-1]._replace(end=begin + b)
        else:
            felt.append(_Leg(axis, begin + a, begin + b))
    size = max(float(step @ np.linalg.norm(rates[:, seen], axis=1)), 1e-9)
    if np.max(np.abs(at - goal)) > FOLLOWS * size + _BIAS:
        raise ValueError(
            f"between {log.time_s[last]:.6g} and {log.time_s[first]:.6g} s the gyros and the table's "
            "angles do not agree: the axes must turn one after the other; does the log have the table of "
            "the spec, with its axes in the same order, and the mounting of the spec?"
        )
    return legs + felt


def _stop_near(time_s: np.ndarray, row: int, still: np.ndarray) -> int:
    """The row at which the gyros see the stop that was read at `row`, of those at which they see one: the stamps of a
    busy computer's readings and samples are late by different times."""
    near = still[np.abs(time_s[still] - time_s[row]) < _LATE_S]
    return int(near[np.argmin(np.abs(near - row))]) if len(near) else row


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
    for axis, angles in enumerate(log.angles.T):
        own = [leg for leg in legs if leg.axis in (axis, -1)]
        begins = [spans[0][0], *(leg.end for leg in own)]
        ends = [*(leg.begin for leg in own), spans[-1][1]]
        # It is read as soon as it stands, which may be a row of its move.
        stops = [begins[0], *(leg.end if leg.axis < 0 else leg.begin + 1 for leg in own)]
        known = np.flatnonzero(np.isfinite(angles))
        read, places = list[np.ndarray](), list[int]()
        for a, b, since in zip(begins, ends, stops, strict=True):
            rows, quarter = np.arange(a, max(b, a) + 1), max(b - a, 0) // 4
            rest = rows[standing[rows]]
            first, last = (rest[0], rest[-1]) if len(rest) else (a + quarter, max(b, a) - quarter)
            rows = known[np.searchsorted(known, first) : np.searchsorted(known, last, "right")]
            # A reading behind its next move, of another session even, may be nearer than its own last one.
            read.append(rows if len(rows) else known[(known >= since) & (known <= b)][-1:])
            places.append(int(first))
        if log.at_a_stop.any():
            _take_those_between(angles, known, read)
        counted = [(max(len(rows), 1), float(np.ptp(log.time_s[rows])) if len(rows) else 0.0) for rows in read]
        averaged.append(np.array(counted[1:]).reshape(-1, 2))
        nearest = [known[[int(np.argmin(np.abs(known - place)))]] for place in places]
        both = zip(read, nearest, strict=True)
        result.append(np.array([np.mean(angles[rows if len(rows) else other]) for rows, other in both]))
    return result, tuple(averaged)


def _take_those_between(angles: np.ndarray, events: np.ndarray, read: list[np.ndarray]) -> None:
    """Add to the rows at which an axis is read in each of its standstills those `events` between two, of its angle in
    one of them: it is read as soon as it stands, which the gyros see a little later, and while other axes move."""
    for k, (first, second) in enumerate(itertools.pairwise(list(read))):
        if not (len(first) and len(second)):
            continue
        means = np.array([np.mean(angles[first]), np.mean(angles[second])])
        between = events[np.searchsorted(events, first[-1], "right") : np.searchsorted(events, second[0])]
        apart = np.abs(angles[between, None] - means)
        near = np.min(apart, axis=1, initial=np.inf) < 0.5 * _TURNED
        if abs(means[1] - means[0]) > _TURNED:
            for place, own in ((k, apart[:, 0] < apart[:, 1]), (k + 1, apart[:, 0] > apart[:, 1])):
                read[place] = np.union1d(read[place], between[near & own])


def _way(log: ImuRows, geometry: Geometry, at: np.ndarray, leg: _Leg, whole: float) -> np.ndarray:
    """The angle (rad) of a move by the gyros, adjusted to the encoder's, as of `way_of`."""
    time = log.time_s[leg.begin : leg.end + 1]
    direction = frames(geometry, at[None], log.mounting[[leg.begin]]).axes[0][leg.axis]
    rates = log.rates[leg.begin + 1 : leg.end + 1]
    direction = np.where(np.isfinite(rates).all(axis=0), direction, 0.0)
    size = float(direction @ direction)
    speed = np.nan_to_num(rates) @ direction / size if size > SEEN**2 else np.full(len(rates), whole)
    turned, path = (np.concatenate([[0.0], np.cumsum(of * np.diff(time))]) for of in (speed, np.abs(speed)))
    if path[-1] > 0.0:
        turned = turned + (whole - turned[-1]) * path / path[-1]
    return way_of(time, turned, path[-1])
