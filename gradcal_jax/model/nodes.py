"""Nodes: where the errors of a sensor are evaluated and summed, piece by piece. The one place where plan and log meet.

A parameter of the sensor adds `∫ (its function of temperature and rate) dt` to the integrated error of a piece. A plan
integrates on Gauss–Legendre nodes of smooth motion (`GaussNodes`), a log sums what was sampled (`SampleNodes`); the
terms of the model are the same functions of either.
"""

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from gradcal_jax.arrays import AnyArray, namespace, put


class GaussNodes(eqx.Module):
    """Nodes of the `k` given `pieces`, `q` each: `weight` s, `rate` rad/s, `temperature` °C.

    Where `moving` is false the rate is zero throughout. `signals`: what else a channel sees, by name (`SignalMap`).
    """

    pieces: Int[AnyArray, " k"]
    weight: Float[AnyArray, "k q"]
    rate: Float[AnyArray, "k q"]
    temperature: Float[AnyArray, "k q"]
    moving: bool = eqx.field(static=True)
    signals: dict[str, Float[AnyArray, "k q"]] = eqx.field(default_factory=dict)

    def sums(self, first: Float[AnyArray, "k q a"], second: Float[AnyArray, "k q b"]) -> Float[AnyArray, "k ab"]:
        """Weighted sums over each piece of all products of two sets of functions, the second fastest."""
        xp = namespace(first, second)
        weighted = xp.swapaxes(second * self.weight[..., None], -1, -2)
        return xp.reshape(xp.swapaxes(weighted @ first, -1, -2), (first.shape[0], -1))


class SampleNodes(eqx.Module):
    """Samples `(n,)` of a log in order of time; those of the k-th of `pieces` begin at `starts[k]`.

    `noise`: standard deviation of a sample's rate (rad/s), which functions that are not linear in it must not see.
    """

    pieces: Int[np.ndarray, " k"]
    starts: Int[np.ndarray, " k"]
    weight: Float[np.ndarray, " n"]
    rate: Float[np.ndarray, " n"]
    temperature: Float[np.ndarray, " n"]
    noise: float
    moving: bool = eqx.field(static=True)

    def sums(self, first: Float[np.ndarray, "n a"], second: Float[np.ndarray, "n b"]) -> Float[np.ndarray, "k ab"]:
        """As of `GaussNodes`."""
        products = first[:, :, None] * (second * self.weight[:, None])[:, None, :]
        return np.add.reduceat(products.reshape(len(first), -1), self.starts, axis=0)


class Nodes(eqx.Module):
    """All nodes of `count` pieces, and what terms that are no integrals need of each piece.

    `temperature_change` K over the piece; `angle_before`, `angle_after`: the table's angle at its ends, rad.
    """

    groups: tuple[GaussNodes | SampleNodes, ...]
    temperature_change: Float[AnyArray, " P"]
    angle_before: Float[AnyArray, " P"]
    angle_after: Float[AnyArray, " P"]

    @property
    def count(self) -> int:
        return self.temperature_change.shape[0]

    def integrals(self, of_group, size: int, *, moving_only: bool = False) -> Float[AnyArray, "P size"]:
        """`of_group(group) -> (k, size)` of every group in the pieces' places; zero where there is none."""
        result = namespace(self).zeros((self.count, size))
        for group in self.groups:
            if group.pieces.shape[0] and (group.moving or not moving_only):
                result = put(result, group.pieces, of_group(group))
        return result


class BodyGroup(eqx.Module):
    """Nodes of the `k` given pieces of a motion on `L` table axes, as the body on it sees them, `q` each.

    `weight` s, `temperature` °C; `rate` rad/s and `force` m/s² in body components, the Earth's rate and gravity in
    them; `earth` rad/s and `up`, the Earth's rate and the vertical; `attitude`: body to East-North-Up. `axes`: the
    axes' directions; `crosses`: see `trajectory.geometry`; `outer`: the rate of all that stands outside each axis;
    `joint`: rate (rad/s) and `angle` (rad) of each axis.
    """

    pieces: Int[AnyArray, " k"]
    weight: Float[AnyArray, "k q"]
    temperature: Float[AnyArray, "k q"]
    rate: Float[AnyArray, "k q 3"]
    force: Float[AnyArray, "k q 3"]
    earth: Float[AnyArray, "k q 3"]
    up: Float[AnyArray, "k q 3"]
    attitude: Float[AnyArray, "k q 3 3"]
    axes: Float[AnyArray, "k q L 3"]
    crosses: Float[AnyArray, "k q J 3"]
    outer: Float[AnyArray, "k q L 3"]
    joint: Float[AnyArray, "k q L"]
    angle: Float[AnyArray, "k q L"]

    def integral(self, values: Float[AnyArray, "k q *s"]) -> Float[AnyArray, " k *s"]:
        """`∫ … dt` over each piece."""
        xp = namespace(values)
        return xp.sum(xp.reshape(self.weight, (*self.weight.shape, *(1,) * (values.ndim - 2))) * values, axis=1)


class BodyNodes(eqx.Module):
    """All nodes of `P` pieces, and the joints' angles (rad) and directions `(P, L, 3)` as each piece begins.

    `axis`: which joint a piece turns; −1: none. `mounting`: which one. `angle_after`: as it ends.
    """

    groups: tuple[BodyGroup, ...]
    temperature_change: Float[AnyArray, " P"]
    angle_before: Float[AnyArray, "P L"]
    angle_after: Float[AnyArray, "P L"]
    axes_before: Float[AnyArray, "P L 3"]
    axis: Int[AnyArray, " P"]
    mounting: Int[AnyArray, " P"]

    def integrals(self, of_group, shape: tuple[int, ...]) -> Float[AnyArray, " P *shape"]:
        """`of_group(group) -> (k, *shape)` of every group in the pieces' places."""
        result = namespace(self).zeros((self.axis.shape[0], *shape))
        for group in self.groups:
            result = put(result, group.pieces, of_group(group))
        return result

    def channel(self, kind: str, index: int) -> Nodes:
        """What a gyro or accelerometer along the body's axis `index` has for its own signal, the other axes beside."""
        own = {"gyro": "rate", "accelerometer": "force"}[kind]
        groups = tuple(
            GaussNodes(
                g.pieces,
                g.weight,
                getattr(g, own)[..., index],
                g.temperature,
                True,
                {f"{name} {AXIS_NAMES[k]}": getattr(g, name)[..., k] for name in ("rate", "force") for k in range(3)},
            )
            for g in self.groups
        )
        return Nodes(groups, self.temperature_change, self.angle_before[:, 0], self.angle_after[:, 0])


AXIS_NAMES = ("x", "y", "z")
