"""What a run did, from its journal: when, by which devices, how long it waited, temperatures and angles."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gradcal_jax.hardware.journal import Event
from gradcal_jax.hardware.run_folder import SESSION, RunFolder, exit_status, sessions, steps_done

Floats = NDArray[np.float64]
_INSTANT_S = 0.05


class Waited(NamedTuple):
    """A segment that waited for a stable temperature, for how long, and where it settled."""

    step: str
    waited_s: float
    temperature_c: float


class Device(NamedTuple):
    """Who answered on a port."""

    name: str
    driver: str
    model: str
    serial_number: str
    firmware: str


class Course(NamedTuple):
    """What was done. Times in s since the run began.

    `chamber_s`, `chamber_c` `(n,)`: when the chamber was read, and its temperature. `angles`: of each axis, when it was
    read and its angle (deg), both `(m,)`. `status`: "success", "stopped", "aborted" or "lost"; `damaged_bytes`: of the
    journal, that belong to no record.
    """

    begun: str
    simulated: bool
    status: str
    sessions: int
    steps: int
    seams: int
    duration_s: float
    waited: tuple[Waited, ...]
    devices: tuple[Device, ...]
    verified_safe: bool
    damaged_bytes: int
    version: str
    chamber_s: Floats
    chamber_c: Floats
    angles: dict[str, tuple[Floats, Floats]]


def course_of(folder: RunFolder) -> Course:
    """The course of a run. Raises `ValueError` where the folder is not a run's."""
    notes, contents = folder.notes(), folder.contents()
    events = _on_one_clock(contents.events, simulated=bool(notes["simulated"]))
    if not events:
        raise ValueError(f"{folder.path} holds a run that never began: its journal is empty")
    start = events[0][0]
    last = max(time for time, _ in events)
    chamber = [
        (time - start, _temperature(event))
        for time, event in events
        if event.name == "chamber" and _temperature(event) is not None
    ]
    devices: dict[str, Device] = {}
    angles: dict[str, list[tuple[float, float]]] = {}
    waited: list[Waited] = []
    verified = False
    for time, event in events:
        data = event.data
        if event.name == "identity":
            said = (str(data.get(name, "")) for name in ("driver", "model", "serial_number", "firmware"))
            devices.setdefault(str(data["device"]), Device(str(data["device"]), *said))
        elif event.name == "stable":
            waited.append(Waited(str(data["step"]), float(data["waited_s"]), float(data["temperature_c"])))
        elif event.name == "angle" and data.get("position_deg") is not None:
            angles.setdefault(str(data["axis"]), []).append((time - start, float(data["position_deg"])))
        elif event.name == "end":
            verified = bool(data.get("verified_safe"))
    return Course(
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
        chamber_s=np.array([time for time, _ in chamber]),
        chamber_c=np.array([value for _, value in chamber], dtype=np.float64),
        angles={axis: _columns(rows) for axis, rows in angles.items()},
    )


def rates_of(time_s: Floats, angle_deg: Floats) -> tuple[Floats, Floats]:
    """Mean rates (deg/s) between readings of an angle, as steps: times and values to draw."""
    lasting = np.diff(time_s)
    # Two readings of one instant, of command and answer, say nothing of a rate.
    kept = lasting > _INSTANT_S
    rate = np.diff(angle_deg)[kept] / lasting[kept]
    begin, end = time_s[:-1][kept], time_s[1:][kept]
    return np.stack([begin, end], axis=1).ravel(), np.repeat(rate, 2)


def _on_one_clock(events: list[Event], *, simulated: bool) -> list[tuple[float, Event]]:
    """Every session's events on the first one's clock: by the wall clock, except where the clock was simulated."""
    found: list[tuple[float, Event]] = []
    shift, first = 0.0, math.nan
    for event in events:
        if event.name == SESSION and not simulated:
            offset = float(event.data["wall_clock_s"]) - event.time_s
            first = offset if math.isnan(first) else first
            shift = offset - first
        found.append((event.time_s + shift, event))
    return found


def _temperature(event: Event) -> float | None:
    value = event.data.get("product_c")
    return event.data.get("air_c") if value is None else value


def _columns(rows: list[tuple[float, float]]) -> tuple[Floats, Floats]:
    time, value = np.array(rows, dtype=np.float64).T
    return time, value
