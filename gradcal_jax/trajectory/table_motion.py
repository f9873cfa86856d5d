"""The motion of a body on a table of several axes: which axis every piece turns, and the nodes that the body sees.

One axis turns at a time; all others stand. The pieces, their rates and temperatures are a `Trajectory`, as for a single
axis; the geometry makes of them the body's rate, specific force and attitude at every instant.
"""

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from gradcal_jax.arrays import AnyArray, namespace
from gradcal_jax.model import BodyGroup, BodyNodes
from gradcal_jax.trajectory.geometry import Geometry, frames
from gradcal_jax.trajectory.trajectory import Trajectory, quadrature

# Nodes that integrate polynomials of a cubic's degree in temperature and rate, and those that a turn needs besides:
# sines of an angle that goes through `x` rad within a piece want about half of x, with a margin.
_LEAST_NODES = 12
_NODES_PER_RAD = 0.75
# Fastest wave in a column, in cycles a turn: squares of the force's components, or harmonics times a direction.
_WAVES = 3
_STANDING_NODES = 4


class TableMotion(eqx.Module):
    """`line`: the pieces, `(P,)`; `axis`: which axis each turns (−1: all stand); `mounting`: how the unit hangs then.

    `start_angles` rad: of the axes as the motion begins.
    """

    line: Trajectory
    axis: Int[AnyArray, " P"]
    mounting: Int[AnyArray, " P"]
    geometry: Geometry
    start_angles: Float[AnyArray, " L"]

    def angles(self) -> tuple[Float[AnyArray, "P L"], Float[AnyArray, "P L"]]:
        """Angles of all axes (rad) as each piece begins and as it ends."""
        xp = namespace(self.line, self.start_angles)
        own = self.axis[:, None] == np.arange(self.geometry.axis_count)
        after = xp.cumsum(xp.where(own, self.line.turned()[:, None], 0.0), axis=0) + self.start_angles[None]
        return xp.concatenate([self.start_angles[None], after[:-1]]), after


def nodes_per_piece(motion: TableMotion, harmonics: int = 0) -> int:
    """How many nodes integrate every column on the pieces that move, whose numbers are known; `harmonics`: the highest
    order of an encoder's error.
    """
    fastest = float(np.max(np.abs(np.asarray(motion.line.turned())), initial=0.0))
    return _LEAST_NODES + int(np.ceil(_NODES_PER_RAD * fastest * max(_WAVES, harmonics + 1)))


def body_nodes(motion: TableMotion, moving_nodes: int) -> BodyNodes:
    """The nodes on which a unit's terms are integrated, `moving_nodes` on every piece that moves."""
    line, xp = motion.line, namespace(motion)
    before, after = motion.angles()
    moving = np.asarray(motion.axis) >= 0
    groups = tuple(
        _group(motion, np.flatnonzero(which), nodes, before)
        for which, nodes in ((~moving, _STANDING_NODES), (moving, moving_nodes))
        if which.any()
    )
    begin, end = line.ends()
    return BodyNodes(
        groups,
        end - begin,
        before,
        after,
        frames(motion.geometry, before, np.asarray(motion.mounting)).axes,
        motion.axis,
        motion.mounting,
    )


def _group(motion: TableMotion, pieces, count: int, before) -> BodyGroup:
    line, geometry = motion.line, motion.geometry
    xp = namespace(motion)
    x, w = quadrature(count)
    v = xp.broadcast_to(xp.asarray(x), (len(pieces), count))
    weight = xp.asarray(w)[None] * line.duration[pieces][:, None]
    own = (motion.axis[pieces][:, None] == np.arange(geometry.axis_count))[:, None, :]
    since, rate = line.angle(v, pieces), line.rate(v, pieces)
    angle = before[pieces][:, None, :] + xp.where(own, since[..., None], 0.0)
    joint = xp.where(own, rate[..., None], 0.0)
    mounting = np.broadcast_to(np.asarray(motion.mounting)[pieces][:, None], v.shape)
    stages = frames(geometry, angle, mounting)
    earth, up = (geometry.earth_rate()[None, :] @ stages.attitude)[..., 0, :], stages.attitude[..., 2, :]
    turning = joint[..., None] * stages.axes
    below = xp.cumsum(turning, axis=-2)
    return BodyGroup(
        pieces,
        weight,
        line.temperature(v, pieces),
        earth + below[..., -1, :],
        geometry.gravity * up,
        earth,
        up,
        stages.attitude,
        stages.axes,
        stages.crosses,
        earth[..., None, :] + below - turning,
        joint,
        angle,
    )
