"""A simulated device with Modbus registers, RTU or TCP, written from the protocol.

Strict: it answers only frames with a sound CRC (or head) and its own address, and refuses unknown functions (exception
1) and unknown registers (2). A pause on a serial line ends a frame: what was left unfinished for 50
ms of real time is forgotten.
"""

import struct
import time

from gradcal_jax.hardware.checksums import crc16_modbus


class ModbusSlave:
    """`words`: its registers by number; those of `read_only` cannot be written."""

    read_only: frozenset[int] = frozenset()

    def __init__(self, words, *, address=1, tcp=False):
        self.words, self._address, self._tcp = words, address, tcp
        self._buffer, self._heard_s = b"", 0.0

    def receive(self, data):
        if not self._tcp and time.monotonic() - self._heard_s > 0.05:
            self._buffer = b""
        self._heard_s = time.monotonic()
        self._buffer += data
        replies = []
        while len(self._buffer) >= 8:
            reply = self._next_of_tcp() if self._tcp else self._next_of_rtu()
            if reply is None:
                break
            replies += [reply] if reply else []
        return replies

    def word(self, register):
        """What a register reads; None: there is none."""
        return self.words.get(register)

    def write(self, register, values):
        """Take values; the code of a refusal, or 0."""
        self.words |= {register + place: value for place, value in enumerate(values)}
        return 0

    def _next_of_rtu(self):
        """The reply to the next frame, empty for none; None: the frame is not complete."""
        length = 9 + self._buffer[6] if self._buffer[1] == 16 else 8
        if len(self._buffer) < length:
            return None
        frame = self._buffer[:length]
        if crc16_modbus(frame[:-2]) != frame[-2:]:
            self._buffer = self._buffer[1:]
            return b""
        self._buffer = self._buffer[length:]
        if frame[0] != self._address:
            return b""
        reply = frame[:1] + self._answer(frame[1:-2])
        return reply + crc16_modbus(reply)

    def _next_of_tcp(self):
        number, protocol, length, unit = struct.unpack(">HHHB", self._buffer[:7])
        if protocol != 0 or not 2 <= length <= 254:
            self._buffer = self._buffer[1:]
            return b""
        if len(self._buffer) < 6 + length:
            return None
        body, self._buffer = self._buffer[7 : 6 + length], self._buffer[6 + length :]
        if unit != self._address:
            return b""
        answer = self._answer(body)
        return struct.pack(">HHHB", number, 0, len(answer) + 1, unit) + answer

    def _answer(self, body):
        function = body[0]
        if function not in (3, 4, 6, 16):
            return bytes([function | 0x80, 1])
        register, count = struct.unpack(">HH", body[1:5])
        if function in (3, 4):
            words = [self.word(register + place) for place in range(count)]
            there = [word & 0xFFFF for word in words if word is not None]
            if len(there) < count:
                return bytes([function | 0x80, 2])
            return struct.pack(f">BB{count}H", function, 2 * count, *there)
        values = (count,) if function == 6 else struct.unpack(f">{count}H", body[6:])
        places = range(register, register + len(values))
        unknown = any(place not in self.words or place in self.read_only for place in places)
        refusal = 2 if unknown else self.write(register, values)
        return bytes([function | 0x80, refusal]) if refusal else body[:5]
