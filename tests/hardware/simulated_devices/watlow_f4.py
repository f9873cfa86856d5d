"""A simulated Watlow F4 on Modbus RTU. Set points outside its limits are refused (exception 3)."""

from dataclasses import dataclass

import numpy as np
from simulated_devices.modbus import ModbusSlave

from gradcal_jax.hardware.clock import Clock
from gradcal_jax.hardware.simulate.plants import ChamberPlant


@dataclass
class WatlowF4Options:
    decimals: int = 1
    low_c: float = -70.0
    high_c: float = 180.0
    fahrenheit: bool = False
    conditioning_event: int = 1
    """Event output that switches the plant in this rig; 0: the plant always runs."""


class SimulatedWatlowF4(ModbusSlave):
    read_only = frozenset({0, 606, 616, 626, 201})

    def __init__(self, plant: ChamberPlant, clock: Clock, options: WatlowF4Options | None = None) -> None:
        self.plant = plant
        self.options = options or WatlowF4Options()
        self._clock = clock
        self.writes: list[tuple[int, int]] = []
        places = self.options.decimals
        self._scale = 10**places
        limits = {602: round(self.options.low_c * self._scale), 603: round(self.options.high_c * self._scale)}
        words = {0: 5270, 200: 0, 201: 0, 300: round(plant.truth.ambient_c * self._scale), 319: 0, **limits}
        words |= {606: places, 616: places, 626: places, 901: 0 if self.options.fahrenheit else 1}
        words |= dict.fromkeys((1061, 1217, 4122, *range(2000, 2080, 10)), 0)
        super().__init__(words)
        plant.switch(clock.now(), self.options.conditioning_event == 0)

    def trip_limit(self, tripped: bool = True) -> None:
        """The limit controller's contact on digital input 1: the plant is switched off by hardware."""
        self.words[201] = int(tripped)
        if tripped:
            self.plant.switch(self._clock.now(), False)

    def reboot(self) -> None:
        self._buffer = b""
        self.words |= dict.fromkeys(range(2000, 2080, 10), 0)
        self.plant.switch(self._clock.now(), self.options.conditioning_event == 0)

    def word(self, register: int) -> int | None:
        now = self._clock.now()
        if register == 100:
            return round(self.plant.air_c(now) * self._scale)
        if register in (104, 108):
            return round(float(self.plant.load_at(np.array([now]))[0]) * self._scale)
        return self.words.get(register)

    def write(self, register: int, values: tuple[int, ...]) -> int:
        for place, word in enumerate(values, register):
            value = word - 65536 if word >= 32768 else word
            if place == 300 and not self.words[602] <= value <= self.words[603]:
                return 3
            self.words[place] = value
            self.writes.append((place, value))
            now, event = self._clock.now(), self.options.conditioning_event
            if place == 300:
                self.plant.command(now, target_c=value / self._scale)
            elif place == 1217 and value == 1:
                self.words[200] = 0
            elif event and place == 2000 + 10 * (event - 1):
                self.plant.switch(now, value != 0 and not self.words[201])
        return 0
