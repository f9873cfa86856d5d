"""Dry run: what a track asks of each device, and what these do not accept. Nothing moves."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from gradcal_jax.hardware.roles import AxisLimits, ChamberLimits, ImuSettings
from gradcal_jax.hardware.track import AxisCommand, Course, Track

# Relative error of an acceleration that changes nothing of a turn.
_LIKE_ACCELERATION = 0.05
# How a spec says it.
_ONE_READING = 'rests with read = "none", or rig.table.axis[].angle.read_every = "rest"'


@dataclass(frozen=True)
class DryRun:
    """`devices`: what each is asked to do; `problems`: why the run would not start."""

    devices: dict[str, str]
    problems: tuple[str, ...]


def dry_run_of(track: Track, limits: Mapping[str, ChamberLimits | AxisLimits | ImuSettings | None]) -> DryRun:
    """What a track asks of the devices with these limits, and what these do not accept; the chamber's name is
    "chamber", and an axis that is not named accepts everything."""
    devices: dict[str, str] = {}
    problems: list[str] = []
    courses: list[Course] = []
    chamber = limits.get("chamber")
    for step in track.steps:
        start = [] if step.start_c is None else [Course(0.0, step.start_c)]
        for course in (*start, *step.courses):
            beyond = ["sets a temperature, but the rig has no chamber."]
            if isinstance(chamber, ChamberLimits):
                beyond = chamber.beyond(course.temperature_c, course.ramp_k_per_min)
            problems += [f"Step {step.name!r} {text}" for text in beyond]
            courses.append(course)
    if courses:
        temperatures = [course.temperature_c for course in courses]
        steepest = max(course.ramp_k_per_min or 0.0 for course in courses)
        devices["chamber"] = f"{min(temperatures):g} to {max(temperatures):g} degC, ramps up to {steepest:.3g} K/min"
    for name in track.moved:
        axis, at, places, rates = limits.get(name), 0.0, [0.0], list[float]()
        if isinstance(axis, AxisLimits) and axis.typed and track.read_at_rest:
            problems.append(
                f"The recipe reads axis {name!r} several times in a rest, but the operator types its angle only once: "
                "add an [axis.encoder] to the rig file, or use a recipe whose plan has one reading in each rest "
                f"({_ONE_READING})."
            )
        for step in track.steps:
            at = step.start_deg.get(name, at)
            for move in (move for move in step.moves if move.axis == name):
                at += move.angle_deg
                if isinstance(axis, AxisLimits):
                    problems += [f"Step {step.name!r}, axis {name!r}, {text}" for text in _beyond(move, at, axis)]
                rates.append(abs(move.rate_dps))
                places.append(at)
        most = f"up to {max(rates, default=0.0):.4g} deg/s, {min(places):g} to {max(places):g} deg"
        devices[name] = f"{len(rates)} commands, {most}"
    return DryRun(devices, tuple(dict.fromkeys(problems)))


def _beyond(move: AxisCommand, goal: float, limits: AxisLimits) -> list[str]:
    if move.kind == "stop":
        return []
    acceleration, step = move.acceleration_dps2, limits.acceleration_step_dps2
    problems = limits.beyond(abs(move.rate_dps), acceleration, goal)
    made = step * max(1, round(acceleration / step)) if step else acceleration
    if move.kind == "turn" and abs(made - acceleration) > _LIKE_ACCELERATION * acceleration:
        problems.append(
            f"accelerates at {acceleration:g} deg/s², but its controller rounds this to {made:g}: make the "
            f'recipe with acceleration = "{step:.9g} deg/s^2" in [rig.resolution] of the spec.'
        )
    if move.kind == "spin" and limits.by_hand:
        problems.append(
            "turns at a constant rate, but is turned by hand: use turns in the plan, or a motor-driven axis."
        )
    elif move.kind == "spin" and limits.travel_deg != (-math.inf, math.inf):
        problems.append("turns continuously, but its travel is limited.")
    return problems
