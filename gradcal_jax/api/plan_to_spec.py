"""A point of the free coordinates as a spec: rounded to what the controllers are told, still filling its time."""

import math
from typing import NamedTuple

import numpy as np

from gradcal_jax.api.structures import axes_of
from gradcal_jax.design import (
    AnyCoordinates,
    Coordinates,
    Cycle,
    ProgrammeCoordinates,
    ProgrammeKnots,
    StandardCoordinates,
)
from gradcal_jax.files import Spec, changed
from gradcal_jax.files.rounding import ControllerSteps, steps_of

DEG = math.pi / 180.0
# A stretch of fewer steps of slope is held level: its time would not survive the rounding.
_LEVEL = 5
# To which what is left at the end of a programme is written; s.
_TIME = 0.1
_STEEP = math.pi / 2.0  # peak acceleration over rate / ramp time, of cosine ramps


def plan_to_spec(spec: Spec, coordinates: AnyCoordinates, point: np.ndarray) -> Spec:
    """The spec with the plan of a point of the coordinates, rounded to what the controllers are told."""
    if isinstance(coordinates, StandardCoordinates):
        return _standard(spec, *coordinates.plan_of(point))
    if isinstance(coordinates, ProgrammeCoordinates | ProgrammeKnots):
        return _static(spec, coordinates, point)
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


def _static(spec: Spec, coordinates: ProgrammeCoordinates | ProgrammeKnots, point: np.ndarray) -> Spec:
    """Stretches at slopes and temperatures that the controller is told, as steep as the chamber manages at most."""
    steps, programme = steps_of(spec), coordinates.programme(point)
    here = _on_grid(float(programme.start), float(steps.temperature))
    items: list[dict[str, object]] = [
        {"soak": _s(float(coordinates.soak)), "at": _c(here), "used": coordinates.soak_used}
    ]
    chamber = _Chamber(*(float(getattr(coordinates, name)) for name in ("coldest", "warmest", "heating", "cooling")))
    items += _stretches(here, np.cumsum(programme.durations), programme.chamber()[1], chamber, steps)
    gone: dict[str, object] = {"plan.temperature": None, "plan.gradient": None, "plan.soak": None}
    return changed(spec, {**gone, "plan.programme": items})


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
    """Ramps and soaks whose slopes and temperatures the controller is told, at the times `ends` (s) near the `goals`.

    What rounding takes from one stretch is made up for in the next; a stretch that rounds to nothing is a soak.
    """
    slope_step, step = float(steps.slope), float(steps.temperature)
    items: list[dict[str, object]] = []
    written_s = 0.0
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
        items.append({"ramp_to": _c(here), "rate": f"{slope * 60.0:.12g} K/min"})
        written_s += change / slope
    if (left := float(ends[-1]) - written_s) > _TIME:
        items.append({"soak": _s(_TIME * math.ceil(left / _TIME - 1e-6)), "used": True})
    return items


def _cycle(spec: Spec, coordinates: Coordinates, cycle: Cycle) -> Spec:
    """Rests become whole numbers of readings."""
    frame = coordinates.frame
    every = float(frame.read_every)
    steps = steps_of(spec)
    time, rate = float(steps.time), float(steps.rate)
    whole = spec.design is not None and spec.design.whole_turns
    reading = {"read_every": _s(every)} if coordinates.others_read else {"read": "none"}
    durations = _rounded(coordinates, np.asarray(cycle.durations), every, time)
    visits: list[list[dict[str, object]]] = [[] for _ in range(coordinates.groups)]
    # Where travel is limited the angle is kept, not the rate; what rounding leaves of it is the next turn's.
    owed = 0.0
    given = spec.gradient_schedule.cycle
    axes = ["x"] if given is None else axes_of(given)
    angles = coordinates.angles(cycle)
    for i, element in enumerate(coordinates.elements()):
        moves = visits[element.group]
        if element.shape == "rest":
            moves.append({"rest": _s(durations[i]), "read_every": _s(every)})
            continue
        peak, ramp, angle = float(cycle.peak_rates[i]), float(cycle.ramps[i]), 0.0
        if coordinates.travels:
            owed += float(angles[i])
            peak = owed / (durations[i] - ramp)
        move = _turn(coordinates, durations[i], peak, ramp, rate, whole)
        if move is not None:
            moves.append({"shape": element.shape, "axis": axes[0], **move.keys})
            angle = move.angle
        else:
            moves.append({"rest": _s(durations[i]), "read_every": _s(every)})
        owed -= angle
    # What the plan's axes leave of the time between turns at the table is for axes that are not in the plan.
    idle = float(frame.other_time) - (len(axes) - 1) * float(frame.own_time)
    idle = idle if idle > 1e-6 else 0.0
    every_move: list[dict[str, object]] = []
    for group, moves in enumerate(visits):
        if group and idle:
            every_move.append({"rest": _s(idle), "other_axes": True, **reading})
        for axis in axes:
            every_move += [move | {"axis": axis} if "axis" in move else move for move in moves]
    cycle_tables: dict[str, object] = {"moves": every_move}
    if idle:
        other: dict[str, object] = {"duration": _s(idle), "read": coordinates.others_read}
        if coordinates.others_read:
            other["read_every"] = _s(every)
        cycle_tables["other_axes"] = other
    return changed(spec, {"plan.cycle": cycle_tables, **_programme(spec, coordinates, cycle)})


def _rounded(coordinates: Coordinates, durations: np.ndarray, every: float, step: float) -> np.ndarray:
    """Durations whose rests hold whole numbers of readings; each visit's longest turn takes what is left."""
    own = float(coordinates.frame.own_time)
    found = np.empty_like(durations)
    elements = coordinates.elements()
    for group in range(coordinates.groups):
        members = [i for i, e in enumerate(elements) if e.group == group]
        turns = [i for i in members if elements[i].shape != "rest"]
        for i in members:
            is_rest = elements[i].shape == "rest"
            unit = every if is_rest else step
            found[i] = max(1, round(durations[i] / unit)) * unit
        last = max(turns or members, key=lambda i: durations[i])
        found[last] = own - sum(found[i] for i in members if i != last)
    return found


class _Turn(NamedTuple):
    """A turn as it is written, and its angle (rad)."""

    keys: dict[str, object]
    angle: float


def _turn(
    coordinates: Coordinates, duration: float, peak: float, ramp: float, step: float, whole: bool
) -> _Turn | None:
    """A turn that the table executes; None where it rounds to nothing."""
    limits = coordinates.limits
    fastest, steepest = float(limits.max_rate), float(limits.max_acceleration)
    size = min(abs(peak), fastest)
    # Ramps in the resolution of time, long enough for the acceleration.
    ramp = min(math.ceil(max(ramp, _STEEP * size / steepest) / 0.01 - 1e-9) * 0.01, duration / 2.0)
    fastest = min(fastest, steepest * ramp / _STEEP)
    size = min(size, fastest)
    if whole:
        turns = round(size * (duration - ramp) / (2.0 * math.pi))
        while turns * 2.0 * math.pi / (duration - ramp) > fastest:
            turns -= 1
        if not turns:
            return None
        turns = int(math.copysign(turns, peak))
        return _Turn({"turns": turns, "duration": _s(duration), "ramp": _s(ramp)}, turns * 2.0 * math.pi)
    size = min(round(size / step), math.floor(fastest / step + 1e-9)) * step
    if size <= 0.0:
        return None
    size = math.copysign(size, peak)
    keys: dict[str, object] = {"peak_rate": f"{size / DEG:.9g} deg/s", "duration": _s(duration), "ramp": _s(ramp)}
    return _Turn(keys, size * (duration - ramp))


def _programme(spec: Spec, coordinates: Coordinates, cycle: Cycle) -> dict[str, object]:
    """The ramp: one slope, or one from each turn at the table to the next."""
    frame = coordinates.frame
    start, end = float(frame.temperature_start), float(frame.temperature_end)
    soak = spec.gradient_schedule.segments[0]
    if "gradient" not in coordinates.free:
        rate = abs(end - start) / float(frame.motion_time)
        # The slope fixes the time: written with all its digits.
        return {
            "plan.programme": None,
            "plan.temperature": [_c(start), _c(end)],
            "plan.gradient": f"{rate * 60.0:.12g} K/min",
            "plan.soak": {"duration": _s(soak.duration), "used": False} if soak.kind == "soak" else None,
        }
    items: list[dict[str, object]] = []
    if soak.kind == "soak":
        items.append({"soak": _s(soak.duration), "at": _c(start), "used": False})
    else:
        items.append({"soak": "1 s", "at": _c(start), "used": False})
    rig = spec.rig.chamber
    coldest, warmest = (float(t) for t in rig.range)
    chamber = _Chamber(coldest, warmest, float(rig.max_heating), float(rig.max_cooling))
    items += _stretches(
        start, np.cumsum(coordinates.lasting()), start + np.cumsum(cycle.steps), chamber, steps_of(spec)
    )
    return {"plan.temperature": None, "plan.gradient": None, "plan.soak": None, "plan.programme": items}


def _s(seconds: float) -> str:
    return f"{seconds:.9g} s"


def _c(temperature: float) -> str:
    return f"{temperature:.12g} degC"
