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

from collections.abc import Iterator
from typing import Annotated, Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from gradcal_jax.hardware.checksums import CrcOfRows
from gradcal_jax.hardware.line_protocol import DescribedSensor, unit_problems
from gradcal_jax.tables.problems import Problem
from gradcal_jax.tables.quantity import Frequency, Number, Text
from gradcal_jax.tables.section import Section

FORMAT: Final = "gradcal-frames/1"
Type = Literal["u8", "i8", "u16", "i16", "i24", "u24", "i32", "u32", "u64", "f32", "f64"]
Order = Literal["big", "little"]
At = Annotated[int, Field(strict=True, ge=0, le=999)]
Hex = Annotated[str, Field(strict=True, pattern=r"^([0-9A-Fa-f]{2}){1,16}$")]
Modulus = Annotated[int, Field(strict=True, ge=2, le=2**64)]
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
