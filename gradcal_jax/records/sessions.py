"""The sessions of a run from its journal: events in memory, samples decoded into a file that is mapped into memory,
because those of days may take more memory than there is."""

import math
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gradcal_jax.hardware.frames import FrameDecoder
from gradcal_jax.hardware.journal import Chunk, Event
from gradcal_jax.hardware.roles import STANDARD_GRAVITY, ImuBatch, ImuDecoder, join
from gradcal_jax.hardware.run_folder import SESSION, breaks_off
from gradcal_jax.hardware.setup import config_of
from gradcal_jax.records.log import Reason
from gradcal_jax.spec.rig import ImuDevice

# Chunks that are decoded, and rows that are copied, at once.
_CHUNKS, _BLOCK = 1 << 6, 1 << 16
Rows = NDArray[Any]
"""A structured array: each row has all columns of a log."""


class SampleFile:
    """Samples of an IMU with `axes` gyros on a table of `table_axes`, in a nameless file in `folder`. Errors: `OSError`
    that names the folder where it cannot be written."""

    def __init__(self, folder: Path, axes: int = 3, table_axes: int = 0) -> None:
        columns: list[Any] = [(name, float) for name in ("time_s", "host_s", "temperature_c")]
        columns += [("rate", float, (axes,)), ("force", float, (3,)), ("table_rate", float, (table_axes,))]
        columns += [(name, np.int64) for name in ("gap", "standstill", "mounting")]
        columns += [("status", np.uint16), ("disturbed", np.bool_), ("restarted", np.bool_)]
        self.kind = np.dtype(columns)
        self._folder = folder
        self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115

    def __len__(self) -> int:
        return self._file.tell() // self.kind.itemsize

    def push(self, batch: ImuBatch) -> None:
        """The samples of a batch."""
        rows = np.zeros(len(batch), self.kind)
        rows["time_s"] = batch.device_time_s
        rows["host_s"] = batch.host_time_s
        rows["rate"] = np.radians(batch.gyro_dps)
        rows["force"] = batch.acceleration_g * STANDARD_GRAVITY
        rows["temperature_c"] = batch.temperature_c.mean(axis=1)
        rows["gap"] = batch.gap_before
        rows["status"] = np.where(batch.status != 0, Reason.MARKED.value, 0)
        rows["disturbed"] = batch.disturbed
        rows["restarted"] = batch.restarted
        self.write(rows)

    def write(self, rows: Rows) -> None:
        """Rows as they are."""
        try:
            self._file.write(rows.tobytes())
            self._file.flush()
        except OSError as problem:
            raise type(problem)(problem.errno, problem.strerror, str(self._folder)) from None

    def rows(self) -> Rows:
        """All samples, at the end; what is assigned to them is in the file, which goes with them."""
        with self._file:
            return np.memmap(self._file, self.kind, "r+") if len(self) else np.zeros(0, self.kind)


def compacted(rows: Rows, ranges: Sequence[tuple[int, int]]) -> Rows:
    """The rows of the increasing `ranges` alone, moved to the beginning."""
    count = 0
    for first, end in ranges:
        for begin in range(first, end, _BLOCK):
            block = rows[begin : min(begin + _BLOCK, end)].copy()
            rows[count : count + len(block)] = block
            count += len(block)
    return rows[:count]


@dataclass
class Session:
    """One part of a run: its records in order. It began at `begun_s` of the run's clock, in the `mounting` of that
    number, from 1; 0: the operator was never asked to mount the units."""

    number: int
    simulated: bool
    wall_clock_s: float
    begun_s: float
    mounting: int
    events: list[Event] = field(default_factory=list[Event])
    decoder: ImuDecoder | None = None
    """The IMU's, as it was first configured in the session."""
    samples: tuple[int, int] = (0, 0)
    """The first sample of the IMU in the file, and the one after the last."""

    @property
    def origin_s(self) -> float:
        """The wall clock's time at zero of the run's clock."""
        return self.wall_clock_s - self.begun_s

    def stretches(self) -> list[tuple[float, float]]:
        """From the beginning of a step with data to its end, or to the end of the run or session. Attempts at a step
        that the run refused ("not done") are no data, nor are those of later steps that were under way meanwhile."""
        attempts: list[tuple[int, float, float]] = []
        """Number of the step, begin and end."""
        latest, under_way = 0.0, False
        for event in self.events:
            latest = max(latest, event.time_s)
            if under_way and (event.name in ("step", "step ends") or breaks_off(event)):
                attempts[-1] = (*attempts[-1][:2], event.time_s)
                under_way = False
            if event.name == "not done":
                attempts = [attempt for attempt in attempts if attempt[0] < event.data["number"]]
            elif event.name == "step begins" and event.data.get("data"):
                attempts.append((event.data["number"], float(event.data["begins_s"]), 0.0))
                under_way = True
        if under_way:
            attempts[-1] = (*attempts[-1][:2], latest)
        stretches: list[tuple[float, float]] = []
        for _, begin_s, end_s in attempts:
            # A step that follows at once continues the stretch: its "step begins" has the same time.
            flows = bool(stretches) and begin_s - stretches[-1][1] < 1e-3
            stretches.append((stretches.pop()[0] if flows else begin_s, end_s))
        return stretches

    def count(self, name: str) -> int:
        """How many events have a name."""
        return sum(event.name == name for event in self.events)

    def mountings(self) -> list[tuple[float, int]]:
        """Times, and the number of the mounting from each on, from 1; 0: the operator was never asked to mount the
        units."""
        hung = [(event.time_s, int(event.data["mounting"])) for event in self.events if event.name == "hung"]
        return [(-math.inf, self.mounting), *hung]


def sessions_of(
    records: Iterable[Event | Chunk], device: ImuDevice | None = None, file: SampleFile | None = None
) -> list[Session]:
    """The sessions of a run; with a `device`, an IMU, its samples are decoded into the `file` as they are read."""
    sessions: list[Session] = []
    waiting: list[Chunk] = []
    mounting = 0

    def decode() -> None:
        if file is None or not sessions:
            return
        decoder, first = sessions[-1].decoder, sessions[-1].samples[0]
        if isinstance(decoder, FrameDecoder) and waiting:
            times_s = np.repeat([chunk.time_s for chunk in waiting], [len(chunk.data) for chunk in waiting])
            file.push(decoder.push(b"".join(chunk.data for chunk in waiting), times_s))
        elif decoder is not None:
            file.push(join([decoder.push(chunk.data, chunk.time_s) for chunk in waiting]))
        waiting.clear()
        sessions[-1].samples = first, len(file)

    for record in records:
        if isinstance(record, Chunk):
            if device is not None and sessions and record.received and record.line == device.name:
                waiting.append(record)
                if len(waiting) >= _CHUNKS and sessions[-1].decoder is not None:
                    decode()
            continue
        if record.name == SESSION:
            decode()
            data = record.data
            of = int(data["number"]), bool(data["simulated"]), float(data["wall_clock_s"])
            first = 0 if file is None else len(file)
            sessions.append(Session(*of, record.time_s, mounting, samples=(first, first)))
        elif record.name == "hung":
            mounting = int(record.data["mounting"])
        elif record.name == "configuration" and device is not None and record.data["device"] == device.name:
            sessions[-1].decoder = sessions[-1].decoder or config_of(device, "imu", ("imu", device.name)).decoder()
        # Where the unit measures its own temperature, the chamber's many readings are not needed.
        if sessions and (device is None or record.name != "chamber"):
            sessions[-1].events.append(record)
    decode()
    return sessions
