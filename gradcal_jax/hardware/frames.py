"""`gradcal-frames/1`: the description of a unit that sends its samples as binary frames of one length, without code.

    format   = "gradcal-frames/1"
    title    = "STIM300"
    rate     = "125 Hz"
    sync     = "A5"                       # the bytes with which every frame begins
    length   = 42                         # bytes of a frame
    check    = { kind = "crc", at = 38, width = 32, poly = "04C11DB7", init = "FFFFFFFF", zeros = 2 }
    counter  = { at = 35, type = "u8", rate = "2000 Hz" }
    gyro         = { at = 1, type = "i24", counts = 16384, unit = "deg/s" }     # x, y, z follow each other
    acceleration = { at = 11, type = "i24", counts = 524.288, unit = "mg" }

The unit is configured beforehand with its maker's tool; a run checks that what it sends is as described. Offsets are
counted from the first byte of the frame.
"""

from collections.abc import Iterator
from typing import Annotated, Any, Final, Literal

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from pydantic import Field

from gradcal_jax.hardware.checksums import CrcOfRows
from gradcal_jax.hardware.description import (
    AccelerationUnit,
    DescribedSensor,
    Modulus,
    RateUnit,
    TemperatureUnit,
    missing,
)
from gradcal_jax.hardware.roles import Flags, Floats, ImuBatch, Integers, join
from gradcal_jax.hardware.sample_times import QUANTITIES, SECONDS, SampleDecoder, converted
from gradcal_jax.tables.problems import Problem
from gradcal_jax.tables.quantity import Frequency
from gradcal_jax.tables.section import Section

FRAMES: Final = "gradcal-frames/1"
Rows = NDArray[np.uint8]
"""Bytes, a row for each frame, or those of a stream."""
Type = Literal["u8", "i8", "u16", "i16", "i24", "u24", "i32", "u32", "u64", "f32", "f64"]
Order = Literal["big", "little"]
At = Annotated[int, Field(strict=True, ge=0, le=999)]
Hex = Annotated[str, Field(strict=True, pattern=r"^([0-9A-Fa-f]{2}){1,16}$")]
_BLOCK: Final = 1 << 14  # frames that are checked together


class Check(Section):
    """`[check]`: the checksum of a frame. "crc": a CRC by its parameters; "fletcher": two bytes, the sum of bytes and
    the sum of these sums."""

    kind: Literal["crc", "fletcher"] = "crc"
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


class Number(Section):
    """Numbers of a frame that follow each other."""

    at: At
    """Offset of the first one in the frame."""
    type: Type
    """Type of the numbers."""

    @property
    def numbers(self) -> int:
        """How many there are."""
        return 1

    @property
    def end(self) -> int:
        """Offset behind them."""
        return self.at + self.numbers * (int(self.type[1:]) // 8)

    def of(self, rows: Rows, order: Order) -> NDArray[np.generic]:
        """`(n, length)` bytes -> `(n, numbers)`."""
        end, kind, size = ">" if order == "big" else "<", self.type[0], int(self.type[1:]) // 8
        block = np.ascontiguousarray(rows[:, self.at : self.end])
        if size != 3:
            return block.view(f"{end}{kind}{size}")
        wide = np.zeros((len(rows), self.numbers, 4), np.uint8)
        first = 0 if order == "big" else 1
        wide[..., first : first + 3] = block.reshape(-1, self.numbers, 3)
        return wide.view(f"{end}{kind}4")[..., 0] >> 8


class Stamp(Number):
    """`[counter]` or `[time]`: the number or the time of a sample."""

    modulus: Modulus | None = None
    """Value at which it restarts at 0; absent: by its type."""
    rate: Frequency | None = None
    """Steps of a counter per second; absent: one for each sample."""
    unit: Literal["s", "ms", "us", "ns"] = "s"
    """Unit of a time."""

    @property
    def restarts_at(self) -> int | None:
        return self.modulus or (None if self.type[0] == "f" else 2 ** int(self.type[1:]))


class FrameColumn(Number):
    """`[gyro]`, `[acceleration]`, `[temperature]`."""

    counts: Annotated[float, Field(gt=0.0)] = 1.0
    """Counts of one unit: a value is the number divided by it."""
    values: Literal[1, 3] = 3
    """Numbers: of three axes, or one for all of them."""

    @property
    def numbers(self) -> int:
        return self.values


class FrameRates(FrameColumn):
    unit: RateUnit
    """Unit of the rates."""


class FrameAccelerations(FrameColumn):
    unit: AccelerationUnit
    """Unit of the accelerations."""


class FrameTemperatures(FrameColumn):
    unit: TemperatureUnit
    """Unit of the temperatures."""


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
    gyro: FrameRates | None = None
    """Rates."""
    acceleration: FrameAccelerations | None = None
    """Accelerations."""
    temperature: FrameTemperatures | None = None
    """Temperatures of the gyros."""
    status: Status | None = None
    """Status of the sample."""

    def decoder(self) -> "FrameDecoder":
        return FrameDecoder(self)

    @property
    def expected(self) -> dict[str, str]:
        """What a unit must send, for messages and the journal."""
        return {"sync": self.sync, "length": str(self.length)}

    @property
    def columns(self) -> dict[str, Any]:
        """Its columns by the names of their quantities."""
        columns = {name: getattr(self, name) for name in QUANTITIES}
        return {name: column for name, column in columns.items() if column is not None}

    def _problems(self) -> Iterator[Problem]:
        check = self.check
        numbers = {"counter": self.counter, "time": self.time, **self.columns}
        ends = {name: number.end for name, number in numbers.items() if number is not None}
        ends["check"] = check.at + (2 if check.kind == "fletcher" else check.width // 8)
        ends["status"] = 1 + max(self.status.at, default=0) if self.status is not None else 0
        for name, end in ends.items():
            if end > self.length:
                yield Problem((name, "at"), f"ends at byte {end}, and a frame has {self.length}")
        if check.start >= check.at:
            yield Problem(("check", "start"), "must be below the offset of the checksum", check.start)
        if self.gyro is None and self.acceleration is None:
            yield missing(("gyro",), "; expected a table gyro or acceleration")
        if self.counter is not None and self.time is not None:
            yield Problem(("time",), "expected a counter or a time, not both")
        if self.counter is not None and self.counter.rate is not None:
            step = float(self.counter.rate) / float(self.rate)
            if abs(step - round(step)) > 1e-9 or round(step) < 1:
                yield Problem(("counter", "rate"), "must be a multiple of the rate of samples", self.counter.rate.text)
        if self.baudrate < (needed := 10 * self.length * float(self.rate)):
            message = f"{self.rate} frames of {self.length} bytes need {needed:.0f} bits/s: raise it, also in the unit"
            yield Problem(("baudrate",), message, self.baudrate)


class FrameDecoder(SampleDecoder):
    """Bytes -> samples. A frame counts where it begins with the sync bytes and its checksum is right; other bytes are
    noise."""

    def __init__(self, unit: FramedSensor) -> None:
        check, stamp = unit.check, unit.counter or unit.time
        self._unit, self._stamp = unit, stamp
        self._sync = np.frombuffer(bytes.fromhex(unit.sync), np.uint8)
        poly, init, xorout = (int(text, 16) for text in (check.poly, check.init, check.xorout))
        self._crc = CrcOfRows(check.width, poly, init, xorout, reflect=check.reflect, zeros=check.zeros)
        self._sent = Number.model_validate({"at": check.at, "type": f"u{check.width}"})
        self._buffer = b""
        self._arrived = np.empty(0)
        # A stream may begin with a unit that starts.
        self._starting = True
        rate_hz, restarts_at = float(unit.rate), stamp and stamp.restarts_at
        if unit.time is not None:
            super().__init__("time", rate_hz, SECONDS[unit.time.unit], restarts_at)
        else:
            tick_s = 1.0 / float((stamp and stamp.rate) or rate_hz)
            super().__init__("count" if stamp else "", rate_hz, tick_s, restarts_at)

    def push(self, data: bytes, host_time_s: float | Floats) -> ImuBatch:
        """The samples; `host_time_s`: when the bytes were in hand, one time or that of each byte."""
        self._arrived = np.concatenate([self._arrived, np.broadcast_to(host_time_s, len(data))])
        self._buffer += data
        length = self._unit.length
        if len(self._buffer) < length:
            return join([])
        whole = np.frombuffer(self._buffer, np.uint8)
        starts, done = self._search(whole)
        ends = np.concatenate(([0], starts + length))
        noise = np.concatenate((starts, [done])) - ends
        # Whether noise comes before each sample, and behind the last.
        disturbed = noise > 0
        disturbed[0] |= self._disturbed
        self._disturbed = bool(disturbed[-1])
        self.bad_bytes += int(noise.sum())
        arrived_s = self._arrived[ends[1:] - 1]
        self._buffer, self._arrived = self._buffer[done:], self._arrived[done:]
        if not len(starts):
            return join([])
        return self._decode(sliding_window_view(whole, length)[starts], arrived_s, disturbed[:-1])

    def _search(self, data: Rows) -> tuple[Integers, int]:
        """Where the sound frames begin, and where the bytes begin that more bytes may make a frame."""
        length, sync = self._unit.length, self._sync
        # Nearly always the bytes are sound frames without noise.
        done = len(data) // length * length
        if self._sound(data[:done].reshape(-1, length)).all():
            return np.arange(0, done, length), done
        windows = sliding_window_view(data, length)
        begins = np.flatnonzero((windows[:, : len(sync)] == sync).all(axis=1))
        starts: list[int] = []
        end = 0
        for block in range(0, len(begins), _BLOCK):
            some = begins[block : block + _BLOCK]
            for start in some[self._sound(windows[some])].tolist():
                if start >= end:
                    starts.append(start)
                    end = start + length
        rest = range(max(end, len(data) - length + 1), len(data))
        waiting = (at for at in rest if bytes(sync).startswith(bytes(data[at : at + len(sync)])))
        return np.array(starts, np.int64), next(waiting, len(data))

    def _sound(self, rows: Rows) -> Flags:
        """`(n, length) -> (n,)`: whether the sync bytes and the checksum of a frame are right."""
        check = self._unit.check
        covered = rows[:, check.start : check.at]
        if check.kind == "fletcher":
            sums = np.cumsum(covered, axis=1, dtype=np.uint8)
            right = (rows[:, check.at] == sums[:, -1]) & (rows[:, check.at + 1] == sums.sum(axis=1, dtype=np.uint8))
        else:
            right = self._crc(covered) == self._sent.of(rows, check.order)[:, 0]
        return right & (rows[:, : len(self._sync)] == self._sync).all(axis=1)

    def _decode(self, rows: Rows, host_time_s: Floats, disturbed: Flags) -> ImuBatch:
        unit, count = self._unit, len(rows)
        stamps = np.zeros(count)
        if self._stamp is not None:
            stamps = self._stamp.of(rows, unit.order)[:, 0].astype(np.float64)
        values: dict[str, Floats] = {}
        for name, column in unit.columns.items():
            numbers = column.of(rows, unit.order).astype(np.float64) / column.counts
            values[name] = np.repeat(converted(name, numbers, column.unit), 3 // column.values, axis=1)
        status, restarted = np.zeros(count, np.int64), np.zeros(count, np.bool_)
        if (said := unit.status) is not None:
            for number, at in enumerate(said.at):
                status |= rows[:, at].astype(np.int64) << 8 * number
            if said.starting is not None:
                starting = (status >> said.starting & 1).astype(np.bool_)
                restarted = starting & ~np.concatenate(([self._starting], starting[:-1]))
                self._starting = bool(starting[-1])
        unusable = ~np.isfinite(np.hstack(list(values.values()))).all(axis=1)
        status[unusable & (status == 0)] = 1
        return self._batch(host_time_s, stamps, values, disturbed, status, restarted)
