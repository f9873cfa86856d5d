"""A simulated ESPEC P-300 chamber: the peer of `drivers.espec`, written from the protocol.

Strict: it does not answer before CR LF, refuses set points outside its alarm limits, refuses program commands when no
program runs, and changes its state only after its `OK`. With `echo_off` it is silent, as an EHS with that setting.
"""

import re
from dataclasses import dataclass

from gradcal_jax.hardware.clock import Clock
from gradcal_jax.hardware.simulate.plants import ChamberPlant


@dataclass
class EspecOptions:
    address: int | None = None
    knows_detail: bool = True
    echo_off: bool = False
    decimals: int = 1
    blanks: bool = False
    """After commas of a reply."""
    high_c: float = 140.0
    low_c: float = -50.0


class SimulatedEspec:
    def __init__(self, plant: ChamberPlant, clock: Clock, options: EspecOptions | None = None) -> None:
        self.plant = plant
        self.options = options or EspecOptions()
        self._clock = clock
        self._buffer = b""
        self.mode = "STANDBY"
        self.constant_c = plant.truth.ambient_c
        self.alarms: list[int] = []
        self._program_end_s: float | None = None
        self.commands: list[str] = []

    def receive(self, data: bytes) -> list[bytes]:
        self._buffer += data
        replies: list[bytes] = []
        while b"\r\n" in self._buffer:
            line, _, self._buffer = self._buffer.partition(b"\r\n")
            text = line.decode("latin-1").strip()
            if self.options.address is not None:
                prefix, comma, text = text.partition(",")
                if not comma or prefix.strip() != str(self.options.address):
                    continue
            self.commands.append(text)
            if text.endswith("?") or "?," in text:
                reply = self._query(text)
            else:
                refusal = self._command(text.replace(" ,", ","))
                reply = f"NA:{refusal}" if refusal else f"OK:{text}"
            if not self.options.echo_off:
                replies.append(reply.encode("ascii") + b"\r\n")
        return replies

    def raise_alarm(self, code: int) -> None:
        """Raise an alarm: the chamber stops conditioning and shows the code."""
        self.alarms.append(code)
        self._enter("OFF")

    def reboot(self) -> None:
        """Power cut and back: off, at the default set point, no program."""
        self._buffer = b""
        self._program_end_s = None
        self._enter("OFF")

    def _query(self, text: str) -> str:
        now = self._clock.now()
        air = self.plant.air_c(now)
        set_point = self.plant.set_point_c(now) if self.mode == "RMT RUN" else self.constant_c
        name, _, argument = text.partition("?")
        argument = argument.lstrip(",").strip()
        detail = argument == "DETAIL"
        if detail and not self.options.knows_detail:
            return "NA:PARA ERR"
        mode = self._mode(now, detail)

        def number(value: float) -> str:
            return f"{value:.{self.options.decimals}f}"

        answers = {
            "ROM": "P3S1.10" if not argument else "P3D1.05",
            "TYPE": "T,P300,140.0",
            "MODE": mode,
            "MON": f"{number(air)},,{mode},{len(self.alarms)}",
            "TEMP": ",".join(map(number, (air, set_point, self.options.high_c, self.options.low_c))),
            "HUMI": "NA:CONT NOT READY-1",
            "ALARM": ",".join(map(str, [len(self.alarms), *self.alarms])),
        }
        answer = answers.get(name, "NA:CMD ERR")
        return answer.replace(",", ", ") if self.options.blanks else answer

    def _command(self, text: str) -> str:
        """Execute a command and return an empty text; or return a refusal and change nothing."""
        if (match := re.fullmatch(r"TEMP,\s*(.+)", text)) is not None:
            return self._temperature(match[1])
        if (match := re.fullmatch(r"MODE,\s*(OFF|STANDBY|CONSTANT)", text)) is not None:
            self._enter(match[1])
            return ""
        if text.startswith("MODE,"):
            return "DATA NOT READY" if "RUN" in text else "PARA ERR"
        if text.startswith("HUMI,"):
            return "CONT NOT READY-1"
        if text.startswith("RUN PRGM,"):
            return self._remote_program(text)
        if (
            match := re.fullmatch(r"PRGM,\s*(PAUSE|CONTINUE|ADVANCE|END,\s*(?:HOLD|CONST|OFF|STANDBY))", text)
        ) is not None:
            if not self._mode(self._clock.now(), True).startswith("RMT RUN"):
                return "CONT NOT READY-2"
            if match[1].startswith("END"):
                end = match[1].split(",")[1].strip()
                self._enter({"CONST": "CONSTANT", "HOLD": "CONSTANT"}.get(end, end))
            return ""
        return "CMD ERR"

    def _temperature(self, words: str) -> str:
        new = {"S": self.constant_c, "H": self.options.high_c, "L": self.options.low_c}
        for word in words.split():
            match = re.fullmatch(r"([SHL])(-?\d+(?:\.\d+)?)", word)
            if match is None:
                return "PARA ERR"
            new[match[1]] = round(float(match[2]), 1)
        if not new["L"] <= new["S"] <= new["H"]:
            return "DATA OUT OF RANGE"
        self.constant_c, self.options.high_c, self.options.low_c = new["S"], new["H"], new["L"]
        if self.mode == "CONSTANT":
            self.plant.command(self._clock.now(), target_c=self.constant_c)
        return ""

    def _remote_program(self, text: str) -> str:
        match = re.fullmatch(
            r"RUN PRGM,\s*TEMP(-?\d+(?:\.\d)?)\s+TIME(\d{1,2}):(\d\d)(?:\s+GOTEMP(-?\d+(?:\.\d)?))?(?:\s+REF\d)?", text
        )
        if match is None or int(match[3]) > 59:
            return "PARA ERR"
        start, end = float(match[1]), float(match[4] or match[1])
        if not all(self.options.low_c <= value <= self.options.high_c for value in (start, end)):
            return "DATA OUT OF RANGE"
        minutes = 60 * int(match[2]) + int(match[3])
        if minutes == 0:
            return "PARA ERR"
        now = self._clock.now()
        self.plant.move_set_point(now, start)
        self.plant.command(now, target_c=end, gradient_k_per_min=abs(end - start) / minutes)
        self.plant.switch(now, True)
        self.mode, self._program_end_s = "RMT RUN", now + 60.0 * minutes
        return ""

    def _enter(self, mode: str) -> None:
        now = self._clock.now()
        self.mode, self._program_end_s = mode, None
        if mode == "CONSTANT":
            self.plant.command(now, target_c=self.constant_c)
        self.plant.switch(now, mode == "CONSTANT")

    def _mode(self, now: float, detail: bool) -> str:
        if self.mode != "RMT RUN":
            return self.mode
        if not detail:
            return "RUN"
        return "RMT RUN" if self._program_end_s is not None and now < self._program_end_s else "RMT RUN END HOLD"
