"""Driver of IMUs that print their samples as lines of text, as a rig file describes them (`files.run.text_unit`).

Nothing is sent to such a unit, and it cannot be asked who it is: its lines are its identity. A counter that wraps
early shows losses modulo its modulus, and the host's clock the rest (as of a STIM300); a time or a long counter shows
them all, and that the IMU restarted.

Unverified on real hardware: everything.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from gradcal_jax import units
from gradcal_jax.hardware.checksums import xor8
from gradcal_jax.hardware.clock import Clock
from gradcal_jax.hardware.drivers.base import ImuDriver
from gradcal_jax.hardware.drivers.stim300 import GapCounter
from gradcal_jax.hardware.errors import FramingError, ReplyTimeout, printable
from gradcal_jax.hardware.framing import LineFramer
from gradcal_jax.hardware.request_reply import Exchange
from gradcal_jax.hardware.roles import Identity, ImuBatch, ImuSettings, KeptSettings, imu_batch, join
from gradcal_jax.hardware.text_unit import NAMES, TextSensor, text_unit_of
from gradcal_jax.hardware.transport import Transport

_ENOUGH = 3
_LOOKS_S = 0.1
_LONG = 1 << 16
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6}


@dataclass(frozen=True)
class TextUnitConfig:
    """Options of the rig file. `protocol`: the description's tables. 0: the description's value."""

    protocol: Any = None
    baudrate: int = 0

    def __post_init__(self) -> None:
        if not self.baudrate:
            object.__setattr__(self, "baudrate", self.described.baudrate)

    @cached_property
    def described(self) -> TextSensor:
        return text_unit_of(self.protocol)


class TextUnitDecoder:
    """Lines -> samples. A line that comes twice in succession counts once, if it has a counter or a time."""

    def __init__(self, unit: TextSensor) -> None:
        self._unit, self._pattern, self._framer = unit, unit.pattern(), LineFramer()
        self._rate = float(unit.rate)
        self.sample_s = 1.0 / self._rate
        self._stamp = next((name for name in ("count", "time") if name in unit.fields), "")
        self._modulus = unit.counter if self._stamp == "count" else unit.time.modulus
        short = self._stamp == "count" and self._modulus is not None and self._modulus < _LONG
        self.round_samples = int(self._modulus or 0) if short else 0
        self.resolution_s = _SECONDS[unit.time.unit] if self._stamp == "time" else self.sample_s
        self._gaps = GapCounter(step=1, modulus=self.round_samples, ticks_per_s=self._rate) if short else None
        self._before: tuple[float, float] | None = None
        self._last_line = b""
        self._lines = 0
        self._disturbed = False
        self._scales = [_line_of(unit.gyro, "deg/s"), _line_of(unit.acceleration, "mg", 1e-3)]
        self._scales.append(_line_of(unit.temperature, "degC"))
        self.bad_bytes = self.repeated_datagrams = 0

    def matches(self, frame: bytes) -> re.Match[str] | None:
        if self._unit.checksum == "xor8":
            body, star, check = frame.rstrip().rpartition(b"*")
            if not star or body[:1] != b"$" or check.upper() != b"%02X" % xor8(body[1:]):
                return None
            frame = body
        return self._pattern.fullmatch(frame.decode("latin-1").strip())

    def push(self, data: bytes, host_time_s: float) -> ImuBatch:
        rows: list[list[float]] = []
        disturbed: list[bool] = []
        for frame in self._framer.push(data):
            match = self.matches(frame)
            if match is None:
                # The first line may be the end of one that began before.
                self.bad_bytes += len(frame)
                self._disturbed = True
            elif self._stamp and frame == self._last_line:
                self.repeated_datagrams += 1
            else:
                fields = match.groupdict()
                rows.append([float(fields[name]) if name in fields else np.nan for name in NAMES])
                disturbed.append(self._disturbed)
                self._disturbed = False
                self._last_line = frame
        if not rows:
            return join([])
        table = np.array(rows)
        times, gaps, restarted = self._times(table[:, 8 + (self._stamp == "time")], host_time_s, disturbed[0])
        (gyro, _), (force, _), (degree, zero) = self._scales
        temperature = np.repeat(table[:, 6:7] * degree + zero, 3, axis=1)
        second = table[:, 7] * degree + zero
        astray = np.array(disturbed) & bool(self.round_samples)
        found = host_time_s, times, table[:, 0:3] * gyro, table[:, 3:6] * force, temperature
        return imu_batch(*found, second_c=second, gap_before=gaps, disturbed=astray, restarted=restarted)

    def _times(self, stamps: Any, host_time_s: float, disturbed: bool) -> tuple[Any, Any, Any]:
        """The unit's own times, the samples missing before each, and whether it restarted before each."""
        count = len(stamps)
        never = np.zeros(count, np.bool_)
        if not self._stamp:
            first, self._lines = self._lines, self._lines + count
            return np.arange(first + 1, first + 1 + count) / self._rate, np.zeros(count, np.int64), never
        if self._gaps is not None:
            counts, gaps = self._gaps.push(stamps.astype(np.int64), host_time_s, disturbed=disturbed)
            return counts / self._rate, gaps, never
        sample = self.sample_s / self.resolution_s
        stamp, ticks = self._before or (float(stamps[0]) - sample, 0.0)
        steps = np.diff(stamps, prepend=stamp)
        if self._modulus is not None:
            steps = np.mod(steps, float(self._modulus))
        restarted = steps < 0.0 if self._modulus is None else steps > 0.5 * self._modulus
        steps = np.where(restarted, sample, steps)
        counts = ticks + np.cumsum(steps)
        self._before = float(stamps[-1]), float(counts[-1])
        return counts * self.resolution_s, np.maximum(np.rint(steps / sample).astype(np.int64) - 1, 0), restarted


def _line_of(unit: str, wanted: str, factor: float = 1.0) -> tuple[float, float]:
    zero = units.convert(0.0, unit, wanted) * factor
    return units.convert(1.0, unit, wanted) * factor - zero, zero


def decoder_of(config: TextUnitConfig, registers: Mapping[str, str]) -> TextUnitDecoder:
    return TextUnitDecoder(config.described)


class TextUnitStream(ImuDriver[TextUnitConfig]):
    def __init__(self, transport: Transport, clock: Clock, config: TextUnitConfig) -> None:
        unit = config.described
        super().__init__(Exchange(transport, LineFramer(), clock, unit.title, float(unit.timeout)), config)
        self._unit, self._ready_s = unit, clock.now() + float(unit.boot)
        self.settings = KeptSettings()

    def identify(self) -> Identity:
        self._listen()
        return Identity("text_unit", self._unit.title)

    def configure(self) -> ImuSettings:
        self._listen()
        return ImuSettings(float(self._unit.rate), {"line": self._unit.line})

    def start(self) -> None: ...

    def stop(self) -> None: ...

    def decoder(self) -> TextUnitDecoder:
        return TextUnitDecoder(self._unit)

    def _listen(self) -> None:
        """Wait for lines of the description. Raises with what the unit printed instead."""
        transport, decoder, timeout_s = self._exchange.transport, self.decoder(), float(self._unit.timeout)
        self._clock.sleep_until(self._ready_s)
        end = self._clock.now() + timeout_s
        framer, good, other, received = LineFramer(), 0, list[bytes](), b""
        transport.drain()
        while good < _ENOUGH and self._clock.now() < end:
            self._clock.sleep(_LOOKS_S)
            data = transport.read(0.0)
            received = (received + data)[-1000:]
            for frame in framer.push(data):
                if decoder.matches(frame) is not None:
                    good += 1
                else:
                    other.append(frame)
        if good >= _ENOUGH:
            return
        where = f"{self._unit.title} at {transport.url}"
        if not received:
            raise ReplyTimeout(f"{where} printed nothing in {timeout_s:g} s. Check power, cable, port, and `boot`.")
        if not other and not good:
            raise FramingError(f"{where} sends {printable(received[-80:])!r} without an end of line. Baud rate?")
        shown = printable(other[-1]) if other else f"{good} lines"
        raise FramingError(
            f"{where} printed {shown!r} in {timeout_s:g} s, but the description expects {self._unit.line!r}"
            + (" with a checksum" if self._unit.checksum != "none" else "")
            + ". Compare them character by character; unreadable text means a wrong baud rate."
        )
