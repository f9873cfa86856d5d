"""The filter and its derivative in machine code, for NumPy, and for JAX on a CPU.

In XLA every pass over N × p numbers costs as much as a whole product; `filter.cc` passes the readings once. It is
compiled for each number of noise states (`compiled.py`) in about a second; `whitening.filter_columns` and
`adjoint` are the equivalent for XLA.
"""

import ctypes
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gradcal_jax.arrays import AnyArray
from gradcal_jax.information.compiled import CompiledSource, NotCompiled, call, compiled, double_or_single, is_at_hand
from gradcal_jax.information.noise_steps import NoiseSteps

_SOURCE = Path(__file__).with_name("filter.cc")
# Number of readings that NumPy filters in about half the compiler's time; and from which on the compiler runs beside,
# for this process and all later ones.
_WORTH, _BESIDE = 40_000, 6_000
_asked: Counter[int] = Counter()


class Kept(NamedTuple):
    """Values of the filter that its derivative needs, at each reading: x and P before it, `P Hᵀ/S` and `1/√S`."""

    states: Float[AnyArray, "N n p"]
    covariances: Float[AnyArray, "N n n"]
    gains: Float[AnyArray, "N n"]
    per_std: Float[AnyArray, " N"]


class Native(NamedTuple):
    """The compiled functions for one number of states and one precision, as JAX calls them.

    Each raises `NotCompiled` where the compiler failed.
    """

    code: CompiledSource

    def whiten(
        self,
        mean: Float[Array, "n p"],
        covariance: Float[Array, "n n"],
        steps: NoiseSteps,
        columns: Float[Array, "N p"],
    ) -> list[Array]:
        """Whitened rows `(N, p)`, and state and covariance after the last reading."""
        shapes = (columns.shape, mean.shape, covariance.shape)
        return call(self.code.wait().names[0], shapes, (*steps[:5], mean, covariance, columns))

    def keep(self, steps: NoiseSteps, columns: Float[Array, "N p"]) -> tuple[Float[Array, "N p"], Kept]:
        """Whitened rows from states of zero, and the values that `cotangents` needs."""
        (count, n), p = steps.observation.shape, columns.shape[1]
        shapes = ((count, p), (n, p), (n, n), (count, n, p), (count, n, n), (count, n), (count,))
        zero = jnp.zeros((n, p), columns.dtype)
        rows, _, _, *kept = call(self.code.wait().names[0], shapes, (*steps[:5], zero, steps.initial, columns))
        return rows, Kept(*kept)

    def cotangents(
        self, steps: NoiseSteps, rows: Float[Array, "N p"], kept: Kept, of_product: Float[Array, "p p"]
    ) -> list[Array]:
        """Cotangents of transition, covariance, observation, reading variance, initial and columns for `of_product`."""
        weighed = rows @ ((of_product + of_product.T) / 2)
        shapes = [x.shape for x in (*steps[:4], steps.initial, rows)]
        stays = jnp.zeros(steps.used.shape, bool) if steps.stays is None else jnp.asarray(steps.stays)
        return call(self.code.wait().names[1], shapes, (*steps[:6], stays, rows, weighed, *kept))


def plain(states: int, readings: int) -> Callable[..., list[np.ndarray]] | None:
    """The filter for NumPy's doubles: from state, steps and columns to the rows and the state after the last reading.

    None without a compiler, and until enough readings were filtered for compilation to pay, or it is done.
    """
    _asked[states] += readings
    if not states or (_asked[states] <= _BESIDE and not is_at_hand(_SOURCE, *_definitions(states))):
        return None
    try:
        work = begin_filter(states)
        if work is None or not (_asked[states] > _WORTH or is_at_hand(_SOURCE, *_definitions(states))):
            return None
        return partial(_plainly, work.wait().loaded.gradcal_filter_plain)
    except NotCompiled:
        return None


def _plainly(
    function,
    mean: Float[np.ndarray, "n p"],
    covariance: Float[np.ndarray, "n n"],
    steps: NoiseSteps,
    columns: Float[np.ndarray, "N p"],
) -> list[np.ndarray]:
    results = [np.empty(np.shape(x)) for x in (columns, mean, covariance)]
    arguments = (*steps[:5], mean, covariance, columns)
    alike = [np.ascontiguousarray(x, bool if np.asarray(x).dtype == bool else float) for x in arguments]
    sizes = map(ctypes.c_int64, columns.shape)
    function(*sizes, *(ctypes.c_void_p(x.ctypes.data) for x in (*alike, *results)))
    return results


def native(steps: NoiseSteps, *others: Array) -> Native | None:
    """The machine code for these arrays in a program for a CPU, or None where there is none."""
    real = double_or_single(*steps[:4], steps.initial, *others)
    count, n = steps.observation.shape
    work = begin_filter(n, real) if real and count and n else None
    return None if work is None else Native(work)


def begin_filter(states: int, real: str = "double") -> CompiledSource | None:
    """Start compilation of the filter for a number of states; None without a compiler."""
    return compiled(_SOURCE, *_definitions(states, real), symbols=("gradcal_filter", "gradcal_pull"), what="the filter")


def _definitions(states: int, real: str = "double") -> tuple[str, str]:
    return f"-DSTATES={states}", f"-DREAL={real}"
