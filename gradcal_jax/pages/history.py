"""The history of a run, from its journal: times, devices, waits and the chamber's temperature."""

import math
from bisect import bisect_right
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gradcal_jax.hardware.journal import Event
from gradcal_jax.hardware.run_folder import SESSION, RunFolder, exit_status, sessions, steps_done
from gradcal_jax.tables.table import Table
from gradcal_jax.units import count_text, time_text

Floats = NDArray[np.float64]


class RunHistory(NamedTuple):
    """The history of a run: sentences, waits for stable temperatures, devices, and the chamber's temperature (°C) on
    the plan's clock (s), which stops while a step waits."""

    begun: str
    simulated: bool
    sentences: list[str]
    waited: Table
    devices: Table
    chamber_s: Floats
    chamber_c: Floats


def history_of(folder: RunFolder) -> RunHistory:
    """The history of a run. Raises `ValueError` where the folder is not a run's."""
    notes, contents = folder.notes(), folder.events()
    simulated = bool(notes["simulated"])
    events = _on_one_clock(contents.events, simulated=simulated)
    if not events:
        raise ValueError(f"the run in {folder.path} never began: its journal is empty")
    on_plan = _plan_clock(folder, events)
    chamber: list[tuple[float, float]] = []
    devices: dict[str, tuple[str, ...]] = {}
    waits: list[tuple[str, float, float]] = []
    verified = False
    for time, event in events:
        data = event.data
        if event.name == "identity":
            names = ("device", "driver", "model", "serial_number", "firmware")
            devices.setdefault(str(data["device"]), tuple(str(data.get(name, "")) for name in names))
        elif event.name == "stable":
            waits.append((str(data["step"]), float(data["waited_s"]), float(data["temperature_c"])))
        elif event.name == "chamber" and (value := _temperature(event)) is not None and on_plan(time) >= 0.0:
            chamber.append((on_plan(time), value))
        elif event.name == "end":
            verified = bool(data.get("verified_safe"))
    lasted = max(time for time, _ in events) - events[0][0]
    seams = sum(event.name == "seam" for _, event in events)
    sentences = [
        f"Run begun {notes.get('begun', '')}: {exit_status(contents)}, {count_text(steps_done(contents), 'step')}, "
        f"{time_text(lasted)} in total, including {time_text(sum(wait[1] for wait in waits))} of waiting for stable "
        "temperatures.",
        "Every device was verified to be safe at the end."
        if verified
        else "NOT every device was verified to be safe at the end.",
    ]
    if seams or sessions(contents) > 1:
        sentences.append(
            f"The run was interrupted and continued {count_text(max(seams, sessions(contents) - 1), 'time')}."
        )
    if contents.damaged_bytes:
        sentences.append(f"{contents.damaged_bytes} bytes of the journal belong to no valid record.")
    track = np.array(chamber, dtype=np.float64).reshape(-1, 2)
    rows = [(step, time_text(waited), f"{at:.4g} °C") for step, waited, at in waits]
    return RunHistory(
        begun=str(notes.get("begun", "")),
        simulated=simulated,
        sentences=sentences,
        waited=Table.of(["segment", "waited", "stable at"], rows),
        devices=Table.of(["device", "driver", "model", "serial number", "firmware"], devices.values()),
        chamber_s=track[:, 0],
        chamber_c=track[:, 1],
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
