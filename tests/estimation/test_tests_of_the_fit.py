"""Least squares, standstills, tests of the fit: the parts of the estimator on whitened rows, against brute force."""

import numpy as np
import pytest
from expected_errors import solve

from gradcal_jax.estimation import Whitened, find_standstills
from gradcal_jax.estimation.added_columns import halves_test

# --- least squares ----------------------------------------------------------------------------------------------------


def test_what_nothing_is_said_of_is_hidden_and_gets_the_smallest_parameters():
    rng = np.random.default_rng(1)
    rows = rng.standard_normal((50, 3))
    rows[:, 2] = rows[:, 0] + rows[:, 1]
    result = solve(Whitened(rows, rows.sum(axis=1), np.zeros((0, 3))))
    assert result.known.hidden.shape == (3, 1)
    assert result.degrees == 50 - 2
    assert result.chi_squared < 1e-20
    known = solve(Whitened(rows, rows.sum(axis=1), np.array([[0.0, 0.0, 10.0]])))
    assert known.known.hidden.shape == (3, 0)


# --- tests of the fit -------------------------------------------------------------------------------------------------


def test_halves_are_two_fits_against_one():
    """χ²_AB − χ²_A − χ²_B, by three fits without priors."""
    rng = np.random.default_rng(3)
    rows, half = rng.standard_normal((300, 6)) * np.geomspace(1.0, 1e6, 6), np.arange(300) < 120
    white = Whitened(rows, rng.standard_normal(300), np.zeros((0, 6)))
    parts = (np.ones(300, bool), half, ~half)
    fits = [solve(white._replace(rows=white.rows[of], data=white.data[of])).chi_squared for of in parts]
    test = halves_test(white, half)
    assert test.statistic == pytest.approx(fits[0] - fits[1] - fits[2], rel=1e-9)
    assert test.degrees == 6
    changed = white.data + np.where(half, 0.0, white.rows[:, 2] * 1e-2)
    assert not halves_test(white._replace(data=changed), half).passed


# --- standstills ------------------------------------------------------------------------------------------------------


def test_standstills_are_found_in_noise_and_in_vibration():
    rng = np.random.default_rng(9)
    rate_hz, rest, turn = 100, 500, 300
    profile = np.tile(np.concatenate([np.zeros(rest), np.sin(np.linspace(0, np.pi, turn)) ** 2]), 12)
    moving = np.tile(np.r_[np.zeros(rest, bool), np.ones(turn, bool)], 12)
    rates = np.zeros((len(profile), 3))
    rates[:, 1] = np.radians(200.0) * profile
    rates += np.radians(0.05) * rng.standard_normal(rates.shape) + np.radians([0.3, -0.2, 0.1])
    time = np.arange(len(profile)) / rate_hz
    shaking = np.where(np.arange(len(profile)) < 4000, 1.0, 0.0) * np.radians(1.0) * np.sin(2 * np.pi * 31.0 * time)
    for more in (0.0, shaking):
        number = find_standstills(rates + np.multiply.outer(more * np.ones(len(profile)), [1.0, 0.2, 0.5]), 0.01)
        assert number.max() + 1 == 12
        inside = number >= 0
        assert np.mean(profile[inside] > 0.01) < 0.02  # only the slow ends of moves pass for rest
        assert inside[~moving].mean() > 0.85
    valid = rng.random(len(profile)) > 0.01
    assert find_standstills(np.where(valid[:, None], rates, 1e3), 0.01, valid=valid).max() + 1 >= 12
    still = find_standstills(rates[: rest - 10], 0.01)
    assert np.all(still == 0)


def test_what_is_never_quiet_or_too_short_is_a_sentence():
    rng = np.random.default_rng(10)
    with pytest.raises(ValueError, match="no part of the record is steady"):
        find_standstills(5.0 + rng.standard_normal((1000, 1)), 0.01)
    with pytest.raises(ValueError, match="shorter than two windows"):
        find_standstills(rng.standard_normal((60, 1)), 0.01)
