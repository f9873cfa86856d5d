"""A simulated ESPEC P-300 chamber, written from the protocol.

Strict: it does not answer before CR LF, refuses set points outside its alarm limits, and changes its state only after
its `OK`.
"""

import re


class SimulatedEspec:
    def __init__(self, plant, clock, *, high_c=140.0, low_c=-50.0):
        self.plant, self.high_c, self.low_c, self._clock = plant, high_c, low_c, clock
        self._buffer, self.mode = b"", "STANDBY"
        self.constant_c = plant.truth.ambient_c
        self.alarms = []
        self.commands = []

    def receive(self, data):
        *lines, self._buffer = (self._buffer + data).split(b"\r\n")
        replies = [reply for reply in map(self._line, lines) if reply]
        return [reply.encode("ascii") + b"\r\n" for reply in replies]

    def raise_alarm(self, code):
        """Raise an alarm: the chamber stops conditioning and shows the code."""
        self.alarms.append(code)
        self._enter("OFF")

    def reboot(self):
        """Power cut and back: off."""
        self._buffer = b""
        self._enter("OFF")

    def run_program(self, end_c):
        """Somebody starts a program at the panel."""
        self.mode = "RUN"
        self.plant.command(self._clock.now(), target_c=end_c, gradient_k_per_min=0.5)
        self.plant.conditioning = True

    def _line(self, line):
        text = line.decode("latin-1").strip()
        self.commands.append(text)
        if "?" in text:
            return self._answer(text)
        refusal = self._command(text)
        return f"NA:{refusal}" if refusal else f"OK:{text}"

    def _answer(self, text):
        now = self._clock.now()
        plant = self.plant.at(now)
        set_point = plant.set_point_c if self.mode == "RUN" else self.constant_c
        temperatures = (plant.air_c, set_point, self.high_c, self.low_c)
        answers = {
            "ROM?": "P3S1.10",
            "TYPE?": "T,P300,140.0",
            "MODE?,DETAIL": self.mode,
            "TEMP?": ",".join(f"{value:.1f}" for value in temperatures),
            "ALARM?": ",".join(map(str, [len(self.alarms), *self.alarms])),
        }
        return answers.get(text, "NA:CMD ERR")

    def _command(self, text):
        """Execute a command and return an empty text; or return a refusal and change nothing."""
        if (match := re.fullmatch(r"TEMP, S(-?\d+(?:\.\d+)?)", text)) is not None:
            if not self.low_c <= float(match[1]) <= self.high_c:
                return "DATA OUT OF RANGE"
            self.constant_c = round(float(match[1]), 1)
            if self.mode == "CONSTANT":
                self.plant.command(self._clock.now(), target_c=self.constant_c)
            return ""
        if (match := re.fullmatch(r"MODE,\s*(OFF|STANDBY|CONSTANT)", text)) is not None:
            self._enter(match[1])
            return ""
        return "CMD ERR"

    def _enter(self, mode):
        now, self.mode = self._clock.now(), mode
        if mode == "CONSTANT":
            self.plant.command(now, target_c=self.constant_c)
        self.plant.at(now).conditioning = mode == "CONSTANT"
