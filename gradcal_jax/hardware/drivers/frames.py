"""Driver of IMUs that send binary frames, as a rig file describes them (`hardware.frames`). Nothing is sent to them.

Unverified on real hardware: everything; each description says what its sources leave open.
"""

from collections import deque
from collections.abc import Iterable
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from gradcal_jax.hardware.drivers.listening import SECONDS, ListeningConfig, ListeningImu, SampleTimes, conversion
from gradcal_jax.hardware.frames import FrameColumn, FramedSensor, RowCheck, bytes_of, numbers_of
from gradcal_jax.hardware.line_protocol import described
from gradcal_jax.hardware.roles import ImuBatch, imu_batch, join
from gradcal_jax.tables.problems import Problem

__all__ = ["FrameDecoder", "FramesConfig", "ListeningImu"]

_BLOCK = 1 << 14  # frames that are checked together
_REMEMBERED = 15
_UNITS = {"gyro": ("deg/s", 1.0), "acceleration": ("mg", 1e-3)}


class FramesConfig(ListeningConfig):
    driver = "frames"

    def _misfits(self, described: FramedSensor) -> Iterable[Problem]:
        baudrate, needed = self.line_settings["baudrate"], 10 * described.length * float(described.rate)
        if baudrate < needed:
            message = (
                f"{float(described.rate):g} frames/s of {described.length} bytes need {needed:.0f} bits/s, and the "
                f"line has {baudrate}: raise baudrate (also in the unit) or lower its rate."
            )
            yield Problem((), message)

    @cached_property
    def described(self) -> FramedSensor:
        return described(FramedSensor, self.protocol, self.changes)

    def decoder(self) -> "FrameDecoder":
        return FrameDecoder(self.described)

    @property
    def expected(self) -> str:
        unit = self.described
        return f"frames of {unit.length} bytes that begin with {unit.sync} and have a right checksum"

    @property
    def registers(self) -> dict[str, str]:
        return {"sync": self.described.sync, "length": str(self.described.length)}


class FrameDecoder:
    """Bytes -> samples. A frame counts where it begins with the sync bytes and its checksum is right; other bytes are
    noise. A frame that comes twice counts once, if it has a counter or a time."""

    def __init__(self, unit: FramedSensor) -> None:
        self._unit, self._check = unit, RowCheck(unit.check)
        self._sync = np.frombuffer(bytes.fromhex(unit.sync), np.uint8)
        self._buffer = np.empty(0, np.uint8)
        self._disturbed = self._starting = False
        self._first = True
        rate = float(unit.rate)
        stamp = unit.counter or unit.time
        kind = "" if stamp is None else "time" if unit.counter is None else "count"
        tick_s, modulus = 1.0 / rate, None
        if stamp is not None:
            modulus = stamp.modulus or (None if stamp.type[0] == "f" else 2 ** (8 * bytes_of(stamp.type)))
            tick_s = SECONDS[stamp.unit] if kind == "time" else 1.0 / float(stamp.rate or unit.rate)
        self._stamp = stamp
        self._times = SampleTimes(kind, rate, tick_s, modulus)
        self.sample_s, self.resolution_s = 1.0 / rate, self._times.resolution_s
        self.round_samples = self._times.round_samples
        # Within a round of the counter no two frames are alike, so a repeated one was sent once and came twice.
        self._recent: deque[bytes] = deque(maxlen=max(1, self.round_samples - 1) if kind == "count" else _REMEMBERED)
        self.bad_bytes = self.repeated_datagrams = 0

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

    def _noise(self, count: int) -> None:
        self.bad_bytes += count
        self._disturbed = self._disturbed or count > 0

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
            stamps = numbers_of(rows, self._stamp.at, self._stamp.type, unit.order)[:, 0]
        times, gaps, restarted = self._times.push(stamps)
        values = {name: self._values(name, column, rows) for name, column in unit.columns.items()}
        absent = np.full((count, 3), np.nan)
        status = np.zeros(count, np.int64)
        if unit.status is not None:
            for number, at in enumerate(unit.status.at):
                status |= rows[:, at].astype(np.int64) << 8 * number
            if unit.status.starting is not None:
                starting = (rows[:, unit.status.at[0]] >> unit.status.starting & 1).astype(np.bool_)
                before = np.concatenate(([self._starting or self._first], starting[:-1]))
                restarted = restarted | (starting & ~before)
                self._starting, self._first = bool(starting[-1]), False
        unusable = ~np.isfinite(np.hstack(list(values.values()))).all(axis=1)
        status[unusable & (status == 0)] = 1
        disturbed = np.zeros(count, np.bool_)
        disturbed[0], self._disturbed = self._disturbed and bool(self.round_samples), False
        return imu_batch(
            host_time_s,
            times,
            values.get("gyro", absent),
            values.get("acceleration", absent),
            values.get("temperature", absent),
            second_c=values.get("second_temperature", absent).mean(axis=1),
            status=status,
            gap_before=gaps,
            disturbed=disturbed,
            restarted=restarted,
        )

    def _values(self, name: str, column: FrameColumn, rows: NDArray[np.uint8]) -> NDArray[np.float64]:
        """`(n, 3)` values of a column, in deg/s, g0 or degC."""
        unit, factor = _UNITS.get(name, ("degC", 1.0))
        scale, zero = conversion(column.unit, unit, factor)
        numbers = numbers_of(rows, column.at, column.type, self._unit.order, column.values).astype(np.float64)
        values = numbers / column.counts * column.factor * scale + zero
        return np.repeat(values, 3 // column.values, axis=1)
