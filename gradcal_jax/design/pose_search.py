"""Search over poses and moves by simulated annealing: which axis turns, how far, how fast, how long to rest, in what
order (Kirkpatrick and others, 1983).

A *cycle* is a tuple of `CycleItem`s, each a turn of one axis by a whole number of angle steps followed by a rest. Every
cycle ends where it began, up to whole turns, so that it can repeat. All values have the resolution of a controller
(0.1 s, 0.1 deg/s), so that the optimum is executed without rounding.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

# Sizes of a change, in angle steps of 45°: to the next pose, a quarter, half a turn, whole turns.
_TURNS = (1, 2, 3, 4, 8, 16, 24)
_COLDEST = 0.0007
_FACTORS = (0.5, 0.7, 0.85, 1.2, 1.4, 2.0)


class CycleItem(NamedTuple):
    """A turn of `axis` by `steps` angle steps (0: none) at up to `rate` (deg/s), then a rest of `rest` s (0: none)."""

    axis: int
    steps: int
    rate: float
    rest: float


PoseCycle = tuple[CycleItem, ...]


class PoseLimits(NamedTuple):
    """Limits of a cycle: `per_turn` angle steps in a turn; for each axis the largest of `rates` (deg/s) and the `reach`
    in both directions, angle steps; rests (s) from `shortest` to `longest`; at most `most` items.
    """

    per_turn: int
    rates: tuple[float, ...]
    reach: tuple[tuple[float, float], ...]
    shortest: float
    longest: float
    most: int


class PoseState(NamedTuple):
    """State of a search: the best cycle and its value, the value of the current cycle, the completed share."""

    best: PoseCycle
    value: float
    current: float
    share: float


def anneal(
    start: PoseCycle,
    values: Callable[[Sequence[PoseCycle]], Iterable[float]],
    limits: PoseLimits,
    *,
    evaluations: int,
    seed: int,
    warmest: float = 0.02,
    together: int = 1,
) -> Iterator[PoseState]:
    """Yields after every `together` evaluations. `values`: the minimised function, of several cycles; infinite for an
    infeasible one.

    `warmest`: temperature at the beginning, the increase (in the value's unit) that is often still accepted; `_COLDEST`
    at the end. `together`: neighbours of one cycle that are evaluated in parallel; the first accepted one counts.
    """
    rng = np.random.default_rng(seed)
    here, now = start, next(iter(values([start])))
    best, least = here, now
    for done in range(0, evaluations, together):
        share = min(1.0, (done + together) / evaluations)
        temperature = warmest * (_COLDEST / warmest) ** share
        neighbours = [neighbour(here, limits, rng) for _ in range(together)]
        possible = [cycle for cycle in neighbours if feasible(cycle, limits)]
        for there, then in zip(possible, values(possible), strict=True):
            if then <= now or rng.random() < math.exp(-(then - now) / temperature):
                here, now = there, then
                break
        if now < least:
            best, least = here, now
        # Far above the best value the search restarts from the best cycle.
        if now > least + 6.0 * temperature:
            here, now = best, least
        yield PoseState(best, least, now, share)


def neighbour(cycle: PoseCycle, limits: PoseLimits, rng: np.random.Generator) -> PoseCycle:
    """A cycle with one change, closed by the next turn of the same axis: only poses between the two change."""
    items, k = list(cycle), int(rng.integers(len(cycle)))
    item, axis = items[k], int(rng.integers(len(limits.rates)))
    steps, factor = int(rng.choice(_TURNS)) * int(rng.choice([-1, 1])), float(rng.choice(_FACTORS))
    what = rng.choice(list(_SHARES), p=list(_SHARES.values()))
    if what == "rest":
        items[k] = item._replace(rest=_rest(item.rest * factor, limits))
    elif what == "rate":
        items[k] = item._replace(rate=_rate(item.rate * factor, item.axis, limits))
    elif what == "turn":
        items[k] = item._replace(steps=-item.steps if rng.random() < 0.3 else item.steps + steps)
    elif what == "axis":
        items[k] = item._replace(axis=axis, rate=_rate(item.rate, axis, limits))
    elif what == "swap":
        other = int(rng.integers(len(items))) if rng.random() < 0.5 else (k + 1) % len(items)
        items[k], items[other] = items[other], items[k]
    elif what == "insert" and len(items) < limits.most:
        rate = _rate(limits.rates[axis] * min(1.0, 2.0 * rng.random()), axis, limits)
        items.insert(k, CycleItem(axis, steps, rate, _rest(item.rest or limits.shortest, limits)))
    elif what == "delete" and len(items) > 2:
        del items[k]
        k -= 1
    elif what == "rests":
        items = [i._replace(rest=_rest(i.rest * factor, limits) if i.rest else 0.0) for i in items]
    elif what == "copy" and len(items) < limits.most:
        # Adds the opposite move, which cancels drift.
        items[k + 1 : k + 1] = [item._replace(steps=-item.steps)]
    elif what == "move":
        block = items[k : k + int(rng.integers(1, 7))]
        del items[k : k + len(block)]
        at = int(rng.integers(len(items) + 1))
        items[at:at] = block if rng.random() < 0.7 else block[::-1]
    return closed(tuple(items), limits, k)


_SHARES = {
    "rest": 0.2,
    "rate": 0.14,
    "turn": 0.2,
    "axis": 0.06,
    "swap": 0.1,
    "insert": 0.1,
    "delete": 0.09,
    "rests": 0.02,
    "copy": 0.04,
    "move": 0.05,
}


def closed(cycle: PoseCycle, limits: PoseLimits, after: int | None = None) -> PoseCycle:
    """The cycle with one turn of each axis changed so that it ends where it began, up to whole turns (exactly on an
    axis of limited travel): the last turn, or the first one behind the item `after`. Empty items are removed.
    """
    items = list(cycle)
    for axis, (_, highest) in enumerate(limits.reach):
        turns = [k for k, i in enumerate(items) if i.axis == axis and i.steps]
        net = sum(items[k].steps for k in turns)
        left = net if math.isfinite(highest) else (net + limits.per_turn // 2) % limits.per_turn - limits.per_turn // 2
        if not left or not turns:
            continue
        at = turns[-1] if after is None else next((k for k in turns if k > after), turns[0])
        items[at] = items[at]._replace(steps=items[at].steps - left)
    return tuple(i for i in items if i.steps or i.rest)


def feasible(cycle: PoseCycle, limits: PoseLimits) -> bool:
    """Whether a cycle stays within the reach of every axis."""
    for axis, (lowest, highest) in enumerate(limits.reach):
        path = np.cumsum([i.steps for i in cycle if i.axis == axis])
        if path.size and (path.min() < lowest or path.max() > highest):
            return False
    return bool(cycle)


def _rest(seconds: float, limits: PoseLimits) -> float:
    return round(min(max(seconds, limits.shortest), limits.longest), 1)


def _rate(rate: float, axis: int, limits: PoseLimits) -> float:
    return round(min(max(rate, 0.02 * limits.rates[axis]), limits.rates[axis]), 1)
