"""Nodes: where the errors of a sensor are evaluated and summed, piece by piece. The one place where plan and log meet.

A parameter of the sensor adds `∫ (its function of temperature and rate) dt` to the integrated error of a piece. A plan
integrates on Gauss–Legendre nodes of smooth motion, a log on its samples; the terms of the model are the same functions
of both.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from gradcal_jax.arrays import AnyArray, PytreeModule, cross, namespace, placed, put


class SharedNodes(NamedTuple):
    """Nodes of `k` pieces of `U` kinds: pieces of one kind share their signals and differ in temperature.

    Temperature is smooth along a piece, so functions of it are interpolated from `m` points, and each signal of a kind
    has a weight at each point: `share` `(q, m)` are the interpolating polynomials of the points at the nodes. `time` s
    and `slope` K/s: of each point, for terms of the path of temperature.
    """

    pieces: Int[AnyArray, " k"]
    kind: Int[AnyArray, " k"]
    temperature: Float[AnyArray, "k m"]
    weight: Float[AnyArray, "U q"]
    rate: Float[AnyArray, "U q"]
    signals: dict[str, Float[AnyArray, "U q"]]
    share: Float[np.ndarray, "q m"]
    time: Float[AnyArray, "k m"] | None = None
    slope: Float[AnyArray, "k m"] | None = None

    def signal(self, name: str) -> Float[AnyArray, "U q"]:
        """A signal by its name: "rate x" (rad/s), "force x" (m/s²), "earth x" (rad/s), "up x" and "north x" (components
        of directions); "|rate x|" its magnitude."""
        signal = self.signals[name.strip("|")]
        return abs(signal) if name.startswith("|") else signal

    def product(self, names: tuple[str, ...]) -> Float[AnyArray, "U q 1"]:
        """The product of signals; none: 1."""
        product = namespace(self.weight).ones(self.weight.shape)
        for name in names:
            product = product * self.signal(name)
        return product[..., None]

    def sums(self, first: Float[AnyArray, "k m a"], second: Float[AnyArray, "U q b"]) -> Float[AnyArray, "k ab"]:
        """Weighted sums over each piece of all products of two sets of functions, the second fastest."""
        xp = namespace(first, second)
        weights = xp.swapaxes(second * self.weight[..., None], -1, -2) @ self.share
        return xp.reshape(
            xp.swapaxes(weights[self.kind] @ first, -1, -2), (first.shape[0], first.shape[2] * second.shape[2])
        )


class Nodes(PytreeModule):
    """All nodes of a channel's pieces, and values of each piece for terms that are no integrals.

    `temperature_change` K over the piece. `temperature_before` °C as the piece begins, and `history` °C: turning points
    of the temperature before the first piece; None where no term depends on the path of temperature.
    """

    groups: tuple[SharedNodes, ...]
    temperature_change: Float[AnyArray, " P"]
    temperature_before: Float[AnyArray, " P"] | None = None
    history: Float[AnyArray, " H"] | None = None

    def integrals(self, of_group, size: int) -> Float[AnyArray, "P size"]:
        """`of_group(group) -> (k, size)` of every group at its pieces; zero at pieces without a group."""
        result = namespace(self.temperature_change).zeros((self.temperature_change.shape[0], size))
        for group in self.groups:
            result = put(result, group.pieces, of_group(group))
        return result


class BodyGroup(PytreeModule):
    """Nodes of `U` kinds of pieces of a motion on `L` table axes, in the body's frame, `q` each.

    `kinds`: numbers of the kinds; `pieces`, `kind`, `temperature`, `share`: see `SharedNodes`. `weight` s; `rate` rad/s
    and `force` m/s² in body components, the Earth's rate and gravity in them; `earth` rad/s and `up`, the Earth's rate
    and the vertical; `attitude`: body to East-North-Up. `axes`: the axes' directions; `crosses`: see
    `trajectory.table_motion`; `outer`: the rate of the stage outside each axis; `joint`: rate (rad/s) and `angle` (rad)
    of each axis. `felt`: the force where the gyros are, off the axes, m/s²; None: as `force`. `across`: what each
    sensor senses by its misalignments, gyros first (rad/s, m/s²); None: nothing. `time`, `slope`: see `SharedNodes`.
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

    @property
    def moving(self) -> bool:
        """Whether anything turns; a standing body has a constant attitude and one node."""
        return self.weight.shape[1] > 1

    def turned(self, k: int) -> Float[AnyArray, "U q 6"]:
        """Contribution of a small rotation about axis k to rate and force, without its derivative."""
        xp, axis = namespace(self.axes), self.axes[..., k, :]
        return xp.concatenate([cross(self.outer[..., k, :], axis), cross(self.force, axis)], axis=-1)

    def shared(self, own: str = "rate", index: int = 0) -> SharedNodes:
        """The nodes with the input of a sensor, along its own axis of sensitivity, for the `rate` of a single axis, and
        all components of rate and force as signals."""
        force = self.force if own == "force" or self.felt is None else self.felt
        seen = {
            "rate": self.rate,
            "force": force,
            "earth": self.earth,
            "up": self.up,
            "north": self.attitude[..., 1, :],
        }
        signals = {f"{name} {AXIS_NAMES[k]}": of[..., k] for name, of in seen.items() for k in range(3)}
        name = f"{own} {AXIS_NAMES[index]}"
        if self.across is not None:
            signals[name] = signals[name] + self.across[..., index + 3 * (own == "force")]
        along = signals[name]
        at = self.pieces, self.kind, self.temperature, self.weight
        return SharedNodes(*at, along, signals, self.share, self.time, self.slope)

    def integral(self, values: Float[AnyArray, "U q *s"]) -> Float[AnyArray, " U *s"]:
        """`∫ … dt` over a piece of each kind."""
        xp = namespace(values)
        flat = xp.reshape(values, (*self.weight.shape, -1))
        return xp.reshape((self.weight[:, None, :] @ flat)[:, 0], (values.shape[0], *values.shape[2:]))


class BodyNodes(PytreeModule):
    """All nodes of `P` pieces of `K` kinds. For each kind: joint angles `angle_before` (rad) and directions
    `axes_before` at the begin of its pieces, `angle_after` at their end, the `axis` that turns (−1: none) and the
    `mounting`. `kind`: of every piece. `temperature_before`, `history`: see `Nodes`. `across_axes`: what the gyros
    sense of these directions by their misalignments; None: nothing.
    """

    groups: tuple[BodyGroup, ...]
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

    def integrals(self, of_group, shape: tuple[int, ...]) -> Float[AnyArray, " K *shape"]:
        """`of_group(group) -> (U, *shape)` of every group at its kinds."""
        return placed((len(self.axis), *shape), *((g.kinds, of_group(g)) for g in self.groups))

    def channel(self, kind: str, index: int) -> Nodes:
        """Nodes of a gyro or accelerometer along the body's axis `index`, with the signals of all axes."""
        groups = tuple(g.shared(INPUTS[kind], index) for g in self.groups)
        return Nodes(groups, self.temperature_change, self.temperature_before, self.history)


AXIS_NAMES = ("x", "y", "z")
INPUTS = {"gyro": "rate", "accelerometer": "force"}
