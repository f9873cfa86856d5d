"""Regressors of what a thermometer and a gyro really say: steps and noise taken off the one, the map off the other."""

import numpy as np
import pytest

from gradcal_jax.estimation import column_readings, smoothed_temperature
from gradcal_jax.estimation.fit_of_log import corrected_rows


@pytest.mark.parametrize("sample_rate_hz", [100.0, 3.0])
def test_steps_and_noise_are_taken_off_a_temperature(sample_rate_hz):
    """A ramp of 1 K/min that begins behind a lag of 3 min, in steps of 1/256 K with noise of 5 mK."""
    time = np.arange(0.0, 1800.0, 1.0 / sample_rate_hz)
    ramp = (time - 180.0 * -np.expm1(-time / 180.0)) / 60.0 - 35.0
    rng = np.random.default_rng(1)
    said = np.round((ramp + 5e-3 * rng.standard_normal(len(time))) * 256.0) / 256.0
    result = smoothed_temperature(time, said)
    # A parabola's value has 9/4 the variance of a mean of 60 s, and 9 times at the ends.
    noise = np.hypot(5e-3, 1.0 / 256.0 / np.sqrt(12.0)) / np.sqrt(60.0 * sample_rate_hz)
    inside = (time > 30.0) & (time < 1770.0)
    assert np.std((result - ramp)[inside]) < 2.0 * noise
    assert np.max(np.abs(result - ramp)) < 15.0 * noise
    # What the parabola misses of the lag's beginning, and of nothing else.
    np.testing.assert_allclose(smoothed_temperature(time, ramp), ramp, rtol=0, atol=2e-4)
    # Parabolas come back (but for their curvature within a bin of a second, which is averaged: a microkelvin), samples
    # that are missing here and there and a break between two temperatures or not.
    curve = 20.0 + 1e-2 * time - 3e-6 * time**2
    np.testing.assert_allclose(smoothed_temperature(time, curve), curve, rtol=0, atol=1e-6)
    kept = (rng.random(len(time)) > 0.3) & ((time < 600.0) | (time > 700.0))
    jumped = np.where(time > 650.0, curve + 40.0, curve)[kept]
    np.testing.assert_allclose(smoothed_temperature(time[kept], jumped), jumped, rtol=0, atol=1e-6)


def test_what_is_too_sparse_stays_as_measured():
    time = np.arange(0.0, 3000.0, 10.0)
    said = np.random.default_rng(2).standard_normal(len(time))
    np.testing.assert_array_equal(smoothed_temperature(time, said), said)
    np.testing.assert_array_equal(smoothed_temperature(time[:3], said[:3]), said[:3])
    np.testing.assert_array_equal(smoothed_temperature(np.arange(300.0), said, over_s=0.0), said)
    with pytest.raises(ValueError, match="smoothed over a time of 0 s or more"):
        smoothed_temperature(time, said, over_s=-1.0)


def test_a_value_that_was_not_polled_again_is_no_reading():
    """A table read about every second in a column of 100 rows a second: one row for each poll, and one for two polls
    that agree; a value that stays for long is read at its end, too."""
    rng = np.random.default_rng(4)
    polls = np.cumsum(np.concatenate([[0], rng.integers(100, 103, 2000)]))
    values = np.round(rng.standard_normal(len(polls) - 1) * 50.0)
    angle = np.repeat(values, np.diff(polls))
    time = np.arange(len(angle)) / 100.0
    read = np.flatnonzero(column_readings(time, angle, np.ones(len(angle), bool), 1.0))
    polled = polls[:-1][np.diff(values, prepend=np.nan) != 0.0]
    assert set(read) <= set(polled)
    assert len(read) > 0.98 * len(polled)
    angle[-1000:] = 7.0
    read = np.flatnonzero(column_readings(time, angle, np.ones(len(angle), bool), 1.0))
    assert read[-1] == len(angle) - 1
    noisy = rng.standard_normal(1001)
    read = np.flatnonzero(column_readings(time[:1001], noisy, np.ones(1001, bool), 1.0))
    assert read.tolist() == list(range(0, 1001, 100))


@pytest.mark.parametrize("seed", range(4))
def test_between_the_rows_that_are_corrected_nothing_moves_and_nothing_is_missing(seed):
    """Rests, moves and masked rows of random length; every 32nd row masked in one of the logs."""
    rng = np.random.default_rng(seed)
    lengths = rng.integers(1, 400, 40)
    standing = np.repeat(np.arange(40) % 2 == 0, lengths)
    usable = np.repeat(rng.random(40) > 0.1, rng.permutation(lengths))
    usable[:: 32 if seed == 3 else 500] = False
    at = corrected_rows(standing, usable)
    assert np.all(usable[at])
    assert (len(at) < np.count_nonzero(usable)) == (seed != 3)
    for row in np.setdiff1d(np.flatnonzero(usable), at):
        before, after = at[at < row][-1], at[at > row][0]
        assert after - before <= 32
        assert np.all((standing & usable)[before : after + 1])


@pytest.mark.parametrize("length", [1, 20, 64])
def test_all_rows_of_a_short_rest_are_corrected(length):
    everywhere = np.ones(length, bool)
    assert corrected_rows(everywhere, everywhere).tolist() == list(range(length))
