"""A simulated VectorNav VN-100: the peer of `drivers.vectornav`, written from the protocol.

Registers over ASCII, samples as binary packets, replies between them. Errors as the unit reports
them: wrong checksum 3, unknown command 4, missing and surplus parameters 5 and 6, invalid parameter 7, unknown
register 8, an output that the baud rate cannot carry 12.
"""

import struct
from dataclasses import dataclass

import numpy as np

from gradcal_jax.hardware.checksums import crc16_vectornav, xor8
from gradcal_jax.hardware.clock import Clock
from gradcal_jax.hardware.simulate.imu import SampledSensor

_STANDARD_GRAVITY = 9.80665


@dataclass
class VectorNavOptions:
    model: str = "VN-100T-CR"
    serial: str = "0100012345"
    baudrate: int = 115200
    burst_s: float = 0.016


class SimulatedVectorNav:
    def __init__(self, sensor: SampledSensor, clock: Clock, options: VectorNavOptions | None = None) -> None:
        self.options = options or VectorNavOptions()
        self.sensor = sensor
        self._clock = clock
        self._buffer = b""
        self.registers: dict[int, str] = {}
        self.reboot()

    def reboot(self) -> None:
        """Settings that were not saved are gone: 40 Hz of attitude lines, as from the factory, which stay silent here
        because the simulated unit has no attitude filter."""
        self._buffer = b""
        self.registers = {
            1: self.options.model,
            2: "7",
            3: self.options.serial,
            4: "2.1.0.0",
            5: str(self.options.baudrate),
            6: "14",
            7: "40",
            30: "0,0,0,0,1,0,1",
            75: "0,4,00",
            76: "0,4,00",
            77: "0,4,00",
        }
        self._paused = False
        self._powered_s = self._clock.now()

    def receive(self, data: bytes) -> list[bytes]:
        self._buffer += data
        replies: list[bytes] = []
        while b"\n" in self._buffer:
            line, _, self._buffer = self._buffer.partition(b"\n")
            start = line.rfind(b"$")
            if start >= 0:
                replies.append(self._answer(line[start + 1 :].rstrip(b"\r")))
        return replies

    def next_emission_s(self) -> float | None:
        if not self._output() and not self._attitude():
            return None
        ahead = max(1, round(self.options.burst_s / self.sensor.true_period_s))
        return self.sensor.next_time_s(ahead)

    def emit(self, now_s: float) -> list[bytes]:
        output, attitude = self._output(), self._attitude()
        count = self.sensor.due(now_s) if output or attitude else 0
        if not count:
            return []
        samples = self.sensor.take(count)
        messages: list[bytes] = []
        force = samples.acceleration_g * _STANDARD_GRAVITY
        rate = np.radians(samples.rate_dps)
        # The unit's own clock: fast by the same share as its sampling.
        own = (samples.time_s - self._powered_s) * (1.0 + self.sensor.clock_error)
        for index in range(count):
            if attitude:
                body = bytes.fromhex("010800") + struct.pack("<3f", 0.0, 0.0, 0.0)
                messages.append(b"\xfa" + body + crc16_vectornav(body).to_bytes(2, "big"))
            if output:
                nanoseconds = round(float(own[index]) * 1e9)
                values = (*force[index], *rate[index], samples.temperature_c[index])
                body = bytes.fromhex("050100 1c00") + struct.pack("<Q7f", nanoseconds, *values)
                messages.append(b"\xfa" + body + crc16_vectornav(body).to_bytes(2, "big"))
        return messages

    # -------------------------------------------------------------------------------------------------------- parts

    def _output(self) -> bool:
        """Whether it sends samples."""
        return not self._paused and not self.registers[75].startswith("0,")

    def _attitude(self) -> bool:
        """Whether the second or third output, of attitude, was left on by somebody."""
        return not self._paused and not all(self.registers[register].startswith("0,") for register in (76, 77))

    def _answer(self, line: bytes) -> bytes:
        body, star, check = line.rpartition(b"*")
        if not star or check.upper() != b"%02X" % xor8(body):
            return _message("VNERR,03")
        name, *fields = body.decode("latin-1").split(",")
        if name == "VNRRG":
            return self._read(fields)
        if name == "VNWRG":
            return self._write(fields)
        if name == "VNASY" and fields in (["0"], ["1"]):
            self._paused = fields == ["0"]
            return _message(body.decode("ascii"))
        if name in ("VNRST", "VNWNV"):
            if name == "VNRST":
                self.reboot()
            return _message(name)
        return _message("VNERR,04")

    def _read(self, fields: list[str]) -> bytes:
        if len(fields) != 1:
            return _message("VNERR,05" if not fields else "VNERR,06")
        if not fields[0].isdigit() or int(fields[0]) not in self.registers:
            return _message("VNERR,08")
        return _message(f"VNRRG,{int(fields[0]):02d},{self.registers[int(fields[0])]}")

    def _write(self, fields: list[str]) -> bytes:
        if len(fields) < 2:
            return _message("VNERR,05")
        register = int(fields[0]) if fields[0].isdigit() else -1
        if register not in (5, 6, 7, 75, 76, 77):
            return _message("VNERR,08")
        if fields[1:2] == ["0"] and register >= 75:
            self.registers[register] = ",".join(fields[1:])
            code = 0
        elif register in (76, 77):
            known = fields[2:] and fields[3:] == ["01", "0008"]
            self.registers[register] = ",".join(fields[1:]) if known else self.registers[register]
            code = 0 if known else 7
        elif register == 75:
            code = self._write_binary(fields[1:])
        elif len(fields) != 2:
            code = 6
        elif not fields[1].isdigit():
            code = 7
        elif register == 6 and fields[1] == "19" and self._too_much(130, float(self.registers[7])):
            code = 12
        else:
            self.registers[register] = fields[1]
            code = 0
            if register == 6 and fields[1] == "19":
                self.sensor.restart(self._clock.now(), float(self.registers[7]))
        if code:
            return _message(f"VNERR,{code:02d}")
        return _message(f"VNWRG,{register:02d},{self.registers[register]}")

    def _write_binary(self, fields: list[str]) -> int:
        if len(fields) != 5:
            return 5 if len(fields) < 5 else 6
        port, divisor, groups, time_mask, imu_mask = fields
        try:
            wanted = (int(groups, 16), int(time_mask, 16), int(imu_mask, 16))
            rate = 800.0 / int(divisor)
        except (ValueError, ZeroDivisionError):
            return 7
        if wanted != (5, 1, 0x1C) or port not in ("0", "1", "2"):
            return 7
        if port != "0" and self._too_much(44, rate):
            return 12
        self.registers[75] = f"{port},{int(divisor)},05,0001,001C"
        if port != "0":
            self.sensor.restart(self._clock.now(), rate)
        return 0

    def _too_much(self, length: int, rate_hz: float) -> bool:
        return 10 * length * rate_hz > int(self.registers[5])


def _message(text: str) -> bytes:
    return f"${text}*{xor8(text.encode()):02X}\r\n".encode("ascii")
