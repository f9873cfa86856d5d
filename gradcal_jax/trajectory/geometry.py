"""Nested table axes on the rotating Earth: a body's attitude, its gravity, and the effect of small errors.

Stages from outside in, body to East-North-Up:

    R = exp[τ×] · base · Rot(e₁,θ₁) · exp[δ₁d₁×] · Rot(e₂,θ₂) · … · mounting · exp[μ×]

τ tilt of the base and its azimuth, δ_l the non-orthogonality of the axes l and l+1 about `d_l = e_{l+1} × e_l`, μ the
error of the mounting. One rule gives the effect of each of them: a small rotation p (body components) inserted at a
stage adds `f × p` to the specific force and `ω_outer × p (+ ṗ along an axis that moves)` to the rate, ω_outer being
the rate outside that stage: the Earth's plus that of the outer axes.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from gradcal_jax.arrays import AnyArray, PytreeModule, cross, namespace
from gradcal_jax.formulas import EARTH_RATE


class Geometry(PytreeModule):
    """A table of `L` axes, outermost first, and the mountings of the body on it.

    `axes`: directions at zero, each in the frame of the next outer axis (the first: in that of the base). `base`: base
    to East-North-Up. `mountings`: body to the innermost axis, one for each mounting. `latitude` rad, `gravity` m/s².
    """

    axes: Float[AnyArray, "L 3"]
    base: Float[AnyArray, "3 3"]
    mountings: Float[AnyArray, "K 3 3"]
    latitude: Float[AnyArray, ""]
    gravity: Float[AnyArray, ""]

    @property
    def axis_count(self) -> int:
        return self.axes.shape[0]

    def earth_rate(self) -> Float[AnyArray, " 3"]:
        """The Earth's rate, East-North-Up, rad/s."""
        xp = namespace(self.latitude)
        return EARTH_RATE * xp.stack([xp.zeros(()), xp.cos(self.latitude), xp.sin(self.latitude)])


class Frames(NamedTuple):
    """The stages in the body's frame. `attitude` `(…, 3, 3)`: body to East-North-Up. Body components of the axes,
    `axes` `(…, L, 3)`, and of `d_l`, `crosses` `(…, L − 1, 3)`.
    """

    attitude: AnyArray
    axes: AnyArray
    crosses: AnyArray


def frames(geometry: Geometry, angles: Float[AnyArray, "*s L"], mounting: AnyArray) -> Frames:
    """The stages at the axes' `angles` (rad), for the mountings with the numbers `mounting` `(*s,)`."""
    xp = namespace(geometry, angles)
    inner = namespace(geometry.mountings, mounting).asarray(geometry.mountings)[mounting]
    axes, crosses = [], []
    for k in reversed(range(geometry.axis_count)):
        direction = geometry.axes[k]
        axes.append(_seen(inner, direction))
        if k + 1 < geometry.axis_count:
            crosses.append(_seen(inner, cross(geometry.axes[k + 1], direction)))
        inner = rotation(direction, angles[..., k]) @ inner
    none = xp.zeros((*angles.shape[:-1], 0, 3))
    outside_in = xp.stack(axes[::-1], axis=-2), xp.stack(crosses[::-1], axis=-2) if crosses else none
    return Frames(geometry.base @ inner, *outside_in)


def _seen(inner: AnyArray, direction: AnyArray) -> AnyArray:
    """A direction of a stage in components of the body: `innerᵀ direction`."""
    return (direction[None, :] @ inner)[..., 0, :]


def rotation(axis: Float[AnyArray, " 3"], angle: Float[AnyArray, "*s"]) -> Float[AnyArray, "*s 3 3"]:
    """Rotation by `angle` (rad) about a unit vector (Rodrigues)."""
    xp = namespace(axis, angle)
    zero = xp.zeros(())
    x, y, z = axis
    cross = xp.stack([xp.stack(row) for row in ([zero, -z, y], [z, zero, -x], [-y, x, zero])])
    lead = (1,) * np.ndim(angle)
    cross, outer, one = (xp.reshape(m, (*lead, 3, 3)) for m in (cross, axis[:, None] * axis[None, :], np.eye(3)))
    c, s = xp.cos(angle)[..., None, None], xp.sin(angle)[..., None, None]
    return c * one + s * cross + (1.0 - c) * outer
