"""The journal of a run: raw bytes and events, append-only, checksummed, readable after any crash.

A file of records, little-endian:

    2 bytes  A7 4A                        4 bytes  length of the payload
    1 byte   kind: 1 event, 2 received,   8 bytes  time on the run's clock, float64, s
             3 sent                       n bytes  payload: JSON of an event, or the bytes of a line
    1 byte   number of the line           4 bytes  CRC-32 of everything from the kind to the payload's end

Nothing is ever rewritten. A record that a crash has truncated fails its CRC; the next run appends behind it, and the
reader continues at the next sound record. Events reach the disk before `event` returns (unless `at_once` is false),
everything else at least once a second: one thread writes, so that a disk that stalls for seconds costs memory, and no
bytes of a line whose buffer holds a quarter of a second.

Writing raises nothing, because the caller may be about to stop an axis: a journal that can no longer be written has a
`problem`, which ends the run, and everything is made safe without a journal.
"""

import errno
import json
import math
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
from typing import Any, BinaryIO, Literal, cast

from gradcal_jax.hardware.errors import HardwareError

_SYNC = b"\xa7\x4a"
_HEAD = struct.Struct("<BBId")
_EVENT, _RECEIVED, _SENT = 1, 2, 3
_LONGEST = 1 << 26
_BLOCK = 1 << 22
_MOST_WAITING = 1 << 28
# A disk that makes no progress for so long has failed.
_LONGEST_WAIT_S = 10.0
_SYNC_EVERY_S = 1.0
_LOOKS_S = 0.25
LINE_EVENT = "line"
_NUMBER = (int, float)
# The fields of events that are read back, and their types.
_FIELDS: Mapping[str, Mapping[str, tuple[type, ...]]] = {
    LINE_EVENT: {"number": (int,), "name": (str,)},
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
        self._lines: dict[str, int] = {}
        self._first_number = 0
        if path.exists():
            # Numbers of lines continue after the last session's: one number never means two lines.
            events = read_journal(path, chunks=False).events
            self._first_number = max((e.data["number"] for e in events if e.name == LINE_EVENT), default=-1) + 1
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND | getattr(os, "O_BINARY", 0), 0o644)
        self._problem = ""
        # Since when the disk has been busy with one call, in real time; None: it is not.
        self._busy_since_s: float | None = None
        self.free_bytes = self._free()
        """Of the disk, at least every second while the run writes."""
        # Guards what waits for the disk: records, and who waits for them to be on it.
        self._lock, self._wake = threading.RLock(), threading.Event()
        self._waiting: list[bytes] = []
        self._waiting_bytes = 0
        self._waiters: list[threading.Event] = []
        self._closing = False
        self._writer = threading.Thread(target=self._write_on, daemon=True, name="journal")
        self._writer.start()

    @property
    def problem(self) -> str:
        """The reason why nothing more can be written, for the operator; empty: writing is possible. A disk that does
        not return from a call is noticed here, whoever looks."""
        since_s = self._busy_since_s
        if since_s is not None and time.monotonic() - since_s > _LONGEST_WAIT_S:
            self._fail(f"the disk has not answered for {_LONGEST_WAIT_S:g} s")
        return self._problem

    def _free(self) -> int:
        return shutil.disk_usage(self.path.parent).free

    def event(self, time_s: float, name: str, /, *, at_once: bool = True, **data: Any) -> None:
        """Write an event; with `at_once` wait until the disk has it, or until there is a `problem`."""
        payload = json.dumps({"event": name, **data}, separators=(",", ":"), allow_nan=False).encode()
        on_disk = threading.Event()
        with self._lock:
            waits = self._append(_EVENT, 0, time_s, payload) and at_once
            if waits:
                self._waiters.append(on_disk)
        while waits and not (on_disk.wait(_LOOKS_S) or self.problem):
            pass

    def bytes_of(self, line: str, time_s: float, data: bytes, *, received: bool) -> None:
        """Write bytes of a line; they are on the disk within a second."""
        with self._lock:
            number = self._lines.get(line)
            if number is None:
                number = self._first_number + len(self._lines)
                if number > 255:
                    self._fail("a journal has at most 256 lines, including those of resumed runs")
                    return
                self._lines[line] = number
                self.event(time_s, LINE_EVENT, at_once=False, number=number, name=line)
            self._append(_RECEIVED if received else _SENT, number, time_s, data)

    def recorder(self, line: str) -> Recorder:
        """A recorder for a `Transport`, whose bytes go into this journal under the name `line`."""
        return lambda time_s, direction, data: self.bytes_of(line, time_s, data, received=direction == "<")

    def close(self) -> None:
        self._closing = True
        self._wake.set()
        self._writer.join(_LONGEST_WAIT_S if self.problem else None)

    def __exit__(self, *_: object) -> None:
        self.close()

    def _append(self, kind: int, line: int, time_s: float, payload: bytes) -> bool:
        """Queue a record for the disk, if it can still be written. The caller holds the lock."""
        body = _HEAD.pack(kind, line, len(payload), time_s) + payload
        record = _SYNC + body + zlib.crc32(body).to_bytes(4, "little")
        if self._waiting_bytes + len(record) > _MOST_WAITING:
            self._fail(f"the disk is too slow: {_MOST_WAITING >> 20} MB wait to be written")
        if self._problem or self._closing:
            return False
        self._waiting.append(record)
        self._waiting_bytes += len(record)
        self._wake.set()
        return True

    def _write_on(self) -> None:
        """The writer's thread: write all waiting records at once, sync on request and once a second. What waits when a
        problem comes is written last, if the disk can; nothing follows a record that failed."""
        synced_s, dirty, ends = time.monotonic(), False, False
        while not ends:
            self._wake.wait(max(0.0, synced_s + _SYNC_EVERY_S - time.monotonic()) if dirty else None)
            self._wake.clear()
            with self._lock:
                ends = self._closing or bool(self._problem)
                batch, self._waiting, self._waiting_bytes = b"".join(self._waiting), [], 0
                waiters, self._waiters = self._waiters, []
            try:
                self._busy_since_s = time.monotonic()
                dirty = dirty or bool(batch)
                while batch:
                    batch = batch[os.write(self._file, batch) :]
                    self._busy_since_s = time.monotonic()
                if dirty and (waiters or ends or time.monotonic() >= synced_s + _SYNC_EVERY_S):
                    os.fsync(self._file)
                    self._busy_since_s = time.monotonic()
                    self.free_bytes = self._free()
                    synced_s, dirty = time.monotonic(), False
                self._busy_since_s = None
            except Exception as problem:
                ends = True
                full = isinstance(problem, OSError) and problem.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
                self._fail("the disk is full" if full else f"{getattr(problem, 'strerror', None) or problem}")
            for waiter in waiters:
                waiter.set()
        os.close(self._file)

    def _fail(self, why: str) -> None:
        """Nothing more is written."""
        self._busy_since_s = None
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
    """The records of a journal one by one; `contents` gets what else `read_journal` finds. Raises `HardwareError`."""
    try:
        with path.open("rb") as file:
            yield from _parse(file, contents or JournalContents())
    except OSError as problem:
        raise HardwareError(f"The journal {path} cannot be read: {problem.strerror}.") from None


def _parse(file: BinaryIO, contents: JournalContents) -> Iterator[Event | Chunk]:
    """Read block by block: a journal of a day is larger than what a computer can spare."""
    names: dict[int, str] = {}
    buffer, origin, ended = b"", 0, False
    while not ended:
        block = file.read(_BLOCK)
        buffer, ended, position = buffer + block, not block, 0
        while (start := buffer.find(_SYNC, position)) >= 0:
            contents.damaged_bytes += start - position
            record, position = _record(buffer, start, origin, names)
            if record is None and position > len(buffer) and not ended:
                # Its end is in the next block.
                position = start
                break
            if record is None:
                # Two bytes that look like a head: the true head may be one byte later.
                contents.damaged_bytes += 1
                position = start + 1
                continue
            if isinstance(record, Event) and record.name == LINE_EVENT:
                names[int(record.data["number"])] = str(record.data["name"])
            contents.latest_s = max(contents.latest_s, record.time_s)
            yield record
        else:
            rest = len(buffer) - (not ended and buffer.endswith(_SYNC[:1]))
            contents.damaged_bytes += rest - position
            position = rest
        buffer, origin = buffer[position:], origin + position


def _record(data: bytes, start: int, origin: int, names: dict[int, str]) -> tuple[Event | Chunk | None, int]:
    """The record at `start` and its end; None where there is none, or where it ends beyond the data."""
    head = start + len(_SYNC)
    if len(data) < head + _HEAD.size + 4:
        return None, head + _HEAD.size + 4
    kind, line, length, time_s = _HEAD.unpack_from(data, head)
    end = head + _HEAD.size + length + 4
    if length > _LONGEST:
        return None, start
    if end > len(data):
        return None, end
    if zlib.crc32(memoryview(data)[head : end - 4]) != int.from_bytes(data[end - 4 : end], "little"):
        return None, start
    payload = data[head + _HEAD.size : end - 4]
    if not math.isfinite(time_s):
        raise _strange(origin + start, "its time is not a number")
    if kind == _EVENT:
        return _event(origin + start, time_s, payload), end
    return Chunk(time_s, names.get(line, f"line {line}"), kind == _RECEIVED, payload), end


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
