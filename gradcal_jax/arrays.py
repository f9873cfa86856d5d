"""Functions of arrays for two libraries: NumPy computes single values, JAX differentiates, batches or compiles.

The core's formulas take the namespace of their arguments. A single result (a prediction, a sweep's point, an estimate)
uses NumPy, where nothing is compiled; a search traces the same lines with JAX. This module contains the operations that
differ between the two libraries.
"""

from collections.abc import Callable
from functools import wraps
from typing import TYPE_CHECKING, Any, TypeVar

import equinox as eqx
import jax
import jax.extend
import jax.numpy as jnp
import numpy as np
from jax.interpreters import ad, batching, mlir

from gradcal_jax.tables.display import summary

# An array of either library, for annotations: `Float[AnyArray, "n p"]`. A type checker cannot follow operations
# that are common to both; the tests check shapes and dtypes.
if TYPE_CHECKING:
    AnyArray = Any
else:
    AnyArray = jax.Array | np.ndarray

Carry = TypeVar("Carry")
# Sums of at most so many rows each are added row by row.
_FEW_ROWS = 16
# Rows of a padded table of sums at most, as a multiple of those that it has without.
_PADDED = 8


class PytreeModule(eqx.Module):
    """An Equinox module whose methods are Python's own.

    Equinox wraps a method, at each look-up, into a pytree with its module, so that it can be passed to a
    transformation. These methods never are, and the prediction of a whole unit looks up hundreds.
    """

    __getattribute__ = object.__getattribute__

    __repr__ = summary


def once(method: Callable[[Any], Carry]) -> Callable[[Any], Carry]:
    """A method without arguments whose result is kept with its object; a tracer's is not, which must not outlive its
    trace."""

    name = f"_{method.__name__}"

    @wraps(method)
    def kept(self):
        known = self.__dict__.get(name)
        if known is None:
            known = method(self)
            if namespace(known) is np:
                self.__dict__[name] = known
        return known

    return kept


def namespace(*trees: Any) -> Any:
    """`jax.numpy` where any array within the arguments (pytrees) is JAX's, else `numpy`."""
    if all(type(tree) is np.ndarray for tree in trees):
        return np  # without a walk through trees: hundreds of times for one unit
    return jnp if any(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(trees)) else np


def put(into: Any, where: Any, values: Any) -> Any:
    """`into` with `into[where] = values`.

    `where` indexes as in NumPy, without repetitions, so that JAX need not order the writes. The argument is not
    changed.
    """
    if namespace(into, values) is jnp:
        return placed(np.shape(into), (..., into), (where, values))
    result = np.array(into)
    result[where] = values
    return result


def placed(shape: tuple[int, ...], *parts: tuple[Any, Any]) -> Any:
    """Zeros with `[where] = values` for each part in order, without repetitions in one; NumPy writes in place."""
    if namespace(*(values for _, values in parts)) is jnp:
        source, flat, count = np.full(shape, -1), [jnp.zeros(0)], 0
        for where, values in parts:
            numbers = np.arange(source[where].size).reshape(source[where].shape)
            flat.append(jnp.ravel(jnp.broadcast_to(values, numbers.shape)))
            source[where] = count + numbers
            count += numbers.size
        filled = np.flatnonzero(source >= 0)
        of = source.ravel()[filled]
        return jnp.reshape(_selected(jnp.concatenate(flat), filled, of, source.size), shape)
    result = np.zeros(shape)
    for where, values in parts:
        result[where] = values
    return result


def summed(values: Any, first: np.ndarray) -> Any:
    """Sums of the rows from each index in `first` (the first is 0) to the next one."""
    if len(first) == values.shape[0]:
        return values
    counts = np.diff(first, append=values.shape[0])
    if namespace(values) is np:
        if np.max(counts) > _FEW_ROWS:
            return np.add.reduceat(values, first, axis=0)
        # A tenth of the time where most sums are of one row.
        result = values[first]
        for k in range(1, int(np.max(counts))):
            longer = np.flatnonzero(counts > k)
            result[longer] += values[first[longer] + k]
        return result
    number = np.repeat(np.arange(len(first)), counts)
    return _selected(values, number, np.arange(len(number)), len(first))


def taken(values: Any, rows: Any) -> Any:
    """`values[rows]`, of rows in any order, and as often as it may be."""
    if namespace(values) is np or isinstance(rows, slice | jax.Array):
        return values[rows]
    rows = np.arange(values.shape[0])[rows]
    flat = _selected(values, np.arange(rows.size), rows.ravel(), rows.size)
    return jnp.reshape(flat, (*rows.shape, *values.shape[1:]))


def _selected(values: Any, to: np.ndarray, of: np.ndarray, size: int) -> Any:
    """`size` rows, each the sum of those of `values` numbered `of` that go `to` it."""
    return _selection.bind(values, selection=_Selection(to, of, size, values.shape[0]))


class _Selection:
    """A matrix of zeros and ones, by the rows and columns of its ones."""

    def __init__(self, to: np.ndarray, of: np.ndarray, size: int, count: int) -> None:
        self.to, self.of, self.size, self.count = to, of, size, count

    def transposed(self) -> "_Selection":
        return _Selection(self.of, self.to, self.count, self.size)

    def times(self, values: Any) -> Any:
        """The product with `(count, …)`. XLA compiles a scatter, of which JAX's own rules make many, into a loop on a
        CPU, a dozen times as long as a gather."""
        order = np.argsort(self.to, kind="stable")
        to, of, counts = self.to[order], self.of[order], np.bincount(self.to, minlength=self.size)
        most = int(np.max(counts, initial=1))
        if most * self.size > _PADDED * (self.size + self.count):
            return jax.ops.segment_sum(_rows(values, of), to, self.size, indices_are_sorted=True)
        table = np.full((self.size, most), self.count, np.int32)
        table[to, np.arange(len(to)) - (np.cumsum(counts) - counts)[to]] = of
        if np.min(counts, initial=most) < most:
            values = jnp.concatenate([values, jnp.zeros((1, *values.shape[1:]), values.dtype)])
        return _rows(values, table[:, 0]) if most == 1 else jnp.sum(_rows(values, table), axis=1)


def _rows(values: Any, numbers: np.ndarray) -> Any:
    return jnp.asarray(values).at[numbers].get(mode="promise_in_bounds", wrap_negative_indices=False)


_selection = jax.extend.core.Primitive("selection")
_selection.def_impl(lambda values, selection: selection.times(values))
_selection.def_abstract_eval(lambda values, selection: values.update(shape=(selection.size, *values.shape[1:])))
mlir.register_lowering(_selection, mlir.lower_fun(lambda x, selection: selection.times(x), multiple_results=False))
ad.deflinear2(_selection, lambda ct, _, selection: [_selection.bind(ct, selection=selection.transposed())])
batching.primitive_batchers[_selection] = lambda of, at, selection: (
    _selection.bind(jnp.moveaxis(of[0], at[0], -1), selection=selection),
    of[0].ndim - 1,
)


def cross(a: Any, b: Any) -> Any:
    """`a × b` over the last axis; NumPy's own moves axes, which takes longer than the products."""
    (ax, ay, az), (bx, by, bz) = ([v[..., k] for k in range(3)] for v in (a, b))
    return namespace(a, b).stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)


def fixed(x: Any) -> Any:
    """The value without its derivative."""
    return jax.lax.stop_gradient(x) if isinstance(x, jax.Array) else x


def running_sum(values: Any) -> Any:
    """Sums of all rows up to and including each one; NumPy's with the rounding of every addition made good (Knuth's
    two-sum), which in thousands of additions would grow to a hundred times that of the sums themselves.
    """
    if namespace(values) is jnp:
        return _running_by_blocks(values)
    sums = np.cumsum(values, axis=0)
    before, after = sums[:-1], sums[1:]
    rounded = after - before
    lost = (before - (after - rounded)) + (values[1:] - rounded)
    sums[1:] += np.cumsum(lost, axis=0)
    return sums


def _running_by_blocks(values: Any) -> Any:
    """Two products with triangles of about √N rows: JAX's own sum costs a CPU a window of 128 rows for each row."""
    count = values.shape[0]
    if not values.size:
        return values
    length = max(1, round(count**0.5))
    blocks = -(-count // length)
    rest = [(0, 0)] * (values.ndim - 1)
    cut = jnp.reshape(jnp.pad(values, [(0, blocks * length - count), *rest]), (blocks, length, -1))
    within = np.tri(length) @ cut
    before = np.tri(blocks, k=-1) @ within[:, -1]
    return jnp.reshape(within + before[:, None], (blocks * length, *values.shape[1:]))[:count]


def size_class(count: int) -> int:
    """The next of 0, 1, 2, 3, 4, 6, 8, 12, 16, 24, …: few sizes, at most 1.5 times the count."""
    if count <= 2:
        return count
    power = 1 << (count - 1).bit_length()
    return power * 3 // 4 if count <= power * 3 // 4 else power
