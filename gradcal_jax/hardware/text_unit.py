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
from typing import Annotated, Final, Literal

import numpy as np
from pydantic import Field

from gradcal_jax.hardware.checksums import xor8
from gradcal_jax.hardware.framing import LineFramer
from gradcal_jax.hardware.line_protocol import DescribedSensor, reply_pattern, unit_problems
from gradcal_jax.hardware.roles import Floats, ImuBatch, join
from gradcal_jax.hardware.sample_times import SECONDS, SampleDecoder, conversion
from gradcal_jax.tables.problems import Problem, instead
from gradcal_jax.tables.quantity import Text
from gradcal_jax.tables.section import Section

NAMES: Final = (
    *(f"{quantity}_{axis}" for quantity in ("gyro", "acceleration") for axis in "xyz"),
    "temperature",
    "second_temperature",
    "count",
    "time",
)
_FIELD: Final = re.compile(r"\{([a-z_]*)(?::(text))?\}")
_NUMBER: Final = r"(?>[-+]?(?:\d++\.?\d*+|\.\d++)(?:[eE][-+]?\d{1,2}+)?|[nN][aA][nN])"


class SensorTime(Section):
    """`[time]`: unit of the field `{time}`, and the value at which it restarts at 0."""

    unit: Literal["s", "ms", "us"] = "s"
    """Unit of the time."""
    modulus: Annotated[int, Field(strict=True, ge=2, le=2**64)] | None = None
    """Value at which the time restarts at 0; absent: it never restarts."""


class TextSensor(DescribedSensor):
    """A complete description of a sensor that prints lines of text."""

    format: Literal["gradcal-text/1"]
    """Name and version of this file format."""
    line: Text
    """A line that the sensor prints, with fields in braces in place of the numbers."""
    gyro: Text = "deg/s"
    """Unit of rates."""
    acceleration: Text = "m/s^2"
    """Unit of accelerations."""
    temperature: Text = "degC"
    """Unit of temperatures."""
    counter: Annotated[int, Field(strict=True, ge=2, le=2**64)] | None = None
    """Value at which the field `{count}` restarts at 0."""
    time: SensorTime = SensorTime()
    """Unit of the field `{time}`, and the value at which it restarts."""
    checksum: Literal["none", "xor8"] = "none"
    """Text at the end of the line: "none"; or "xor8": an asterisk and two hexadecimal digits, the exclusive or of
    the characters between "$" and "*"."""

    @property
    def fields(self) -> tuple[str, ...]:
        """The names of its fields."""
        return tuple(match[1] for match in _FIELD.finditer(self.line) if match[1])

    def _problems(self) -> Iterator[Problem]:
        fields = self.fields
        if {"{", "}"} & set(_FIELD.sub("", self.line)) or re.search(r"\}\{", self.line):
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
                "this key (the value at which the count restarts at 0) is required if the line has a field {count}, "
                "and not allowed otherwise"
            )
            yield Problem(("counter",), message)
        if {"count", "time"} <= set(fields):
            yield Problem(("line",), "expected {count} or {time}, not both: replace one of the two by {}", self.line)
        kinds = {"gyro": "angular rate", "acceleration": "acceleration", "temperature": "temperature"}
        yield from unit_problems(self, kinds)

    def pattern(self) -> re.Pattern[str]:
        """The pattern of a line, with the fields as named groups."""
        return reply_pattern(self.line, _NUMBER, tabs=True, padded=True)


class TextUnitDecoder(SampleDecoder):
    """Lines -> samples. A line that comes twice in succession counts once, if it has a counter or a time."""

    def __init__(self, unit: TextSensor) -> None:
        self._unit, self._pattern, self._framer = unit, unit.pattern(), LineFramer()
        rate = float(unit.rate)
        self._stamp = next((name for name in ("count", "time") if name in unit.fields), "")
        timed = self._stamp == "time"
        modulus = unit.time.modulus if timed else unit.counter
        super().__init__(self._stamp, rate, SECONDS[unit.time.unit] if timed else 1.0 / rate, modulus)
        self._last_line = b""

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
                self._noise(len(frame))
            elif self._stamp and frame == self._last_line:
                self.repeated_datagrams += 1
            else:
                fields = match.groupdict()
                rows.append([float(fields.get(name, "nan")) for name in NAMES])
                disturbed.append(self._disturbed)
                self._disturbed, self._last_line = False, frame
        if not rows:
            return join([])
        table, values = np.array(rows), dict[str, Floats]()
        temperature = conversion(self._unit.temperature, "degC")
        scales = {
            "gyro": (0, 3, conversion(self._unit.gyro, "deg/s")),
            "acceleration": (3, 6, conversion(self._unit.acceleration, "mg", 1e-3)),
            "temperature": (6, 7, temperature),
            "second_temperature": (7, 8, temperature),
        }
        for name, (first, end, (scale, zero)) in scales.items():
            values[name] = np.repeat(table[:, first:end] * scale + zero, 3 // (end - first), axis=1)
        stamps = table[:, NAMES.index(self._stamp or "count")]
        return self._batch(host_time_s, stamps, values, np.array(disturbed))
