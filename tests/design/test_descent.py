"""The descent: it ends at a minimum, can be watched, and comes back from where there is no value."""

import jax.numpy as jnp
import numpy as np
import pytest

from gradcal_jax.design.descent import Descent


def valley(x, args):
    """Rosenbrock's, its minimum at (a, a²)."""
    (a,) = args
    return (a - x[0]) ** 2 + 100.0 * (x[1] - x[0] ** 2) ** 2


def test_a_descent_reaches_the_minimum_and_says_that_it_ended():
    descent = Descent(valley, tolerance=1e-9)
    for a in (1.0, 1.5):
        *some, last = descent(np.array([-1.2, 1.0]), (a,), evaluations=400, together=10)
        assert last.ended
        assert last.point == pytest.approx([a, a * a], abs=1e-6)
        assert [r.evaluations for r in some] == list(range(10, 10 * len(some) + 1, 10))
        values = [r.value for r in (*some, last)]
        assert values == sorted(values, reverse=True)
        assert last.value == pytest.approx(float(valley(last.point, (a,))), abs=1e-12)


def test_it_makes_no_more_evaluations_than_it_may():
    *_, last = Descent(valley)(np.array([-1.2, 1.0]), (1.0,), evaluations=25, together=10)
    assert last.evaluations == 25
    assert not last.ended


def test_a_step_to_where_there_is_no_value_is_made_shorter():
    """log x, of which the first step of unit length is beyond zero."""

    def steep(x, args):
        value = jnp.sum(x - 0.01 * jnp.log(x)) * args
        return jnp.where(jnp.isfinite(value), value, 1e3)

    *_, last = Descent(steep, tolerance=1e-9)(np.array([0.5, 0.6]), 3.0, evaluations=200)
    assert last.point == pytest.approx([0.01, 0.01], rel=1e-3)
