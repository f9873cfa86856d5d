"""The search: many random starts of BFGS, a soft maximum that hardens, and a polish of the best.

Starts run one after the other inside one compiled program (`lax.map`: on a CPU a wide `vmap` leaves the cache), a few
steps at a time, so that whoever drives the search sees its progress and may stop it with the best so far.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float
from scipy.optimize import minimize

Objective = Callable[[Array, Array | None], Array]


class Progress(NamedTuple):
    """How far a search is: the best start's exact objective before and now, and how many steps are done of how many."""

    first: float
    best: float
    values: np.ndarray
    step: int
    steps: int


class Found(NamedTuple):
    """The best point, its exact objective, what the starts ended at, and a sentence that says whether it converged."""

    point: np.ndarray
    value: float
    starts: np.ndarray
    gradient_norm: float
    converged: bool
    sentence: str


SHARPNESS = (8.0, 40.0, 200.0, 1000.0)


def search(
    objective: Objective, size: int, *, starts: int, seed: int, steps: int = 240, chunk: int = 20
) -> Iterator[Progress | Found]:
    """Yield `Progress` after every chunk of steps and `Found` at the end.

    `objective(z, sharpness)` is a positive scalar, exact for sharpness None; its logarithm is minimised. Errors:
    `ValueError` when no start gives a finite objective.
    """
    points = jnp.asarray(np.random.default_rng(seed).standard_normal((starts, size)))
    exact = eqx.filter_jit(lambda z: jax.lax.map(lambda one: objective(one, None), z))
    advance = eqx.filter_jit(lambda z, k: _advance(objective, z, k, chunk))
    first = float(np.nanmin(np.asarray(exact(points))))
    if not np.isfinite(first):
        raise ValueError("no random start gives a finite residual: the plan's structure cannot observe the parameters")
    stage = max(1, steps // (chunk * len(SHARPNESS)))
    best_point, best, values = np.asarray(points[0]), np.inf, np.array([first])
    done = 0
    for sharpness in SHARPNESS:
        for _ in range(stage):
            points = advance(points, jnp.asarray(sharpness))
            values = np.asarray(exact(points))
            done += chunk
            if np.nanmin(values) < best:
                best, best_point = float(np.nanmin(values)), np.asarray(points[int(np.nanargmin(values))])
            yield Progress(first, best, values, done, stage * chunk * len(SHARPNESS))
    yield polish(objective, best_point, values)


def _advance(objective: Objective, points: Float[Array, "s n"], sharpness: Array, steps: int) -> Float[Array, "s n"]:
    """A few BFGS steps from each point."""

    def smooth(z, k):
        value = jnp.log(objective(z, k))
        return jnp.where(jnp.isfinite(value), value, 1e3)

    solver = optx.BFGS(rtol=1e-9, atol=1e-9)

    def one(z):
        return optx.minimise(smooth, solver, z, args=sharpness, max_steps=steps, throw=False).value

    return jax.lax.map(one, points)


def polish(objective: Objective, point: np.ndarray, starts: np.ndarray, tolerance: float = 1e-6) -> Found:
    """SLSQP on the hardest soft maximum, which it cannot tell from the exact one, then the exact value.

    The gradient norm is of the logarithm, for coordinates of unit size: a share of the objective.
    """
    hardest = jnp.asarray(SHARPNESS[-1])
    smooth = eqx.filter_jit(jax.value_and_grad(lambda z: jnp.log(objective(z, hardest))))
    exact = eqx.filter_jit(lambda z: objective(z, None))

    def both(z):
        value, gradient = smooth(jnp.asarray(z))
        return float(value), np.asarray(gradient)

    before = float(exact(jnp.asarray(point)))
    result = minimize(both, point, jac=True, method="SLSQP", options={"maxiter": 200, "ftol": 1e-12})
    after = float(exact(jnp.asarray(result.x)))
    if after < before:
        point, before = result.x, after
    norm = float(np.max(np.abs(both(point)[1])))
    converged = norm < 1e-4
    sentence = (
        f"converged: the largest gradient component is {norm:.1e} of the objective"
        if converged
        else f"not converged: the largest gradient component is still {norm:.1e} of the objective: take more steps"
    )
    return Found(point, before, np.sort(starts), norm, converged, sentence)
