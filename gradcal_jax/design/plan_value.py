"""The objective of a design (`design.plan_objective`) as a function of free numbers, traced by JAX: coordinates of a
cycle and of the chamber's course → the plan's moves in all cycles → its motion → information → statistics.

A template of the plan has all that is discrete: how often the cycle is repeated, its pieces, and which of them are
read. With a sharpness that is the number `math.inf` the readings of rests are those of a prediction. With any other one
a few readings stand for them, of which the number is smooth, too: it grows with the rest.
"""

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from gradcal_jax.arrays import AnyArray, taken
from gradcal_jax.design.course import ProgrammeCoordinates
from gradcal_jax.design.plan_objective import ExactObjective
from gradcal_jax.design.repeated import FILTERED, RepeatedCycle, repeated_cycle
from gradcal_jax.design.slots import SHAPE, CycleCoordinates, Decoded, Structure
from gradcal_jax.information import gram, imu_system, segments_of
from gradcal_jax.information.gears import rows_of_gears
from gradcal_jax.information.imu_rows import Segments
from gradcal_jax.model.build import BuiltImu
from gradcal_jax.model.terms import block_diagonal
from gradcal_jax.motion import Programme, Schedule, TableMotion, body_nodes, gradient_plan, rest, turn
from gradcal_jax.motion import programme as programme_of
from gradcal_jax.motion.plan_motion import chamber_programme, course_before, fineness, geometry
from gradcal_jax.motion.table_motion import nodes_of_turn
from gradcal_jax.spec.schedule import PlanSchedule

# Quadrature nodes at most.
_MOST_NODES = 512
# Readings that stand for all those of a rest in a search, of a time of other axes, and of a table that stands, each
# with the weight of its share of them.
_OF_A_REST, _OF_OTHERS, _OF_A_STAY = 2, 8, 240
# Sharpness at which the number of readings of a rest is halfway between a smooth and a whole number.
# Beyond the largest one the slope of the number is not finite.
_SHARP_COUNT, _SHARPEST = 1e3, 1e9
# Relative and absolute rounding of a number of readings.
_ROUNDING = 1e-9
# The objective of a plan that has none.
_NOWHERE = 1e3


@dataclass(frozen=True, eq=False)
class PlanValue:
    """The objective `exact` of plans with a `schedule` by the `coordinates` of their cycle and, if it is free, those of
    the chamber's `course`. `spare` s: by how much visits of the template are longer. `cycles`: of a stretch.
    `stands`: the table never turns."""

    exact: ExactObjective
    schedule: PlanSchedule
    coordinates: CycleCoordinates
    course: ProgrammeCoordinates | None
    spare: float
    cycles: int
    stands: bool

    def __call__(self, z: Float[AnyArray, " n"], args: tuple[Structure, Any]) -> Float[AnyArray, ""]:
        """The objective of all free numbers; where it has no value, a large one. `args`: structure, sharpness."""
        of, sharpness = args
        count = 3 * self.coordinates.slots
        decoded = self.coordinates.decode(jnp.reshape(z[:count], (3, -1)), of)
        programme = None if self.course is None else self.course.programme(z[count:])
        plan = self._plan(decoded, programme, sharpness)
        statistics = self.exact.statistics()
        over = self.exact.limits / np.array([of.factor for of in self.exact.units])
        logs = []
        for built in self.exact.builts:
            root = self._root(built, *self._motion(built, plan, of))
            logs.append(jnp.log(jnp.stack([s(root, sharpness) for s in statistics]) / over))
        total = self.exact.soft(jnp.stack(logs), sharpness) + self.coordinates.penalty(decoded)
        return jnp.where(jnp.isfinite(total), total, _NOWHERE)

    def _root(self, built: BuiltImu, motion: TableMotion, at: Segments) -> Float[AnyArray, "p r"]:
        """A root of the covariance of all parameters."""
        model, nodes = built.model, body_nodes(motion, built.points)
        common = rows_of_gears(motion, model, nodes, built.gears, at)[1] if built.gears else np.zeros((0, 0))
        count = common.shape[1]
        steps, columns = imu_system(motion, model, nodes, at, common if count else None)
        prior = block_diagonal([np.eye(count), model.prior_rows()])
        repeated = self._repeated()
        product = gram(steps, columns) if repeated is None else repeated.gram(built, steps, columns)
        return inverse_root(prior.T @ prior + product)[count:]

    def _repeated(self) -> RepeatedCycle | None:
        """The cycle of which some stand for all, exactly."""
        visits = self.coordinates.visits
        if self.course is not None or self.stands or visits.other:
            return None
        return repeated_cycle(self.schedule, self.exact.builts, self.cycles, visits.period)

    def _rests(self, rest: Float[AnyArray, " K"], sharpness: Any, *, exactly: bool) -> tuple[AnyArray, AnyArray]:
        """The rests of a cycle, divided at their readings, of which the last one is at the end of the rest: of each
        part `(K, m)` the duration (s), and for how many readings that at its end stands; `exactly`: for one."""
        every = self.coordinates.limits.read_every
        if math.isinf(every):
            return rest[:, None], jnp.ones((len(rest), 1))
        if exactly:
            most = math.floor(min(self.coordinates.limits.longest, self.coordinates.visits.own) / every + 1.0)
            count = jnp.minimum(jnp.floor(rest / every * (1.0 + _ROUNDING) + _ROUNDING), float(most))
            spaced = jnp.where(np.arange(most, dtype=float)[None] < count[:, None], every, 0.0)
            left = rest - count * every
            left = jnp.where(left > _ROUNDING * rest, left, 0.0)
            duration = jnp.concatenate([spaced, left[:, None]], axis=1)
            return duration, jnp.ones(duration.shape)
        both = jnp.stack([rest, _soft_count(rest / every, sharpness)]) / _OF_A_REST
        return jnp.tile(both[0][:, None], (1, _OF_A_REST)), jnp.tile(both[1][:, None], (1, _OF_A_REST))

    def _plan(self, decoded: Decoded, programme: Programme | None, sharpness: Any) -> "_Plan":
        """All cycles of a decoded one: each slot is a turn, the parts of its rest, and those of a time for others."""
        visits, course = self.coordinates.visits, chamber_programme(self.schedule)
        exactly = isinstance(sharpness, float) and math.isinf(sharpness)
        rests, read = self._rests(decoded.rest, sharpness, exactly=exactly)
        (slots, each), reads = rests.shape, math.isfinite(visits.every)
        parts = _OF_OTHERS if reads else 1
        others = np.tile(visits.waits()[:, None] / parts, (1, parts))
        there = np.concatenate([np.ones((slots, 1 + each), bool), others > 0.0], axis=1) & (not self.stands)
        order = np.flatnonzero(there)
        slot, column = np.divmod(order, there.shape[1])

        if self.course is not None:
            # (All courses are of one duration.)
            course = self.course.programme(np.zeros(2 * self.course.stretches + 1)), ((1, 1 + self.course.stretches),)
        if (of := self._repeated()) is not None:
            window = FILTERED * (visits.own + self.spare) * visits.number
            course = programme_of(of.begins, [(window, of.slope)]), ((0, 1),)
        lasting = (visits.own + self.spare) * visits.number / max(int(np.sum(column <= each)), 1)
        a_turn, a_rest = turn(SHAPE, 1.0, lasting, ramp=lasting / 4.0), rest(lasting, read_at_end=True)
        waits = [rest(float(wait), read_at_end=reads) for wait in others[:, 0]]
        pairs = zip(slot, column, strict=True)
        moves = tuple(a_turn if c == 0 else a_rest if c <= each else waits[k] for k, c in pairs)
        spacing = self._spacing_of_stays(exactly=exactly)
        own = len(moves) - (parts if visits.tail and self.cycles > 1 else 0)
        # A piece is not divided where the chamber's slope changes within it: its middle decides.
        template = gradient_plan(course[0], moves[:own], moves[own:], used=course[1], read_every=spacing, divided=False)
        fillers, move = len(template.duration) - len(order), np.asarray(template.pieces.move)

        def in_order(*columns: AnyArray, of_stays: float = 0.0) -> AnyArray:
            whole = jnp.concatenate(columns, axis=1).ravel()
            return jnp.concatenate([taken(whole, order), jnp.full(fillers, of_stays)])

        still = np.zeros((slots, each + parts))
        line = replace(
            jax.tree.map(lambda x: jnp.asarray(x) if eqx.is_inexact_array(x) else x, template),
            duration=in_order(decoded.turning[:, None], rests, others),
            peak_rate=in_order(decoded.rate[:, None], still),
            ramp=in_order(decoded.ramp[:, None], still),
        )
        line = line if programme is None else replace(line, programme=programme)
        stay = spacing / self.coordinates.limits.read_every if self.stands and spacing else 1.0
        of_others = others / visits.every if reads else np.ones(others.shape)
        share = in_order(np.ones((slots, 1)), read, of_others, of_stays=stay)[move]
        turns = np.append(column == 0, np.zeros(fillers, bool))[move]
        # A time of other axes, and one that no move fills, have the slot after the last.
        slot = np.append(np.where(column <= each, slot, slots), np.full(fillers, slots))[move]
        return _Plan(line, template, share, slot, turns)

    def _spacing_of_stays(self, *, exactly: bool) -> float | None:
        """Spacing of the readings (s) where no move fills a stretch."""
        table = self.exact.builts[0].spec.rig.table
        every = float(table.axis[0].angle.read_every) if table.standing == "read" else math.inf
        if math.isinf(every):
            return every if table.standing == "read" and table.typed else None
        longest = max(s.duration for s in self.schedule.stretches)
        return every if exactly or not self.stands else max(every, longest / _OF_A_STAY)

    def _motion(self, built: BuiltImu, plan: "_Plan", of: Structure) -> tuple[TableMotion, Segments]:
        """The plan's motion, and its segments: those of empty slots, or without any time, are not used."""
        line, slot, turns, spec, model = plan.template, plan.slot, plan.turns, built.spec, built.model
        pieces, track = line.pieces, replace(plan.line.trajectory(spec.sensor.lag), share=plan.share)
        axis = jnp.where(turns, jnp.append(of.axis, -1)[slot], -1)
        stretch = np.cumsum(np.diff(pieces.gap.astype(int), prepend=0) < 0)
        mounting = np.minimum(stretch, len(spec.rig.table.mounting) - 1)
        # Pieces of the same place in the cycle are alike; where it returns to its begin, or no column sees where it is.
        first = np.searchsorted(pieces.segment, pieces.segment)
        place = np.stack([pieces.move, np.arange(len(slot)) - first, mounting])
        _, example, kind = np.unique(place, axis=1, return_index=True, return_inverse=True)
        kind, nodes = np.reshape(kind, -1), self._nodes(built, turns[example], pieces.of.varying[example])
        table, start = jax.tree.map(jnp.asarray, geometry(spec.rig)), np.asarray(self.coordinates.limits.start)
        before = course_before(spec) if model.knows_path else None
        motion = TableMotion(track, axis, mounting, table, start, kind, example, nodes, before)

        known = replace(motion, line=line.trajectory(None), axis=np.where(turns, 0, -1))
        at = segments_of(known, model)
        # (A time of other axes that is not read belongs to the turn after it.)
        moves, of_segment = at.axis >= 0, slot[at.last]
        of_slot = jnp.append(of.axis, -1)[of_segment]
        there = jnp.where(moves, of_slot >= 0, jnp.append(of.rests, True)[of_segment])
        there = there & (at.sums(track.duration) > 0.0)
        used = jnp.asarray(at.used) & there[at.row_segment]
        return motion, at._replace(axis=jnp.where(moves, of_slot, -1), used=used)

    def _nodes(self, built: BuiltImu, turns: np.ndarray, varying: np.ndarray) -> np.ndarray:
        """Quadrature nodes of pieces."""
        limits, (waves, least) = self.coordinates.limits, fineness(built.spec, built.model, built.motion.line)
        if not waves:
            return np.where(turns, least, 1)
        in_ramp = float(np.max(limits.rates**2 / (2.0 * limits.accelerations)))
        ramps, flat = np.minimum(nodes_of_turn(np.array([in_ramp, limits.largest]), waves), _MOST_NODES)
        return np.where(~turns, 1, np.where(varying, ramps, flat))


class _Plan(NamedTuple):
    """All cycles of a plan: the `line`, and a `template` of it, of which only what is discrete counts; of each piece
    the `share`: for how many readings that at its end stands, the `slot`, and whether it `turns`."""

    line: Schedule
    template: Schedule
    share: AnyArray
    slot: Int[np.ndarray, " P"]
    turns: Bool[np.ndarray, " P"]


def _soft_count(spacings: AnyArray, sharpness: Any) -> AnyArray:
    """A smooth number of readings of a rest of so many spacings, which tends to the whole number as sharpness grows.

    The whole number is `ceil(x) = x + 1/2 + Σ_k sin(2πkx)/(πk)`. With each term times ρ^k, of ρ from 0 to 1, the sum is
    closed, and the slope of `x` with it is that of the Poisson kernel, nowhere zero."""
    rho = 1.0 - 1.0 / (1.0 + jnp.minimum(sharpness, _SHARPEST) / _SHARP_COUNT)
    turned = 2.0 * jnp.pi * spacings
    wave = jnp.arctan2(rho * jnp.sin(turned), 1.0 - rho * jnp.cos(turned)) / jnp.pi
    # A rest of no length has a reading, too.
    return 0.5 + rho * spacings + (1.0 - rho) * jnp.hypot(0.5, spacings) + wave


def inverse_root(info: Float[AnyArray, "p p"]) -> Float[AnyArray, "p p"]:
    """A root of the covariance by an information matrix; NaN for a singular one."""
    scale = 1.0 / jnp.sqrt(jnp.diagonal(info))
    factor = jnp.linalg.cholesky(info * scale[:, None] * scale[None, :])
    return jax.scipy.linalg.solve_triangular(factor, jnp.diag(scale), lower=True).T
