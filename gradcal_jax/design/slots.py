"""A cycle of turns and rests as free numbers: any real vector is a cycle within the limits of the table.

A *cycle* is a ring of slots: a turn of one axis, then a rest of the table. Which axis turns in which slot is an
argument of the compiled program, as is whether a slot has a turn and a rest at all: one program serves every cycle of
its number of slots. The axes have the table in *visits*, of which each has its time and its slots; an IMU has it all
the time. Turns are free in one of two ways:

| turns by | free numbers | of the visit's time |
|---|---|---|
| pose | the angle that each reaches, the share of its fastest rate | rests share what the turns leave of it |
| time | their share of it, the signed share of the fastest rate in it | turns and rests share it |

By pose a cycle returns to its begin, up to whole turns, and axes of limited travel stay within their reach.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from gradcal_jax.arrays import AnyArray, namespace

# The shape of turns: the controllers' trapezoids, as steep as the axis allows.
SHAPE = "linear ramps"
# Shortest useful turn; s.
LEAST_TURN = 1.0
# A turn below this (rad) has its rate's sign smoothed; a share of the fastest rate that a turn of its angle can reach.
_TINY, _REACHED = 1e-3, 0.9999
# Exponent of the smooth minimum of the two limits of a rate.
_SMOOTH = 8
# s: softness of the time that is left for rests.
_SOFT = 0.5
# Penalty on missing time, as the square of its share of a tenth of the visit; on longer turns and rests alike.
_PENALTY = 10.0
# Sizes of a coordinate's unit, so that the objective's curvature is alike in all: of a pose (rad), of the logits of a
# rate's share of its limit, and of a rest's share of the time.
_UNITS = np.array([[4.0], [20.0], [15.0]])
# Shares of a limit at which coordinates begin at most.
_LOW, _HIGH, _NEAR_LIMIT = 0.02, 0.98, 0.999
# Of a turn by time: the share of its largest rate, and the time (s) beyond the least, at which coordinates begin.
_FULL, _BRIEF = 1.0 - 1e-4, 1e-4


class SlotTurn(NamedTuple):
    """A turn of `axis` (−1: none) by `angle` rad at up to `rate` rad/s, then a rest of `rest` s (0: none)."""

    axis: int
    angle: float
    rate: float
    rest: float


Cycle = tuple[SlotTurn, ...]
EMPTY = SlotTurn(-1, 0.0, 0.0, 0.0)


class TableLimits(NamedTuple):
    """Limits of the table's `L` axes and of a cycle.

    `rates` rad/s, `accelerations` rad/s², `reach` `(L, 2)` rad: lowest and highest angle. `start` rad: angles at which
    a cycle begins. `largest` rad: of one turn. `shortest`, `longest` s: rests. `read_every` s: spacing of the readings
    of a rest; infinite: one at its end.
    """

    rates: Float[np.ndarray, " L"]
    accelerations: Float[np.ndarray, " L"]
    reach: Float[np.ndarray, "L 2"]
    start: Float[np.ndarray, " L"]
    largest: float
    shortest: float
    longest: float
    read_every: float = math.inf

    def time_of(self, t: SlotTurn) -> float:
        """How long (s) a turn takes that is as steep as its axis allows."""
        if t.axis < 0 or not t.angle:
            return 0.0
        steepest = float(self.accelerations[t.axis])
        rate = min(t.rate, math.sqrt(abs(t.angle) * steepest))
        return abs(t.angle) / rate + rate / steepest


class Visits(NamedTuple):
    """To which visit each slot belongs, `group` `(K,)`; the time of each, `own` s; after each but the last the `other`
    time (s) of other axes, of which readings are `every` s apart (infinite: none); and the time behind the last,
    `tail` s."""

    group: Int[np.ndarray, " K"]
    own: float
    other: float = 0.0
    every: float = math.inf
    tail: float = 0.0

    @property
    def number(self) -> int:
        """How many visits a cycle has."""
        return int(self.group[-1]) + 1

    @property
    def period(self) -> float:
        """From the begin of a cycle to that of the next (s)."""
        return self.number * self.own + (self.number - 1) * self.other + self.tail

    def waits(self) -> Float[np.ndarray, " K"]:
        """For how long (s) other axes have the table behind each slot."""
        last = np.diff(self.group, append=-1) != 0
        return np.where(last, np.append(np.full(len(last) - 1, self.other), self.tail), 0.0)


class Structure(NamedTuple):
    """What is fixed in a cycle of `K` slots: the `axis` of each turn (−1: none), whether it `rests`; `before`: the slot
    of the axis's turn before it (−1: none); `closes`: the last turn of its axis; `whole` rad: by which a cycle turns
    each axis."""

    axis: Int[AnyArray, " K"]
    rests: Bool[AnyArray, " K"]
    before: Int[AnyArray, " K"]
    closes: Bool[AnyArray, " K"]
    whole: Float[AnyArray, " L"]


class Decoded(NamedTuple):
    """Numbers of a cycle: `angle` rad, peak `rate` rad/s, `ramp` and `turning` s of each turn, `rest` s, and the time
    (s) that rests beyond the shortest have (negative: the turns take too long)."""

    angle: AnyArray
    rate: AnyArray
    ramp: AnyArray
    turning: AnyArray
    rest: AnyArray
    left: AnyArray


class CycleCoordinates(NamedTuple):
    """`(3, K)` numbers of any size to a cycle of `K` slots within the limits of the table; see the module's head.
    `timed`: turns are by time. `closed`: by pose, a cycle returns to its begin, up to whole turns."""

    limits: TableLimits
    visits: Visits
    timed: bool = False
    closed: bool = True

    @property
    def slots(self) -> int:
        """K."""
        return len(self.visits.group)

    @property
    def units(self) -> Float[np.ndarray, "3 1"]:
        """Sizes of the units of a pose, a rate and a rest."""
        return _UNITS if self.visits.number == 1 and not self.timed else np.ones((3, 1))

    def structure(self, cycle: Sequence[SlotTurn]) -> Structure:
        """The structure of a cycle of at most `K` turns."""
        slots, axes = self.slots, len(self.limits.rates)
        axis, rests = np.full(slots, -1), np.zeros(slots, bool)
        axis[: len(cycle)] = [t.axis for t in cycle]
        rests[: len(cycle)] = [t.rest > 0.0 for t in cycle]
        before, last = np.full(slots, -1), np.full(axes, -1)
        for k in np.flatnonzero(axis >= 0):
            before[k], last[axis[k]] = last[axis[k]], k
        closes = np.isin(np.arange(slots), last) & self.closed
        net = np.array([sum(t.angle for t in cycle if t.axis == l) for l in range(axes)])
        free = np.all(np.isinf(self.limits.reach), axis=1)
        whole = np.where(free, np.round(net / (2.0 * np.pi)) * 2.0 * np.pi, 0.0)
        return Structure(axis, rests, before, closes, whole)

    def encode(self, cycle: Sequence[SlotTurn]) -> Float[np.ndarray, "3 K"]:
        """Coordinates of a cycle, moved off the bounds."""
        z, limits = np.zeros((3, self.slots)), self.limits
        here = limits.start.copy()
        for k, t in enumerate(cycle):
            if t.axis >= 0 and self.timed:
                z[:2, k] = self._of_time(t)
            elif t.axis >= 0:
                here[t.axis] += t.angle
                low, high = limits.reach[t.axis]
                z[0, k] = here[t.axis]
                if np.isfinite(high):
                    z[0, k] = np.arcsin(np.clip((2.0 * here[t.axis] - low - high) / (high - low), -_HIGH, _HIGH))
                share = t.rate / float(self._fastest(np.hypot(t.angle, _TINY), np.array(t.axis), np))
                share = np.clip(share, _LOW, _NEAR_LIMIT)
                z[1, k] = np.log(share / (1.0 - share))
            if t.rest > 0.0:
                z[2, k] = np.log(max(t.rest - limits.shortest, _SOFT / 10.0))
        return z / self.units

    def _of_time(self, t: SlotTurn) -> tuple[float, float]:
        """The logarithm of the time of a turn beyond the least, and of its share of the fastest rate in that time."""
        rate, steepest = float(self.limits.rates[t.axis]), float(self.limits.accelerations[t.axis])
        lasting = self.limits.time_of(t)
        share = np.copysign(t.rate, t.angle) / min(rate, 0.5 * steepest * lasting) if t.angle else 0.0
        return np.log(max(lasting - LEAST_TURN, _BRIEF)), np.arctanh(np.clip(share, -_FULL, _FULL))

    def _fastest(self, size, axis, xp):
        """The largest peak rate of turns of a `size` (rad), rad/s."""
        by_ramps = xp.sqrt(xp.asarray(self.limits.accelerations)[axis] * size)
        far = by_ramps / xp.asarray(self.limits.rates)[axis]
        return _REACHED * by_ramps * (1.0 + far**_SMOOTH) ** (-1.0 / _SMOOTH)

    def decode(self, z: Float[AnyArray, "3 K"], of: Structure) -> Decoded:
        """The cycle of coordinates."""
        xp, z, turns = namespace(z, of), z * self.units, of.axis >= 0
        if self.timed:
            least = xp.where(turns, LEAST_TURN, 0.0)
            left, (more, rest) = self._shared(least, z, of)
            turning = least + more
            steepest = xp.asarray(self.limits.accelerations)[xp.maximum(of.axis, 0)]
            fastest = xp.minimum(xp.asarray(self.limits.rates)[xp.maximum(of.axis, 0)], 0.5 * steepest * turning)
            rate = xp.where(turns, fastest * xp.tanh(z[1]), 0.0)
            ramp = xp.abs(rate) / steepest
            return Decoded(rate * (turning - ramp), rate, ramp, turning, rest, left)
        angle, rate, ramp, turning = self._posed(z, of)
        left, (_, rest) = self._shared(turning, z, of)
        return Decoded(angle, rate, ramp, turning, rest, left)

    def _shared(self, least: AnyArray, z: AnyArray, of: Structure) -> tuple[Any, AnyArray]:
        """The time that is left in a visit beside turns that last at `least` so long (s), of the fullest one; and what
        turns by time get of it beyond that, and rests in all, `(2, K)`."""
        xp, group = namespace(z, of), self.visits.group
        shortest = xp.where(of.rests, self.limits.shortest, 0.0)
        member = np.arange(self.visits.number)[:, None] == group[None]
        left = self.visits.own - xp.sum(xp.where(member, (least + shortest)[None], 0.0), axis=1)
        room = left if self.timed else _SOFT * xp.logaddexp(left / _SOFT, 0.0)
        logits = xp.stack([xp.where((of.axis >= 0) & self.timed, z[0], -xp.inf), xp.where(of.rests, z[2], -xp.inf)])
        top = xp.max(xp.where(member[:, None], logits[None], -xp.inf), axis=(1, 2))
        weight = xp.exp(logits - xp.where(xp.isfinite(top), top, 0.0)[group][None])
        whole = xp.sum(xp.where(member[:, None], weight[None], 0.0), axis=(1, 2))
        shared = (room / xp.where(whole > 0.0, whole, 1.0))[group][None] * weight
        return xp.min(left), shared + xp.stack([xp.zeros_like(shortest), shortest])

    def _posed(self, z: Float[AnyArray, "3 K"], of: Structure) -> tuple[AnyArray, AnyArray, AnyArray, AnyArray]:
        """Angles, peak rates, and times of the ramps and of the whole of turns by pose."""
        xp, limits, turns = namespace(z, of), self.limits, of.axis >= 0
        axis = xp.maximum(of.axis, 0)
        low, high = xp.asarray(limits.reach)[axis].T
        bounded = xp.isfinite(high)
        middle, half = xp.where(bounded, 0.5 * (low + high), 0.0), xp.where(bounded, 0.5 * (high - low), 0.0)
        pose = xp.where(bounded, middle + half * xp.sin(z[0]), z[0])
        begin = xp.asarray(limits.start)[axis]
        pose = xp.where(of.closes, begin + xp.asarray(of.whole)[axis], pose)
        angle = xp.where(turns, pose - xp.where(of.before >= 0, pose[of.before], begin), 0.0)
        size = xp.sqrt(angle**2 + _TINY**2)
        rate = xp.exp(-xp.logaddexp(-z[1], 0.0)) * self._fastest(size, axis, xp)
        ramp = xp.where(turns, rate / xp.asarray(limits.accelerations)[axis], 0.0)
        return angle, rate * angle / size, ramp, xp.where(turns, size / rate + ramp, 0.0)

    def penalty(self, of: Decoded) -> AnyArray:
        """What a cycle beyond its limits adds to the objective."""
        long = jnp.maximum(jnp.abs(of.angle) - self.limits.largest, 0.0) / self.limits.largest
        rests = jnp.maximum(of.rest - self.limits.longest, 0.0) / self.limits.longest
        missing = jnp.minimum(of.left, 0.0) / (0.1 * self.visits.period)
        return _PENALTY * (missing**2 + jnp.sum(long**2) + jnp.sum(rests**2))

    def cycle(self, decoded: Decoded, of: Structure) -> Cycle:
        """The cycle of decoded coordinates; of several visits, where a slot has its place, with its empty slots."""
        angle, rate, _, _, rests, _ = (np.asarray(x) for x in decoded)
        turns = (
            SlotTurn(int(l), float(a), float(abs(w)), float(r))
            for l, a, w, r in zip(np.asarray(of.axis), angle, rate, rests, strict=True)
        )
        placed = self.visits.number > 1 or self.timed
        return tuple(t for t in turns if placed or t.axis >= 0 or t.rest > 0.0)
