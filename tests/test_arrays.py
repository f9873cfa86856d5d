"""Functions of arrays for two libraries."""

import math
import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gradcal_jax.arrays import PytreeModule, once, put, running_sum, summed, taken


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


ROWS = np.array([[0, 6, -1], [3, 3, 2]])
SELECTIONS = {
    "some rows twice": (lambda x: taken(x, ROWS), lambda x: x[ROWS]),
    "no rows": (lambda x: taken(x, np.zeros(0, int)), lambda x: x[:0]),
    "one row often": (lambda x: taken(x, np.zeros(400, int)), lambda x: x[np.zeros(400, int)]),
    "sums": (lambda x: summed(x, np.array([0, 1, 5])), lambda x: jnp.stack([x[0], x[1:5].sum(0), x[5:].sum(0)])),
    "rows put": (lambda x: put(x, np.array([4, 1]), x[:2]), lambda x: x.at[np.array([4, 1])].set(x[:2])),
}


@pytest.mark.parametrize("name", SELECTIONS)
def test_known_selections_of_rows_have_the_derivatives_and_batches_of_jax(name):
    ours, plain = SELECTIONS[name]
    ours, plain = jax.jit(ours), jax.jit(plain)
    x = jnp.asarray(np.random.default_rng(0).standard_normal((7, 3)))
    np.testing.assert_array_equal(ours(x), plain(x))
    curved = [jax.hessian(lambda v, of=of: jnp.sum(jnp.sin(of(jnp.cos(v))) ** 2)) for of in (ours, plain)]
    np.testing.assert_allclose(*(jax.jit(of)(x) for of in curved), rtol=1e-12, atol=1e-12)
    many = jnp.stack([x, 2.0 * x])
    for axis in range(3):
        batch = jnp.moveaxis(many, 0, axis)
        np.testing.assert_array_equal(jax.vmap(ours, axis)(batch), jax.vmap(plain, axis)(batch))
