"""Triangular factors with safe derivatives, and triangular solves.

A square-root information matrix is an upper triangular `R` with `RᵀR = AᵀA` for stacked whitened rows `A`. No matrix is
inverted here, and no absolute jitter is added: in radians a diagonal of 1e-9 is larger than the signal.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Bool, Float

from gradcal_jax.arrays import AnyArray, namespace

# Ratio of rows to columns from which on two products are faster than QR.
_TALL = 8
# Least ratio of smallest to largest diagonal of the first Cholesky factor; NaN, without a factor, fails as well.
_SOUND = 1e-5
# Squared condition number (Frobenius) up to which the first factor is as accurate as any: rounding of the product is at
# most 1e-16 of it.
_WELL_CONDITIONED = 1e5
# Entries from which on a second product takes a noticeable part of a single prediction; below, its digits cost nothing.
_LARGE = 200_000


def triangular_factor(rows: Float[AnyArray, "n p"]) -> Float[AnyArray, "p p"]:
    """Upper triangular `R`, diagonal not negative, with `RᵀR = rowsᵀ rows`; JAX's has a derivative for any rows."""
    (n, p), xp = rows.shape, namespace(rows)
    if n < p:
        rows = xp.concatenate([rows, xp.zeros((p - n, p), rows.dtype)])
    if xp is jnp:
        return _triangular_factor(rows)
    if n >= _TALL * p:
        try:
            first = np.linalg.cholesky(rows.T @ rows).T
        except np.linalg.LinAlgError:
            first = np.zeros((p, p))
        diagonal = np.diagonal(first)
        if np.min(diagonal, initial=np.inf) > _SOUND * np.max(diagonal, initial=0.0):
            if rows.size > _LARGE:
                inverse = scipy.linalg.solve_triangular(first, np.eye(p), check_finite=False)
                if np.sum(first**2) * np.sum(inverse**2) < _WELL_CONDITIONED:
                    return first
            return _by_two_products(rows, first)
    return _by_reflections(rows)


@jax.custom_jvp
def _triangular_factor(rows: Float[Array, "n p"]) -> Float[Array, "p p"]:
    """Upper triangular `R`, diagonal not negative, with `RᵀR = rowsᵀ rows`.

    The derivative follows from `d(RᵀR) = dRᵀR + RᵀdR`: with `S = R⁻ᵀ d(rowsᵀrows) R⁻¹`, `dR = (upper(S) + ½diag(S))
    R`. JAX's own rule for QR divides by zero for rows that do not span the space; here such directions (a zero on R's
    diagonal) contribute nothing, so every differentiable function of `RᵀR` has its derivative, and none is NaN.
    """
    n, p = rows.shape
    return _by_reflections(rows) if n < _TALL * p else _of_tall(rows.T @ rows, lambda: rows)


def scaled_factor(rows: Float[Array, "n p"], below: Float[Array, "q p"]) -> tuple[Float[Array, "p p"], Array]:
    """R of the stacked rows with columns scaled to unit length, and these lengths `(p,)`, 1 for zero."""

    def scaled(scale: Array) -> Array:
        return jnp.concatenate([rows, below]) / scale[None, :]

    n, p = rows.shape
    if n < _TALL * p:
        scale = column_norms(jnp.concatenate([rows, below]))
        return triangular_factor(scaled(scale)), scale
    # One pass over the rows: their product contains the lengths, too.
    product = rows.T @ rows + below.T @ below
    square = jnp.diagonal(product)
    scale = jnp.where(square > 0.0, jnp.sqrt(square), 1.0)
    return _of_tall(product / (scale[:, None] * scale[None, :]), lambda: scaled(scale)), scale


def _of_tall(product: Float[Array, "p p"], rows: Callable[[], Array]) -> Float[Array, "p p"]:
    """R of tall rows from their product, where that is accurate enough.

    Cholesky of the product: once where the columns are far from parallel; twice, which is as accurate as QR unless the
    first factor is too ill-conditioned (Yamamoto and others, 2015) and takes a tenth of its time; otherwise QR.
    """
    first, p = jnp.linalg.cholesky(product).T, product.shape[0]
    diagonal = jnp.diagonal(first)
    sound = jnp.min(diagonal) > _SOUND * jnp.max(diagonal)
    inverse = solve_triangular(jnp.where(sound, first, jnp.eye(p, dtype=first.dtype)), jnp.eye(p, dtype=first.dtype))
    good = sound & (jnp.sum(first**2) * jnp.sum(inverse**2) < _WELL_CONDITIONED)
    ways = [lambda _: _by_reflections(rows()), lambda first: _by_two_products(rows(), first), lambda first: first]
    return jax.lax.switch(sound.astype(int) + good.astype(int), ways, first)


def _by_two_products(rows: Float[AnyArray, "n p"], first: Float[AnyArray, "p p"]) -> Float[AnyArray, "p p"]:
    orthogonal = solve_transposed(first, rows.T)
    return namespace(rows).linalg.cholesky(orthogonal @ orthogonal.T).T @ first


def _by_reflections(rows: Float[AnyArray, "n p"]) -> Float[AnyArray, "p p"]:
    xp = namespace(rows)
    factor = xp.linalg.qr(rows, mode="r")
    sign = xp.where(xp.diagonal(factor) < 0.0, -1.0, 1.0).astype(rows.dtype)
    return xp.triu(factor * sign[:, None])


@_triangular_factor.defjvp
def _triangular_factor_jvp(primals, tangents):
    (rows,), (d_rows,) = primals, tangents
    factor = _triangular_factor(rows)
    cross = rows.T @ d_rows
    return factor, factor_tangent(factor, cross + cross.T)


def factor_tangent(factor: Float[Array, "p p"], d_gram: Float[Array, "p p"]) -> Float[Array, "p p"]:
    """`dR` of an upper triangular R for a symmetric `d(RᵀR)`; see `triangular_factor`."""
    dead = dead_of(factor)
    safe = factor + jnp.diag(jnp.where(dead, 1.0 - jnp.diagonal(factor), 0.0))
    half = solve_triangular(safe, d_gram, trans=1, lower=False)
    inner = solve_triangular(safe, half.T, trans=1, lower=False)
    alive = jnp.where(dead, 0.0, 1.0).astype(factor.dtype)
    inner = inner * alive[:, None] * alive[None, :]
    upper = jnp.triu(inner, 1) + 0.5 * jnp.diag(jnp.diagonal(inner))
    return upper @ factor


def dead_of(factor: Float[Array, "p p"]) -> Bool[Array, " p"]:
    """Where the diagonal of an upper triangular R is rounding."""
    diagonal = jnp.diagonal(factor)
    return diagonal <= factor.shape[1] * jnp.finfo(factor.dtype).eps * jnp.max(diagonal, initial=0.0)


def solve_transposed(factor: Float[AnyArray, "p p"], right: Float[AnyArray, "p m"]) -> Float[AnyArray, "p m"]:
    """`R⁻ᵀ right` for upper triangular `R`: the columns' norms squared are `rightᵀ (RᵀR)⁻¹ right`."""
    if namespace(factor, right) is np:
        return scipy.linalg.solve_triangular(factor, right, trans=1, check_finite=False)
    return solve_triangular(factor, right, trans=1, lower=False)


def column_norms(rows: Float[AnyArray, "n p"]) -> Float[AnyArray, " p"]:
    """Euclidean norm of each column, 1 where a column is zero; its derivative is zero there, not NaN."""
    xp = namespace(rows)
    square = xp.einsum("ij,ij->j", rows, rows)
    alive = square > 0.0
    return xp.where(alive, xp.sqrt(xp.where(alive, square, 1.0)), 1.0)
