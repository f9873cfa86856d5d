"""Whitening: a Kalman filter of the noise alone, run over every column of the regressors as if it were data.

With the parameters kept out of the state, `L⁻¹Φ` (`LLᵀ` the covariance of all readings) costs O(N·n²·p) with a
handful of noise states `n`, in blocks so that neither a CPU nor a GPU walks through N small steps:

1. **Inside blocks, all blocks side by side.** The readings are cut into `B` blocks of `K`. Each block's filter starts
   from a *known* state `s_b`, whose effect on the readings is carried as `n` more columns. After K steps, taken for all
   blocks at once, every block is `e = Φ̃ − Ã s_b` with unit white noise, and `s_{b+1} = X + Ψ s_b + noise(P)`.
2. **An orthogonal basis** `U` of the few columns `Ã` (`Ã = U R`): what of `Φ̃` is orthogonal to `U` does not depend on
   the start and is white as it stands; `UᵀΦ̃ = R s_b + noise` are `n` readings of the start.
3. **Between blocks**, a short filter over the B blocks takes those n readings one scalar at a time.

The rows of 2 and 3 together satisfy `rowsᵀ rows = Φᵀ (LLᵀ)⁻¹ Φ` exactly. The block filter is exact algebra: no steady
state, no approximation, any timing.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from gradcal_jax.information.noise_steps import NoiseSteps

Grid = list[list[Array]]


class FilterState(NamedTuple):
    """What goes from one stretch of readings to the next: every column's predicted state, and its covariance."""

    mean: Float[Array, "n p"]
    covariance: Float[Array, "n n"]


def whiten(steps: NoiseSteps, columns: Float[Array, "N p"], *, block: int | None = None) -> Float[Array, "rows p"]:
    """Rows with `rowsᵀ rows = columnsᵀ V⁻¹ columns`, V the covariance of the used readings.

    `block`: K, by default about √N. Shapes and the algorithm are in the module's head.
    """
    start = FilterState(jnp.zeros((steps.observation.shape[1], columns.shape[1]), columns.dtype), steps.initial)
    rows, _ = whiten_from(start, steps, columns, block=block)
    return rows


def whiten_from(
    state: FilterState, steps: NoiseSteps, columns: Float[Array, "N p"], *, block: int | None = None
) -> tuple[Float[Array, "rows p"], FilterState]:
    """As `whiten`, from a given state and returning the next: long logs go through in tiles."""
    count, p = columns.shape
    n = steps.observation.shape[1]
    length = block or max(1, round(1.2 * count**0.5))
    blocks = -(-count // length)
    padding = blocks * length - count

    def side_by_side(x: Array, fill: Array | float | bool) -> Array:
        """`(N, …)` to `(K, …, B)`: time first for the scan, blocks last for the vector units."""
        if padding:
            x = jnp.concatenate([x, jnp.broadcast_to(jnp.asarray(fill, x.dtype), (padding, *x.shape[1:]))])
        return jnp.moveaxis(jnp.reshape(x, (blocks, length, *x.shape[1:])), 0, -1)

    inputs = (
        side_by_side(steps.transition, jnp.eye(n, dtype=columns.dtype)),
        side_by_side(steps.covariance, 0.0),
        side_by_side(steps.observation, 0.0),
        side_by_side(steps.reading_variance, 1.0),
        side_by_side(steps.used, False),
        side_by_side(columns, 0.0),
    )
    inner, end_mean, end_covariance = _inside_blocks(inputs, n, p, blocks)
    data, starts = inner[:, :p], inner[:, p:]
    basis, triangle = _orthogonal_basis(starts)
    projected = [jnp.sum(data * u[:, None], axis=0) for u in basis]
    for u, z in zip(basis, projected, strict=True):
        data = data - u[:, None] * z[None]
    between, state = _between_blocks(state, triangle, jnp.stack(projected), end_mean, end_covariance, p)
    rows = jnp.reshape(jnp.moveaxis(data, -1, 0), (-1, p))
    return jnp.concatenate([rows, jnp.reshape(between, (-1, p))]), state


def _inside_blocks(inputs: tuple[Array, ...], n: int, p: int, blocks: int) -> tuple[Array, list[Array], Grid]:
    """Step 1: whitened columns `(K, p+n, B)`, the last n `Ã`; end states n × (p+n, B), covariances n × n × (B,)."""
    dtype = inputs[5].dtype
    unit = [
        jnp.concatenate(
            [jnp.zeros((p, blocks), dtype), *(jnp.full((1, blocks), float(i == j), dtype) for j in range(n))]
        )
        for i in range(n)
    ]
    known = [[jnp.zeros(blocks, dtype) for _ in range(n)] for _ in range(n)]

    def step(carry, now):
        mean, cov = carry
        transition, noise, observe, variance, used, column = now
        f = [[transition[i, j] for j in range(n)] for i in range(n)]
        mean = [sum((f[i][j][None] * mean[j] for j in range(1, n)), start=f[i][0][None] * mean[0]) for i in range(n)]
        cov = _propagate(f, cov, noise)
        h = [observe[i] for i in range(n)]
        gain, spread = _gain(cov, h, variance)
        weight = jnp.where(used & (spread > 0.0), 1.0, 0.0)
        per_std = weight * jax.lax.rsqrt(jnp.where(weight > 0.0, spread, 1.0))
        seen = sum((h[j][None] * mean[j] for j in range(1, n)), start=h[0][None] * mean[0])
        column = jnp.concatenate([column, jnp.zeros((n, blocks), dtype)])
        row = per_std[None] * (column - seen)
        gain = [g * per_std for g in gain]
        mean = [mean[i] + gain[i][None] * row for i in range(n)]
        cov = [[cov[i][j] - gain[i] * gain[j] for j in range(n)] for i in range(n)]
        return (mean, cov), row

    (mean, cov), rows = jax.lax.scan(step, (unit, known), inputs)
    # The start's columns carry the response of the *prediction*; as regressors of the readings their sign is opposite.
    return rows.at[:, p:].multiply(-1.0), mean, cov


def _propagate(f: Grid, cov: Grid, noise: Array) -> Grid:
    """`F P Fᵀ + Q`, written out; symmetric entries are computed once."""
    n = len(f)
    half = [
        [sum((f[i][k] * cov[k][j] for k in range(1, n)), start=f[i][0] * cov[0][j]) for j in range(n)] for i in range(n)
    ]
    out: Grid = [[half[0][0]] * n for _ in range(n)]
    for i in range(n):
        for j in range(i, n):
            value = sum((half[i][k] * f[j][k] for k in range(1, n)), start=half[i][0] * f[j][0]) + noise[i, j]
            out[i][j] = out[j][i] = value
    return out


def _gain(cov: Grid, h: list[Array], variance: Array) -> tuple[list[Array], Array]:
    """`P Hᵀ` and `H P Hᵀ + R`."""
    n = len(h)
    gain = [sum((cov[i][j] * h[j] for j in range(1, n)), start=cov[i][0] * h[0]) for i in range(n)]
    return gain, sum((h[i] * gain[i] for i in range(1, n)), start=h[0] * gain[0]) + variance


def _orthogonal_basis(starts: Float[Array, "K n B"]) -> tuple[list[Array], Grid]:
    """Step 2: Gram–Schmidt, twice, over each block's few start columns: `n × (K, B)`, and R with `Ã = U R`.

    A column that depends on the ones before (a state that the block does not see) gets the direction 0.
    """
    n = starts.shape[1]
    eps = jnp.finfo(starts.dtype).eps
    basis: list[Array] = []
    zero = jnp.zeros_like(starts[0, 0])
    triangle: Grid = [[zero] * n for _ in range(n)]
    for j in range(n):
        column = starts[:, j]
        whole = jnp.sum(column * column, axis=0)
        for _ in range(2):
            for i, u in enumerate(basis):
                share = jnp.sum(u * column, axis=0)
                triangle[i][j] = triangle[i][j] + share
                column = column - u * share[None]
        square = jnp.sum(column * column, axis=0)
        alive = square > (1e3 * eps) ** 2 * whole
        norm = jnp.where(alive, jnp.sqrt(jnp.where(alive, square, 1.0)), 0.0)
        basis.append(column * jnp.where(alive, 1.0 / jnp.where(alive, norm, 1.0), 0.0)[None])
        triangle[j][j] = norm
    return basis, triangle


def _between_blocks(
    state: FilterState, triangle: Grid, readings: Float[Array, "n p B"], mean: list[Array], cov: Grid, p: int
) -> tuple[Float[Array, "B n p"], FilterState]:
    """Step 3: the blocks' readings of their start states, filtered from block to block."""
    n = len(mean)
    last_first = lambda x: jnp.moveaxis(x, -1, 0)  # noqa: E731
    ends = last_first(jnp.stack(mean))
    inputs = (
        last_first(jnp.stack([jnp.stack(r) for r in triangle])),
        last_first(readings),
        ends[:, :, :p],
        ends[:, :, p:],
        last_first(jnp.stack([jnp.stack(c) for c in cov])),
    )

    def step(carry, now):
        m, c = carry
        observe, reading, offset, onward, noise = now
        rows = []
        for i in range(n):
            h = observe[i]
            gain = c @ h
            per_std = jax.lax.rsqrt(1.0 + h @ gain)
            row = per_std * (reading[i] - h @ m)
            gain = gain * per_std
            m = m + gain[:, None] * row[None, :]
            c = c - gain[:, None] * gain[None, :]
            rows.append(row)
        m = offset + onward @ m
        c = onward @ c @ onward.T + noise
        return (m, c), jnp.stack(rows)

    (m, c), rows = jax.lax.scan(step, (state.mean, state.covariance), inputs)
    return rows, FilterState(m, c)
