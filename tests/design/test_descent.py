"""The descent: it ends at a minimum, can be watched, and comes back from where there is no value."""

import jax.numpy as jnp
import numpy as np
import pytest

from gradcal_jax.design.descent import LOOK, Descent


def valley(x, args):
    """Rosenbrock's, its minimum at (a, a²)."""
    (a,) = args
    return (a - x[0]) ** 2 + 100.0 * (x[1] - x[0] ** 2) ** 2


BEGIN = np.array([-1.2, 1.0])


def test_a_descent_reaches_the_minimum_and_is_watched():
    seen = []
    for a in (1.0, 1.5):
        last = Descent(valley)(BEGIN, (a,), evaluations=400, ends=lambda now: seen.append(now))
        assert last.point == pytest.approx([a, a * a], abs=1e-4)
        assert last.value == pytest.approx(float(valley(last.point, (a,))), abs=1e-12)
    assert all(now.evaluations % LOOK == 0 for now in seen)
    assert Descent(valley)(BEGIN, (1.0,), evaluations=15).evaluations == 15
    assert Descent(valley)(BEGIN, (1.0,), evaluations=90, ends=lambda _: True).evaluations == LOOK


def test_a_step_to_where_there_is_no_value_is_made_shorter():
    """log x, of which the first step of unit length is beyond zero."""

    def steep(x, args):
        value = jnp.sum(x - 0.01 * jnp.log(x)) * args
        return jnp.where(jnp.isfinite(value), value, 1e3)

    last = Descent(steep)(np.array([0.5, 0.6]), 3.0, evaluations=200)
    assert last.point == pytest.approx([0.01, 0.01], rel=1e-2)
