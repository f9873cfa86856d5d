"""Modbus messages as bytes: RTU frames with a CRC-16, and messages of Modbus TCP with a number. Pure.

Functions 3 and 4 read registers, 6 writes one, 16 several.
"""

import struct
from dataclasses import dataclass

from .checksums import crc16_modbus
from .errors import ChecksumError, FramingError, Rejected, printable
from .framing import Framer, ModbusReplyFramer, ModbusTcpFramer
from .request_reply import NotThisReply

EXCEPTIONS = {1: "function", 2: "register address", 3: "value", 4: "device failure", 5: "acknowledged", 6: "busy"}


def read_body(register: int, count: int = 1, function: int = 3) -> bytes:
    return struct.pack(">BHH", function, register, count)


def write_body(register: int, words: tuple[int, ...]) -> bytes:
    """Function 6 for one register, 16 for several."""
    if len(words) == 1:
        return struct.pack(">BHH", 6, register, words[0] & 0xFFFF)
    return struct.pack(f">BHHB{len(words)}H", 16, register, len(words), 2 * len(words), *words)


@dataclass(frozen=True)
class Rtu:
    """Frames of a serial line."""

    address: int

    def framer(self) -> Framer:
        return ModbusReplyFramer(self.address)

    def message(self, body: bytes) -> bytes:
        frame = bytes([self.address]) + body
        return frame + crc16_modbus(frame)

    def body(self, frame: bytes, sent: bytes) -> bytes:
        """Function and data of the reply to a frame. Raises for a wrong CRC and for an exception; ignores others'."""
        if len(frame) < 5 or crc16_modbus(frame[:-2]) != frame[-2:]:
            raise ChecksumError(f"The reply {frame.hex(' ')} fails its CRC. Check the line's shielding and ends.")
        if frame[0] != sent[0] or frame[1] & 0x7F != sent[1]:
            raise NotThisReply
        return _accepted(frame[1:-2])

    def asked(self, sent: bytes) -> bytes:
        return sent[1:-2]


class Tcp:
    """Messages of Modbus TCP: their number, the length of what follows, the unit's address, function and data."""

    def __init__(self, address: int) -> None:
        self._address, self._number = address, 0

    def framer(self) -> Framer:
        return ModbusTcpFramer()

    def message(self, body: bytes) -> bytes:
        self._number = self._number % 0xFFFF + 1
        return struct.pack(">HHHB", self._number, 0, len(body) + 1, self._address) + body

    def body(self, frame: bytes, sent: bytes) -> bytes:
        """Function and data of the reply to a message. Raises for an exception; ignores replies to other messages."""
        if frame[:2] != sent[:2] or frame[6] != sent[6] or frame[7] & 0x7F != sent[7]:
            raise NotThisReply
        return _accepted(frame[7:])

    def asked(self, sent: bytes) -> bytes:
        return sent[7:]


Modbus = Rtu | Tcp


def parse_words(modbus: Modbus, frame: bytes, sent: bytes, count: int) -> tuple[int, ...]:
    """The registers of a reply to function 3 or 4, unsigned."""
    data = modbus.body(frame, sent)[1:]
    if len(data) != 1 + 2 * count or data[0] != 2 * count:
        raise FramingError(f"The reply {printable(frame)!r} does not hold {count} registers.")
    return struct.unpack(f">{count}H", data[1:])


def parse_written(modbus: Modbus, frame: bytes, sent: bytes) -> None:
    """A write is acknowledged by the first five bytes of its body."""
    if modbus.body(frame, sent) != modbus.asked(sent)[:5]:
        raise FramingError(f"A write was acknowledged as {printable(frame)!r}; {printable(sent)!r} was sent.")


def _accepted(body: bytes) -> bytes:
    if body[0] & 0x80:
        meaning = EXCEPTIONS.get(body[1], "unknown")
        raise Rejected(f"It refuses: exception {body[1]} ({meaning}).", code=str(body[1]), text=meaning)
    return body
