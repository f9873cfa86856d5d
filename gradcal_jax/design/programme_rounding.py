"""A course of the chamber in numbers that its controller takes."""

import math
from typing import NamedTuple

import numpy as np

from gradcal_jax.design.free_course import ProgrammeCoordinates
from gradcal_jax.recipe.rounding import ControllerSteps, steps_of
from gradcal_jax.spec.spec_sections import Spec

# A stretch of fewer steps of slope becomes a soak: rounding would change its duration too much.
_LEVEL = 5
# Resolution of the soak that fills the end of a programme; s.
_TIME = 0.1


def programme_keys(spec: Spec, coordinates: ProgrammeCoordinates, point: np.ndarray) -> dict[str, object]:
    """The keys of a spec's course: stretches at slopes and temperatures of the controller's steps, no steeper than the
    chamber allows."""
    programme, steps = coordinates.programme(point), steps_of(spec)
    here = _on_grid(float(programme.start), float(steps.temperature))
    soak = {"soak": _s(float(coordinates.soak)), "at": _c(here), "used": False}
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


def _s(seconds: float) -> str:
    return f"{seconds:.9g} s"


def _c(temperature: float) -> str:
    return f"{temperature:.12g} degC"
