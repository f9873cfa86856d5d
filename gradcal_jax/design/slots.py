"""A cycle of turns and rests as free numbers: any real vector is a cycle within the limits of the table.

A *cycle* is a ring of slots: a turn of one axis, then a rest of the table. Which axis turns in which slot is an
argument of the compiled program, as is whether a slot has a turn and a rest at all: one program serves every cycle of
its number of slots. Turns are free in one of two ways:

| turns by | free numbers | of the time |
|---|---|---|
| pose | the angle that each reaches, the share of its fastest rate | rests share what the turns leave of it |
| time | their share of it, the signed share of the fastest rate in it | turns and rests share it |

By pose a cycle returns to its begin, up to whole turns, and axes of limited travel stay within their reach. An axis
that has the table only in *visits* shares the time of each among the slots of it; other axes turn in between.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from gradcal_jax.arrays import AnyArray

# Turns are the controllers' trapezoids: their shape, and how much steeper than on average their ramps are at most.
SHAPE, STEEPNESS = "linear ramps", 1.0
# A turn below this (rad) has its rate's sign smoothed; a share of the fastest rate that a turn of its angle can reach.
_TINY, _REACHED = 1e-3, 0.9999
# Exponent of the smooth minimum of the two limits of a rate.
_SMOOTH = 8
# s: softness of the time that is left for rests.
_SOFT = 0.5
# Penalty on missing time, as the square of its share of a tenth of the period; on longer turns and rests alike.
_PENALTY = 10.0
# Sizes of a coordinate's unit, so that the objective's curvature is alike in all: of a pose (rad), of the logits of a
# rate's share of its limit, and of a rest's share of the time.
_UNITS = np.array([[4.0], [20.0], [15.0]])
# Shares of a limit at which coordinates begin at most.
_LOW, _HIGH, _NEAR_LIMIT = 0.02, 0.98, 0.999
# Of a turn in visits: the share of its largest rate, and the time (s) beyond the least, at which coordinates begin.
_FULL, _BRIEF = 1.0 - 1e-4, 1e-4


class PoseTurn(NamedTuple):
    """A turn of `axis` (−1: none) by `angle` rad at up to `rate` rad/s, then a rest of `rest` s (0: none)."""

    axis: int
    angle: float
    rate: float
    rest: float


class TableLimits(NamedTuple):
    """Limits of the table's `L` axes and of a cycle.

    `rates` rad/s, `accelerations` rad/s², `reach` `(L, 2)` rad: lowest and highest angle. `start` rad: angles at which
    a cycle begins. `largest` rad: of one turn. `shortest`, `longest` s: rests. `slow` rad/s: up to which accelerometers
    are read on a move. `read_every` s: spacing of the readings of a rest; infinite: one at its end.
    """

    rates: Float[np.ndarray, " L"]
    accelerations: Float[np.ndarray, " L"]
    reach: Float[np.ndarray, "L 2"]
    start: Float[np.ndarray, " L"]
    largest: float
    shortest: float
    longest: float
    slow: float
    read_every: float = math.inf


class CycleStructure(NamedTuple):
    """What is fixed in a cycle of `K` slots: the `axis` of each turn (−1: none), whether it `rests`, whether it is
    `slow`; `before`: the slot of the axis's turn before it (−1: none); `closes`: the last turn of its axis; `whole`
    rad: by which the cycle turns each axis; `period` s; `turnable`: whether poses are free; `timed`: whether turns are
    by time, in visits."""

    axis: Int[AnyArray, " K"]
    rests: Bool[AnyArray, " K"]
    slow: Bool[AnyArray, " K"]
    before: Int[AnyArray, " K"]
    closes: Bool[AnyArray, " K"]
    whole: Float[AnyArray, " L"]
    period: Float[AnyArray, ""]
    turnable: Bool[AnyArray, ""]
    timed: Bool[AnyArray, ""] = np.asarray(False)


class Decoded(NamedTuple):
    """Numbers of a cycle: `angle` rad, peak `rate` rad/s, `ramp` and `turning` s of each turn, `rest` s, and the time
    (s) that rests beyond the shortest have (negative: the turns take too long)."""

    angle: AnyArray
    rate: AnyArray
    ramp: AnyArray
    turning: AnyArray
    rest: AnyArray
    left: AnyArray


def structure_of(
    cycle: Sequence[PoseTurn],
    slots: int,
    limits: TableLimits,
    period: float,
    *,
    closed: bool = True,
    turnable: bool = True,
    timed: bool = False,
) -> CycleStructure:
    """The structure of a cycle of at most `slots` turns, which lasts `period` s. `closed`: it returns to its begin, up
    to whole turns. `turnable`: its poses are free. `timed`: its turns are by time."""
    count, axes = len(cycle), len(limits.rates)
    axis, rests, slow = np.full(slots, -1), np.zeros(slots, bool), np.zeros(slots, bool)
    axis[:count] = [t.axis for t in cycle]
    rests[:count] = [t.rest > 0.0 for t in cycle]
    slow[:count] = [0.0 < t.rate <= limits.slow for t in cycle]
    before, last = np.full(slots, -1), np.full(axes, -1)
    for k in range(count):
        if axis[k] >= 0:
            before[k], last[axis[k]] = last[axis[k]], k
    closes = np.isin(np.arange(slots), last) & closed
    net = np.array([sum(t.angle for t in cycle if t.axis == l) for l in range(axes)])
    free = np.all(np.isinf(limits.reach), axis=1)
    whole = np.where(free, np.round(net / (2.0 * np.pi)) * 2.0 * np.pi, 0.0)
    flags = np.asarray(turnable), np.asarray(timed)
    return CycleStructure(axis, rests, slow, before, closes, whole, np.asarray(period), *flags)


def time_of(t: PoseTurn, limits: TableLimits) -> float:
    """How long (s) a turn takes that is as steep as its axis allows."""
    if t.axis < 0 or not t.angle:
        return 0.0
    steepest = float(limits.accelerations[t.axis]) / STEEPNESS
    rate = min(t.rate, math.sqrt(abs(t.angle) * steepest))
    return abs(t.angle) / rate + rate / steepest


class Visits(NamedTuple):
    """Visits of an axis to its table: to which of them each slot belongs, `group` `(K,)`; the time of each, `own` s;
    after each the `other` time (s) of other axes, of which readings are `every` s apart (infinite: none); and the time
    behind the last, `tail` s. A turn by time takes at least `least` s. All times are longer by a factor `stretch`."""

    group: Int[np.ndarray, " K"]
    own: float
    other: float
    every: float
    tail: float
    least: float
    stretch: float | AnyArray = 1.0

    def waits(self) -> list[tuple[int, float]]:
        """The slot behind which the table is other axes', or stands at the end, and for how long (s)."""
        last = len(self.group) - 1
        between = [(k, self.other) for k in range(last) if self.group[k + 1] != self.group[k] and self.other]
        return between + ([(last, self.tail)] if self.tail else [])


class CycleCoordinates(NamedTuple):
    """`(3, K)` numbers of any size to a cycle of `K` slots within the limits of the table; see the module's head."""

    limits: TableLimits
    slots: int
    visits: Visits | None = None

    @property
    def units(self) -> Float[np.ndarray, "3 1"]:
        """Sizes of the units of a pose, a rate and a rest."""
        return _UNITS if self.visits is None else np.ones((3, 1))

    def encode(self, cycle: Sequence[PoseTurn], of: CycleStructure) -> Float[np.ndarray, "3 K"]:
        """Coordinates of a cycle, moved off the bounds."""
        z, limits = np.zeros((3, self.slots)), self.limits
        here = limits.start.copy()
        for k, t in enumerate(cycle):
            if t.axis >= 0 and of.timed:
                z[:2, k] = self._of_time(t)
            elif t.axis >= 0:
                here[t.axis] += t.angle
                low, high = limits.reach[t.axis]
                if np.isfinite(high):
                    z[0, k] = np.arcsin(np.clip((2.0 * here[t.axis] - low - high) / (high - low), -_HIGH, _HIGH))
                else:
                    z[0, k] = here[t.axis]
                share = t.rate / float(self._fastest(np.hypot(t.angle, _TINY), np.array(t.axis), of.slow[k], np))
                share = np.clip(share, _LOW, _NEAR_LIMIT)
                z[1, k] = np.log(share / (1.0 - share))
            if t.rest > 0.0:
                z[2, k] = np.log(max(t.rest - limits.shortest, _SOFT / 10.0))
        return z / self.units

    def _of_time(self, t: PoseTurn) -> tuple[float, float]:
        """The logarithm of the time of a turn beyond the least, and of its share of the fastest rate in that time."""
        assert self.visits is not None
        rate, steepest = float(self.limits.rates[t.axis]), float(self.limits.accelerations[t.axis]) / STEEPNESS
        lasting = time_of(t, self.limits)
        share = np.copysign(t.rate, t.angle) / min(rate, 0.5 * steepest * lasting) if t.angle else 0.0
        return np.log(max(lasting - self.visits.least, _BRIEF)), np.arctanh(np.clip(share, -_FULL, _FULL))

    def _fastest(self, size, axis, slow, xp):
        """The largest peak rate of turns of a `size` (rad), rad/s."""
        of_axis = xp.asarray(self.limits.rates)[axis]
        of_axis = xp.where(slow, xp.minimum(of_axis, self.limits.slow), of_axis) if self.limits.slow else of_axis
        by_ramps = xp.sqrt(xp.asarray(self.limits.accelerations)[axis] * size / STEEPNESS)
        far = by_ramps / of_axis
        return _REACHED * by_ramps * (1.0 + far**_SMOOTH) ** (-1.0 / _SMOOTH)

    def decode(self, z: Float[AnyArray, "3 K"], of: CycleStructure) -> Decoded:
        """The cycle of coordinates."""
        z, visits, shortest = z * self.units, self.visits, self.limits.shortest
        angle, rate, ramp, turning = self._posed(z, of)
        turns, axis, rests = of.axis >= 0, jnp.maximum(of.axis, 0), of.rests
        if visits is None:
            group, own = np.zeros(self.slots, int), of.period
        else:
            group, own = visits.group, visits.own * visits.stretch
            turning = jnp.where(of.timed & turns, visits.least, turning)
        member = np.arange(group[-1] + 1)[:, None] == group[None]
        least = turning + jnp.where(rests, shortest, 0.0)
        left = own - jnp.sum(jnp.where(member, least[None], 0.0), axis=1)
        room = jnp.where(of.timed, left, _SOFT * jax.nn.softplus(left / _SOFT))
        logits = jnp.stack([jnp.where(turns & of.timed, z[0], -jnp.inf), jnp.where(rests, z[2], -jnp.inf)])
        top = jnp.max(jnp.where(member[:, None], logits[None], -jnp.inf), axis=(1, 2))
        weight = jnp.exp(logits - jnp.where(jnp.isfinite(top), top, 0.0)[None, group])
        whole = jnp.sum(jnp.where(member[:, None], weight[None], 0.0), axis=(1, 2))
        of_turns, of_rests = (room / jnp.where(whole > 0.0, whole, 1.0))[None, group] * weight
        resting = jnp.where(rests, shortest, 0.0) + of_rests
        if visits is not None:
            turning = turning + of_turns
            steepest = jnp.asarray(self.limits.accelerations)[axis] / STEEPNESS
            fastest = jnp.minimum(jnp.asarray(self.limits.rates)[axis], 0.5 * steepest * turning)
            by_time = jnp.where(turns, fastest * jnp.tanh(z[1]), 0.0)
            rate = jnp.where(of.timed, by_time, rate)
            ramp = jnp.where(of.timed, jnp.abs(by_time) / steepest, ramp)
            angle = jnp.where(of.timed, by_time * (turning - ramp), angle)
        return Decoded(angle, rate, ramp, turning, resting, jnp.min(left))

    def _posed(self, z: Float[AnyArray, "3 K"], of: CycleStructure) -> tuple[AnyArray, AnyArray, AnyArray, AnyArray]:
        """Angles, peak rates, and times of the ramps and of the whole of turns by pose."""
        limits, axis = self.limits, jnp.maximum(of.axis, 0)
        low, high = jnp.asarray(limits.reach)[axis].T
        bounded = jnp.isfinite(high)
        at = jnp.where(of.turnable, z[0], jax.lax.stop_gradient(z[0]))
        middle, half = jnp.where(bounded, 0.5 * (low + high), 0.0), jnp.where(bounded, 0.5 * (high - low), 0.0)
        pose = jnp.where(bounded, middle + half * jnp.sin(at), at)
        begin = jnp.asarray(limits.start)[axis]
        pose = jnp.where(of.closes, begin + jnp.asarray(of.whole)[axis], pose)
        angle = jnp.where(of.axis >= 0, pose - jnp.where(of.before >= 0, pose[of.before], begin), 0.0)
        size = jnp.sqrt(angle**2 + _TINY**2)
        rate = jax.nn.sigmoid(z[1]) * self._fastest(size, axis, of.slow, jnp)
        return angle, rate * angle / size, *self._times(size, rate, of)

    def _times(self, size: AnyArray, rate: AnyArray, of: CycleStructure) -> tuple[AnyArray, AnyArray]:
        """Seconds of the ramps and of the whole turns, as steep as the axes allow."""
        steepest = jnp.asarray(self.limits.accelerations)[jnp.maximum(of.axis, 0)]
        ramp = jnp.where(of.axis >= 0, STEEPNESS * rate / steepest, 0.0)
        return ramp, jnp.where(of.axis >= 0, size / rate + ramp, 0.0)

    def penalty(self, of: Decoded, period: AnyArray) -> AnyArray:
        """What a cycle beyond its limits adds to the objective."""
        long = jnp.maximum(jnp.abs(of.angle) - self.limits.largest, 0.0) / self.limits.largest
        rests = jnp.maximum(of.rest - self.limits.longest, 0.0) / self.limits.longest
        missing = jnp.minimum(of.left, 0.0) / (0.1 * period)
        return _PENALTY * (missing**2 + jnp.sum(long**2) + jnp.sum(rests**2))

    def cycle(self, z: Float[np.ndarray, "3 K"], of: CycleStructure) -> tuple[PoseTurn, ...]:
        """The cycle of coordinates, without its empty slots; in visits, where a slot has its place, with them."""
        return self.cycle_of(self.decode(jnp.asarray(z), of), of)

    def cycle_of(self, decoded: Decoded, of: CycleStructure) -> tuple[PoseTurn, ...]:
        """The same of decoded coordinates."""
        angle, rate, _, _, rests, _ = (np.asarray(x) for x in decoded)
        turns = (
            PoseTurn(int(l), float(a), float(abs(w)), float(r))
            for l, a, w, r in zip(np.asarray(of.axis), angle, rate, rests, strict=True)
        )
        return tuple(t for t in turns if t.axis >= 0 or t.rest > 0.0 or self.visits is not None)
