"""Functions of arrays for two libraries."""

import math

import numpy as np

from gradcal_jax.arrays import running_sum


def test_a_running_sum_is_right_to_its_last_digit_after_many_additions():
    values = np.random.default_rng(0).uniform(0.0, 1.0, (20_000, 2))
    sums = running_sum(values)
    for row in (0, 1, 999, 19_999):
        exact = [math.fsum(values[: row + 1, k]) for k in (0, 1)]
        np.testing.assert_allclose(sums[row], exact, rtol=2.3e-16, atol=0.0)
    assert np.max(np.abs(np.cumsum(values, axis=0) - sums)) > 1e-12  # what plain addition loses here


def test_a_running_sum_of_few_rows():
    assert running_sum(np.zeros((0, 3))).shape == (0, 3)
    np.testing.assert_array_equal(running_sum(np.array([2.0])), [2.0])
