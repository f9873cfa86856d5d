"""The nodes of an executed motion, on which the channels' terms are integrated: signals and temperatures of a log."""

from dataclasses import replace
from typing import Final, NamedTuple

import equinox as eqx
import numpy as np

from gradcal_jax.estimation.imu_rows import ExecutedImu, ImuRows
from gradcal_jax.model import BodyNodes, NodeGroup
from gradcal_jax.motion import Geometry, body_group, frames, lagrange, quadrature

# Time after and before, over which dT/dt is measured, s.
_AROUND_S = 30.0
# Equal parts of a piece of rest in which functions of temperature with jumps are summed.
_PARTS = 64


class AngleErrors(NamedTuple):
    """Errors of the axes' angles (rad): `waves`, each of an axis with its order and the sizes of cosine and sine; and
    of one `axis` a `constant` error and one in proportion to the angle."""

    waves: tuple[tuple[int, int, float, float], ...] = ()
    axis: int = -1
    constant: float = 0.0
    slope: float = 0.0

    def __call__(self, angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The errors at the angles of all axes (the last axis of the array), and their derivatives."""
        own = (np.arange(angles.shape[-1]) == self.axis).astype(float)
        error, slope = (
            own * (self.constant + self.slope * angles),
            np.broadcast_to(own * self.slope, angles.shape).copy(),
        )
        for axis, order, cosine, sine in self.waves:
            c, s = np.cos(order * angles[..., axis]), np.sin(order * angles[..., axis])
            error[..., axis] += cosine * c + sine * s
            slope[..., axis] += order * (sine * c - cosine * s)
        return error, slope


NO_ERRORS: Final = AngleErrors()


def nodes_of_rows(
    done: ExecutedImu,
    log: ImuRows,
    geometry: Geometry,
    points: int,
    temperature_c: np.ndarray,
    errors: AngleErrors,
    added: np.ndarray | None,
) -> BodyNodes:
    """The nodes of the executed motion on a table of this `geometry`. `temperature_c` `(n,)`: temperature of the maps.
    `points` along a piece for functions of temperature; 0: they have jumps, and are evaluated at every node.

    `errors`: of the angle of every axis less that of its encoder. `added` `(P, 3)`: the mean specific force beyond
    gravity over every piece, m/s², in the frame of the innermost axis: away from the axes a move adds some hundredths
    of g to gravity, and gyros are sensitive to it.
    """
    motion, line = eqx.tree_at(lambda m: m.geometry, done.motion, geometry), done.motion.line
    before, after = motion.angles()
    sizes = np.array([1 if way is None else len(way) - 1 for way in done.travelled])

    def group(count: int) -> NodeGroup:
        """The pieces of so many nodes."""
        kinds = np.flatnonzero(sizes == count)
        duration, own = line.duration[kinds][:, None], motion.turns[kinds][:, None, :]
        since = speed = np.zeros((len(kinds), 1))
        if count > 1:
            ways = np.array([done.travelled[k] for k in kinds])
            since = 0.5 * (ways[:, 1:] + ways[:, :-1])
            speed = np.diff(ways, axis=1) * count / np.where(duration > 0.0, duration, 1.0)
        angle = before[kinds][:, None, :] + np.where(own, since[..., None], 0.0)
        error, slope = errors(angle)
        joint = np.where(own, speed[..., None], 0.0) * (1.0 + slope)
        mounting = np.broadcast_to(motion.mounting[kinds][:, None], since.shape)
        middles = (np.arange(count) + 0.5) / count
        if points:
            x, w = quadrature(points)
            share = w[None] if count == 1 else lagrange(x, middles)
        else:
            x = (np.arange(_PARTS) + 0.5) / _PARTS if count == 1 else middles
            share = np.full((1, _PARTS), 1.0 / _PARTS) if count == 1 else np.eye(count)
        time = line.start[kinds][:, None] + duration * x
        ends = [np.clip(time + by, log.time_s[0], log.time_s[-1]) for by in (-_AROUND_S, _AROUND_S)]
        change = np.diff([np.interp(end, log.time_s, temperature_c) for end in ends], axis=0)[0]
        weight = np.broadcast_to(duration / count, since.shape)
        own_kinds = kinds, kinds, np.arange(len(kinds))
        temperature = np.interp(time, log.time_s, temperature_c)
        found = replace(
            body_group(geometry, own_kinds, temperature, share, weight, angle + error, joint, mounting),
            time=time - log.time_s[0],
            slope=change / np.maximum(ends[1] - ends[0], np.finfo(float).tiny),
        )
        if added is None or count == 1:
            return found
        in_body = np.einsum("kij,ki->kj", geometry.mountings[motion.mounting[kinds]], added[kinds])
        return replace(found, felt=found.force + in_body[:, None])

    begin, end = temperature_c[done.rows[:-1]], temperature_c[done.rows[1:]]
    seen_before, seen_after = (angle + errors(angle)[0] for angle in (before, after))
    earlier = np.zeros(0) if done.motion.history is None else np.asarray(done.motion.history)
    return BodyNodes(
        tuple(group(int(count)) for count in np.unique(sizes)),
        motion.kind,
        end - begin,
        seen_before,
        seen_after,
        frames(geometry, seen_before, motion.mounting).axes,
        motion.axis,
        motion.mounting,
        begin,
        np.concatenate([earlier, turning_points(temperature_c[: done.rows[0] + 1])]),
    )


def turning_points(temperature: np.ndarray) -> np.ndarray:
    """The first, the last, and all turning points of a series of temperatures."""
    change = np.sign(np.diff(temperature))
    steps = np.flatnonzero(change)
    turns = steps[1:][np.diff(change[steps]) != 0]
    return temperature[np.unique(np.concatenate([[0], turns, [len(temperature) - 1]]).astype(int))]
