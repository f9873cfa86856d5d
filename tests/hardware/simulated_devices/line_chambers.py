"""Simulated chambers that speak in lines: a Thermotron 3800 and a CTS. Each with what it remembers.

Written from the protocols' public descriptions (see the heads of `spec/presets/devices`), not from the driver.
"""

import re
from abc import ABC, abstractmethod
from functools import reduce

from gradcal_jax.hardware.clock import Clock
from gradcal_jax.hardware.simulate.plants import ChamberPlant


class _LineChamber(ABC):
    """What these have in common: lines, a time after each command in which they are deaf, and a switch."""

    _ENDS, _REPLY_ENDS = b"\r", b"\r\n"

    def __init__(self, plant: ChamberPlant, clock: Clock) -> None:
        self.plant, self._clock = plant, clock
        self._buffer = b""
        self._deaf_until_s = -1.0
        self.running = False
        self.ignored: list[str] = []

    def receive(self, data: bytes) -> list[bytes]:
        *lines, self._buffer = (self._buffer + data).split(self._ENDS)
        return [reply.encode() + self._REPLY_ENDS for reply in map(self._line, lines) if reply]

    def reboot(self) -> None:
        self._buffer = b""
        self._run(False)

    def _run(self, on: bool) -> None:
        self.running = on
        self.plant.switch(self._clock.now(), on)

    @abstractmethod
    def _line(self, line: bytes) -> str: ...


class SimulatedThermotron(_LineChamber):
    """A set point that was told counts, and is shown, from the next RUNM on; the ramp outlives STOP; a line that comes
    less than a second after a command is lost. Commands have no reply, and words that are none neither."""

    _DEAF_S = 1.0

    def __init__(self, plant: ChamberPlant, clock: Clock) -> None:
        super().__init__(plant, clock)
        self.told_c = self.setpoint_c = plant.truth.ambient_c
        self.ramp_k_per_min = 0.0
        self.alarm = 0

    def raise_alarm(self) -> None:
        self.alarm = 1 << 5
        self._run(False)

    def _line(self, line: bytes) -> str:
        now, text = self._clock.now(), line.decode("latin-1").strip()
        if now < self._deaf_until_s - 1e-9:
            self.ignored.append(text)
            return ""
        answers = {
            "IDEN?": "3800",
            "VRSN?": "1.07",
            "PVAR1?": f"{self.plant.air_c(now):.2f}",
            "SETP1?": f"{self.setpoint_c:.2f}",
            "MRMP1?": f"{self.ramp_k_per_min:.1f}",
            "MODE?": "16" if self.running else "2",
            "ALRM1?": str(self.alarm),
        }
        if text in answers:
            return answers[text]
        if self._obeys(text, now):
            self._deaf_until_s = now + self._DEAF_S
        else:
            self.ignored.append(text)
        return ""

    def _obeys(self, text: str, now: float) -> bool:
        if (match := re.fullmatch(r"SETP1,(-?\d+(?:\.\d+)?(?:e-?\d+)?)", text)) and -55.0 <= float(match[1]) <= 150.0:
            self.told_c = float(match[1])
        elif (match := re.fullmatch(r"MRMP1,(\d+(?:\.\d+)?)", text)) and float(match[1]) <= 20.0:
            self.ramp_k_per_min = float(match[1])
        elif text == "RUNM":
            self.setpoint_c = self.told_c
            self.plant.command(now, target_c=self.setpoint_c, gradient_k_per_min=self.ramp_k_per_min or None)
            self._run(True)
        elif text in ("STOP", "INIT"):
            self._run(False)
        else:
            return False
        return True


class SimulatedCts(_LineChamber):
    """Framed by STX, address, check and ETX; what fails its check is not answered. Rates of ramps outlive a stop; the
    set value that A0 shows is the one that is regulated to now; the target is in R1."""

    _FREE = 999.9

    def __init__(self, plant: ChamberPlant, clock: Clock, address: int = 129) -> None:
        super().__init__(plant, clock)
        self._address = address
        self.error = False
        self.up = self.down = self._FREE
        self.target_c = plant.truth.ambient_c
        self.limits_c = (-40.0, 180.0)
        self.unanswered = 0

    def receive(self, data: bytes) -> list[bytes]:
        *frames, self._buffer = (self._buffer + data).split(b"\x03")
        return [self._framed(reply) for reply in map(self._line, frames) if reply]

    def raise_alarm(self) -> None:
        self.error = True
        self._run(False)

    def _framed(self, text: str) -> bytes:
        body = bytes([self._address, *(ord(letter) | 0x80 for letter in text)])
        return b"\x02" + body + bytes([reduce(lambda a, b: a ^ b, body) | 0x80, 3])

    def _line(self, line: bytes) -> str:
        begins = line.rfind(b"\x02")
        body = line[begins + 1 :]
        sound = begins >= 0 and len(body) > 2 and body[0] == self._address and all(byte & 0x80 for byte in body)
        if not sound or (reduce(lambda a, b: a ^ b, body[:-1]) | 0x80) != body[-1]:
            self.unanswered += 1
            return ""
        return self._answer("".join(chr(byte & 0x7F) for byte in body[1:-1]))

    def _answer(self, text: str) -> str:
        now = self._clock.now()
        if text == "A0":
            return f"A0 {self.plant.air_c(now):05.1f} {self.plant.set_point_c(now):05.1f}"
        if text == "R1":
            on = int(min(self.up, self.down) < self._FREE)
            return f"R1 {on}{on * int(self.running)} {self.up:07.2f} {self.down:07.2f} {self.target_c:07.2f}"
        if text == "S":
            return f"S{int(self.running)}{int(self.error)}100000{'1' if self.error else '0'}"
        if (match := re.fullmatch(r"a0 (-?\d+\.\d)", text)) is not None:
            low, high = self.limits_c
            if low <= float(match[1]) <= high:
                self.target_c = float(match[1])
                self._regulate(now)
            return "a"
        if (match := re.fullmatch(r"([ud])1 (\d{3}\.\d)", text)) is not None:
            if match[1] == "u":
                self.up = float(match[2])
            else:
                self.down = float(match[2])
            return match[1]
        if (match := re.fullmatch(r"s1 ([01])", text)) is not None:
            self._run(match[1] == "1" and not self.error)
            return "s1"
        return ""

    def _regulate(self, now: float) -> None:
        rate = self.up if self.target_c >= self.plant.set_point_c(now) else self.down
        self.plant.command(now, target_c=self.target_c, gradient_k_per_min=rate if rate < self._FREE else None)
