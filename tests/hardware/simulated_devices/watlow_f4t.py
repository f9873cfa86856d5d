"""A simulated Watlow F4T on Modbus TCP, with the state that the controller has.

While its control loop is off it takes set points and does nothing with them, also once the loop is on again. A set
point that is written while the loop is on is gone to at once, or by the ramp where the ramp's action says so. Set
points outside its limits are refused (exception 3).
"""

import struct

from simulated_devices.modbus import ModbusSlave

_OFF, _AUTO = 62, 10
_LOW_C, _HIGH_C = -70.0, 180.0


class SimulatedWatlowF4T(ModbusSlave):
    """`locked`: an input at the back keeps the control loop off."""

    read_only = frozenset({2810, 2814, 2820, 1356})

    def __init__(self, plant, clock):
        self.plant, self._clock, self.locked = plant, clock, False
        words = {4: 4, 12: 0xE240, 13: 1, 2730: _OFF, 2794: _OFF, 2796: 57, 2814: _OFF, 16566: 61, 16568: 251, 6730: 15}
        words |= {1356 + 100 * number: 88 for number in range(6)}
        super().__init__(words, tcp=True)
        for register, value in {2774: _LOW_C, 2776: _HIGH_C, 2782: 23.0, 2798: 1.0, 2810: 0.0, 2820: 0.0}.items():
            self.put(register, value)
        self._switch()

    def put(self, register, value):
        """A float, its low word first."""
        bits = int.from_bytes(struct.pack(">f", value), "big")
        self.words |= {register: bits & 0xFFFF, register + 1: bits >> 16}

    def get(self, register):
        bits = self.words[register + 1] << 16 | self.words[register]
        return struct.unpack(">f", bits.to_bytes(4, "big"))[0]

    def reboot(self):
        """The loop comes back off."""
        self._buffer = b""
        self.words |= {2730: _OFF, 2814: _OFF}
        self._switch()

    def word(self, register):
        # Both words of a number are of one instant.
        if register == 2820:
            self.put(2820, self.plant.at(self._clock.now()).air_c)
        elif register == 2810:
            self.put(2810, self.plant.at(self._clock.now()).set_point_c)
        return self.words.get(register)

    def write(self, register, values):
        before, now = dict(self.words), self._clock.now()
        super().write(register, values)
        if register == 2782:
            target = self.get(2782)
            if not _LOW_C <= target <= _HIGH_C:
                self.words |= before
                return 3
            if self.words[2814] == _AUTO:
                ramps = self.words[2794] in (85, 13)
                per_minute = self.get(2798) / (1.0 if self.words[2796] == 57 else 60.0)
                self.plant.command(now, target_c=target, gradient_k_per_min=per_minute if ramps else None)
        elif register == 2730:
            self.words[2814] = _OFF if self.locked else values[0]
        elif register == 16566 and values[0] == 148:
            self.words[16568] = 253
        self._switch()
        return 0

    def _switch(self):
        self.plant.at(self._clock.now()).conditioning = self.words[2814] == _AUTO
