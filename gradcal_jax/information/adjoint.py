"""The product of whitened rows `G = ΦᵀV⁻¹Φ`, its factor, with a derivative that needs no second run of the filter.

With `U = V⁻¹Φ` the derivative is

    dG = dΦᵀU + UᵀdΦ − UᵀdV U,

and for a linear state-space V the last term is a sum over the readings that is *linear* in the model's tangents. Let
u_k be row k of U, ρ_k the adjoint of the state before reading k, and ẑ_k the smoothed state there (de Jong's smoother;
Durbin and Koopman, Time Series Analysis by State Space Methods, 4.4–4.5):

    ρ_k = Aᵀρ_{k+1} + Hᵀrow_k/√S,   u_k = row_k/√S − gᵀρ_{k+1},   ẑ_k = x_k + P_k ρ_k,

    UᵀdV U = ρ₀ᵀ dP₀ ρ₀ + Σ_k [ u_kᵀ dR u_k + ρ_{k+1}ᵀ dQ ρ_{k+1}
                                + (u_kᵀ dH ẑ_k + ρ_{k+1}ᵀ dF ẑ_k) + (the same, transposed) ].

So a value and its gradient cost the filter, one backward linear recurrence with the same A in the same blocks, and a
few products; neither the filter's covariances nor its blocks are differentiated. The rule is linear in the tangents and
serves both modes; its transpose is dense products, or the machine code of `information.native` where it is available.
"""

from collections.abc import Callable, Sequence
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from gradcal_jax.information.by_platform import by_platform, like, linear_with_transpose
from gradcal_jax.information.native import Kept, native
from gradcal_jax.information.noise_steps import NoiseSteps
from gradcal_jax.information.whitening import (
    Filtered,
    FilterState,
    act,
    applied,
    block_length,
    cut,
    cut_rows,
    cut_up,
    filter_columns,
    gains,
    over_blocks,
    times,
    to_the_ends,
    total,
    transposed,
    whiten,
)
from gradcal_jax.linalg import dead_of, factor_tangent, scaled_factor, solve_transposed


@jax.custom_jvp
def gram(steps: NoiseSteps, columns: Float[Array, "N p"]) -> Float[Array, "p p"]:
    """`columnsᵀ V⁻¹ columns`, V the covariance of the used readings. This squares the rows' condition number."""
    rows = whiten(steps, columns)
    return rows.T @ rows


@gram.defjvp
def _gram_jvp(primals, tangents):
    rows, tangent = _linearised(*primals)
    return rows.T @ rows, tangent(*tangents)


@jax.custom_jvp
def whitened_factor(
    steps: NoiseSteps, columns: Float[Array, "N p"], below: Float[Array, "q p"]
) -> tuple[Float[Array, "p p"], Float[Array, " p"], Float[Array, "p p"]]:
    """R, upper triangular, and columns' lengths: `diag(scale) RᵀR diag(scale) = columnsᵀ V⁻¹ columns + belowᵀ below`.

    R is computed from the rows themselves, which keeps their condition number. `scale` counts as a constant. The third
    result is `(RᵀR)⁻¹`, not finite for singular R; its derivative needs no triangular solve.
    """
    return _with_inverse(*scaled_factor(whiten(steps, columns), below))[:3]


@whitened_factor.defjvp
def _whitened_factor_jvp(primals, tangents):
    (steps, columns, below), (d_steps, d_columns, d_below) = primals, tangents
    rows, tangent = _linearised(steps, columns)
    factor, scale, inverse, safe = _with_inverse(*scaled_factor(rows, below))
    cross = below.T @ d_below
    d_gram = tangent(d_steps, d_columns) + cross + cross.T
    d_scaled = d_gram / (scale[:, None] * scale[None, :])
    tangents = factor_tangent(factor, d_scaled), jnp.zeros_like(scale), -safe @ d_scaled @ safe
    return (factor, scale, inverse), tangents


def _with_inverse(factor: Array, scale: Array) -> tuple[Array, Array, Array, Array]:
    """The arguments, `(RᵀR)⁻¹`, and the same with ones for zeros on the diagonal, so that no derivative is NaN."""
    dead = dead_of(factor)
    half = solve_transposed(factor + jnp.diag(jnp.where(dead, 1.0, 0.0)), jnp.eye(len(factor), dtype=factor.dtype))
    safe = half.T @ half
    return factor, scale, safe + jnp.diag(jnp.where(dead, jnp.inf, 0.0)), safe


def _linearised(steps: NoiseSteps, columns: Array) -> tuple[Array, Callable[[NoiseSteps, Array], Array]]:
    """Whitened rows, and `dG` as a function of the tangents."""
    if native(steps, columns) is None:
        filtered = _filtered(steps, columns)
        rows = jnp.reshape(filtered.rows, (-1, columns.shape[1]))
        return rows, lambda d_steps, d_columns: _tangent(filtered, steps, d_steps, d_columns)
    rows, kept = _kept(steps, columns)

    def tangent(d_steps, d_columns):
        tangents = [*d_steps[:4], d_steps.initial, d_columns]
        product = jax.ShapeDtypeStruct((rows.shape[1],) * 2, rows.dtype)
        return linear_with_transpose(_tangent_in_blocks, _cotangents, (steps, columns, rows, kept), tangents, product)

    return rows, tangent


@jax.custom_jvp
def _kept(steps: NoiseSteps, columns: Array) -> tuple[Array, Kept]:
    (count, p), n, dtype = columns.shape, steps.observation.shape[1], like(columns).dtype
    shapes = ((count, n, p), (count, n, n), (count, n), (count,))
    results = like(columns), Kept(*(jax.ShapeDtypeStruct(shape, dtype) for shape in shapes))
    return _keep_by_platform(results, steps, columns)


@_kept.defjvp
def _kept_jvp(primals, tangents):
    """For second derivatives. Only the custom transpose uses `Kept`; JAX derives its derivative from the linear map."""
    rows, kept = _kept(*primals)
    d_rows = jax.jvp(partial(whiten, block=block_length(rows.shape[0])), primals, tangents)[1]
    return (rows, kept), (d_rows, jax.tree.map(jnp.zeros_like, kept))


def _kept_natively(steps: NoiseSteps, columns: Array) -> tuple[Array, Kept]:
    code = native(steps, columns)
    assert code is not None
    return code.keep(steps, columns)


def _kept_in_blocks(steps: NoiseSteps, columns: Array) -> tuple[Array, Kept]:
    count = columns.shape[0]
    filtered = _filtered(steps, columns)
    assert filtered.states is not None

    def by_reading(x: Array) -> Array:
        """`(B, K, …)` to `(N, …)`."""
        return jnp.reshape(x, (-1, *x.shape[2:]))[:count]

    def in_order(x: Array) -> Array:
        """`(K, …, B)` to `(N, …)`."""
        return by_reading(jnp.moveaxis(x, (-1, 0), (0, 1)))

    covariances, per_std = in_order(filtered.covariance), in_order(filtered.per_std)
    cross = jnp.einsum("kij,kj->ki", covariances, jnp.asarray(steps.observation))
    kept = Kept(by_reading(jnp.moveaxis(filtered.states, 0, 2)), covariances, cross * per_std[:, None] ** 2, per_std)
    return by_reading(filtered.rows), kept


_keep_by_platform = by_platform("gradcal_keep", _kept_natively, _kept_in_blocks)


def _pulled_natively(steps: NoiseSteps, rows: Array, kept: Kept, of_product: Array) -> list[Array]:
    code = native(steps, rows)
    assert code is not None
    return code.cotangents(steps, rows, kept, of_product)


def _pulled_in_blocks(steps: NoiseSteps, rows: Array, kept: Kept, of_product: Array) -> list[Array]:
    filtered = _refiltered(steps, rows, kept)

    def linear(tangents):
        return _tangent(filtered, steps, _changed(steps, tangents), tangents[-1])

    (cotangents,) = jax.linear_transpose(linear, [*steps[:4], steps.initial, rows])(of_product)
    return cotangents


_pull_by_platform = by_platform("gradcal_pull", _pulled_natively, _pulled_in_blocks)


@jax.jit  # Traced once, and not at every use of `_linearised`.
def _tangent_in_blocks(known: tuple[NoiseSteps, Array, Array, Kept], tangents: list[Array]) -> Array:
    steps, columns, *_ = known
    return _tangent(_filtered(steps, columns), steps, _changed(steps, tangents), tangents[-1])


def _cotangents(known: tuple[NoiseSteps, Array, Array, Kept], of_product: Array) -> list[Array]:
    steps, _, rows, kept = known
    results = [like(x) for x in (*steps[:4], steps.initial, rows)]
    return _pull_by_platform(results, steps, rows, kept, of_product)


def _changed(steps: NoiseSteps, tangents: Sequence[Array]) -> NoiseSteps:
    transition, covariance, observation, variance, initial, _ = tangents
    return NoiseSteps(transition, covariance, observation, variance, steps.used, initial)


def _refiltered(steps: NoiseSteps, rows: Array, kept: Kept) -> Filtered:
    """`Filtered` from the values kept by reading; its `end` is that before the last reading."""
    length = block_length(rows.shape[0])
    cut_steps = cut_up(jax.tree.map(jnp.asarray, steps), length)
    covariance = cut(kept.covariances, length, 0.0)
    closed, gain, per_std = gains(cut_steps, covariance)
    through, _ = to_the_ends(closed, gain)
    states = jnp.moveaxis(cut_rows(kept.states, length), 2, 0)
    end = FilterState(kept.states[-1], kept.covariances[-1])
    return Filtered(cut_steps, cut_rows(rows, length), states, covariance, closed, gain, per_std, through, end)


def _filtered(steps: NoiseSteps, columns: Array) -> Filtered:
    start = FilterState(jnp.zeros((steps.observation.shape[1], columns.shape[1]), columns.dtype), steps.initial)
    return filter_columns(start, steps, columns, None, keep=True)


def _backwards(filtered: Filtered) -> tuple[Array, Array, Array]:
    """`u_k` `(B, K, p)`, `ρ_{k+1}` `(n, B, K, p)` and `ρ_0` `(n, p)`."""
    steps, rows = filtered.steps, filtered.rows
    blocks, length, p = rows.shape
    n = filtered.gain.shape[1]

    def from_the_start(response, now):
        a, h = now
        return times(a, response), applied(transposed(response), h)

    first = jnp.broadcast_to(jnp.eye(n, dtype=rows.dtype)[:, :, None], (n, n, blocks))
    _, seen = jax.lax.scan(from_the_start, first, (filtered.closed, steps.observation))
    effect, nothing = seen * filtered.per_std[:, None], jnp.zeros((n, p), rows.dtype)
    ends, first_of_all = over_blocks(transposed(filtered.through), effect, rows, nothing, reverse=True)

    def step(carry, now):
        rho, us, rhos = carry
        k, a, g, h, w = now
        scaled = w[:, None] * jax.lax.dynamic_index_in_dim(rows, k, 1, keepdims=False)
        us = jax.lax.dynamic_update_index_in_dim(us, scaled - jnp.sum(g[..., None] * rho, axis=0), k, 1)
        rhos = jax.lax.dynamic_update_index_in_dim(rhos, rho, k, 2)
        return (act(transposed(a), rho) + h[..., None] * scaled[None], us, rhos), None

    now = (jnp.arange(length), filtered.closed, filtered.gain, steps.observation, filtered.per_std)
    empty = (jnp.zeros_like(rows), jnp.zeros((n, *rows.shape), rows.dtype))
    (_, us, rhos), _ = jax.lax.scan(step, (ends, *empty), now, reverse=True)
    return us, rhos, first_of_all


def _tangent(filtered: Filtered, steps: NoiseSteps, d_steps: NoiseSteps, d_columns: Array) -> Float[Array, "p p"]:
    """`dG`; see the module's head. One of each pair of transposes is computed, and the sum is symmetrised."""
    us, rhos, first_of_all = _backwards(filtered)
    states = filtered.states
    assert states is not None
    length, n = us.shape[1], states.shape[0]

    def by_time(x: Array) -> Array:
        """`(K, …, B)` to `(…, B, K)`, the layout of the large arrays."""
        return jnp.moveaxis(x, 0, -1)

    # ρ_k = Hᵀu_k + Fᵀρ_{k+1}, the same as with A.
    h, covariance = by_time(filtered.steps.observation), by_time(filtered.covariance)
    by_next = times(covariance, transposed(by_time(filtered.steps.transition)))
    smoothed = states + applied(covariance, h)[..., None] * us[None] + act(by_next, rhos)

    def small(x: Array, *, later: bool = False) -> Array:
        return by_time(cut(x, length, 0.0, later=later))[..., None]

    d_noise, d_transition = small(d_steps.covariance, later=True), small(d_steps.transition, later=True)
    d_observation, d_variance = small(d_steps.observation), small(d_steps.reading_variance)
    of_u = d_variance * us - 2.0 * cut_rows(d_columns, length)
    of_u = of_u + 2.0 * total(d_observation[i] * smoothed[i] for i in range(n))
    half = jnp.einsum("bkp,bkq->pq", us, of_u)
    for i in range(n):
        terms = [2.0 * d_transition[i, j] * smoothed[j] for j in range(n)]
        terms += [(d_noise[i, j] + d_noise[j, i]) * rhos[j] if j > i else d_noise[i, i] * rhos[i] for j in range(i, n)]
        half = half + jnp.einsum("bkp,bkq->pq", rhos[i], total(terms))
    first, d_first = steps.transition[0], d_steps.transition[0]
    d_start = first @ d_steps.initial @ first.T + d_steps.covariance[0]
    d_start = d_start + 2.0 * d_first @ steps.initial @ first.T
    half = half + first_of_all.T @ d_start @ first_of_all
    return -0.5 * (half + half.T)
