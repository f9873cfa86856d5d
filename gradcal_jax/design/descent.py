"""Quasi-Newton descent (BFGS of optimistix) as one compiled program, advanced a few evaluations at a time so that it
can be watched and interrupted."""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from gradcal_jax.design.compiling import compiler_options

# A line search that has come down to this share of a step ends the descent.
_SMALLEST_STEP = 1e-6
_TOLERANCE = 1e-6


class Reached(NamedTuple):
    """A point of a descent, its value and gradient, the evaluations made so far, and whether the descent has ended by
    itself."""

    point: np.ndarray
    value: float
    gradient: np.ndarray
    evaluations: int
    ended: bool


class Descent:
    """Descents of `function(y, args)`, `y` `(n,)`, compiled once for all points and arguments of equal shapes.

    A value that is not finite counts as a step too far. `tolerance`: relative and absolute, of point and value.
    """

    def __init__(self, function: Callable[[Any, Any], Any], tolerance: float = _TOLERANCE) -> None:
        import optimistix  # Slow to import: a prediction does without.

        self._solver: Any = optimistix.BFGS(rtol=tolerance, atol=tolerance)
        self._function = lambda y, args: (function(y, args), None)
        self._advance = jax.jit(self._advanced, static_argnums=0, compiler_options=compiler_options())
        # (One by one its operations would compile a dozen programs.)
        self._begun = eqx.filter_jit(self._begin)
        # Of points of each size.
        self._static: dict[tuple[int, ...], _Static] = {}

    def _begin(self, y) -> Any:
        """A solver's state at a point `y`; the arguments count from the first step on."""
        value = jax.ShapeDtypeStruct((), y.dtype)
        return self._solver.init(self._function, y, None, {}, value, None, frozenset())

    def _static_of(self, y) -> "_Static":
        """What is no array in it."""
        if y.shape not in self._static:
            # Of several threads that come here at once, all take the same one.
            self._static.setdefault(y.shape, _Static(eqx.filter(self._begun(y), eqx.is_array, inverse=True)))
        return self._static[y.shape]

    def _advanced(self, static: "_Static", y, args, dynamic, count):
        def going(carry):
            k, _, dynamic = carry
            state = eqx.combine(dynamic, static.state)
            return (k < count) & ~state.terminate & (state.search_state.step_size > _SMALLEST_STEP)

        def step(carry):
            k, y, dynamic = carry
            state = eqx.combine(dynamic, static.state)
            y, state, _ = self._solver.step(self._function, y, args, {}, state, frozenset())
            return k + 1, y, eqx.filter(state, eqx.is_array)

        return jax.lax.while_loop(going, step, (0, y, dynamic))

    def __call__(
        self, point: Float[np.ndarray, " n"], args: Any, *, evaluations: int, together: int = 20
    ) -> Iterator[Reached]:
        """Descend from a point; yields after every `together` evaluations, at most until `evaluations` are made."""
        y = jnp.asarray(point, dtype=float)
        static, dynamic = self._static_of(y), eqx.filter(self._begun(y), eqx.is_array)
        done = 0
        while done < evaluations:
            count = min(together, evaluations - done)
            made, y, dynamic = self._advance(static, y, args, dynamic, count)
            done += int(made)
            state = eqx.combine(dynamic, static.state)
            ended = int(made) < count or bool(state.terminate)
            yield Reached(np.asarray(y), float(state.f_info.f), np.asarray(state.f_info.grad), done, ended)
            if ended:
                return


class _Static:
    """The parts of a solver's state that are no arrays, as one hashable argument."""

    def __init__(self, state: Any) -> None:
        self.state = state
