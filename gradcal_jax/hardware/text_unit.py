"""`gradcal-text/1`: the description of a unit that prints its samples as lines of text, without code.

    format       = "gradcal-text/1"
    title        = "Arduino with an IMU"
    line         = "$IMU,{gyro_x},{gyro_y},{gyro_z},{acceleration_x},{acceleration_y},{acceleration_z},{time}"
    rate         = "100 Hz"
    gyro         = "deg/s"               # what the numbers are in
    acceleration = "m/s^2"
    time         = { unit = "us", modulus = 4294967296 }
    checksum     = "xor8"                # *HH at the end: of all characters between "$" and "*"

In `line` a field in braces is a number, `{}` a number and `{:text}` a text that are ignored. Without `{count}` or
`{time}` a lost line is noticed by the rate of samples alone.
"""

import re
from collections.abc import Iterator
from typing import Final, Literal

import numpy as np

from gradcal_jax.hardware.checksums import xor8
from gradcal_jax.hardware.description import AccelerationUnit, DescribedSensor, Modulus, RateUnit, TemperatureUnit
from gradcal_jax.hardware.roles import Floats, ImuBatch, join
from gradcal_jax.hardware.sample_times import QUANTITIES, SECONDS, SampleDecoder, converted
from gradcal_jax.hardware.templates import FIELD, reply_pattern
from gradcal_jax.tables.problems import Problem, instead
from gradcal_jax.tables.quantity import Text
from gradcal_jax.tables.section import Section

# The fields of each quantity, and the stamps.
_FIELDS: Final = {
    name: [name] if "temperature" in name else [f"{name}_{axis}" for axis in "xyz"] for name in QUANTITIES
}
NAMES: Final = (*(field for fields in _FIELDS.values() for field in fields), "count", "time")
_NUMBER: Final = r"(?>[-+]?(?:\d++\.?\d*+|\.\d++)(?:[eE][-+]?\d{1,2}+)?|[nN][aA][nN])"
_LONGEST_LINE: Final = 4096


class SensorTime(Section):
    """`[time]`: unit of the field `{time}`, and the value at which it restarts at 0."""

    unit: Literal["s", "ms", "us"] = "s"
    """Unit of the time."""
    modulus: Modulus | None = None
    """Value at which the time restarts at 0; absent: it never restarts."""


class TextSensor(DescribedSensor):
    """A complete description of a sensor that prints lines of text."""

    format: Literal["gradcal-text/1"]
    """Name and version of this file format."""
    line: Text
    """A line that the sensor prints, with fields in braces in place of the numbers."""
    gyro: RateUnit = "deg/s"
    """Unit of rates."""
    acceleration: AccelerationUnit = "m/s^2"
    """Unit of accelerations."""
    temperature: TemperatureUnit = "degC"
    """Unit of temperatures."""
    counter: Modulus | None = None
    """Value at which the field `{count}` restarts at 0."""
    time: SensorTime = SensorTime()
    """Unit of the field `{time}`, and the value at which it restarts."""
    checksum: Literal["none", "xor8"] = "none"
    """Text at the end of the line: "none"; or "xor8": an asterisk and two hexadecimal digits, the exclusive or of
    the characters between "$" and "*"."""

    def decoder(self) -> "TextUnitDecoder":
        return TextUnitDecoder(self)

    @property
    def expected(self) -> dict[str, str]:
        """What a unit must print, for messages and the journal."""
        return {"line": self.line, "checksum": self.checksum}

    @property
    def fields(self) -> list[str]:
        """The names of its fields."""
        return [match[1] for match in FIELD.finditer(self.line) if match[1]]

    def _problems(self) -> Iterator[Problem]:
        fields = self.fields
        if {"{", "}"} & set(FIELD.sub("", self.line)) or "}{" in self.line:
            message = "expected fields in braces, such as {gyro_x}, with a character between two fields"
            yield Problem(("line",), message, self.line)
            return
        for name in (name for name in fields if name not in NAMES):
            yield Problem(("line",), f"{{{name}}} is not the name of a field; {instead(name, NAMES)}", self.line)
        if len(set(fields)) != len(fields):
            yield Problem(("line",), "a field appears twice", self.line)
        if not any(name.startswith(("gyro", "acceleration")) for name in fields):
            message = "expected at least one field of a rate or an acceleration, such as {gyro_x}"
            yield Problem(("line",), message, self.line)
        if ("count" in fields) is not (self.counter is not None):
            message = (
                "this key, the value at which the count restarts at 0, belongs to a line with {count}, and only there"
            )
            yield Problem(("counter",), message)
        if {"count", "time"} <= set(fields):
            yield Problem(("line",), "expected {count} or {time}, not both: replace one of the two by {}", self.line)


class TextUnitDecoder(SampleDecoder):
    """Lines -> samples. Lines end at CR, LF or both; a line of more than 4096 bytes is noise."""

    def __init__(self, unit: TextSensor) -> None:
        self._unit, self._pattern = unit, reply_pattern(unit.line, _NUMBER)
        self._buffer = b""
        self._stamp = "time" if "time" in unit.fields else "count"
        rate_hz = float(unit.rate)
        if self._stamp == "time":
            super().__init__("time", rate_hz, SECONDS[unit.time.unit], unit.time.modulus)
        else:
            super().__init__("count" if unit.counter else "", rate_hz, 1.0 / rate_hz, unit.counter)

    def _matches(self, line: bytes) -> re.Match[str] | None:
        if self._unit.checksum == "xor8":
            body, star, check = line.rstrip().rpartition(b"*")
            if not star or body[:1] != b"$" or check.upper() != b"%02X" % xor8(body[1:]):
                return None
            line = body
        return self._pattern.fullmatch(line.decode("latin-1").strip())

    def push(self, data: bytes, host_time_s: float) -> ImuBatch:
        rows: list[list[float]] = []
        disturbed: list[bool] = []
        *lines, self._buffer = (self._buffer + data.replace(b"\r", b"\n")).split(b"\n")
        if len(self._buffer) > _LONGEST_LINE:
            # What remains of the line is too long with it, whatever it is.
            self._noise(len(self._buffer) - _LONGEST_LINE)
            self._buffer = self._buffer[:_LONGEST_LINE]
        for line in filter(None, lines):
            match = self._matches(line) if len(line) < _LONGEST_LINE else None
            if match is None:
                # The first line may be the end of one that began before.
                self._noise(len(line))
                continue
            fields = match.groupdict()
            rows.append([float(fields.get(name, "nan")) for name in NAMES])
            disturbed.append(self._disturbed)
            self._disturbed = False
        if not rows:
            return join([])
        table = dict(zip(NAMES, np.array(rows).T, strict=True))
        values: dict[str, Floats] = {}
        for name, fields in _FIELDS.items():
            numbers = np.stack([table[field] for field in fields], axis=1)
            values[name] = np.repeat(converted(name, numbers, getattr(self._unit, name)), 3 // len(fields), axis=1)
        return self._batch(host_time_s, table[self._stamp], values, np.array(disturbed))
