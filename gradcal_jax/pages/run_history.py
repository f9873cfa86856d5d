"""The history of a run, from its journal: times, devices, waits, temperatures and angles."""

import math
from bisect import bisect_right
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gradcal_jax.hardware.journal import Event
from gradcal_jax.hardware.run_folder import SESSION, RunFolder, exit_status, sessions, steps_done
from gradcal_jax.hardware.track import AxisCommand

Floats = NDArray[np.float64]
_INSTANT_S = 0.05


class Waited(NamedTuple):
    """A segment that waited for a stable temperature, for how long, and where it settled."""

    step: str
    waited_s: float
    temperature_c: float


class RunDevice(NamedTuple):
    """The identity of a device."""

    name: str
    driver: str
    model: str
    serial_number: str
    firmware: str


class RunHistory(NamedTuple):
    """The history of a run.

    `chamber_s`, `chamber_c` `(n,)`: times and temperatures of the chamber's readings. `rates`: for each axis that
    turned, times and rates (deg/s) between which the rate is linear, both `(m,)`. Times are in s on the plan's clock,
    which stops while a step waits; readings before the first step are left out. `status`: "success", "stopped",
    "aborted" or "lost"; `damaged_bytes`: bytes of the journal that belong to no record.
    """

    begun: str
    simulated: bool
    status: str
    sessions: int
    steps: int
    seams: int
    duration_s: float
    waited: tuple[Waited, ...]
    devices: tuple[RunDevice, ...]
    verified_safe: bool
    damaged_bytes: int
    version: str
    chamber_s: Floats
    chamber_c: Floats
    rates: dict[str, tuple[Floats, Floats]]


def history_of(folder: RunFolder) -> RunHistory:
    """The history of a run. Raises `ValueError` where the folder is not a run's."""
    notes, contents = folder.notes(), folder.events()
    events = _on_one_clock(contents.events, simulated=bool(notes["simulated"]))
    if not events:
        raise ValueError(f"the run in {folder.path} never began: its journal is empty")
    start = events[0][0]
    last = max(time for time, _ in events)
    on_plan = _plan_clock(folder, events)
    chamber = [
        (on_plan(time), _temperature(event))
        for time, event in events
        if event.name == "chamber" and _temperature(event) is not None
    ]
    devices: dict[str, RunDevice] = {}
    angles: dict[str, list[tuple[float, float]]] = {}
    moves: dict[str, list[tuple[float, Mapping[str, Any]]]] = {}
    waited: list[Waited] = []
    verified = False
    for time, event in events:
        data = event.data
        if event.name == "identity":
            identity = (str(data.get(name, "")) for name in ("driver", "model", "serial_number", "firmware"))
            devices.setdefault(str(data["device"]), RunDevice(str(data["device"]), *identity))
        elif event.name == "stable":
            waited.append(Waited(str(data["step"]), float(data["waited_s"]), float(data["temperature_c"])))
        elif event.name == "angle" and data.get("position_deg") is not None:
            angles.setdefault(str(data["axis"]), []).append((on_plan(time), float(data["position_deg"])))
        elif event.name == "move":
            began = on_plan(time - event.time_s + float(data["began_s"]))
            moves.setdefault(str(data["axis"]), []).append((began, data))
        elif event.name == "end":
            verified = bool(data.get("verified_safe"))
    return RunHistory(
        begun=str(notes.get("begun", "")),
        simulated=bool(notes["simulated"]),
        status=exit_status(contents),
        sessions=sessions(contents),
        steps=steps_done(contents),
        seams=sum(event.name == "seam" for _, event in events),
        duration_s=last - start,
        waited=tuple(waited),
        devices=tuple(devices.values()),
        verified_safe=verified,
        damaged_bytes=contents.damaged_bytes,
        version=str(notes.get("version", "")),
        chamber_s=np.array([time for time, _ in chamber if time >= 0.0]),
        chamber_c=np.array([value for time, value in chamber if time >= 0.0], dtype=np.float64),
        rates={axis: _turned(commands, angles.get(axis, [])) for axis, commands in moves.items()},
    )


def _plan_clock(folder: RunFolder, events: list[tuple[float, Event]]) -> Callable[[float], float]:
    """The plan's time as a function of the run's: parallel within a step; negative before the first step."""
    steps = folder.track().steps
    planned = np.concatenate([[0.0], np.cumsum([step.duration_s for step in steps])])
    begun = [
        (time - event.time_s + float(event.data["begins_s"]), int(event.data["number"]))
        for time, event in events
        if event.name == "step begins"
    ]

    def on_plan(time: float) -> float:
        # `begun` is in order of time.
        first = max(0, bisect_right(begun, (time, 10**9)) - 1)
        here = [(begins, number) for begins, number in begun[first:] if begins <= time]
        if not here:
            return -1.0
        begins, number = here[-1]
        return float(planned[number] + min(time - begins, steps[number].duration_s))

    return on_plan


def _turned(moves: list[tuple[float, Mapping[str, Any]]], angles: list[tuple[float, float]]) -> tuple[Floats, Floats]:
    """The rate of an axis by its executed commands or, for turns by hand, by differences of its angles."""
    if any(move["kind"] == "turn" and not move["acceleration_dps2"] for _, move in moves):
        return rates_of(*_columns(angles))
    points, rate = [(0.0, 0.0)], 0.0
    for began, move in moves:
        peak, steep = float(move["rate_dps"]), float(move["acceleration_dps2"])
        if move["kind"] == "turn":
            turned = AxisCommand(0.0, "", "turn", 0.0, peak, steep, float(move["angle_deg"]))
            signed = math.copysign(min(abs(peak), math.sqrt(abs(turned.angle_deg) * steep)), turned.angle_deg)
            ramp, end = abs(signed) / steep, turned.duration_s
            points += [(began, 0.0), (began + ramp, signed), (began + end - ramp, signed), (began + end, 0.0)]
        elif move["kind"] in ("spin", "stop"):
            then = peak if move["kind"] == "spin" else 0.0
            points += [(began, rate), (began + abs(then - rate) / (steep or math.inf), then)]
            rate = then
    return _columns(points)


def rates_of(time_s: Floats, angle_deg: Floats) -> tuple[Floats, Floats]:
    """Mean rates (deg/s) between readings of an angle, as steps: times and values to draw."""
    lasting = np.diff(time_s)
    # Two readings of one instant (of command and reply) do not determine a rate.
    kept = lasting > _INSTANT_S
    rate = np.diff(angle_deg)[kept] / lasting[kept]
    begin, end = time_s[:-1][kept], time_s[1:][kept]
    return np.stack([begin, end], axis=1).ravel(), np.repeat(rate, 2)


def _on_one_clock(events: list[Event], *, simulated: bool) -> list[tuple[float, Event]]:
    """The events of all sessions on the first session's clock: by the wall clock, except for a simulated clock."""
    shifted: list[tuple[float, Event]] = []
    shift, first = 0.0, math.nan
    for event in events:
        if event.name == SESSION and not simulated:
            offset = float(event.data["wall_clock_s"]) - event.time_s
            first = offset if math.isnan(first) else first
            shift = offset - first
        shifted.append((event.time_s + shift, event))
    return shifted


def _temperature(event: Event) -> float | None:
    value = event.data.get("product_c")
    return event.data.get("air_c") if value is None else value


def _columns(rows: list[tuple[float, float]]) -> tuple[Floats, Floats]:
    time, value = np.array(rows, dtype=np.float64).T
    return time, value
