"""Nodes: where the errors of a sensor are evaluated and summed, piece by piece. The one place where plan and log meet.

A parameter of the sensor adds `∫ (its function of temperature and rate) dt` to the integrated error of a piece. A plan
integrates on Gauss–Legendre nodes of smooth motion, a log on its samples; the terms of the model are the same functions
of both.
"""

from dataclasses import replace

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from gradcal_jax.arrays import AnyArray, PytreeModule, cross, namespace, placed, taken

AXIS_NAMES = ("x", "y", "z")
INPUTS = {"gyro": "rate", "accelerometer": "force"}


class NodeGroup(PytreeModule):
    """Nodes of `k` pieces of `U` kinds on `L` table axes, `q` each, in the body's frame.

    Pieces of one kind share their signals and differ in temperature. That is smooth along a piece, so functions of it
    are interpolated from `m` points: `share` are the interpolating polynomials of the points at the nodes.

    `kinds`: numbers of the kinds; `pieces`, `kind`: number and kind of each piece. `weight` s; `rate` rad/s and `force`
    m/s² in body components, the Earth's rate and gravity in them; `earth` rad/s and `up`, the Earth's rate and the
    vertical; `attitude`: body to East-North-Up. `axes`: the axes' directions; `crosses`: see `motion.table_motion`;
    `outer`: the rate of the stage outside each axis; `joint`: rate (rad/s) and `angle` (rad) of each axis. `felt`: the
    force where the gyros are, off the axes, m/s²; None: as `force`. `across`: what each sensor senses by its
    misalignments, gyros first (rad/s, m/s²); None: nothing. `time` s and `slope` K/s: of each point, for terms of the
    path of temperature. `channel`: kind and axis of what senses.
    """

    kinds: Int[np.ndarray, " U"]
    pieces: Int[np.ndarray, " k"]
    kind: Int[np.ndarray, " k"]
    temperature: Float[AnyArray, "k m"]
    share: Float[np.ndarray, "q m"]
    weight: Float[AnyArray, "U q"]
    rate: Float[AnyArray, "U q 3"]
    force: Float[AnyArray, "U q 3"]
    earth: Float[AnyArray, "U q 3"]
    up: Float[AnyArray, "U q 3"]
    attitude: Float[AnyArray, "U q 3 3"]
    axes: Float[AnyArray, "U q L 3"]
    crosses: Float[AnyArray, "U q J 3"]
    outer: Float[AnyArray, "U q L 3"]
    joint: Float[AnyArray, "U q L"]
    angle: Float[AnyArray, "U q L"]
    felt: Float[AnyArray, "U q 3"] | None = None
    across: Float[AnyArray, "U q 6"] | None = None
    time: Float[AnyArray, "k m"] | None = None
    slope: Float[AnyArray, "k m"] | None = None
    channel: tuple[str, int] = eqx.field(static=True, default=("gyro", 0))

    @property
    def moving(self) -> bool:
        """Whether anything turns; a standing body has a constant attitude and one node."""
        return self.weight.shape[1] > 1

    @property
    def own_input(self) -> Float[AnyArray, "U q"]:
        """What the channel senses along its axis."""
        kind, axis = self.channel
        return self.signal(f"{INPUTS[kind]} {AXIS_NAMES[axis]}")

    def signal(self, name: str) -> Float[AnyArray, "U q"]:
        """A signal by its name: "rate x" (rad/s), "force x" (m/s²), "earth x" (rad/s), "up x" and "north x" (components
        of directions); "|rate x|" its magnitude."""
        of, axis = name.strip("|").split()
        k, (kind, own) = AXIS_NAMES.index(axis), self.channel
        vector = self.attitude[..., 1, :] if of == "north" else getattr(self, of)
        if of == "force" and kind == "gyro" and self.felt is not None:
            vector = self.felt
        signal = vector[..., k]
        if self.across is not None and (of, k) == (INPUTS[kind], own):
            signal = signal + self.across[..., k + 3 * (kind != "gyro")]
        return abs(signal) if name.startswith("|") else signal

    def product(self, names: tuple[str, ...]) -> Float[AnyArray, "U q 1"]:
        """The product of signals; none: 1."""
        if not names:
            return namespace(self.weight).ones((*self.weight.shape, 1))
        product = self.signal(names[0])
        for name in names[1:]:
            product = product * self.signal(name)
        return product[..., None]

    def sums(self, first: Float[AnyArray, "k m a"], second: Float[AnyArray, "U q b"]) -> Float[AnyArray, "k ab"]:
        """Weighted sums over each piece of all products of two sets of functions, the second fastest."""
        xp = namespace(first, second)
        weights = xp.swapaxes(second * self.weight[..., None], -1, -2) @ self.share
        return xp.reshape(
            xp.swapaxes(taken(weights, self.kind) @ first, -1, -2), (first.shape[0], first.shape[2] * second.shape[2])
        )

    def integral(self, values: Float[AnyArray, "U q *s"]) -> Float[AnyArray, " U *s"]:
        """`∫ … dt` over a piece of each kind."""
        xp = namespace(values)
        flat = xp.reshape(values, (*self.weight.shape, -1))
        return xp.reshape((self.weight[:, None, :] @ flat)[:, 0], (values.shape[0], *values.shape[2:]))

    def turned(self, k: int) -> Float[AnyArray, "U q 6"]:
        """Contribution of a small rotation about axis k to rate and force, without its derivative."""
        xp, axis = namespace(self.axes), self.axes[..., k, :]
        return xp.concatenate([cross(self.outer[..., k, :], axis), cross(self.force, axis)], axis=-1)


class BodyNodes(PytreeModule):
    """All nodes of `P` pieces of `K` kinds, and values of each piece for terms that are no integrals.

    For each kind: joint angles `angle_before` (rad) and directions `axes_before` at the begin of its pieces,
    `angle_after` at their end, the `axis` that turns (−1: none) and the `mounting`. `kind`: of every piece, and its
    `temperature_change` K. `temperature_before` °C as a piece begins, and `history` °C: turning points of the
    temperature before the first piece; None where no term depends on the path of temperature. `across_axes`: what the
    gyros sense of these directions by their misalignments; None: nothing.
    """

    groups: tuple[NodeGroup, ...]
    kind: Int[np.ndarray, " P"]
    temperature_change: Float[AnyArray, " P"]
    angle_before: Float[AnyArray, "K L"]
    angle_after: Float[AnyArray, "K L"]
    axes_before: Float[AnyArray, "K L 3"]
    axis: Int[AnyArray, " K"]
    mounting: Int[AnyArray, " K"]
    temperature_before: Float[AnyArray, " P"] | None = None
    history: Float[AnyArray, " H"] | None = None
    across_axes: Float[AnyArray, "K L 3"] | None = None

    def of_kinds(self, of_group, shape: tuple[int, ...]) -> Float[AnyArray, " K *shape"]:
        """`of_group(group) -> (U, *shape)` of every group at its kinds."""
        return placed((len(self.axis), *shape), *((g.kinds, of_group(g)) for g in self.groups))

    def of_pieces(self, of_group, size: int) -> Float[AnyArray, "P size"]:
        """`of_group(group) -> (k, size)` of every group at its pieces."""
        return placed((len(self.kind), size), *((g.pieces, of_group(g)) for g in self.groups))

    def sensed_by(self, kind: str, axis: int) -> "BodyNodes":
        """The nodes as a gyro or accelerometer along the body's axis senses them."""
        return replace(self, groups=tuple(replace(g, channel=(kind, axis)) for g in self.groups))
