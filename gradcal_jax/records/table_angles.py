"""The angles of a run's table, from the events of its journal: standstills, readings, rates of spins."""

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gradcal_jax.hardware.journal import Event
from gradcal_jax.hardware.run_folder import breaks_off
from gradcal_jax.records.log import AngleReadings, ReadingKind

# Not "stopped": what stood stands on, and what moved was told to.
MOVE_COMMANDS: Final = ("move", "homing")
MARGIN_S: Final = 0.02
# Unit, adapter and system delay the stamps of samples by an unknown time. A row of rest that is lost costs nothing; a
# row of motion that counted as rest would be an error.
SETTLED_S: Final = 0.1
# A motor whose move takes longer than its trapezoid by more than this did not follow it.
_LATE_S: Final = 0.2
Floats = NDArray[np.float64]


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


def known_standstills(events: Sequence[Event], axis: str, first_s: Floats, last_s: Floats) -> NDArray[np.bool_]:
    """For standstills from `first_s` to `last_s`, whether the angle of the axis was read since its last command of
    motion (a typed angle holds until the axis is turned again)."""
    own = [event for event in events if event.data.get("axis") == axis]
    moved = np.array([-math.inf, *(e.data.get("began_s", e.time_s) for e in own if e.name in MOVE_COMMANDS)])
    still = [e.data for e in own if e.name == "angle" and not e.data["moving"]]
    times = np.array(sorted(float(data["time_s"]) for data in still if data["position_deg"] is not None))
    since_s = moved[np.maximum(np.searchsorted(moved, first_s) - 1, 0)]
    return np.searchsorted(times, since_s) < np.searchsorted(times, last_s + 2.0 * MARGIN_S, side="right")


def table_readings(events: Sequence[Event], axis: str, number: int, host: Floats, late_s: float) -> AngleReadings:
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
            row = min(int(np.searchsorted(host, max(time_s, begin_s))), len(host) - 1)
            add(time_s, event, float(host[row]) + 2.0 * SETTLED_S, kind, next_row=True, until_s=end_s)
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


def held_rates(events: Sequence[Event], axis: str, end_s: float) -> tuple[Floats, Floats] | None:
    """Times up to `end_s`, and the rates of an axis between which straight lines are drawn, deg/s: the commanded rate
    of its spins, the reference of the standard method, zero where it stands. None for an axis that never spins."""
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
    close(end_s)
    times, rates = np.array(knots).reshape(-1, 2).T
    return (times, rates) if len(knots) else None


def _spins(event: Event, axis: str) -> bool:
    return event.name == "move" and event.data["axis"] == axis and event.data["kind"] == "spin"
