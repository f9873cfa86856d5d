"""The objective of a cycle of turns and rests (`design.slots`), traced by JAX.

The noise of every cycle is the same, and only the temperature of its columns differs: on a ramp of constant slope a
polynomial at a shifted temperature is a polynomial, so that the columns of a cycle are those of another times a small
matrix S. Two cycles, of which the second one ends a stretch of the plan, are filtered reading by reading from any state
of the noise (`whitening.passage`), the first one also from that at the begin. These passages then follow one another as
often as there are cycles (`through`), a few small products each: exactly the information of all readings.
"""

import math
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from gradcal_jax.arrays import AnyArray, fixed
from gradcal_jax.design.free_course import FreeCourse, Ramp
from gradcal_jax.design.plan_objective import EXCESS, ExactObjective
from gradcal_jax.design.slots import SHAPE, STEEPNESS, CycleCoordinates, CycleStructure, Decoded
from gradcal_jax.information import gram, imu_system, segments_of
from gradcal_jax.information.imu_rows import Segments
from gradcal_jax.information.noise_steps import NoiseSteps
from gradcal_jax.information.whitening import Passage, passage
from gradcal_jax.model import ImuModel
from gradcal_jax.model.build import geometry
from gradcal_jax.motion import Geometry, Schedule, TableMotion, body_nodes, gradient_plan, programme
from gradcal_jax.motion.motion import rest, turn
from gradcal_jax.motion.table_motion import largest_turn, nodes_of_turn

# Cycles that are filtered reading by reading; those after which the noise of a cycle within many is steady.
FILTERED = 2
_SETTLED = 8
# Numbers of quadrature nodes.
_NODES = (16, 24, 32, 48, 64, 96, 128, 192, 256, 384, 512)
# Readings that stand for all those of a rest in a search, each with the weight of its share of them.
READINGS_OF_A_REST = 2
# Sharpness at which the number of readings of a rest is halfway between a smooth and a whole number.
# Beyond the largest one the slope of the number is not finite.
_SHARP_COUNT, _SHARPEST = 1e3, 1e9
# Relative and absolute rounding of a number of readings.
_ROUNDING = 1e-9
# The objective of a cycle that has none.
_NOWHERE = 1e3
# Readings that stand for all those of a time of other axes.
_READINGS_OF_OTHERS = 8


def nodes_for(turned: float, waves: int) -> int:
    """Quadrature nodes for a piece that turns so far (rad), with waves of so many cycles a turn."""
    (least,) = nodes_of_turn(np.array([turned]), waves)
    return next((n for n in _NODES if n >= least), _NODES[-1])


def largest_alike(least: float, waves: int) -> float:
    """The largest turn (rad) for which the nodes suffice that a turn of `least` needs."""
    return largest_turn(nodes_for(least, waves), waves)


class CycleObjective:
    """The objective of a design (`exact`) as a function of the coordinates of a cycle.

    `cycles`: that are filtered, `FILTERED` or the only one. `readings`: how many stand for all those of a rest.
    `waves`: as `nodes_for`; None: no column has waves, and every part of a turn has so many `nodes`. `lag` s: of the
    temperature, which is steady as the plan begins; None: the ramps are those of the sensor itself.

    With a sharpness that is the number `math.inf` the readings of rests are those of a prediction. With any other one a
    few readings stand for them, of which the number is smooth, too: it grows with the rest.
    """

    def __init__(
        self,
        coordinates: CycleCoordinates,
        exact: ExactObjective,
        *,
        cycles: int,
        waves: int | None,
        readings: int,
        nodes: int = 1,
        lag: float | None = None,
    ) -> None:
        self.coordinates, self.exact = coordinates, exact
        # Those of the coordinates may be eased, and are then no plain numbers.
        self.limits = coordinates.limits
        self.models = [built.model for built in exact.builts]
        self.geometries = [jax.tree.map(jnp.asarray, geometry(built.spec.rig)) for built in exact.builts]
        aims = exact.statistics()
        self.statistics = [statistic for _, statistic in aims]
        self.targets = np.array([aim.limit / aim.per_si for aim, _ in aims])
        self.minimised = sum(aim.counted for aim, _ in aims)
        self.cycles, self.waves, self.nodes, self.lag = cycles, waves, nodes, lag
        self.points = exact.builts[0].points
        self.readings = readings if math.isfinite(coordinates.limits.read_every) else 1

    def value_at(
        self,
        z: Float[AnyArray, " n"],
        args: tuple[CycleStructure, Ramp | None, Any, Float[AnyArray, " m"] | None],
        course: FreeCourse | None = None,
    ) -> Float[AnyArray, ""]:
        """The objective of all free numbers of a cycle and its course. `args`: structure, ramps (None: those of the
        free `course`), sharpness, targets."""
        of, ramps, sharpness, targets = args
        count = 3 * self.coordinates.slots
        if ramps is None:
            assert course is not None
            ramps = course.ramps(z[count:], of.period)
        return self.value(jnp.reshape(z[:count], (3, -1)), of, ramps, sharpness, targets)

    def value(
        self,
        z: Float[AnyArray, "3 K"],
        of: CycleStructure,
        ramps: Ramp,
        sharpness,
        targets: Float[AnyArray, " m"] | None = None,
    ) -> Float[AnyArray, ""]:
        """The objective of a cycle on stacked `ramps`; where it has no value, a large one."""
        decoded = self.coordinates.decode(z, of)
        logs = self.logs(decoded, of, ramps, sharpness, targets)
        logs, beyond = logs[:, : self.minimised], logs[:, self.minimised :]
        each = largest_log(logs, sharpness, axis=1) if self.exact.worst else jnp.mean(logs, axis=1)
        if self.exact.design.robust == "worst":
            total = largest_log(each, sharpness, axis=0)
        elif self.exact.of_logs:
            total = jnp.dot(self.exact.weights, each)
        else:
            total = jax.scipy.special.logsumexp(each, b=self.exact.weights)
        # From above, as all that is sharp: a limit is kept with a little room.
        total = total + EXCESS * jnp.sum(largest_log(jnp.stack([beyond, jnp.zeros_like(beyond)]), sharpness, axis=0))
        total = total + self.coordinates.penalty(decoded, of.period)
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
        logs = []
        for model, table in zip(self.models, self.geometries, strict=True):
            prior = model.prior_rows()
            root = inverse_root(prior.T @ prior + self.information(model, table, decoded, of, ramps, sharpness))
            logs.append(jnp.log(jnp.stack([s(root, sharpness) for s in self.statistics]) / over))
        return jnp.stack(logs)

    def information(
        self, model: ImuModel, geometry: Geometry, decoded: Decoded, of: CycleStructure, ramps: Ramp, sharpness
    ) -> Float[AnyArray, "p p"]:
        """The information of all cycles on the ramps."""

        def readings(ramp: Ramp) -> tuple[NoiseSteps, AnyArray]:
            motion, at = self._motion(ramp, decoded, of, model, geometry, sharpness)
            return imu_system(motion, model, body_nodes(motion, self.points), at)

        def alone(ramp: Ramp) -> AnyArray:
            return gram(*readings(ramp))

        def passages(ramp: Ramp) -> list[Passage]:
            steps, columns = readings(ramp)
            one, last = (_of_cycle(k, steps, columns) for k in range(FILTERED))
            begun, between = (passage(*one, known=known) for known in (True, False))
            # Where a table is held, the last standstill is another one, since nothing turns after it.
            return [begun, between, passage(*last, known=False) if model.encoder.held else between]

        def steadily(ramp: Ramp) -> tuple[AnyArray, AnyArray]:
            """The information of the ramp's cycles among many, and what that of a first one and those after it exceeds
            it by."""
            begun, one, _ = passages(ramp)
            same = jnp.eye(model.size)
            settled, _ = jax.lax.scan(lambda known, _: (through(known, one, same), None), begun, None, _SETTLED)
            added = through(settled, one, same).product - settled.product
            assert ramp.number is not None
            return ramp.number * added, settled.product - (1 + _SETTLED) * added

        if self.cycles == 1:
            return jnp.sum(jax.lax.map(alone, ramps), axis=0)
        if ramps.number is not None:
            added, begun = jax.vmap(steadily)(ramps)
            return jnp.sum(added, axis=0) + begun[0]
        of_ramps = jax.lax.map(passages, ramps)
        nothing = jax.tree.map(lambda x: jnp.zeros_like(x[0]), of_ramps[0])
        known, _ = jax.lax.scan(_along, nothing, (ramps, of_ramps))
        return known.product

    def _motion(
        self, ramp: Ramp, decoded: Decoded, of: CycleStructure, model: ImuModel, geometry: Geometry, sharpness
    ) -> tuple[TableMotion, Segments]:
        rests, visits = self._rests(decoded.rest, sharpness), self.coordinates.visits
        layout = _layout_of(self.coordinates, rests)
        line = layout.line(self.cycles)

        def in_order(of_turns: AnyArray, of_rests: AnyArray, of_waits: AnyArray) -> AnyArray:
            return jnp.concatenate([of_turns, jnp.reshape(of_rests, (-1,)), of_waits])[layout.order]

        none, still = jnp.zeros(rests.duration.shape), jnp.zeros(len(layout.waits))
        waits = jnp.asarray(layout.waits) * (1.0 if visits is None else visits.stretch)
        numbers = [
            in_order(decoded.turning, rests.duration, waits),
            in_order(decoded.rate, none, still),
            in_order(decoded.ramp, none, still),
        ]
        course = replace(
            line.programme,
            start=ramp.begins,
            durations=jnp.reshape(self.cycles * of.period, (1,)),
            slopes=jnp.reshape(ramp.slope, (1,)),
        )
        of_line = replace(line, duration=numbers[0], peak_rate=numbers[1], ramp=numbers[2], programme=course)
        move = np.asarray(line.pieces.move)
        share = in_order(jnp.ones(self.coordinates.slots), rests.share, jnp.asarray(layout.readings))[move]
        track = replace(of_line.trajectory(self.lag), share=share)
        count = len(move) // self.cycles
        slot, turns = layout.slot[move], layout.turns[move]
        axis = jnp.where(turns, jnp.append(of.axis, -1)[slot], -1)
        example = np.arange(count)
        kind = np.arange(len(move)) % count
        nodes = self._nodes(turns[:count], np.asarray(line.pieces.varying)[:count])
        mounting = jnp.full(len(move), ramp.mounting)
        history = None
        if ramp.history.shape[0]:
            history, track = ramp.history, replace(track, start=track.start + ramp.elapsed)
        start = np.asarray(self.coordinates.limits.start)
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
        limits = self.limits
        if self.waves is None:
            return np.where(turns, self.nodes, 1)
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
        # (A time of other axes that is not read belongs to the turn after it.)
        slot = slot_of_piece[at.last]
        moves = at.axis >= 0
        of_slot = jnp.append(of.axis, -1)[slot]
        axis = jnp.where(moves, of_slot, -1)
        there = jnp.where(moves, of_slot >= 0, jnp.append(of.rests, True)[slot])
        there = there & (at.sums(duration) > 0.0)
        used = jnp.asarray(at.used) & there[at.row_segment]
        forces = np.array([c.kind != "gyro" for c in model.channels])[at.row_channel] & moves[at.row_segment]
        used = used & (~forces | jnp.append(of.slow, False)[slot[at.row_segment]])
        return at._replace(axis=axis, used=used)


class _Rests(NamedTuple):
    """Rests divided at their readings: of each part `(K, m)` the `duration` (s), and the `share`: for how many readings
    that at its end stands."""

    duration: AnyArray
    share: AnyArray


class _Layout(NamedTuple):
    """The moves of a cycle in order: of each the `slot` (a time of other axes: the one after the last), whether it
    `turns`, and its place (`order`) among all turns, all rests and all `waits` (s), of which `readings` stand at the
    end."""

    slot: Int[np.ndarray, " M"]
    turns: Bool[np.ndarray, " M"]
    order: Int[np.ndarray, " M"]
    read: Bool[np.ndarray, " M"]
    waits: Float[np.ndarray, " w"]
    readings: Float[np.ndarray, " w"]

    def line(self, cycles: int) -> Schedule:
        """A schedule with these moves, of which only what is discrete counts."""
        moves = [
            turn(SHAPE, 1.0, 4.0, ramp=1.0) if turns else rest(1.0, read_at_end=bool(read))
            for turns, read in zip(self.turns, self.read, strict=True)
        ]
        whole = math.fsum(move.duration for move in moves)
        return gradient_plan(programme(0.0, [(whole * cycles, 0.0)]), tuple(moves), read_every=None)


def _layout_of(coordinates: CycleCoordinates, rests: _Rests) -> _Layout:
    count, each = rests.duration.shape
    visits = coordinates.visits
    waits, every = ([], math.inf) if visits is None else (visits.waits(), visits.every)
    rows: list[tuple[int, bool, int, bool]] = []
    times, readings = [], []
    for k in range(count):
        rows.append((k, True, k, True))
        rows += [(k, False, count + k * each + i, True) for i in range(each)]
        for at, time in waits:
            if at != k:
                continue
            read = math.isfinite(every)
            parts = _READINGS_OF_OTHERS if read else 1
            for _ in range(parts):
                rows.append((count, False, count * (1 + each) + len(times), read))
                times.append(time / parts)
                readings.append(time / parts / every if read else 1.0)
    slot, turns, order, read = (np.array(of) for of in zip(*rows, strict=True))
    return _Layout(slot, turns, order, read, np.array(times), np.array(readings))


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


def largest_log(logs: AnyArray, sharpness, axis: int) -> AnyArray:
    """The largest of logarithms, from above; infinite sharpness: exact."""
    k = jnp.where(jnp.isfinite(sharpness), sharpness, 1.0)
    return jnp.where(
        jnp.isfinite(sharpness), jax.scipy.special.logsumexp(k * logs, axis=axis) / k, jnp.max(logs, axis=axis)
    )


def inverse_root(info: Float[AnyArray, "p p"]) -> Float[AnyArray, "p p"]:
    """A root of the covariance by an information matrix; NaN for a singular one."""
    scale = 1.0 / jnp.sqrt(jnp.diagonal(info))
    factor = jnp.linalg.cholesky(info * scale[:, None] * scale[None, :])
    return jax.scipy.linalg.solve_triangular(factor, jnp.diag(scale), lower=True).T


def through(known: Passage, after: Passage, shift: Float[AnyArray, "p p"]) -> Passage:
    """What is known after a passage from any state of the noise, with columns times `shift`."""
    p, state, covariance = len(shift), known.after, known.left
    own, both, of_state = after.product[:p, :p], after.product[:p, p:], after.product[p:, p:]
    missing = both.T @ shift - of_state @ state
    # The covariance of the state before, given the readings after: (I + P J)⁻¹ P.
    size = fixed(jnp.sqrt(jnp.diagonal(covariance)))
    size = jnp.where(size > 0.0, size, 1.0)
    sizes = size[:, None] * size[None, :]
    scaled = covariance / sizes
    smoothed = jnp.linalg.solve(jnp.eye(len(size)) + scaled @ (of_state * sizes), scaled) * sizes
    cross = shift.T @ both @ state
    seen = shift.T @ own @ shift - cross - cross.T + state.T @ of_state @ state - missing.T @ smoothed @ missing
    begin, onward = state + smoothed @ missing, -after.after[:, p:]
    return Passage(
        known.product + 0.5 * (seen + seen.T),
        after.after[:, :p] @ shift + onward @ begin,
        onward @ (0.5 * (smoothed + smoothed.T)) @ onward.T + after.left,
    )


def _along(known: Passage, now: tuple[Ramp, list[Passage]]) -> tuple[Passage, None]:
    """What is known after all cycles of a ramp."""
    ramp, (first, between, last) = now
    begun = first._replace(product=known.product + first.product)
    known = jax.tree.map(partial(jnp.where, ramp.first), begun, known)

    def one(known: Passage, cycle: tuple[AnyArray, AnyArray]) -> tuple[Passage, None]:
        shift, place = cycle
        after = through(known, jax.tree.map(partial(jnp.where, place == 2), last, between), shift)
        return jax.tree.map(partial(jnp.where, place > 0), after, known), None

    return jax.lax.scan(one, known, (ramp.shifts, ramp.place))


def _of_cycle(number: int, steps: NoiseSteps, columns: AnyArray) -> tuple[NoiseSteps, AnyArray]:
    """The readings of one of the cycles."""
    count = len(columns) // FILTERED
    rows = slice(number * count, (number + 1) * count)
    return NoiseSteps(*(x if x is None or x is steps.initial else x[rows] for x in steps)), columns[rows]
