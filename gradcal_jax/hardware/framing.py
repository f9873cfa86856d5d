"""From a stream of bytes to messages: pure, without ports and clocks. Also the messages of Modbus RTU and TCP.

A framer takes chunks of any size and returns whole frames, independent of how the stream was cut into chunks. Framers
of a single device (datagrams, packets) are beside its codec; this module has those that several devices share.
"""

import struct
from abc import ABC, abstractmethod
from dataclasses import dataclass

from gradcal_jax.hardware.checksums import crc16_modbus
from gradcal_jax.hardware.errors import ChecksumError, FramingError, Rejected, printable

# Unit, function and an exception's code; and the longest message.
_SHORTEST_TCP, _LONGEST_TCP = 3, 254
_LONGEST_LINE = 4096
_LONGEST_MODBUS = 261


class NotThisReply(Exception):
    """Raised by a reply parser for a sound frame that answers another request: the exchange continues to wait."""


class Framer(ABC):
    def __init__(self) -> None:
        self._buffer: bytes = b""

    @abstractmethod
    def push(self, data: bytes) -> list[bytes]: ...

    def reset(self) -> None:
        """Drop an unfinished frame, after a time-out or when a port is opened again."""
        self._buffer = b""


class LineFramer(Framer):
    """Text lines that end at `terminator`, which is not part of the frame; None: at CR, LF or both, for devices where
    this is a setting. Empty lines are dropped, unless `keep_empty`.

    A line of more than 4096 bytes is noise: it is dropped up to the next terminator.
    """

    def __init__(self, terminator: bytes | None = None, *, keep_empty: bool = False) -> None:
        super().__init__()
        self._terminator = terminator
        self._keep_empty = keep_empty
        self._overlong = False

    def reset(self) -> None:
        self._buffer, self._overlong = b"", False

    def push(self, data: bytes) -> list[bytes]:
        data = self._buffer + data
        terminator = self._terminator or b"\n"
        *lines, self._buffer = (data.replace(b"\r", b"\n") if self._terminator is None else data).split(terminator)
        if lines and self._overlong:
            lines, self._overlong = lines[1:], False
        if len(self._buffer) > _LONGEST_LINE:
            # The tail may be the first part of a terminator of several bytes.
            self._buffer, self._overlong = self._buffer[1 - len(terminator) or len(self._buffer) :], True
        return [line for line in lines if (line or self._keep_empty) and len(line) <= _LONGEST_LINE]


class LengthFramer(Framer):
    """Frames whose head gives their length. Bytes where no frame begins are noise: dropped one by one, and counted."""

    def __init__(self) -> None:
        super().__init__()
        self.bad_bytes = 0

    @abstractmethod
    def _length(self, head: bytes) -> int | None:
        """The length of the frame at `head`; 0 when that needs more bytes, None when no frame begins there."""

    def push(self, data: bytes) -> list[bytes]:
        data = self._buffer + data
        frames: list[bytes] = []
        place = 0
        while place < len(data):
            head = data[place : place + _LONGEST_MODBUS]
            length = self._length(head)
            if length is None:
                place += 1
                self.bad_bytes += 1
            elif 0 < length <= len(head):
                frames.append(head[:length])
                place += length
            else:
                break
        self._buffer = data[place:]
        return frames


class ModbusTcpFramer(LengthFramer):
    def _length(self, head: bytes) -> int | None:
        if len(head) < 8:
            return 0
        length = int.from_bytes(head[4:6], "big")
        return 6 + length if head[2:4] == b"\0\0" and _SHORTEST_TCP <= length <= _LONGEST_TCP else None


class ModbusReplyFramer(LengthFramer):
    """Replies of a Modbus RTU slave to functions 3, 4, 6 and 16, by the length that their head announces.

    The CRC is checked by the codec, *not* here, so that a damaged reply differs from a missing one. Only bytes of
    `address` start a frame.
    """

    def __init__(self, address: int) -> None:
        super().__init__()
        self._address = address

    def _length(self, head: bytes) -> int | None:
        length = self._announced(head)
        if not length or len(head) < length or _is_sound(head[:length]):
            return length
        # If a sound frame begins later, the bytes at the head are noise.
        for start in range(1, len(head) - 4):
            later = self._announced(head[start:])
            if later and len(head) >= start + later and _is_sound(head[start : start + later]):
                return None
        return length

    def _announced(self, head: bytes) -> int | None:
        if len(head) < 3:
            return 0
        if head[0] != self._address:
            return None
        function = head[1]
        if function & 0x80:
            return 5
        if function in (3, 4):
            return 5 + head[2] if head[2] and head[2] % 2 == 0 else None
        return 8 if function in (6, 16) else None


def _is_sound(frame: bytes) -> bool:
    return crc16_modbus(frame[:-2]) == frame[-2:]


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
    address: int

    def framer(self) -> Framer:
        return ModbusReplyFramer(self.address)

    def message(self, body: bytes) -> bytes:
        frame = bytes([self.address]) + body
        return frame + crc16_modbus(frame)

    def body(self, frame: bytes, sent: bytes) -> bytes:
        """Function and data of the reply to a frame. Raises for a wrong CRC and for an exception; ignores others'."""
        if len(frame) < 5 or crc16_modbus(frame[:-2]) != frame[-2:]:
            raise ChecksumError(
                f"The reply {frame.hex(' ')} has a wrong CRC. Check the shielding and termination of the line."
            )
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
        raise FramingError(f"The reply {printable(frame)!r} does not have {count} registers.")
    return struct.unpack(f">{count}H", data[1:])


def parse_written(modbus: Modbus, frame: bytes, sent: bytes) -> None:
    """A write is acknowledged by the first five bytes of its body."""
    if modbus.body(frame, sent) != modbus.asked(sent)[:5]:
        raise FramingError(f"A write was acknowledged as {printable(frame)!r}; {printable(sent)!r} was sent.")


def _accepted(body: bytes) -> bytes:
    if body[0] & 0x80:
        meaning = EXCEPTIONS.get(body[1], "unknown")
        raise Rejected(f"It refuses: exception {body[1]} ({meaning}).")
    return body
