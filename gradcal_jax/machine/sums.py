"""Sums that are slow in XLA on a CPU: running sums, and sums of products of Legendre polynomials.

The columns of every polynomial map are such sums. In XLA they would take a search longer than the filter: a matrix
product for each piece, several passes of the polynomials through memory, products with triangles.
"""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gradcal_jax.formulas import legendre
from gradcal_jax.machine.by_platform import by_platform, like, linear_with_transpose
from gradcal_jax.machine.compiled import CompiledSource, call, compiled, double_or_single

_SOURCE = Path(__file__).with_name("sums.cc")
# Largest number of polynomials, as in `sums.cc`.
_MOST = 16
# XLA sums fewer rows as fast.
_FEW = 64


@jax.tree_util.register_static
@dataclass(frozen=True)
class _Sizes:
    """Numbers of polynomials, static in a pytree."""

    first: int
    second: int


def legendre_sums(
    x: Float[Array, "k q"], y: Float[Array, "k q"], weight: Float[Array, "k q"], first: int, second: int
) -> Float[Array, "k first second"]:
    """`Σ_q weight P_a(x) P_b(y)` of all degrees `a < first`, `b < second`: `q` nodes of each of `k` pieces."""
    sizes = _Sizes(first, second)
    if max(first, second) > _MOST or not x.size or _code(x, y, weight) is None:
        return _sums_by_xla(sizes, x, y, weight)
    return _sums(sizes, x, y, weight)


@jax.custom_jvp
def _sums(sizes: _Sizes, x: Array, y: Array, weight: Array) -> Array:
    return _sums_by_platform(_like_sums(sizes, x), sizes, x, y, weight)


@_sums.defjvp
def _sums_jvp(primals, tangents):
    sizes, *nodes = primals
    tangent = linear_with_transpose(_tangent, _cotangents, (sizes, nodes), list(tangents[1:]), _like_sums(*primals[:2]))
    return _sums(*primals), tangent


def _like_sums(sizes: _Sizes, x: Array) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct((x.shape[0], sizes.first, sizes.second), like(x).dtype)


def _tangent(known: tuple[_Sizes, list[Array]], tangents: list[Array]) -> Array:
    sizes, nodes = known
    return jax.jvp(partial(_sums_by_xla, sizes), nodes, tangents)[1]


def _cotangents(known: tuple[_Sizes, list[Array]], of_sums: Array) -> list[Array]:
    return _pull_by_platform([like(x) for x in known[1]], known[1], of_sums)


def _sums_by_xla(sizes: _Sizes, x: Array, y: Array, weight: Array) -> Array:
    weighted = jnp.swapaxes(legendre(y, sizes.second - 1) * weight[..., None], -1, -2)
    return jnp.swapaxes(weighted @ legendre(x, sizes.first - 1), -1, -2)


def _sums_natively(sizes: _Sizes, x: Array, y: Array, weight: Array) -> Array:
    return call(_name("gradcal_sums", x), [(x.shape[0], sizes.first, sizes.second)], (x, y, weight))[0]


def _pulled_natively(nodes: list[Array], of_sums: Array) -> list[Array]:
    return call(_name("gradcal_sums_pull", of_sums), [x.shape for x in nodes], (*nodes, of_sums))


def _pulled_by_xla(nodes: list[Array], of_sums: Array) -> list[Array]:
    return list(jax.vjp(partial(_sums_by_xla, _Sizes(*of_sums.shape[-2:])), *nodes)[1](of_sums))


def running_sum_of_rows(values: Float[Array, " N *c"]) -> Float[Array, " N *c"]:
    """Sums of all rows up to and including each one."""
    if values.shape[0] < _FEW or not values.size or _code(values) is None:
        return _running_by_xla(values)
    return linear_with_transpose(_running, _running_back, (), values, like(values))


def _running(known: tuple[()], values: Array) -> Array:
    return _running_by_platform(like(values), values)


def _running_back(known: tuple[()], of_sums: Array) -> Array:
    return _back_by_platform(like(of_sums), of_sums)


def _running_by_xla(values: Array) -> Array:
    """Two products with triangles of about √N rows: JAX's own sum costs a CPU a window of 128 rows for each row."""
    count = values.shape[0]
    length = max(1, round(count**0.5))
    blocks = -(-count // length)
    rest = [(0, 0)] * (values.ndim - 1)
    cut = jnp.reshape(jnp.pad(values, [(0, blocks * length - count), *rest]), (blocks, length, -1))
    within = np.tri(length) @ cut
    before = np.tri(blocks, k=-1) @ within[:, -1]
    return jnp.reshape(within + before[:, None], (blocks * length, *values.shape[1:]))[:count]


def _running_natively(symbol: str, values: Array) -> Array:
    flat = jnp.reshape(values, (values.shape[0], -1))
    return jnp.reshape(call(_name(symbol, values), [flat.shape], [flat])[0], values.shape)


def _code(*arrays: Array) -> CompiledSource | None:
    real = double_or_single(*arrays)
    return begin_sums(real) if real else None


def begin_sums(real: str = "double") -> CompiledSource | None:
    """Start compilation of these sums, which every prediction needs; None without a compiler."""
    return compiled(_SOURCE, f"-DREAL={real}", symbols=_SYMBOLS, what="the sums of columns")


def _name(symbol: str, array: Array) -> str:
    code = _code(array)
    assert code is not None
    return code.wait().names[_SYMBOLS.index(symbol)]


_SYMBOLS = ("gradcal_sums", "gradcal_sums_pull", "gradcal_running", "gradcal_running_back")
_sums_by_platform = by_platform("gradcal_sums", _sums_natively, _sums_by_xla)
_pull_by_platform = by_platform("gradcal_sums_pull", _pulled_natively, _pulled_by_xla)
_running_by_platform = by_platform("gradcal_running", partial(_running_natively, "gradcal_running"), _running_by_xla)
_back_by_platform = by_platform(
    "gradcal_running_back",
    partial(_running_natively, "gradcal_running_back"),
    lambda of_sums: _running_by_xla(of_sums[::-1])[::-1],
)
