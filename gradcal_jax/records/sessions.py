"""The sessions of a run from its journal: events in memory, samples decoded into a file."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, field

from gradcal_jax.hardware.journal import Chunk, Event
from gradcal_jax.hardware.roles import ImuBatch, ImuDecoder, join
from gradcal_jax.hardware.run_folder import SESSION, breaks_off
from gradcal_jax.hardware.setup import config_of
from gradcal_jax.records.samples import SampleFile
from gradcal_jax.spec.rig import ImuDevice

# Samples that are joined at once.
_SAMPLES = 1 << 15


@dataclass
class _Attempt:
    """At a step with data of this number."""

    number: int
    begin_s: float
    end_s: float = 0.0


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
    stream: "Stream | None" = None
    """The samples of the IMU."""

    @property
    def origin_s(self) -> float:
        """The wall clock's time at zero of the run's clock."""
        return self.wall_clock_s - self.begun_s

    def stretches(self) -> list[tuple[float, float]]:
        """From the beginning of a step with data to its end, or to the end of the run or session. Attempts at a step
        that the run refused ("not done") are no data, nor are those of later steps that were under way meanwhile."""
        attempts: list[_Attempt] = []
        latest, under_way = 0.0, False
        for event in self.events:
            latest = max(latest, event.time_s)
            if under_way and (event.name in ("step", "step ends") or breaks_off(event)):
                attempts[-1].end_s = event.time_s
                under_way = False
            if event.name == "not done":
                attempts = [attempt for attempt in attempts if attempt.number < event.data["number"]]
            elif event.name == "step begins" and event.data.get("data"):
                attempts.append(_Attempt(event.data["number"], float(event.data["begins_s"])))
                under_way = True
        if under_way:
            attempts[-1].end_s = latest
        stretches: list[tuple[float, float]] = []
        for attempt in attempts:
            # A step that follows at once continues the stretch: its "step begins" has the same time.
            flows = bool(stretches) and attempt.begin_s - stretches[-1][1] < 1e-3
            begin_s = stretches.pop()[0] if flows else attempt.begin_s
            stretches.append((begin_s, attempt.end_s))
        return stretches

    def refused(self) -> int:
        """How many attempts at a step the run refused."""
        return sum(event.name == "not done" for event in self.events)

    def mountings(self) -> list[tuple[float, int]]:
        """Times, and the number of the mounting from each on, from 1; 0: the operator was never asked to mount the
        units."""
        hung = [(event.time_s, int(event.data["mounting"])) for event in self.events if event.name == "hung"]
        return [(-math.inf, self.mounting), *hung]


class Stream:
    """The samples of an IMU in one session: those of `file` from `first` to before `end`."""

    def __init__(self, device: ImuDevice, file: SampleFile) -> None:
        self._device, self._file = device, file
        self._early: list[Chunk] = []
        self._waiting: list[ImuBatch] = []
        self._count = 0
        self.first = self.end = len(file)
        self.decoder: ImuDecoder | None = None

    def configure(self, event: Event) -> None:
        """The decoder is that of the unit's first configuration in the session."""
        if event.data["device"] != self._device.name or self.decoder is not None:
            return
        self.decoder = config_of(self._device, "imu", ("imu", self._device.name)).decoder()
        for chunk in self._early:
            self.push(chunk)
        self._early.clear()

    def push(self, chunk: Chunk) -> None:
        if chunk.line != self._device.name:
            return
        if self.decoder is None:
            self._early.append(chunk)
            return
        self._waiting.append(self.decoder.push(chunk.data, chunk.time_s))
        self._count += len(self._waiting[-1])
        if len(self._waiting) == _SAMPLES or self._count >= _SAMPLES:
            self.flush()

    def flush(self) -> None:
        self._file.push(join(self._waiting))
        self._waiting, self._count = [], 0
        self.end = len(self._file)


def sessions_of(
    records: Iterable[Event | Chunk], device: ImuDevice | None = None, file: SampleFile | None = None
) -> list[Session]:
    """The sessions of a run; with a `device`, an IMU, its samples are decoded into the `file` as they are read."""
    sessions: list[Session] = []
    mounting = 0
    for record in records:
        stream = sessions[-1].stream if sessions else None
        if isinstance(record, Chunk):
            if stream is not None and record.received:
                stream.push(record)
            continue
        if record.name == SESSION:
            if stream is not None:
                stream.flush()
            stream = None if device is None or file is None else Stream(device, file)
            data = record.data
            of = int(data["number"]), bool(data["simulated"]), float(data["wall_clock_s"])
            sessions.append(Session(*of, record.time_s, mounting, stream=stream))
        elif record.name == "hung":
            mounting = int(record.data["mounting"])
        elif record.name == "configuration" and stream is not None:
            stream.configure(record)
        # Where the unit measures its own temperature, the chamber's many readings are not needed.
        if sessions and (device is None or record.name != "chamber"):
            sessions[-1].events.append(record)
    if sessions and (stream := sessions[-1].stream) is not None:
        stream.flush()
    return sessions
