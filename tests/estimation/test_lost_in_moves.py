"""Samples that are missing or repeated on the ramps of moves, by which every move is wrong to the same side."""

import numpy as np
import pytest

from gradcal_jax.estimation import lost_in_moves

INTERVAL, MOVES = 0.02, 12
START = np.array([0])


def record(seed: int = 2):
    """Moves to and fro with cosine ramps of 1 s to 1 rad/s: time, rate, standing, usable."""
    ramp = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, 50))
    move = np.concatenate([ramp, np.ones(200), ramp[::-1]])
    cycle = np.concatenate([np.zeros(300), move, np.zeros(300), -move])
    rate = np.concatenate([np.tile(cycle, MOVES // 2), np.zeros(300)])
    standing = rate == 0.0
    rate = rate + 5e-4 * np.random.default_rng(seed).standard_normal(len(rate))
    return np.arange(len(rate)) * INTERVAL, rate, standing, np.ones(len(rate), bool)


def begins(standing: np.ndarray) -> np.ndarray:
    return np.flatnonzero(standing[:-1] & ~standing[1:]) + 1


def without(rows: np.ndarray):
    """The record without some rows."""
    time, rate, standing, usable = record()
    keep = np.setdiff1d(np.arange(len(time)), rows)
    return time[keep], rate[keep], standing[keep], usable[keep]


def test_a_whole_record_lacks_nothing():
    for seed in range(5):
        assert lost_in_moves(*record(seed), START) == (0, 0.0)


@pytest.mark.parametrize("count", [1, 4, 10])
def test_rows_lost_on_every_ramp_leave_the_angle_uncertain(count: int):
    """Held from the next sample, the integral is wrong by half the change of rate times the time that is lost."""
    _, rate, standing, _ = record()
    at = begins(standing) + 20
    lost, angle = lost_in_moves(*without((at[:, None] + np.arange(count)).ravel()), START)
    assert lost == MOVES
    true = np.mean(0.5 * np.abs(rate[at + count] - rate[at - 1]) * count * INTERVAL)
    assert angle == pytest.approx(true, rel=1e-6)
    # The error of the integral itself, of one move:
    part = slice(at[0] - 1, at[0] + count + 1)
    held = (rate[at[0] + count] * (count + 1) - np.sum(rate[part][1:])) * INTERVAL
    assert angle == pytest.approx(held, rel=0.2)


def test_a_sample_that_is_repeated_on_every_ramp_is_a_lost_one():
    time, rate, standing, usable = record()
    for k in begins(standing) + 20:
        rate[k : k + 5] = rate[k - 1]
    lost, angle = lost_in_moves(time, rate, standing, usable, START)
    assert lost == MOVES
    assert angle > np.radians(0.3)


def test_gaps_that_are_marked_and_masked_rows_are_known():
    time, rate, standing, usable = record()
    at = begins(standing) + 20
    rows = (at[:, None] + np.arange(5)).ravel()
    usable[rows] = False
    assert lost_in_moves(time, np.where(usable, rate, 0.0), standing, usable, START)[0] == 0
    assert lost_in_moves(time, np.where(usable, rate, np.nan), standing, ~(rate > 9.0), START)[0] == 0
    cut = without(rows)
    starts = np.flatnonzero(np.diff(cut[0], prepend=-INTERVAL) > 1.5 * INTERVAL)
    assert len(starts) == MOVES
    assert lost_in_moves(*cut, np.append(START, starts)) == (0, 0.0)


def test_lost_rows_at_rest_or_at_constant_rate_matter_little():
    standing = record()[2]
    rest, middle = begins(standing) - 100, begins(standing) + 150
    lost, angle = lost_in_moves(*without(np.concatenate([rest, middle])), START)
    assert lost <= MOVES
    assert angle < 1e-5


def test_late_stamps_and_coarse_steps_are_no_loss():
    time, rate, standing, usable = record()
    late = time + np.where(np.random.default_rng(3).random(len(time)) < 0.03, 0.75 * INTERVAL, 0.0)
    # (But for those at the end of the window in which stamps are compared.)
    assert lost_in_moves(late, rate, standing, usable, START)[1] < 5e-5
    for step in (2e-3, 2e-2):
        coarse = np.round(rate / step) * step
        assert lost_in_moves(time, coarse, standing, usable, START)[1] < 5e-5
    # Every sample twice: the rate of the samples is half that of the rows.
    twice = rate[np.arange(len(rate)) // 2 * 2]
    assert lost_in_moves(time, twice, standing, usable, START)[1] < 5e-5
