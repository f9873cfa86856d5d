"""Sensonor / Safran STIM300 inertial units: binary datagrams, and Utility Mode for everything else.

Source: the data sheet TS1524 rev. 31; the frames of a real unit agree. Nothing is saved to the flash memory. Bias trim
and g-compensation alter the outputs: they are read and recorded.

A datagram has no sync word: it begins with an identifier that implies its length and ends in a CRC-32 that includes
zero bytes which are never sent, up to a multiple of four. The decoder locks only where a CRC is right, stays locked
while CRCs are right, and advances by one byte after a failure.

The counter counts internal samples (2000 /s) modulo 256: at 125 samples/s it wraps every 16 samples. The host's clock
gives the number of whole wraps that are lost in a disturbed stretch.

Unverified on real hardware: that a unit already in Utility Mode answers the request with status 1; the codes of the
output units (`rate_unit_code`, `increment_unit_code`); non-standard baud rates on USB adapters.
"""

import re
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from gradcal_jax.hardware.checksums import crc8_stim300, crc32_mpeg2, crc32_mpeg2_of_rows
from gradcal_jax.hardware.clock import Clock
from gradcal_jax.hardware.drivers.base import ImuDriver, codes_of
from gradcal_jax.hardware.errors import ChecksumError, FramingError, NotVerified, Rejected, ReplyTimeout, printable
from gradcal_jax.hardware.framing import LineFramer, NotThisReply
from gradcal_jax.hardware.request_reply import Exchange
from gradcal_jax.hardware.roles import STANDARD_GRAVITY, Identity, ImuBatch, ImuSettings, KeptSettings, imu_batch, join
from gradcal_jax.hardware.transport import Transport

INTERNAL_RATE_HZ = 2000
_MODULUS = 256  # of the counter of internal samples
# By the codes of `$sd`: (accelerometer, inclinometer, temperatures), identifier, identifier with PPS, of older units.
CONTENTS = tuple(
    ((bool(k & 1), bool(k & 2), k > 3), (0x90 if k < 5 else 0xA0) + k, 0xF0 + k, (0x98 if k < 5 else 0xA8) + k)
    for k in range(8)
)
_ARRIVALS = 256  # remembered, for the quickest of them
START_UP = 0x40  # status bit of a cluster that is not valid yet
_ACCELERATION_BITS = {2: 21, 5: 20, 10: 19, 30: 18, 80: 16}
_INCREMENT_BITS = {5: 23, 10: 22, 30: 21, 80: 19}


class DatagramLayout(NamedTuple):
    """Offsets of one kind of datagram; -1 where a part is absent. `length` is without a line end."""

    length: int
    acceleration: int
    temperature: int
    counter: int
    unsent_zeros: int


def _layout(acceleration: bool, inclination: bool, temperature: bool, auxiliary: bool) -> DatagramLayout:
    end = 11
    at_acceleration = end if acceleration else -1
    end += 10 * acceleration + 10 * inclination
    at_temperature = end if temperature else -1
    end += 7 * temperature * (1 + acceleration + inclination) + 4 * auxiliary
    return DatagramLayout(end + 7, at_acceleration, at_temperature, end, -(end + 3) % 4)


LAYOUTS: dict[int, DatagramLayout] = {}
for _contents, _plain, _pulse, _older in CONTENTS:
    LAYOUTS[_plain] = _layout(*_contents, auxiliary=False)
    LAYOUTS[_pulse] = LAYOUTS[_older] = _layout(*_contents, auxiliary=True)


def _temperatures(block: NDArray[np.uint8]) -> NDArray[np.float64]:
    return np.ascontiguousarray(block).view(">i2").astype(np.float64) / 256.0


def _int24(columns: NDArray[np.uint8]) -> NDArray[np.int32]:
    """(n, 9) big-endian bytes -> (n, 3) signed integers."""
    wide = columns.astype(np.int32).reshape(-1, 3, 3)
    value = wide[..., 0] << 16 | wide[..., 1] << 8 | wide[..., 2]
    return np.where(value >= 1 << 23, value - (1 << 24), value).astype(np.int32)


class GapCounter:
    """Unwraps a sample counter and says how many samples are missing before each one.

    A counter that wraps after `modulus` samples cannot show the loss of a whole number of wraps by itself. After a
    disturbance of the stream the host's clock gives the number of wraps; without one, a late chunk is only late. The
    host's clock is compared with the quickest of the recent arrivals, because a busy computer stamps bytes late.

    This uses the past only, and is right where the chunk after a disturbance is later than the quickest of the
    `_ARRIVALS` before it by less than half a wrap. A log uses the later samples, too (`decoding.counter_wraps`).
    """

    def __init__(self, *, step: int, modulus: int, ticks_per_s: float) -> None:
        self._step, self._modulus, self._ticks_per_s = step, modulus, ticks_per_s
        self._count = 0
        self._last_raw: int | None = None
        self._offsets_s: deque[float] = deque(maxlen=_ARRIVALS)

    def push(
        self, raw: NDArray[np.int64], host_time_s: float, *, disturbed: bool
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Unwrapped counts and gaps of samples that came together; `disturbed`: bytes were lost before the first."""
        previous = raw[0] - self._step if self._last_raw is None else self._last_raw
        delta = np.mod(np.diff(raw, prepend=previous), self._modulus)
        delta[delta == 0] = self._modulus
        if disturbed and self._offsets_s:
            # The last sample has waited least: the counter's value when the host has it.
            now = (host_time_s - min(self._offsets_s)) * self._ticks_per_s
            lost = (now - float(self._count + delta.sum())) / self._modulus
            delta[0] += self._modulus * max(0, round(lost))
        counts = self._count + np.cumsum(delta)
        self._count, self._last_raw = int(counts[-1]), int(raw[-1])
        self._offsets_s.append(host_time_s - self._count / self._ticks_per_s)
        return counts, delta // self._step - 1


class Stim300Decoder:
    """Bytes of Normal Mode -> samples. `acceleration_range_g` comes from the unit itself (`$irng`).

    The first datagram shows whether the unit ends them in CR LF. A start-up bit within a stream means that the IMU
    restarted. Special datagrams, which come after power-on, count as `bad_bytes`. A datagram that comes twice, at once
    or later, counts once.
    """

    resolution_s = 1.0 / INTERNAL_RATE_HZ

    def __init__(
        self, *, sample_rate_hz: float = 125.0, acceleration_range_g: int = 10, increments: bool = False
    ) -> None:
        bits = (_INCREMENT_BITS if increments else _ACCELERATION_BITS).get(acceleration_range_g)
        if bits is None:
            raise ValueError(f"An accelerometer range of {acceleration_range_g} g is not in the data sheet.")
        rate = sample_rate_hz if increments else 1.0
        self._gyro_scale = rate / 2 ** (21 if increments else 14)
        self._acceleration_scale = rate / 2**bits / (STANDARD_GRAVITY if increments else 1.0)
        self._line_end: bool | None = None
        self._buffer: bytes = b""
        self._locked: int | None = None
        self._disturbed = False
        self._step = round(INTERNAL_RATE_HZ / sample_rate_hz)
        self.sample_s = self._step / INTERNAL_RATE_HZ
        self.round_samples = _MODULUS // self._step
        self._gaps = GapCounter(step=self._step, modulus=_MODULUS, ticks_per_s=float(INTERNAL_RATE_HZ))
        # Within a round of the counter no two datagrams are alike, so a repeated one was sent once and came twice.
        self._recent: dict[bytes, None] = {}
        self._before = b""
        self._starting_up = True
        self.bad_bytes = 0
        self.repeated_datagrams = 0

    def push(self, data: bytes, host_time_s: float) -> ImuBatch:
        self._buffer += data
        batches: list[ImuBatch] = []
        while self._buffer:
            if self._locked is None and not self._lock():
                break
            assert self._locked is not None
            layout = LAYOUTS[self._locked]
            stride = layout.length + 2 * bool(self._line_end)
            whole = len(self._buffer) // stride
            if self._line_end is None:
                if self._recent:
                    # The byte after the first datagram decides: no identifier is a CR.
                    if self._buffer == b"\r":
                        break
                    self._line_end = self._buffer.startswith(b"\r\n")
                    self._buffer = self._buffer.removeprefix(b"\r\n")
                    continue
                whole = min(whole, 1)
            good = self._sound_frames(whole, stride, layout)
            if good:
                block = np.frombuffer(self._buffer, np.uint8, good * stride).reshape(good, stride)
                batches.append(self._decode(block, layout, host_time_s))
                self._buffer = self._buffer[good * stride :]
                if self._line_end is None:
                    continue
            # The remaining bytes may already be known not to be a datagram of this kind.
            astray = good < whole or (bool(self._buffer) and self._buffer[0] != self._locked)
            if astray:
                self._locked = None
                self._drop(1)
            elif good == whole and len(self._buffer) < stride:
                break
        return join(batches)

    def _lock(self) -> bool:
        """Find the next sound datagram. False when more bytes are needed to decide."""
        for start, identifier in enumerate(self._buffer):
            layout = LAYOUTS.get(identifier)
            if layout is None:
                continue
            end = start + layout.length
            if end > len(self._buffer):
                self._drop(start)
                return False
            crc = crc32_mpeg2(self._buffer[start : end - 4] + bytes(layout.unsent_zeros))
            if crc == int.from_bytes(self._buffer[end - 4 : end], "big"):
                self._drop(start)
                self._locked = identifier
                return True
        self._drop(len(self._buffer))
        return False

    def _drop(self, count: int) -> None:
        self._buffer = self._buffer[count:]
        self.bad_bytes += count
        self._disturbed = self._disturbed or count > 0

    def _sound_frames(self, whole: int, stride: int, layout: DatagramLayout) -> int:
        """The number of datagrams at the buffer's beginning that are sound, at most `whole`."""
        rows = np.frombuffer(self._buffer, np.uint8, whole * stride).reshape(whole, stride)
        end, zeros = layout.length - 4, np.zeros((whole, layout.unsent_zeros), np.uint8)
        sent = np.ascontiguousarray(rows[:, end : layout.length]).view(">u4")[:, 0]
        sound = (rows[:, 0] == self._locked) & (crc32_mpeg2_of_rows(np.hstack([rows[:, :end], zeros])) == sent)
        if self._line_end:
            sound &= (rows[:, layout.length :] == np.frombuffer(b"\r\n", np.uint8)).all(axis=1)
        return whole if sound.all() else int(np.argmin(sound))

    def _first_comers(self, block: NDArray[np.uint8], layout: DatagramLayout) -> NDArray[np.uint8]:
        """Remove repeated datagrams. A late repetition may have the count that is due, and later ones may follow it, so
        that each is compared."""
        data, stride = block.tobytes(), block.shape[1]
        datagrams = [data[start : start + stride] for start in range(0, len(data), stride)]
        fresh: list[int] = []
        for row, datagram in enumerate(datagrams):
            if not self._came_before(datagram, layout):
                self._recent.pop(datagram, None)
                self._recent[datagram] = None
                if len(self._recent) >= self.round_samples:
                    del self._recent[next(iter(self._recent))]
                self._before = datagram
                fresh.append(row)
        self.repeated_datagrams += len(block) - len(fresh)
        return block[fresh]

    def _came_before(self, datagram: bytes, layout: DatagramLayout) -> bool:
        if datagram not in self._recent:
            return False
        # A unit with constant output does not repeat its datagrams.
        contents = slice(1, layout.counter)
        return datagram == self._before or datagram[contents] != self._before[contents]

    def _decode(self, block: NDArray[np.uint8], layout: DatagramLayout, host_time_s: float) -> ImuBatch:
        block = self._first_comers(block, layout)
        count = block.shape[0]
        if not count:
            return join([])
        raw = _int24(block[:, 1:10])
        status = block[:, 10].astype(np.int64)
        starting = (status & START_UP) != 0
        restarted = starting & ~np.concatenate(([self._starting_up], starting[:-1]))
        self._starting_up = bool(starting[-1])
        acceleration = np.full((count, 3), np.nan)
        if (at := layout.acceleration) >= 0:
            acceleration = _int24(block[:, at : at + 9]).astype(np.float64) * self._acceleration_scale
            status |= block[:, at + 9].astype(np.int64) << 8
        temperature, second = np.full((count, 3), np.nan), np.full(count, np.nan)
        if (at := layout.temperature) >= 0:
            temperature = _temperatures(block[:, at : at + 6])
            status |= block[:, at + 6].astype(np.int64) << 16
            if layout.acceleration >= 0:
                second = _temperatures(block[:, at + 7 : at + 13]).mean(axis=1)
        counts, gaps = self._gaps.push(
            block[:, layout.counter].astype(np.int64), host_time_s, disturbed=self._disturbed
        )
        disturbed = np.zeros(count, np.bool_)
        disturbed[0], self._disturbed = self._disturbed, False
        times, rates = counts.astype(np.float64) / float(INTERNAL_RATE_HZ), raw.astype(np.float64) * self._gyro_scale
        more = {"status": status, "gap_before": gaps, "disturbed": disturbed, "restarted": restarted}
        return imu_batch(host_time_s, times, rates, acceleration, temperature, second_c=second, **more)


_STATUS_TEXTS = codes_of("stim300")
SAMPLE_RATE_CODES = {125.0: 0, 250.0: 1, 500.0: 2, 1000.0: 3, 2000.0: 4}


@dataclass(frozen=True)
class Stim300Config:
    """Options of the rig file. `datagram` is the code of `$sd`: 5 is rate, acceleration and temperature."""

    baudrate: int = 921600
    stopbits: Literal[1, 2] = 1
    parity: Literal["N", "E", "O"] = "N"
    sample_rate_hz: float = 125.0
    datagram: Annotated[int, Field(ge=0, lt=len(CONTENTS))] = 5
    increments: bool = False
    rate_unit_code: int = 0
    increment_unit_code: int = 1
    reply_timeout_s: float = 1.0
    mode_timeout_s: float = 3.0

    def __post_init__(self) -> None:
        if self.sample_rate_hz not in SAMPLE_RATE_CODES:
            raise ValueError(f"sample_rate is {self.sample_rate_hz:g} Hz; expected 125, 250, 500, 1000 or 2000 Hz.")
        bits = 1 + 8 + (self.parity != "N") + self.stopbits
        needed = 1.1 * bits * LAYOUTS[CONTENTS[self.datagram][1]].length * self.sample_rate_hz
        if self.baudrate < needed:
            raise ValueError(
                f"{self.sample_rate_hz:g} datagrams/s need {needed:.0f} bits/s and the line has {self.baudrate}: "
                "the IMU would lose datagrams without notice. Raise baudrate, lower sample_rate or choose a "
                "shorter datagram."
            )


def utility_request(name: str, *parameters: object) -> bytes:
    body = ",".join([f"${name}", *map(str, parameters)]) + ","
    return f"{body}{crc8_stim300(body.encode())}\r".encode("ascii")


def parse_utility(frame: bytes) -> tuple[str, list[str]]:
    """Name and fields of a reply whose check fits; raises `Rejected` for a status other than 0 and 8."""
    body, comma, check = frame[frame.find(b"#") :].rpartition(b",")
    if not comma or check != str(crc8_stim300(body + comma)).encode():
        raise ChecksumError(f"The reply {printable(frame)!r} has a wrong CRC. Check the line's shielding.")
    name, *fields = body.decode("ascii", "replace").removeprefix("#").split(",")
    if not fields or not fields[0].isdigit():
        raise FramingError(f"{printable(frame)!r} is not a reply of Utility Mode.")
    status = int(fields[0])
    if status not in (0, 8):
        text = _STATUS_TEXTS.get(str(status), "unknown status")
        raise Rejected(f"The IMU refuses {name or 'the command'}: status {status} ({text}).")
    return name, fields[1:]


def decoder_of(config: Stim300Config, registers: Mapping[str, str]) -> Stim300Decoder:
    """The decoder for a unit's configuration as it was read back: live, or later from a journal."""
    ranges = registers.get("irng", "").split(",")
    try:
        (range_g,) = {int(text) for text in ranges[3:6]}
    except ValueError:
        raise FramingError(
            f"The IMU reports its ranges as {registers.get('irng')!r}; one accelerometer range was expected in "
            "the fourth to sixth field."
        ) from None
    return Stim300Decoder(
        sample_rate_hz=config.sample_rate_hz, acceleration_range_g=range_g, increments=config.increments
    )


class Stim300Stream(ImuDriver[Stim300Config]):
    def __init__(self, transport: Transport, clock: Clock, config: Stim300Config) -> None:
        super().__init__(Exchange(transport, LineFramer(b"\r"), clock, "The STIM300", config.reply_timeout_s), config)
        # Settings last until the unit is switched off, and are never saved.
        self.settings = KeptSettings()
        self._registers: dict[str, str] = {}
        self._in_utility = False

    def identify(self) -> Identity:
        self._enter_utility()
        return Identity("stim300", self._ask("ix")[0], self._ask("isn")[0], self._ask("ifw")[0])

    def configure(self) -> ImuSettings:
        self._enter_utility()
        config = self._config
        self._set("m", SAMPLE_RATE_CODES[config.sample_rate_hz])
        self._set("d", config.datagram)
        for name in ("gu", "au"):
            self._set(name, config.increment_unit_code if config.increments else config.rate_unit_code)
        registers: dict[str, str] = {}
        for name in ("id", "im", "it", "irng", "igu", "iau", "igf", "iaf", "ig", "ibto", "isv"):
            try:
                registers[name] = ",".join(self._ask(name))
            except Rejected as refusal:
                registers[name] = f"refused: {refusal}"
        self._registers = registers
        decoder_of(config, registers)
        return ImuSettings(config.sample_rate_hz, registers)

    def start(self) -> None:
        if self._in_utility:
            self._ask("xn")
            self._in_utility = False

    def stop(self) -> None:
        self._enter_utility()

    def decoder(self) -> Stim300Decoder:
        if not self._registers:
            raise NotVerified("The IMU's accelerometer range is not known yet: call configure() first.")
        return decoder_of(self._config, self._registers)

    def _enter_utility(self) -> None:
        if self._in_utility:
            return
        received = b""
        for _ in range(2):
            self._exchange.transport.write(b"UTILITYMODE\r")
            end = time.monotonic() + self._config.mode_timeout_s
            while (left := end - time.monotonic()) > 0.0:
                received = (received + self._exchange.transport.read(min(left, 0.1)))[-4096:]
                # A unit that a killed program left in Utility Mode calls the request invalid: `#,1,180`.
                if re.search(rb"#UTILITYMODE,234\r|#,1,180\r", received):
                    self._exchange.transport.drain(0.02)
                    self._in_utility = True
                    return
        raise (FramingError if received else ReplyTimeout)(
            f"The IMU at {self._exchange.transport.url} was sent 'UTILITYMODE' and did not enter Utility Mode"
            + (f"; it sent {printable(received[-80:])!r}. Check that this is a STIM300 and" if received else ". Check")
            + " power, cable (RS-422), baud rate and parity."
        )

    def _ask(self, name: str, *parameters: object) -> list[str]:
        def parse(frame: bytes) -> list[str]:
            answered, fields = parse_utility(frame)
            if answered != name:
                raise NotThisReply
            return fields

        return self._exchange.query(utility_request(name, *parameters), parse)

    def _set(self, name: str, code: int) -> None:
        """Settings are idempotent: repeating after a lost reply is harmless; the read-back decides."""
        if self._ask(f"i{name}")[0] == str(code):
            return
        self._ask(f"s{name}", code)
        if (shown := self._ask(f"i{name}")[0]) != str(code):
            raise NotVerified(f"${name} of the IMU was set to {code}, but it reports {shown}.")
