"""VectorNav VN-100 and VN-200: ASCII registers, and samples as binary packets.

Sources: the vendor's C library and its example for binary output. 115200 8N1. An ASCII message is `$VN…*` and two
hexadecimal digits of the exclusive or between `$` and `*`; a binary packet is FA, a byte of groups, a 16-bit mask per
group, the payload, and a CRC-16 that makes the CRC of all bytes after FA zero. Replies come between samples and differ
from them by their header. Nothing is saved to the unit's memory.

The samples are the *uncompensated* ones: calibrated in the factory, without the user's filter and bias registers.
Binary packets carry the unit's own time in nanoseconds, from which missing samples are counted. (`$VNIMU` lines carry
no time and no counter: a unit that was set to print them is a unit of text, see `files.run.text_unit`.)

Unverified on real hardware: that the base rate is 800 Hz on every model (`base_rate_hz`); the meaning of
"uncompensated" differs between versions of the firmware.
"""

import math
import struct
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from gradcal_jax.hardware.checksums import crc16_vectornav, xor8
from gradcal_jax.hardware.clock import Clock
from gradcal_jax.hardware.drivers.base import ImuDriver, codes_of
from gradcal_jax.hardware.errors import ChecksumError, NotVerified, Rejected, printable
from gradcal_jax.hardware.framing import LengthFramer, NotThisReply
from gradcal_jax.hardware.request_reply import Exchange
from gradcal_jax.hardware.roles import STANDARD_GRAVITY, Identity, ImuBatch, ImuSettings, KeptSettings, imu_batch, join
from gradcal_jax.hardware.transport import Transport

_ERRORS = codes_of("vectornav")
_DOLLAR = 0x24
_LONGEST_LINE = 256
_REMEMBERED = 16
# Group 1 bit 0: time since start-up; group 3 bits 2, 3, 4: uncompensated acceleration and rate, temperature.
_HEADER = bytes.fromhex("FA0501001C00")
_PAYLOAD = struct.Struct("<Q3f3ff")
_PACKET = len(_HEADER) + _PAYLOAD.size + 2


@dataclass(frozen=True)
class VectorNavConfig:
    baudrate: int = 115200
    sample_rate_hz: float = 200.0
    base_rate_hz: float = 800.0
    reply_timeout_s: float = 1.0

    def __post_init__(self) -> None:
        divisor = self.base_rate_hz / self.sample_rate_hz
        if abs(divisor - round(divisor)) > 1e-9:
            raise ValueError(f"sample_rate {self.sample_rate_hz:g} /s does not divide {self.base_rate_hz:g} /s.")
        if 10 * _PACKET * self.sample_rate_hz > self.baudrate:
            raise ValueError(
                f"{self.sample_rate_hz:g} samples/s of {_PACKET} bytes do not fit {self.baudrate} baud. Raise "
                "baudrate (also in the IMU) or lower sample_rate."
            )


def request(words: str) -> bytes:
    return f"${words}*{xor8(words.encode()):02X}\r\n".encode("ascii")


def parse_line(frame: bytes) -> list[str]:
    """Fields of an ASCII message with a right checksum. Raises `Rejected` for `$VNERR`."""
    body, star, check = frame[1:].rpartition(b"*")
    if frame[:1] != b"$" or not star or check != b"%02X" % xor8(body):
        raise ChecksumError(f"The message {printable(frame)!r} has a wrong checksum. Check cable and baud rate.")
    fields = body.decode("ascii", "replace").split(",")
    if fields[0] == "VNERR":
        code = str(int(fields[1])) if len(fields) > 1 and fields[1].isdigit() else "?"
        raise Rejected(f"The IMU reports error {code}: {_ERRORS.get(code, 'unknown error')}.")
    return fields


class VectorNavFramer(LengthFramer):
    """ASCII lines (`$…`, without the line end) and sound packets of the driver's own output, in order; those of other
    outputs are noise."""

    def push(self, data: bytes) -> list[bytes]:
        return [frame[:-2] if frame[0] == _DOLLAR else frame for frame in super().push(data)]

    def _length(self, head: bytes) -> int | None:
        if head[0] == _DOLLAR:
            end = head.find(b"\r\n")
            text = head[: end if end >= 0 else len(head)].removesuffix(b"\r")
            if len(text) > _LONGEST_LINE or not all(32 <= byte < 127 for byte in text):
                return None
            return end + 2 if end >= 0 else 0
        if head[: len(_HEADER)] != _HEADER[: len(head)]:
            return None
        if len(head) < _PACKET:
            return 0
        return None if crc16_vectornav(head[1:_PACKET]) else _PACKET


class VectorNavDecoder:
    """Bytes -> samples.

    A binary packet that comes twice counts once: no two have the same time. If the time goes back, the IMU restarted.
    """

    resolution_s = 1e-9
    round_samples = 0

    def __init__(self, *, sample_rate_hz: float) -> None:
        self._rate = sample_rate_hz
        self.sample_s = 1.0 / sample_rate_hz
        self._framer = VectorNavFramer()
        self._last_time_s: float | None = None
        self._recent: deque[bytes] = deque(maxlen=_REMEMBERED)
        self.repeated_datagrams = 0

    @property
    def bad_bytes(self) -> int:
        return self._framer.bad_bytes

    def push(self, data: bytes, host_time_s: float) -> ImuBatch:
        rows = [row for frame in self._framer.push(data) if (row := self._row(frame)) is not None]
        if not rows:
            return join([])
        table = np.array([row[0] for row in rows])
        times = table[:, 0]
        before = times[0] - 1.0 / self._rate if self._last_time_s is None else self._last_time_s
        steps, self._last_time_s = np.diff(times, prepend=before), float(times[-1])
        return imu_batch(
            host_time_s,
            times,
            np.degrees(table[:, 4:7]),
            table[:, 1:4] / STANDARD_GRAVITY,
            np.repeat(table[:, 7:8], 3, axis=1),
            status=np.array([row[1] for row in rows], np.int64),
            gap_before=np.maximum(np.rint(steps * self._rate).astype(np.int64) - 1, 0),
            restarted=steps < 0.0,
        )

    def _row(self, frame: bytes) -> tuple[list[float], int] | None:
        """Time, three accelerations (m/s²), three rates (rad/s), temperature (°C); status 1 where not finite."""
        if frame[0] == _DOLLAR:
            return None
        if frame in self._recent:
            self.repeated_datagrams += 1
            return None
        self._recent.append(frame)
        time_ns, *values = _PAYLOAD.unpack_from(frame, len(_HEADER))
        return [time_ns * 1e-9, *values], int(not all(map(math.isfinite, values)))


def decoder_of(config: VectorNavConfig, registers: Mapping[str, str]) -> VectorNavDecoder:
    """The decoder for a configured unit; binary packets describe all but the rate."""
    return VectorNavDecoder(sample_rate_hz=config.sample_rate_hz)


class VectorNavStream(ImuDriver[VectorNavConfig]):
    def __init__(self, transport: Transport, clock: Clock, config: VectorNavConfig) -> None:
        line = transport, VectorNavFramer(), clock, "The VectorNav IMU", config.reply_timeout_s
        super().__init__(Exchange(*line), config)
        self.settings = KeptSettings(self._read, self._write, _same)

    def identify(self) -> Identity:
        model, hardware, serial, firmware = map(self._read, ("1", "2", "3", "4"))
        return Identity("vectornav", model, serial, firmware, {"hardware": hardware})

    def configure(self) -> ImuSettings:
        self.stop()
        names = ("01", "02", "03", "04", "05", "30", "06", "07", "75")
        return ImuSettings(self._config.sample_rate_hz, {name: self._read(name) for name in names})

    def start(self) -> None:
        self.settings.change("75", self._binary_output(1))

    def stop(self) -> None:
        """Switch off all outputs, also others that an earlier use may have left on."""
        self.settings.change("6", "0")
        self.settings.change("75", self._binary_output(0))
        for register in ("76", "77"):
            # The unit does not have this output.
            with suppress(Rejected):
                self.settings.change(register, ",".join(["0", *self._read(register).split(",")[1:]]))

    def decoder(self) -> VectorNavDecoder:
        return decoder_of(self._config, {})

    def _binary_output(self, port: int) -> str:
        return f"{port},{round(self._config.base_rate_hz / self._config.sample_rate_hz)},05,0001,001C"

    def _ask(self, command: str, register: str, *values: str) -> str:
        def parse(frame: bytes) -> str:
            if frame[0] != _DOLLAR:
                raise NotThisReply
            name, *fields = parse_line(frame)
            if (name, [number.lstrip("0") for number in fields[:1]]) != (command, [register.lstrip("0")]):
                raise NotThisReply
            return ",".join(fields[1:])

        return self._exchange.query(request(",".join([command, register.zfill(2), *values])), parse)

    def _read(self, register: str) -> str:
        return self._ask("VNRRG", register)

    def _write(self, register: str, values: str) -> None:
        """Registers are idempotent: writing again after a lost reply is harmless; the read-back decides."""
        self._ask("VNWRG", register, values)
        shown = self._read(register)
        if not _same(shown, values):
            raise NotVerified(f"Register {int(register)} was set to {values}, but it reports {shown}.")


def _same(shown: str, wanted: str) -> bool:
    """Equal except for leading zeros; a unit may append fields of its other ports."""
    seen, asked = ([field.lstrip("0") or "0" for field in text.split(",")] for text in (shown, wanted))
    return seen[: len(asked)] == asked
