"""Functions of arrays for two libraries."""

import math
import pickle

import jax
import jax.numpy as jnp
import numpy as np

from gradcal_jax.arrays import PytreeModule, once, running_sum


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


class Lengths(PytreeModule):
    sides: jax.Array | np.ndarray

    @once
    def total(self):
        """The sum."""
        return self.sides.sum() + (self.sides * 0.0)


def test_a_result_of_numbers_is_kept_and_a_traced_one_is_not():
    known = Lengths(np.array([1.0, 2.0]))
    assert known.total() is known.total()
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(known)).total(), [3.0, 3.0])
    # A module of JAX's arrays that a traced function closes over: its tracers must not outlive the trace.
    traced = Lengths(jnp.array([1.0, 2.0]))
    for _ in range(2):
        assert float(jax.jit(lambda x: (traced.total() * x).sum())(2.0)) == 12.0
    np.testing.assert_array_equal(traced.total(), [3.0, 3.0])
