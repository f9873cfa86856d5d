"""Dry run: the commands that a run will send to each device, and whether all that it needs is ready.

Nothing moves, except in `try_longest_moves`, which has to be requested.
"""

import math
import time
from collections.abc import Generator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass

from gradcal_jax.hardware.chamber_control import ramps_alone, rate_as_made
from gradcal_jax.hardware.clock import Clock
from gradcal_jax.hardware.errors import HardwareError
from gradcal_jax.hardware.roles import AxisLimits, ChamberLimits, ImuStream
from gradcal_jax.hardware.setup import Bench
from gradcal_jax.hardware.track import AxisCommand, Course, Track

_STREAM_S, _LONGEST_S = 3.0, 12.0
_RATE_OFF = 0.05
_OFF_GOAL_DEG = 1.0
_LATE_S = 2.0
# Relative error of an acceleration that changes nothing of a turn.
_LIKE_ACCELERATION = 0.05
# How a spec says it.
_ONE_READING = 'rests with read = "none", or rig.table.axis[].angle.read_every = "rest"'


@dataclass(frozen=True)
class PlannedStep:
    """A step of the run: its own time (without waiting), and the commands to the devices in it."""

    name: str
    begins_s: float
    duration_s: float
    waits: bool
    commands: tuple[str, ...]


@dataclass(frozen=True)
class DryRun:
    """The dry run of a recipe. `problems`: why it would not start; `rounded`: slopes that the chamber would
    round."""

    steps: tuple[PlannedStep, ...]
    duration_s: float
    rounded: tuple[str, ...]
    problems: tuple[str, ...]


def dry_run_of(track: Track, chamber: ChamberLimits | None, axes: Mapping[str, AxisLimits]) -> DryRun:
    """The commands of a track to devices with these limits, and what these do not accept."""
    steps: list[PlannedStep] = []
    rounded: list[str] = []
    problems = [
        f"The recipe reads axis {name!r} several times in a rest, but the operator types its angle only once: add "
        "an [axis.encoder] to the rig file, or use a recipe whose plan has one reading in each rest "
        f"({_ONE_READING})."
        for name in track.moved
        if track.read_at_rest and name in axes and axes[name].typed
    ]
    begins_s = 0.0
    at: dict[str, float] = {}
    for step in track.steps:
        commands: list[str] = []
        where = f"Step {step.name!r}"
        if step.ready is not None and step.begins_c is not None:
            commands.append(f"chamber: hold {step.begins_c:g} degC, until it is stable")
        own = [] if step.temperature_c is None else [Course(0.0, step.temperature_c, step.ramp_k_per_min)]
        start = [] if step.start_c is None else [Course(0.0, step.start_c)]
        for course in (*own, *start, *step.courses):
            problems += [f"{where} {text}" for text in _beyond_chamber(course, chamber)]
        for course in step.courses if step.follows else [*own, *(c for c in step.courses if c.start_s > 0.0)]:
            command, rounding = _chamber_command(course, chamber)
            commands.append(f"chamber: {command}")
            rounded += [f"step {step.name!r}: {rounding}"] if rounding else []
        at |= step.start_deg if step.goes_there else {}
        for name in dict.fromkeys(move.axis for move in step.moves):
            if name not in axes:
                problems.append(f"{where} moves axis {name!r}, but the rig has no such axis ({', '.join(axes)}).")
            places = [at.get(name, 0.0)]
            moves = [move for move in step.moves if move.axis == name]
            for move in moves:
                if move.kind in ("go", "turn"):
                    places.append(places[-1] + move.angle_deg if move.kind == "turn" else move.position_deg)
                beyond = _beyond_axis(move, places[-1], axes[name]) if name in axes else []
                problems += [f"{where}, axis {name!r}, {text}" for text in beyond]
            at[name] = places[-1]
            reach = f", {min(places):g} to {max(places):g} deg" if len(places) > 1 else ""
            count = f"{len(moves)} command{'s' * (len(moves) > 1)}"
            commands.append(f"{name}: {count}, up to {max(abs(move.rate_dps) for move in moves):.4g} deg/s{reach}")
        steps.append(PlannedStep(step.name, begins_s, step.duration_s, step.ready is not None, tuple(commands)))
        begins_s += step.duration_s
    return DryRun(tuple(steps), begins_s, tuple(dict.fromkeys(rounded)), tuple(dict.fromkeys(problems)))


def _chamber_command(course: Course, limits: ChamberLimits | None) -> tuple[str, str]:
    """The command to the chamber, and a sentence where the chamber would round its rate."""
    rate = course.ramp_k_per_min
    if rate is None:
        return f"hold {course.temperature_c:g} degC", ""
    command, rounded = f"ramp to {course.temperature_c:g} degC at {rate:.3g} K/min", ""
    if limits is not None and ramps_alone(limits, rate):
        return command, ""
    if limits is not None and limits.hardware_ramp:
        rounded = f"the chamber would round {rate:.3g} K/min to {rate_as_made(limits, rate):.3g} K/min"
        rounded += ": the run steps the set point instead"
    return f"{command} (by steps of its set point, every 5 s)", rounded


def _beyond_chamber(course: Course, limits: ChamberLimits | None) -> list[str]:
    if limits is None:
        return ["sets a temperature, but the rig has no chamber."]
    return limits.beyond(course.temperature_c, course.ramp_k_per_min)


def _beyond_axis(move: AxisCommand, goal: float, limits: AxisLimits) -> list[str]:
    if move.kind == "stop":
        return []
    acceleration, step = move.acceleration_dps2, limits.acceleration_step_dps2
    problems = limits.beyond(abs(move.rate_dps), acceleration, goal if move.kind in ("go", "turn") else None)
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


@dataclass(frozen=True)
class Tried:
    name: str
    what: str
    good: bool = True


def try_for(bench: Bench, track: Track, clock: Clock, *, move: bool = False) -> list[Tried]:
    """Try all that a run needs: a reading of each device, the rates of streams, the track's limits; with `move` the
    references and the longest move of each axis, there and back."""
    trials: list[Tried] = []
    limits: dict[str, AxisLimits] = {}
    chamber = None
    if bench.chamber is not None:
        with _noted("chamber", trials):
            reading, chamber = bench.chamber.read(), bench.chamber_limits()
            text = f"air {reading.air_c:.1f} degC, set point {reading.setpoint_c:.1f}, mode {reading.mode}"
            alarms = ", ".join(reading.alarms)
            trials.append(Tried("chamber", f"{text}; ALARM {alarms}" if alarms else text, not alarms))
    for name, axis in bench.axes.items():
        with _noted(name, trials):
            place, limits[name] = axis.read(), axis.limits()
            text = "its angle is not known yet" if math.isnan(place.position_deg) else f"{place.position_deg:.3f} deg"
            faults = ", ".join(place.faults)
            # Many controllers report a missing reference as a fault: a run homes the axis first.
            unknown = bool(faults) and not place.referenced
            trials.append(Tried(name, f"{text}; {faults}" if faults else text, not faults or unknown))
    for name, unit in bench.imus.items():
        with _noted(name, trials):
            trials.append(_streams(name, unit))
    trials += [Tried("recipe", problem, False) for problem in dry_run_of(track, chamber, limits).problems]
    if move and all(entry.good for entry in trials):
        trials += try_longest_moves(bench, track, clock)
    return trials


@contextmanager
def _noted(name: str, trials: list[Tried]) -> Generator[None]:
    """Context in which the problem of a device is a trial that failed."""
    try:
        yield
    except HardwareError as problem:
        trials.append(Tried(name, str(problem), False))


def _streams(name: str, unit: ImuStream) -> Tried:
    settings, decoder = unit.configure(), unit.decoder()
    unit.start()
    count, missing, last_s = 0, 0, math.nan
    first: tuple[int, float] | None = None
    rate_hz, good, doubtful, began_s = math.nan, False, False, time.monotonic()
    # The longer the measurement, the smaller the error by late readings of a busy host.
    while (lasted_s := time.monotonic() - began_s) < (_LONGEST_S if doubtful else _STREAM_S):
        batch = decoder.push(*unit.read_bytes(0.5))
        if len(batch):
            missing += int(batch.gap_before[1:].sum())
            last_s, count = float(batch.host_time_s[-1]), count + len(batch)
            first = first or (count, last_s)
            # The first bytes had waited for an unknown time.
            rate_hz = (count - first[0]) / (last_s - first[1]) if last_s > first[1] else math.nan
            good = abs(rate_hz / settings.sample_rate_hz - 1.0) < _RATE_OFF
            doubtful = not (good or missing)
    unit.stop()
    if math.isnan(rate_hz):
        return Tried(name, f"no samples arrived in {lasted_s:.0f} s", False)
    text = f"{rate_hz:.1f} of {settings.sample_rate_hz:g} samples/s, {missing} missing"
    return Tried(name, text, good and not missing)


def try_longest_moves(bench: Bench, track: Track, clock: Clock) -> list[Tried]:
    trials: list[Tried] = []
    for name in track.moved:
        turns = [m for step in track.steps for m in step.moves if m.axis == name and m.kind == "turn"]
        axis = bench.axes[name]
        if not turns or axis.limits().by_hand:
            continue
        longest = max(turns, key=lambda turn: abs(turn.angle_deg))
        with _noted(name, trials), ExitStack() as stack:
            stack.callback(axis.stop)
            axis.home()
            begins = axis.read().position_deg
            for goal in (begins + longest.angle_deg, begins):
                began_s = clock.now()
                axis.move_to(goal, longest.rate_dps, longest.acceleration_dps2)
                while (reading := axis.read()).moving:
                    if clock.now() - began_s > longest.duration_s + 10.0 * _LATE_S:
                        break
                    clock.sleep(0.05)
                took_s, off = clock.now() - began_s, reading.position_deg - goal
                planned = f"planned: {longest.duration_s:.1f} s"
                text = f"{longest.angle_deg:g} deg in {took_s:.1f} s ({planned}), error {off:+.4f} deg"
                good = not reading.moving and abs(off) < _OFF_GOAL_DEG and took_s < longest.duration_s + _LATE_S
                trials.append(Tried(name, text, good))
                if not good:
                    break
    return trials
