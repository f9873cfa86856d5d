"""A spec's plan as a search of cycles sees it: what is free of it, its objective, and the plan of a point as a spec, in
numbers that controllers take."""

import math
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gradcal_jax.design.cycle_moves import Cycle
from gradcal_jax.design.cycle_rounding import CycleRounding
from gradcal_jax.design.descent import Descent
from gradcal_jax.design.free_course import (
    FreeCourse,
    ProgrammeCoordinates,
    Ramp,
    behind_on_leg,
    cycles_alike,
    legs_of,
)
from gradcal_jax.design.plan_objective import (
    ExactObjective,
)
from gradcal_jax.design.pose_cycle import (
    FILTERED,
    READINGS_OF_A_REST,
    CycleObjective,
    largest_alike,
)
from gradcal_jax.design.programme_rounding import programme_keys
from gradcal_jax.design.slots import (
    CycleCoordinates,
    CycleStructure,
    PoseTurn,
    TableLimits,
    Visits,
    structure_of,
    time_of,
)
from gradcal_jax.design.visits import (
    LEAST_TURN,
    VisitTimes,
    moves_of_visits,
    reading_spacing,
    reading_spacing_of_others,
    rest_spacing,
    shortest_rest,
)
from gradcal_jax.model import ImuModel, OwnTerm
from gradcal_jax.model.build import course_before, fineness, waves_of
from gradcal_jax.recipe.rounding import steps_of
from gradcal_jax.recipe.tracks import makeable_acceleration
from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.motion_plan import MotionPlan, PlanSchedule
from gradcal_jax.spec.spec import spec_of
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.tables.problems import Problem, SpecError

# Slots for turns that a search inserts, as a share, and multiples of slots, each of which is compiled once.
_SPARE, _SLOTS = 0.35, 4
_MOST_TURNS = 80
# Turns up to this (rad) are tried, or up to the largest one of the file's plan.
_LARGEST = 6.0 * math.pi
# Temperatures at which cycles stand for all others of a slope, where bases are no polynomials.
_SAMPLES = 5
# ... and where a term depends on the path of temperature.
_SAMPLES_ON_A_PATH = 16
# Cycles of a table that stands for the whole course at most, and their length in the longest correlation time.
_STANDING, _OF_MEMORY = 48, 0.5
# Readings that stand for all those of a cycle of a table that stands.
_READINGS_OF_A_STAY = 8
# What is left of the time for rounding, s: of a course of the file, and of a free one.
_LEFT, _LEFT_OF_COURSE = 1e-3, 0.2
_SLACK = 1e-9
# A turn shorter than this many times the shortest is left out.
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


class RepeatedCycle(NamedTuple):
    """A cycle, how often the first stretch of the plan repeats it, and the coordinates of the chamber's course (empty:
    that of the file)."""

    turns: Cycle
    cycles: int
    course: tuple[float, ...] = ()


class CyclePlan:
    """A spec's plan as the search sees it: the objective of a cycle, its start, and what a cycle's plan leaves."""

    def __init__(self, spec: Spec, times: VisitTimes | None = None) -> None:
        self.exact = exact = ExactObjective(spec)
        self.spec, self.design, self.built = spec, exact.design, exact.builts[0]
        self._model = self.built.model
        self.turns_free = "cycle" in self.design.free or not self.design.free
        self._stands = isinstance(spec.plan, MotionPlan) and spec.plan.cycle is None
        if times is not None:
            self._schedule = spec.gradient_schedule
        else:
            self._schedule = spec.executable_schedule if self._stands else spec.plain_schedule
        stretches, self._visits = self._schedule.stretches, None
        if times is not None:
            self.limits = _limits(exact)._replace(largest=_UNBOUNDED, longest=_UNBOUNDED, read_every=rest_spacing(spec))
            self._visits, turns = self._in_visits(times)
            self.start = RepeatedCycle(turns, times.cycles)
        elif self._stands:
            whole = stretches[0].duration
            each = max(_OF_MEMORY * _longest_memory([built.model for built in exact.builts]), whole / _STANDING)
            count = max(round(whole / each), _STANDING // 4)
            turns, self.turns_free = (PoseTurn(-1, 0.0, 0.0, whole / count),), False
            self.start = RepeatedCycle(turns, count)
        else:
            turns = _cycle_of(spec)
            self.start = RepeatedCycle(turns, max(1, stretches[0].cycles))
        self.repeats = max(self.start.cycles, *(s.cycles for s in stretches)) > 1 or len(stretches) > 1
        if times is None:
            self.limits = _limits(exact, turns)
            spare = math.ceil(len(turns) * (1.0 + _SPARE) / _SLOTS) * _SLOTS
            self.slots = max(min(spare, self.design.moves or _MOST_TURNS), len(turns))
        else:
            self.repeats, self.slots = times.cycles > 1, len(turns)
        self.by_time = times is not None and not np.any(np.isfinite(self.limits.reach))
        self.closed = self.repeats and not self.by_time
        self.coordinates = CycleCoordinates(self.limits, self.slots, self._visits)
        step = self.design.angle_step
        self.rounding = CycleRounding(
            self.limits,
            tuple(axis.name for axis in spec.rig.table.axis),
            float(steps_of(spec).time),
            None if step is None else float(step),
            self.closed,
        )
        self._courses: dict[int, CycleCourse] = {}
        parts = _parts(self._schedule, (1,) * len(stretches), 0.0)
        self.objective = CycleObjective(
            self.coordinates,
            exact,
            cycles=FILTERED if self.repeats or len(parts) > 1 else 1,
            waves=waves_of(spec) if times is None else None,
            nodes=1 if times is None else fineness(spec, self._model, self.built.motion.line)[1],
            lag=spec.sensor.lag if self._one_run else None,
            readings=_READINGS_OF_A_STAY if self._stands else READINGS_OF_A_REST,
        )
        self.free_course = self._free_course()
        if self.free_course is not None:
            own = self.free_course.coordinates.vector(*_own_course(self._schedule))
            self.start = self.start._replace(course=tuple(own.tolist()))
        elif not self.turns_free:
            raise ValueError(f"optimise can change no part of this plan: the table is at rest, and {NO_COURSE}")
        self.value = partial(self.objective.value_at, course=self.free_course)
        self.descent = Descent(self.value)
        # (One by one its operations would compile a dozen programs.)
        self._decode = jax.jit(self.coordinates.decode)

    @property
    def motion(self) -> float:
        """The time of all cycles, s."""
        return math.fsum(s.duration for s in self._schedule.stretches)

    def _free_course(self) -> FreeCourse | None:
        """The chamber's courses of the search; None where that of the file is fixed."""
        spec, schedule, free = self.spec, self._schedule, self.design.free
        loops = any(isinstance(t, OwnTerm) and t.of_path for t in self.built.model.terms)
        if "programme" not in free and (free or not (loops or self._stands)):
            return None
        first, *rest = schedule.segments
        ramps = rest if first.kind == "soak" and not first.used else schedule.segments
        fixed = any(s.kind != "ramp" or not s.used for s in ramps) or not ramps
        if fixed or len(spec.rig.table.mounting) > 1 or self._one_run:
            if "programme" in free:
                raise ValueError(NO_COURSE)
            return None
        soak = first.duration if first.kind == "soak" else _BRIEF
        time = sum(s.duration for s in ramps) - (0.0 if first.kind == "soak" else _BRIEF)
        chamber = spec.rig.chamber
        numbers = (soak, time, *chamber.range, chamber.max_heating, chamber.max_cooling)
        legs = legs_of(len(ramps), stands=self._stands)
        coordinates = ProgrammeCoordinates(*(np.asarray(float(v)) for v in numbers), stretches=legs)
        before = course_before(spec)
        past = np.zeros(0) if before is None else before
        model, lag = self._model, float(spec.sensor.lag or 0.0)
        return FreeCourse(coordinates, past, lag, model.size, tuple(of.lag for of in model.others))

    def starts(self) -> list[RepeatedCycle]:
        """What a search begins with: the file's plan and, of a free course, others of the chamber."""
        if self.free_course is None:
            return [self.start]
        courses = self.free_course.starts(np.array(self.start.course))
        return [self.start._replace(course=tuple(course.tolist())) for course in courses]

    def point(self, cycle: RepeatedCycle, of: CycleStructure) -> np.ndarray:
        """All free numbers of a cycle."""
        return np.concatenate([self.coordinates.encode(cycle.turns, of).ravel(), np.array(cycle.course)])

    def cycle_at(self, point: np.ndarray, of: CycleStructure, cycles: int) -> RepeatedCycle:
        """The cycle of such numbers."""
        count = 3 * self.slots
        turns = self.coordinates.cycle_of(self._decode(point[:count].reshape(3, -1), of), of)
        return RepeatedCycle(turns, cycles, tuple(point[count:].tolist()))

    def in_words(self, cycle: RepeatedCycle) -> str:
        """The structure of a cycle and its course."""
        words = f"{len(cycle.turns)} turns in each of {cycle.cycles} cycles"
        if self._visits is not None:
            number = (self._visits.group[-1] + 1) * cycle.cycles
            kind = "the same moves in each cycle" if self.repeats else "each with its own moves"
            words = f"{number} visits of {self._visits.own:.0f} s, {kind}"
        if self.free_course is None:
            return words
        of = self.free_course.coordinates.programme(np.array(cycle.course))
        knots = [float(of.start), *of.chamber()[1].tolist()]
        turning = [b for a, b, c in zip(knots, knots[1:], knots[2:], strict=False) if (b - a) * (c - b) <= 0.0]
        course = " \u2192 ".join(f"{t:.3g}" for t in (knots[0], *turning, knots[-1]))
        return f"{'the table is at rest' if self._stands else words}; the chamber goes {course} degC"

    def course(self, count: int) -> "CycleCourse":
        """The course of the plan where its first stretch has `count` cycles."""
        if count not in self._courses:
            stretches = self._schedule.stretches
            left = _LEFT if self.free_course is None else _LEFT_OF_COURSE
            period = min(stretches[0].duration / count, *(s.duration for s in stretches)) - left / count
            if self._visits is not None and self.repeats:
                period = (self._visits.own + self._visits.other) * (self._visits.group[-1] + 1)
            behind = 0.0 if self._visits is None else self._visits.other
            counts = tuple(max(1, int((s.duration + behind) / period)) for s in stretches)
            # They are kept, and so must be no tracers of a program that happens to ask first.
            with jax.ensure_compile_time_eval():
                ramps = self._ramps(counts, period) if self.free_course is None else None
            self._courses[count] = CycleCourse(period, ramps)
        return self._courses[count]

    def structure(self, cycle: RepeatedCycle, *, turnable: bool = True) -> CycleStructure:
        """The structure of a cycle; where its turns are not `turnable`, they are by pose."""
        period, flags = self.course(cycle.cycles).period, {"turnable": turnable, "timed": self.by_time and turnable}
        return structure_of(cycle.turns, self.slots, self.limits, period, closed=self.closed, **flags)

    def without_brief(self, cycle: RepeatedCycle) -> RepeatedCycle:
        """A cycle of visits without turns that are hardly longer than the shortest."""
        assert self._visits is not None
        turns, group = list(cycle.turns), self._visits.group
        for k, t in enumerate(turns):
            if t.axis >= 0 and time_of(t, self.limits) < _VANISHED * self._visits.least:
                turns[k] = PoseTurn(-1, 0.0, 0.0, 0.0)
                if k and group[k - 1] == group[k] and turns[k - 1].rest:
                    turns[k - 1] = turns[k - 1]._replace(rest=turns[k - 1].rest + t.rest)
        return cycle._replace(turns=tuple(turns))

    def snapped(self, cycle: RepeatedCycle) -> RepeatedCycle:
        """A cycle whose turns are whole angle steps."""
        return cycle._replace(turns=self.rounding.on_steps(cycle.turns, slots=self._visits is not None))

    @property
    def draws(self) -> bool:
        """Whether random plans are among its starts: of an axis that has the table in visits, or stands."""
        return self._visits is not None or self._stands

    @property
    def _one_run(self) -> bool:
        """Whether one cycle of visits is the whole plan."""
        return self._visits is not None and not self.repeats

    def _in_visits(self, times: VisitTimes) -> tuple[Visits, Cycle]:
        """The slots of the visits: a rest before the first turn of all, then turns with rests between them and, where
        no other axis waits, behind the last. With the moves of the file's cycle, as many as it has, in every visit."""
        own, slots, group = moves_of_visits(self.spec), [], []
        whole, period = self._schedule.stretches[0].duration, times.own + times.other
        tail = times.other if times.cycles > 1 else max(whole - times.visits * period + times.other, 0.0)
        tail = tail if tail > _LEFT else 0.0
        for visit in range(times.visits):
            turns = [PoseTurn(-1, 0.0, 0.0, self.limits.shortest)]
            for move in own[visit % len(own)]:
                if move.is_rest:
                    turns[-1] = turns[-1]._replace(rest=turns[-1].rest + move.duration)
                else:
                    turns.append(PoseTurn(0, move.angle, move.fastest, 0.0))
            turns = turns if visit == 0 else turns[1:]
            if times.other and (visit < times.visits - 1 or tail):
                turns[-1] = turns[-1]._replace(rest=0.0)
            empty = times.turns + (visit == 0) - len(turns)
            slots += turns + [PoseTurn(-1, 0.0, 0.0, 0.0)] * empty
            group += [visit] * (times.turns + (visit == 0))
        every = reading_spacing_of_others(self.spec, self.limits.read_every)
        # For the steps of time to which turns are rounded.
        spare = 0.5 * float(steps_of(self.spec).time) * (times.turns + 1)
        other = times.other + spare if times.other else 0.0
        return Visits(np.array(group), times.own - spare, other, every, tail, LEAST_TURN), tuple(slots)

    def drawn(self, rng: np.random.Generator) -> RepeatedCycle:
        """A random cycle with all turns that fit, of an axis that has the table in visits, or a random course."""
        visits, count = self._visits, self.slots
        if visits is None:
            return self.start._replace(course=tuple(rng.standard_normal(len(self.start.course)).tolist()))
        last = np.append(np.diff(visits.group) > 0, bool(visits.tail)) & (visits.other > 0.0)
        turns = [PoseTurn(0 if k else -1, 1.0, 1.0, 0.0 if last[k] else 1.0) for k in range(count)]
        full = self.start._replace(turns=tuple(turns))
        point = np.concatenate([rng.standard_normal(3 * count), np.array(full.course)])
        return self.cycle_at(point, self.structure(full), full.cycles)

    def _ramps(self, counts: Sequence[int], period: float) -> Ramp:
        """All parts of the plan with one slope: see `Ramp`."""
        model, lag = self._model, self.spec.sensor.lag or 0.0
        mountings = len(self.spec.rig.table.mounting)
        polynomials, of_path = model.shifts(np.zeros(1)) is not None, model.knows_path
        past = course_before(self.spec) if of_path else None
        parts, ramps = _parts(self._schedule, counts, period), list[Ramp]()
        for following, part in enumerate(parts, 1):
            mounting, begins = min(part.stretch, mountings - 1), part.temperatures[0]
            begins -= 0.0 if self._one_run else part.slope * lag
            step, number = part.slope * period, len(part.temperatures)
            ends = model.encoder.held and (following == len(parts) or parts[following].first)
            history = np.array([*([] if past is None else past), *part.history]) if of_path else np.zeros(0)
            samples = _SAMPLES_ON_A_PATH if of_path else _SAMPLES
            for group in [np.arange(number)] if polynomials else cycles_alike(number, samples):
                first = part.first and group[0] == 0
                further = group[1:] if first else group
                last = ends & (further == number - 1)
                # Where the first of two cycles begins, so that these are where the further ones are.
                begin = 0.0 if group[0] == 0 or polynomials else float(np.mean(group - last))
                shifts = np.tile(np.eye(model.size), (len(further), 1, 1))
                if polynomials and len(further):
                    shifts = model.shifts((further - last) * step)
                begun = part.begun_s + period * begin
                at = part.slope, mounting, first, shifts, 1 + last
                ramps.append(Ramp(begins + step * begin, *at, begun, history, self._behind(begun)))
        longest = max(len(r.history) for r in ramps)
        most = max(len(r.place) for r in ramps)
        for k, r in enumerate(ramps):
            more = 0, most - len(r.place)
            shifts, place = np.pad(r.shifts, (more, (0, 0), (0, 0))), np.pad(r.place, more)
            history = np.pad(r.history, (longest - len(r.history), 0), mode="edge") if longest else r.history
            ramps[k] = r._replace(shifts=shifts, place=place, history=history)
        columns = zip(*(r[:-1] for r in ramps), strict=True)
        return Ramp(*(jnp.asarray(np.stack([np.asarray(x) for x in of])) for of in columns))

    def _behind(self, time: float) -> np.ndarray:
        """How far (K) the model's other temperatures are behind at a time of the plan (s)."""
        lags = tuple(of.lag for of in self._model.others)
        behind = np.zeros(len(lags))
        for s in self._schedule.segments:
            if s.end > time + _SLACK:
                return behind_on_leg(behind, lags, np.asarray(s.slope), np.array([time - s.start]))[0]
            behind = behind_on_leg(behind, lags, np.asarray(s.slope), np.array([s.duration]))[0]
        return behind

    def spec_of(self, cycle: RepeatedCycle) -> Spec:
        """The spec with a cycle's moves, in numbers that a controller takes."""
        if self.design.angle_step is not None:
            cycle = self.snapped(cycle)
        spec = self.spec
        if self.free_course is not None:
            spec = changed(spec, programme_keys(spec, self.free_course.coordinates, np.array(cycle.course)))
        if self._stands:
            return spec
        if self._visits is not None:
            return changed(spec, self._keys_of_visits(cycle.turns, self._visits))
        tables = spec.model_dump(mode="json", exclude_unset=True)
        period, whole = self.course(cycle.cycles).period, self.structure(cycle).whole
        tables["plan"]["cycle"]["moves"] = self.rounding.moves(self.rounding.rounded(cycle.turns, period, whole))
        return spec_of(tables)

    def _keys_of_visits(self, turns: Cycle, visits: Visits) -> dict[str, Any]:
        """The keys of a plan whose axis has the table in visits."""
        moves: list[dict[str, Any]] = []
        parts, reads = self.rounding.visits(turns, visits), math.isfinite(visits.every)
        behind = 0.0
        least = visits.other - float(steps_of(self.spec).time) * (len(turns) / len(parts))
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
        every = self.limits.read_every
        spaced = {} if every == reading_spacing(self.spec) else {"rig.table.axis[0].angle.read_every": f"{every:.9g} s"}
        return {"plan.cycle": cycle, **spaced}


class CycleCourse(NamedTuple):
    """The `period` (s) of a number of cycles, and their ramps; None where the course is free."""

    period: float
    ramps: Ramp | None


class _Part(NamedTuple):
    """Cycles on one slope (K/s): the `temperatures` (°C) at which they begin; whether the stretch begins with them; the
    time of the first (s), and the chamber's turning points before it (°C)."""

    stretch: int
    first: bool
    slope: float
    temperatures: np.ndarray
    begun_s: float
    history: tuple[float, ...]


def _parts(schedule: PlanSchedule, counts: Sequence[int], period: float) -> list[_Part]:
    """The parts of a plan whose cycles differ in temperature alone; a cycle counts where it begins."""
    parts = []
    for number, stretch in enumerate(schedule.stretches):
        times = stretch.start + period * np.arange(counts[number])
        segments = [
            s
            for s in schedule.segments
            if s.end > stretch.start + _SLACK and s.start < stretch.start + stretch.duration - _SLACK
        ]
        ends = np.array([s.end for s in segments])
        where = np.minimum(np.searchsorted(ends, times + _SLACK, side="right"), len(segments) - 1)
        for k in np.unique(where):
            s, own = segments[k], times[where == k]
            temperatures = s.temperature_start + s.slope * (own - s.start)
            earlier = [e for e in schedule.segments if e.end <= s.start + _SLACK]
            history = (schedule.segments[0].temperature_start, *(e.temperature_end for e in earlier))
            at = float(own[0]), tuple(map(float, history))
            parts.append(_Part(number, bool(where[0] == k), float(s.slope), temperatures, *at))
    return parts


def _own_course(schedule: PlanSchedule) -> tuple[float, np.ndarray, np.ndarray]:
    """Where a plan's ramps begin (°C), their durations (s) and slopes (K/s)."""
    ramps = [s for s in schedule.segments if s.kind == "ramp"]
    return ramps[0].temperature_start, np.array([s.duration for s in ramps]), np.array([s.slope for s in ramps])


def _longest_memory(models: Sequence[ImuModel]) -> float:
    """The longest correlation time of the noise, s."""
    decays = (d for m in models for c in m.channels for d in np.asarray(c.processes.decay) if d > 0.0)
    return max((1.0 / d for d in decays), default=0.0)


def _cycle_of(spec: Spec) -> Cycle:
    """The spec's own cycle: a rest belongs to the turn before it, the first one to the last turn."""
    turns: list[PoseTurn] = []
    begins = 0.0
    for s in spec.plain_schedule.steps:
        if s.axis >= 0:
            turns.append(PoseTurn(s.axis, s.move.angle, s.move.fastest, 0.0))
        elif turns:
            turns[-1] = turns[-1]._replace(rest=turns[-1].rest + s.move.duration)
        else:
            begins += s.move.duration
    if begins and turns and max(x.cycles for x in spec.plain_schedule.stretches) > 1:
        turns[-1] = turns[-1]._replace(rest=turns[-1].rest + begins)
    elif begins:
        turns.insert(0, PoseTurn(-1, 0.0, 0.0, begins))
    return tuple(turns)


def _limits(exact: ExactObjective, start: Cycle = ()) -> TableLimits:
    """The strictest limits of the table in all cases of a search, and of the turns and rests of a cycle."""
    spec, design = exact.cases[0].spec, exact.design
    step = steps_of(spec).acceleration
    rates, accelerations, reach = [], [], []
    for case in exact.cases:
        axes, gyro = case.spec.rig.table.axis, case.spec.sensor.gyro
        usable = math.inf if gyro is None or gyro.usable_rate is None else gyro.usable_rate
        rates.append([min(float(a.max_rate), usable) for a in axes])
        steepest = [float(a.max_acceleration) for a in axes]
        accelerations.append([makeable_acceleration(a, None if step is None else float(step), a) for a in steepest])
        reach.append([a.reach for a in axes])
    low, high = np.moveaxis(np.array(reach, dtype=float), -1, 0)
    return TableLimits(
        np.min(rates, axis=0),
        np.min(accelerations, axis=0),
        np.stack([np.max(low, axis=0), np.min(high, axis=0)], axis=1),
        np.array(spec.executable_schedule.start, dtype=float),
        largest_alike(max([_LARGEST, *(abs(t.angle) for t in start)]), waves_of(spec)),
        shortest_rest(spec, design),
        max([float(design.longest_rest), *(t.rest for t in start)]),
        0.0,
        float(spec.rig.table.axis[0].angle.read_every) if spec.rig.table.standing == "read" else math.inf,
    )
