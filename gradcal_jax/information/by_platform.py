"""Functions that are one thing in programs for a CPU and another in all others."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.dtypes import canonicalize_dtype
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir

_HOW = ("tree", "batch", "results")


def like(x) -> jax.ShapeDtypeStruct:
    """Shape and dtype of what JAX makes of an array: without its float64, NumPy's doubles become singles."""
    return jax.ShapeDtypeStruct(x.shape, canonicalize_dtype(x.dtype))


def by_platform(name: str, on_cpu: Callable[..., Any], elsewhere: Callable[..., Any]) -> Callable[..., Any]:
    """A function of `results`, what `like` says of them, and the pytrees of arrays that both functions take.

    The choice is made as a program is lowered, and what its platform does not need is not even traced:
    `jax.lax.platform_dependent` would trace both. It goes through `vmap`; a derivative is the caller's to tell.
    """
    primitive = Primitive(name)
    primitive.multiple_results = True
    primitive.def_abstract_eval(lambda *_, results, **__: [ShapedArray(x.shape, x.dtype) for x in results])
    primitive.def_impl(jax.jit(primitive.bind, static_argnames=_HOW))
    batching.primitive_batchers[primitive] = partial(_batched, primitive)
    mlir.register_lowering(primitive, mlir.lower_fun(partial(_of_leaves, elsewhere), multiple_results=True))
    mlir.register_lowering(primitive, mlir.lower_fun(partial(_of_leaves, on_cpu), multiple_results=True), "cpu")

    def call(results, *arguments):
        leaves, tree = jax.tree.flatten(arguments)
        shapes, shape_of_all = jax.tree.flatten(results)
        made = primitive.bind(*map(jnp.asarray, leaves), tree=tree, batch=0, results=tuple(shapes))
        return jax.tree.unflatten(shape_of_all, made)

    return call


def _of_leaves(function, *leaves, tree, batch, results):
    del results

    def one(*given):
        return jax.tree.leaves(function(*jax.tree.unflatten(tree, given)))

    for _ in range(batch):
        one = jax.vmap(one)
    return one(*leaves)


def _batched(primitive, leaves, where, *, tree, batch, results):
    size = next(x.shape[at] for x, at in zip(leaves, where, strict=True) if at is not None)
    leaves = [
        jnp.broadcast_to(x, (size, *x.shape)) if at is None else jnp.moveaxis(x, at, 0)
        for x, at in zip(leaves, where, strict=True)
    ]
    results = tuple(jax.ShapeDtypeStruct((size, *x.shape), x.dtype) for x in results)
    made = primitive.bind(*leaves, tree=tree, batch=batch + 1, results=results)
    return made, [0] * len(made)
