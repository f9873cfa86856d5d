"""A simulated Watlow F4 on Modbus RTU: the peer of `drivers.watlow_f4`, written from the protocol.

Strict: it answers only frames with a sound CRC and its own address, refuses unknown registers (exception 2), set points
outside its limits (exception 3) and unknown functions (exception 1). A pause on the line ends a frame: what was left
unfinished for 50 ms of real time is forgotten.
"""

import time
from dataclasses import dataclass

import numpy as np

from gradcal_jax.hardware.checksums import crc16_modbus
from gradcal_jax.hardware.clock import Clock
from gradcal_jax.hardware.simulate.plants import ChamberPlant


@dataclass
class WatlowF4Options:
    address: int = 1
    decimals: int = 1
    low_c: float = -70.0
    high_c: float = 180.0
    fahrenheit: bool = False
    conditioning_event: int = 1
    """Event output that switches the plant in this rig; 0: the plant always runs."""


class SimulatedWatlowF4:
    def __init__(self, plant: ChamberPlant, clock: Clock, options: WatlowF4Options | None = None) -> None:
        self.plant = plant
        self.options = options or WatlowF4Options()
        self._clock = clock
        self._buffer = b""
        self._heard_s = 0.0
        self.bad_frames = 0
        self.writes: list[tuple[int, int]] = []
        scale = 10**self.options.decimals
        self.registers: dict[int, int] = {
            0: 5270,
            200: 0,
            201: 0,
            300: round(plant.truth.ambient_c * scale),
            319: 0,
            602: round(self.options.low_c * scale),
            603: round(self.options.high_c * scale),
            606: self.options.decimals,
            616: self.options.decimals,
            626: self.options.decimals,
            901: 0 if self.options.fahrenheit else 1,
            1061: 0,
            1217: 0,
            4122: 0,
        } | {2000 + 10 * (event - 1): 0 for event in range(1, 9)}
        plant.switch(clock.now(), self.options.conditioning_event == 0)

    def receive(self, data: bytes) -> list[bytes]:
        if time.monotonic() - self._heard_s > 0.05:
            self._buffer = b""
        self._heard_s = time.monotonic()
        self._buffer += data
        replies: list[bytes] = []
        while len(self._buffer) >= 8:
            length = 9 + self._buffer[6] if self._buffer[1] == 16 else 8
            if len(self._buffer) < length:
                break
            frame, rest = self._buffer[:length], self._buffer[length:]
            if crc16_modbus(frame[:-2]) != frame[-2:]:
                self.bad_frames += 1
                self._buffer = self._buffer[1:]
                continue
            self._buffer = rest
            if frame[0] == self.options.address:
                body = self._answer(frame[1], frame[2:-2])
                replies.append(bytes([frame[0]]) + body + crc16_modbus(bytes([frame[0]]) + body))
        return replies

    def trip_limit(self, tripped: bool = True) -> None:
        """The limit controller's contact on digital input 1: the plant is switched off by hardware."""
        self.registers[201] = int(tripped)
        if tripped:
            self.plant.switch(self._clock.now(), False)

    def reboot(self) -> None:
        self._buffer = b""
        for event in range(1, 9):
            self.registers[2000 + 10 * (event - 1)] = 0
        self.plant.switch(self._clock.now(), self.options.conditioning_event == 0)

    # -------------------------------------------------------------------------------------------------------- parts

    def _answer(self, function: int, body: bytes) -> bytes:
        register, value = int.from_bytes(body[:2], "big"), int.from_bytes(body[2:4], "big")
        if function in (3, 4):
            if not 1 <= value <= 125:
                return bytes([function | 0x80, 3])
            words = [self._value(register + index) for index in range(value)]
            if any(word is None for word in words):
                return bytes([function | 0x80, 2])
            data = b"".join((word & 0xFFFF).to_bytes(2, "big") for word in words if word is not None)
            return bytes([function, len(data)]) + data
        if function == 6:
            refusal = self._write(register, value)
            return bytes([0x86, refusal]) if refusal else bytes([6]) + body
        if function == 16:
            values = [int.from_bytes(body[5 + 2 * i : 7 + 2 * i], "big") for i in range(value)]
            for index, word in enumerate(values):
                if refusal := self._write(register + index, word):
                    return bytes([0x90, refusal])
            return bytes([16]) + body[:4]
        return bytes([function | 0x80, 1])

    def _value(self, register: int) -> int | None:
        now, scale = self._clock.now(), 10**self.options.decimals
        if register == 100:
            return round(self.plant.air_c(now) * scale)
        if register in (104, 108):
            return round(float(self.plant.load_at(np.array([now]))[0]) * scale)
        return self.registers.get(register)

    def _write(self, register: int, word: int) -> int:
        if register not in self.registers or register in (0, 606, 616, 626, 201):
            return 2
        value = word - 65536 if word >= 32768 else word
        if register == 300 and not self.registers[602] <= value <= self.registers[603]:
            return 3
        self.registers[register] = value
        self.writes.append((register, value))
        now, event = self._clock.now(), self.options.conditioning_event
        if register == 300:
            self.plant.command(now, target_c=value / 10**self.options.decimals)
        elif register == 1217 and value == 1:
            self.registers[200] = 0
        elif event and register == 2000 + 10 * (event - 1):
            self.plant.switch(now, value != 0 and not self.registers[201])
        return 0
