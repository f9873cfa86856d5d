"""A simulated operator at a terminal, who turns a gimbal: the peer of `drivers.operator`, parsing its questions.

The operator reacts after a while, turns unevenly, misses the mark by a little, reads the dial (to its digits) when it
stands, and types its angle. `slips` is the rate of typing errors; the answer to a repeated question is right. Asked to
hang the units anew, the operator calls `hang` with the number of the mounting and presses Enter.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gradcal_jax.hardware.clock import Clock
from gradcal_jax.hardware.simulate.plants import AxisPlant

_TURN = re.compile(r"([\w-]+): turn (?:by \S+ deg in (\S+) s, )?to (\S+) deg")
_ZERO = re.compile(r"([\w-]+): bring it to its zero mark")
_AGAIN = re.compile(r"([\w-]+): .*(?:again to confirm|Type the angle that its scale shows):$")
_HANG = re.compile(r"mount the IMUs as follows: mounting (\d+)")
_HOME_S = 5.0
_HANGS_S = 120.0


@dataclass
class OperatorOptions:
    """`slips`: the fraction of mistyped answers. `digits`: decimals of the dial, in degrees."""

    reaction_s: float = 1.5
    reading_s: float = 2.0
    miss_deg: float = 0.3
    pace_spread: float = 0.1
    digits: int = 3
    slips: float = 0.0
    types_angles: bool = True
    seed: int = 0


class SimulatedOperator:
    """One operator for all axes of a gimbal, by name."""

    def __init__(
        self,
        plants: dict[str, AxisPlant],
        clock: Clock,
        options: OperatorOptions | None = None,
        hang: Callable[[int], None] | None = None,
    ) -> None:
        self.options = options or OperatorOptions()
        self.heard: list[str] = []
        self.typed: list[str] = []
        self._plants, self._clock = plants, clock
        self._random = np.random.default_rng([self.options.seed, 4])
        self._text = ""
        self._axis = ""
        self._types_s: float | None = None
        self._slipped = False
        self._hang, self._mounting = hang, 0

    def receive(self, data: bytes) -> list[bytes]:
        self._text += data.decode("utf-8", "replace").replace("\a", "")
        *lines, self._text = self._text.split("\n")
        for line in lines:
            self._attend(line.strip())
        if self._text.endswith(": "):
            self._attend(self._text.strip())
            self._text = ""
        return []

    def next_emission_s(self) -> float | None:
        return self._types_s

    def emit(self, now_s: float) -> list[bytes]:
        if self._types_s is None or now_s < self._types_s:
            return []
        self._types_s = None
        answer = ""
        if self._mounting:
            if self._hang is not None:
                self._hang(self._mounting)
            self._mounting = 0
        elif self.options.types_angles:
            shown = self._plants[self._axis].reading(now_s) % 360.0
            answer = f"{shown:.{self.options.digits}f} deg"
            self._slipped = not self._slipped and float(self._random.random()) < self.options.slips
            if self._slipped:
                answer = answer.replace(".", ",").replace("0", "o")
        self.typed.append(answer)
        return [f"{answer}\r".encode()]

    def _attend(self, line: str) -> None:
        if not line:
            return
        self.heard.append(line)
        options, random, now = self.options, self._random, self._clock.now()
        if line.endswith("leave the axis where it is."):
            self._types_s, self._mounting = None, 0
        elif anew := _HANG.search(line):
            self._mounting, self._types_s = int(anew[1]), now + _HANGS_S
        elif turn := _TURN.match(line):
            begins = now + options.reaction_s * float(random.lognormal(0.0, 0.3))
            planned = _HOME_S if turn[2] is None else float(turn[2])
            ends = begins + planned * max(0.5, 1.0 + options.pace_spread * float(random.standard_normal()))
            self._turn(turn[1], float(turn[3]), begins, ends)
        elif zero := _ZERO.match(line):
            plant = self._plants[zero[1]]
            nearest = 360.0 * round(plant.state(now)[0] / 360.0)
            # At the zero mark the angle becomes zero, without whole turns.
            plant.set_zero(now, plant.state(now)[0] - nearest)
            self._turn(zero[1], 0.0, now + options.reaction_s, now + options.reaction_s + _HOME_S)
        elif again := _AGAIN.match(line):
            self._axis, self._types_s = again[1], now + options.reading_s

    def _turn(self, name: str, target_deg: float, begins_s: float, ends_s: float) -> None:
        miss = self.options.miss_deg * float(self._random.standard_normal())
        plant = self._plants[name]
        plant.turn_by_hand(begins_s, target_deg + miss, ends_s - begins_s)
        self._axis, self._types_s = name, ends_s + self.options.reading_s
