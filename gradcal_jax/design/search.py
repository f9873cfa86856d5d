"""The search: random starts that descend while a soft maximum hardens, hops from the best, and a polish.

One compiled program makes every descent and gives its starts and ends their values; the polish and the prices need
another one, with all gradients. Starts are independent of one another and share the cores; the better half of them
continues in each harder stage.
"""

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from gradcal_jax.design.compiling import compiler_options
from gradcal_jax.design.descent import Descent

SHARPNESS = (8.0, 40.0, 200.0, 1000.0)
# Penalty: this times the squared log excess over a limit is added to the log value.
_PENALTY = 30.0
# Least number of starts, each with a share of a stage's steps: there are many local optima, and the start hardly
# predicts the end of a descent. This share of a stage's points continues in the next one, and at least this number.
_BEGIN, _BRIEF = 24, 0.5
_SURVIVORS, _FEWEST = 0.5, 4
_QUICK_STEPS = 200
# Descents in one program of a GPU.
_SIDE_BY_SIDE = 64
# An objective with more noise steps than this has proportionally fewer starts and hops.
_CHEAP, _FEWEST_DEAR = 1024, 2
# Standard deviations of hops in coordinates of unit size, used in turn; the search ends after a round that gains less
# than this share.
_HOPS = (0.3, 1.0)
_HOP_GAIN = 1e-3
# A descent of the search ends where twenty evaluations gain less than this share: a polish follows.
_DESCENT_GAIN = 2e-4
# The merit of a point without a finite value.
_NOWHERE = 1e3
_LARGEST = 700.0
# Largest gradient component of log(value) that counts as zero.
CONVERGED = 1e-4
_POLISHES = 3
# Evaluations for each step that is asked for: a line search has more than one, most of them without a gradient; and
# until the size of a step is known.
_EVALUATIONS, _BEGINNING = 2, 20
# Tolerance of a descent, far below that of an optimum.
_EXACTLY = 1e-9
# A limit nearer than this binds.
_BINDING = 1e-4
# Largest log excess at which a limit counts as satisfied.
KEPT = 1e-3


@runtime_checkable
class Minimised(Protocol):
    """An objective: a pytree, so that its numbers are arguments of the compiled program.

    `value(z, sharpness)`: the positive value and the log excess (k,) over limits. `cost`: noise steps of one
    evaluation; `limited`: whether there are limits.
    """

    @property
    def cost(self) -> int: ...

    @property
    def limited(self) -> bool: ...

    def value(self, z, sharpness) -> tuple[Any, Any]: ...


class Slopes(NamedTuple):
    """At a point: `logs` `(1 + k,)` of the value and of the excess over limits, and their derivatives `(1 + k, n)`."""

    logs: np.ndarray
    of_z: np.ndarray

    def merit(self) -> tuple[float, np.ndarray]:
        """The logarithm of the value plus the penalty, and its gradient."""
        excess = np.maximum(self.logs[1:], 0.0)
        log = float(self.logs[0] + _PENALTY * np.sum(excess**2))
        gradient = self.of_z[0] + 2.0 * _PENALTY * excess @ self.of_z[1:]
        if not (np.isfinite(log) and np.all(np.isfinite(gradient))):
            return _NOWHERE, np.zeros(len(gradient))
        return log, gradient


@lru_cache(maxsize=64)
def _program(structure):
    """Value and slopes of all objectives of a structure; compiled once for each class of sizes."""

    def slopes(leaves, z, sharpness):
        def logs(z):
            value, excess = jax.tree.unflatten(structure, leaves).value(z, sharpness)
            return jnp.concatenate([jnp.log(value)[None], excess])

        values, pull = jax.vjp(logs, z)
        (of_z,) = jax.lax.map(pull, jnp.eye(values.shape[0]))
        return values, of_z

    return jax.jit(slopes, compiler_options=compiler_options())


@lru_cache(maxsize=64)
def _descent(structure) -> Descent:
    """Descents of the merit of all objectives of a structure, with the entries of a point that count marked by ones."""

    def merit(z, args):
        leaves, counts, sharpness = args
        value, excess = jax.tree.unflatten(structure, leaves).value(z * counts, sharpness)
        return jnp.log(value) + _PENALTY * jnp.sum(jnp.maximum(excess, 0.0) ** 2)

    return Descent(merit, _EXACTLY)


class Compiled:
    """An objective as a function of vectors of `size`, through the programs of its class.

    `places`: which entries of the objective's own `whole` vectors count, where those are padded.
    """

    def __init__(self, objective: Minimised, whole: int, places: np.ndarray | None = None) -> None:
        leaves, structure = jax.tree.flatten(objective)
        # (`jnp.asarray` would compile a program for every shape.)
        self._leaves = jax.device_put([np.asarray(leaf) for leaf in leaves])
        self._program, self._descent = _program(structure), _descent(structure)
        self._whole = whole
        self._places = np.arange(whole) if places is None else places
        self.cost, self.limited = objective.cost, objective.limited
        self.size = len(self._places)

    def __call__(self, z: Float[np.ndarray, " n"], sharpness: float = np.inf) -> Slopes:
        """Value and slopes at a point; an infinite sharpness is exact. Without limits by the program of the descents,
        so that no other one is compiled."""
        if not self.limited:
            return self._of_merit(z, sharpness)
        whole = np.zeros(self._whole)
        whole[self._places] = z
        logs, of_z = (np.asarray(x) for x in self._program(self._leaves, whole, sharpness))
        return Slopes(logs, of_z[:, self._places])

    def merit(self, z: Float[np.ndarray, " n"]) -> float:
        """The exact merit (`Slopes.merit`) at a point, by the program of the descents: until its polish a search
        compiles no other one."""
        return self._of_merit(z, np.inf).merit()[0]

    def _of_merit(self, z: Float[np.ndarray, " n"], sharpness: float) -> Slopes:
        """The merit and its slopes at a point, as of an objective without limits."""
        reached = next(self._descent(*self._whole_of(np.asarray(z), sharpness), evaluations=1))
        return Slopes(np.array([reached.value]), reached.gradient[None, self._places])

    def _whole_of(self, z: np.ndarray, sharpness: float) -> tuple[np.ndarray, tuple[Any, ...]]:
        """A point, or several ones, and the other arguments of the descent's program."""
        whole, mask = np.zeros((*z.shape[:-1], self._whole)), np.zeros(self._whole)
        whole[..., self._places], mask[self._places] = z, 1.0
        return whole, (self._leaves, mask, np.asarray(sharpness))

    def descend(
        self,
        z: Float[np.ndarray, " n"],
        sharpness: float,
        evaluations: int,
        stop: Callable[[], bool] = lambda: False,
        gain: float = 0.0,
    ) -> Float[np.ndarray, " n"]:
        """The end of a descent of the merit (`Slopes.merit`) from a point, after at most so many evaluations, where a
        block of them gains less than `gain` or, once `stop()` is true, its present point."""
        (whole, args), before = self._whole_of(z, sharpness), np.inf
        for reached in self._descent(whole, args, evaluations=evaluations):
            whole, gained, before = reached.point, before - reached.value, reached.value
            if stop() or gained < gain:
                break
        return whole[self._places]

    def descend_side_by_side(
        self, points: Float[np.ndarray, "m n"], sharpness: float, evaluations: int, stop: Callable[[], bool]
    ) -> Float[np.ndarray, "m n"]:
        """`descend` from many points by one program."""
        whole, args = self._whole_of(points, sharpness)
        return self._descent.side_by_side(whole, args, evaluations=evaluations, stop=stop)[:, self._places]


class SearchState(NamedTuple):
    """Where a search is: every start's point and value, the number of completed descents, the best.

    A start that did not continue in a later stage keeps its last point.
    """

    points: np.ndarray
    values: np.ndarray
    step: int
    first: float
    best: float
    best_point: np.ndarray


class Progress(NamedTuple):
    """Progress of a search: the best objective at its beginning and now, completed descents and their maximum."""

    first: float
    best: float
    step: int
    steps: int
    state: SearchState


class Optimum(NamedTuple):
    """The polished point, its exact objective, and a sentence on its convergence.

    `gradient_norm`: largest component of the objective's log gradient, projected on the binding limits. `held`: whether
    every limit is satisfied.
    """

    point: np.ndarray
    value: float
    gradient_norm: float
    converged: bool
    sentence: str
    held: bool = True


def search(
    compiled: Compiled,
    *,
    starts: int,
    seed: int,
    steps: int = 240,
    hops: int = 8,
    quick: bool = False,
    begin: Float[np.ndarray, " n"] | None = None,
    alone: bool = False,
    stop: Callable[[], bool] = lambda: False,
) -> Iterator[Progress]:
    """Yield `Progress` after every descent; the last one's state holds the best point.

    Twice `starts` points begin and make up to `steps` steps in all; the better half continues in each harder stage.
    Then some points near the best begin again, at most `hops` times and as long as that gains something. `quick`: half
    as many starts, one stage, no hops. `begin`: a further start, or, `alone`, the only one.
    `stop`: called between steps; once it returns true, descents end at their present point. Errors: `ValueError` when
    no start gives a finite objective.
    """
    share = min(1.0, _CHEAP / max(1, compiled.cost))
    plan = _levels(1, min(steps, _QUICK_STEPS), 0, 0.5 * share) if quick else _levels(starts, steps, hops, share)
    if begin is not None and alone:
        plan = [level._replace(descents=1) for level in plan if not level.hop]
    elif begin is not None:
        plan[0] = plan[0]._replace(descents=plan[0].descents + 1)
    total = sum(level.descents for level in plan)
    points = np.random.default_rng(seed).standard_normal((plan[0].descents, compiled.size))
    if begin is not None:
        points[-1] = begin
    merits = np.array([compiled.merit(z) for z in points])
    values = np.exp(np.minimum(merits, _LARGEST))
    if not np.min(merits) < _NOWHERE:
        raise ValueError(
            "no random start gives a finite residual, so plans of this structure cannot observe all parameters"
        )
    at = int(np.argmin(values))
    state = SearchState(points, values, 0, float(values[at]), float(values[at]), points[at])
    yield Progress(state.first, state.best, 0, total, state)
    without_gain, hop_from = 0, np.inf
    for number, level in enumerate(plan):
        count = level.descents
        if level.hop:
            without_gain = without_gain + 1 if state.best > hop_from * (1.0 - _HOP_GAIN) else 0
            if without_gain >= len(_HOPS):
                return
            hop_from = state.best
            near = np.random.default_rng([seed, number]).standard_normal((count, compiled.size))
            order, begins = np.arange(count), state.best_point + level.hop * near
        else:
            order = np.argsort(state.values, kind="stable")[:count]
            begins = state.points[order]
        for k, reached in _descents(compiled, list(begins), level.sharpness, level.steps, stop):
            at = int(order[k])
            value = float(np.exp(min(compiled.merit(reached), _LARGEST)))
            best, best_point = state.best, state.best_point
            if value < best:
                best, best_point = value, reached
            points, values = state.points.copy(), state.values.copy()
            points[at], values[at] = reached, value
            state = SearchState(points, values, state.step + 1, state.first, best, best_point)
            yield Progress(state.first, state.best, state.step, total, state)
            if stop():
                return


class _Level(NamedTuple):
    """Number and steps of descents at a sharpness; `hop`: spread of their starts about the best point, 0 for none."""

    sharpness: float
    descents: int
    steps: int
    hop: float = 0.0


def _levels(starts: int, steps: int, hops: int, share: float) -> list[_Level]:
    """`share`: affordable share of the starts and hops beyond the requested ones."""
    stage = max(1, round(steps / len(SHARPNESS)))
    fewest = max(_FEWEST_DEAR, round(_FEWEST * share))
    counts = [max(2 * starts, round(_BEGIN * share))]
    for _ in SHARPNESS[1:]:
        counts.append(min(counts[-1], max(fewest, round(_SURVIVORS * counts[-1]))))
    levels = [_Level(k, count, stage) for k, count in zip(SHARPNESS, counts, strict=True)]
    levels[0] = levels[0]._replace(steps=max(1, round(_BRIEF * stage)))
    return levels + [_Level(SHARPNESS[-1], fewest, stage, _HOPS[k % len(_HOPS)]) for k in range(hops)]


def _descents(
    compiled: Compiled, points: Sequence[np.ndarray], sharpness: float, steps: int, stop: Callable[[], bool]
) -> Iterator[tuple[int, np.ndarray]]:
    """End of a descent of `steps` steps from each point, in their order: one thread for each core, or on a GPU all in
    one program."""
    evaluations = _BEGINNING + _EVALUATIONS * steps

    def descend(z: np.ndarray) -> np.ndarray:
        return compiled.descend(z, sharpness, evaluations, stop, _DESCENT_GAIN)

    if jax.default_backend() != "cpu":
        # Of one size, which is compiled once: the last ones descend several times.
        for first in range(0, len(points), _SIDE_BY_SIDE):
            some = points[first : first + _SIDE_BY_SIDE]
            whole = np.stack([*some, *(_SIDE_BY_SIDE - len(some)) * [some[-1]]])
            reached = compiled.descend_side_by_side(whole, sharpness, evaluations, stop)
            yield from enumerate(reached[: len(some)], first)
        return
    with ThreadPoolExecutor(min(len(points), os.cpu_count() or 1) or 1) as pool:
        yield from enumerate(pool.map(descend, points))


def polish(
    compiled: Compiled,
    point: np.ndarray,
    *,
    steps: int = 300,
    rounds: int = _POLISHES,
    names: Sequence[str] = (),
) -> Optimum:
    """A descent of the hardest soft maximum, which is nearly the exact one; with limits by SLSQP, which holds them
    exactly.

    It restarts where `steps` do not suffice, `rounds` in all. `names`: of the limits.
    """
    seen: dict[bytes, Slopes] = {}

    def at(z):
        key = np.asarray(z).tobytes()
        if key not in seen:
            seen.clear()
            seen[key] = compiled(np.asarray(z), SHARPNESS[-1])
        return seen[key]

    limits = []
    if compiled.limited:
        limits.append({"type": "ineq", "fun": lambda z: -at(z)[0][1:], "jac": lambda z: -at(z)[1][1:]})
    options = {"maxiter": steps, "ftol": 1e-12}
    value, excess = exactly(compiled, point)
    norm = np.inf
    for _ in range(rounds):
        if limits:
            from scipy.optimize import minimize

            fun = lambda z: (float(at(z)[0][0]), at(z)[1][0].copy())  # noqa: E731 (SLSQP overwrites its argument.)
            reached = minimize(fun, point, jac=True, method="SLSQP", constraints=limits, options=options).x
        else:
            reached = compiled.descend(point, SHARPNESS[-1], _BEGINNING + _EVALUATIONS * steps)
        after = exactly(compiled, reached)
        before_it = float(np.max(excess, initial=0.0))
        worse = after[0] > value and before_it <= 1e-6
        worse |= float(np.max(after[1], initial=0.0)) > max(before_it, 1e-6)
        worse |= not np.all(np.isfinite(reached))
        if not worse:
            point, (value, excess) = reached, after
        norm = _projected(*at(point))
        if worse or norm < CONVERGED:
            break
    held = bool(np.all(excess <= KEPT))
    converged = norm < CONVERGED and held
    if not held:
        sentence = f"not converged: {missed_limit(excess, names)}: perhaps no plan of this kind can meet this limit"
    elif converged:
        sentence = f"converged: the largest gradient component is {norm:.1e} of the objective"
    else:
        sentence = (
            f"not converged: the largest gradient component is still {norm:.1e} of the objective: take more steps"
        )
    return Optimum(np.asarray(point), value, norm, converged, sentence, held)


def missed_limit(excess: np.ndarray, names: Sequence[str]) -> str:
    """The limit that is exceeded most, in words; empty where all are satisfied."""
    if np.all(excess <= KEPT):
        return ""
    worst = int(np.argmax(excess))
    return f"{names[worst] if names else 'a limit'} is {np.exp(excess[worst]):.3g} times the allowed value"


def exactly(compiled: Compiled, point: np.ndarray) -> tuple[float, np.ndarray]:
    """The exact value and the log excess over limits."""
    logs = compiled(np.asarray(point)).logs
    return float(np.exp(logs[0])), logs[1:]


def multipliers(compiled: Compiled, point: np.ndarray) -> Float[np.ndarray, " k"]:
    """At an optimum: price of each compiled limit, d log value / d log excess; 0 where it does not bind."""
    if not compiled.limited:
        return np.zeros(0)
    from scipy.optimize import nnls

    values, rows = compiled(np.asarray(point), SHARPNESS[-1])
    binding = values[1:] > -_BINDING
    costs = np.zeros(len(binding))
    if np.any(binding):
        costs[binding] = nnls(rows[1:][binding].T, -rows[0])[0]
    return costs


def _projected(values: np.ndarray, rows: np.ndarray) -> float:
    """Largest component of the gradient after subtraction of its best fit by the gradients of binding limits."""
    gradient, binding = rows[0], rows[1:][values[1:] > -_BINDING]
    if not (np.all(np.isfinite(gradient)) and np.all(np.isfinite(binding))):
        return np.inf
    if len(binding):
        from scipy.optimize import nnls

        gradient = gradient + binding.T @ nnls(binding.T, -gradient)[0]
    return float(np.max(np.abs(gradient)))
