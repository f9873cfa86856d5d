"""From a stream of bytes to messages: pure, without ports and without clocks.

A framer takes chunks of any size and gives whole frames; how the stream was cut into chunks makes no difference. The
framers of single devices (datagrams, packets) stand beside their codecs; here are those that several devices share.
"""

from typing import Protocol

from .checksums import crc16_modbus

# Unit, function and an exception's code; and the longest message.
_SHORTEST_TCP, _LONGEST_TCP = 3, 254


class Framer(Protocol):
    """Cuts a stream into frames."""

    def push(self, data: bytes) -> list[bytes]:
        """Take the next bytes; return the frames that are now complete."""
        ...

    def reset(self) -> None:
        """Forget an unfinished frame, after a time-out or a re-opened port."""
        ...


class BufferedFramer:
    """What every framer has; `pending` are the bytes of the unfinished frame."""

    def __init__(self) -> None:
        self._buffer: bytes = b""

    @property
    def pending(self) -> bytes:
        return self._buffer

    def reset(self) -> None:
        self._buffer = b""


class LineFramer(BufferedFramer):
    """Text lines that end at `terminator`, which is not part of the frame; None: at CR, LF or both, as a device may be
    set. Empty lines are dropped, unless `keep_empty`.

    A line longer than `longest` bytes is garbage: it is dropped up to the next terminator.
    """

    def __init__(self, terminator: bytes | None = None, *, longest: int = 4096, keep_empty: bool = False) -> None:
        super().__init__()
        self._terminator = terminator
        self._keep_empty = keep_empty
        self._longest = longest
        self._overlong = False

    def reset(self) -> None:
        self._buffer, self._overlong = b"", False

    def push(self, data: bytes) -> list[bytes]:
        data = self._buffer + data
        terminator = self._terminator or b"\n"
        *lines, self._buffer = (data.replace(b"\r", b"\n") if self._terminator is None else data).split(terminator)
        if lines and self._overlong:
            lines, self._overlong = lines[1:], False
        if len(self._buffer) > self._longest:
            # The tail may be the first part of a terminator of several bytes.
            self._buffer, self._overlong = self._buffer[1 - len(terminator) or len(self._buffer) :], True
        return [line for line in lines if (line or self._keep_empty) and len(line) <= self._longest]


class ModbusTcpFramer(BufferedFramer):
    """Messages of Modbus TCP, by the length in their head. What cannot be a head is dropped byte by byte."""

    def push(self, data: bytes) -> list[bytes]:
        self._buffer += data
        frames: list[bytes] = []
        while len(self._buffer) >= 8:
            protocol, length = self._buffer[2:4], int.from_bytes(self._buffer[4:6], "big")
            if protocol != b"\0\0" or not _SHORTEST_TCP <= length <= _LONGEST_TCP:
                self._buffer = self._buffer[1:]
                continue
            if len(self._buffer) < 6 + length:
                break
            frames.append(self._buffer[: 6 + length])
            self._buffer = self._buffer[6 + length :]
        return frames


class ModbusReplyFramer(BufferedFramer):
    """Replies of a Modbus RTU slave to functions 3, 4, 6 and 16, by the length that their head announces.

    The frames' CRC is *not* checked here: the codec does, so that a damaged reply is told from a missing one. Only what
    belongs to `address` starts a frame; other leading bytes are noise and are dropped one by one.
    """

    def __init__(self, address: int) -> None:
        super().__init__()
        self._address = address

    def push(self, data: bytes) -> list[bytes]:
        self._buffer += data
        frames: list[bytes] = []
        while len(self._buffer) >= 3:
            length = self._length(self._buffer)
            if length is None:
                self._buffer = self._buffer[1:]
                continue
            if len(self._buffer) < length:
                break
            frame = self._buffer[:length]
            if crc16_modbus(frame[:-2]) != frame[-2:] and self._later_frame():
                self._buffer = self._buffer[1:]
                continue
            frames.append(frame)
            self._buffer = self._buffer[length:]
        return frames

    def _length(self, head: bytes) -> int | None:
        if head[0] != self._address:
            return None
        function = head[1]
        if function & 0x80:
            return 5
        if function in (3, 4):
            return 5 + head[2] if head[2] and head[2] % 2 == 0 else None
        return 8 if function in (6, 16) else None

    def _later_frame(self) -> bool:
        """Whether a sound frame begins later in the buffer: then the one at its head is noise."""
        for start in range(1, len(self._buffer) - 4):
            rest = self._buffer[start:]
            length = self._length(rest)
            if (
                length is not None
                and len(rest) >= length
                and crc16_modbus(rest[: length - 2]) == rest[length - 2 : length]
            ):
                return True
        return False
