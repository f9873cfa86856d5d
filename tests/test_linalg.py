"""Triangular factors: RᵀR, and derivatives that stay right where the rows do not span the space."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gradcal_jax.linalg import column_norms, scaled_factor, solve_transposed, triangular_factor


def rows_of(kind: str) -> np.ndarray:
    rng = np.random.default_rng(3)
    full = rng.standard_normal((7, 4))
    if kind == "dependent last":
        full[:, 3] = full[:, 0] - 2.0 * full[:, 1]
    elif kind == "zero column":
        full[:, 1] = 0.0
    elif kind == "dependent in the middle":
        full[:, 2] = 0.5 * full[:, 0]
    elif kind == "too few rows":
        full = full[:2]
    return full


KINDS = ("full", "dependent last", "dependent in the middle", "zero column", "too few rows")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_the_factor_is_triangular_with_the_same_gram(kind, dtype):
    rows = jnp.asarray(rows_of(kind).astype(dtype))
    factor = np.asarray(triangular_factor(rows))
    assert factor.dtype == dtype
    assert np.all(np.tril(factor, -1) == 0.0)
    assert np.all(np.diagonal(factor) >= 0.0)
    # Backward error of QR, n·p·eps of the rows' size, twice in the product.
    size = float(np.sum(np.square(rows)))
    assert np.max(np.abs(factor.T @ factor - np.asarray(rows.T @ rows))) <= 2 * rows.size * np.finfo(dtype).eps * size


@pytest.mark.parametrize("apart", [1.0, 1e-2, 1e-4, 1e-7, 0.0])
@pytest.mark.parametrize("count", [20, 200])
@pytest.mark.parametrize("second", [0.0, 1.0])
def test_scaled_rows_keep_their_condition_however_parallel_they_are(count, apart, second):
    rng = np.random.default_rng(6)
    rows, below = rng.standard_normal((count, 5)), rng.standard_normal((3, 5))
    for block in (rows, below):
        block[:, 4] = block[:, 0] + apart * block[:, 4]
        block *= [1e6, second, 1e-6, 1e3, 1.0]
    together = np.concatenate([rows, below])
    factor, scale = jax.jit(scaled_factor)(rows, below)
    lengths = np.linalg.norm(together, axis=0)
    np.testing.assert_allclose(scale, np.where(lengths > 0.0, lengths, 1.0), rtol=1e-14)
    wanted = np.abs(np.diagonal(np.linalg.qr(together / np.where(lengths > 0.0, lengths, 1.0), mode="r")))
    np.testing.assert_allclose(np.diagonal(factor), wanted, rtol=1e-7, atol=1e-14)


def smooth_function_of_the_gram(rows):
    """Uses RᵀR and, through it, a solve with the identity added: a smooth function of the rows whatever their rank."""
    factor = triangular_factor(rows)
    gram = factor.T @ factor
    return jnp.sum(jnp.sin(gram)) + jnp.linalg.slogdet(gram + jnp.eye(rows.shape[1]))[1]


@pytest.mark.parametrize("kind", KINDS)
def test_functions_of_the_gram_have_their_derivative(kind):
    """Along tangents that keep the rows' span, for the rank is not to change."""
    rng = np.random.default_rng(4)
    rows = rows_of(kind)
    direct = lambda a: jnp.sum(jnp.sin(a.T @ a)) + jnp.linalg.slogdet(a.T @ a + jnp.eye(a.shape[1]))[1]  # noqa: E731
    span = np.linalg.pinv(rows) @ rows
    tangent = jnp.asarray(rng.standard_normal(rows.shape) @ span)
    primal = jnp.asarray(rows)
    # In one program each: every operation by itself would be compiled by itself.
    along = lambda of: jax.jit(lambda a, da: jax.jvp(of, (a,), (da,))[1])(primal, tangent)  # noqa: E731
    wanted, result = along(direct), along(smooth_function_of_the_gram)
    np.testing.assert_allclose(result, wanted, rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("kind", KINDS)
def test_no_derivative_is_nan(kind):
    rows = jnp.asarray(rows_of(kind))
    assert np.all(np.isfinite(jax.jit(jax.jacrev(triangular_factor))(rows)))
    assert np.all(np.isfinite(jax.jit(jax.grad(smooth_function_of_the_gram))(rows)))
    assert np.all(np.isfinite(jax.jit(jax.jacfwd(triangular_factor))(jnp.zeros_like(rows))))


def test_solves_and_norms():
    factor = triangular_factor(jnp.asarray(rows_of("full")))
    right = jnp.asarray(np.random.default_rng(6).standard_normal((4, 3)))
    np.testing.assert_allclose(factor.T @ solve_transposed(factor, right), right, atol=1e-12)
    rows = jnp.asarray(rows_of("zero column"))
    norms = column_norms(rows)
    assert norms[1] == 1.0
    np.testing.assert_allclose(norms[0], np.linalg.norm(rows[:, 0]), rtol=1e-15)
    slope = jax.jit(jax.grad(lambda a: jnp.sum(column_norms(a))))(rows)
    assert np.all(np.isfinite(slope))
    assert np.all(np.asarray(slope[:, 1]) == 0.0)
