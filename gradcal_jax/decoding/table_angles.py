"""The angles of a run's table, from the events of its journal: standstills, readings, and a course for pictures."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ..files.log import AngleReadings, ReadingKind
from ..hardware.journal import Event
from ..hardware.stretches import breaks_off
from ..hardware.track import AxisCommand

# Not "stopped": what stood stands on, and what moved was told to.
MOVE_COMMANDS: Final = ("move", "homing")
MARGIN_S: Final = 0.02
# Unit, adapter and system delay the stamps of samples by an unknown time. A row of rest that is lost costs nothing; a
# row of motion that counted as rest would be an error.
SETTLED_S: Final = 0.1
# A motor whose move takes longer than its trapezoid by more than this did not follow it.
_LATE_S: Final = 0.2
Floats = NDArray[np.float64]


@dataclass(frozen=True)
class RunAngles:
    """The axes of a table at the rows of a log: `course_deg` `(n, L)` for pictures, the `readings`, and the rates held
    `(n, L)`, deg/s, where an axis spins."""

    course_deg: Floats
    readings: AngleReadings
    rates_dps: Floats | None


def table_angles(
    events: Sequence[Event], axes: Sequence[str], host: Floats, standstill: NDArray[np.int64], late_s: float
) -> RunAngles:
    """The angles of `axes` at the times `host` (s) of the rows, of which `standstill` is the number of the standstill.
    A row may be `late_s` earlier or later than its time."""
    nothing = np.zeros((len(host), 0))
    courses = [_reconstructed_course(events, axis, host, standstill)[:, None] for axis in axes]
    rates = [_held_rates(events, axis, host) for axis in axes]
    readings = [_table_readings(events, axis, k, host, late_s) for k, axis in enumerate(axes)]
    spun = [np.zeros(len(host)) if own is None else own for own in rates]
    return RunAngles(
        np.concatenate([nothing, *courses], axis=1),
        AngleReadings.in_order(readings),
        np.stack(spun, axis=1) if any(own is not None for own in rates) else None,
    )


def standstills(events: Sequence[Event], axes: Sequence[str]) -> list[tuple[float, float]]:
    """When no axis moves: from the reading that shows it to the next command of motion, or to the run's interruption.

    An axis that stood at an interruption stands again where the next step begins: a typed angle is not read again.
    """
    moving = set(axes)
    intervals: list[tuple[float, float]] = []
    since: float | None = None
    latest = 0.0
    for event in events:
        latest = max(latest, event.time_s)
        if event.name == "angle" and not event.data["moving"] and event.data["axis"] in moving:
            moving.discard(str(event.data["axis"]))
            if not moving:
                since = float(event.data["time_s"])
        elif event.name == "step begins" and since is None and axes and not moving:
            since = float(event.data["begins_s"])
        elif event.name in MOVE_COMMANDS or breaks_off(event):
            if since is not None:
                intervals.append((since, float(event.data.get("began_s", event.time_s))))
                since = None
            if event.name in MOVE_COMMANDS:
                moving.add(str(event.data["axis"]))
    if since is not None:
        intervals.append((since, latest))
    return [(start, end) for start, end in intervals if end > start]


def _table_readings(events: Sequence[Event], axis: str, number: int, host: Floats, late_s: float) -> AngleReadings:
    """The readings of an axis, `number` of the log's, at the times `host` of its rows.

    A standing axis is at its angle from the first reading that shows it standing to its next command. Its row is the
    nearest to the reading's time in between, without `late_s` and the margins of a standstill. An axis that is not read
    again (its angle was typed) has its last reading where samples begin, also behind an interruption at which it stood.
    """
    rows: list[tuple[float, int, float, ReadingKind]] = []
    stands: list[tuple[float, Event]] = []
    last: Event | None = None
    again_s = math.nan

    def add(
        time_s: float,
        event: Event,
        at_s: float,
        kind: ReadingKind,
        *,
        next_row: bool = False,
        until_s: float | None = None,
    ) -> None:
        row = int(np.searchsorted(host, at_s))
        if not next_row and row > 0 and (row == len(host) or at_s - host[row - 1] < host[row] - at_s):
            row -= 1
        # Where no samples are near, the reading has no row.
        near_s = SETTLED_S + late_s if until_s is None else until_s - at_s
        if row < len(host) and abs(host[row] - at_s) <= near_s:
            rows.append((time_s, row, math.radians(float(event.data["position_deg"])), kind))

    def close(until_s: float) -> None:
        """Place the readings of one standstill, which ends at `until_s`."""
        if not stands and last is not None and math.isfinite(again_s):
            stands.append((again_s, last))
        first_s = stands[0][0] if stands else 0.0
        begin_s, end_s = first_s + SETTLED_S + late_s, until_s - MARGIN_S - late_s
        count, kind = len(rows), ReadingKind.PLANNED
        for time_s, event in stands:
            kind = ReadingKind.PLANNED if event.data.get("planned", True) else ReadingKind.STANDING
            if begin_s > end_s:
                add(time_s, event, 0.5 * (first_s + until_s), kind)
            else:
                at_s = max(time_s, begin_s)
                add(time_s, event, min(at_s, end_s), kind, next_row=at_s < end_s)
        if stands and len(rows) == count and begin_s < end_s:
            time_s, event = stands[-1]
            samples_s = host[np.searchsorted(host[:-1], max(time_s, begin_s))] + 2.0 * SETTLED_S
            add(time_s, event, float(samples_s), kind, next_row=True, until_s=end_s)
        stands.clear()

    for event in events:
        own = event.data.get("axis") == axis
        if event.name == "angle" and own and event.data["position_deg"] is not None:
            time_s = float(event.data["time_s"])
            if event.data["moving"]:
                add(time_s, event, time_s, ReadingKind.MOVING)
            else:
                stands.append((time_s, event))
                last = event
        elif (moves := event.name in MOVE_COMMANDS and own) or breaks_off(event):
            close(float(event.data.get("began_s", event.time_s)))
            last, again_s = None if moves else last, math.nan
        elif event.name == "step begins" and not stands:
            again_s = float(event.data["begins_s"])
    close(math.inf)
    times, at, angles, kinds = np.array(rows).reshape(-1, 4).T
    whole, none = np.int64, np.full(len(rows), np.nan)
    return AngleReadings(times, at.astype(whole), np.full(len(rows), number, whole), angles, none, kinds.astype(whole))


def _held_rates(events: Sequence[Event], axis: str, host: Floats) -> Floats | None:
    """The rate of an axis at the times `host`, deg/s: the commanded rate of its spins, the reference of the standard
    method, zero where it stands, and straight lines in between. None for an axis
    that never spins."""
    if not any(_spins(event, axis) for event in events):
        return None
    knots: list[tuple[float, float]] = []
    since_s, rate = math.inf, 0.0

    def close(until_s: float) -> None:
        if since_s < until_s:
            knots.extend([(since_s, rate), (until_s, rate)])

    for event in events:
        own = event.data.get("axis") == axis
        if event.name == "angle" and own and not event.data["moving"] and since_s == math.inf:
            since_s, rate = float(event.data["time_s"]), 0.0
        elif (event.name in MOVE_COMMANDS and own) or breaks_off(event):
            began_s = float(event.data.get("began_s", event.time_s))
            close(began_s)
            before, since_s = (rate if since_s < math.inf else 0.0), math.inf
            if _spins(event, axis):
                rate = float(event.data["rate_dps"])
                since_s = began_s + abs(rate - before) / float(event.data["acceleration_dps2"]) + _LATE_S
    close(float(host[-1]))
    times, rates = np.array(knots).reshape(-1, 2).T
    return np.interp(host, times, rates) if len(knots) else None


def _spins(event: Event, axis: str) -> bool:
    return event.name == "move" and event.data["axis"] == axis and event.data["kind"] == "spin"


def _reconstructed_course(events: Sequence[Event], axis: str, host: Floats, standstill: NDArray[np.int64]) -> Floats:
    """The axis's angle at every row, deg: in a standstill the nearest reading since the axis's last command of motion
    (a typed angle holds until the axis is turned again), else from its own moves."""
    readings = [
        e for e in events if e.name == "angle" and e.data["axis"] == axis and e.data["position_deg"] is not None
    ]
    if not readings:
        return np.full(len(host), np.nan)
    times = np.array([float(e.data["time_s"]) for e in readings])
    values = np.array([float(e.data["position_deg"]) for e in readings])
    still = np.array([not e.data["moving"] for e in readings])
    moves = [e for e in events if e.name in MOVE_COMMANDS and e.data["axis"] == axis]
    moved = np.array([float(e.data.get("began_s", e.time_s)) for e in moves])
    result = _own_course(np.interp(host, times, values), host, moves, moved, times[still], values[still])
    edges = np.flatnonzero(np.diff(standstill, prepend=-1, append=-1))
    for begin, end in itertools.pairwise(edges):
        if begin >= len(standstill) or standstill[begin] < 0:
            continue
        number = int(np.searchsorted(moved, float(host[begin])))
        low, high = moved[number - 1] if number else -math.inf, host[end - 1] + 2.0 * MARGIN_S
        inside = np.flatnonzero(still & (times >= low) & (times <= high))
        if not len(inside):
            result[begin:end] = np.nan
            continue
        result[begin:end] = _nearest(times[inside], values[inside], host[begin:end])
    return result


def _nearest(times: Floats, values: Floats, at: Floats) -> Floats:
    """Of the `values` at increasing `times` the nearest to each time of `at`."""
    return values[np.searchsorted((times[1:] + times[:-1]) / 2.0, at)]


def _own_course(
    straight: Floats, host: Floats, commands: Sequence[Event], moved: Floats, times: Floats, values: Floats
) -> Floats:
    """An axis's angle at every row, deg, independent of other axes: the nearest of its readings `values` at `times`
    while it stands, and the commanded trapezoid from one to the next; `straight` where neither is known."""
    result = straight.copy()
    for k in range(-1, len(commands)):
        begin = moved[k] if k >= 0 else -math.inf
        until = moved[k + 1] if k + 1 < len(commands) else math.inf
        # A reading at the time of a command belongs to the standstill before it.
        first, last = np.searchsorted(times, np.array([begin, until]), side="right")
        if first == last:
            continue
        low, middle, high = np.searchsorted(host, np.array([begin, float(times[first]), until]))
        result[middle:high] = _nearest(times[first:last], values[first:last], host[middle:high])
        move = commands[k].data if k >= 0 else {}
        if first == 0 or move.get("kind") not in ("go", "turn") or not move.get("acceleration_dps2"):
            continue
        angle, rate = float(values[first] - values[first - 1]), float(move["rate_dps"])
        turn = AxisCommand(0.0, "", "turn", rate_dps=rate, acceleration_dps2=move["acceleration_dps2"], angle_deg=angle)
        # An operator, or a stage that was held up, does not follow the trapezoid.
        if turn.duration_s + _LATE_S > times[first] - begin:
            result[low:middle] = values[first - 1] + _turned(turn, host[low:middle] - begin)
    return result


def _turned(turn: AxisCommand, since: Floats) -> Floats:
    """How far a turn has come (deg), seconds after it began."""
    size, whole = abs(turn.angle_deg), turn.duration_s
    if whole == 0.0:
        return np.full(len(since), turn.angle_deg)
    peak = min(abs(turn.rate_dps), math.sqrt(size * turn.acceleration_dps2))
    ramp = peak / turn.acceleration_dps2
    near = 0.5 * turn.acceleration_dps2 * np.clip(np.minimum(since, whole - since), 0.0, ramp) ** 2
    sides = np.where(since < 0.5 * whole, near, size - near)
    flat = (since > ramp) & (since < whole - ramp)
    return math.copysign(1.0, turn.angle_deg) * np.where(flat, peak * (since - 0.5 * ramp), sides)
