"""Generalised least squares under state-space noise: whitened rows of regressors, their Gram matrix, its derivative.

With `V = L Lᵀ` the covariance of all readings and `Φ` the regressors, `whiten` returns the rows `L⁻¹Φ`. A Kalman filter
takes every column of Φ for data: a row is its innovation over the innovation's standard deviation. The parameters stay
out of the state, so the cost is O(N n² p) with a handful of noise states n.

**Blocks.** One step of the filter is a few operations on tiny matrices, and most of its time is their overhead. `_lift`
therefore joins several steps into one, exactly. For a block of r readings and the state x at its begin,

    y = H x + e,    x⁺ = F x + w,    Cov e = R,    Cov w = Q,    Cov(w, e) = C

**Derivative.** With `U = V⁻¹Φ`, `dG = dΦᵀU + UᵀdΦ − UᵀdV U`, and `UᵀdV U` is a sum over blocks that is linear in their
matrices (de Jong's smoother; Durbin and Koopman, Time Series Analysis by State Space Methods, 4.4–4.5). One scan
backwards gives, for every block, u (its rows of U), ρ (the adjoint of the state after it) and z (its smoothed state):

    UᵀdV U = h + hᵀ,   h = Σ uᵀ(dH z + ½dR u) + ρᵀ(dF z + ½dQ ρ + dC u) + ½ρ₀ᵀ dP₀ ρ₀

This is linear in the tangents, so it serves forward and reverse mode, and it can be differentiated again.

The same lines run in NumPy, where nothing is compiled, and in JAX.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.linalg import get_lapack_funcs

from gradcal_jax.arrays import AnyArray, namespace, placed, taken
from gradcal_jax.information.noise_steps import NoiseSteps
from gradcal_jax.linalg import dead_of, factor_tangent, scaled_factor, solve_transposed

SINGLE_PRECISION = (
    "a covariance would be wrong in single precision, so none is reported: call jax.config.update('jax_enable_x64', "
    "True) before the first JAX array is made"
)
# Readings of a block in NumPy, whose calls are dear; JAX joins only readings between which no step lies.
_READINGS = 24
# LAPACK in double precision: NumPy's and SciPy's own calls take three times as long for small matrices.
_LAPACK: Any = get_lapack_funcs(("potrf", "trtri"), dtype=np.float64)


class Blocks(NamedTuple):
    """The noise in `B` blocks of `r` readings; see the head of the module. `initial`: covariance of the first state."""

    transition: Float[AnyArray, "B n n"]
    process_noise: Float[AnyArray, "B n n"]
    observation: Float[AnyArray, "B r n"]
    reading_noise: Float[AnyArray, "B r r"]
    cross_noise: Float[AnyArray, "B n r"]
    initial: Float[AnyArray, "n n"]


class Passage(NamedTuple):
    """Readings of `p` regressors as they change what is known of the `n` noise states. `product`: the Gram matrix of
    the regressors and, if it is not known, of the state before, which counts as further ones; `after`: the state after
    them by a unit of each; `left`: its covariance with the state before known."""

    product: Float[AnyArray, "k k"]
    after: Float[AnyArray, "n k"]
    left: Float[AnyArray, "n n"]


class Filtered(NamedTuple):
    """State and covariance at the begin of every block, its gain, and W with `WᵀW = S⁻¹`, S of its innovations."""

    state: Float[AnyArray, "B n p"]
    covariance: Float[AnyArray, "B n n"]
    gain: Float[AnyArray, "B n r"]
    whitener: Float[AnyArray, "B r r"]


def whiten(steps: NoiseSteps, columns: Float[AnyArray, "N p"]) -> Float[AnyArray, "N p"]:
    """Rows with `rowsᵀ rows = columnsᵀ V⁻¹ columns`; the row of a reading that is not used is zero."""
    blocks, data, place = _in_blocks(steps, columns)
    return _filter(blocks, data)[0][place]


def whitener(steps: NoiseSteps) -> Callable[[Float[np.ndarray, "N p"]], Float[np.ndarray, "N p"]]:
    """`whiten` of these steps, for several sets of columns. NumPy."""
    blocks, number = _lift(steps, _READINGS), np.arange(len(steps.used))
    place = number // _READINGS, number % _READINGS
    return lambda columns: _filter(blocks, _cut(columns, _READINGS, steps.used))[0][place]


def weights(steps: NoiseSteps, columns: Float[np.ndarray, "N p"]) -> Float[np.ndarray, "N p"]:
    """`V⁻¹ columns`."""
    blocks, data, place = _in_blocks(steps, columns)
    rows, filtered, _ = _filter(blocks, data)
    return _smooth(blocks, rows, filtered)[0][place]


def by_reading(
    steps: NoiseSteps, columns: Float[np.ndarray, "N p"]
) -> tuple[Float[np.ndarray, "N n p"], Float[np.ndarray, " N"]]:
    """The state after each reading by all readings up to it, if each column is what was read, and the inverse of the
    standard deviation of each innovation (0: the reading says nothing). NumPy."""
    blocks, data = _lift(steps, 1), _cut(columns, 1, steps.used)
    _, filtered, (last, _) = _filter(blocks, data)
    return np.concatenate([filtered.state[1:], last[None]]), filtered.whitener[:, 0, 0]


def passage(steps: NoiseSteps, columns: Float[AnyArray, "N p"]) -> Passage:
    """The passage of readings from any state."""
    blocks, data, _ = _in_blocks(steps, jnp.asarray(columns))
    every = jnp.eye(len(blocks.initial), dtype=data.dtype)
    begin = jnp.concatenate([jnp.zeros((len(every), data.shape[-1]), data.dtype), -every], axis=1)
    data = jnp.concatenate([data, jnp.zeros((*data.shape[:2], len(every)), data.dtype)], axis=2)
    blocks = blocks._replace(initial=jnp.zeros_like(blocks.initial))
    rows, _, (after, left) = _filter(blocks, data, begin)
    return Passage(_product(rows)[0], after, left)


def gram(steps: NoiseSteps, columns: Float[AnyArray, "N p"]) -> Float[AnyArray, "p p"]:
    """`columnsᵀ V⁻¹ columns`. This squares the rows' condition number."""
    blocks, data, _ = _in_blocks(steps, jnp.asarray(columns))
    return _gram_and_rows(blocks, data)[0]


def whitened_factor(
    steps: NoiseSteps, columns: Float[AnyArray, "N m"], below: Float[AnyArray, "q p"]
) -> tuple[Float[AnyArray, "p p"], Float[AnyArray, " p"], Float[AnyArray, "p p"], Float[AnyArray, "p k"]]:
    """R, upper triangular, and columns' lengths: `diag(scale) RᵀR diag(scale) = columnsᵀ V⁻¹ columns + belowᵀ below`
    of the first p columns; `(RᵀR)⁻¹`, not finite for singular R; and their product `columnsᵀ V⁻¹ others` with the other
    columns. Computed from the rows themselves, which keeps their condition number; `scale` counts as a constant."""
    blocks, data, _ = _in_blocks(steps, jnp.asarray(columns))
    product, rows = _gram_and_rows(blocks, data)
    p = below.shape[1]
    of = _factor(product[:p, :p] + below.T @ below, rows[:, :p], jax.lax.stop_gradient(below))
    return (*of, product[:p, p:])


def _in_blocks(steps: NoiseSteps, columns: AnyArray) -> tuple[Blocks, AnyArray, tuple[np.ndarray, np.ndarray]]:
    """The noise and the columns in blocks, and the block and the place in it of every reading."""
    if namespace(steps, columns) is np:
        number = np.arange(len(columns))
        blocks, data = _lift(steps, _READINGS), _cut(columns, _READINGS, steps.used)
        return blocks, data, (number // _READINGS, number % _READINGS)
    # Readings of one instant (of several channels) are one reading of a vector.
    fresh = np.ones(len(columns), bool) if steps.stays is None else ~np.asarray(steps.stays)
    fresh[:1] = True
    instant = np.cumsum(fresh) - 1
    first = np.flatnonzero(fresh)
    place = instant, np.arange(len(columns)) - first[instant]
    sizes = len(first), int(np.max(place[1], initial=0)) + 1

    def at_instants(x: AnyArray) -> AnyArray:
        kept = jnp.where(jnp.reshape(steps.used, (-1,) + (1,) * (x.ndim - 1)), x, 0.0)
        return placed((*sizes, *x.shape[1:]), (place, kept))

    observation, variance, data = map(at_instants, (steps.observation, steps.reading_variance, columns))
    f, q = (taken(jnp.asarray(x), first) for x in (steps.transition, steps.covariance))
    own = q @ _t(observation)
    noise = observation @ own + variance[:, :, None] * jnp.eye(sizes[1], dtype=own.dtype)[None]
    return Blocks(f, q, observation @ f, noise, own, jnp.asarray(steps.initial)), data, place


def _cut(x: np.ndarray, size: int, used: np.ndarray | None = None, fill: Any = 0.0) -> np.ndarray:
    """Values of the steps in blocks of `size`, with `fill` after the last; zero where readings are not `used`."""
    if used is not None:
        x = x * np.reshape(used, (-1,) + (1,) * (x.ndim - 1))
    rest = np.broadcast_to(fill, (-len(x) % size, *x.shape[1:]))
    return np.concatenate([x, rest]).reshape(-(-len(x) // size), size, *x.shape[1:])


def _lift(steps: NoiseSteps, size: int) -> Blocks:
    """Blocks of `size` steps. Readings that are not used, and those of padding, see nothing and have no noise."""
    n = steps.observation.shape[1]
    observation, variance = (_cut(x, size, steps.used) for x in (steps.observation, steps.reading_variance))
    transition, noise = _cut(steps.transition, size, fill=np.eye(n)), _cut(steps.covariance, size)
    goes_on = _cut(np.ones(len(steps.used), bool) if steps.stays is None else ~steps.stays, size, fill=False)
    blocks = len(observation)
    # Of the state at the present step: its response to that at the block's begin, and its covariance with all readings.
    response, covariance = np.tile(np.eye(n), (blocks, 1, 1)), np.zeros((blocks, n, n))
    seen, within, cross = np.zeros((blocks, size, n)), np.zeros((blocks, size, size)), np.zeros((blocks, n, size))
    for k in range(size):
        on, h = goes_on[:, k], observation[:, k, None]
        f = transition[on, k]
        response[on], cross[on] = f @ response[on], f @ cross[on]
        covariance[on] = f @ covariance[on] @ _t(f) + noise[on, k]
        own = covariance @ _t(h)
        seen[:, k] = (h @ response)[:, 0]
        within[:, k] = within[:, :, k] = (h @ cross)[:, 0]
        within[:, k, k] = (h @ own)[:, 0, 0] + variance[:, k]
        cross[:, :, k] = own[..., 0]
    return Blocks(response, covariance, seen, within, cross, np.asarray(steps.initial))


def _filter(
    blocks: Blocks, data: Float[AnyArray, "B r p"], begin: Float[AnyArray, "n p"] | None = None
) -> tuple[Float[AnyArray, "B r p"], Filtered, tuple[AnyArray, AnyArray]]:
    """Whitened rows of every block, the values that a smoother needs, and the last state and its covariance. `begin`:
    the first state; None: zero. The gains do not depend on the data, of which one recursion of small matrices is left.
    """

    def gains(covariance, now):
        f, q, h, r, c = now
        cross = covariance @ h.T
        whitener = _whitener(h @ cross + r)
        gain = (f @ cross + c) @ whitener.T
        return f @ covariance @ f.T + q - gain @ gain.T, (covariance, gain, whitener)

    def states(state, now):
        onward, driven = now
        return onward @ state + driven, (state,)

    left, (covariance, gain, whitener) = _scan(gains, blocks.initial, blocks[:5])
    own, seen = whitener @ data, whitener @ blocks.observation
    if begin is None:
        begin = namespace(data).zeros((len(blocks.initial), data.shape[-1]), data.dtype)
    after, (state,) = _scan(states, begin, (blocks.transition - gain @ seen, gain @ own))
    return own - seen @ state, Filtered(state, covariance, gain, whitener), (after, left)


def _whitener(covariance: Float[AnyArray, "r r"]) -> Float[AnyArray, "r r"]:
    """W with `WᵀW` the inverse of a covariance, apart from readings without variance, which tell nothing."""
    xp, variance = namespace(covariance), covariance.diagonal()
    if xp is np and variance.min() > 0.0:
        factor, failed = _LAPACK[0](covariance, lower=1, clean=1)
        if failed:
            raise np.linalg.LinAlgError("a covariance of readings is not positive definite")
        return _LAPACK[1](factor, lower=1)[0]
    none = xp.where(variance > 0.0, 0.0, 1.0).astype(covariance.dtype)
    factor = xp.linalg.cholesky(covariance + xp.diag(none))
    return solve_transposed(factor.T, xp.diag(1.0 - none))


@jax.custom_jvp
def _gram_and_rows(blocks: Blocks, data: AnyArray) -> tuple[Float[AnyArray, "p p"], Float[AnyArray, "rows p"]]:
    """The rows count as constant."""
    return _product(_filter(blocks, data)[0])


def _product(rows: Float[AnyArray, "B r p"]) -> tuple[Float[AnyArray, "p p"], Float[AnyArray, "rows p"]]:
    flat = _flat(rows)
    return flat.T @ flat, flat


@_gram_and_rows.defjvp
def _gram_and_rows_jvp(primals, tangents):
    (blocks, data), (changes, d_data) = primals, tangents
    rows, filtered, _ = _filter(blocks, data)
    u, rho, z, first = _smooth(blocks, rows, filtered)
    product, flat = _product(rows)
    # Half of the derivative: the other half is its transpose.
    of_readings = d_data - changes.observation @ z - 0.5 * changes.reading_noise @ u
    of_states = changes.transition @ z + 0.5 * changes.process_noise @ rho + changes.cross_noise @ u
    half = _flat(u).T @ _flat(of_readings) - _flat(rho).T @ _flat(of_states)
    half = half - 0.5 * first.T @ changes.initial @ first
    return (product, flat), (half + half.T, jnp.zeros_like(flat))


def _smooth(blocks: Blocks, rows: Float[AnyArray, "B r p"], filtered: Filtered):
    """u `(B, r, p)`, ρ after and z at the begin of every block `(B, n, p)`, and ρ of the first state `(n, p)`."""

    def step(rho, now):
        f, h, row, state, covariance, gain, whitener = now
        u = whitener.T @ (row - gain.T @ rho)
        before = f.T @ rho + h.T @ u
        return before, (u, rho, state + covariance @ before)

    nothing = namespace(rows).zeros((len(blocks.initial), rows.shape[-1]), rows.dtype)
    over = (blocks.transition, blocks.observation, rows, *filtered)
    first, (u, rho, z) = _scan(step, nothing, over, reverse=True)
    return u, rho, z, first


def _flat(x: Float[AnyArray, "B k p"]) -> Float[AnyArray, "rows p"]:
    return jnp.reshape(x, (-1, x.shape[-1]))


@jax.custom_jvp
def _factor(product: AnyArray, rows: AnyArray, below: AnyArray) -> tuple[AnyArray, AnyArray, AnyArray]:
    """`whitened_factor` of `product = rowsᵀ rows + belowᵀ below`, whose derivative counts alone."""
    return _with_inverse(*scaled_factor(rows, below))[:3]


@_factor.defjvp
def _factor_jvp(primals, tangents):
    factor, scale, inverse, safe = _with_inverse(*scaled_factor(*primals[1:]))
    change = tangents[0] / (scale[:, None] * scale[None, :])
    return (factor, scale, inverse), (factor_tangent(factor, change), jnp.zeros_like(scale), -safe @ change @ safe)


def _with_inverse(factor: AnyArray, scale: AnyArray) -> tuple[AnyArray, AnyArray, AnyArray, AnyArray]:
    """The arguments, `(RᵀR)⁻¹`, and the same with ones for zeros on the diagonal, so that no derivative is NaN."""
    dead = dead_of(factor)
    half = solve_transposed(factor + jnp.diag(jnp.where(dead, 1.0, 0.0)), jnp.eye(len(factor), dtype=factor.dtype))
    safe = half.T @ half
    return factor, scale, safe + jnp.diag(jnp.where(dead, jnp.inf, 0.0)), safe


def _scan(step, begin: Any, over: Any, *, reverse: bool = False) -> Any:
    """The last carry and the stacked results of `step(carry, row) -> (carry, result)`: `jax.lax.scan`, or a loop of
    NumPy."""
    if namespace(begin, over) is jnp:
        return jax.lax.scan(step, begin, over, reverse=reverse)
    rows, results = list(zip(*over, strict=True)), []
    for row in reversed(rows) if reverse else rows:
        begin, result = step(begin, row)
        results.append(result)
    stacked = (np.array(of[::-1] if reverse else of) for of in zip(*results, strict=True))
    return begin, tuple(stacked)


def _t(matrices: AnyArray) -> AnyArray:
    return namespace(matrices).swapaxes(matrices, -1, -2)
