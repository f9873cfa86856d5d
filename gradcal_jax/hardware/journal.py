"""The journal of a run: raw bytes and events, append-only, checksummed, readable after any crash.

A file of records, little-endian:

    2 bytes  A7 4A                        4 bytes  length of the payload
    1 byte   kind: 1 event, 2 received,   8 bytes  time on the run's clock, float64, s
             3 sent                       n bytes  payload: JSON of an event, or the bytes of a line
    1 byte   number of the line           4 bytes  CRC-32 of everything from the kind to the payload's end

Nothing is ever rewritten. A record that a crash has torn fails its CRC; the next run appends behind it, and the reader
goes on at the next record that fits. Events reach the disk before `event` returns (unless it is told not to wait),
everything else at least once a second.
"""

import errno
import json
import os
import shutil
import struct
import threading
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

from .errors import HardwareError
from .transcript import Direction

_SYNC = b"\xa7\x4a"
_HEAD = struct.Struct("<BBId")
_EVENT, _RECEIVED, _SENT = 1, 2, 3
_LONGEST = 1 << 26
LINE_EVENT = "line"


class JournalFull(HardwareError):
    """The journal cannot be written: without it a run must not go on."""


@dataclass(frozen=True)
class Event:
    """Something that happened: `name` and whatever belongs to it."""

    time_s: float
    name: str
    data: dict[str, Any]


@dataclass(frozen=True)
class Chunk:
    """Bytes of one line as they came or went."""

    time_s: float
    line: str
    received: bool
    data: bytes


@dataclass
class JournalContents:
    """Everything that a journal holds, in order. `damaged_bytes` belong to no sound record."""

    records: list[Event | Chunk] = field(default_factory=list[Event | Chunk])
    damaged_bytes: int = 0

    @property
    def events(self) -> list[Event]:
        return [record for record in self.records if isinstance(record, Event)]

    def chunks(self, line: str, *, received: bool = True) -> Iterator[Chunk]:
        for record in self.records:
            if isinstance(record, Chunk) and record.line == line and record.received == received:
                yield record


class Journal:
    """Append to a journal file, from any thread."""

    def __init__(self, path: Path, *, sync_every_s: float = 1.0) -> None:
        self.path = path
        self._lock = threading.Lock()
        self._lines: dict[str, int] = {}
        self._dirty = False
        self._stop = threading.Event()
        if path.exists():
            # Numbers of lines go on where the last run stopped: one number never means two lines.
            known = [event.data["number"] for event in read_journal(path).events if event.name == LINE_EVENT]
            self._first_number = max(known, default=-1) + 1
        else:
            self._first_number = 0
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND | getattr(os, "O_BINARY", 0), 0o644)
        self._problem: JournalFull | None = None
        self._syncer = threading.Thread(target=self._sync_regularly, args=(sync_every_s,), daemon=True, name="journal")
        self._syncer.start()

    def event(self, time_s: float, name: str, /, *, at_once: bool = True, **data: Any) -> None:
        """Write an event; with `at_once` wait until the disk has it. Raises `JournalFull`."""
        payload = json.dumps({"event": name, **data}, separators=(",", ":"), allow_nan=False).encode()
        with self._lock:
            self._append(_EVENT, 0, time_s, payload)
            if at_once:
                self._sync()

    def bytes_of(self, line: str, time_s: float, data: bytes, *, received: bool) -> None:
        """Write bytes of a line; they are on the disk within `sync_every_s`. Raises `JournalFull`."""
        with self._lock:
            number = self._lines.get(line)
            if number is None:
                number = self._lines[line] = self._first_number + len(self._lines)
                if number > 255:
                    raise HardwareError("A journal holds 256 lines at most, resumed runs included.")
                note = json.dumps({"event": LINE_EVENT, "number": number, "name": line}).encode()
                self._append(_EVENT, 0, time_s, note)
            self._append(_RECEIVED if received else _SENT, number, time_s, data)

    def recorder(self, line: str) -> "LineRecorder":
        """For a `Transport`: its bytes go into this journal under the name `line`."""
        return LineRecorder(self, line)

    def close(self) -> None:
        self._stop.set()
        self._syncer.join(timeout=5.0)
        with self._lock:
            if self._file >= 0:
                if self._problem is None:
                    self._sync()
                os.close(self._file)
                self._file = -1

    def __enter__(self) -> "Journal":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # -------------------------------------------------------------------------------------------------------- parts

    def _append(self, kind: int, line: int, time_s: float, payload: bytes) -> None:
        if self._problem is not None:
            raise self._problem
        if self._file < 0:
            raise JournalFull("The journal is closed.")
        body = _HEAD.pack(kind, line, len(payload), time_s) + payload
        record = _SYNC + body + zlib.crc32(body).to_bytes(4, "little")
        try:
            while record:
                record = record[os.write(self._file, record) :]
        except OSError as problem:
            raise self._failed(problem) from None
        self._dirty = True

    def _sync(self) -> None:
        try:
            os.fsync(self._file)
        except OSError as problem:
            raise self._failed(problem) from None
        self._dirty = False

    def _sync_regularly(self, every_s: float) -> None:
        while not self._stop.wait(every_s):
            # On a duplicate and outside the lock: a slow disk must not hold up those who write.
            with self._lock:
                if self._file < 0 or not self._dirty or self._problem is not None:
                    continue
                self._dirty = False
                duplicate = os.dup(self._file)
            try:
                os.fsync(duplicate)
            except OSError as problem:
                with self._lock:
                    self._failed(problem)
            finally:
                os.close(duplicate)

    def _failed(self, problem: OSError) -> JournalFull:
        full = problem.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
        what = "the disk is full" if full else f"{problem.strerror or problem}"
        self._problem = JournalFull(
            f"The journal {self.path} cannot be written: {what}. Free some space or choose another folder; what was "
            "written before is sound and the run can be resumed."
        )
        return self._problem


class LineRecorder:
    """A `Recorder` that writes to a journal."""

    def __init__(self, journal: Journal, line: str) -> None:
        self._journal, self._line = journal, line

    def record(self, time_s: float, direction: Direction, data: bytes) -> None:
        self._journal.bytes_of(self._line, time_s, data, received=direction == "<")


def read_journal(path: Path) -> JournalContents:
    """Everything sound in a journal, however it ends. Raises `HardwareError` where there is no such file."""
    try:
        data = path.read_bytes()
    except OSError as problem:
        raise HardwareError(f"The journal {path} cannot be read: {problem.strerror}.") from None
    return parse_journal(data)


def parse_journal(data: bytes) -> JournalContents:
    contents = JournalContents()
    names: dict[int, str] = {}
    position = 0
    while (start := data.find(_SYNC, position)) >= 0:
        contents.damaged_bytes += start - position
        record, end = _record(data, start, names)
        if record is None:
            # Two bytes that look like a beginning: the true one may be the very next.
            contents.damaged_bytes += 1
            position = start + 1
            continue
        if isinstance(record, Event) and record.name == LINE_EVENT:
            names[int(record.data["number"])] = str(record.data["name"])
        contents.records.append(record)
        position = end
    contents.damaged_bytes += len(data) - position
    return contents


def _record(data: bytes, start: int, names: dict[int, str]) -> tuple[Event | Chunk | None, int]:
    head = start + len(_SYNC)
    if len(data) < head + _HEAD.size + 4:
        return None, start
    kind, line, length, time_s = _HEAD.unpack_from(data, head)
    end = head + _HEAD.size + length + 4
    if length > _LONGEST or end > len(data):
        return None, start
    if zlib.crc32(memoryview(data)[head : end - 4]) != int.from_bytes(data[end - 4 : end], "little"):
        return None, start
    payload = data[head + _HEAD.size : end - 4]
    if kind == _EVENT:
        content = json.loads(payload)
        return Event(time_s, content.pop("event"), content), end
    return Chunk(time_s, names.get(line, f"line {line}"), kind == _RECEIVED, payload), end


def free_space_bytes(folder: Path) -> int:
    """Room on the disk that holds `folder`, for the interlock that stops a run before the disk is full."""
    return shutil.disk_usage(folder).free
