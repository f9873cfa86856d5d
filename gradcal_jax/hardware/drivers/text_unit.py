"""Driver of IMUs that print their samples as lines of text, as a rig file describes them (`hardware.text_unit`)."""

import re
from functools import cached_property

import numpy as np

from gradcal_jax.hardware.checksums import xor8
from gradcal_jax.hardware.drivers.listening import SECONDS, ListeningConfig, ListeningImu, SampleTimes, conversion
from gradcal_jax.hardware.framing import LineFramer
from gradcal_jax.hardware.line_protocol import described
from gradcal_jax.hardware.roles import ImuBatch, imu_batch, join
from gradcal_jax.hardware.text_unit import NAMES, TextSensor

__all__ = ["ListeningImu", "TextUnitConfig", "TextUnitDecoder"]


class TextUnitConfig(ListeningConfig):
    driver = "text_unit"

    @cached_property
    def described(self) -> TextSensor:
        return described(TextSensor, self.protocol, self.changes)

    def decoder(self) -> "TextUnitDecoder":
        return TextUnitDecoder(self.described)

    @property
    def expected(self) -> str:
        return repr(self.described.line) + (" with a checksum" if self.described.checksum != "none" else "")

    @property
    def registers(self) -> dict[str, str]:
        return {"line": self.described.line}


class TextUnitDecoder:
    """Lines -> samples. A line that comes twice in succession counts once, if it has a counter or a time."""

    def __init__(self, unit: TextSensor) -> None:
        self._unit, self._pattern, self._framer = unit, unit.pattern(), LineFramer()
        rate = float(unit.rate)
        self._stamp = next((name for name in ("count", "time") if name in unit.fields), "")
        timed = self._stamp == "time"
        modulus = unit.time.modulus if timed else unit.counter
        self._times = SampleTimes(self._stamp, rate, SECONDS[unit.time.unit] if timed else 1.0 / rate, modulus)
        self.sample_s, self.resolution_s = 1.0 / rate, self._times.resolution_s
        self.round_samples = self._times.round_samples
        self._last_line = b""
        self._disturbed = False
        self._scales = [conversion(unit.gyro, "deg/s"), conversion(unit.acceleration, "mg", 1e-3)]
        self._scales.append(conversion(unit.temperature, "degC"))
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
        stamps = table[:, NAMES.index(self._stamp or "count")]
        times, gaps, restarted = self._times.push(stamps)
        (gyro, _), (force, _), (degree, zero) = self._scales
        temperature = np.repeat(table[:, 6:7] * degree + zero, 3, axis=1)
        second = table[:, 7] * degree + zero
        astray = np.array(disturbed) & bool(self.round_samples)
        columns = host_time_s, times, table[:, 0:3] * gyro, table[:, 3:6] * force, temperature
        return imu_batch(*columns, second_c=second, gap_before=gaps, disturbed=astray, restarted=restarted)
