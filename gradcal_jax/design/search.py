"""The search: many random starts of BFGS, a soft maximum that hardens, hops from the best, and a polish.

Starts run one after the other inside one compiled program (`lax.map`: on a CPU a wide `vmap` leaves the cache), a few
steps at a time, so that whoever drives the search sees its progress and may stop it with the best so far.
"""

from collections.abc import Callable, Iterator
from functools import lru_cache
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float
from scipy.optimize import minimize, nnls

Objective = Callable[[Array, Array | None], tuple[Array, Array]]
"""`(z, sharpness)` to the value that is minimised, positive, and the logarithms by which limits are exceeded (k,)."""

SHARPNESS = (8.0, 40.0, 200.0, 1000.0)
# What exceeding a limit by a factor e costs, in factors e of the value, squared.
_PENALTY = 30.0
# Standard deviation of a hop in coordinates of unit size; a hop that gains less than this share is the last.
_HOP = 0.3
_HOP_GAIN = 2e-3
# Largest gradient component of log(value) that counts as zero.
CONVERGED = 1e-4
# Where it has not converged it begins anew, with no memory of curvature, so often in all.
_POLISHES = 3
# A limit that is nearer than this binds; a linear one that is exceeded by less is held.
_BINDING = 1e-4
_HELD = 1e-8


class State(NamedTuple):
    """All that a search needs to go on: where every start is, what it reached, how many steps are done, the best."""

    points: np.ndarray
    values: np.ndarray
    step: int
    first: float
    best: float
    best_point: np.ndarray


class Progress(NamedTuple):
    """How far a search is: the best objective at its beginning and now, and steps done of how many."""

    first: float
    best: float
    step: int
    steps: int
    state: State


class Linear(NamedTuple):
    """Limits on a vector: `rows @ z >= least`, and exactly equal where `equal` says so."""

    rows: np.ndarray
    least: np.ndarray
    equal: np.ndarray


class Found(NamedTuple):
    """The polished point, its exact objective, and a sentence that says whether it converged.

    `gradient_norm`: largest component of the gradient of the objective's logarithm, less what limits hold back.
    `held`: whether every limit is.
    """

    point: np.ndarray
    value: float
    gradient_norm: float
    converged: bool
    sentence: str
    held: bool = True


def search(
    objective: Objective,
    size: int,
    *,
    starts: int,
    seed: int,
    steps: int = 240,
    chunk: int = 20,
    hops: int = 4,
    state: State | None = None,
) -> Iterator[Progress]:
    """Yield `Progress` after every chunk of steps; the last one's state holds the best point.

    Each start makes about `steps` steps in all, while the maximum hardens; then all start again near the best, as long
    as that gains something, `hops` times at most. `state`: go on from there. Errors: `ValueError` when no start gives a
    finite objective.
    """
    exact, advance = _compiled(objective, chunk)
    generator = np.random.default_rng(seed)
    stage = max(1, round(steps / (chunk * len(SHARPNESS)))) * chunk
    total = stage * (len(SHARPNESS) + hops)
    if state is None:
        points = generator.standard_normal((starts, size))
        values = np.exp(np.asarray(exact(jnp.asarray(points))))
        if not np.isfinite(np.nanmin(values)):
            raise ValueError(
                "no random start gives a finite residual: the plan's structure cannot observe the parameters"
            )
        at = int(np.nanargmin(values))
        state = State(points, values, 0, float(values[at]), float(values[at]), points[at])
    hop_from = np.inf
    while state.step < total:
        level, into = divmod(state.step, stage)
        points = state.points
        if level >= len(SHARPNESS) and into == 0:
            if state.best > hop_from * (1.0 - _HOP_GAIN):
                break
            hop_from = state.best
            # The same numbers whether a search went on or began anew.
            near = np.random.default_rng([seed, level]).standard_normal(points.shape)
            points = state.best_point + _HOP * near
        sharpness = jnp.asarray(SHARPNESS[min(level, len(SHARPNESS) - 1)])
        points = np.asarray(advance(jnp.asarray(points), sharpness))
        values = np.exp(np.asarray(exact(jnp.asarray(points))))
        best, best_point = state.best, state.best_point
        if np.any(values < best):
            at = int(np.nanargmin(values))
            best, best_point = float(values[at]), points[at]
        state = State(points, values, state.step + chunk, state.first, best, best_point)
        yield Progress(state.first, best, state.step, total, state)


# The last objective's programs are kept for whoever searches it again.
@lru_cache(maxsize=1)
def _compiled(objective: Objective, chunk: int):
    """The exact merit of points, and a few steps from each of them at a sharpness."""
    merit = _merit(objective)
    exact = eqx.filter_jit(lambda z: jax.lax.map(lambda one: merit(one, None), z))
    return exact, eqx.filter_jit(lambda z, k: _advance(merit, z, k, chunk))


def _merit(objective: Objective) -> Callable[[Array, Array | None], Array]:
    """The logarithm of the value, and what exceeding limits costs."""

    def merit(z, sharpness):
        value, excess = objective(z, sharpness)
        log = jnp.log(value) + _PENALTY * jnp.sum(jnp.maximum(excess, 0.0) ** 2)
        return jnp.where(jnp.isfinite(log), log, 1e3)

    return merit


def _advance(merit, points: Float[Array, "s n"], sharpness: Array, steps: int) -> Float[Array, "s n"]:
    """A few BFGS steps from each point."""
    solver = optx.BFGS(rtol=1e-9, atol=1e-9)

    def one(z):
        return optx.minimise(merit, solver, z, args=sharpness, max_steps=steps, throw=False).value

    return jax.lax.map(one, points)


@lru_cache(maxsize=1)
def _hardest(objective: Objective):
    """The exact objective; and logarithms of the hardest soft maximum and of the limits' excess, with their rows."""
    hardest = jnp.asarray(SHARPNESS[-1])

    def logs(z):
        value, excess = objective(z, hardest)
        return jnp.concatenate([jnp.log(value)[None], excess])

    @eqx.filter_jit
    def both(z):
        values, pull = jax.vjp(logs, z)
        return values, jax.lax.map(lambda e: pull(e)[0], jnp.eye(values.shape[0]))

    return eqx.filter_jit(lambda z: objective(z, None)), both


def polish(objective: Objective, point: np.ndarray, *, steps: int = 300, linear: Linear | None = None) -> Found:
    """SLSQP on the hardest soft maximum, which it hardly tells from the exact one; limits held exactly.

    `linear`: further limits, on the vector itself.
    """
    exact, both = _hardest(objective)
    seen: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}

    def at(z):
        key = np.asarray(z).tobytes()
        if key not in seen:
            seen.clear()
            values, rows = both(jnp.asarray(z))
            seen[key] = np.asarray(values), np.asarray(rows)
        return seen[key]

    limits = []
    if len(at(point)[0]) > 1:
        limits.append({"type": "ineq", "fun": lambda z: -at(z)[0][1:], "jac": lambda z: -at(z)[1][1:]})
    if linear is not None:
        for kind, of in (("ineq", ~linear.equal), ("eq", linear.equal)):
            rows, least = linear.rows[of], linear.least[of]
            limits.append({"type": kind, "fun": lambda z, r=rows, b=least: r @ z - b, "jac": lambda z, r=rows: r})
    options = {"maxiter": steps, "ftol": 1e-12}
    value, excess = exact(jnp.asarray(point))
    norm = np.inf
    for _ in range(_POLISHES):
        reached = minimize(
            lambda z: (float(at(z)[0][0]), at(z)[1][0]),
            point,
            jac=True,
            method="SLSQP",
            constraints=limits,
            options=options,
        ).x
        after = exact(jnp.asarray(reached))
        worse = float(after[0]) > float(value) and np.all(np.asarray(excess) <= 1e-6)
        worse |= not np.all(np.isfinite(reached)) or _beyond(linear, reached) > max(_beyond(linear, point), _HELD)
        if not worse:
            point, (value, excess) = reached, after
        norm = _projected(*at(point), point, linear)
        if worse or norm < CONVERGED:
            break
    held = bool(np.all(np.asarray(excess) <= 1e-3)) and _beyond(linear, point) <= _HELD
    converged = norm < CONVERGED and held
    if not held:
        over = max(float(np.exp(np.max(np.asarray(excess), initial=0.0))) - 1.0, _beyond(linear, point))
        sentence = f"not converged: a limit is still exceeded by {100 * over:.2g} %: no plan of this kind may meet it"
    elif converged:
        sentence = f"converged: the largest gradient component is {norm:.1e} of the objective"
    else:
        sentence = (
            f"not converged: the largest gradient component is still {norm:.1e} of the objective: take more steps"
        )
    return Found(np.asarray(point), float(value), norm, converged, sentence, held)


def _beyond(linear: Linear | None, point: np.ndarray) -> float:
    """By how much a point exceeds the worst of its linear limits."""
    if linear is None:
        return 0.0
    room = linear.rows @ point - linear.least
    return float(np.max(np.where(linear.equal, np.abs(room), -room), initial=0.0))


def _projected(values: np.ndarray, rows: np.ndarray, point: np.ndarray, linear: Linear | None) -> float:
    """Largest component of the gradient, less its best combination of the gradients of the limits that bind."""
    gradient, binding = rows[0], rows[1:][values[1:] > -_BINDING]
    if linear is not None:
        held = linear.rows[linear.equal | (linear.rows @ point - linear.least < _BINDING)]
        binding = np.concatenate([binding, -held, linear.rows[linear.equal]])
    if not (np.all(np.isfinite(gradient)) and np.all(np.isfinite(binding))):
        return np.inf
    if len(binding):
        gradient = gradient + binding.T @ nnls(binding.T, -gradient)[0]
    return float(np.max(np.abs(gradient)))
