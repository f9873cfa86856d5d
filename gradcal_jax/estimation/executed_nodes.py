"""The nodes of an executed motion, on which the channels' terms are integrated: signals and temperatures of a log."""

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

import equinox as eqx
import numpy as np

from gradcal_jax.estimation.imu_executed import ExecutedImu, ImuRows
from gradcal_jax.model import BodyGroup, BodyNodes
from gradcal_jax.motion import Geometry, body_group, frames, lagrange, quadrature

# Time after and before, over which dT/dt is measured, s.
_AROUND_S = 30.0
# Equal parts of a piece of rest in which functions of temperature with jumps are summed.
_PARTS = 64


def nodes_of_rows(
    done: ExecutedImu,
    log: ImuRows,
    geometry: Geometry,
    points: int,
    temperature_c: np.ndarray,
    error_of=None,
    added: np.ndarray | None = None,
    others: Mapping[str, np.ndarray] = MappingProxyType({}),
) -> BodyNodes:
    """The nodes of the executed motion on a table of this `geometry`. `temperature_c` `(n,)`: temperature of the maps.
    `points` along a piece for functions of temperature; 0: they have jumps, and are evaluated at every node.

    `error_of(axis, angle) -> (error, its derivative)`, rad: angle of every axis less that of its encoder. `added` `(P,
    3)`: the mean specific force beyond gravity over every piece, m/s², in the frame of the innermost axis: away from
    the axes a move adds some hundredths of g to gravity, and gyros are sensitive to it. `others`: other temperatures of
    the rows, by name.
    """
    motion = eqx.tree_at(lambda m: m.geometry, done.motion, geometry)
    before, after = motion.angles()
    seen_before, seen_after = (angle + _errors(error_of, angle)[0] for angle in (before, after))
    sizes = np.array([1 if way is None else len(way) - 1 for way in done.travelled])
    warm = temperature_c, others
    groups = tuple(
        _group(done, log, motion, np.flatnonzero(sizes == n), int(n), points, warm, before, error_of, added)
        for n in np.unique(sizes)
    )
    begin, end = temperature_c[done.rows[:-1]], temperature_c[done.rows[1:]]
    axes = frames(geometry, seen_before, motion.mounting).axes
    at = groups, motion.kind, end - begin, seen_before, seen_after, axes, motion.axis, motion.mounting
    earlier = np.zeros(0) if done.motion.history is None else np.asarray(done.motion.history)
    return BodyNodes(*at, begin, np.concatenate([earlier, turning_points(temperature_c[: done.rows[0] + 1])]))


def turning_points(temperature: np.ndarray) -> np.ndarray:
    """The first, the last, and all turning points of a series of temperatures."""
    change = np.sign(np.diff(temperature))
    change = change[np.flatnonzero(change)] if len(change) else change
    steps = np.flatnonzero(np.diff(temperature)) if len(temperature) > 1 else np.zeros(0, int)
    turns = steps[1:][np.diff(change) != 0] if len(steps) else steps
    return temperature[np.unique(np.concatenate([[0], turns, [len(temperature) - 1]]).astype(int))]


def _errors(error_of, angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Errors of all axes (the last axis of `angle`), and their derivatives."""
    if error_of is None:
        return np.zeros(angle.shape), np.zeros(angle.shape)
    both = [error_of(axis, angle[..., axis]) for axis in range(angle.shape[-1])]
    return np.stack([b[0] for b in both], axis=-1), np.stack([b[1] for b in both], axis=-1)


def _group(done, log, motion, kinds, count, points, warm, before, error_of, added) -> BodyGroup:
    geometry, line, (temperature_c, others) = motion.geometry, motion.line, warm
    duration = line.duration[kinds]
    own = motion.turns[kinds][:, None, :]
    if count == 1:
        since, speed = np.zeros((len(kinds), 1)), np.zeros((len(kinds), 1))
    else:
        ways = np.stack([done.travelled[k] for k in kinds])
        since = 0.5 * (ways[:, 1:] + ways[:, :-1])
        speed = np.diff(ways, axis=1) * count / np.where(duration > 0.0, duration, 1.0)[:, None]
    angle = before[kinds][:, None, :] + np.where(own, since[..., None], 0.0)
    error, slope = _errors(error_of, angle)
    joint = np.where(own, speed[..., None], 0.0) * (1.0 + slope)
    mounting = np.broadcast_to(motion.mounting[kinds][:, None], since.shape)
    middles = (np.arange(count) + 0.5) / count
    if points:
        x, w = quadrature(points)
        share = w[None] if count == 1 else lagrange(x, middles)
    else:
        x = (np.arange(_PARTS) + 0.5) / _PARTS if count == 1 else middles
        share = np.full((1, _PARTS), 1.0 / _PARTS) if count == 1 else np.eye(count)
    time = line.start[kinds][:, None] + duration[:, None] * x
    temperature = np.interp(time, log.time_s, temperature_c)
    after, before = (np.clip(time + by, log.time_s[0], log.time_s[-1]) for by in (_AROUND_S, -_AROUND_S))
    change = np.interp(after, log.time_s, temperature_c) - np.interp(before, log.time_s, temperature_c)
    slope = change / np.maximum(after - before, np.finfo(float).tiny)
    weight = np.broadcast_to(duration[:, None] / count, since.shape)
    own_kinds = kinds, kinds, np.arange(len(kinds))
    group = body_group(geometry, own_kinds, temperature, share, weight, angle + error, joint, mounting)
    beside = {name: np.interp(time, log.time_s, of) for name, of in others.items()}
    group = replace(group, time=time - log.time_s[0], slope=slope, others=beside or None)
    if added is None or count == 1:
        return group
    in_body = np.einsum("kij,ki->kj", geometry.mountings[motion.mounting[kinds]], added[kinds])
    return replace(group, felt=group.force + in_body[:, None])
