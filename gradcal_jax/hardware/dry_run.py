"""Dry run: what a track asks of each device, and what these do not accept. Nothing moves."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from gradcal_jax.hardware.roles import AxisLimits, ChamberLimits
from gradcal_jax.hardware.setup import DeviceReport
from gradcal_jax.hardware.track import AxisCommand, Course, Track

# Relative error of an acceleration that changes nothing of a turn.
_LIKE_ACCELERATION = 0.05
# How a spec says it.
_ONE_READING = 'rests with read = "none", or rig.table.axis[].angle.read_every = "rest"'


@dataclass(frozen=True)
class DryRun:
    """The dry run of a recipe, whose steps take `duration_s` without waiting. `devices`: what each is asked to do;
    `problems`: why the run would not start."""

    duration_s: float
    devices: dict[str, str]
    problems: tuple[str, ...]


def dry_run_of(track: Track, chamber: ChamberLimits | None, axes: Mapping[str, AxisLimits]) -> DryRun:
    """What a track asks of devices with these limits, and what these do not accept."""
    devices: dict[str, str] = {}
    problems = [
        f"The recipe reads axis {name!r} several times in a rest, but the operator types its angle only once: add "
        "an [axis.encoder] to the rig file, or use a recipe whose plan has one reading in each rest "
        f"({_ONE_READING})."
        for name in track.moved
        if track.read_at_rest and name in axes and axes[name].typed
    ]
    courses: list[Course] = []
    for step in track.steps:
        start = [] if step.start_c is None else [Course(0.0, step.start_c)]
        for course in (*start, *step.courses):
            beyond = ["sets a temperature, but the rig has no chamber."]
            if chamber is not None:
                beyond = chamber.beyond(course.temperature_c, course.ramp_k_per_min)
            problems += [f"Step {step.name!r} {text}" for text in beyond]
            courses.append(course)
    if courses:
        temperatures = [course.temperature_c for course in courses]
        steepest = max(course.ramp_k_per_min or 0.0 for course in courses)
        devices["chamber"] = f"{min(temperatures):g} to {max(temperatures):g} degC, ramps up to {steepest:.3g} K/min"
    for name in track.moved:
        devices[name] = _axis(track, name, axes, problems)
    return DryRun(track.duration_s, devices, tuple(dict.fromkeys(problems)))


def dry_run_on(track: Track, reports: Sequence[DeviceReport]) -> DryRun:
    """The dry run on a rig whose devices have reported; a device with a problem is one of the dry run."""
    chamber = next((report.limits for report in reports if isinstance(report.limits, ChamberLimits)), None)
    axes = {report.name: report.limits for report in reports if isinstance(report.limits, AxisLimits)}
    run = dry_run_of(track, chamber, axes)
    silent = [f"{report.name}: {report.problem}" for report in reports if report.problem]
    return replace(run, problems=(*silent, *run.problems))


def _axis(track: Track, name: str, axes: Mapping[str, AxisLimits], problems: list[str]) -> str:
    """What an axis is asked to do; adds the problems."""
    count, fastest, places, at = 0, 0.0, [0.0], 0.0
    for step in track.steps:
        at = step.start_deg.get(name, at)
        moves = [move for move in step.moves if move.axis == name]
        if moves and name not in axes:
            problems.append(
                f"Step {step.name!r} moves axis {name!r}, but the rig has no such axis ({', '.join(axes)})."
            )
        for move in moves:
            at += move.angle_deg
            if name in axes:
                beyond = _beyond_axis(move, at, axes[name])
                problems += [f"Step {step.name!r}, axis {name!r}, {text}" for text in beyond]
            count, fastest = count + 1, max(fastest, abs(move.rate_dps))
            places.append(at)
    return f"{count} commands, up to {fastest:.4g} deg/s, {min(places):g} to {max(places):g} deg"


def _beyond_axis(move: AxisCommand, goal: float, limits: AxisLimits) -> list[str]:
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
