"""A simulated CTS chamber, which speaks in framed lines, with what it remembers.

Written from the protocol's public description (see the head of `spec/presets/devices/cts.toml`), not from the driver.
"""

import re
from functools import reduce


class SimulatedCts:
    """Framed by STX, address, check and ETX; what fails its check is not answered. Rates of ramps outlive a stop; the
    set value that A0 shows is the one that is regulated to now; the target is in R1."""

    _FREE = 999.9

    def __init__(self, plant, clock, address=129):
        self.plant, self._clock, self._address = plant, clock, address
        self._buffer, self.running = b"", False
        self.up = self.down = self._FREE
        self.target_c = plant.truth.ambient_c
        self.limits_c = (-40.0, 180.0)

    def receive(self, data):
        *frames, self._buffer = (self._buffer + data).split(b"\x03")
        return [self._framed(reply) for reply in map(self._line, frames) if reply]

    def reboot(self):
        self._buffer = b""
        self._run(False)

    def _run(self, on):
        self.running = on
        self.plant.at(self._clock.now()).conditioning = on

    def _framed(self, text):
        body = bytes([self._address, *(ord(letter) | 0x80 for letter in text)])
        return b"\x02" + body + bytes([reduce(lambda a, b: a ^ b, body) | 0x80, 3])

    def _line(self, line):
        begins = line.rfind(b"\x02")
        body = line[begins + 1 :]
        sound = begins >= 0 and len(body) > 2 and body[0] == self._address and all(byte & 0x80 for byte in body)
        if not sound or (reduce(lambda a, b: a ^ b, body[:-1]) | 0x80) != body[-1]:
            return ""
        return self._answer("".join(chr(byte & 0x7F) for byte in body[1:-1]))

    def _answer(self, text):
        now = self._clock.now()
        if text == "A0":
            return f"A0 {self.plant.at(now).air_c:05.1f} {self.plant.set_point_c:05.1f}"
        if text == "R1":
            on = int(min(self.up, self.down) < self._FREE)
            return f"R1 {on}{on * int(self.running)} {self.up:07.2f} {self.down:07.2f} {self.target_c:07.2f}"
        if text == "S":
            return f"S{int(self.running)}01000000"
        if (match := re.fullmatch(r"a0 (-?\d+\.\d)", text)) is not None:
            low, high = self.limits_c
            if low <= float(match[1]) <= high:
                self.target_c = float(match[1])
                self._regulate(now)
            return "a"
        if (match := re.fullmatch(r"([ud])1 (\d{3}\.\d)", text)) is not None:
            setattr(self, "up" if match[1] == "u" else "down", float(match[2]))
            return match[1]
        if (match := re.fullmatch(r"s1 ([01])", text)) is not None:
            self._run(match[1] == "1")
            return "s1"
        return ""

    def _regulate(self, now):
        rate = self.up if self.target_c >= self.plant.at(now).set_point_c else self.down
        self.plant.command(now, target_c=self.target_c, gradient_k_per_min=rate if rate < self._FREE else None)
