"""A cycle of poses, turns and rests as continuous coordinates, and its objective, traced by JAX.

A *cycle* is a ring of slots: a turn of one axis, then a rest of the table. It returns to its first pose up to whole
turns, so that it repeats. Free are the pose that every turn reaches, its peak rate, and the rests, which share the time
that the turns leave of a cycle's period. Which axis turns in which slot is an argument of the compiled program, as is
whether a slot has a turn and a rest at all: one program serves every cycle of its number of slots.

On a ramp of constant slope cycles differ in temperature alone, and a polynomial at a shifted temperature is a
polynomial: the columns of a cycle are those of another times one small matrix S. What a cycle adds when the W − 1
before it are known is

    D = G_W − G_(W−1)                    G_k: information of the first k cycles,

and with J cycles the information is `G_(W−1) + Σ_j S_jᵀ D S_j`, j = 0 … J − W: exact for noise that W cycles forget.
As S is a polynomial of j, its singular values over j leave degree + 1 products in place of J.
"""

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from gradcal_jax.arrays import AnyArray
from gradcal_jax.design.criteria import largest, smooth_statistic
from gradcal_jax.information import gram, imu_system, segments_of
from gradcal_jax.information.imu_rows import Segments
from gradcal_jax.information.noise_steps import NoiseSteps
from gradcal_jax.information.residual import Statistic
from gradcal_jax.model import ImuModel
from gradcal_jax.motion import Geometry, Schedule, TableMotion, body_nodes, gradient_plan, programme
from gradcal_jax.motion.motion import rest, turn
from gradcal_jax.motion.table_motion import largest_turn, nodes_of_turn

# Cycles whose noise is filtered together: with two, standard deviations agree with those of all cycles to about 1e-3.
WINDOW = 2
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
# Numbers of quadrature nodes.
_NODES = (16, 24, 32, 48, 64, 96, 128, 192, 256, 384, 512)
# Sizes of a coordinate's unit, so that the objective's curvature is alike in all: of a pose (rad), of the logits of a
# rate's share of its limit, and of a rest's share of the time.
_UNITS = np.array([[4.0], [20.0], [15.0]])
# Readings that stand for all those of a rest in a search, each with the weight of its share of them.
READINGS_OF_A_REST = 2
# Sharpness at which the number of readings of a rest is halfway between a smooth and a whole number.
# Beyond the largest one the slope of the number is not finite.
_SHARP_COUNT, _SHARPEST = 1e3, 1e9
# Relative and absolute rounding of a number of readings.
_ROUNDING = 1e-9
# What a limit that is exceeded costs, in multiples of the logarithm of what it leaves over its target: more than any
# limit's price, so that the optimum keeps all.
EXCESS = 10.0
# The objective of a cycle that has none.
_NOWHERE = 1e3
# Shares of a limit at which coordinates begin at most.
_LOW, _HIGH, _NEAR_LIMIT = 0.02, 0.98, 0.999


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


class Ramp(NamedTuple):
    """A part of the plan with one slope: `begins` °C, `slope` K/s, `mounting`. Its information is `first` times that of
    the first W − 1 cycles, and `Σ_d F_dᵀ D F_d` with F the matrices `further`. `elapsed` s since power-on; `history` °C
    and `behind` K: as of a `TableMotion`."""

    begins: Float[AnyArray, ""]
    slope: Float[AnyArray, ""]
    mounting: Int[AnyArray, ""]
    first: Float[AnyArray, ""]
    further: Float[AnyArray, "d p p"]
    elapsed: float | Float[AnyArray, ""] = 0.0
    history: Float[AnyArray, " H"] = np.zeros(0)
    behind: Float[AnyArray, " O"] = np.zeros(0)


class CycleStructure(NamedTuple):
    """What is fixed in a cycle of `K` slots: the `axis` of each turn (−1: none), whether it `rests`, whether it is
    `slow`; `before`: the slot of the axis's turn before it (−1: none); `closes`: the last turn of its axis; `whole`
    rad: by which the cycle turns each axis; `period` s; `turnable`: whether poses are free."""

    axis: Int[AnyArray, " K"]
    rests: Bool[AnyArray, " K"]
    slow: Bool[AnyArray, " K"]
    before: Int[AnyArray, " K"]
    closes: Bool[AnyArray, " K"]
    whole: Float[AnyArray, " L"]
    period: Float[AnyArray, ""]
    turnable: Bool[AnyArray, ""]


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
) -> CycleStructure:
    """The structure of a cycle of at most `slots` turns, which lasts `period` s. `closed`: it returns to its begin, up
    to whole turns. `turnable`: its poses are free."""
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
    return CycleStructure(axis, rests, slow, before, closes, whole, np.asarray(period), np.asarray(turnable))


def nodes_for(turned: float, waves: int) -> int:
    """Quadrature nodes for a piece that turns so far (rad), with waves of so many cycles a turn."""
    (least,) = nodes_of_turn(np.array([turned]), waves)
    return next((n for n in _NODES if n >= least), _NODES[-1])


def largest_alike(least: float, waves: int) -> float:
    """The largest turn (rad) for which the nodes suffice that a turn of `least` needs."""
    return largest_turn(nodes_for(least, waves), waves)


class CycleCoordinates(NamedTuple):
    """`(3, K)` numbers of any size to a cycle of `K` slots within the limits of the table."""

    limits: TableLimits
    slots: int

    def encode(self, cycle: Sequence[PoseTurn], of: CycleStructure) -> Float[np.ndarray, "3 K"]:
        """Coordinates of a cycle, moved off the bounds."""
        z, limits = np.zeros((3, self.slots)), self.limits
        here = limits.start.copy()
        for k, t in enumerate(cycle):
            if t.axis >= 0:
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
        return z / _UNITS

    def _fastest(self, size, axis, slow, xp):
        """The largest peak rate of turns of a `size` (rad), rad/s."""
        of_axis = xp.asarray(self.limits.rates)[axis]
        of_axis = xp.where(slow, xp.minimum(of_axis, self.limits.slow), of_axis) if self.limits.slow else of_axis
        by_ramps = xp.sqrt(xp.asarray(self.limits.accelerations)[axis] * size / STEEPNESS)
        far = by_ramps / of_axis
        return _REACHED * by_ramps * (1.0 + far**_SMOOTH) ** (-1.0 / _SMOOTH)

    def decode(self, z: Float[AnyArray, "3 K"], of: CycleStructure) -> Decoded:
        """The cycle of coordinates."""
        limits, turns, z = self.limits, of.axis >= 0, z * _UNITS
        axis = jnp.maximum(of.axis, 0)
        low, high = jnp.asarray(limits.reach)[axis].T
        bounded = jnp.isfinite(high)
        at = jnp.where(of.turnable, z[0], jax.lax.stop_gradient(z[0]))
        middle, half = jnp.where(bounded, 0.5 * (low + high), 0.0), jnp.where(bounded, 0.5 * (high - low), 0.0)
        pose = jnp.where(bounded, middle + half * jnp.sin(at), at)
        begin = jnp.asarray(limits.start)[axis]
        pose = jnp.where(of.closes, begin + jnp.asarray(of.whole)[axis], pose)
        angle = jnp.where(turns, pose - jnp.where(of.before >= 0, pose[of.before], begin), 0.0)
        size = jnp.sqrt(angle**2 + _TINY**2)
        rate = jax.nn.sigmoid(z[1]) * self._fastest(size, axis, of.slow, jnp)
        ramp, turning = self._times(size, rate, of)
        left = of.period - jnp.sum(turning) - limits.shortest * jnp.sum(jnp.where(of.rests, 1.0, 0.0))
        shares = jax.nn.softmax(jnp.where(of.rests, z[2], -jnp.inf))
        shares = jnp.where(of.rests, shares, 0.0)
        rests = jnp.where(of.rests, limits.shortest, 0.0) + _SOFT * jax.nn.softplus(left / _SOFT) * shares
        return Decoded(angle, rate * angle / size, ramp, turning, rests, left)

    def plain(self, angle: Float[AnyArray, " m"], rate, rest, of: CycleStructure) -> Decoded:
        """The cycle of its own numbers (rad, rad/s, s): `m` turns by an angle with a peak rate, each with a rest after
        it; all rests are in proportion to these, and fill the period."""
        fill = (0, self.slots - angle.shape[0])
        angle, rate, rest = (jnp.pad(x, fill, constant_values=c) for x, c in ((angle, 0.0), (rate, 1.0), (rest, 0.0)))
        size = jnp.sqrt(angle**2 + _TINY**2)
        ramp, turning = self._times(size, rate, of)
        left, rest = of.period - jnp.sum(turning), jnp.where(of.rests, rest, 0.0)
        return Decoded(angle, rate * angle / size, ramp, turning, rest * (left / jnp.sum(rest)), left)

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
        """The cycle of coordinates, without its empty slots."""
        angle, rate, _, _, rests, _ = (np.asarray(x) for x in self.decode(jnp.asarray(z), of))
        turns = (
            PoseTurn(int(l), float(a), float(abs(w)), float(r))
            for l, a, w, r in zip(np.asarray(of.axis), angle, rate, rests, strict=True)
        )
        return tuple(t for t in turns if t.axis >= 0 or t.rest > 0.0)


class GridElement(NamedTuple):
    """A linear function of the parameters on a grid: `rows` `(g, k)` of the parameters `where`; the variance `added` to
    its own, less that of `alone`. `path` `(s, g, k)`: added to the rows in each state of the service, of which the
    worst counts."""

    where: slice
    rows: AnyArray
    alone: AnyArray | None
    added: AnyArray
    path: AnyArray | None = None


class Statistics(NamedTuple):
    """How a requirement sums up its elements on a grid of `shape`, in SI; `together`: their root mean square counts,
    not the worst."""

    elements: tuple[GridElement, ...]
    shape: tuple[int, int]
    kind: Statistic
    together: bool

    def __call__(self, info: AnyArray, covariance: AnyArray, sharpness) -> AnyArray:
        del info
        each = []
        for e in self.elements:
            c = covariance[e.where, e.where]
            states = [e.rows] if e.path is None else [e.rows + state for state in np.asarray(e.path)]
            each_state = [jnp.sum((rows @ c) * rows, axis=1) for rows in states]
            variance = each_state[0] if len(states) == 1 else jnp.max(jnp.stack(each_state), axis=0)
            variance = variance + e.added
            if e.alone is not None:
                variance = variance - jnp.sum((e.alone @ c) * e.alone, axis=1)
            each.append(smooth_statistic(self.kind, jnp.reshape(jnp.sqrt(variance), self.shape), sharpness))
        together = jnp.stack(each)
        return jnp.sqrt(jnp.mean(together**2)) if self.together else _largest(together, sharpness)


class CycleObjective:
    """The logarithm of a cycle's residuals over their `targets` (SI): their mean or the worst, over `models` of the
    noise likewise, in a mean with their `weights` (`of_logs`, else of the residuals); and `EXCESS` times what the
    `limiting` ones exceed. `known`: for each model, the information before the plan begins; `geometries`: its table and
    mountings.
    `readings`: how many stand for all those of a rest.

    With a sharpness that is the number `math.inf` the readings of rests are those of a prediction. With any other one a
    few readings stand for them, of which the number is smooth, too: it grows with the rest.

    Programs take targets as arguments, so that plans for other targets need none of their own."""

    def __init__(
        self,
        coordinates: CycleCoordinates,
        geometries: Sequence[Geometry],
        models: Sequence[ImuModel],
        known: Sequence[Float[np.ndarray, "p p"]],
        statistics: Sequence[Statistics],
        limiting: Sequence[Statistics],
        targets: Float[np.ndarray, " m"],
        *,
        weights: Float[np.ndarray, " s"],
        of_logs: bool,
        window: int,
        points: int,
        waves: int,
        readings: int,
        worst: bool,
        worst_model: bool,
    ) -> None:
        self.coordinates, self.models, self.known = coordinates, models, known
        self.geometries = [jax.tree.map(jnp.asarray, geometry) for geometry in geometries]
        self.statistics, self.window, self.points = (*statistics, *limiting), window, points
        self.targets, self.minimised, self.weights, self.of_logs = targets, len(statistics), weights, of_logs
        self.waves, self.worst, self.worst_model = waves, worst, worst_model
        self.readings = readings if math.isfinite(coordinates.limits.read_every) else 1

    def without_targets(self) -> "CycleObjective":
        """The same with targets of 1, for programs that take them as arguments."""
        same = copy(self)
        same.targets = np.ones(len(self.targets))
        return same

    def value(
        self,
        z: Float[AnyArray, "3 K"],
        of: CycleStructure,
        ramps: Ramp,
        sharpness,
        targets: Float[AnyArray, " m"] | None = None,
        coordinates: CycleCoordinates | None = None,
    ) -> Float[AnyArray, ""]:
        """The objective of a cycle on stacked `ramps`; where it has no value, a large one. `coordinates`: of other
        limits than those of the search."""
        coordinates = coordinates or self.coordinates
        decoded = coordinates.decode(z, of)
        logs = self.logs(decoded, of, ramps, sharpness, targets)
        logs, beyond = logs[:, : self.minimised], logs[:, self.minimised :]
        each = largest_log(logs, sharpness, axis=1) if self.worst else jnp.mean(logs, axis=1)
        if self.worst_model:
            total = largest_log(each, sharpness, axis=0)
        elif self.of_logs:
            total = jnp.dot(self.weights, each)
        else:
            total = jax.scipy.special.logsumexp(each, b=self.weights)
        # From above, as all that is sharp: a limit is kept with a little room.
        total = total + EXCESS * jnp.sum(largest_log(jnp.stack([beyond, jnp.zeros_like(beyond)]), sharpness, axis=0))
        total = total + coordinates.penalty(decoded, of.period)
        return jnp.where(jnp.isfinite(total), total, _NOWHERE)

    def logs(
        self,
        decoded: Decoded,
        of: CycleStructure,
        ramps: Ramp,
        sharpness,
        targets: Float[AnyArray, " m"] | None = None,
    ) -> Float[AnyArray, "s m"]:
        """The logarithm of every statistic over its target in every model of the noise."""
        over = jnp.asarray(self.targets if targets is None else targets)
        all_logs, each = [], []
        for model, geometry, known in zip(self.models, self.geometries, self.known, strict=True):
            on_ramp = partial(self.information, model, geometry, decoded, of, sharpness=sharpness)
            each.append(known + jnp.sum(jax.lax.map(on_ramp, ramps), axis=0))
        for info in each:
            covariance = inverse(info)
            all_logs.append(jnp.log(jnp.stack([s(info, covariance, sharpness) for s in self.statistics]) / over))
        return jnp.stack(all_logs)

    def information(
        self, model: ImuModel, geometry: Geometry, decoded: Decoded, of: CycleStructure, ramp: Ramp, *, sharpness
    ) -> Float[AnyArray, "p p"]:
        """The information of all cycles on one ramp."""
        motion, at = self._motion(ramp, decoded, of, model, geometry, sharpness)
        steps, columns = imu_system(motion, model, body_nodes(motion, self.points), at)
        if self.window == 1:
            return gram(steps, columns)
        rows = columns.shape[0] // self.window * (self.window - 1)
        fewer = NoiseSteps(*(x if x is None or x is steps.initial else x[:rows] for x in steps))
        first = gram(fewer, columns[:rows])
        added = gram(steps, columns) - first
        return ramp.first * first + jnp.sum(jnp.swapaxes(ramp.further, 1, 2) @ (added @ ramp.further), axis=0)

    def _motion(
        self, ramp: Ramp, decoded: Decoded, of: CycleStructure, model: ImuModel, geometry: Geometry, sharpness
    ) -> tuple[TableMotion, Segments]:
        k, window = self.coordinates.slots, self.window
        limits = self.coordinates.limits
        rests = self._rests(decoded.rest, sharpness)
        moves = []
        for _ in range(k):
            moves.append(turn(SHAPE, 1.0, 4.0, ramp=1.0))
            moves += [rest(1.0, read_at_end=True)] * rests.duration.shape[1]
        # Only what is discrete is taken from this schedule; all its numbers are replaced.
        whole = math.fsum(move.duration for move in moves)
        line = gradient_plan(programme(0.0, [(whole * window, 0.0)]), tuple(moves), read_every=None)
        none = jnp.zeros(rests.duration.shape)
        numbers = [
            jnp.reshape(jnp.concatenate([of_turn[:, None], of_rests], axis=1), (-1,))
            for of_turn, of_rests in (
                (decoded.turning, rests.duration),
                (decoded.rate, none),
                (decoded.ramp, none),
            )
        ]
        course = replace(
            line.programme,
            start=ramp.begins,
            durations=jnp.reshape(window * of.period, (1,)),
            slopes=jnp.reshape(ramp.slope, (1,)),
        )
        of_line = replace(line, duration=numbers[0], peak_rate=numbers[1], ramp=numbers[2], programme=course)
        move = np.asarray(line.pieces.move)
        share = jnp.reshape(jnp.concatenate([jnp.ones((k, 1)), rests.share], axis=1), (-1,))[move]
        track = replace(of_line.trajectory(None), share=share)
        count = len(move) // window
        each = 1 + rests.duration.shape[1]
        slot, turns = move // each, move % each == 0
        axis = jnp.where(turns, of.axis[slot], -1)
        example = np.arange(count)
        kind = np.arange(len(move)) % count
        nodes = self._nodes(turns[:count], np.asarray(line.pieces.varying)[:count])
        mounting = jnp.full(len(move), ramp.mounting)
        history = None
        if ramp.history.shape[0]:
            history, track = ramp.history, replace(track, start=track.start + ramp.elapsed)
        start = np.asarray(limits.start)
        path = history, model.others, ramp.behind
        motion = TableMotion(track, axis, mounting, geometry, start, kind, example, nodes, *path)
        return motion, self._segments(line, turns, slot, track.duration, of, model)

    def _rests(self, rest: Float[AnyArray, " K"], sharpness) -> "_Rests":
        """The rests of a cycle, divided at their readings, of which the last one is at the end of the rest."""
        every = self.coordinates.limits.read_every
        if math.isinf(every):
            return _Rests(rest[:, None], jnp.ones((len(rest), 1)))
        if _is_exact(sharpness):
            most = math.floor(self.coordinates.limits.longest / every + 1.0)
            count = jnp.minimum(jnp.floor(rest / every * (1.0 + _ROUNDING) + _ROUNDING), float(most))
            spaced = jnp.where(np.arange(most, dtype=float)[None] < count[:, None], every, 0.0)
            left = rest - count * every
            left = jnp.where(left > _ROUNDING * rest, left, 0.0)
            duration = jnp.concatenate([spaced, left[:, None]], axis=1)
            return _Rests(duration, jnp.ones(duration.shape))
        count = _soft_count(rest / every, sharpness)
        share = jnp.tile(count[:, None] / self.readings, (1, self.readings))
        return _Rests(jnp.tile(rest[:, None] / self.readings, (1, self.readings)), share)

    def _nodes(self, turns: np.ndarray, varying: np.ndarray) -> np.ndarray:
        """Quadrature nodes of the pieces of a cycle."""
        limits = self.coordinates.limits
        in_ramp = float(np.max(STEEPNESS * limits.rates**2 / (2.0 * limits.accelerations)))
        ramps, flat = (nodes_for(turned, self.waves) for turned in (in_ramp, limits.largest))
        return np.where(~turns, 1, np.where(varying, ramps, flat))

    def _segments(
        self,
        line: Schedule,
        turns: np.ndarray,
        slot_of_piece: np.ndarray,
        duration: Float[AnyArray, " P"],
        of: CycleStructure,
        model: ImuModel,
    ) -> Segments:
        """The segments and rows of the cycles; those of empty slots, or without any time, are not used."""
        moving = replace(line, peak_rate=np.where(np.asarray(line.peak_rate) > 0.0, self.coordinates.limits.slow, 0.0))
        still = moving.trajectory(None)
        each = np.arange(len(turns))
        plain = TableMotion(
            still, np.where(turns, 0, -1), np.zeros(len(turns), int), self.geometries[0],
            np.asarray(self.coordinates.limits.start), each, each, each,
        )  # fmt: skip
        at = segments_of(plain, model)
        slot = slot_of_piece[at.first]
        moves = at.axis >= 0
        axis = jnp.where(moves, of.axis[slot], -1)
        there = jnp.where(moves, of.axis[slot] >= 0, of.rests[slot])
        there = there & (at.sums(duration) > 0.0)
        used = jnp.asarray(at.used) & there[at.row_segment]
        forces = np.array([c.kind != "gyro" for c in model.channels])[at.row_channel] & moves[at.row_segment]
        used = used & (~forces | of.slow[slot[at.row_segment]])
        return at._replace(axis=axis, used=used)


class _Rests(NamedTuple):
    """Rests divided at their readings: of each part `(K, m)` the `duration` (s), and the `share`: for how many readings
    that at its end stands."""

    duration: AnyArray
    share: AnyArray


def _soft_count(spacings: AnyArray, sharpness) -> AnyArray:
    """A smooth number of readings of a rest of so many spacings, which tends to the whole number as sharpness grows.

    The whole number is `ceil(x) = x + 1/2 + Σ_k sin(2πkx)/(πk)`. With each term times ρ^k, of ρ from 0 to 1, the sum is
    closed, and the slope of `x` with it is that of the Poisson kernel, nowhere zero."""
    rho = 1.0 - 1.0 / (1.0 + jnp.minimum(sharpness, _SHARPEST) / _SHARP_COUNT)
    turned = 2.0 * jnp.pi * spacings
    wave = jnp.arctan2(rho * jnp.sin(turned), 1.0 - rho * jnp.cos(turned)) / jnp.pi
    # A rest of no length has a reading, too.
    return 0.5 + rho * spacings + (1.0 - rho) * jnp.hypot(0.5, spacings) + wave


def _is_exact(sharpness) -> bool:
    return isinstance(sharpness, float) and math.isinf(sharpness)


def _largest(values: AnyArray, sharpness) -> AnyArray:
    """The largest value of all, or a norm just above it."""
    return largest(values[:, None], sharpness)[0]


def largest_log(logs: AnyArray, sharpness, axis: int) -> AnyArray:
    """The largest of logarithms, from above; infinite sharpness: exact."""
    k = jnp.where(jnp.isfinite(sharpness), sharpness, 1.0)
    return jnp.where(
        jnp.isfinite(sharpness), jax.scipy.special.logsumexp(k * logs, axis=axis) / k, jnp.max(logs, axis=axis)
    )


def inverse(info: Float[AnyArray, "p p"]) -> Float[AnyArray, "p p"]:
    """The covariance of an information matrix; NaN for a singular one."""
    scale = 1.0 / jnp.sqrt(jnp.diagonal(info))
    factor = jnp.linalg.cholesky(info * scale[:, None] * scale[None, :])
    half = jax.scipy.linalg.solve_triangular(factor, jnp.diag(scale), lower=True)
    return half.T @ half


def further(shifts: Float[np.ndarray, "J p p"]) -> Float[np.ndarray, "d p p"]:
    """Matrices F with `Σ_d F_dᵀ D F_d = Σ_j S_jᵀ D S_j` for every D, S a polynomial of j: d its degree plus one."""
    _, sizes, along = np.linalg.svd(np.reshape(shifts, (len(shifts), -1)), full_matrices=False)
    kept = sizes > 1e-14 * sizes[0]
    return np.reshape(sizes[kept, None] * along[kept], (-1, *shifts.shape[1:]))
