"""Messages of Modbus RTU and TCP, of functions 3, 4, 6 and 16, to the device of an address.

A message is the number, address and checksum of its transport about a body: the function and its data.
"""

import struct
from abc import ABC, abstractmethod

from gradcal_jax.hardware.checksums import crc16_modbus
from gradcal_jax.hardware.errors import Rejected

EXCEPTIONS = {1: "function", 2: "register address", 3: "value", 4: "device failure", 5: "acknowledged", 6: "busy"}


def read_body(register: int, count: int = 1, function: int = 3) -> bytes:
    return struct.pack(">BHH", function, register, count)


def write_body(register: int, words: tuple[int, ...]) -> bytes:
    """Function 6 for one register, 16 for several."""
    if len(words) == 1:
        return struct.pack(">BHH", 6, register, words[0] & 0xFFFF)
    return struct.pack(f">BHHB{len(words)}H", 16, register, len(words), 2 * len(words), *words)


def words_of(reply: bytes) -> tuple[int, ...]:
    """The registers in the body of a reply to function 3 or 4, unsigned."""
    return struct.unpack(f">{reply[1] // 2}H", reply[2:])


def expected(body: bytes) -> bytes:
    """How the body of a reply begins: a write is acknowledged by the first five bytes of its body, and registers follow
    their function and number of bytes."""
    return body[:5] if body[0] in (6, 16) else bytes([body[0], 2 * body[4] & 0xFF])


def reply_length(body: bytes) -> int:
    return 5 if body[0] in (6, 16) else 2 + 2 * body[4]


class Modbus(ABC):
    def __init__(self, address: int) -> None:
        self._address = bytes([address])

    @abstractmethod
    def message(self, body: bytes) -> bytes: ...

    @abstractmethod
    def reply(self, received: bytes, body: bytes) -> bytes | None:
        """The body of the reply to the newest message, whose body was `body`, among bytes; None: it is not there.
        Raises `Rejected` for an exception."""

    def _reply(self, said: bytes, body: bytes) -> bytes | None:
        """The reply whose body begins here, if it is one."""
        if said[:1] == bytes([body[0] | 0x80]) and len(said) > 1:
            meaning = EXCEPTIONS.get(said[1], "unknown")
            raise Rejected(f"It refuses: exception {said[1]} ({meaning}).")
        return said if len(said) == reply_length(body) and said.startswith(expected(body)) else None


class Rtu(Modbus):
    def message(self, body: bytes) -> bytes:
        return self._address + body + crc16_modbus(self._address + body)

    def reply(self, received: bytes, body: bytes) -> bytes | None:
        for start in range(len(received) - 4):
            refused = received[start + 1] == body[0] | 0x80
            end = start + 3 + (2 if refused else reply_length(body))
            frame = received[start:end]
            sound = frame[:1] == self._address and crc16_modbus(frame[:-2]) == frame[-2:]
            if sound and (said := self._reply(frame[1:-2], body)) is not None:
                return said
        return None


class Tcp(Modbus):
    """A message is its number, the length of what follows, the unit's address, and the body."""

    _number = 0

    def message(self, body: bytes) -> bytes:
        self._number = self._number % 0xFFFF + 1
        return struct.pack(">HHH", self._number, 0, len(body) + 1) + self._address + body

    def reply(self, received: bytes, body: bytes) -> bytes | None:
        start = received.find(struct.pack(">HH", self._number, 0))
        head = received[start : start + 7]
        end = start + 6 + int.from_bytes(head[4:6], "big")
        if start < 0 or len(head) < 7 or head[6:] != self._address or len(received) < end:
            return None
        return self._reply(received[start + 7 : end], body)
