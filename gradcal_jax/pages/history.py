"""The history of a run, from its journal: times, devices, and the chamber's temperature."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gradcal_jax.hardware.run_folder import SESSION, RunFolder, exit_status, sessions, steps_done
from gradcal_jax.tables.table import Table
from gradcal_jax.units import count_text, time_text


class RunHistory(NamedTuple):
    """The history of a run: sentences, devices, and the chamber's temperature (°C) since the run began (s)."""

    begun: str
    simulated: bool
    sentences: list[str]
    devices: Table
    chamber_s: NDArray[np.float64]
    chamber_c: NDArray[np.float64]


def history_of(folder: RunFolder) -> RunHistory:
    """The history of a run. Raises `ValueError` where the folder is not a run's."""
    notes, contents = folder.notes(), folder.events()
    simulated, begun = bool(notes["simulated"]), str(notes.get("begun", ""))
    if not contents.events:
        raise ValueError(f"the run in {folder.path} never began: its journal is empty")
    start, shift, first, time, waited = contents.events[0].time_s, 0.0, math.nan, 0.0, 0.0
    chamber: list[tuple[float, float]] = []
    devices: dict[str, tuple[str, ...]] = {}
    verified = False
    for event in contents.events:
        data = event.data
        if event.name == SESSION and not simulated:
            # All sessions on the first session's clock, by the wall clock.
            offset = float(data["wall_clock_s"]) - event.time_s
            first = offset if math.isnan(first) else first
            shift = offset - first
        time = max(time, event.time_s + shift - start)
        if event.name == "identity":
            names = ("device", "driver", "model", "serial_number", "firmware")
            devices.setdefault(str(data["device"]), tuple(str(data.get(name, "")) for name in names))
        elif event.name == "stable":
            waited += float(data["waited_s"])
        elif event.name == "chamber":
            air, product = data.get("air_c"), data.get("product_c")
            if (value := air if product is None else product) is not None:
                chamber.append((event.time_s + shift - start, value))
        elif event.name == "end":
            verified = bool(data.get("verified_safe"))
    sentences = [
        f"Run begun {begun}: {exit_status(contents)}, {count_text(steps_done(contents), 'step')}, {time_text(time)} in "
        f"total, including {time_text(waited)} of waiting for stable temperatures.",
        f"{'Every' if verified else 'NOT every'} device was verified to be safe at the end.",
    ]
    seams = sum(event.name == "seam" for event in contents.events)
    if interrupted := max(seams, sessions(contents) - 1):
        sentences.append(f"The run was interrupted and continued {count_text(interrupted, 'time')}.")
    if contents.damaged_bytes:
        sentences.append(f"{contents.damaged_bytes} bytes of the journal belong to no valid record.")
    at = np.array(chamber, dtype=np.float64).reshape(-1, 2)
    table = Table.of(["device", "driver", "model", "serial number", "firmware"], devices.values())
    return RunHistory(begun, simulated, sentences, table, at[:, 0], at[:, 1])
