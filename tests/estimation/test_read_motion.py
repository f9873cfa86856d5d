"""The motion of a table of one axis from its readings and a gyro, against a course that is known."""

import numpy as np
import pytest

from gradcal_jax.estimation import ImuRows, column_readings, motion_by_readings
from gradcal_jax.motion import Geometry

STEP = 0.01
BIAS = np.radians(0.3)
# Ends of moves (s) and where they lead (deg): there and back with a rest between, then on without one.
KNOTS = [(5.0, 0.0), (7.0, 90.0), (10.0, 90.0), (11.0, 60.0), (16.0, 60.0), (18.0, 150.0), (21.0, 240.0), (27.0, 240.0)]
READ_AT = [1.0, 4.0, 12.0, 15.0, 22.0, 26.0]


def geometry() -> Geometry:
    numbers = np.array([[0.0, 0.0, 1.0]]), np.eye(3), np.eye(3)[None]
    return Geometry(*numbers, np.zeros(()), np.array(9.8))


def log(**changes) -> ImuRows:
    time = STEP * np.arange(1, round(KNOTS[-1][0] / STEP) + 1)
    at, angle = np.array(KNOTS).T
    course = np.radians(np.interp(time, at, angle))
    rates = np.zeros((len(time), 3))
    rates[:, 2] = np.diff(course, prepend=0.0) / STEP + BIAS
    rows = np.searchsorted(time, np.array(READ_AT) - 1e-9)
    angles, reads = np.full((len(time), 1), np.nan), np.zeros(len(time), bool)
    angles[rows, 0], reads[rows] = course[rows], True
    standing = np.abs(rates[:, 2] - BIAS) < 1e-9
    none = np.zeros(len(time))
    made = ImuRows(
        time,
        rates,
        np.full((len(time), 3), np.nan),
        none + 20.0,
        angles,
        standing,
        none == 0.0,
        none.astype(int),
        reads,
    )
    return made._replace(**changes)


def test_segments_end_at_readings_and_are_divided_where_the_axis_stands():
    rows = log()
    done = motion_by_readings(rows, geometry())
    line, (_, after) = done.motion.line, done.motion.angles()
    ends = rows.time_s[done.rows[1:]]
    np.testing.assert_allclose(ends[line.read], READ_AT[1:], atol=1e-9)
    np.testing.assert_allclose(np.degrees(after[line.read, 0]), [0.0, 60.0, 60.0, 240.0, 240.0], atol=1e-9)
    # The unread rest at 90 deg is a piece of its own, and the gyro tells its angle.
    (rest,) = np.flatnonzero((done.motion.axis < 0) & (ends > 7.0) & (ends < 10.0))
    assert np.degrees(after[rest, 0]) == pytest.approx(90.0, abs=0.1)
    assert line.duration[rest] == pytest.approx(2.8, abs=0.05)
    # Two turns without a rest between are one move.
    assert np.count_nonzero(done.motion.axis >= 0) == 3


def test_a_standing_axis_is_at_the_mean_of_its_readings_weighted_by_what_they_are_worth():
    rows = log()
    read = np.flatnonzero(rows.at_a_stop)
    angles, worth = rows.angles.copy(), np.ones(len(rows.time_s))
    angles[read[2]] += np.radians(0.3)
    worth[read[3]] = 2.0
    done = motion_by_readings(rows._replace(angles=angles, worth=worth), geometry())
    _, after = done.motion.angles()
    at = np.flatnonzero(done.rows[1:] == read[3])[0]
    assert np.degrees(after[at, 0]) == pytest.approx(60.1, abs=1e-9)
    np.testing.assert_array_equal(done.motion.line.share[done.motion.line.read], worth[read[1:]])


def test_an_axis_that_stands_elsewhere_after_a_break_has_another_standstill():
    """Where the first row after the break is a reading, too; and what a reading is off does not divide a standstill."""
    rows = log()
    kept = (rows.time_s <= 22.0 + 1e-9) | (rows.time_s >= 26.0 - 1e-9)
    taken = ImuRows(*(None if column is None else column[kept] for column in rows))
    begin = int(np.searchsorted(taken.time_s, 26.0 - 1e-9))
    taken.usable[begin] = taken.standing[begin] = False
    for turned, ends in ((180.0, [240.0, 420.0]), (0.3, [240.15, 240.15])):
        angles = taken.angles.copy()
        angles[begin:] += np.radians(turned)
        motion = motion_by_readings(taken._replace(angles=angles), geometry()).motion
        _, after = motion.angles()
        np.testing.assert_allclose(np.degrees(after[-2:, 0]), ends, atol=1e-9)
        assert motion.line.gap[-1]


def test_missing_rows_make_a_gap_with_a_new_origin_behind_it():
    rows = log()
    usable = rows.usable.copy()
    usable[np.searchsorted(rows.time_s, 6.0)] = False
    line = motion_by_readings(rows._replace(usable=usable), geometry()).motion.line
    assert line.gap.sum() == 1
    assert not line.read[line.gap].any()
    np.testing.assert_allclose(line.start[line.gap] + line.duration[line.gap], [12.0], atol=2.0 * STEP)


def test_an_angle_that_never_changes_is_read_as_often_as_the_spec_says():
    time = np.arange(0.0, 100.0, 1.0)
    still, constant = np.ones(len(time), bool), np.zeros(len(time))
    assert column_readings(time, constant, still, 10.0).sum() == 11
    # One value that stays is one poll, where others show the table's noise.
    polled = np.where(time < 50.0, 0.0, 1e-5)
    assert column_readings(time, polled, still, 10.0).sum() == 4


def test_a_standstill_ends_with_its_mounting():
    """The table stands at another angle when the IMU has been mounted anew, without a row between."""
    rows, once = log(), len(log().time_s)
    again = rows._replace(
        time_s=rows.time_s + rows.time_s[-1] + 3600.0,
        usable=np.arange(once) > 0,
        mounting=rows.mounting + 1,
        angles=rows.angles + 1.0,
    )
    both = ImuRows(*(None if a is None else np.concatenate([a, b]) for a, b in zip(rows, again, strict=True)))
    twice = Geometry(np.array([[0.0, 0.0, 1.0]]), np.eye(3), np.stack([np.eye(3)] * 2), np.zeros(()), np.array(9.8))
    line = motion_by_readings(both, twice).motion
    alone = motion_by_readings(rows, geometry()).motion
    count = len(alone.line.duration)
    begin, end = (of[:count] for of in line.angles())
    np.testing.assert_allclose((begin, end), alone.angles(), atol=1e-12)
    assert line.line.gap[count]
    assert not alone.line.gap[-1]
