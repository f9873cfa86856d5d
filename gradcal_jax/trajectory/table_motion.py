"""The motion of a body on a table of several axes: the axis that each piece turns, and the nodes of the body.

One axis turns at a time; all others stand. Pieces, rates and temperatures are a `Trajectory`, as for a single axis; the
geometry yields the body's rate, specific force and attitude at every instant.
"""

import numpy as np
from jaxtyping import Float, Int

from gradcal_jax.arrays import AnyArray, PytreeModule, namespace, size_class
from gradcal_jax.model import BodyGroup, BodyNodes
from gradcal_jax.trajectory.geometry import Geometry, frames
from gradcal_jax.trajectory.trajectory import Trajectory, quadrature

# Nodes for cubic polynomials in temperature and rate, smallest number for a turn, and nodes per rad: sines of an angle
# that changes by x rad within a piece need about x/2, with a margin.
_LEAST_NODES = 12
_FEWEST = 16
_NODES_PER_RAD = 0.75
# Fastest wave in a column, in cycles a turn: squares of the force's components, or harmonics times a direction.
_WAVES = 3
# Angles that differ by less (rad) are the same pose.
_SAME_POSE = 1e-9


class TableMotion(PytreeModule):
    """`line`: the pieces, `(P,)`; `axis`: the axis that each turns (−1: all stand); `mounting`: its number.

    `start_angles` rad: of the axes at the begin of the motion. Pieces of one `kind` differ only in temperature and by
    whole turns; `example` is a piece of each of the `K` kinds, and `nodes` its number of nodes.
    """

    line: Trajectory
    axis: Int[np.ndarray, " P"]
    mounting: Int[np.ndarray, " P"]
    geometry: Geometry
    start_angles: Float[AnyArray, " L"]
    kind: Int[np.ndarray, " P"]
    example: Int[np.ndarray, " K"]
    nodes: Int[np.ndarray, " K"]

    def angles(self) -> tuple[Float[AnyArray, "P L"], Float[AnyArray, "P L"]]:
        """Angles of all axes (rad) as each piece begins and as it ends."""
        xp = namespace(self.line.duration, self.line.terms, self.start_angles)
        after = xp.cumsum(xp.where(self.turns, self.line.turned()[:, None], 0.0), axis=0) + self.start_angles[None]
        return xp.concatenate([self.start_angles[None], after[:-1]]), after

    @property
    def turns(self) -> np.ndarray:
        """`(P, L)`: which axis every piece turns."""
        return self.axis[:, None] == np.arange(self.geometry.axis_count)


def table_motion(
    line: Trajectory,
    axis: Int[np.ndarray, " P"],
    mounting: Int[np.ndarray, " P"],
    geometry: Geometry,
    start_angles: Float[np.ndarray, " L"],
    harmonics: int = 0,
) -> TableMotion:
    """A motion whose numbers are known. `harmonics`: the highest order of an encoder's error."""
    each = np.arange(line.piece_count)
    before, after = TableMotion(line, axis, mounting, geometry, start_angles, each, each, each).angles()
    pose = np.round(np.mod(before, 2.0 * np.pi) / _SAME_POSE) % np.round(2.0 * np.pi / _SAME_POSE)
    of_motion = np.round(np.column_stack([line.duration, line.u_start, line.u_end, line.terms]) / _SAME_POSE)
    # The encoder's error is interpolated between standstills over the whole move of a piece.
    first = np.flatnonzero(np.diff(line.segment, prepend=line.segment[0] - 1))
    segment = np.repeat(np.arange(len(first)), np.diff(first, append=line.piece_count))
    ends = np.append(first[1:], line.piece_count) - 1
    of_move = np.round(
        np.column_stack([before - before[first][segment], (after[ends] - before[first])[segment]]) / _SAME_POSE
    )
    key = np.column_stack([axis, mounting, line.moving, pose, of_motion, of_move])
    _, example, kind = np.unique(key, axis=0, return_index=True, return_inverse=True)
    waves = max(_WAVES, harmonics + 1)
    turned = np.abs(line.turned()[example])
    nodes = _LEAST_NODES + np.ceil(_NODES_PER_RAD * turned * waves).astype(int)
    # A standing piece has a constant attitude and one node. Few sizes: each costs more than some additional nodes.
    sizes = np.array([_FEWEST, *(size_class(4 * _FEWEST * 2**k) for k in range(12))])
    nodes = np.where(axis[example] < 0, 1, sizes[np.searchsorted(sizes, nodes)])
    return TableMotion(line, axis, mounting, geometry, start_angles, np.reshape(kind, -1), example, nodes)


def body_nodes(motion: TableMotion, points: int) -> BodyNodes:
    """The nodes of a unit's terms, with functions of temperature interpolated from `points` points on each piece."""
    example = motion.example
    before, after = (angle[example] for angle in motion.angles())
    begin, end = motion.line.ends()
    groups = tuple(
        _group(motion, np.flatnonzero(motion.nodes == n), int(n), points, before) for n in np.unique(motion.nodes)
    )
    axis, mounting = motion.axis[example], motion.mounting[example]
    axes = frames(motion.geometry, before, mounting).axes
    return BodyNodes(groups, motion.kind, end - begin, before, after, axes, axis, mounting)


def _group(motion: TableMotion, kinds: np.ndarray, count: int, points: int, before) -> BodyGroup:
    line, geometry, xp = motion.line, motion.geometry, namespace(before, motion.line.duration, motion.geometry)
    example = motion.example[kinds]
    x, w = quadrature(count)
    v = xp.broadcast_to(xp.asarray(x), (len(kinds), count))
    own = motion.turns[example][:, None, :]
    since, rate = line.angle(v, example), line.rate(v, example)
    angle = before[kinds][:, None, :] + xp.where(own, since[..., None], 0.0)
    joint = xp.where(own, rate[..., None], 0.0)
    mounting = np.broadcast_to(motion.mounting[example][:, None], v.shape)
    pieces = np.flatnonzero(np.isin(motion.kind, kinds))
    at, of_points = quadrature(points)
    temperatures = line.temperature(xp.broadcast_to(xp.asarray(at), (len(pieces), points)), pieces)
    # A single node stands for what is constant along the piece.
    share = of_points[None] if count == 1 else lagrange(at, x)
    kind = np.searchsorted(kinds, motion.kind[pieces])
    weight = xp.asarray(w)[None] * line.duration[example][:, None]
    return body_group(geometry, (kinds, pieces, kind), temperatures, share, weight, angle, joint, mounting)


def body_group(
    geometry: Geometry,
    pieces: tuple[np.ndarray, np.ndarray, np.ndarray],
    temperature: Float[AnyArray, "k m"],
    share: Float[np.ndarray, "q m"],
    weight: Float[AnyArray, "U q"],
    angle: Float[AnyArray, "U q L"],
    joint: Float[AnyArray, "U q L"],
    mounting: Int[np.ndarray, "U q"],
) -> BodyGroup:
    """A group of nodes at which the table's axes stand at `angle` (rad) and turn at `joint` (rad/s).

    `pieces`: numbers of the kinds, of the pieces, and of each piece's kind among the former. The rest: see `BodyGroup`.
    """
    xp = namespace(geometry, angle, joint)
    stages = frames(geometry, angle, mounting)
    earth, up = (geometry.earth_rate()[None, :] @ stages.attitude)[..., 0, :], stages.attitude[..., 2, :]
    turning = joint[..., None] * stages.axes
    below = xp.cumsum(turning, axis=-2)
    rate, outer = earth + below[..., -1, :], earth[..., None, :] + below - turning
    seen = rate, geometry.gravity * up, earth, up, stages.attitude, stages.axes, stages.crosses
    return BodyGroup(*pieces, temperature, share, weight, *seen, outer, joint, angle)


def lagrange(points: np.ndarray, at: np.ndarray) -> np.ndarray:
    """The interpolating polynomials of `points` `(m,)`, at the places `at` `(q,)`: `(q, m)`."""
    apart = points[:, None] - points[None, :] + np.eye(len(points))
    others = np.where(
        np.eye(len(points), dtype=bool)[None], 1.0, (at[:, None, None] - points[None, None, :]) / apart[None]
    )
    return np.prod(others, axis=-1)
