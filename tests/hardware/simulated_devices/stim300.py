"""A simulated STIM300: the peer of `drivers.stim300`, written from the data sheet.

After power-on it sends its part number, serial number and configuration, then Normal Mode, in which the start-up bit is
set for the first second. A special datagram *replaces* the next normal one. Datagrams beyond the line's bit rate are
lost silently, as in the real unit. Utility Mode answers with checks and status codes.

Special datagrams have the real identifier, length and CRC, but not the real contents.
"""

import re
from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from simulated_devices.datagrams import datagrams

from gradcal_jax.hardware.checksums import crc8_stim300, crc32_mpeg2
from gradcal_jax.hardware.clock import Clock
from gradcal_jax.hardware.simulate.imu import SampledSensor, SensorSamples
from gradcal_jax.hardware.simulate.lab import RATES_HZ


@dataclass
class Stim300Options:
    serial: str = "N25582405002002"
    part: str = "84167-440100-321"
    firmware: str = "SWD12345REV10"
    baudrate: int = 921600
    datagram: int = 5
    rate_code: int = 4
    range_g: int = 10
    line_end: bool = False
    burst_s: float = 0.016
    latency_us: int = 506
    start_up_s: float = 1.0


class SimulatedStim300:
    """One unit; `sensor` gives its samples. `options.burst_s` is the time between bursts of bytes to the host."""

    def __init__(self, sensor: SampledSensor, clock: Clock, options: Stim300Options | None = None) -> None:
        self.options = options or Stim300Options()
        self.sensor = sensor
        # Counts of datagrams: sent ("normal"), lost on a slow line ("overrun"), replaced by special ones ("special").
        self.counters: Counter[str] = Counter()
        self._clock = clock
        self._buffer = b""
        self._registers: dict[str, str] = {}
        self.reboot()

    def reboot(self) -> None:
        """Power on: unsaved settings are lost, the start-up datagrams come first."""
        options = self.options
        self._mode = "normal"
        self._buffer = b""
        self._registers = {"id": str(options.datagram), "im": str(options.rate_code), "ibto": "0,0,0,0,0,0"}
        self._registers |= dict.fromkeys(("igu", "iau", "iiu", "ig"), "0")
        self._registers |= dict.fromkeys(("igf", "iaf", "iif"), "4,4,4")
        self._waiting: list[bytes] = [self._special(0xB1, 20), self._special(0xB5, 20), self._special(0xBC, 26)]
        self._booted_s = self._clock.now()
        self._restart()

    def receive(self, data: bytes) -> list[bytes]:
        self._buffer += data
        replies: list[bytes] = []
        while b"\r" in self._buffer:
            line, _, self._buffer = self._buffer.partition(b"\r")
            text = line.decode("latin-1").strip("\n")
            reply = self._utility(text) if self._mode == "utility" else self._normal(text)
            if reply:
                replies.append(reply)
        return replies

    def next_emission_s(self) -> float | None:
        if self._mode != "normal":
            return None
        ahead = max(1, round(self.options.burst_s / self.sensor.true_period_s))
        return self.sensor.next_time_s(ahead)

    def emit(self, now_s: float) -> list[bytes]:
        if self._mode != "normal":
            return []
        count = self.sensor.due(now_s)
        if not count:
            return []
        first = self.sensor.taken
        return self._datagrams(first, self.sensor.take(count))

    def _rate_hz(self) -> float:
        return RATES_HZ[int(self._registers["im"])]

    def _restart(self) -> None:
        self.sensor.restart(self._clock.now(), self._rate_hz())

    def _datagrams(self, first: int, samples: SensorSamples) -> list[bytes]:
        count = samples.time_s.shape[0]
        starting = samples.time_s - self._booted_s < self.options.start_up_s
        bodies = datagrams(
            samples,
            first,
            starting,
            rate_hz=self._rate_hz(),
            kind=int(self._registers["id"]),
            range_g=self.options.range_g,
            rate_increments=self._registers["igu"] == "1",
            force_increments=self._registers["iau"] == "1",
            latency_us=self.options.latency_us,
        )
        number: NDArray[np.int64] = first + np.arange(count, dtype=np.int64)
        end = np.frombuffer(b"\r\n" if self.options.line_end else b"", np.uint8)
        rows = np.hstack([bodies, np.tile(end, (count, 1))])
        data, length = rows.tobytes(), rows.shape[1]
        messages: list[bytes] = []
        for index in np.flatnonzero(self._fit_line(number, length)).tolist():
            if self._waiting:
                self.counters["special"] += 1
                messages.append(self._waiting.pop(0))
            else:
                self.counters["normal"] += 1
                messages.append(data[index * length : (index + 1) * length])
        self.counters["overrun"] += count - len(messages)
        return messages

    def _fit_line(self, index: NDArray[np.int64], length: int) -> NDArray[np.bool_]:
        """Datagrams beyond the line's capacity are lost, evenly spaced."""
        share = self.options.baudrate / (10.0 * length * self._rate_hz())
        return (np.floor((index + 1) * share) > np.floor(index * share)) | (share >= 1.0)

    def _special(self, identifier: int, length: int) -> bytes:
        body = bytes([identifier]) + bytes((7 * i + identifier) % 251 for i in range(length - 5))
        return body + crc32_mpeg2(body + bytes(-len(body) % 4)).to_bytes(4, "big")

    def _normal(self, text: str) -> bytes:
        """Commands of Normal Mode: no echo, no error."""
        special = {"N": (0xB1, 20), "I": (0xB5, 20), "C": (0xBC, 26), "T": (0xD1, 40), "E": (0xBE, 21)}
        if text.endswith("UTILITYMODE"):
            self._mode = "utility"
            return b"#UTILITYMODE,234\r"
        if text in special:
            self._waiting.append(self._special(*special[text]))
        elif text == "R":
            self.reboot()
        return b""

    def _utility(self, text: str) -> bytes:
        match = re.fullmatch(r"(\$([a-z]+)(?:,(.*))?,)(\d+)", text)
        if match is None:
            return _reply("", 1)
        if int(match[4]) != crc8_stim300(match[1].encode()):
            return _reply("", 2)
        name, parameters = match[2], match[3].split(",") if match[3] else []
        readable = self._registers | {
            "isn": self.options.serial,
            "ix": self.options.part,
            "in": "STIM300",
            "ifw": self.options.firmware,
            "it": f"{self.options.baudrate},1,N,1,{int(self.options.line_end)},0",
            "irng": f"400,400,400,{self.options.range_g},{self.options.range_g},{self.options.range_g},1.7,1.7,1.7,NA",
            "isv": "9958",
            "ie": "0",
        }
        if name in readable:
            return _reply(name, 0, readable[name]) if not parameters else _reply(name, 4)
        if name == "xn":
            self._mode = "normal"
            self._restart()
            return _reply(name, 0)
        limits = {"sm": 4, "sd": 7, "sgu": 3, "sau": 3, "siu": 3}
        if name not in limits:
            return _reply("", 3)
        if len(parameters) != 1:
            return _reply(name, 4)
        if not parameters[0].isdigit() or int(parameters[0]) > limits[name]:
            return _reply(name, 5)
        self._registers["i" + name[1:]] = parameters[0]
        return _reply(name, 0, parameters[0])


def _reply(name: str, status: int, data: str = "") -> bytes:
    body = f"#{name},{status}," + (f"{data}," if data else "")
    return f"{body}{crc8_stim300(body.encode())}\r".encode("ascii")
