"""The plans of one gyro's turns, of the chamber, or of set points, as a search sees them: their structures (the number
of turns at the table, of moves in each, and whether cycles are alike), and the objective of a [design] over each.

The integers of a plan (numbers of visits and of moves) have no gradient: a few structures are searched, and the best is
taken. Moves that a structure has in excess shrink to nothing and are pruned.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final, Literal, NamedTuple, cast

import numpy as np

from gradcal_jax.design import (
    AnyCoordinates,
    Case,
    Compiled,
    Coordinates,
    Criterion,
    CycleNumbers,
    Element,
    Frame,
    Limits,
    Objective,
    ProgrammeCoordinates,
    StandardCoordinates,
    make_coordinates,
    polynomial_grid,
)
from gradcal_jax.design.plan_objective import ExactObjective, optimality
from gradcal_jax.formulas import RAMPED_SHAPES, repetitions
from gradcal_jax.information import contrasts
from gradcal_jax.information.error_budget import counted_criterion
from gradcal_jax.information.imu_residual import box, heading_contrasts
from gradcal_jax.information.residual import Statistic, map_of
from gradcal_jax.information.verdicts import mission_weights
from gradcal_jax.model import BIAS, SCALE_FACTOR, HigherPolynomials, Map, Polynomial, SensorModel
from gradcal_jax.model.build import assemble, longest_piece
from gradcal_jax.motion import Schedule, rule_of
from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.design import ALL, OPTIMALITIES, Design
from gradcal_jax.spec.motion_plan import MotionPlan
from gradcal_jax.spec.moves import ResolvedMove
from gradcal_jax.spec.plan import RampItem, StandardPlan
from gradcal_jax.spec.requirement import MissionHeadingRequirement, Requirement
from gradcal_jax.spec.schedule import StandardSchedule
from gradcal_jax.spec.sensor import GyroTriad
from gradcal_jax.spec.spec_sections import Spec

# Shortest useful turn; s.
LEAST_TURN: Final = 1.0
# Largest number of turns at the table with moves of their own; beyond, the cycle repeats.
_MOST_OWN: Final = 20
# Moves of all cycles together, about, and of each at least: one for every power of a cubic.
_MOVES: Final = 36
_LEAST_MOVES: Final = 4
# Numbers of turns at the table that are searched where the cycle's length is free.
_FREE_VISITS: Final = (3, 4, 6)
_FREE: Final = {"duration": "duration", "rest": "duration", "turn": "duration", "peak_rate": "peak_rate"}
# Numbers of slopes of a programme for a standing axis.
_STRETCHES: Final = (2, 4, 6)


class ResolvedCycle(NamedTuple):
    """One cycle in SI: the moves one after the other, then the other axes' time, then idle standing (not read).

    `other_read_every` is None where the axis is not read while the others turn.
    """

    moves: tuple[ResolvedMove, ...]
    moving: float
    other: float
    other_read_every: float | None
    idle: float

    @property
    def duration(self) -> float:
        """Duration of the whole cycle (s)."""
        return self.moving + self.other + self.idle


class Structure(NamedTuple):
    """Coordinates of a search, and their structure in words. `start`: the vector of the spec's own plan, if it is one
    of them; `alone`: no other start is made."""

    coordinates: AnyCoordinates
    words: str
    start: np.ndarray | None = None
    alone: bool = False


def limits_of(spec: Spec, scenarios: list[Spec]) -> Limits:
    """The strictest of the rig's and the sensor's limits, over all scenarios."""
    every, (start, end) = [spec, *scenarios], ramp_ends(spec)
    return Limits(
        largest_rate(spec, scenarios),
        min(float(s.rig.table.axis[0].max_acceleration) for s in every),
        min(float(s.rig.table.axis[0].travel) for s in every),
        min(float(s.rig.chamber.max_heating if end > start else s.rig.chamber.max_cooling) for s in every),
    )


def ramp_ends(spec: Spec) -> tuple[float, float]:
    """Where the one ramp of a gradient plan begins and ends, °C. Errors: `ValueError` for any other programme."""
    ramps = [s for s in spec.gradient_schedule.segments if s.kind == "ramp"]
    others = [s for s in spec.gradient_schedule.segments if s.kind == "step" or (s.kind == "soak" and s.used)]
    slopes = [s.slope for s in ramps]
    if others or not ramps or min(slopes) * max(slopes) < 0.0:
        raise ValueError(
            "a plan with motion is optimised on one ramp, up or down, after a soak whose data are not used: "
            'write plan.temperature = [start, end], plan.gradient and plan.soak with "used = false"'
        )
    return ramps[0].temperature_start, ramps[-1].temperature_end


def motion_time(spec: Spec, design: Design) -> float:
    """The duration of the ramp (s) by [design], else the plan's. Errors: `ValueError` where no time is left."""
    schedule = spec.gradient_schedule
    limits = [] if design.max_motion is None else [float(design.max_motion)]
    if design.max_total is not None:
        limits.append(float(design.max_total) - schedule.soak)
    limits = limits or [schedule.motion]
    if min(limits) <= 0.0:
        raise ValueError(
            f"design.max_total leaves no time for the ramp: the soak alone takes {schedule.soak / 60.0:.4g} min"
        )
    return min(limits)


def with_motion(spec: Spec, time: float) -> Spec:
    """The spec with ramps that last, with steps between them, `time` s in all: every slope by the same factor.

    Errors: `ValueError` for a plan without a ramp, or where the steps take longer; `SpecError` where the chamber or a
    cycle needs more.
    """
    schedule = spec.gradient_schedule
    ramps = math.fsum(s.duration for s in schedule.segments if s.kind == "ramp")
    left = time - (schedule.motion - ramps)
    if not ramps or left <= 0.0:
        raise ValueError(f"the plan has no ramp that could last {time / 60.0:.4g} min")

    def slower(slope: float) -> str:
        return f"{60.0 * slope * ramps / left:.12g} K/min"

    plan = spec.plan
    assert isinstance(plan, MotionPlan)
    if plan.programme is not None:
        keys: dict[str, Any] = {
            f"plan.programme[{k}].rate": slower(item.rate)
            for k, item in enumerate(plan.programme)
            if isinstance(item, RampItem)
        }
    else:
        one = plan.gradient
        keys = {"plan.gradient": [slower(s) for s in one] if isinstance(one, tuple) else slower(float(one or 0.0))}
    return changed(spec, keys)


def structures(spec: Spec, scenarios: list[Spec], *, motion: float | None = None) -> list[Structure]:
    """The structures to search; `motion` s replaces the time that [design] gives (without soaks).

    Errors: `ValueError` where [design] frees a quantity that such a plan lacks, or leaves no time.
    """
    design = cast("Design", spec.design)
    if isinstance(spec.schedule, StandardSchedule):
        _only(design, ("temperatures", "rates", "integration"), "a standard plan")
        return _standard(spec, scenarios, design, motion)
    cycle = cycle_of(spec)
    if cycle is None:
        _only(design, ("programme", "gradient"), "a gradient plan with the axis at rest")
        return _programmes(spec, scenarios, design, motion)
    _only(design, ("duration", "rest", "turn", "peak_rate", "ramp", "gradient", "cycle"), "a gradient plan with moves")
    return _cycles(spec, scenarios, cycle, design, motion)


def gyro_of(spec: Spec) -> GyroTriad:
    """The gyro of a spec that has one."""
    assert spec.sensor.gyro is not None
    return spec.sensor.gyro


def cycle_of(spec: Spec) -> ResolvedCycle | None:
    """The cycle of a plan about the only axis of a table; None where the axis stands.

    A rest that is read once, at its end, has no spacing; nor has a time of other axes in which nothing is read.
    """
    if isinstance(spec.plan, StandardPlan) or spec.plan.cycle is None:
        return None
    schedule, others = spec.gradient_schedule, spec.plan.cycle.other_axes
    every = reading_spacing(spec)
    moves: list[ResolvedMove] = []
    for step in schedule.every_step:
        spacing = every if step.move.reads_as_table else step.move.read_every
        spaced = spacing is not None and math.isfinite(spacing)
        moves.append(replace(step.move, repeat=1, read_every=spacing if spaced else None))
    moving, behind = math.fsum(move.duration for move in moves), math.fsum(s.move.duration for s in schedule.after)
    other = 0.0 if others is None else float(others.duration)
    other_every = None
    if others is not None and others.read:
        spacing = every if others.read_every is None else float(others.read_every)
        other_every = min(spacing, other)
    return ResolvedCycle(tuple(moves), moving, other, other_every, behind - other)


def reading_spacing(spec: Spec) -> float:
    """Spacing (s) of the readings of the only axis where the plan does not say it; infinite: at the end of a rest."""
    return float(spec.rig.table.axis[0].angle.read_every)


def _only(design: Design, possible: tuple[str, ...], plan: str) -> None:
    wrong = [name for name in design.free if name not in possible]
    if wrong:
        raise ValueError(f"design.free: {plan} has no {wrong[0]!r} to change; it has {', '.join(possible)}")


def _standard(spec: Spec, scenarios: list[Spec], design: Design, motion: float | None) -> list[Structure]:
    schedule = cast("StandardSchedule", spec.schedule)
    soak = schedule.soak_each
    fewest = max(s.temperature.size for s in (gyro_of(spec).bias, gyro_of(spec).scale_factor) if s is not None)
    if design.max_total is not None:
        time = float(design.max_total)
    elif design.max_motion is not None:
        time = float(design.max_motion) + schedule.soak
    else:
        time = schedule.duration
    if motion is not None:
        time = motion + schedule.soak
    # Many more temperatures than needed would spend the time on soaks.
    counts = [n for n in range(fewest, 2 * fewest) if time / n > 1.05 * soak]
    if "temperatures" not in design.free:
        counts = [len(schedule.temperatures)]
    if not counts:
        raise ValueError(
            f"{fewest} temperatures are needed, each with a soak of {soak / 60.0:.4g} min: of {time / 60.0:.4g} min, "
            "no time is left for the integration; allow more time, or shorten the soaks"
        )
    low, high = temperatures_of(spec, scenarios)
    numbers = [np.asarray(float(v)) for v in (soak, time, low, high, largest_rate(spec, scenarios))]
    options = {"rates_free": "rates" in design.free, "points": schedule.shared}
    rates = np.asarray(schedule.rates, dtype=float)
    own = np.sort(np.asarray(schedule.temperatures, dtype=float))
    choices = [StandardCoordinates(*numbers, fixed_rates=rates, temperatures=n, **options) for n in counts]
    return [
        Structure(c, f"{c.temperatures} temperatures", c.vector(own, rates) if c.temperatures == len(own) else None)
        for c in choices
    ]


def _programmes(spec: Spec, scenarios: list[Spec], design: Design, motion: float | None) -> list[Structure]:
    schedule = spec.gradient_schedule
    first = schedule.segments[0]
    soak = first.duration if first.kind == "soak" else 0.0
    if soak == 0.0:
        raise ValueError("a programme for an axis at rest begins with a soak: give plan.soak")
    time = motion_time(spec, design) if motion is None else motion
    low, high = temperatures_of(spec, scenarios)
    every = [spec, *scenarios]
    heating = min(float(s.rig.chamber.max_heating) for s in every)
    cooling = min(float(s.rig.chamber.max_cooling) for s in every)
    numbers = [
        np.asarray(float(v)) for v in (soak, time, min(reading_spacing(spec), soak + time), low, high, heating, cooling)
    ]
    ramps = schedule.segments[1:]
    begin, scale = schedule.segments[0].temperature_end, time / max(sum(s.duration for s in ramps), 1e-9)
    own = begin, np.array([s.duration * scale for s in ramps]), np.array([s.slope / scale for s in ramps])
    choices = [ProgrammeCoordinates(*numbers, stretches=n, soak_used=first.used) for n in _STRETCHES]
    return [
        Structure(c, f"a programme of {c.stretches} slopes", c.vector(*own) if 0 < len(ramps) <= c.stretches else None)
        for c in choices
    ]


def temperatures_of(spec: Spec, scenarios: list[Spec]) -> tuple[float, float]:
    """The range that every scenario's chamber reaches, °C."""
    ranges = [s.rig.chamber.range for s in (spec, *scenarios)]
    return max(float(r[0]) for r in ranges), min(float(r[1]) for r in ranges)


def largest_rate(spec: Spec, scenarios: list[Spec]) -> float:
    """The largest rate that every scenario's table and sensor allow, rad/s."""
    every = [spec, *scenarios]
    rates = [float(s.rig.table.axis[0].max_rate) for s in every]
    return min(rates + [float(usable) for s in every if (usable := gyro_of(s).usable_rate) is not None])


def visit_times(cycle: ResolvedCycle) -> tuple[float, float]:
    """The duration (s) of one turn at the table, and the time after it for other axes."""
    others = [move.duration for move in cycle.moves if move.other_axes]
    each = (cycle.moving - sum(others)) / (len(others) + 1)
    return each, others[0] if others else cycle.duration - cycle.moving


def _cycles(
    spec: Spec, scenarios: list[Spec], cycle: ResolvedCycle, design: Design, motion: float | None
) -> list[Structure]:
    time = motion_time(spec, design) if motion is None else motion
    free = frozenset(_FREE.get(name, name) for name in design.free) - {"cycle"}
    own, other = visit_times(cycle)
    share = own / (own + other)
    if "duration" not in free:
        if refused := _unsuited(cycle.moves):
            raise ValueError(refused)
        return [_spec_cycle(spec, scenarios, cycle, free, time)]
    if "cycle" in design.free:
        # The axis keeps its share of the time. The last turn at the table ends with the ramp.
        choices = [(n, share * time / n, (1.0 - share) * time / (n - 1)) for n in _FREE_VISITS]
    else:
        choices = [(repetitions(time, own, own + other)[0], own, other)]
        if choices[0][0] == 0:
            raise ValueError(
                f"the moves of a cycle take {own:.4g} s, but the ramp takes only {time:.4g} s: lengthen the ramp"
            )
    candidates = []
    # Many short visits have more numbers than a search can tell apart: they begin with the same moves in each.
    many = choices[0][0] > _MOST_OWN and "cycles" not in design.model_fields_set
    own_plan: Structure | None = None
    if "cycle" not in design.free and not _unsuited(cycle.moves):
        own_plan = _spec_cycle(spec, scenarios, cycle, free, time)
        if many:
            return [own_plan]
    for visits, each, between in choices:
        alike = design.cycles == "alike" or many
        groups = 1 if alike else -(-visits // max(1, -(-visits // _MOST_OWN)))
        cycles = visits if alike else max(1, visits // groups)
        groups = 1 if alike else visits // cycles
        rest = float(read_spacing(cycle))
        # The shortest turns and rests may take half the time at the table.
        fitting = max(1, int(0.5 * each / (LEAST_TURN + rest)))
        wanted = 2 * _LEAST_MOVES if alike else max(_LEAST_MOVES, -(-_MOVES // groups))
        moves = design.moves or min(wanted, fitting)
        ends_moving = abs(cycles * groups * (each + between) - between - time) < 1e-6
        elements = _elements(ramped_shape(cycle), groups, moves, rest, not_shared=other <= 0.0, ends=ends_moving)
        coordinates = make_coordinates(
            elements,
            limits_of(spec, scenarios),
            _frame(spec, cycle, each, between, time),
            cycles=cycles,
            others_read=cycle.other_read_every is not None,
            free=free,
            longest_piece=min(longest_piece(gyro_of(s)) for s in (spec, *scenarios)),
        )
        kind = "the same moves in each" if alike else "each with its own moves"
        words = f"{cycles * groups} visits of {each:.4g} s, {kind}"
        start = None if own_plan is None else _among(coordinates, cycle.moves)
        candidates.append(Structure(coordinates, words, start))
    # A program of its own, for a plan of more moves than are searched.
    outside = own_plan is not None and all(candidate.start is None for candidate in candidates)
    return candidates + ([own_plan._replace(alone=True)] if own_plan is not None and outside else [])


def _frame(spec: Spec, cycle: ResolvedCycle, own: float, other: float, time: float) -> Frame:
    start, end = ramp_ends(spec)
    return Frame(own, other, time, start, end, read_spacing(cycle))


def read_spacing(cycle: ResolvedCycle) -> float:
    """How often a standing axis is read, s."""
    spacings = [m.read_every for m in cycle.moves if m.is_rest and m.read_every is not None]
    return spacings[0] if spacings else (cycle.other_read_every or 1.0)


def ramped_shape(cycle: ResolvedCycle) -> str:
    """The shape of the turns of a search: the first ramped one of the cycle."""
    return next((m.shape for m in cycle.moves if m.shape in RAMPED_SHAPES), "cosine ramps")


def _elements(shape: str, groups: int, moves: int, rest: float, *, not_shared: bool, ends: bool) -> tuple[Element, ...]:
    """Turns with rests between, after a first rest; a rest also after the last turn where no other rest follows it."""
    elements = [Element("rest", rest, 0)]
    for group in range(groups):
        for i in range(moves):
            elements.append(Element(shape, LEAST_TURN, group))
            if i < moves - 1 or not_shared or (ends and group == groups - 1):
                elements.append(Element("rest", rest, group))
    return tuple(elements)


def _among(coordinates: Coordinates, moves: Sequence[ResolvedMove]) -> np.ndarray | None:
    """The vector in which every turn at the table has these moves, but for the rest before the first of them where
    other axes turn then; None where they are more, or of other shapes, than the structure's."""
    turns, rests = [m for m in moves if not m.is_rest], [0.0]
    for move in moves:
        if move.is_rest:
            rests[-1] += move.duration
        else:
            rests.append(0.0)
    elements = coordinates.elements()
    durations, peaks, ramps = np.array([e.least for e in elements]), np.zeros(len(elements)), np.zeros(len(elements))
    group, turned = -1, 0
    for k, element in enumerate(elements):
        turned = 0 if element.group != group else turned
        group = element.group
        if element.shape == "rest":
            durations[k] = max(rests[turned] if turned < len(rests) else 0.0, element.least)
            continue
        if turned < len(turns):
            if turns[turned].shape != element.shape:
                return None
            durations[k], peaks[k], ramps[k] = turns[turned].duration, turns[turned].peak_rate, turns[turned].ramp
        turned += 1
    if turned < len(turns):
        return None
    span = float(coordinates.frame.temperature_end) - float(coordinates.frame.temperature_start)
    steps = span * np.asarray(coordinates.lasting()) / float(coordinates.frame.motion_time)
    return coordinates.vector(CycleNumbers(durations, peaks, ramps, steps))


def _unsuited(moves: Sequence[ResolvedMove]) -> str:
    """Why a search cannot begin with these moves; empty where it can."""
    shapes = {m.shape for m in moves} - {"rest", *RAMPED_SHAPES}
    if shapes:
        return f"optimise cannot change a move of shape {sorted(shapes)[0]!r}: add duration to design.free"
    spacings = sorted(
        {"at the end" if m.read_every is None else f"every {m.read_every:g} s" for m in moves if m.is_rest}
    )
    if len(spacings) > 1:
        return (
            f"optimise needs the same readings in all rests, but some rests of this plan are read {spacings[0]} and "
            f"others {' or '.join(spacings[1:])}: give all rests the same read_every"
        )
    if any(m.other_axes for m in moves):
        return "optimise cannot change a rest with other_axes: add duration to design.free"
    return ""


def _spec_cycle(
    spec: Spec, scenarios: list[Spec], cycle: ResolvedCycle, free: frozenset[str], time: float
) -> Structure:
    """The moves of the spec's own cycle, which is the start."""
    moves, own, other = cycle.moves, cycle.moving, cycle.other + cycle.idle
    visits = repetitions(time, own, own + other)[0]
    numbers = lambda name: np.array([float(getattr(m, name)) for m in moves])  # noqa: E731
    frame = _frame(spec, cycle, own, other, time)
    shortest = {True: float(frame.read_every), False: LEAST_TURN}
    least = [min(shortest[m.is_rest], m.duration) if "duration" in free else 0.0 for m in moves]
    nominal = CycleNumbers(numbers("duration"), numbers("peak_rate"), numbers("ramp"), np.zeros(visits))
    coordinates = make_coordinates(
        tuple(Element(m.shape, shortest_) for m, shortest_ in zip(moves, least, strict=True)),
        limits_of(spec, scenarios),
        frame,
        cycles=visits,
        others_read=cycle.other_read_every is not None,
        free=free,
        nominal=nominal,
        longest_piece=min(longest_piece(gyro_of(s)) for s in (spec, *scenarios)),
    )
    span = float(frame.temperature_end) - float(frame.temperature_start)
    begin = nominal._replace(steps=span * np.asarray(coordinates.lasting()) / time)
    return Structure(coordinates, f"{visits} cycles with the moves in the spec", coordinates.vector(begin))


# The search sees a requirement's box on a grid of at most this many temperatures and rates.
_GRID = 41


class Measure(NamedTuple):
    """The objective of a [design] as a function of a plan's numbers.

    `cases`, `factors`, `targets`, `robust`: of an `Objective`, which `compiled` makes for coordinates.
    """

    objective: ExactObjective
    cases: tuple[Case, ...]
    factors: np.ndarray
    targets: np.ndarray
    robust: Literal["worst", "mean"]

    @property
    def limits(self) -> tuple[str, ...]:
        """What has a target that is a limit."""
        return tuple(aim.name for aim in self.objective.aims if aim.limiting)

    def compiled(self, coordinates: AnyCoordinates) -> Compiled:
        """The objective over coordinates, through the program of the class of their sizes."""
        # Any plan in which everything moves determines the quadrature rule.
        plan = coordinates.decode(np.linspace(0.1, 0.9, coordinates.size))
        lines = [case.trajectory(plan) for case in self.cases]
        cases = tuple(replace(c, rule=rule_of(c.model, line)) for c, line in zip(self.cases, lines, strict=True))
        whole, places = coordinates, None
        if isinstance(coordinates, Coordinates):
            whole = coordinates.padded()
            places = coordinates.places_in(whole)
        objective = Objective(whole, cases, self.factors, self.targets, self.robust)
        return Compiled(objective, whole.size, places)

    def logs(self, schedule: Schedule) -> np.ndarray:
        """Logarithms of the exact value of one plan, and of its excess over limits."""
        value, excess = Objective(None, self.cases, self.factors, self.targets, self.robust).of_schedule(schedule)
        return np.log([value, *np.exp(excess)])

    def exact(self, schedule: Schedule) -> float:
        """The exact value of one plan, in the unit."""
        return float(np.exp(self.logs(schedule)[0]))


def design_of(spec: Spec) -> Design:
    """The spec's [design]. Errors: `ValueError` where it has none."""
    if spec.design is None:
        raise ValueError(
            f"the spec has no [design]: state the objective and the free parts. To paste:\n\n{design_block(spec)}"
        )
    return spec.design


def design_block(spec: Spec) -> str:
    """A [design] for the spec's own requirement and kind of plan, as text to paste."""
    name = spec.requirement[0].name if spec.requirement else "D-optimality"
    if isinstance(spec.plan, StandardPlan):
        free = '"temperatures", "integration"' + (', "rates"' if any(spec.plan.rates or ()) else "")
    elif not spec.turns_one_gyro:
        return f'[design]\nminimise = "{name if spec.requirement else ALL}"'
    else:
        free = '"duration", "peak_rate"' if spec.plan.cycle is not None else '"programme"'
    return f'[design]\nminimise = "{name}"\nfree     = [{free}]\nstarts   = 8'


def measure(spec: Spec) -> Measure:
    """The objective of the spec's [design]."""
    design, exact = design_of(spec), ExactObjective(spec)
    counted = [aim for aim in exact.aims if aim.counted]
    limiting = [aim for aim in exact.aims if aim.limiting]
    cases = []
    for case, whole in zip(exact.cases, exact.builts, strict=True):
        one = case.spec
        if design.whole_turns:
            # Whole turns cancel the encoder's harmonics; while turns are not yet whole, these only disturb the search.
            one = changed(one, {"rig.table.axis[0].angle.harmonics": None})
        built = assemble(one)
        model = built.model
        criteria: dict[str, Any] = {}
        for r, aim in zip(spec.requirement, exact.aims, strict=False):
            if aim.counted or aim.limiting:
                criteria[r.name] = counted_criterion(criterion_of(model, r, aim.statistic, _GRID), whole)
        if design.minimise in OPTIMALITIES:
            criteria[design.minimise] = optimality(model, design.minimise)
        own, limits = (tuple(criteria[aim.name] for aim in of) for of in (counted, limiting))
        lag = None if built.thermal_lag is None else np.asarray(built.thermal_lag)
        cases.append(Case(model, lag, own, limits, np.asarray(case.weight)))
    # A criterion is SI.
    factors = np.array([aim.per_si / aim.limit for aim in counted])
    targets = np.array([aim.limit / aim.per_si for aim in limiting])
    return Measure(exact, tuple(cases), factors, targets, design.robust if len(cases) > 1 else "mean")


def criterion_of(
    model: SensorModel, requirement: Requirement, name: Statistic | None = None, most: int | None = None
) -> Criterion:
    """A gyro's requirement, by its own statistic or that of a `name`, as a criterion of its model's parameters (SI).
    `most`: see `box`; for a search, which interpolates a polynomial map between few places."""
    name, at, between = name or requirement.statistic, box(requirement, most), None
    shape = len(at[0]), len(at[1])
    quantity = SCALE_FACTOR if requirement.quantity.endswith("scale_factor") else BIAS
    if most is not None and not isinstance(requirement, MissionHeadingRequirement):
        at, between = _few_places(map_of(model, quantity), *at)
    if isinstance(requirement, MissionHeadingRequirement):
        of = heading_contrasts(model, requirement)
    else:
        of = contrasts(model, quantity, *(g.ravel() for g in np.meshgrid(*at, indexing="ij")))
    # Such that the unweighted statistic of missions is the weighted one.
    rows, alone, beyond = of.times(mission_weights(requirement, name)[:, 0])
    return Criterion(rows, alone if np.any(alone) else None, beyond, shape, name, between)


def _few_places(of: Map, temperatures: np.ndarray, rates: np.ndarray):
    """The places at which a map's residual is evaluated, and the matrices that interpolate it onto the grid."""
    bases = [(of.temperature, of.beyond and of.beyond.temperature), (of.rate, of.beyond and of.beyond.rate)]
    pairs = []
    for at, both in zip((temperatures, rates), bases, strict=True):
        degrees = [
            b.degree if isinstance(b, Polynomial | HigherPolynomials) else len(at) for b in both if b is not None
        ]
        pairs.append(polynomial_grid(at, max(degrees, default=0)))
    (few_t, by_t), (few_w, by_w) = pairs
    return (few_t, few_w), (by_t, by_w)
