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
import jax.numpy as jnp
import numpy as np

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
    """`into` with `into[where] = values`; JAX drops indices beyond the end, which padding uses.

    `where` indexes as in NumPy, without repetitions, so that JAX need not order the writes. The argument is not
    changed.
    """
    if namespace(into, values) is jnp:
        return jnp.asarray(into).at[where].set(values, mode="drop", unique_indices=True)
    result = np.array(into)
    result[where] = values
    return result


def placed(shape: tuple[int, ...], *parts: tuple[Any, Any]) -> Any:
    """Zeros with `[where] = values` for each part in order, without repetitions in one; NumPy writes in place."""
    if namespace(*(values for _, values in parts)) is jnp:
        result = jnp.zeros(shape)
        for where, values in parts:
            result = result.at[where].set(values, mode="drop", unique_indices=True)
        return result
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
    return jax.ops.segment_sum(values, number, num_segments=len(first), indices_are_sorted=True)


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
