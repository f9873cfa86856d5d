"""The journal of a run: raw bytes and events, append-only, checksummed, readable after any crash.

A file of records, little-endian:

    2 bytes  A7 4A                        4 bytes  length of the payload
    1 byte   kind: 1 event, 2 received,   8 bytes  time on the run's clock, float64, s
             3 sent                       n bytes  payload: JSON of an event; or the line's name, and its bytes
    1 byte   length of the line's name    4 bytes  CRC-32 of everything from the kind to the payload's end

Nothing is ever rewritten. A record that a crash has truncated fails its CRC; the next run appends behind it, and the
reader continues at the next sound record. Events reach the disk before `event` returns (unless `at_once` is false),
everything else within 1.1 s: one thread writes, so that a disk that stalls for seconds costs memory, and no
bytes of a line whose buffer holds a quarter of a second.

Writing raises nothing, because the caller may be about to stop an axis: a journal that can no longer be written has a
`problem`, which ends the run, and everything is made safe without a journal.
"""

import json
import math
import mmap
import os
import shutil
import struct
import threading
import time
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, cast

from gradcal_jax.hardware.errors import HardwareError

_SYNC = b"\xa7\x4a"
_HEAD = struct.Struct("<BBId")
_EVENT, _RECEIVED, _SENT = 1, 2, 3
_LONGEST, _LONGEST_NAME = 1 << 26, 255
# A disk that makes no progress for so long has failed.
_LONGEST_WAIT_S = 10.0
_SYNC_EVERY_S = 1.0
# Records for which nobody waits are written together.
_GATHERS_S = 0.02
_LOOKS_S = 0.25
_NUMBER = (int, float)
# The fields of events that are read back, and their types.
_FIELDS: Mapping[str, Mapping[str, tuple[type, ...]]] = {
    "session": {"number": (int,), "wall_clock_s": _NUMBER, "simulated": (bool,)},
    "step begins": {"begins_s": _NUMBER, "number": (int,)},
    "not done": {"number": (int,)},
    "step done": {"number": (int,)},
    "configuration": {"device": (str,), "registers": (dict,)},
    "identity": {"device": (str,)},
    "angle": {"axis": (str,), "time_s": _NUMBER, "moving": (bool,), "position_deg": (*_NUMBER, type(None))},
    "chamber": {"air_c": _NUMBER},
    "track": {"axis": (str,), "time_s": _NUMBER, "position_deg": (*_NUMBER, type(None))},
    "move": {"axis": (str,)},
    "homing": {"axis": (str,)},
    "state": {"state": (str,)},
    "hung": {"mounting": (int,)},
}

Direction = Literal[">", "<", "#"]
"""To the device, from it, or a remark about the line."""
Recorder = Callable[[float, Direction, bytes], None]
"""Records the bytes of a line: time, direction, bytes."""


@dataclass(frozen=True)
class Event:
    """An event of the run: its `name` and data."""

    time_s: float
    name: str
    data: dict[str, Any]


@dataclass(frozen=True)
class Chunk:
    """Bytes of one line, received or sent."""

    time_s: float
    line: str
    received: bool
    data: bytes


@dataclass
class JournalContents:
    """Everything that a journal holds, in order. `damaged_bytes` belong to no sound record; `latest_s`: last time."""

    records: list[Event | Chunk] = field(default_factory=list[Event | Chunk])
    damaged_bytes: int = 0
    latest_s: float = 0.0

    @property
    def events(self) -> list[Event]:
        return [record for record in self.records if isinstance(record, Event)]


class Journal(AbstractContextManager["Journal"]):
    """Append to a journal file, from any thread."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND | getattr(os, "O_BINARY", 0), 0o644)
        self._problem = ""
        # Since when the disk has been busy with one call, in real time.
        self._busy_since_s = math.inf
        self.free_bytes = self._free()
        """Of the disk, at least every second while the run writes."""
        # Guards what waits for the disk, whether somebody waits with it, and what is set when the disk has it.
        self._lock, self._wake, self._urgent = threading.Lock(), threading.Event(), threading.Event()
        self._waiting, self._awaited, self._on_disk = list[bytes](), False, threading.Event()
        self._closing = False
        self._writer = threading.Thread(target=self._write_on, daemon=True, name="journal")
        self._writer.start()

    @property
    def problem(self) -> str:
        """The reason why nothing more can be written, for the operator; empty: writing is possible. A disk that does
        not return from a call is noticed here, whoever looks."""
        if time.monotonic() - self._busy_since_s > _LONGEST_WAIT_S:
            self._fail(f"the disk has not answered for {_LONGEST_WAIT_S:g} s")
        return self._problem

    def _free(self) -> int:
        return shutil.disk_usage(self.path.parent).free

    def event(self, time_s: float, name: str, /, *, at_once: bool = True, **data: Any) -> None:
        """Write an event; with `at_once` wait until the disk has it, or until there is a `problem`."""
        payload = json.dumps({"event": name, **data}, separators=(",", ":"), allow_nan=False).encode()
        on_disk = self._append(_EVENT, b"", time_s, payload, awaited=at_once)
        while at_once and not (on_disk.wait(_LOOKS_S) or self.problem or self._closing):
            pass

    def bytes_of(self, line: str, time_s: float, data: bytes, *, received: bool) -> None:
        """Write bytes of a line; they are on the disk within a second."""
        self._append(_RECEIVED if received else _SENT, line.encode()[:_LONGEST_NAME], time_s, data)

    def recorder(self, line: str) -> Recorder:
        """A recorder for a `Transport`, whose bytes go into this journal under the name `line`."""
        return lambda time_s, direction, data: self.bytes_of(line, time_s, data, received=direction == "<")

    def close(self) -> None:
        self._closing = True
        self._urgent.set()
        self._wake.set()
        self._writer.join(_LONGEST_WAIT_S if self.problem else None)

    def __exit__(self, *_: object) -> None:
        self.close()

    def _append(self, kind: int, line: bytes, time_s: float, data: bytes, *, awaited: bool = False) -> threading.Event:
        """Queue a record for the disk, if it can still be written. Returns what is set when the disk has it."""
        body = _HEAD.pack(kind, len(line), len(line) + len(data), time_s) + line + data
        with self._lock:
            if not (self._problem or self._closing):
                self._waiting.append(_SYNC + body + zlib.crc32(body).to_bytes(4, "little"))
                self._awaited |= awaited
                if awaited:
                    self._urgent.set()
                self._wake.set()
            return self._on_disk

    def _write_on(self) -> None:
        """The writer's thread: write all waiting records at once, sync on request and once a second. What waits when a
        problem comes is written last, if the disk can; nothing follows a record that failed."""
        synced_s, dirty, ends = time.monotonic(), False, False
        while not ends:
            self._wake.wait(_SYNC_EVERY_S if dirty else None)
            self._urgent.wait(_GATHERS_S)
            self._wake.clear()
            self._urgent.clear()
            with self._lock:
                ends = self._closing or bool(self._problem)
                batch, awaited, on_disk = b"".join(self._waiting), self._awaited, self._on_disk
                self._waiting, self._awaited, self._on_disk = [], False, threading.Event()
            try:
                dirty = dirty or bool(batch)
                while batch:
                    self._busy_since_s = time.monotonic()
                    batch = batch[os.write(self._file, batch) :]
                if dirty and (awaited or ends or time.monotonic() >= synced_s + _SYNC_EVERY_S):
                    self._busy_since_s = time.monotonic()
                    os.fsync(self._file)
                    self.free_bytes = self._free()
                    synced_s, dirty = time.monotonic(), False
                self._busy_since_s = math.inf
            except Exception as problem:
                ends = True
                self._fail(f"{getattr(problem, 'strerror', None) or problem}")
            on_disk.set()
        os.close(self._file)

    def _fail(self, why: str) -> None:
        """Nothing more is written."""
        self._busy_since_s = math.inf
        self._problem = self._problem or (
            f"The journal {self.path} cannot be written: {why}. Free some space or choose another folder; the "
            "earlier part is valid and the run can be resumed."
        )


def read_journal(path: Path, *, chunks: bool = True) -> JournalContents:
    """All sound records of a journal, however it ends; without `chunks` its events alone, which take little memory.
    Raises `HardwareError` where there is no such file."""
    contents = JournalContents()
    contents.records += (record for record in records_of(path, contents) if chunks or isinstance(record, Event))
    return contents


def records_of(path: Path, contents: JournalContents | None = None) -> Iterator[Event | Chunk]:
    """The records of a journal one by one; `contents` gets what else `read_journal` finds. Raises `HardwareError`.

    The file is mapped: a journal of a day is larger than the memory that a computer can spare.
    """
    contents, place = contents or JournalContents(), 0
    try:
        with path.open("rb") as file:
            if not os.fstat(file.fileno()).st_size:
                return
            with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
                contents.damaged_bytes = len(data)
                while (place := data.find(_SYNC, place)) >= 0:
                    record, end = _record(data, place)
                    if record is None:
                        # Two bytes that look like a head: the true head may be one byte later.
                        place += 1
                        continue
                    contents.damaged_bytes -= end - place
                    contents.latest_s = max(contents.latest_s, record.time_s)
                    place = end
                    yield record
    except OSError as problem:
        raise HardwareError(f"The journal {path} cannot be read: {problem.strerror}.") from None


def _record(data: mmap.mmap, start: int) -> tuple[Event | Chunk | None, int]:
    """The record at `start`, if there is a sound one, and its end."""
    head = start + len(_SYNC)
    if len(data) < head + _HEAD.size:
        return None, start
    kind, named, length, time_s = _HEAD.unpack_from(data, head)
    begin = head + _HEAD.size
    end = begin + length
    if length > _LONGEST or zlib.crc32(data[head:end]).to_bytes(4, "little") != data[end : end + 4]:
        return None, start
    if not math.isfinite(time_s):
        raise _strange(start, "its time is not a number")
    if kind == _EVENT:
        return _event(start, time_s, data[begin:end]), end + 4
    line = data[begin : begin + named].decode("utf-8", "replace")
    return Chunk(time_s, line, kind == _RECEIVED, data[begin + named : end]), end + 4


def _event(start: int, time_s: float, payload: bytes) -> Event:
    """An event with the fields that this program writes; any other is refused with a sentence."""
    try:
        read: Any = json.loads(payload)
    except (ValueError, RecursionError):
        raise _strange(start, "it is not JSON") from None
    content = cast("dict[str, Any]", read if isinstance(read, dict) else {})
    name: Any = content.pop("event", None)
    if not isinstance(name, str):
        raise _strange(start, "it has no name")
    for field_name, kinds in _FIELDS.get(name, {}).items():
        value = content.get(field_name)
        if not isinstance(value, kinds) or (isinstance(value, bool) and bool not in kinds):
            raise _strange(start, f"the field {field_name!r} of an event {name!r} has the impossible value {value!r}")
    return Event(time_s, name, content)


def _strange(start: int, why: str) -> HardwareError:
    return HardwareError(
        f"The journal holds a record that no run of this program wrote, at byte {start}: {why}. Copy the original "
        "journal of the run again."
    )


def json_of(item: Any) -> Any:
    """Values for JSON: tuples as lists, infinities and NaN as null."""
    if isinstance(item, Mapping):
        return {str(k): json_of(v) for k, v in item.items()}  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]
    if isinstance(item, (list, tuple)):
        return [json_of(v) for v in item]  # pyright: ignore[reportUnknownVariableType]
    return None if isinstance(item, float) and not math.isfinite(item) else item


def event_fields(value: Any) -> dict[str, Any]:
    """A dataclass for JSON; its `name` is that of a device."""
    fields = {name: json_of(getattr(value, name)) for name in value.__dataclass_fields__}
    if "name" in fields:
        fields["device"] = fields.pop("name")
    return fields
