"""Installation terms: small errors of table, mounting, site and clock, common to all channels of the unit.

Each is a small rotation p (body components) inserted at a stage of the table (`trajectory.table_motion`), which adds
`ω_outer × p + ṗ` to the rate and `f × p` to the specific force, or a common scale. Their columns are shared by all
channels: `(K, 6, size)`, three gyros and three accelerometers along the body's axes.
"""

from abc import abstractmethod

import equinox as eqx
import numpy as np
from jaxtyping import Float

from gradcal_jax.arrays import AnyArray, PytreeModule, cross, namespace
from gradcal_jax.model.nodes import AXIS_NAMES, BodyGroup, BodyNodes
from gradcal_jax.model.terms import waves


class InstallationTerm(PytreeModule):
    """An error common to all channels, linear in `size` parameters with independent priors `stds`."""

    stds: eqx.AbstractVar[AnyArray]

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
    def columns(self, nodes: BodyNodes) -> Float[AnyArray, "K 6 size"]:
        """Contribution of each parameter's unit to all channels' integrals over a piece of each kind, rad and m/s."""


def seen(group: BodyGroup, p: Float[AnyArray, "U q m 3"], outer: Float[AnyArray, "U q #m 3"]) -> AnyArray:
    """Contribution of inserted rotations to rate and force at the nodes, without ṗ, `(U, q, 6, m)`."""
    xp = namespace(p, outer)
    both = xp.concatenate([cross(outer, p), cross(group.force[..., None, :], p)], axis=-1)
    return xp.swapaxes(both, -1, -2)


class BaseTilt(InstallationTerm):
    """Error of the base's attitude, rad: rotations about East and North (tilt) and about the vertical (azimuth)."""

    stds: Float[AnyArray, " 3"]

    def names(self) -> list[str]:
        return ["tilt_east", "tilt_north", "azimuth"]

    def columns(self, nodes: BodyNodes) -> Float[AnyArray, "K 6 3"]:
        # Column j of Rᵀ is row j of R. A rotation about the vertical changes no force: exact zeros, no rounding.
        whole = np.ones((1, 1, 6, 3))
        whole[..., 3:, 2] = 0.0
        return nodes.integrals(lambda g: g.integral(whole * seen(g, g.attitude, g.earth[..., None, :])), (6, 3))


class NonOrthogonality(InstallationTerm):
    """Non-orthogonality of neighbouring axes, outermost first: deviation (rad) of their angle from the drawing."""

    stds: Float[AnyArray, " J"]
    axis_names: tuple[str, ...] = eqx.field(static=True)

    def names(self) -> list[str]:
        return [f"orthogonality_{a}_{b}" for a, b in zip(self.axis_names, self.axis_names[1:], strict=False)]

    def columns(self, nodes: BodyNodes) -> Float[AnyArray, "K 6 J"]:
        def of_group(g: BodyGroup):
            outer = (g.outer + g.joint[..., None] * g.axes)[..., :-1, :]
            return g.integral(seen(g, g.crosses, outer))

        return nodes.integrals(of_group, (6, self.size))


class AxisHarmonics(InstallationTerm):
    """Repeatable error of one axis's encoder: cosine and sine of each of `orders` cycles a turn, rad."""

    stds: Float[AnyArray, " m"]
    orders: tuple[int, ...] = eqx.field(static=True)
    axis: int = eqx.field(static=True)
    axis_name: str = eqx.field(static=True)

    def names(self) -> list[str]:
        return [f"angle_{self.axis_name}_{wave}{order}" for order in self.orders for wave in ("cos", "sin")]

    def columns(self, nodes: BodyNodes) -> Float[AnyArray, "K 6 m"]:
        k, xp = self.axis, namespace(nodes.angle_before)

        def of_group(g: BodyGroup):
            weighted = xp.swapaxes(waves(g.angle[..., k], self.orders) * g.weight[..., None], -1, -2)
            return xp.swapaxes(weighted @ g.turned(k), -1, -2)

        inserted = nodes.integrals(of_group, (6, self.size))
        change = waves(nodes.angle_after[:, k], self.orders) - waves(nodes.angle_before[:, k], self.orders)
        along = xp.where(nodes.axis == k, 1.0, 0.0)[:, None] * nodes.axes_before[:, k]
        return inserted + xp.concatenate([along, xp.zeros(along.shape)], axis=1)[:, :, None] * change[:, None, :]


class MountingError(InstallationTerm):
    """Misalignment of the unit in each mounting, rad about the body's axes, three for each.

    A single mounting defines the body's frame and has no error.
    """

    stds: Float[AnyArray, " m"]

    def names(self) -> list[str]:
        return [f"mounting{k + 1}_{axis}" for k in range(self.size // 3) for axis in AXIS_NAMES]

    def columns(self, nodes: BodyNodes) -> Float[AnyArray, "K 6 m"]:
        xp = namespace(nodes)

        def of_group(g: BodyGroup):
            p = xp.broadcast_to(xp.eye(3), (*g.weight.shape, 3, 3))
            once = g.integral(seen(g, p, g.rate[..., None, :]))
            number = nodes.mounting[g.kinds]
            return xp.concatenate(
                [xp.where((number == k)[:, None, None], once, 0.0) for k in range(self.size // 3)], axis=-1
            )

        return nodes.integrals(of_group, (6, self.size))


class CommonScale(InstallationTerm):
    """A common error of the unit's scale factors: of gravity (m/s²) or of the sample clock (relative).

    `forces`: whether the clock acts on accelerometers, too, which it does where they give velocity increments."""

    stds: Float[AnyArray, " 1"]
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

    def columns(self, nodes: BodyNodes) -> Float[AnyArray, "K 6 1"]:
        def of_group(g: BodyGroup):
            xp = namespace(g.rate)
            still = xp.zeros(g.rate.shape)
            parts = [still, g.up] if self.of == "gravity" else [g.rate, g.force if self.forces else still]
            return g.integral(xp.concatenate(parts, axis=-1)[..., None])

        return nodes.integrals(of_group, (6, 1))
