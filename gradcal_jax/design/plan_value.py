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
from jaxtyping import Float, Int

from gradcal_jax.arrays import AnyArray
from gradcal_jax.design.course import ProgrammeCoordinates
from gradcal_jax.design.plan_objective import ExactObjective
from gradcal_jax.design.repeated import FILTERED, RepeatedCycle, repeated_cycle
from gradcal_jax.design.slots import SHAPE, CycleCoordinates, Decoded, Structure
from gradcal_jax.information import gram, imu_system, segments_of
from gradcal_jax.information.gears import rows_of_gears
from gradcal_jax.information.imu_rows import Segments
from gradcal_jax.model.build import BuiltImu, chamber_programme, course_before, fineness, geometry
from gradcal_jax.model.terms import block_diagonal
from gradcal_jax.motion import Programme, Schedule, TableMotion, body_nodes, gradient_plan, programme
from gradcal_jax.motion.motion import rest, turn
from gradcal_jax.motion.table_motion import largest_turn, nodes_of_turn
from gradcal_jax.spec.schedule import PlanSchedule

# Numbers of quadrature nodes.
_NODES = (16, 24, 32, 48, 64, 96, 128, 192, 256, 384, 512)
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


def nodes_for(turned: float, waves: int) -> int:
    """Quadrature nodes for a piece that turns so far (rad), with waves of so many cycles a turn."""
    (least,) = nodes_of_turn(np.array([turned]), waves)
    return next((n for n in _NODES if n >= least), _NODES[-1])


def largest_alike(least: float, waves: int) -> float:
    """The largest turn (rad) for which the nodes suffice that a turn of `least` needs."""
    return largest_turn(nodes_for(least, waves), waves)


@dataclass(frozen=True, eq=False)
class PlanValue:
    """The objective `exact` of plans with a `schedule` by the `coordinates` of their cycle and, if it is free, those of
    the chamber's `course`. `spare` s: by how much visits of the template are longer. `repeats`: the cycle is repeated;
    `stands`: the table never turns."""

    exact: ExactObjective
    schedule: PlanSchedule
    coordinates: CycleCoordinates
    course: ProgrammeCoordinates | None
    spare: float
    repeats: bool
    stands: bool

    def __call__(self, z: Float[AnyArray, " n"], args: tuple[Structure, Any]) -> Float[AnyArray, ""]:
        """The objective of all free numbers; where it has no value, a large one. `args`: structure, sharpness."""
        of, sharpness = args
        count = 3 * self.coordinates.slots
        decoded = self.coordinates.decode(jnp.reshape(z[:count], (3, -1)), of)
        programme = None if self.course is None else self.course.whole(z[count:])
        total = self.exact.soft(self.logs(decoded, of, programme, sharpness), sharpness)
        total = total + self.coordinates.penalty(decoded)
        return jnp.where(jnp.isfinite(total), total, _NOWHERE)

    def logs(
        self, decoded: Decoded, of: Structure, programme: Programme | None, sharpness: Any
    ) -> Float[AnyArray, "s m"]:
        """The logarithm of every statistic over its limit at every place."""
        statistics = self.exact.statistics()
        over = self.exact.limits / np.array([per_si for _, per_si in self.exact.units])
        rests = self._rests(decoded.rest, sharpness)
        template, logs = self._template(rests), []
        for built in self.exact.builts:
            root = self._root(built, *self._motion(built, template, decoded, rests, of, programme))
            logs.append(jnp.log(jnp.stack([s(root, sharpness) for s in statistics]) / over))
        return jnp.stack(logs)

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
        free = self.course is not None or self.stands
        period = self.coordinates.visits.period
        return None if free else repeated_cycle(self.schedule, self.exact.builts, period)

    def _rests(self, rest: Float[AnyArray, " K"], sharpness: Any) -> "_Rests":
        """The rests of a cycle, divided at their readings, of which the last one is at the end of the rest."""
        every = self.coordinates.limits.read_every
        exactly = isinstance(sharpness, float) and math.isinf(sharpness)
        if math.isinf(every):
            return _Rests(rest[:, None], jnp.ones((len(rest), 1)), exactly)
        if exactly:
            most = math.floor(min(self.coordinates.limits.longest, self.coordinates.visits.own) / every + 1.0)
            count = jnp.minimum(jnp.floor(rest / every * (1.0 + _ROUNDING) + _ROUNDING), float(most))
            spaced = jnp.where(np.arange(most, dtype=float)[None] < count[:, None], every, 0.0)
            left = rest - count * every
            left = jnp.where(left > _ROUNDING * rest, left, 0.0)
            duration = jnp.concatenate([spaced, left[:, None]], axis=1)
            return _Rests(duration, jnp.ones(duration.shape), exactly)
        share = jnp.tile(_soft_count(rest / every, sharpness)[:, None] / _OF_A_REST, (1, _OF_A_REST))
        return _Rests(jnp.tile(rest[:, None] / _OF_A_REST, (1, _OF_A_REST)), share, exactly)

    def _template(self, rests: "_Rests") -> "_Template":
        """The discrete part of the plan."""
        visits, course = self.coordinates.visits, chamber_programme(self.schedule)
        if self.course is not None:
            # (All courses are of one duration.)
            course = self.course.whole(np.zeros(2 * self.course.stretches + 1)), ((1, 1 + self.course.stretches),)
        if (of := self._repeated()) is not None:
            window = FILTERED * (visits.own + self.spare)
            course = programme(of.begins, [(window, of.slope)]), ((0, 1),)
        slots, each = rests.duration.shape
        parts, order, waits = _OF_OTHERS if math.isfinite(visits.every) else 1, list[int](), list[float]()
        for k, wait in enumerate(() if self.stands else visits.waits()):
            order += [k, *(slots + k * each + i for i in range(each))]
            for _ in range(parts if wait else 0):
                order.append(slots * (1 + each) + len(waits))
                waits.append(wait / parts)
        reads, turning = math.isfinite(visits.every), slots * (1 + each)
        lasting = (visits.own + self.spare) * visits.number / max(len(order) - len(waits), 1)
        a_turn, a_rest = turn(SHAPE, 1.0, lasting, ramp=lasting / 4.0), rest(lasting, read_at_end=True)
        of_others = [rest(wait, read_at_end=reads) for wait in waits]
        moves = [a_turn if p < slots else a_rest if p < turning else of_others[p - turning] for p in order]
        behind = parts if visits.tail and self.repeats else 0
        line = _plan_of(course, tuple(moves), behind, self._spacing_of_stays(exactly=rests.exactly))
        readings = np.array(waits) / visits.every if reads else np.ones(len(waits))
        return _Template(line, np.array(order, int), np.array(waits), readings)

    def _spacing_of_stays(self, *, exactly: bool) -> float | None:
        """Spacing of the readings (s) where no move fills a stretch."""
        table = self.exact.builts[0].spec.rig.table
        every = float(table.axis[0].angle.read_every) if table.standing == "read" else math.inf
        if math.isinf(every):
            return every if table.standing == "read" and table.typed else None
        longest = max(s.duration for s in self.schedule.stretches)
        return every if exactly or not self.stands else max(every, longest / _OF_A_STAY)

    def _motion(
        self,
        built: BuiltImu,
        of_plan: "_Template",
        decoded: Decoded,
        rests: "_Rests",
        of: Structure,
        programme: Programme | None,
    ) -> tuple[TableMotion, Segments]:
        """The plan's motion, and its segments: those of empty slots, or without any time, are not used."""
        line, spec, model = of_plan.line, built.spec, built.model
        (slots, each), move, order = rests.duration.shape, np.asarray(line.pieces.move), of_plan.order
        fillers = len(line.duration) - len(order)

        def in_order(of_turns: AnyArray, of_rests: AnyArray, of_waits: AnyArray, of_stays: float) -> AnyArray:
            every = jnp.concatenate([of_turns, jnp.reshape(of_rests, (-1,)), of_waits])[order]
            return jnp.concatenate([every, jnp.full(fillers, of_stays)])

        none, still = jnp.zeros(rests.duration.shape), jnp.zeros(len(of_plan.waits))
        numbers = {
            "duration": in_order(decoded.turning, rests.duration, of_plan.waits, 0.0),
            "peak_rate": in_order(decoded.rate, none, still, 0.0),
            "ramp": in_order(decoded.ramp, none, still, 0.0),
        }
        course = line.programme if programme is None else programme
        traced = jax.tree.map(
            lambda x: jnp.asarray(x) if eqx.is_inexact_array(x) else x, replace(line, programme=course)
        )
        spacing = self._spacing_of_stays(exactly=rests.exactly)
        stay = spacing / self.coordinates.limits.read_every if self.stands and spacing else 1.0
        share = in_order(jnp.ones(slots), rests.share, of_plan.readings, stay)[move]
        track = replace(replace(traced, **numbers).trajectory(spec.sensor.lag), share=share)

        turns = np.append(order < slots, np.zeros(fillers, bool))[move]
        # A time of other axes, and one that no move fills, have the slot after the last.
        slot = np.where(order < slots, order, np.minimum((order - slots) // each, slots))
        slot = np.append(slot, np.full(fillers, slots))[move]
        axis = jnp.where(turns, jnp.append(of.axis, -1)[slot], -1)
        stretch = np.cumsum(np.diff(line.pieces.gap.astype(int), prepend=0) < 0)
        mounting = np.minimum(stretch, len(spec.rig.table.mounting) - 1)
        # Pieces of the same place in the cycle are alike; where it returns to its begin, or no column sees where it is.
        first = np.searchsorted(line.pieces.segment, line.pieces.segment)
        place = np.stack([move, np.arange(len(move)) - first, mounting])
        _, example, kind = np.unique(place, axis=1, return_index=True, return_inverse=True)
        kind, nodes = np.reshape(kind, -1), self._nodes(built, turns[example], line.pieces.varying[example])
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
        ramps, flat = (nodes_for(turned, waves) for turned in (in_ramp, limits.largest))
        return np.where(~turns, 1, np.where(varying, ramps, flat))


class _Rests(NamedTuple):
    """Rests divided at their readings: of each part `(K, m)` the `duration` (s), and the `share`: for how many readings
    that at its end stands. `exactly`: for one."""

    duration: AnyArray
    share: AnyArray
    exactly: bool


class _Template(NamedTuple):
    """A plan, of which only what is discrete counts: of each of a cycle's moves the place (`order`) among the turns of
    all slots, the rests of all slots and all `waits` for other axes (s), of which `readings` stand at the end."""

    line: Schedule
    order: Int[np.ndarray, " M"]
    waits: Float[np.ndarray, " w"]
    readings: Float[np.ndarray, " w"]


def _plan_of(
    course: tuple[Programme, tuple[tuple[int, int], ...]], moves: tuple[Any, ...], behind: int, spacing: float | None
) -> Schedule:
    """The plan of a cycle of `moves`, of which the last cycle leaves out the last `behind`, on the parts of a course
    whose data are used. A piece is not divided where the chamber's slope changes within it: its middle decides."""
    whole, used = course
    times = whole.times()
    knots = np.unique([0, len(times) - 1, *(k for part in used for k in part)])
    parts = [(int(np.searchsorted(knots, a)), int(np.searchsorted(knots, b))) for a, b in used]
    lasting = [(float(duration), 0.0) for duration in np.diff(times[knots])]
    own = len(moves) - behind
    line = gradient_plan(programme(0.0, lasting), moves[:own], moves[own:], used=tuple(parts), read_every=spacing)
    fills = {"fill_from": knots[line.fill_from], "fill_to": knots[line.fill_to]}
    return replace(line, programme=whole, first_knot=np.asarray(knots[line.first_knot]), **fills)


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
