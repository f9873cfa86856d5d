"""Linear functions whose transpose is told: which of the two comes back, and every way to differentiate and batch."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gradcal_jax.information.by_platform import like, linear_with_transpose

RNG = np.random.default_rng(6)
MATRIX, TOLD = jnp.asarray(RNG.standard_normal((4, 3))), jnp.asarray(RNG.standard_normal((3, 4)))
ARGUMENT = (jnp.asarray(RNG.standard_normal(2)), jnp.asarray(RNG.standard_normal((1, 1))))
RESULT = jax.ShapeDtypeStruct((2, 2), jnp.float64)


def flat(a):
    return jnp.concatenate([a[0], a[1][0]])


def forwards(known, a):
    matrix, _ = known
    return jnp.reshape((matrix * matrix) @ flat(a), (2, 2))


def backwards(known, s):
    _, told = known
    back = told @ jnp.ravel(s)
    return back[:2], back[2:, None]


def apply(a, told=TOLD, matrix=MATRIX):
    return linear_with_transpose(forwards, backwards, (matrix, told), a, RESULT)


def true(matrix):
    return (matrix * matrix).T


def test_a_wrong_transpose_comes_back_from_reverse_mode_and_from_nothing_else():
    wanted = forwards((MATRIX, TOLD), ARGUMENT)
    for call in (apply, jax.jit(apply)):
        np.testing.assert_allclose(call(ARGUMENT), wanted, rtol=1e-14)
        np.testing.assert_allclose(jax.jvp(call, (ARGUMENT,), (ARGUMENT,))[1], wanted, rtol=1e-14)
        weight = jnp.asarray(RNG.standard_normal((5, 2, 2)))
        back = jax.vmap(lambda w, call=call: flat(jax.vjp(call, ARGUMENT)[1](w)[0]))(weight)
        np.testing.assert_allclose(back, jnp.reshape(weight, (5, 4)) @ TOLD.T, rtol=1e-13)


def test_batched_and_of_one_part_of_the_argument():
    many = (jnp.asarray(RNG.standard_normal((7, 2))), jnp.asarray(RNG.standard_normal((7, 1, 1))))
    matrices = jnp.asarray(RNG.standard_normal((7, 4, 3)))
    result = jax.jit(jax.vmap(lambda a, m: apply(a, matrix=m)))(many, matrices)
    for k in range(7):
        one = jax.tree.map(lambda x, k=k: x[k], many)
        np.testing.assert_allclose(result[k], forwards((matrices[k], TOLD), one), rtol=1e-13)
    part = jax.grad(lambda first: jnp.sum(apply((first, ARGUMENT[1]))))(ARGUMENT[0])
    np.testing.assert_allclose(part, (TOLD @ jnp.ones(4))[:2], rtol=1e-13)


@pytest.mark.parametrize("outer", [jax.jacfwd, jax.jacrev])
@pytest.mark.parametrize("inner", [jax.jacfwd, jax.jacrev])
def test_second_derivatives_with_what_is_known_in_it(inner, outer):
    """The told transpose is right where it stands; what follows from the matrix is for JAX to derive."""
    weight = jnp.asarray(RNG.standard_normal((2, 2)))

    def value(x, call):
        matrix, argument = MATRIX * x[0], (x[:2] ** 2, jnp.reshape(x[2] * x[0], (1, 1)))
        return jnp.sum(weight * call(matrix, argument)) ** 2

    def told(x):
        return value(x, lambda m, a: apply(a, told=true(m), matrix=m))

    def derived(x):
        return value(x, lambda m, a: forwards((m, None), a))

    at = jnp.asarray([0.7, -0.4, 1.1])
    wanted = jax.jit(jax.hessian(derived))(at)
    np.testing.assert_allclose(jax.jit(outer(inner(told)))(at), wanted, rtol=1e-11, atol=1e-11)
    batch = jnp.stack([at, 2.0 * at])
    np.testing.assert_allclose(jax.jit(jax.vmap(outer(inner(told))))(batch)[0], wanted, rtol=1e-11, atol=1e-11)


def test_shapes_are_as_jax_makes_them():
    assert like(np.zeros((2, 3))).dtype == jnp.float64
