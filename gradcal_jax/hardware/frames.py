"""`gradcal-frames/1`: the description of a unit that sends its samples as binary frames of one length, without code.

    format   = "gradcal-frames/1"
    title    = "STIM300"
    rate     = "125 Hz"
    sync     = "A5"                       # the bytes with which every frame begins
    length   = 42                         # bytes of a frame
    check    = { kind = "crc", at = 38, width = 32, poly = "04C11DB7", init = "FFFFFFFF", zeros = 2 }
    counter  = { at = 35, type = "u8", rate = "2000 Hz" }
    gyro         = { at = 1, type = "i24", counts = 16384, unit = "deg/s" }     # x, y, z follow each other
    acceleration = { at = 11, type = "i24", counts = 524288, unit = "mg", factor = 1000 }

The unit is configured beforehand with its maker's tool; a run checks that what it sends is as described. Offsets are
counted from the first byte of the frame.
"""

from collections import deque
from collections.abc import Iterator
from typing import Annotated, Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from gradcal_jax.hardware.checksums import CrcOfRows
from gradcal_jax.hardware.line_protocol import DescribedSensor, unit_problems
from gradcal_jax.hardware.roles import ImuBatch, join
from gradcal_jax.hardware.sample_times import SECONDS, SampleDecoder, conversion
from gradcal_jax.tables.problems import Problem
from gradcal_jax.tables.quantity import Frequency, Number, Text
from gradcal_jax.tables.section import Section

FORMAT: Final = "gradcal-frames/1"
Type = Literal["u8", "i8", "u16", "i16", "i24", "u24", "i32", "u32", "u64", "f32", "f64"]
Order = Literal["big", "little"]
At = Annotated[int, Field(strict=True, ge=0, le=999)]
Hex = Annotated[str, Field(strict=True, pattern=r"^([0-9A-Fa-f]{2}){1,16}$")]
Modulus = Annotated[int, Field(strict=True, ge=2, le=2**64)]
_BLOCK: Final = 1 << 14  # frames that are checked together
_REMEMBERED: Final = 15
_UNITS: Final = {"gyro": ("deg/s", 1.0), "acceleration": ("mg", 1e-3)}
QUANTITIES: Final = ("gyro", "acceleration", "temperature", "second_temperature")


def bytes_of(kind: Type) -> int:
    """Length of a number, bytes."""
    return int(kind[1:]) // 8


class Check(Section):
    """`[check]`: the checksum of a frame. "crc": a CRC by its parameters; "sum": the sum of bytes; "fletcher": two
    bytes, the sum of bytes and the sum of these sums."""

    kind: Literal["crc", "sum", "fletcher"] = "crc"
    """Kind of checksum."""
    at: At
    """Offset of the checksum, which covers the bytes before it."""
    start: At = 0
    """Offset of the first byte that the checksum covers."""
    width: Literal[8, 16, 32] = 16
    """Bits of the checksum."""
    poly: Hex = "1021"
    """Polynomial of the CRC, without its highest power, not reflected."""
    init: Hex = "0000"
    """Value of the CRC before the first byte."""
    reflect: bool = False
    """Whether bytes and result are reflected."""
    xorout: Hex = "0000"
    """Value by which the result is changed (exclusive or)."""
    zeros: Annotated[int, Field(strict=True, ge=0, le=8)] = 0
    """Zero bytes that the CRC covers behind the frame, and that are not sent."""
    order: Order = "big"
    """Order of the checksum's bytes."""


class Stamp(Section):
    """`[counter]` or `[time]`: the number or the time of a sample."""

    at: At
    """Offset in the frame."""
    type: Type
    """Type of the number."""
    modulus: Modulus | None = None
    """Value at which it restarts at 0; absent: by its type."""
    rate: Frequency | None = None
    """Steps of a counter per second; absent: one for each sample."""
    unit: Literal["s", "ms", "us", "ns"] = "s"
    """Unit of a time."""


class FrameColumn(Section):
    """`[gyro]`, `[acceleration]`, `[temperature]`, `[second_temperature]`: numbers that follow each other."""

    at: At
    """Offset of the first number."""
    type: Type
    """Type of the numbers."""
    counts: Number = 1.0
    """Counts of one unit: a value is the number divided by it."""
    factor: Number = 1.0
    """Value in `unit` of one of the frame's own units."""
    unit: Text
    """Unit of the values."""
    values: Literal[1, 3] = 3
    """Numbers: of three axes, or one for all of them."""


class Status(Section):
    """`[status]`: bits of a sample; 0 means that it is good."""

    at: tuple[At, ...]
    """Offsets of its bytes."""
    starting: Annotated[int, Field(strict=True, ge=0, le=7)] | None = None
    """Bit of the first byte that is set while the unit starts; in a stream it shows a restart."""


class FramedSensor(DescribedSensor):
    """A complete description of a sensor that sends frames."""

    format: Literal["gradcal-frames/1"]
    """Name and version of this file format."""
    sync: Hex
    """Bytes with which every frame begins, as hexadecimal digits."""
    length: Annotated[int, Field(strict=True, ge=4, le=1000)]
    """Bytes of a frame."""
    order: Order = "big"
    """Order of the bytes of its numbers."""
    check: Check
    """The checksum."""
    counter: Stamp | None = None
    """Number of the sample."""
    time: Stamp | None = None
    """Time of the sample."""
    gyro: FrameColumn | None = None
    """Rates."""
    acceleration: FrameColumn | None = None
    """Accelerations."""
    temperature: FrameColumn | None = None
    """Temperatures of the gyros."""
    second_temperature: FrameColumn | None = None
    """A second thermometer, or the temperatures of the accelerometers."""
    status: Status | None = None
    """Status of the sample."""

    @property
    def columns(self) -> dict[str, FrameColumn]:
        """Its columns by the names of their quantities."""
        columns = {name: getattr(self, name) for name in QUANTITIES}
        return {name: column for name, column in columns.items() if column is not None}

    def _problems(self) -> Iterator[Problem]:
        check, ends = self.check, dict[tuple[str, ...], int]()
        ends["check", "at"] = check.at + (2 if check.kind == "fletcher" else check.width // 8)
        stamps = {"counter": self.counter, "time": self.time}
        for name, stamp in stamps.items():
            if stamp is not None:
                ends[name, "at"] = stamp.at + bytes_of(stamp.type)
        for name, column in self.columns.items():
            ends[name, "at"] = column.at + column.values * bytes_of(column.type)
        if self.status is not None:
            ends["status", "at"] = 1 + max(self.status.at, default=0)
        for key, end in ends.items():
            if end > self.length:
                yield Problem(key, f"ends at byte {end}, and a frame has {self.length}")
        if check.start >= check.at:
            yield Problem(("check", "start"), "must be below the offset of the checksum", check.start)
        if self.gyro is None and self.acceleration is None:
            yield Problem(("gyro",), "expected a table gyro or acceleration", kind="missing")
        if self.counter is not None and self.time is not None:
            yield Problem(("time",), "expected a counter or a time, not both")
        if self.counter is not None and self.counter.rate is not None:
            step = float(self.counter.rate) / float(self.rate)
            if abs(step - round(step)) > 1e-9 or round(step) < 1:
                yield Problem(("counter", "rate"), "must be a multiple of the rate of samples", self.counter.rate.text)
        kinds = {"gyro": "angular rate", "acceleration": "acceleration"}
        for name, column in self.columns.items():
            for problem in unit_problems(column, {"unit": kinds.get(name, "temperature")}):
                yield Problem((name, *problem.key), problem.message, problem.value)
            if column.counts == 0.0:
                yield Problem((name, "counts"), "must not be 0", column.counts)


class RowCheck:
    """The checksum of frames, by a description."""

    def __init__(self, check: Check) -> None:
        self._check = check
        self._crc: CrcOfRows | None = None
        if check.kind == "crc":
            poly, init, xorout = (int(text, 16) for text in (check.poly, check.init, check.xorout))
            self._crc = CrcOfRows(check.width, poly, init, xorout, reflect=check.reflect, zeros=check.zeros)

    def sound(self, rows: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """`(n, length) -> (n,)`: whether the checksum of a frame is right."""
        check = self._check
        covered = rows[:, check.start : check.at]
        if check.kind == "fletcher":
            first = np.cumsum(covered, axis=1, dtype=np.uint8)
            second = first.sum(axis=1, dtype=np.uint8)
            return (rows[:, check.at] == first[:, -1]) & (rows[:, check.at + 1] == second)
        sent = numbers_of(rows, check.at, f"u{check.width}", check.order)[:, 0].astype(np.uint64)
        if self._crc is not None:
            return self._crc(covered) == sent
        return covered.sum(axis=1, dtype=np.uint64) % np.uint64(2**check.width) == sent


def numbers_of(rows: NDArray[np.uint8], at: int, kind: str, order: Order, count: int = 1) -> NDArray[np.generic]:
    """`(n, length)` bytes -> `(n, count)` numbers that follow each other from the offset `at`."""
    size = int(kind[1:]) // 8
    block = np.ascontiguousarray(rows[:, at : at + count * size])
    if size == 3:
        parts = block.reshape(-1, count, 3).astype(np.int32)
        if order == "little":
            parts = parts[..., ::-1]
        value = parts[..., 0] << 16 | parts[..., 1] << 8 | parts[..., 2]
        negative = (value >= 1 << 23) & (kind == "i24")
        return np.where(negative, value - (1 << 24), value)
    return block.view(f"{'>' if order == 'big' else '<'}{kind[0]}{size}")


class FrameDecoder(SampleDecoder):
    """Bytes -> samples. A frame counts where it begins with the sync bytes and its checksum is right; other bytes are
    noise. A frame that comes twice counts once, if it has a counter or a time."""

    def __init__(self, unit: FramedSensor) -> None:
        self._unit, self._check = unit, RowCheck(unit.check)
        self._sync = np.frombuffer(bytes.fromhex(unit.sync), np.uint8)
        self._buffer = np.empty(0, np.uint8)
        self._starting = True
        rate = float(unit.rate)
        stamp = unit.counter or unit.time
        kind = "" if stamp is None else "time" if unit.counter is None else "count"
        tick_s, modulus = 1.0 / rate, None
        if stamp is not None:
            modulus = stamp.modulus or (None if stamp.type[0] == "f" else 2 ** (8 * bytes_of(stamp.type)))
            tick_s = SECONDS[stamp.unit] if kind == "time" else 1.0 / float(stamp.rate or unit.rate)
        super().__init__(kind, rate, tick_s, modulus)
        self._stamp = stamp
        # Within a round of the counter no two frames are alike, so a repeated one was sent once and came twice.
        self._recent: deque[bytes] = deque(maxlen=max(1, self.round_samples - 1) if kind == "count" else _REMEMBERED)

    def push(self, data: bytes, host_time_s: float) -> ImuBatch:
        self._buffer = np.concatenate([self._buffer, np.frombuffer(data, np.uint8)])
        starts, done = self._frames()
        batches: list[ImuBatch] = []
        # Frames that follow each other without noise are decoded together.
        place, number = 0, 0
        while number < len(starts):
            run = number + 1
            while run < len(starts) and starts[run] == starts[run - 1] + self._unit.length:
                run += 1
            self._noise(starts[number] - place)
            place = starts[run - 1] + self._unit.length
            rows = self._buffer[starts[number] : place].reshape(-1, self._unit.length)
            batches.append(self._decode(rows, host_time_s))
            number = run
        self._noise(done - place)
        self._buffer = self._buffer[done:]
        return join(batches)

    def _frames(self) -> tuple[list[int], int]:
        """Where the sound frames of the buffer begin, and where the bytes begin that more bytes may make a frame."""
        data, sync, length = self._buffer, self._sync, self._unit.length
        padded = np.concatenate([data, np.zeros(len(sync), np.uint8)])
        places = np.arange(len(data))
        begins = np.ones(len(data), np.bool_)
        for offset, byte in enumerate(sync):
            begins &= (padded[offset : offset + len(data)] == byte) | (places + offset >= len(data))
        candidates = np.flatnonzero(begins)
        whole = candidates[candidates + length <= len(data)]
        starts: list[int] = []
        end = 0
        for block in range(0, len(whole), _BLOCK):
            some = whole[block : block + _BLOCK]
            good = some[self._check.sound(data[some[:, None] + np.arange(length)])]
            for start in good.tolist():
                if start >= end:
                    starts.append(start)
                    end = start + length
        waiting = candidates[(candidates + length > len(data)) & (candidates >= end)]
        return starts, int(waiting[0]) if len(waiting) else len(data)

    def _new_frames(self, rows: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Remove repeated frames: those that came before, but not a unit's constant output."""
        if self._stamp is None:
            return rows
        stamp = slice(self._stamp.at, self._stamp.at + bytes_of(self._stamp.type))
        check = self._unit.check.at
        fresh: list[int] = []
        for number, row in enumerate(rows):
            frame = row.tobytes()
            if frame in self._recent:
                before = self._recent[-1]
                constant = frame[: stamp.start] + frame[stamp.stop : check]
                if frame == before or constant != before[: stamp.start] + before[stamp.stop : check]:
                    continue
            self._recent.append(frame)
            fresh.append(number)
        self.repeated_datagrams += len(rows) - len(fresh)
        return rows[fresh]

    def _decode(self, rows: NDArray[np.uint8], host_time_s: float) -> ImuBatch:
        unit, rows = self._unit, self._new_frames(rows)
        count = len(rows)
        if not count:
            return join([])
        stamps = np.zeros(count)
        if self._stamp is not None:
            stamps = numbers_of(rows, self._stamp.at, self._stamp.type, unit.order)[:, 0].astype(np.float64)
        values = {name: self._values(name, column, rows) for name, column in unit.columns.items()}
        status, restarted = np.zeros(count, np.int64), np.zeros(count, np.bool_)
        if unit.status is not None:
            for number, at in enumerate(unit.status.at):
                status |= rows[:, at].astype(np.int64) << 8 * number
            if unit.status.starting is not None:
                starting = (rows[:, unit.status.at[0]] >> unit.status.starting & 1).astype(np.bool_)
                # A stream may begin with a unit that starts.
                restarted = starting & ~np.concatenate(([self._starting], starting[:-1]))
                self._starting = bool(starting[-1])
        unusable = ~np.isfinite(np.hstack(list(values.values()))).all(axis=1)
        status[unusable & (status == 0)] = 1
        disturbed = np.zeros(count, np.bool_)
        disturbed[0], self._disturbed = self._disturbed, False
        return self._batch(host_time_s, stamps, values, disturbed, status=status, restarted=restarted)

    def _values(self, name: str, column: FrameColumn, rows: NDArray[np.uint8]) -> NDArray[np.float64]:
        """`(n, 3)` values of a column, in deg/s, g0 or degC."""
        unit, factor = _UNITS.get(name, ("degC", 1.0))
        scale, zero = conversion(column.unit, unit, factor)
        numbers = numbers_of(rows, column.at, column.type, self._unit.order, column.values).astype(np.float64)
        values = numbers / column.counts * column.factor * scale + zero
        return np.repeat(values, 3 // column.values, axis=1)
