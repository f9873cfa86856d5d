"""A simulated operator at a terminal: the person of the simulated laboratory, by the bytes of a line.

`slips` is the rate of typing errors; the answer to a repeated question is right. `always_types`: an angle, also where
Enter is asked for.
"""

import math
from collections.abc import Callable

import numpy as np

from gradcal_jax.hardware.clock import Clock
from gradcal_jax.hardware.simulate.lab import SimulatedHand, SimulatedPerson
from gradcal_jax.hardware.simulate.plants import AxisPlant


class SimulatedOperator:
    """One operator for all axes of a gimbal, by name."""

    def __init__(
        self,
        plants: dict[str, AxisPlant],
        clock: Clock,
        hand: SimulatedHand | None = None,
        hang: Callable[[int], None] | None = None,
        *,
        slips: float = 0.0,
    ) -> None:
        hand = hand or SimulatedHand()
        self.person = SimulatedPerson(clock, plants, hand, hang)
        self.heard: list[str] = []
        self.typed: list[str] = []
        self._random, self._slips, self._slipped = np.random.default_rng([hand.seed, 5]), slips, False
        self._text = ""
        self.always_types = False

    def receive(self, data: bytes) -> list[bytes]:
        self._text += data.decode("utf-8", "replace").replace("\a", "")
        *lines, self._text = self._text.split("\n")
        if self._text.endswith(": "):
            lines, self._text = [*lines, self._text], ""
        for line in lines:
            self._attend(line.strip())
        return []

    def next_emission_s(self) -> float | None:
        return self.person.answers_s if math.isfinite(self.person.answers_s) else None

    def emit(self, now_s: float) -> list[bytes]:
        answer = self.person.answer()
        if answer is None:
            return []
        text = answer[0] or "90 deg" * self.always_types
        self._slipped = bool(text) and not self._slipped and float(self._random.random()) < self._slips
        if self._slipped:
            text = text.replace(".", ",").replace("0", "o")
        self.typed.append(text)
        return [f"{text}\r".encode()]

    def _attend(self, line: str) -> None:
        if not line:
            return
        self.heard.append(line)
        if line.endswith("leave the axis where it is."):
            self.person.withdraw(line)
        elif line.endswith(":"):
            self.person.ask(line)
