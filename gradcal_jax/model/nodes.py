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

    Where `moving` is false the rate is zero throughout.
    """

    pieces: Int[AnyArray, " k"]
    weight: Float[AnyArray, "k q"]
    rate: Float[AnyArray, "k q"]
    temperature: Float[AnyArray, "k q"]
    moving: bool = eqx.field(static=True)

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
