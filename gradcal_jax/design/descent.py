"""Quasi-Newton descent of one compiled program, which can be watched and interrupted."""

import os
from collections.abc import Callable
from contextlib import suppress
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

# Evaluations between two looks.
LOOK = 20
_TOLERANCE = 1e-9


class Reached(NamedTuple):
    """A point of a descent, its value, and the evaluations made until then."""

    point: Float[np.ndarray, " n"]
    value: float
    evaluations: int


class _EndedError(Exception):
    pass


def _compiler_options() -> dict[str, bool | int]:
    """On a CPU XLA's optimisations take a fifth of the compile time and its fusion emitters, which speed small kernels
    up a little, a third; a search gains from neither. (JAX 0.11 refuses the second option.) A level in XLA_FLAGS is the
    user's."""
    if jax.default_backend() != "cpu":
        return {}
    emitters = {"xla_cpu_use_fusion_emitters": False} if jax.__version_info__ < (0, 11) else {}
    level = {} if "xla_backend_optimization_level" in os.environ.get("XLA_FLAGS", "") else {
        "xla_backend_optimization_level": 1
    }  # fmt: skip
    return level | emitters


class Descent:
    """Descents of `function(y, args)`, `y` `(n,)`, compiled once for all points and arguments of equal shapes."""

    def __init__(self, function: Callable[[Any, Any], Any]) -> None:
        def value_and_slope(y: Any, args: Any) -> Any:
            return jax.value_and_grad(function)(y, args)

        self._both = jax.jit(value_and_slope, compiler_options=_compiler_options())

    def __call__(
        self,
        point: Float[np.ndarray, " n"],
        args: Any,
        *,
        evaluations: int,
        ends: Callable[[Reached], bool] = lambda _: False,
    ) -> Reached:
        """The best point of a descent after at most so many evaluations, of the function and its gradient. `ends`:
        called with the best point so far now and then; once true, the descent is over."""
        from scipy.optimize import minimize

        best, made = Reached(point, np.inf, 0), 0

        def both(y: np.ndarray) -> tuple[float, np.ndarray]:
            nonlocal best, made
            value, gradient = self._both(y, args)
            made += 1
            if float(value) < best.value:
                best = Reached(y.copy(), float(value), made)
            if made >= evaluations or (made % LOOK == 0 and ends(best._replace(evaluations=made))):
                raise _EndedError
            return float(value), np.nan_to_num(np.asarray(gradient))

        options = {"maxiter": evaluations, "maxfun": evaluations, "maxcor": 30, "ftol": _TOLERANCE, "gtol": _TOLERANCE}
        with suppress(_EndedError):
            minimize(both, point, jac=True, method="L-BFGS-B", options=options)
        return best._replace(evaluations=made)
