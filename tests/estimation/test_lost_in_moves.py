"""What gyros show at the ends of standstills and within moves: marks that are early or late, filters, lost samples."""

import numpy as np
import pytest
from scipy import signal

from gradcal_jax.estimation import lost_in_moves, settling

INTERVAL, MOVES = 0.02, 12
START = np.array([0])
RAMP = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, 50))


def record(filtered_hz: float | None = None, early: int = 0, late: int = 0, seed: int = 2):
    """Moves to and fro with cosine ramps of 1 s to 1 rad/s: time, rate, standing, usable."""
    move = np.concatenate([RAMP, np.ones(200), RAMP[::-1]])
    cycle = np.concatenate([np.zeros(300), move, np.zeros(300), -move])
    rate = np.concatenate([np.tile(cycle, MOVES // 2), np.zeros(300)])
    standing = rate == 0.0
    if filtered_hz is not None:
        rate = signal.lfilter(*signal.butter(1, filtered_hz, fs=1.0 / INTERVAL), rate)
    for edge in np.flatnonzero(np.diff(standing.astype(int)) == 1) + 1:
        standing[max(edge - early, 0) : edge] = True
    for edge in begins(standing):
        standing[edge : edge + late] = True
    rate = rate + 5e-4 * np.random.default_rng(seed).standard_normal(len(rate))
    return np.arange(len(rate)) * INTERVAL, rate, standing, np.ones(len(rate), bool)


def begins(standing: np.ndarray) -> np.ndarray:
    return np.flatnonzero(standing[:-1] & ~standing[1:]) + 1


def without(rows: np.ndarray):
    """The record without some rows."""
    time, rate, standing, usable = record()
    keep = np.setdiff1d(np.arange(len(time)), rows)
    return time[keep], rate[keep], standing[keep], usable[keep]


def test_a_sound_record_is_not_accused():
    for seed in range(10):
        of = record(seed=seed)
        assert lost_in_moves(*of, START) == (0, 0.0)
        seen = settling(*of)
        assert max(abs(seen.after) / seen.after_std, abs(seen.before) / seen.before_std) < 4.5
    assert settling(*(values[:1000] for values in record())) is None


def test_marks_that_are_early_or_late_and_filters_show_a_part_of_the_move():
    seen = settling(*record(early=15))
    # (The first row's sample is of the time before it.)
    assert seen.after == pytest.approx(INTERVAL * np.sum(RAMP[:15]), rel=0.02)
    assert abs(seen.before) < 4.5 * seen.before_std
    filtered, late = settling(*record(filtered_hz=0.8)), settling(*record(late=20))
    assert filtered.after > 20.0 * filtered.after_std
    assert late.before > 20.0 * late.before_std


@pytest.mark.parametrize("count", [1, 10])
def test_rows_lost_on_every_ramp_leave_the_angle_uncertain(count: int):
    """Held from the next sample, the integral is wrong by half the change of rate times the time that is lost."""
    _, rate, standing, _ = record()
    at = begins(standing) + 20
    lost, angle = lost_in_moves(*without((at[:, None] + np.arange(count)).ravel()), START)
    assert lost == MOVES
    true = np.mean(0.5 * np.abs(rate[at + count] - rate[at - 1]) * count * INTERVAL)
    assert angle == pytest.approx(true, rel=1e-6)
    # The error of the integral itself, of one move:
    held = (rate[at[0] + count] * (count + 1) - np.sum(rate[at[0] : at[0] + count + 1])) * INTERVAL
    assert angle == pytest.approx(held, rel=0.2)


def test_a_sample_that_is_repeated_on_every_ramp_is_a_lost_one():
    time, rate, standing, usable = record()
    for k in begins(standing) + 20:
        rate[k : k + 5] = rate[k - 1]
    lost, angle = lost_in_moves(time, rate, standing, usable, START)
    assert lost == MOVES
    assert angle > np.radians(0.3)


def test_what_is_known_or_matters_little_is_no_loss():
    """Marked gaps, masked rows, losses at rest or at a constant rate, late stamps, coarse steps, samples said twice."""
    time, rate, standing, usable = record()
    at = begins(standing) + 20
    rows = (at[:, None] + np.arange(5)).ravel()
    cut = without(rows)
    starts = np.flatnonzero(np.diff(cut[0], prepend=-INTERVAL) > 1.5 * INTERVAL)
    assert lost_in_moves(*cut, np.append(START, starts)) == (0, 0.0)
    masked = usable.copy()
    masked[rows] = False
    assert lost_in_moves(time, np.where(masked, rate, 0.0), standing, masked, START)[0] == 0
    assert lost_in_moves(*without(np.concatenate([at - 120, at + 130])), START)[1] < 1e-5
    late = time + np.where(np.random.default_rng(3).random(len(time)) < 0.03, 0.75 * INTERVAL, 0.0)
    twice = rate[np.arange(len(rate)) // 2 * 2]
    for stamps, of in ((late, rate), (time, np.round(rate / 2e-2) * 2e-2), (time, twice)):
        # (But for those at the end of the window in which stamps are compared.)
        assert lost_in_moves(stamps, of, standing, usable, START)[1] < 5e-5
