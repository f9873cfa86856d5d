"""A point of the free coordinates as a spec, rounded to the controllers' steps, that still fills its time."""

import math
from typing import NamedTuple

import numpy as np

from gradcal_jax.api.structures import reading_spacing
from gradcal_jax.design import (
    STEEPNESS,
    AnyCoordinates,
    Coordinates,
    CycleNumbers,
    Element,
    Limits,
    ProgrammeCoordinates,
    StandardCoordinates,
)
from gradcal_jax.files import changed
from gradcal_jax.files.rounding import ControllerSteps, steps_of
from gradcal_jax.files.spec_sections import Spec

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
