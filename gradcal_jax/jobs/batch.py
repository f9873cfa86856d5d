"""Many plans of one layout through one compiled program, one after the other in the cache of one core."""

from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from gradcal_jax.errormodel import GyroModel
from gradcal_jax.information import SquareRootInformation, information
from gradcal_jax.jobs.layout import Plan, filled
from gradcal_jax.jobs.room import Layout
from gradcal_jax.plans import Programme, Timeline
from gradcal_jax.plans.timeline import IndexArray

TOGETHER = 32
"""Plans in one call; of a call with fewer the last is repeated, so that every call has the same shapes."""


def informations(layout: Layout, plans: list[Plan], models: list[GyroModel]) -> list[SquareRootInformation]:
    """Square-root information of plans that fit a layout, each with its model; the models are of one structure."""
    found: list[SquareRootInformation] = []
    for begin in range(0, len(plans), TOGETHER):
        arrays = [filled(plan, layout) for plan in plans[begin : begin + TOGETHER]]
        leaves = [jax.tree.leaves(model) for model in models[begin : begin + TOGETHER]]
        fill = TOGETHER - len(arrays)
        arrays += [arrays[-1]] * fill
        leaves += [leaves[-1]] * fill
        stacked = {name: np.stack([a[name] for a in arrays]) for name in arrays[0]}
        columns = [np.stack([np.asarray(leaf) for leaf in column]) for column in zip(*leaves, strict=True)]
        factor, scale = _compiled(layout, jax.tree.structure(models[begin]))(stacked, columns)
        found += _apart(factor, scale, TOGETHER - fill)
    return found


def in_own_shape(plans_: list[Any], models: list[GyroModel], lags: list[Any], channel: str):
    """The same for plans without a layout, of equal structure and shapes: standard plans that differ in numbers."""
    found: list[SquareRootInformation] = []
    trees = [(plan, model, lag) for plan, model, lag in zip(plans_, models, lags, strict=True)]
    for begin in range(0, len(trees), TOGETHER):
        some = [jax.tree.leaves(tree) for tree in trees[begin : begin + TOGETHER]]
        fill = TOGETHER - len(some)
        some += [some[-1]] * fill
        columns = [np.stack([np.asarray(leaf) for leaf in column]) for column in zip(*some, strict=True)]
        factor, scale = _compiled_tree(jax.tree.structure(trees[begin]), channel)(columns)
        found += _apart(factor, scale, TOGETHER - fill)
    return found


def _apart(factor, scale, count: int) -> list[SquareRootInformation]:
    factor, scale = np.asarray(factor), np.asarray(scale)
    return [SquareRootInformation(factor[k], scale[k]) for k in range(count)]


@lru_cache(maxsize=256)
def _compiled(layout: Layout, structure):
    def one(both):
        arrays, leaves = both
        model = jax.tree.unflatten(structure, leaves)
        known = information(timeline(layout, arrays), model)
        return known.factor, known.scale

    return jax.jit(lambda arrays, leaves: jax.lax.map(one, (arrays, leaves)))


@lru_cache(maxsize=256)
def _compiled_tree(structure, channel: str):
    def one(leaves):
        plan, model, lag = jax.tree.unflatten(structure, leaves)
        known = information(plan.timeline(channel, lag), model)
        return known.factor, known.scale

    return jax.jit(lambda leaves: jax.lax.map(one, leaves))


_FIELDS = ("duration", "u_start", "u_end", "terms", "read", "at_rest", "moving")


def timeline(layout: Layout, a: dict[str, Array]) -> Timeline:
    """A plan's numbers (`layout.filled`) as a timeline: `GradientPlan.timeline` with the cycles counted at run time."""
    kind, room = layout
    programme = Programme(a["start"], a["durations"], a["slopes"])
    times = programme.knots()[0]
    trail = programme.trail(a["lag"] if kind.lagged else None)
    own = {field: a[f"own {field}"] for field in _FIELDS}
    cycle = {field: jnp.concatenate([a[f"own {field}"], a[f"after {field}"]]) for field in _FIELDS}
    blocks: list[dict[str, Array]] = []
    for k, (first, _) in enumerate(kind.stretches):
        if k:
            gap = times[first] - times[kind.stretches[k - 1][1]]
            blocks.append(_gap(gap))
        if repeats := room.whole[k]:
            size = cycle["duration"].shape[0]
            here = jnp.repeat(jnp.arange(repeats) < a["whole"][k], size)
            blocks.append(_where(here, {f: jnp.tile(v, (repeats,) + (1,) * (v.ndim - 1)) for f, v in cycle.items()}))
        if own["duration"].shape[0]:
            blocks.append(_where(jnp.broadcast_to(a["made"][k], own["duration"].shape), own))
        if room.tail[k]:
            blocks.append({field: a[f"tail {k} {field}"] for field in _FIELDS})
    p = {field: jnp.concatenate([block[field] for block in blocks]) for field in _FIELDS}
    moving, varying, gaps, segment, of_segment = _structure(layout)
    begin = times[kind.stretches[0][0]]
    start = begin + jnp.concatenate([jnp.zeros(1), jnp.cumsum(p["duration"])[:-1]])
    middle = start + 0.5 * p["duration"]
    within = jnp.clip(jnp.searchsorted(trail.times, middle, side="right") - 1, 0, trail.slope.shape[0] - 1)
    since = start - trail.times[within]
    count = p["duration"].shape[0]
    return Timeline(
        start=start,
        duration=p["duration"],
        u_start=p["u_start"],
        u_end=p["u_end"],
        terms=p["terms"],
        share=jnp.ones(count),
        trail=trail.trail[within] + trail.slope[within] * since,
        slope=trail.slope[within],
        excess=trail.excess[within] * jnp.exp(-trail.lag_rate * since),
        lag_rate=trail.lag_rate,
        read=p["read"],
        at_rest=p["at_rest"],
        moving=p["moving"],
        reset=jnp.zeros(count, bool),
        segment=jnp.asarray(segment),
        moving_pieces=moving,
        varying_pieces=varying,
        gap_pieces=gaps,
        segment_moves=of_segment,
        axis=kind.channel,
        lagged=kind.lagged,
    )


def _where(here: Array, block: dict[str, Array]) -> dict[str, Array]:
    """A block of which only some is there: the rest lasts no time, does not move and is not read."""
    return {
        "duration": jnp.where(here, block["duration"], 0.0),
        "u_start": block["u_start"],
        "u_end": jnp.where(here, block["u_end"], block["u_start"]),
        "terms": jnp.where(here[:, None], block["terms"], 0.0),
        "read": block["read"] & here,
        "at_rest": block["at_rest"] | ~here,
        "moving": block["moving"] & here,
    }


def _gap(duration: Array) -> dict[str, Array]:
    one, none = jnp.ones(1), jnp.zeros(1)
    yes = jnp.ones(1, bool)
    return {
        "duration": jnp.reshape(duration, (1,)), "u_start": none, "u_end": one, "terms": jnp.zeros((1, 10)),
        "read": ~yes, "at_rest": yes, "moving": ~yes,
    }  # fmt: skip


@lru_cache(maxsize=256)
def _structure(layout: Layout):
    """What of a timeline the layout decides: which pieces may move, may vary, are gaps; segments and their moves."""
    kind, room = layout
    own = _pieces(kind.own, room.own)
    moves = 1 + max((i for i, _ in kind.own), default=-1)
    after = _pieces(tuple((moves + i, what) for i, what in kind.after), room.after)
    order: list[tuple[int, str]] = []
    runs: list[int] = []
    gap_at: list[int] = []
    run = 0
    for k in range(len(kind.stretches)):
        if k:
            gap_at.append(len(order))
            order.append((-1, "rest"))
            runs.append(run := run + 1)
        for block in [own + after] * room.whole[k] + [own]:
            before = None
            for piece in block:
                run += piece[0] != before
                before = piece[0]
                order.append(piece)
                runs.append(run)
        run += 1
        order += [(-1, "rest")] * room.tail[k]
        runs += [run] * room.tail[k]
    kinds = np.array([what for _, what in order])
    _, first, segment = np.unique(np.array(runs), return_index=True, return_inverse=True)
    of_segment = tuple(order[i][0] for i in first)
    return (
        IndexArray(np.flatnonzero(kinds != "rest")),
        IndexArray(np.flatnonzero(kinds == "varying")),
        IndexArray(gap_at),
        segment,
        of_segment,
    )


def _pieces(parts: tuple[tuple[int, str], ...], counts: tuple[int, ...]) -> list[tuple[int, str]]:
    return [part for part, count in zip(parts, counts, strict=True) for _ in range(count)]
