"""A spec's plan as a search sees it: what is free of it, its objective, and the plan of a point as a spec, in numbers
that controllers take."""

import math
from typing import Any, NamedTuple

import numpy as np

from gradcal_jax.design.course import ProgrammeCoordinates
from gradcal_jax.design.cycle_rounding import CycleRounding
from gradcal_jax.design.descent import Descent
from gradcal_jax.design.plan_objective import ExactObjective
from gradcal_jax.design.plan_value import PlanValue
from gradcal_jax.design.slots import EMPTY, Cycle, CycleCoordinates, SlotTurn, Structure, TableLimits, Visits
from gradcal_jax.design.visits import VisitTimes, cycle_in_visits, shortest_rest, slot_turns
from gradcal_jax.model import OwnTerm
from gradcal_jax.recipe.tracks import makeable_acceleration, steps_of
from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.design import Design
from gradcal_jax.spec.plan import MotionPlan
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.tables.problems import Problem, SpecError

# Slots for turns that a search inserts, as a share, and multiples of slots.
_SPARE, _SLOTS = 0.35, 4
_MOST_TURNS = 80
# Legs of a free course at least; of a table that stands.
_LEGS, _LEGS_AT_REST = 4, 6
# Turns up to this (rad) are tried, or up to the largest one of the file's plan.
_LARGEST = 7.35 * math.pi
# What is left of the time for rounding, s: of a course of the file, and of a free one.
_LEFT, _LEFT_OF_COURSE = 1e-3, 0.2
# A turn by time shorter than this (s) is left out.
_VANISHED = 3.0
# Largest turn (rad) and longest rest (s) of an axis that has the table in visits: of any size.
_UNBOUNDED = 1e9
# Shortest soak that a programme may begin with, s.
_BRIEF = 1.0
NO_COURSE = (
    'design.free = ["programme"] needs a plan with one mounting that does not continue an interrupted run; its '
    "temperature programme must be ramps whose data are used, after at most one soak whose data are not used; an axis "
    "that has the table in a few visits follows the programme of the file"
)


class Proposal(NamedTuple):
    """A cycle of turns, and the coordinates of the chamber's course (empty: that of the file)."""

    turns: Cycle
    course: tuple[float, ...] = ()


class CyclePlan:
    """A spec's plan as the search sees it: the objective of a proposal, its start, and the spec of one.

    `draws`: random plans are among its starts: of an axis that has the table in visits, or of a table that stands."""

    def __init__(self, spec: Spec, times: VisitTimes | None = None) -> None:
        self.exact = exact = ExactObjective(spec)
        self.spec, self.design, self._times = spec, exact.design, times
        self.stands = isinstance(spec.plan, MotionPlan) and spec.plan.cycle is None
        self.draws = self.stands or times is not None
        self.turns_free = not self.stands and ("cycle" in self.design.free or not self.design.free)
        plain = not self.draws
        self._schedule = spec.plain_schedule if plain else spec.gradient_schedule if times else spec.executable_schedule
        stretches = self._schedule.stretches
        self.cycles = times.cycles if times else max(1, stretches[0].cycles)
        self._repeats = self.cycles > 1 or (plain and bool(stretches[1:]))
        self.course = self._free_course()
        if not self.turns_free and self.course is None:
            raise ValueError(f"optimise can change no part of this plan: the table is at rest, and {NO_COURSE}")
        turns = _cycle_of(spec) if plain else (EMPTY,)
        self.limits = _limits(spec, self.design, turns)
        if times is not None:
            self.limits = self.limits._replace(largest=_UNBOUNDED, longest=_UNBOUNDED)
            visits, turns = cycle_in_visits(spec, times, self.limits)
            spare = 0.0 if self._repeats else (stretches[0].duration - visits.period) / visits.number
        else:
            spare = (_LEFT if self.course is None else _LEFT_OF_COURSE) / self.cycles
            period = min(stretches[0].duration / self.cycles, *(s.duration for s in stretches)) - spare
            visits = Visits(np.zeros(self._slots_for(len(turns)), int), period)
        timed = times is not None and not np.any(np.isfinite(self.limits.reach))
        closed = self._repeats and not timed
        self.coordinates = CycleCoordinates(self.limits, visits, timed, closed)
        axes = tuple(axis.name for axis in spec.rig.table.axis)
        self.rounding = CycleRounding(self.limits, axes, float(steps_of(spec).time), closed)
        own = np.zeros(0)
        if self.course is not None:
            ramps = [s for s in self._schedule.segments if s.kind == "ramp"]
            durations, slopes = np.array([(s.duration, s.slope) for s in ramps]).T
            own = self.course.vector(ramps[0].temperature_start, durations, slopes)
        self.start = Proposal(turns, tuple(own.tolist()))
        self.value = PlanValue(exact, self._schedule, self.coordinates, self.course, spare, self.cycles, self.stands)
        self.descent = Descent(self.value)

    def _slots_for(self, turns: int) -> int:
        spare = math.ceil(turns * (1.0 + _SPARE) / _SLOTS) * _SLOTS
        return 1 if self.stands else max(min(spare, self.design.moves or _MOST_TURNS), turns)

    def _free_course(self) -> ProgrammeCoordinates | None:
        """The chamber's courses of the search; None where that of the file is fixed."""
        spec, schedule, free = self.spec, self._schedule, self.design.free
        loops = any(isinstance(t, OwnTerm) and t.of_path for t in self.exact.builts[0].model.terms)
        if "programme" not in free and (free or not (loops or self.stands)):
            return None
        first, *rest = schedule.segments
        ramps = rest if first.kind == "soak" and not first.used else schedule.segments
        fixed = any(s.kind != "ramp" or not s.used for s in ramps) or not ramps
        if fixed or len(spec.rig.table.mounting) > 1 or (self._times and not self._repeats):
            if "programme" in free:
                raise ValueError(NO_COURSE)
            return None
        soak = first.duration if first.kind == "soak" else _BRIEF
        time = sum(s.duration for s in ramps) - (0.0 if first.kind == "soak" else _BRIEF)
        chamber = spec.rig.chamber
        numbers = (soak, time, *chamber.range, chamber.max_heating, chamber.max_cooling)
        legs = max(len(ramps), _LEGS_AT_REST if self.stands else _LEGS)
        return ProgrammeCoordinates(*map(float, numbers), stretches=legs)

    def starts(self) -> list[Proposal]:
        """What a search begins with: the file's plan and, of a free course, others of the chamber."""
        if self.course is None:
            return [self.start]
        courses = self.course.starts(np.array(self.start.course))
        return [self.start._replace(course=tuple(course.tolist())) for course in courses]

    def drawn(self, rng: np.random.Generator) -> Proposal:
        """A random cycle with all turns that fit, of an axis that has the table in visits, or a random course."""
        visits, count = self.coordinates.visits, self.coordinates.slots
        if self._times is None:
            return self.start._replace(course=tuple(rng.standard_normal(len(self.start.course)).tolist()))
        waits = visits.waits() if visits.other else np.zeros(count)
        full = tuple(SlotTurn(0 if k else -1, 1.0, 1.0, 0.0 if waits[k] else 1.0) for k in range(count))
        point = np.concatenate([rng.standard_normal(3 * count), np.array(self.start.course)])
        return self.at(point, self.coordinates.structure(full))

    def point(self, of: Proposal) -> np.ndarray:
        """All free numbers of a proposal."""
        return np.concatenate([self.coordinates.encode(of.turns).ravel(), np.array(of.course)])

    def at(self, point: np.ndarray, of: Structure) -> Proposal:
        """The proposal of such numbers."""
        count = 3 * self.coordinates.slots
        # (What is not chosen may be a division by zero.)
        with np.errstate(all="ignore"):
            decoded = self.coordinates.decode(point[:count].reshape(3, -1), of)
        return Proposal(self.coordinates.cycle(decoded, of), tuple(point[count:].tolist()))

    def without_brief(self, of: Proposal) -> Proposal:
        """A proposal without turns by time that are hardly longer than the shortest."""
        turns, group = list(of.turns), self.coordinates.visits.group
        for k, t in enumerate(turns):
            if t.axis >= 0 and self.limits.time_of(t) < _VANISHED:
                turns[k] = EMPTY
                if k and group[k - 1] == group[k] and turns[k - 1].rest:
                    turns[k - 1] = turns[k - 1]._replace(rest=turns[k - 1].rest + t.rest)
        return of._replace(turns=tuple(turns))

    def in_words(self, of: Proposal) -> str:
        """The structure of a proposal and its course."""
        words, visits = f"{len(of.turns)} turns", self.coordinates.visits
        if self._times is not None:
            words = f"{visits.number} visits of {visits.own:.0f} s, each with its own moves"
        words += f" in each of {self.cycles} cycles" if self.cycles > 1 else ""
        if self.course is None:
            return words
        course = " \u2192 ".join(f"{t:.3g}" for t in self.course.knots(np.array(of.course)))
        return f"{'the table is at rest' if self.stands else words}; the chamber goes {course} degC"

    def spec_of(self, of: Proposal) -> Spec:
        """The spec with a proposal's moves and course, in numbers that a controller takes."""
        keys = {} if self.course is None else self.course.keys(np.array(of.course), steps_of(self.spec))
        if self._times is not None:
            keys |= self._keys_of_visits(of.turns)
        elif not self.stands:
            whole = self.coordinates.structure(of.turns).whole if self.rounding.closed else None
            turns = self.rounding.rounded(of.turns, self.coordinates.visits.own, self.limits.start, whole)
            keys["plan.cycle.moves"] = self.rounding.moves(turns)
        return changed(self.spec, keys)

    def _keys_of_visits(self, turns: Cycle) -> dict[str, Any]:
        """The keys of a plan whose axis has the table in visits."""
        moves, visits = list[dict[str, Any]](), self.coordinates.visits
        parts, reads = self.rounding.visits(turns, visits), math.isfinite(visits.every)
        behind = 0.0
        least = visits.other - self.rounding.grid * (len(turns) / len(parts))
        for number, (part, wait) in enumerate(parts):
            if wait < least:
                words = f"the turns of visit {number + 1} take {least - wait:.3g} s more than it has"
                raise SpecError([Problem(("plan", "cycle", "moves"), words)])
            moves += self.rounding.moves(part)
            behind = wait
            if visits.other and number < len(parts) - 1:
                moves.append({"rest": f"{wait:.9g} s", "other_axes": True} | ({} if reads else {"read_every": "none"}))
        cycle: dict[str, Any] = {"moves": moves}
        if visits.other:
            spacing = {"read_every": f"{self.limits.read_every:.9g} s"} if reads else {}
            cycle["other_axes"] = {"duration": f"{behind:.9g} s"} | spacing
        return {"plan.cycle": cycle}


def _cycle_of(spec: Spec) -> Cycle:
    """The spec's own cycle: a rest belongs to the turn before it, the first one of repeated cycles to the last turn."""
    first, *turns = slot_turns(spec.plain_schedule.steps)
    if first.rest and turns and max(x.cycles for x in spec.plain_schedule.stretches) > 1:
        turns[-1] = turns[-1]._replace(rest=turns[-1].rest + first.rest)
    elif first.rest:
        turns.insert(0, first)
    return tuple(turns)


def _limits(spec: Spec, design: Design, start: Cycle) -> TableLimits:
    """The limits of the table, and of the turns and rests of a cycle."""
    table, step, gyro = spec.rig.table, steps_of(spec).acceleration, spec.sensor.gyro
    usable = math.inf if gyro is None or gyro.usable_rate is None else gyro.usable_rate
    steepest = [float(axis.max_acceleration) for axis in table.axis]
    makeable = [makeable_acceleration(a, None if step is None else float(step), a) for a in steepest]
    return TableLimits(
        np.minimum([float(axis.max_rate) for axis in table.axis], usable),
        np.array(makeable),
        np.array([axis.reach for axis in table.axis], dtype=float),
        np.array(spec.executable_schedule.start, dtype=float),
        max([_LARGEST, *(abs(t.angle) for t in start)]),
        shortest_rest(spec, design),
        max([float(design.longest_rest), *(t.rest for t in start)]),
        float(table.axis[0].angle.read_every) if table.standing == "read" else math.inf,
    )
