"""The search for the course of one gyro's turns, of the chamber, or of set points, that minimises a [design]'s
objective; its result as a spec, rounded to the controllers' steps, with the limits that bind it."""

import math
from collections.abc import Callable, Iterator
from typing import Any, Final, NamedTuple

import numpy as np

from gradcal_jax.design import (
    KEPT,
    STEEPNESS,
    AnyCoordinates,
    Coordinates,
    CycleNumbers,
    Element,
    Limits,
    Optimum,
    ProgrammeCoordinates,
    SearchState,
    StandardCoordinates,
    exactly,
    multipliers,
    polish,
    search,
)
from gradcal_jax.design.plan_objective import scenario_specs
from gradcal_jax.design.searching import Optimised, PlanOutcome, Price, PricedLimit, priced
from gradcal_jax.design.turn_plan import Measure, design_of, measure, reading_spacing, structures
from gradcal_jax.recipe.rounding import ControllerSteps, steps_of
from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.spec_sections import Spec

DEG = math.pi / 180.0
# A stretch of fewer steps of slope becomes a soak: rounding would change its duration too much.
_LEVEL = 5
# Resolution of the soak that fills the end of a programme; s.
_TIME = 0.1
# Steps of time by which a turn may become longer to fit; a difference of a visit's time that is negligible, s.
_LONGER = 100
_LEFT = 1e-6
_ROUNDING = 1.0 + 1e-9


def plan_to_spec(spec: Spec, coordinates: AnyCoordinates, point: np.ndarray) -> Spec:
    """The spec with the plan of a point of the coordinates, rounded to the controllers' steps."""
    if isinstance(coordinates, StandardCoordinates):
        return _standard(spec, *coordinates.plan_of(point))
    if isinstance(coordinates, ProgrammeCoordinates):
        return changed(spec, programme_keys(spec, coordinates, point))
    return _cycle(spec, coordinates, coordinates.cycle(point))


def _standard(spec: Spec, temperatures: np.ndarray, rates: np.ndarray, integration: float) -> Spec:
    steps = steps_of(spec)
    warm, quick, brief = (float(v) for v in (steps.temperature, steps.rate, steps.time))
    temperatures = np.round(temperatures / warm) * warm
    rates = np.round(rates / quick) * quick / DEG
    keys: dict[str, object] = {
        "plan.temperatures": [_c(t) for t in temperatures],
        "plan.integration": _s(math.floor(integration / brief + 1e-9) * brief),
    }
    if np.any(rates):
        keys["plan.rates"] = [f"{r:.9g} deg/s" for r in rates]
    return changed(spec, keys)


def programme_keys(spec: Spec, coordinates: ProgrammeCoordinates, point: np.ndarray) -> dict[str, object]:
    """The keys of a spec's course: stretches at slopes and temperatures of the controller's steps, no steeper than the
    chamber allows."""
    programme, steps = coordinates.programme(point), steps_of(spec)
    here = _on_grid(float(programme.start), float(steps.temperature))
    soak = {"soak": _s(float(coordinates.soak)), "at": _c(here), "used": coordinates.soak_used}
    chamber = _Chamber(*(float(getattr(coordinates, name)) for name in _Chamber._fields))
    ends, goals = np.cumsum(programme.durations), programme.chamber()[1]
    return _free_programme(soak, _stretches(here, ends, goals, chamber, steps))


def _free_programme(soak: dict[str, object], stretches: list[dict[str, object]]) -> dict[str, object]:
    return {"plan.temperature": None, "plan.gradient": None, "plan.soak": None, "plan.programme": [soak, *stretches]}


class _Chamber(NamedTuple):
    """Range (°C) and largest slopes (K/s)."""

    coldest: float
    warmest: float
    heating: float
    cooling: float


def _on_grid(value: float, step: float) -> float:
    return round(value / step) * step


def _stretches(
    here: float, ends: np.ndarray, goals: np.ndarray, chamber: _Chamber, steps: ControllerSteps
) -> list[dict[str, object]]:
    """Ramps and soaks with slopes and temperatures of the controller's steps, near the `goals` at the times `ends` (s).

    The next stretch compensates the rounding of one; a stretch that rounds to nothing is a soak.
    """
    slope_step, step = float(steps.slope), float(steps.temperature)
    items: list[dict[str, object]] = []
    written_s, went_up = 0.0, False
    for end, goal in zip(ends, goals, strict=True):
        lasting = float(end) - written_s
        up = float(goal) > here
        steepest, room = (chamber.heating, chamber.warmest - here) if up else (chamber.cooling, here - chamber.coldest)
        count = min(round(abs(float(goal) - here) / lasting / slope_step), int(steepest / slope_step + 1e-6))
        slope = count * slope_step
        change = math.floor(min(slope * lasting, room) / step + 1e-6) * step
        if count < _LEVEL or change <= 0.0:
            whole = float(round(lasting))
            items.append({"soak": _s(whole), "used": True})
            written_s += whole
            continue
        here = _on_grid(here + (change if up else -change), step)
        ramp: dict[str, object] = {"ramp_to": _c(here), "rate": f"{slope * 60.0:.12g} K/min"}
        if items and items[-1].get("rate") == ramp["rate"] and up == went_up:
            items[-1] = ramp
        else:
            items.append(ramp)
        written_s, went_up = written_s + change / slope, up
    if (left := float(ends[-1]) - written_s) > _TIME:
        items.append({"soak": _s(_TIME * math.ceil(left / _TIME - 1e-6)), "used": True})
    return items


def _cycle(spec: Spec, coordinates: Coordinates, cycle: CycleNumbers) -> Spec:
    """Rests become whole numbers of readings; turns are written by angle, rate and duration, each on its grid."""
    frame = coordinates.frame
    every = float(frame.read_every)
    axis: dict[str, object] = {"axis": spec.rig.table.axis[0].name}
    reading = {} if coordinates.others_read else {"read": "none"}
    visits: list[list[_Move]] = [[] for _ in range(coordinates.groups)]
    for move in _moves(spec, coordinates, cycle):
        moves = visits[move.element.group]
        if not move.angle and moves and not moves[-1].angle:
            # A turn that rounded to nothing belongs to the rest beside it.
            moves[-1] = moves[-1]._replace(duration=moves[-1].duration + move.duration)
        else:
            moves.append(move)
    idle = float(frame.other_time) if frame.other_time > 1e-6 else 0.0
    every_move: list[dict[str, object]] = []
    for group, moves in enumerate(visits):
        if group and idle:
            every_move.append({"rest": _s(idle), "other_axes": True, **reading})
        for move in moves:
            every_move.append(move.keys() | axis if move.angle else {"rest": _s(move.duration)})
    cycle_tables: dict[str, object] = {"moves": every_move}
    if idle:
        cycle_tables["other_axes"] = {"duration": _s(idle), "read": coordinates.others_read}
    # Every rest is read as the table is.
    spacing = {} if every == reading_spacing(spec) else {"rig.table.axis[0].angle.read_every": _s(every)}
    return changed(spec, {"plan.cycle": cycle_tables, **spacing, **_programme(spec, coordinates, cycle)})


class _Move(NamedTuple):
    """A move on the controllers' grids: a turn by `angle` with ramps of about `ramp`; a rest where `angle` is zero.

    `peak`: of a ramped turn, at which that angle takes just that duration.
    """

    element: Element
    duration: float
    ramp: float = 0.0
    angle: float = 0.0
    peak: float = 0.0

    def keys(self) -> dict[str, object]:
        """The keys of a turn in a spec."""
        turns = self.angle / (2.0 * math.pi)
        whole = abs(turns - round(turns)) < 1e-12 * abs(turns)
        angle = {"turns": round(turns)} if whole else {"turn": f"{self.angle / DEG:.12g} deg"}
        peak = {"peak_rate": f"{self.peak / DEG:.9g} deg/s"} if self.peak else {}
        return {"shape": self.element.shape, **angle, **peak, "duration": _s(self.duration)}

    def lasting(self, duration: float, limits: Limits, step: float) -> "_Move | None":
        """The same turn in another time, its rate a multiple of `step`; None where it does not fit.

        With ramps r a turn of θ in D has the rate θ/(D − r), at least θ/D without ramps and 2θ/D with nothing else; and
        the table's acceleration allows those between the roots of `steep ω² − D ω + θ`.
        """
        size, steep = abs(self.angle), STEEPNESS[self.element.shape] / float(limits.max_acceleration)
        if (square := duration**2 - 4.0 * steep * size) < 0.0:
            return None
        root = math.sqrt(square)
        least = max(size / (duration - min(self.ramp, 0.5 * duration)), 2.0 * size / (duration + root))
        most = min(float(limits.max_rate), 2.0 * size / duration, 0.5 * (duration + root) / steep)
        peak = math.ceil(least / step - 1e-6) * step
        return self._replace(duration=duration, peak=peak) if 0.0 < peak <= most * _ROUNDING else None

    def lesser(self, duration: float, limits: Limits, step: float, fine: float) -> "_Move | None":
        """The same turn shortened to `duration` at its rate, its angle a multiple of `fine` (rad)."""
        short = self._replace(duration=duration, angle=0.0, peak=0.0)
        count = _most(short, math.copysign(self.peak, self.angle), limits, fine) if duration > 0.0 else 0
        return short._replace(angle=count * fine).lasting(duration, limits, step) if count else None


def _moves(spec: Spec, coordinates: Coordinates, cycle: CycleNumbers) -> list[_Move]:
    """The moves on the controllers' grids.

    Rates are kept or, where travel is limited, the positions at which turns end: rounding then does not accumulate over
    the cycles, and a cycle ends where it began. A turn that does not fit into its time gets more of it, from the
    longest turn of its visit or else from its longest rests, reading by reading.
    """
    steps, limits = steps_of(spec), coordinates.limits
    every, quick, brief, fine = (float(v) for v in (coordinates.frame.read_every, steps.rate, steps.time, steps.angle))
    if spec.design is not None and spec.design.whole_turns:
        fine = 2.0 * math.pi
    durations = _rounded(coordinates, np.asarray(cycle.durations), every, brief)
    places, here = np.cumsum(coordinates.angles(cycle)), 0
    furthest = math.floor(float(limits.travel) / fine + 1e-6) if coordinates.travels else 0
    moves: list[_Move] = []
    for i, element in enumerate(coordinates.elements()):
        rest = _Move(element, float(durations[i]), float(cycle.ramps[i]))
        if element.shape == "rest":
            moves.append(rest)
            continue
        if coordinates.travels:
            count = max(-furthest, min(furthest, round(places[i] / fine))) - here
        else:
            count = _most(rest, float(cycle.peak_rates[i]), limits, fine)
        times = rest.duration + brief * np.arange(_LONGER)
        turns = (rest._replace(angle=count * fine).lasting(float(d), limits, quick) for d in times) if count else ()
        move = next((turn for turn in turns if turn is not None), rest)
        here += count if move.angle else 0
        moves.append(move)
    for group in range(coordinates.groups):
        _fill([i for i, m in enumerate(moves) if m.element.group == group], moves, coordinates, every, quick, fine)
    return moves


def _most(rest: _Move, peak: float, limits: Limits, fine: float) -> int:
    """The angle, in multiples of `fine` (rad), of a turn with about that peak rate in its time and acceleration."""
    duration, steepest = rest.duration, float(limits.max_acceleration) / STEEPNESS[rest.element.shape]
    size = abs(peak) * (duration - min(max(rest.ramp, abs(peak) / steepest), 0.5 * duration))
    size = min(size, 0.25 * duration**2 * steepest)
    # Angles in thousandths of a degree are rounded towards zero, whole turns to the nearest.
    count = math.floor(size / fine + (0.5 if fine > 1.0 else 1e-6))
    while count and rest._replace(angle=count * fine).lasting(duration, limits, 1e-9) is None:
        count -= 1
    return int(math.copysign(count, peak))


def _fill(
    members: list[int], moves: list[_Move], coordinates: Coordinates, every: float, step: float, fine: float
) -> None:
    """Make the moves of a visit fill its time if they can; turns become smaller only where nothing else helps."""
    turns = sorted((i for i in members if moves[i].angle), key=lambda i: -moves[i].duration)
    left = float(coordinates.frame.own_time) - sum(moves[i].duration for i in members)
    while abs(left) > _LEFT:
        for i in turns:
            other = moves[i].lasting(moves[i].duration + left, coordinates.limits, step)
            if other is not None and other.duration > 0.0:
                moves[i] = other
                return
        longest = max((i for i in members if not moves[i].angle), key=lambda i: moves[i].duration, default=None)
        if left > 0.0:
            return
        if longest is None or moves[longest].duration < 1.5 * every:
            lesser = (moves[i].lesser(moves[i].duration + left, coordinates.limits, step, fine) for i in turns)
            shorter = next(((i, turn) for i, turn in zip(turns, lesser, strict=True) if turn is not None), None)
            if shorter is not None and not coordinates.travels:
                moves[shorter[0]] = shorter[1]
            return
        moves[longest] = moves[longest]._replace(duration=moves[longest].duration - every)
        left += every


def _rounded(coordinates: Coordinates, durations: np.ndarray, every: float, step: float) -> np.ndarray:
    """Durations with rests of whole numbers of readings; each visit's longest turn takes the rest of its time."""
    own = float(coordinates.frame.own_time)
    rounded = np.empty_like(durations)
    elements = coordinates.elements()
    for group in range(coordinates.groups):
        members = [i for i, e in enumerate(elements) if e.group == group]
        turns = [i for i in members if elements[i].shape != "rest"]
        for i in members:
            is_rest = elements[i].shape == "rest"
            unit = every if is_rest else step
            rounded[i] = max(1, round(durations[i] / unit)) * unit
        last = max(turns or members, key=lambda i: durations[i])
        rounded[last] = max(step, own - sum(rounded[i] for i in members if i != last))
    return rounded


def _programme(spec: Spec, coordinates: Coordinates, cycle: CycleNumbers) -> dict[str, object]:
    """The ramp: one slope, or one from each turn at the table to the next."""
    frame = coordinates.frame
    start, end = float(frame.temperature_start), float(frame.temperature_end)
    soak = spec.gradient_schedule.segments[0]
    if "gradient" not in coordinates.free:
        rate = abs(end - start) / float(frame.motion_time)
        # The slope determines the time, and is written with all its digits.
        return {
            "plan.programme": None,
            "plan.temperature": [_c(start), _c(end)],
            "plan.gradient": f"{rate * 60.0:.12g} K/min",
            "plan.soak": {"duration": _s(soak.duration), "used": False} if soak.kind == "soak" else None,
        }
    soaked = {"soak": _s(soak.duration) if soak.kind == "soak" else "1 s", "at": _c(start), "used": False}
    rig, ends, goals = spec.rig.chamber, np.cumsum(coordinates.lasting()), start + np.cumsum(cycle.steps)
    chamber = _Chamber(*(float(v) for v in (*rig.range, rig.max_heating, rig.max_cooling)))
    return _free_programme(soaked, _stretches(start, ends, goals, chamber, steps_of(spec)))


def _s(seconds: float) -> str:
    return f"{seconds:.9g} s"


def _c(temperature: float) -> str:
    return f"{temperature:.12g} degC"


STEPS: Final = 240
_UNPOLISHED: Final = "not converged: the last descent, from the best plan, was left out"
# A point is proposed once it is better than the last one by this factor: its plan takes longer to judge than a value.
_NEWS: Final = 0.95
# A turn within this share of its limit counts as limited.
_AT_LIMIT: Final = 1e-3
_FIRST: Final = 100
_POLISH: Final = 1000
_POLISHES: Final = 3
_BRIEF_POLISH: Final = 40
# The largest relative increase of the objective for which vanished turns are left out.
_NO_WORSE: Final = 1e-3
# A larger relative cost of rounding is reported.
_DEAR: Final = 0.05
# Rounds of random steps from the best programme at most, their sizes, the steps of each descent, and the gain of a
# round that counts as none.
_ROUNDS: Final = 6
_HOP_SIZES: Final = (0.1, 0.3, 0.6, 1.0) * 4
_HOP_STEPS: Final = 100
_NO_GAIN: Final = 1e-5


class _At(NamedTuple):
    """Where a search is: the number of a structure, and the state there."""

    structure: int
    state: SearchState


def belief_of(spec: Spec) -> str:
    """A sentence on the maps that a design takes as exact; empty where each has a discrepancy or smoothness."""
    gyro = spec.sensor.gyro
    sections = {} if gyro is None else {"bias": gyro.bias, "scale factor": gyro.scale_factor}
    sure = [name for name, s in sections.items() if s is not None and s.discrepancy is None and s.smoothness is None]
    if not sure:
        return ""
    return (
        f"assumed: the {' and the '.join(sure)} {'have' if len(sure) > 1 else 'has'} exactly the structure in the "
        "spec; if the spec states a discrepancy, the plan is robust against deviations from this structure"
    )


class TurnPoint(NamedTuple):
    """A plan of a structure: its coordinates, the vector, and the structure in words."""

    coordinates: AnyCoordinates
    vector: np.ndarray
    words: str


class TurnSearch:
    """The search for one gyro along the only axis of a table: of every structure, many starts; then a polish.

    `steps`: iterations of each start. `quick`: few starts, and a brief polish by the same program. `motion` s: time
    without soaks, in the place of [design]'s; the spec's own plan, which has another, then counts for nothing.
    """

    def __init__(
        self, spec: Spec, *, steps: int, quick: bool, motion: float | None, stop: Callable[[], bool] = lambda: False
    ) -> None:
        self._of, self._options = measure(spec), {"steps": steps, "quick": quick, "stop": stop}
        self._choices = structures(spec, [s for s, _ in scenario_specs(spec)], motion=motion)
        self.objective, self.own_counts = self._of.objective, motion is None
        self._best: _At | None = None
        self._optimum: tuple[AnyCoordinates, Optimum] | None = None

    def run(self) -> Iterator[tuple[float, TurnPoint]]:
        """The best point after every descent, or one that is not much worse."""
        design, stop = design_of(self.objective.spec), self._options["stop"]
        point, proposed = None, np.inf
        for k, choice in enumerate(self._choices):
            options = {"starts": design.starts, "seed": design.seed, "begin": choice.start, "alone": choice.alone}
            for progress in search(self._of.compiled(choice.coordinates), **options, **self._options):
                if self._best is None or progress.best < self._best.state.best:
                    self._best = _At(k, progress.state)
                if point is None or self._best.state.best < _NEWS * proposed:
                    point, proposed = self._point(self._best), self._best.state.best
                yield 0.95 * (k + progress.step / progress.steps) / len(self._choices), point
                if stop():
                    break
            if stop():
                break
        assert self._best is not None
        point, quick = self._point(self._best), self._options["quick"]
        if stop():
            # A polish, with the program that it may have to compile, takes seconds.
            yield 1.0, point
            return
        coordinates, optimum = self._optimum = polished(self._of, *point[:2], design.seed, stop, quick=quick)
        yield 1.0, TurnPoint(*_pruned(self._of, coordinates, optimum.point), point.words)

    def _point(self, at: _At) -> TurnPoint:
        choice = self._choices[at.structure]
        return TurnPoint(choice.coordinates, at.state.best_point, choice.words)

    def plan_of(self, point: TurnPoint) -> tuple[Spec, str]:
        """The plan of a point, and its structure in words."""
        return plan_to_spec(self.objective.spec, point.coordinates, point.vector), point.words

    def record(self, best: Optimised, point: TurnPoint | None, last: PlanOutcome) -> dict[str, Any]:
        """The optimum before rounding, and what rounding made of it."""
        if self._optimum is None or self._best is None:
            stopped = self._options["stop"]()
            return {"sentence": _UNPOLISHED if stopped else "", "converged": not stopped}
        coordinates, optimum = self._optimum
        spec, sentence = self.objective.spec, optimum.sentence
        if last.trouble:
            sentence = f"the optimum cannot be rounded to the controllers' steps: {last.trouble}"
        elif not np.isfinite(last.value):
            hint = "state finer steps in [rig.resolution]"
            name = design_of(spec).minimise
            if any(r.name == name and r.quantity == "mission_heading" for r in spec.requirement):
                hint = "add priors for the maps, or targets for other requirements: a mission alone is not enough"
            sentence = (
                f"after rounding to the controllers' steps, some requirements are not observable: {hint}; {sentence}"
            )
        elif last.value > (1.0 + _DEAR) * optimum.value:
            more = 100.0 * (last.value / optimum.value - 1.0)
            sentence += (
                f"; rounding to the controllers' steps and to whole readings increases the objective by {more:.2g} %: "
                "if the controllers accept finer steps, state them in [rig.resolution]"
            )
        compiled = self._of.compiled(self._choices[self._best.structure].coordinates)
        ends = [exactly(compiled, end) for end in self._best.state.points]
        turns = coordinates if point is not None and isinstance(coordinates, Coordinates) else None
        return {
            "sentence": sentence,
            "converged": optimum.converged and bool(np.isfinite(last.value)) and not best.kept,
            "optimum": optimum.value,
            "starts": tuple(sorted(value if np.all(excess <= KEPT) else float(np.inf) for value, excess in ends)),
            "gradient_norm": optimum.gradient_norm,
            "active": () if turns is None else active_limits(turns, optimum.point),
            "prices": () if turns is None else shadow_prices(self._of, turns, optimum),
        }


def polished(
    of: Measure,
    coordinates: AnyCoordinates,
    point: np.ndarray,
    seed: int = 0,
    stop: Callable[[], bool] = lambda: False,
    *,
    quick: bool = False,
) -> tuple[AnyCoordinates, Optimum]:
    """The local optimum from the best point of a search, with its coordinates; without turns that vanish."""
    # Fewer turns would be another size class, which would have to be compiled.
    if not quick:
        coordinates, point = _pruned(of, coordinates, point)
    if isinstance(coordinates, ProgrammeCoordinates):
        return coordinates, best_programme(of, coordinates, point, seed, stop)
    if quick:
        return coordinates, polish(of.compiled(coordinates), point, steps=_BRIEF_POLISH, names=of.limits)
    optimum = polish(of.compiled(coordinates), point, steps=_FIRST, rounds=1, names=of.limits)
    for _ in range(_POLISHES):
        if optimum.converged:
            break
        # A vanishing turn leaves a flat valley in which a polish does not converge, so it is removed.
        fewer, point = _pruned(of, coordinates, optimum.point)
        again = polish(of.compiled(fewer), point, steps=_POLISH, rounds=1, names=of.limits)
        allowed = optimum.value * (1.0 + _NO_WORSE) if fewer.size < coordinates.size else optimum.value
        if not again.held or again.value > allowed:
            break
        gained = again.value < optimum.value or fewer.size < coordinates.size
        coordinates, optimum = fewer, again
        if not gained:
            break
    return coordinates, optimum


def best_programme(
    of: Measure, coordinates: ProgrammeCoordinates, point: np.ndarray, seed: int, stop: Callable[[], bool]
) -> Optimum:
    """Polish a programme, then polish from random steps about the best until they gain nothing: programmes that lie on
    different limits are separate local optima, and where slopes are clipped the gradient need not vanish."""
    objective, generator = of.compiled(coordinates), np.random.default_rng(seed)
    optimum = polish(objective, point, names=of.limits)
    for _ in range(_ROUNDS):
        before = optimum.value
        for size in _HOP_SIZES:
            if stop():
                return optimum
            other = optimum.point + size * generator.standard_normal(point.shape)
            other = polish(objective, other, steps=_HOP_STEPS, rounds=1, names=of.limits)
            if other.held and (other.value < optimum.value or not optimum.held):
                optimum = other
        if optimum.held and optimum.value > (1.0 - _NO_GAIN) * before:
            sentence = f"converged: none of {len(_HOP_SIZES)} descents from nearby points ends at a lower value"
            return optimum if optimum.converged else optimum._replace(converged=True, sentence=sentence)
    return optimum


def _pruned(of: Measure, coordinates: AnyCoordinates, point: np.ndarray) -> tuple[AnyCoordinates, np.ndarray]:
    """The plan without turns that shrank to nothing, unless that costs more than rounding may: a plan of few turns may
    need even the briefest.

    Where travel is limited all turns may be brief; there those that round to nothing are written as rests.
    """
    if not isinstance(coordinates, Coordinates) or "duration" not in coordinates.free or coordinates.travels:
        return coordinates, point
    fewer, cycle = coordinates.pruned(coordinates.cycle(np.asarray(point)))
    left = fewer.vector(cycle)
    if of.exact(fewer.decode(left)) > (1.0 + _DEAR) * of.exact(coordinates.decode(point)):
        return coordinates, point
    return fewer, left


def active_limits(coordinates: Coordinates, point: np.ndarray) -> tuple[str, ...]:
    """Which limits bind, in words."""
    cycle = coordinates.cycle(point)
    peaks = np.abs(cycle.peak_rates)[coordinates.turns]
    fastest = int(np.sum(peaks > float(coordinates.limits.max_rate) * (1.0 - _AT_LIMIT)))
    binding = ["the time for turns of this axis"]
    if fastest:
        binding.append(f"the maximum rate, in {fastest} of {len(peaks)} turns")
    if coordinates.travels:
        angles = np.cumsum(coordinates.angles(cycle))
        if np.max(np.abs(angles)) > float(coordinates.limits.travel) * (1.0 - _AT_LIMIT):
            binding.append("the travel")
    if "gradient" in coordinates.free:
        slopes = np.abs(cycle.steps) / coordinates.lasting()
        steep = int(np.sum(slopes > float(coordinates.limits.max_slope) * (1.0 - _AT_LIMIT)))
        if steep:
            binding.append(f"the chamber's slope, in {steep} of {len(slopes)} parts of the ramp")
    return tuple(binding)


def shadow_prices(of: Measure, coordinates: Coordinates, optimum: Optimum) -> tuple[Price, ...]:
    """The objective's derivatives in the limits. At an optimum the derivative through the free numbers vanishes
    (envelope theorem); the multipliers count that easing a limit also changes the binding targets."""
    limits, costs = coordinates.limits, np.append(1.0, multipliers(of.compiled(coordinates), optimum.point))
    travel = limits.travel if coordinates.travels else 0.0
    slope = limits.max_slope if "gradient" in coordinates.free else 0.0
    sizes = coordinates.frame.motion_time, limits.max_rate, limits.max_acceleration, travel, slope
    rows = [PricedLimit(*row, float(size)) for row, size in zip(PRICED, sizes, strict=True)]
    logs = lambda by: of.logs(coordinates.eased(by).decode(optimum.point))  # noqa: E731
    return priced(optimum.value, rows, lambda by: float(costs @ logs(by)))


# Limits by the index of `Coordinates.eased`: name, unit in which the limit is eased, and that unit in SI.
PRICED: Final = (
    ("ramp time (cycle and turns longer in proportion)", "minute", 60.0),
    ("largest rate", "deg/s", np.pi / 180.0),
    ("largest acceleration", "deg/s^2", np.pi / 180.0),
    ("travel", "turn", 2.0 * np.pi),
    ("chamber slope", "K/min", 1.0 / 60.0),
)
