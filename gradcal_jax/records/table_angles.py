"""The angles of a run's table, from the events of its journal: how long each axis is held, standstills, readings."""

import math
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gradcal_jax.hardware.journal import Event
from gradcal_jax.hardware.run_folder import breaks_off
from gradcal_jax.records.log import ReadingKind

# Not "stopped": what stood stands on, and what moved was told to.
MOVE_COMMANDS: Final = ("move", "homing")
MARGIN_S: Final = 0.02
# Unit, adapter and system delay the stamps of samples by an unknown time. A row of rest that is lost costs nothing; a
# row of motion that counted as rest would be an error.
SETTLED_S: Final = 0.1
# A motor whose move takes longer than its trapezoid by more than this did not follow it.
_LATE_S: Final = 0.2
Floats = NDArray[np.float64]


class Reading(NamedTuple):
    """An angle that was read."""

    time_s: float
    angle_rad: float
    kind: ReadingKind


@dataclass
class Held:
    """A time in which an axis stands, from the reading that shows it to its next command or an interruption of the run,
    or spins at the commanded rate."""

    begin_s: float
    end_s: float = math.inf
    rate_dps: float = 0.0
    readings: list[Reading] = field(default_factory=list[Reading])


@dataclass
class AxisCourse:
    """What is known of an axis: when it is held, in order, and the readings while it moves."""

    held: list[Held]
    moving: list[Reading]

    @property
    def spins(self) -> bool:
        return any(one.rate_dps != 0.0 for one in self.held)


def course_of(events: Sequence[Event], axis: str) -> AxisCourse:
    """The course of an axis. One that stood at an interruption stands again where the next step begins: a typed angle
    is not read again, and holds until the axis is turned."""
    course = AxisCourse([], [])
    now: Held | None = None
    last: Reading | None = None
    stood = False
    for event in events:
        own, data = event.data.get("axis") == axis, event.data
        if event.name == "angle" and own:
            time_s = float(data["time_s"])
            kind = ReadingKind.PLANNED if data.get("planned", True) else ReadingKind.STANDING
            kind = ReadingKind.MOVING if data["moving"] else kind
            known = data["position_deg"] is not None
            reading = Reading(time_s, math.radians(float(data["position_deg"])), kind) if known else None
            if data["moving"]:
                course.moving += [reading] if reading else []
                continue
            if now is None and not stood:
                now = Held(time_s)
                course.held.append(now)
            if reading is not None:
                last = reading
                if now is not None:
                    now.readings.append(reading)
        elif (commanded := event.name in MOVE_COMMANDS and own) or breaks_off(event):
            began_s = float(data.get("began_s", event.time_s))
            before = now.rate_dps if now is not None else 0.0
            stood = not commanded and (stood or (now is not None and now.rate_dps == 0.0))
            if now is not None:
                now.end_s, now = began_s, None
            if commanded:
                last = None
                if event.name == "move" and data["kind"] == "spin":
                    rate = float(data["rate_dps"])
                    ramp_s = abs(rate - before) / float(data["acceleration_dps2"])
                    now = Held(began_s + ramp_s + _LATE_S, rate_dps=rate)
                    course.held.append(now)
        elif event.name == "step begins" and stood:
            stood, begin_s = False, float(data["begins_s"])
            now = Held(begin_s, readings=[] if last is None else [last._replace(time_s=begin_s)])
            course.held.append(now)
    # (A turn can follow at the instant of the reading that ends the one before.)
    course.held = [one for one in course.held if one.end_s >= one.begin_s]
    return course


def standstills(courses: Sequence[AxisCourse], latest_s: float) -> list[tuple[float, float]]:
    """When all axes stand at angles that were read, up to `latest_s`."""
    of_axes = [[one for one in course.held if one.rate_dps == 0.0 and one.readings] for course in courses]
    begins = [one.begin_s for held in of_axes for one in held]
    ends = [one.end_s for held in of_axes for one in held]
    times = np.minimum([*ends, *begins], latest_s)
    order = np.argsort(times, kind="stable")
    standing = np.cumsum(np.repeat([-1, 1], [len(ends), len(begins)])[order])
    first = np.flatnonzero(standing == len(courses)) if courses else np.zeros(0, np.int64)
    times = times[order]
    return [(float(times[k]), float(times[k + 1])) for k in first.tolist() if times[k + 1] > times[k]]


def table_readings(course: AxisCourse, host: Floats, late_s: float) -> Floats:
    """The readings of an axis, at the times `host` of its rows: `(readings, 4)` times, rows, angles (rad) and kinds.

    A standing axis is at its angle from the first reading that shows it standing to its next command. Its row is the
    nearest to the reading's time in between, without `late_s` and the margins of a standstill.
    """
    rows: list[tuple[float, int, float, int]] = []

    def add(reading: Reading, at_s: float, near_s: float, *, next_row: bool = False) -> None:
        row = bisect_left(host, at_s)
        if not next_row and row > 0 and (row == len(host) or at_s - host[row - 1] < host[row] - at_s):
            row -= 1
        # Where no samples are near, the reading has no row.
        if row < len(host) and abs(host[row] - at_s) <= near_s:
            rows.append((reading.time_s, row, reading.angle_rad, reading.kind))

    near_s = SETTLED_S + late_s
    for reading in course.moving:
        add(reading, reading.time_s, near_s)
    for held in course.held:
        if held.rate_dps != 0.0 or not held.readings:
            continue
        first_s = held.readings[0].time_s
        begin_s, end_s = first_s + near_s, held.end_s - MARGIN_S - late_s
        count = len(rows)
        for reading in held.readings:
            if begin_s > end_s:
                add(reading, 0.5 * (first_s + held.end_s), near_s)
            else:
                at_s = min(max(reading.time_s, begin_s), end_s)
                add(reading, at_s, near_s, next_row=at_s < end_s)
        if len(rows) == count and begin_s < end_s:
            row = min(bisect_left(host, max(held.readings[-1].time_s, begin_s)), len(host) - 1)
            at_s = float(host[row]) + 2.0 * SETTLED_S
            add(held.readings[-1], at_s, end_s - at_s, next_row=True)
    return np.array(rows, np.float64).reshape(-1, 4)


def held_rates(course: AxisCourse, times_s: Floats) -> Floats:
    """`(n,)`: the rate of an axis, rad/s: the commanded one of its spins, the reference of the standard method, zero
    where it stands, and straight lines between these."""
    if not course.held:
        return np.zeros(len(times_s))
    # What stands only behind the last row is the end of the way there.
    last_s = max(float(times_s[-1]), course.held[-1].begin_s)
    ends = np.array([(one.begin_s, min(one.end_s, last_s)) for one in course.held])
    rates = np.array([one.rate_dps for one in course.held])
    return np.radians(np.interp(times_s, ends.ravel(), np.repeat(rates, 2)))
