"""Functions that differ between CPUs and all other platforms, and linear ones with a transpose of their own."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.dtypes import canonicalize_dtype
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from gradcal_jax.information.compiled import NotCompiled


def like(x) -> jax.ShapeDtypeStruct:
    """Shape and dtype of an array in JAX: without its float64 mode, NumPy's doubles become singles."""
    return jax.ShapeDtypeStruct(x.shape, canonicalize_dtype(x.dtype))


class _Choice(NamedTuple):
    """Static part of a call of a function of pytrees by their leaves, under `batch` nested `vmap`s."""

    tree: Any
    results: tuple[jax.ShapeDtypeStruct, ...]
    batch: int = 0


class _Linear(NamedTuple):
    """A call of a linear function: the first `known` of its leaves are constants, the others its operands.

    `argument`, `results`: shapes of operands and results; `tree`, `shape`: their pytrees. `transposed`: the transpose
    is called, whose argument has the shapes of `results`.
    """

    linear: Callable[..., Any]
    transpose: Callable[..., Any]
    known: int
    tree: Any
    shape: Any
    argument: tuple[jax.ShapeDtypeStruct, ...]
    results: tuple[jax.ShapeDtypeStruct, ...]
    transposed: bool = False
    batch: int = 0

    @property
    def output(self) -> tuple[jax.ShapeDtypeStruct, ...]:
        return self.argument if self.transposed else self.results

    def by_leaves(self, *leaves, supplied: bool = True) -> list[jax.Array]:
        """The output's leaves for one problem; not `supplied`: with the transpose that JAX derives."""
        known, operands = leaves[: self.known], leaves[self.known :]

        def linear(*argument):
            return jax.tree.leaves(self.linear(*jax.tree.unflatten(self.tree, (*known, *argument))))

        if not self.transposed:
            return linear(*operands)
        if not supplied:
            return list(jax.linear_transpose(linear, *self.argument)(list(operands)))
        # (The argument's leaves are there for the tree alone.)
        first, _ = jax.tree.unflatten(self.tree, (*known, *self.argument))
        return jax.tree.leaves(self.transpose(first, jax.tree.unflatten(self.shape, operands)))


def by_platform(name: str, on_cpu: Callable[..., Any], elsewhere: Callable[..., Any]) -> Callable[..., Any]:
    """A function of `results` (their `like`) and of the pytrees of arrays that both functions take.

    The choice is made when a program is lowered, and the other function is not traced (`jax.lax.platform_dependent`
    would trace both). A CPU uses `elsewhere`, too, where `on_cpu` raises `NotCompiled`. `vmap` is supported; the caller
    defines its derivatives.
    """

    def here(*arguments):
        try:
            return on_cpu(*arguments)
        except NotCompiled:
            return elsewhere(*arguments)

    def by_leaves(function, how: _Choice):
        return lambda *leaves: jax.tree.leaves(function(*jax.tree.unflatten(how.tree, leaves)))

    primitive = _primitive(name, partial(by_leaves, elsewhere), lambda how: how.results)
    lowered = mlir.lower_fun(lambda *leaves, how: _each(by_leaves(here, how), how)(*leaves), multiple_results=True)
    mlir.register_lowering(primitive, lowered, "cpu")

    def call(results, *arguments):
        leaves, tree = jax.tree.flatten(arguments)
        shapes, shape_of_all = jax.tree.flatten(results)
        output = primitive.bind(*map(jnp.asarray, leaves), how=_Choice(tree, tuple(shapes)))
        return jax.tree.unflatten(shape_of_all, output)

    return call


def linear_with_transpose(linear: Callable, transpose: Callable, known, argument, results):
    """`linear(known, argument)`, linear in the second of two pytrees, with a transpose of its own.

    `transpose(known, cotangent)` returns a pytree like `argument`; `results`: `like` of the results of `linear`. Both
    must be functions of a module, since they are keys of the cache of compiled programs. Derivatives of the transpose
    are those of the one that JAX derives from `linear`, which is traced only if a derivative needs it.
    """
    first, (leaves, tree) = jax.tree.leaves(known), jax.tree.flatten((known, argument))
    shapes, shape = jax.tree.flatten(results)
    leaves = [jnp.asarray(x) for x in leaves]
    like_argument = tuple(map(like, leaves[len(first) :]))
    how = _Linear(linear, transpose, len(first), tree, shape, like_argument, tuple(shapes))
    return jax.tree.unflatten(shape, _linear.bind(*leaves, how=how))


def _primitive(name: str, by_leaves: Callable[[Any], Callable[..., list]], output: Callable[[Any], tuple]) -> Primitive:
    """A primitive with one parameter, `how`: `by_leaves(how)` for one problem, `output(how)` its results' shapes."""
    primitive = Primitive(name)
    primitive.multiple_results = True

    def shapes(*leaves, how):
        sizes = leaves[0].shape[: how.batch]
        return [ShapedArray((*sizes, *x.shape), x.dtype) for x in output(how)]

    def batched(leaves, where, *, how):
        size = next(x.shape[at] for x, at in zip(leaves, where, strict=True) if at is not None)
        leaves = [
            jnp.broadcast_to(x, (size, *x.shape)) if at is None else jnp.moveaxis(x, at, 0)
            for x, at in zip(leaves, where, strict=True)
        ]
        results = primitive.bind(*leaves, how=how._replace(batch=how.batch + 1))
        return results, [0] * len(results)

    primitive.def_abstract_eval(shapes)
    primitive.def_impl(jax.jit(primitive.bind, static_argnames="how"))
    batching.primitive_batchers[primitive] = batched
    lowered = mlir.lower_fun(lambda *leaves, how: _each(by_leaves(how), how)(*leaves), multiple_results=True)
    mlir.register_lowering(primitive, lowered)
    return primitive


def _each(one: Callable[..., list], how) -> Callable[..., list]:
    for _ in range(how.batch):
        one = jax.vmap(one)
    return one


def _transposed(cotangents, *leaves, how: _Linear):
    asked = [ad.is_undefined_primal(x) for x in leaves[how.known :]]
    cotangents = map(ad.instantiate_zeros, cotangents)
    output = _linear.bind(*leaves[: how.known], *cotangents, how=how._replace(transposed=not how.transposed))
    return [None] * how.known + [x if wanted else None for x, wanted in zip(output, asked, strict=True)]


def _differentiated(leaves, tangents, *, how: _Linear):
    """The product rule: the linear operands pass through, JAX differentiates the known leaves."""
    values = _linear.bind(*leaves, how=how)
    known, operands, d_known, d_operands = (
        x[cut] for x in (leaves, tangents) for cut in (slice(how.known), slice(how.known, None))
    )
    moves = [k for k, d in enumerate(d_known) if type(d) is not ad.Zero]
    tangent = [jnp.zeros_like(x) for x in values]
    if any(type(d) is not ad.Zero for d in d_operands):
        tangent = _linear.bind(*known, *map(ad.instantiate_zeros, d_operands), how=how)

    def of_known(*varying):
        whole = list(known)
        for k, x in zip(moves, varying, strict=True):
            whole[k] = x
        return _each(partial(how.by_leaves, supplied=False), how)(*whole, *operands)

    if moves:
        _, more = jax.jvp(of_known, [known[k] for k in moves], [d_known[k] for k in moves])
        tangent = [a + b for a, b in zip(tangent, more, strict=True)]
    return values, tangent


_linear = _primitive("gradcal_linear", lambda how: how.by_leaves, lambda how: how.output)
ad.primitive_transposes[_linear] = _transposed
ad.primitive_jvps[_linear] = _differentiated
