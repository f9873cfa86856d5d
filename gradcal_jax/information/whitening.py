"""Whitening: a Kalman filter of the noise alone, applied to every column of the regressors as to data.

With the parameters kept out of the state, `L⁻¹Φ` (`LLᵀ = V` the covariance of all readings) costs O(N·n²·p) with a
handful of noise states `n`. Written for the state *before* each reading, `P_k` its covariance and `F`, `Q` the step
that follows reading k,

    S = H P Hᵀ + R,   g = F P Hᵀ/S,   A = F − g H,   P⁺ = F (P − P Hᵀ H P/S) Fᵀ + Q
    x⁺ = A x + g y,   row = (y − H x)/√S

The readings are divided into `B` blocks of `K`, which avoids a sequence of N small steps:

1. **Covariances first**, without data. From a *known* state at its start every block, in parallel, computes its map of
   covariances `P → Ψ (P⁻¹ + TᵀT)⁻¹ Ψᵀ + P₀`. A short recursion over the blocks gives the covariance at every start, and
   a second pass through the blocks that at every reading: the exact one, not the steady state.
2. **Then the data**, for which the filter is a linear recurrence with known coefficients. The map of a block is one
   small product, `x → Ψx + E y`; a short recurrence over the blocks gives every start, and one pass the rows.

Nothing is approximated and any timing is allowed. Derivatives of `rowsᵀ rows` do not differentiate the filter: see
`information.adjoint`. Where machine code is available (`information.native`), it takes the readings one by one instead.
"""

from collections.abc import Iterable
from functools import partial, reduce
from operator import add
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gradcal_jax.arrays import AnyArray, namespace
from gradcal_jax.information.by_platform import by_platform, like
from gradcal_jax.information.by_reading import filter_readings
from gradcal_jax.information.native import native, plain
from gradcal_jax.information.noise_steps import NoiseSteps

SINGLE_PRECISION = (
    "a covariance would be wrong in single precision, so none is reported: call jax.config.update('jax_enable_x64', "
    "True) before the "
    "first JAX array is made"
)


class FilterState(NamedTuple):
    """The filter's state between stretches of readings: the state of every column, and their common covariance."""

    mean: Float[AnyArray, "n p"]
    covariance: Float[AnyArray, "n n"]


def whiten(steps: NoiseSteps, columns: Float[AnyArray, "N p"], *, block: int | None = None) -> Float[AnyArray, "N p"]:
    """Rows with `rowsᵀ rows = columnsᵀ V⁻¹ columns`, V the covariance of the used readings.

    The row of a reading that is not used is zero. `block`: K, by default about √N, or none in machine code. To
    differentiate functions of the rows' product, use `gram` or `whitened_factor`: several times faster, and exact for
    singular noise, too.
    """
    zeros = namespace(columns).zeros((steps.observation.shape[1], columns.shape[1]), columns.dtype)
    return whiten_from(FilterState(zeros, steps.initial), steps, columns, block=block)[0]


def whiten_from(
    state: FilterState, steps: NoiseSteps, columns: Float[AnyArray, "N p"], *, block: int | None = None
) -> tuple[Float[AnyArray, "N p"], FilterState]:
    """As `whiten`, from a state and with the next state as second result, for rows in parts."""
    if block is None and namespace(state, steps, columns) is np:
        return _by_value(state, steps, columns)
    if block is None and native(steps, columns, *state) is not None:
        return _quickly(state, steps, columns)
    return _in_blocks(state, steps, columns, block)


def _in_blocks(
    state: FilterState, steps: NoiseSteps, columns: Array, block: int | None = None
) -> tuple[Array, FilterState]:
    filtered = filter_columns(state, steps, columns, block)
    return jnp.reshape(filtered.rows, (-1, columns.shape[1]))[: columns.shape[0]], filtered.end


def _by_value(state: FilterState, steps: NoiseSteps, columns: np.ndarray) -> tuple[np.ndarray, FilterState]:
    """For NumPy's arrays: by machine code where it is available or pays."""
    code = plain(len(state.mean), len(columns))
    if code is not None:
        rows, *after = code(*state, steps, columns)
        return rows, FilterState(*after)
    readings = filter_readings(*state, steps, columns)
    return readings.rows, FilterState(readings.mean, readings.covariance)


def _natively(state: FilterState, steps: NoiseSteps, columns: Array) -> tuple[Array, FilterState]:
    code = native(steps, columns, *state)
    assert code is not None
    rows, *after = code.whiten(*state, steps, columns)
    return rows, FilterState(*after)


_filter_by_platform = by_platform("gradcal_filter", _natively, _in_blocks)


@jax.custom_jvp
def _quickly(state: FilterState, steps: NoiseSteps, columns: Array) -> tuple[Array, FilterState]:
    return _filter_by_platform(jax.tree.map(like, (columns, state)), state, steps, columns)


@_quickly.defjvp
def _quickly_jvp(primals, tangents):
    return jax.jvp(partial(whiten_from, block=block_length(len(primals[2]))), primals, tangents)


# --- small matrices with arrays as entries: `(i, j, …)` ------------------------------------------------------


def total(terms: Iterable[Array]) -> Array:
    """Sum of at least one term."""
    return reduce(add, terms)


def times(a: Float[Array, "i k *s"], b: Float[Array, "k j *s"]) -> Float[Array, "i j *s"]:
    """`A B`, entry by entry over the last axes: n terms, each one array operation."""
    return total(a[:, k, None] * b[None, k] for k in range(b.shape[0]))


def applied(a: Float[Array, "i k *s"], x: Float[Array, " k *s"]) -> Float[Array, " i *s"]:
    """`A x` for a vector whose entries are arrays like A's."""
    return total(a[:, k] * x[None, k] for k in range(x.shape[0]))


def transposed(a: Float[Array, "i j *s"]) -> Float[Array, "j i *s"]:
    return jnp.swapaxes(a, 0, 1)


def act(a: Float[Array, "i k *s"], x: Float[Array, "k *s p"]) -> Float[Array, "i *s p"]:
    """`A x` for columns that stand on a last axis of x's entries."""
    return total(a[:, k, ..., None] * x[None, k] for k in range(x.shape[0]))


def _congruence(a: Array, covariance: Array) -> Array:
    return times(times(a, covariance), transposed(a))


def _innovation(covariance: Array, h: Array, variance: Array | float, used: Array | bool = True):
    """`P Hᵀ` and `1/(H P Hᵀ + R)`; zero where there is no reading, or one without variance."""
    cross = applied(covariance, h)
    spread = jnp.sum(h * cross, axis=0) + variance
    useful = used & (spread > 0.0)
    return cross, jnp.where(useful, 1.0, 0.0) / jnp.where(useful, spread, 1.0)


def _updated(covariance: Array, cross: Array, reciprocal: Array) -> Array:
    """`P − P Hᵀ (H P Hᵀ + R)⁻¹ H P`."""
    return covariance - (cross * reciprocal[None])[:, None] * cross[None]


def _root(x: Array) -> Array:
    """Square root whose derivative at 0 is 0."""
    alive = x > 0.0
    return jnp.where(alive, jnp.sqrt(jnp.where(alive, x, 1.0)), 0.0)


# --- the filter, block by block ---------------------------------------------------------------------------------------


class Steps(NamedTuple):
    """Noise steps cut into blocks, time within a block first: `transition`, `noise` of the step after each reading."""

    observation: Float[Array, "K n B"]
    variance: Float[Array, "K B"]
    used: Array
    transition: Float[Array, "K n n B"]
    noise: Float[Array, "K n n B"]


class Filtered(NamedTuple):
    """The filter's pass over all columns. Arrays by reading, time within a block first except for the large ones:

    `states` x before each reading, of which `starts` are the blocks'; `covariance` P then, `cross` P Hᵀ; `closed` A,
    `gain` g, `per_std` 1/√S; `through` Ψ of each block; `end`: after the last reading.
    """

    steps: Steps
    rows: Float[Array, "B K p"]
    states: Float[Array, "n B K p"] | None
    covariance: Float[Array, "K n n B"]
    closed: Float[Array, "K n n B"]
    gain: Float[Array, "K n B"]
    per_std: Float[Array, "K B"]
    through: Float[Array, "n n B"]
    end: FilterState


def cut(x: Array, length: int, fill: float | bool | np.ndarray, *, later: bool = False) -> Array:
    """`(N, …)` to `(K, …, B)`, padded at the end; `later`: shifted by one step, for the step after a reading."""
    blocks = -(-x.shape[0] // length)
    x = x[1:] if later else x
    if missing := blocks * length - x.shape[0]:
        rest = jnp.broadcast_to(jnp.asarray(fill, x.dtype), (missing, *x.shape[1:]))
        x = jnp.concatenate([x, rest])
    return jnp.moveaxis(jnp.reshape(x, (blocks, length, *x.shape[1:])), (1, 0), (0, -1))


def block_length(count: int, asked: int | None = None) -> int:
    """The number near √N with the least padding."""
    if asked:
        return asked
    root = max(1.0, count**0.5)
    near = range(max(1, round(0.8 * root)), max(2, round(1.3 * root) + 1))
    return min(near, key=lambda k: (-count % k, abs(k - root)))


def filter_columns(
    state: FilterState, steps: NoiseSteps, columns: Float[Array, "N p"], block: int | None, *, keep: bool = False
) -> Filtered:
    """The whole filter; `keep`: with the states before the readings."""
    # Untraced arrays may be NumPy's.
    steps = jax.tree.map(jnp.asarray, steps)
    length = block_length(columns.shape[0], block)
    cut_steps = cut_up(steps, length)
    first = steps.transition[0]
    before, end = _covariances(cut_steps, first @ state.covariance @ first.T + steps.covariance[0])
    closed, gain, per_std = gains(cut_steps, before)
    through, effect = to_the_ends(closed, gain)
    data = cut_rows(columns, length)
    starts, mean = over_blocks(through, effect, data, first @ state.mean)
    rows, states = _rows(cut_steps, closed, gain, per_std, data, starts, keep)
    return Filtered(cut_steps, rows, states, before, closed, gain, per_std, through, FilterState(mean, end))


def cut_up(steps: NoiseSteps, length: int) -> Steps:
    """Steps in blocks of `length` readings."""
    return Steps(
        cut(steps.observation, length, 0.0),
        cut(steps.reading_variance, length, 1.0),
        cut(steps.used, length, False),
        cut(steps.transition, length, np.eye(steps.observation.shape[1]), later=True),
        cut(steps.covariance, length, 0.0, later=True),
    )


def cut_rows(x: Float[Array, " N *s"], length: int) -> Float[Array, "B K *s"]:
    """Rows in blocks, padded with zeros at the end."""
    if missing := -x.shape[0] % length:
        x = jnp.concatenate([x, jnp.zeros((missing, *x.shape[1:]), x.dtype)])
    return jnp.reshape(x, (-1, length, *x.shape[1:]))


def to_the_ends(closed: Float[Array, "K n n B"], gain: Float[Array, "K n B"]) -> tuple[Array, Array]:
    """Ψ of each block `(n, n, B)`, and E, the effect of each reading on the state at its block's end `(K, n, B)`."""

    def step(onward, now):
        a, g = now
        return times(onward, a), applied(onward, g)

    n, blocks = gain.shape[1:]
    none = jnp.broadcast_to(jnp.eye(n, dtype=gain.dtype)[:, :, None], (n, n, blocks))
    return jax.lax.scan(step, none, (closed, gain), reverse=True)


def _covariances(steps: Steps, start: Float[Array, "n n"]) -> tuple[Float[Array, "K n n B"], Float[Array, "n n"]]:
    """Covariance before every reading, and after the last step."""
    n = start.shape[0]

    def from_known(carry, now: Steps):
        covariance, response, noisy = carry
        cross, reciprocal = _innovation(covariance, now.observation, now.variance, now.used)
        seen = applied(transposed(response), now.observation)
        response = response - (cross * reciprocal[None])[:, None] * seen[None]
        after = _congruence(now.transition, _updated(covariance, cross, reciprocal)) + now.noise
        hit = jnp.any((now.observation != 0.0) & noisy, axis=0)
        exact = jnp.where(now.used & (now.variance == 0.0) & ~hit, 1.0, 0.0)
        noisy = _noisy(now, noisy)
        return (after, times(now.transition, response), noisy), (_root(reciprocal)[None] * seen, exact[None] * seen)

    # The state is known *after* the block's first reading: if it were known before, a reading without noise would have
    # no variance, and its information about the block's start would be lost. Readings without noise that follow at the
    # same instant (of other channels) are exact in the known state, too: these rows are kept as constraints.
    first, others = jax.tree.map(lambda x: x[0], steps), jax.tree.map(lambda x: x[1:], steps)
    begun = (first.noise, first.transition, _noisy(first, jnp.zeros(first.observation.shape, bool)))
    (own, response, _), (rows, exact) = jax.lax.scan(from_known, begun, others)

    def across(covariance, now):
        exact, triangle, response, own, h, variance, used = now
        after = _updated(covariance, *_innovation(covariance, h, variance, used))
        for of, noise in ((exact, 0.0), (triangle, 1.0)):
            for i in range(n):
                after = _updated(after, *_innovation(after, of[i], noise))
        return response @ after @ response.T + own, covariance

    triangles = (_triangle(exact), _triangle(rows))
    by_block = (*triangles, response, own, first.observation, first.variance, first.used)
    end, starts = jax.lax.scan(across, start, [jnp.moveaxis(x, -1, 0) for x in by_block])

    def step(covariance, now: Steps):
        updated = _updated(covariance, *_innovation(covariance, now.observation, now.variance, now.used))
        return _congruence(now.transition, updated) + now.noise, covariance

    _, before = jax.lax.scan(step, jnp.moveaxis(starts, 0, -1), steps)
    return before, end


def _noisy(now: Steps, noisy: Array) -> Array:
    """Which states noise has reached after a step `(n, B)`."""
    moved = jnp.any((now.transition != 0.0) & noisy[None], axis=1)
    return moved | (jnp.diagonal(now.noise, axis1=0, axis2=1).T > 0.0)


def _triangle(rows: Float[Array, "K n B"]) -> Float[Array, "n n B"]:
    """T with `TᵀT = AᵀA` for each block's `rows` A: Gram–Schmidt, twice.

    A column that depends on those before (a state that the block does not observe) has a zero on the diagonal.
    """
    count, n, blocks = rows.shape
    eps = jnp.finfo(rows.dtype).eps
    basis = jnp.zeros((count, 0, blocks), rows.dtype)
    triangle = []
    for j in range(n):
        column = rows[:, j]
        whole = jnp.sum(column * column, axis=0)
        above = jnp.zeros((j, blocks), rows.dtype)
        for _ in range(2 if j else 0):
            share = jnp.sum(basis * column[:, None], axis=0)
            above, column = above + share, column - jnp.sum(basis * share[None], axis=1)
        square = jnp.sum(column * column, axis=0)
        norm = _root(jnp.where(square > (1e3 * eps) ** 2 * whole, square, 0.0))
        unit = column * jnp.where(norm > 0.0, 1.0 / jnp.where(norm > 0.0, norm, 1.0), 0.0)[None]
        basis = jnp.concatenate([basis, unit[:, None]], axis=1)
        triangle.append(jnp.concatenate([above, norm[None], jnp.zeros((n - 1 - j, blocks), rows.dtype)]))
    return jnp.stack(triangle, axis=1)


def gains(steps: Steps, before: Array) -> tuple[Array, Array, Array]:
    """`A`, `g` and `1/√S` of every reading, from the covariance before it."""

    def of_readings(now: Steps, covariance):
        cross, reciprocal = _innovation(covariance, now.observation, now.variance, now.used)
        gain = applied(now.transition, cross) * reciprocal[None]
        return now.transition - gain[:, None] * now.observation[None], gain, _root(reciprocal)

    return jax.vmap(of_readings)(steps, before)


def over_blocks(
    through: Float[Array, "n n B"],
    effect: Float[Array, "K n B"],
    data: Float[Array, "B K p"],
    start: Float[Array, "n p"],
    *,
    reverse: bool = False,
) -> tuple[Float[Array, "n B p"], Float[Array, "n p"]]:
    """`x⁺ = Ψx + E y`, one step for each block: x at the start of every block, and after the last."""
    added = jnp.transpose(effect, (2, 1, 0)) @ data

    def step(x, now):
        through, added = now
        return times(through, x) + added, x

    end, starts = jax.lax.scan(step, start, (jnp.moveaxis(through, -1, 0), added), reverse=reverse)
    return jnp.moveaxis(starts, 0, 1), end


def _rows(steps: Steps, closed: Array, gain: Array, per_std: Array, data: Array, starts: Array, keep: bool):
    """The pass over the data: whitened rows, and the states before the readings if `keep`."""

    def step(carry, now):
        x, rows, states = carry
        k, a, g, h, w = now
        y = jax.lax.dynamic_index_in_dim(data, k, 1, keepdims=False)
        row = w[:, None] * (y - jnp.sum(h[..., None] * x, axis=0))
        if keep:
            states = jax.lax.dynamic_update_index_in_dim(states, x, k, 2)
        rows = jax.lax.dynamic_update_index_in_dim(rows, row, k, 1)
        return (act(a, x) + g[..., None] * y[None], rows, states), None

    kept = jnp.zeros((starts.shape[0], *data.shape), data.dtype) if keep else None
    now = (jnp.arange(data.shape[1]), closed, gain, steps.observation, per_std)
    (_, rows, states), _ = jax.lax.scan(step, (starts, jnp.zeros_like(data), kept), now)
    return rows, states
