"""A simulated Weiss / Vötsch chamber with ASCII-2: the peer of `drivers.weiss`, written from the protocol.

Layouts of 14, 16 and 11 numbers; a self-description in the old form (`DO00 DO01`) or the new one (joined, and broken
over lines within a name); acknowledges with `0` or not at all; while a gradient runs the nominal value moves. Strings
that come faster than the manual allows (on the run's clock) are counted, and with `strict` left unanswered.
"""

import re
from dataclasses import dataclass
from typing import Literal

import numpy as np

from gradcal_jax.hardware.clock import Clock
from gradcal_jax.hardware.simulate.plants import ChamberPlant

_LAYOUTS: dict[int, tuple[str, str]] = {
    14: (
        "CV01 CV02 SV01 MV01 MV02 MV03 MV04",
        " ".join(f"{c} {c}" for c in ["CV01", "CV02", "SV01", "MV01", "MV02", "MV03", "MV04"]),
    ),
    16: (
        "CV01 CV02 CV03 SV01 MV01 MV02 MV03 MV04",
        "CV01 CV01 CV02 CV02 CV03 CV03 SV01 SV02 MV01 MV01 MV02 MV02 MV03 MV03 MV04 MV04",
    ),
    11: ("CV01 CV02 SV01 SV02 SV03", "CV01 CV01 CV02 CV02 SV01 SV02 SV03 MV01 MV02 MV03 MV04"),
}
_NUMBER = re.compile(r"-?\d+(?:\.\d+)?")


@dataclass
class WeissOptions:
    address: int = 1
    numbers: Literal[11, 14, 16] = 14
    joined_description: bool = True
    describes_itself: bool = True
    acknowledges: bool = True
    interval_s: float = 5.0
    strict: bool = False
    lowest_c: float = -72.0
    highest_c: float = 182.0
    digital: str = "00" + "1" + "0" * 29
    """Digital channels at power-on; channel 1 starts the chamber, the others are the lab's options."""


class SimulatedWeiss:
    def __init__(self, plant: ChamberPlant, clock: Clock, options: WeissOptions | None = None) -> None:
        self.plant = plant
        self.options = options or WeissOptions()
        self._clock = clock
        self._buffer = b""
        self._writes, self._reads = (line.split() for line in _LAYOUTS[self.options.numbers])
        self.nominal = dict.fromkeys(self._reads, 0.0) | {"CV01": plant.truth.ambient_c, "CV02": 50.0, "SV01": 80.0}
        self.digital = self.options.digital
        self.gradients = (0.0, 0.0)
        self.throttle_violations = 0
        self._last_string_s = -1e9

    def receive(self, data: bytes) -> list[bytes]:
        self._buffer += data
        replies: list[bytes] = []
        while b"\r" in self._buffer:
            line, _, self._buffer = self._buffer.partition(b"\r")
            text = line.decode("latin-1").lstrip("\n")
            match = re.fullmatch(r"\$(\d\d)([IEUFQ?])(?: (.*))?", text)
            if match is not None and int(match[1]) != self.options.address:
                continue
            too_soon = self._too_soon()
            reply = self._answer(match[2], match[3] or "") if match is not None else "ERROR: unknown command"
            if reply is not None and not (too_soon and self.options.strict):
                replies.append(reply.encode("ascii") + b"\r")
        return replies

    def reboot(self) -> None:
        self._buffer = b""
        self.digital, self.gradients = self.options.digital, (0.0, 0.0)
        self.plant.switch(self._clock.now(), False)

    # -------------------------------------------------------------------------------------------------------- parts

    def _too_soon(self) -> bool:
        now = self._clock.now()
        early = now - self._last_string_s < self.options.interval_s - 1e-6
        self._last_string_s = now
        self.throttle_violations += early
        return early

    def _answer(self, letter: str, body: str) -> str | None:
        if letter == "I":
            return self._record()
        if letter == "E":
            return self._write(body)
        if letter == "U":
            return self._gradient(body)
        if letter == "?":
            return self._description() if self.options.describes_itself else None
        return "0"

    def _record(self) -> str:
        now = self._clock.now()
        seen: set[str] = set()
        values: list[float] = []
        for name in self._reads:
            first = name not in seen and self._reads.count(name) == 2
            seen.add(name)
            if name == "CV01":
                values.append(self.plant.set_point_c(now) if first else self.plant.air_c(now))
            elif name == "MV01" and not first:
                values.append(float(self.plant.load_at(np.array([now]))[0]))
            elif name.startswith("MV"):
                values.append(0.0 if first else self.plant.air_c(now))
            else:
                values.append(self.nominal[name])
        return " ".join([*(f"{value:06.1f}" for value in values), self.digital])

    def _write(self, body: str) -> str | None:
        *numbers, digital = body.split(" ")
        if len(numbers) != len(self._writes) or re.fullmatch("[01]{32}", digital) is None:
            return "ERROR: wrong number of values"
        if not all(_NUMBER.fullmatch(text) and len(text) == 6 for text in numbers):
            return "ERROR: number format"
        values = dict(zip(self._writes, map(float, numbers), strict=True))
        if not self.options.lowest_c <= values["CV01"] <= self.options.highest_c:
            return "ERROR: CV01 out of range"
        self.nominal |= values
        self.digital = digital
        now = self._clock.now()
        up, down = self.gradients
        if not up and not down:
            self.plant.command(now, target_c=values["CV01"])
        else:
            warming = values["CV01"] >= self.plant.set_point_c(now)
            gradient = up if warming else down
            # A gradient in the other direction than the one that is set does not bind.
            self.plant.command(now, target_c=values["CV01"], gradient_k_per_min=gradient or None)
        self.plant.switch(now, digital[1] == "1")
        return "0" if self.options.acknowledges else None

    def _gradient(self, body: str) -> str | None:
        fields = body.split(" ")
        if len(fields) != 4 or not all(_NUMBER.fullmatch(field) for field in fields):
            return "ERROR: four gradients expected"
        self.gradients = (float(fields[0]), float(fields[1]))
        return "0" if self.options.acknowledges else None

    def _description(self) -> str:
        digital = [f"DO{index:02d}" for index in range(32)]

        def template(names: list[str]) -> str:
            if not self.options.joined_description:
                return " ".join([*names, *digital])
            text = " ".join(names) + " " + "".join(digital)
            # The controller breaks its lines after 60 characters, wherever that is.
            return "\r\n".join(text[i : i + 60] for i in range(0, len(text), 60))

        ranges = f"CV01  value min: {self.options.lowest_c} value max: {self.options.highest_c} Temperature"
        return "\r\n".join(
            [
                "ASCII-2 PROTOCOL CONFIGURATION",
                "Configuration type: DYNAMIC",
                "E-String",
                template(self._writes),
                "I-String",
                template(self._reads),
                ranges,
                "CV02  value min: 0.0 value max: 98.0 Humidity",
                "SV01  value min: 25 value max: 100 Option",
                "DO00 unused",
                "DO01 Start",
                "DO02 Custom Out1",
                "DO06 Cond.protect",
            ]
        )
