"""Whitening: a Kalman filter of the noise alone, run over every column of the regressors as if it were data.

With the parameters kept out of the state, `L⁻¹Φ` (`LLᵀ` the covariance of all readings) costs O(N·n²·p) with a handful
of noise states `n`. The readings are cut into `B` blocks of `K`, so that nothing walks through N small steps:

1. **Covariances first**, without data. From a *known* state at its start every block finds, all blocks side by side,
   what it does to a covariance: `P → Ψ (P⁻¹ + TᵀT)⁻¹ Ψᵀ + P₀`. A short recursion over the blocks gives that at
   every start, and a second pass through the blocks the gains at every reading: the exact ones, not the steady ones.
2. **Then the data**, for which the filter is a linear recurrence `x⁺ = A x + g y` with known coefficients: every block
   from zero, a short recurrence over the blocks, and the response to the starts added. The rows are `w (y − c x)`.

Nothing is approximated and any timing is allowed. Both recursions carry their own derivative. That of the covariances
is `dP⁺ = A dP Aᵀ + …`, that of the data `dx⁺ = A dx + …`: linear recurrences with the same A, solved in the same
blocks, so neither the blocks nor step 1's factors are ever differentiated.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from gradcal_jax.information.noise_steps import NoiseSteps

Grid = list[list[Array]]


class FilterState(NamedTuple):
    """What goes from one stretch of readings to the next: every column's state, and the covariance of all."""

    mean: Float[Array, "n p"]
    covariance: Float[Array, "n n"]


def whiten(steps: NoiseSteps, columns: Float[Array, "N p"], *, block: int | None = None) -> Float[Array, "N p"]:
    """Rows with `rowsᵀ rows = columnsᵀ V⁻¹ columns`, V the covariance of the used readings.

    The row of a reading that is not used is zero. `block`: K, by default about √N.
    """
    start = FilterState(jnp.zeros((steps.observation.shape[1], columns.shape[1]), columns.dtype), steps.initial)
    rows, _ = whiten_from(start, steps, columns, block=block)
    return rows


def whiten_from(
    state: FilterState, steps: NoiseSteps, columns: Float[Array, "N p"], *, block: int | None = None
) -> tuple[Float[Array, "N p"], FilterState]:
    """As `whiten`, from a given state and returning the next: long logs go through in tiles."""
    count, p = columns.shape
    n = steps.observation.shape[1]
    length = block or max(1, round(count**0.5))
    blocks = -(-count // length)

    def side_by_side(x: Array, fill: float | bool) -> Array:
        """`(N, …)` to `(K, B, …)`: time first for the recursions."""
        if padding := blocks * length - count:
            x = jnp.concatenate([x, jnp.full((padding, *x.shape[1:]), fill, x.dtype)])
        return jnp.swapaxes(jnp.reshape(x, (blocks, length, *x.shape[1:])), 0, 1)

    transition, covariance, observation = steps.transition, steps.covariance, steps.observation
    system = _System(
        [[side_by_side(transition[:, i, j], float(i == j)) for j in range(n)] for i in range(n)],
        [side_by_side(covariance[:, i, j], 0.0) for i, j in _upper(n)],
        [side_by_side(observation[:, i], 0.0) for i in range(n)],
        side_by_side(steps.reading_variance, 1.0),
        side_by_side(steps.used, False),
    )
    data = side_by_side(columns, 0.0)
    before, end = _covariances(system, [state.covariance[i, j] for i, j in _upper(n)])
    closed, gain, seen, per_std = _gains(system, before)
    drive = [g[..., None] * data for g in gain]
    states, mean = _recurrence(closed, drive, [state.mean[i] for i in range(n)])
    rows = per_std[..., None] * (data - _total(c[..., None] * x for c, x in zip(seen, states, strict=True)))
    rows = jnp.reshape(jnp.swapaxes(rows, 0, 1), (-1, p))[:count]
    return rows, FilterState(jnp.stack(mean), jnp.stack([jnp.stack(line) for line in _full(end, n)]))


class _System(NamedTuple):
    """The steps, entry by entry, each `(K, B)`; of the symmetric covariance the upper triangle, line by line."""

    transition: Grid
    noise: list[Array]
    observation: list[Array]
    variance: Array
    used: Array


# --- small matrices, written out: their entries are whole arrays ------------------------------------------------------


def _upper(n: int) -> list[tuple[int, int]]:
    return [(i, j) for i in range(n) for j in range(i, n)]


def _full(packed: list[Array], n: int) -> Grid:
    at = {pair: k for k, pair in enumerate(_upper(n))}
    return [[packed[at[min(i, j), max(i, j)]] for j in range(n)] for i in range(n)]


def _total(terms) -> Array:
    first, *others = terms
    return sum(others, start=first)


def _times(a: Grid, b: Grid) -> Grid:
    inner = range(len(b))
    return [[_total(a[i][k] * b[k][j] for k in inner) for j in range(len(b[0]))] for i in range(len(a))]


def _congruence(a: Grid, packed: list[Array]) -> list[Array]:
    """Upper triangle of `A S Aᵀ`."""
    n = len(a)
    half = _times(a, _full(packed, n))
    return [_total(half[i][k] * a[j][k] for k in range(n)) for i, j in _upper(n)]


def _seen(h: list[Array], a: Grid) -> list[Array]:
    """`H A`."""
    return [_total(h[i] * a[i][j] for i in range(len(h))) for j in range(len(a[0]))]


def _innovation(packed: list[Array], h: list[Array], variance: Array | float, used: Array | bool = True):
    """`P Hᵀ` and the reciprocal of `H P Hᵀ + R`; zero where there is no reading, or one that is known beforehand."""
    n = len(h)
    cross = _seen(h, _full(packed, n))
    spread = _total(h[i] * cross[i] for i in range(n)) + variance
    useful = used & (spread > 0.0)
    return cross, jnp.where(useful, 1.0, 0.0) / jnp.where(useful, spread, 1.0)


def _updated(packed: list[Array], cross: list[Array], reciprocal: Array) -> list[Array]:
    """`P − P Hᵀ (H P Hᵀ + R)⁻¹ H P`."""
    scaled = [c * reciprocal for c in cross]
    return [value - scaled[i] * cross[j] for value, (i, j) in zip(packed, _upper(len(cross)), strict=True)]


def _identity(like: Array, n: int) -> Grid:
    return [[jnp.full_like(like, float(i == j)) for j in range(n)] for i in range(n)]


# --- covariances ------------------------------------------------------------------------------------------------------


def _step(system: _System, packed: list[Array]) -> list[Array]:
    """Covariance after a step, from the one before: on single steps and on whole arrays of them."""
    predicted = [a + b for a, b in zip(_congruence(system.transition, packed), system.noise, strict=True)]
    cross, reciprocal = _innovation(predicted, system.observation, system.variance, system.used)
    return _updated(predicted, cross, reciprocal)


@jax.custom_jvp
def _covariances(system: _System, start: list[Array]) -> tuple[list[Array], list[Array]]:
    """Upper triangles of the covariance before every step, each `(K, B)`, and after the last."""
    n = len(system.observation)
    zero = jnp.zeros_like(system.variance[0])

    def from_known(carry, now: _System):
        packed, response = carry
        predicted = [a + b for a, b in zip(_congruence(now.transition, packed), now.noise, strict=True)]
        response = _times(now.transition, response)
        cross, reciprocal = _innovation(predicted, now.observation, now.variance, now.used)
        seen = _seen(now.observation, response)
        response = [[response[i][j] - cross[i] * reciprocal * seen[j] for j in range(n)] for i in range(n)]
        root = jnp.sqrt(reciprocal)
        return (_updated(predicted, cross, reciprocal), response), [root * s for s in seen]

    known = ([zero for _ in _upper(n)], _identity(zero, n))
    (own, response), rows = jax.lax.scan(from_known, known, system)

    def across(packed, now):
        triangle, response, own = now
        after = packed
        for i in range(n):
            after = _updated(after, *_innovation(after, triangle[i], 1.0))
        return [a + b for a, b in zip(_congruence(response, after), own, strict=True)], packed

    end, starts = jax.lax.scan(across, start, (_triangle(rows), response, own))
    _, before = jax.lax.scan(lambda packed, now: (_step(now, packed), packed), starts, system)
    return before, end


@_covariances.defjvp
def _covariances_jvp(primals, tangents):
    (system, start), (d_system, d_start) = primals, tangents
    before, end = _covariances(system, start)
    closed, *_ = _gains(system, before)

    def step(transition, noise, observation, variance):
        return _step(_System(transition, noise, observation, variance, system.used), before)

    _, drive = jax.jvp(step, tuple(system[:4]), tuple(d_system[:4]))
    return (before, end), _in_blocks(_congruence, closed, drive, d_start)


def _triangle(rows: list[Array]) -> Grid:
    """T with `TᵀT = AᵀA` for each block's few columns `rows`, n of `(K, B)`: Gram–Schmidt, twice.

    A column that depends on the ones before (a state that the block does not see) gets a zero on the diagonal.
    """
    n = len(rows)
    eps = jnp.finfo(rows[0].dtype).eps
    basis: list[Array] = []
    zero = jnp.zeros_like(rows[0][0])
    triangle: Grid = [[zero] * n for _ in range(n)]
    for j, column in enumerate(rows):
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
    return triangle


def _gains(system: _System, before: list[Array]) -> tuple[Grid, list[Array], list[Array], Array]:
    """`A = (1 − K H) F`, `K`, `H F` and `1/√(H P Hᵀ + R)` of every step: `x⁺ = A x + K y`, `row = (y − H F x)/√…`."""
    f, n = system.transition, len(system.observation)
    predicted = [a + b for a, b in zip(_congruence(f, before), system.noise, strict=True)]
    cross, reciprocal = _innovation(predicted, system.observation, system.variance, system.used)
    gain = [c * reciprocal for c in cross]
    seen = _seen(system.observation, f)
    closed = [[f[i][j] - gain[i] * seen[j] for j in range(n)] for i in range(n)]
    alive = reciprocal > 0.0
    per_std = jnp.where(alive, jnp.sqrt(jnp.where(alive, reciprocal, 1.0)), 0.0)
    return closed, gain, seen, per_std


# --- linear recurrences -----------------------------------------------------------------------------------------------


def _apply(a: Grid, x: list[Array]) -> list[Array]:
    """`A x` for columns that stand on a last axis of x's entries."""
    return [_total(a[i][j][..., None] * x[j] for j in range(len(x))) for i in range(len(a))]


@jax.custom_jvp
def _recurrence(closed: Grid, drive: list[Array], start: list[Array]) -> tuple[list[Array], list[Array]]:
    """`x⁺ = A x + drive`: x before every step, n of `(K, B, p)`, and after the last, n of `(p,)`."""
    return _in_blocks(_apply, closed, drive, start)


@_recurrence.defjvp
def _recurrence_jvp(primals, tangents):
    (closed, drive, start), (d_closed, d_drive, d_start) = primals, tangents
    states, end = _recurrence(closed, drive, start)
    d_drive = [a + b for a, b in zip(_apply(d_closed, states), d_drive, strict=True)]
    return (states, end), _in_blocks(_apply, closed, d_drive, d_start)


def _in_blocks(
    act: Callable[[Grid, list[Array]], list[Array]], closed: Grid, drive: list[Array], start: list[Array]
) -> tuple[list[Array], list[Array]]:
    """`x⁺ = act(A, x) + drive`, `act` linear in x and multiplicative in A, by blocks side by side."""
    n = len(closed)
    add = lambda x, y: [a + b for a, b in zip(x, y, strict=True)]  # noqa: E731
    response, from_start = jax.lax.scan(lambda r, a: (_times(a, r), r), _identity(closed[0][0][0], n), closed)

    def step(x, now):
        a, extra = now
        return add(act(a, x), extra), x

    ends, states = jax.lax.scan(step, [jnp.zeros_like(d[0]) for d in drive], (closed, drive))
    end, starts = jax.lax.scan(step, start, (response, ends))
    return add(states, act(from_start, [s[None] for s in starts])), end
