"""The filter and its derivative in machine code, for NumPy, and for JAX on a CPU.

XLA pays for every pass over N × p numbers what a whole product costs; `filter.cc` goes through the readings once. It is
made for each number of noise states by itself (`machine.compiled`), in a second; `whitening.filter_columns` and
`adjoint` say the same to XLA.
"""

import ctypes
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gradcal_jax.arrays import AnyArray
from gradcal_jax.information.noise_steps import NoiseSteps
from gradcal_jax.machine import Compiled, call, compiled, double_or_single

_SOURCE = Path(__file__).with_name("filter.cc")


class Kept(NamedTuple):
    """What the derivative needs of the filter, at each reading: x and P before it, `P Hᵀ/S` and `1/√S`."""

    states: Float[AnyArray, "N n p"]
    covariances: Float[AnyArray, "N n n"]
    gains: Float[AnyArray, "N n"]
    per_std: Float[AnyArray, " N"]


class Native(NamedTuple):
    """The names under which JAX finds the compiled functions for one number of states and one precision."""

    filter: str
    pull: str

    def whiten(
        self,
        mean: Float[Array, "n p"],
        covariance: Float[Array, "n n"],
        steps: NoiseSteps,
        columns: Float[Array, "N p"],
    ) -> list[Array]:
        """Whitened rows `(N, p)`, and state and covariance after the last reading."""
        shapes = (columns.shape, mean.shape, covariance.shape)
        return call(self.filter, shapes, (*steps[:5], mean, covariance, columns))

    def keep(self, steps: NoiseSteps, columns: Float[Array, "N p"]) -> tuple[Float[Array, "N p"], Kept]:
        """Whitened rows from states of zero, and what `cotangents` wants."""
        (count, n), p = steps.observation.shape, columns.shape[1]
        shapes = ((count, p), (n, p), (n, n), (count, n, p), (count, n, n), (count, n), (count,))
        zero = jnp.zeros((n, p), columns.dtype)
        rows, _, _, *kept = call(self.filter, shapes, (*steps[:5], zero, steps.initial, columns))
        return rows, Kept(*kept)

    def cotangents(
        self, steps: NoiseSteps, rows: Float[Array, "N p"], kept: Kept, of_product: Float[Array, "p p"]
    ) -> list[Array]:
        """Of transition, covariance, observation, reading variance, initial and columns, for that of `rowsᵀ rows`."""
        weighed = rows @ ((of_product + of_product.T) / 2)
        shapes = [x.shape for x in (*steps[:4], steps.initial, rows)]
        return call(self.pull, shapes, (*steps[:6], _stays(steps, jnp), rows, weighed, *kept))


class Plain(NamedTuple):
    """The compiled functions for NumPy's arrays of doubles."""

    filter: Callable[..., None]
    pull: Callable[..., None]

    def whiten(
        self,
        mean: Float[np.ndarray, "n p"],
        covariance: Float[np.ndarray, "n n"],
        steps: NoiseSteps,
        columns: Float[np.ndarray, "N p"],
        *,
        keep: bool = False,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, Kept | None]:
        """Whitened rows `(N, p)`, state and covariance after the last reading, and what `cotangents` wants."""
        (count, n), p = steps.observation.shape, columns.shape[1]
        rows, after, covariance_after = np.empty((count, p)), np.empty((n, p)), np.empty((n, n))
        shapes = ((count, n, p), (count, n, n), (count, n), (count,))
        kept = Kept(*map(np.empty, shapes)) if keep else None
        made = [rows, after, covariance_after, *(kept or (None,) * 4)]
        _plainly(self.filter, count, p, (*steps[:5], mean, covariance, columns), made)
        return rows, after, covariance_after, kept

    def cotangents(self, steps: NoiseSteps, rows: np.ndarray, kept: Kept, of_product: np.ndarray) -> list[np.ndarray]:
        """As of `Native`."""
        weighed = rows @ ((of_product + of_product.T) / 2)
        made = [np.empty(np.shape(x)) for x in (*steps[:4], steps.initial, rows)]
        _plainly(self.pull, len(rows), rows.shape[1], (*steps[:6], _stays(steps, np), rows, weighed, *kept), made)
        return made


def _stays(steps: NoiseSteps, xp) -> AnyArray:
    return xp.zeros(steps.used.shape, bool) if steps.stays is None else xp.asarray(steps.stays)


def _plainly(function, count: int, p: int, arguments, results) -> None:
    alike = [np.ascontiguousarray(x, bool if np.asarray(x).dtype == bool else float) for x in arguments]
    addresses = [None if x is None else x.ctypes.data for x in (*alike, *results)]
    function(ctypes.c_int64(count), ctypes.c_int64(p), *map(ctypes.c_void_p, addresses))


def plain(states: int) -> Plain | None:
    """The machine code for NumPy's doubles, or None where there is none."""
    made = _made(states, "double") if states else None
    return None if made is None else Plain(made.library.gradcal_filter_plain, made.library.gradcal_pull_plain)


def native(steps: NoiseSteps, *others: Array) -> Native | None:
    """The machine code that serves these arrays in a program for a CPU, or None where there is none."""
    real = double_or_single(*steps[:4], steps.initial, *others)
    count, n = steps.observation.shape
    made = _made(n, real) if real and count and n else None
    return None if made is None else Native(*made.names)


def _made(states: int, real: str) -> Compiled | None:
    symbols = ("gradcal_filter", "gradcal_pull")
    return compiled(_SOURCE, f"-DSTATES={states}", f"-DREAL={real}", symbols=symbols, what="the filter")
