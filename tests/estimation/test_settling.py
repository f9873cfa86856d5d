"""Whether the gyros agree that the table stands where it is said to."""

import numpy as np
import pytest
from scipy import signal

from gradcal_jax.estimation import settling

INTERVAL = 0.02


def record(filtered_hz: float | None = None, early: int = 0, late: int = 0, seed: int = 2):
    """Moves to and fro with cosine ramps: time, rate, standing, usable."""
    ramp = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, 50))
    move = np.concatenate([ramp, np.ones(200), ramp[::-1]]) * 1.0
    cycle = np.concatenate([np.zeros(300), move, np.zeros(300), -move])
    rate = np.concatenate([np.tile(cycle, 6), np.zeros(300)])
    standing = rate == 0.0
    if filtered_hz is not None:
        b, a = signal.butter(1, filtered_hz, fs=1.0 / INTERVAL)
        rate = signal.lfilter(b, a, rate)
    edges = np.flatnonzero(np.diff(standing.astype(int)) == 1) + 1
    for edge in edges:
        standing[max(edge - early, 0) : edge] = True
    for edge in np.flatnonzero(np.diff(standing.astype(int)) == -1) + 1:
        standing[edge : edge + late] = True
    rate = rate + 5e-4 * np.random.default_rng(seed).standard_normal(len(rate))
    time = np.arange(len(rate)) * INTERVAL
    return time, rate, standing, np.ones(len(rate), bool)


def test_a_table_that_stands_is_not_accused():
    for seed in range(20):
        seen = settling(*record(seed=seed))
        assert seen is not None
        assert abs(seen.after) < 4.5 * seen.after_std
        assert abs(seen.before) < 4.5 * seen.before_std


def test_the_angle_after_early_marks_is_that_of_the_move():
    time, rate, standing, usable = record(early=15)
    seen = settling(time, rate, standing, usable)
    assert seen is not None
    ramp = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, 50))
    # (The first row's sample is of the time before it.)
    assert seen.after == pytest.approx(INTERVAL * np.sum(ramp[:15]), rel=0.02)
    assert abs(seen.before) < 4.5 * seen.before_std


def test_a_filtered_gyro_shows_the_move_after_it_ends():
    seen = settling(*record(filtered_hz=0.8))
    assert seen is not None
    assert seen.after > 20.0 * seen.after_std


def test_a_table_that_moves_before_it_is_said_to():
    seen = settling(*record(late=20))
    assert seen is not None
    assert seen.before > 20.0 * seen.before_std


def test_few_moves_say_nothing():
    time, rate, standing, usable = (values[:1000] for values in record())
    assert settling(time, rate, standing, usable) is None
