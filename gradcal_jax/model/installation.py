"""Installation terms: small errors of table, mounting, site and clock, common to all channels of the unit.

Each is a small rotation p (body components) inserted at a stage of the table (`trajectory.table_motion`), which adds
`ω_outer × p + ṗ` to the rate and `f × p` to the specific force, or a common scale. Their columns are shared by all
channels: `(K, 6, size)`, three gyros and three accelerometers along the body's axes.
"""

from abc import abstractmethod
from itertools import pairwise

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from gradcal_jax.arrays import AnyArray, PytreeModule, cross, namespace
from gradcal_jax.model.nodes import AXIS_NAMES, BodyNodes, NodeGroup
from gradcal_jax.model.terms import waves


class InstallationTerm(PytreeModule):
    """An error common to all channels, linear in parameters with the independent priors `stds`."""

    stds: Float[AnyArray, " size"]

    @property
    def size(self) -> int:
        return self.stds.shape[0]

    @property
    def unit(self) -> str:
        """SI unit of its parameters."""
        return "rad"

    @abstractmethod
    def names(self) -> list[str]:
        """Names of the parameters."""

    @abstractmethod
    def of_nodes(self, group: NodeGroup, mounting: Int[AnyArray, " U"]) -> Float[AnyArray, "U q 6 size"]:
        """What each parameter's unit adds to rates and forces at the nodes, rad/s and m/s²; `mounting`: of each kind
        of pieces."""

    def columns(self, nodes: BodyNodes) -> Float[AnyArray, "K 6 size"]:
        """Contribution of each parameter's unit to all channels' integrals over a piece of each kind, rad and m/s."""
        return nodes.of_kinds(lambda g: g.integral(self.of_nodes(g, nodes.mounting[g.kinds])), (6, self.size))


def seen(group: NodeGroup, p: Float[AnyArray, "U q m 3"], outer: Float[AnyArray, "U q #m 3"]) -> AnyArray:
    """Contribution of inserted rotations to rate and force at the nodes, without ṗ, `(U, q, 6, m)`."""
    xp = namespace(p, outer)
    both = xp.concatenate([cross(outer, p), cross(group.force[..., None, :], p)], axis=-1)
    return xp.swapaxes(both, -1, -2)


class BaseTilt(InstallationTerm):
    """Error of the base's attitude, rad: rotations about East and North (tilt) and about the vertical (azimuth)."""

    def names(self) -> list[str]:
        return ["tilt_east", "tilt_north", "azimuth"]

    def of_nodes(self, group: NodeGroup, mounting: Int[AnyArray, " U"]) -> Float[AnyArray, "U q 6 3"]:
        # Column j of Rᵀ is row j of R. A rotation about the vertical changes no force: exact zeros, no rounding.
        whole = np.ones((1, 1, 6, 3))
        whole[..., 3:, 2] = 0.0
        return whole * seen(group, group.attitude, group.earth[..., None, :])


class NonOrthogonality(InstallationTerm):
    """Non-orthogonality of neighbouring axes, outermost first: deviation (rad) of their angle from the drawing."""

    axis_names: tuple[str, ...] = eqx.field(static=True)

    def names(self) -> list[str]:
        return [f"orthogonality_{a}_{b}" for a, b in pairwise(self.axis_names)]

    def of_nodes(self, group: NodeGroup, mounting: Int[AnyArray, " U"]) -> Float[AnyArray, "U q 6 J"]:
        outer = (group.outer + group.joint[..., None] * group.axes)[..., :-1, :]
        return seen(group, group.crosses, outer)


class AxisHarmonics(InstallationTerm):
    """Repeatable error of one axis's encoder: cosine and sine of each of `orders` cycles a turn, rad."""

    orders: tuple[int, ...] = eqx.field(static=True)
    axis: int = eqx.field(static=True)
    axis_name: str = eqx.field(static=True)

    def names(self) -> list[str]:
        return [f"angle_{self.axis_name}_{wave}{order}" for order in self.orders for wave in ("cos", "sin")]

    def of_nodes(self, group: NodeGroup, mounting: Int[AnyArray, " U"]) -> Float[AnyArray, "U q 6 m"]:
        return group.turned(self.axis)[..., None] * waves(group.angle[..., self.axis], self.orders)[..., None, :]

    def columns(self, nodes: BodyNodes) -> Float[AnyArray, "K 6 m"]:
        k, xp = self.axis, namespace(nodes.angle_before)
        change = waves(nodes.angle_after[:, k], self.orders) - waves(nodes.angle_before[:, k], self.orders)
        along = xp.where(nodes.axis == k, 1.0, 0.0)[:, None] * nodes.axes_before[:, k]
        turned = xp.concatenate([along, xp.zeros(along.shape)], axis=1)
        return super().columns(nodes) + turned[:, :, None] * change[:, None, :]


class MountingError(InstallationTerm):
    """Misalignment of the unit in each mounting, rad about the body's axes, three for each.

    A single mounting defines the body's frame and has no error.
    """

    def names(self) -> list[str]:
        return [f"mounting{k + 1}_{axis}" for k in range(self.size // 3) for axis in AXIS_NAMES]

    def of_nodes(self, group: NodeGroup, mounting: Int[AnyArray, " U"]) -> Float[AnyArray, "U q 6 m"]:
        xp = namespace(group)
        p = xp.broadcast_to(xp.eye(3), (*group.weight.shape, 3, 3))
        once = seen(group, p, group.rate[..., None, :])
        own = xp.where(mounting[:, None] == np.arange(self.size) // 3, 1.0, 0.0)
        return xp.concatenate([once] * (self.size // 3), axis=-1) * own[:, None, None, :]


class CommonScale(InstallationTerm):
    """A common error of the unit's scale factors: of gravity (m/s²) or of the sample clock (relative).

    `forces`: whether the clock acts on accelerometers, too, which it does where they give velocity increments."""

    of: str = eqx.field(static=True)
    forces: bool = eqx.field(static=True, default=True)

    def __check_init__(self):
        if self.of not in ("gravity", "sample_clock"):
            raise ValueError(f'"{self.of}" is not an error common to all channels: expected gravity or sample_clock')

    @property
    def unit(self) -> str:
        return "m/s^2" if self.of == "gravity" else "1"

    def names(self) -> list[str]:
        return [self.of]

    def of_nodes(self, group: NodeGroup, mounting: Int[AnyArray, " U"]) -> Float[AnyArray, "U q 6 1"]:
        xp = namespace(group.rate)
        still = xp.zeros(group.rate.shape)
        parts = [still, group.up] if self.of == "gravity" else [group.rate, group.force if self.forces else still]
        return xp.concatenate(parts, axis=-1)[..., None]
