"""Chambers that are read and commanded by Modbus registers which a rig file describes (`hardware.register_protocol`).

Every register that is written is read back, from itself or from the one that shows its effect; a set point that a
controller accepts and ignores is noticed so. Unverified on real hardware: everything.
"""

import math
import struct
from collections.abc import Iterator, Mapping
from functools import partial
from typing import Annotated

from pydantic import Field

from gradcal_jax.hardware.checksums import crc16_modbus
from gradcal_jax.hardware.clock import Clock
from gradcal_jax.hardware.drivers.described import DescribedChamber, RequestOptions, Texts
from gradcal_jax.hardware.errors import FramingError, LimitExceeded, Rejected
from gradcal_jax.hardware.register_protocol import Register, RegisterProtocol
from gradcal_jax.hardware.request_reply import Exchange

# Of floats so many decimals are read.
_OF_FLOATS = 4
_FORMATS = {"int16": ">h", "uint16": ">H", "int32": ">i", "uint32": ">I", "float32": ">f"}
_EXCEPTIONS = {1: "function", 2: "register address", 3: "value", 4: "device failure", 5: "acknowledged", 6: "busy"}


class RegistersConfig(RequestOptions):
    """Options of the rig file."""

    role = "chamber"
    kind = RegisterProtocol
    address: Annotated[int, Field(strict=True, ge=0, le=255)] = 1
    """Address of the device on its line."""

    def device(self, link: Exchange, clock: Clock, name: str = "", encoder: object = None) -> "RegistersChamber":
        return RegistersChamber(link, self)


class RegistersChamber(DescribedChamber):
    name = "registers"

    def __init__(self, exchange: Exchange, config: RegistersConfig) -> None:
        super().__init__(exchange, config)
        self._modbus = Modbus(config.address, tcp=self._said.line.transport == "tcp")

    def _fields(self, *names: str) -> Texts:
        known = self._said.registers
        return {name: _text(known[name], self._number(known[name])) for name in names if name in known}

    def _tell(self, name: str, values: Mapping[str, float]) -> None:
        for register, value in self._said.tell[name].items():
            entry = self._said.registers[register]
            number = values[name] if isinstance(value, str) else value
            if entry.type != "float32":
                number = round(number * 10.0**entry.decimals)
            try:
                data = struct.pack(_FORMATS[entry.type], number)
            except (struct.error, OverflowError):
                raise LimitExceeded(f"{self._title}: {number:g} does not fit the register {register}.") from None
            self._query(write_body(entry.address, self._ordered(data)), repeat=False)

    def _expected(self, name: str, values: Mapping[str, float], *, ramps: bool = False) -> Texts:
        texts: Texts = {}
        for register, value in sorted(self._said.tell[name].items(), key=lambda item: not isinstance(item[1], str)):
            field = register if ramps else self._said.registers[register].shown_in or register
            number = values[name] if isinstance(value, str) else value
            texts[field] = _text(self._said.registers[field], number)
        return texts

    def _step_of(self, command: str) -> float:
        (name,) = (name for name, written in self._said.tell[command].items() if isinstance(written, str))
        entry = self._said.registers[name]
        return 0.0 if entry.type == "float32" else 10.0**-entry.decimals

    def _number(self, entry: Register) -> float:
        form = _FORMATS[entry.type]
        function = 4 if entry.input else 3
        body = self._query(struct.pack(">BHH", function, entry.address, struct.calcsize(form) // 2))
        (value,) = struct.unpack(form, self._ordered(body[2:]))
        if not math.isfinite(value):
            raise FramingError(
                f"{self._title}: register {entry.address} is {value}. Check type and order of the words."
            )
        return value if entry.type == "float32" else value / 10.0**entry.decimals

    def _ordered(self, data: bytes) -> bytes:
        """The registers of a number in the device's order, or in the order of their values."""
        return data[2:] + data[:2] if self._said.line.low_word_first else data

    def _query(self, body: bytes, *, repeat: bool = True) -> bytes:
        parse = partial(self._modbus.reply, body=body)
        return self._exchange.query(self._modbus.message(body), parse, repeat=repeat)


def write_body(register: int, data: bytes) -> bytes:
    """Function 6 for one register, 16 for several."""
    if len(data) == 2:
        return struct.pack(">BH", 6, register) + data
    return struct.pack(">BHHB", 16, register, len(data) // 2, len(data)) + data


def _text(entry: Register, number: float) -> str:
    text = f"{number:.{_OF_FLOATS if entry.type == 'float32' else entry.decimals}f}"
    return entry.codes.get(text, text)


class Modbus:
    """Messages of functions 3, 4, 6 and 16: a body, which is the function and its data, in an RTU frame, or behind
    the head of a message of TCP: its number, a zero, and the length of what follows."""

    def __init__(self, address: int, *, tcp: bool = False) -> None:
        self._address, self._tcp, self._number = bytes([address]), tcp, 0

    def message(self, body: bytes) -> bytes:
        message = self._address + body
        if not self._tcp:
            return message + crc16_modbus(message)
        self._number = self._number % 0xFFFF + 1
        return struct.pack(">HHH", self._number, 0, len(message)) + message

    def reply(self, received: bytes, body: bytes) -> bytes | None:
        """The body of the reply to the newest message, whose body was `body`, among bytes; None: it is not there.
        Raises `Rejected` for an exception."""
        # A write is acknowledged by the first five bytes of its body; registers follow their function and their size.
        begins, length = body[:5], 5
        if body[0] in (3, 4):
            begins, length = bytes([body[0], 2 * body[4]]), 2 + 2 * body[4]
        for said in self._tcp_bodies(received) if self._tcp else self._rtu_bodies(received, length):
            if said[0] == body[0] | 0x80 and len(said) == 2:
                meaning = _EXCEPTIONS.get(said[1], "unknown")
                raise Rejected(f"It refuses: exception {said[1]} ({meaning}).")
            if said.startswith(begins) and len(said) == length:
                return said
        return None

    def _rtu_bodies(self, received: bytes, length: int) -> Iterator[bytes]:
        """The bodies of sound frames, of an exception or of this length."""
        for start in range(len(received) - 4):
            for size in (2, length):
                frame = received[start : start + size + 3]
                if frame[:1] == self._address and crc16_modbus(frame[:-2]) == frame[-2:]:
                    yield frame[1:-2]

    def _tcp_bodies(self, received: bytes) -> Iterator[bytes]:
        """The body of the message with the newest number, if it is complete."""
        start = received.find(struct.pack(">HH", self._number, 0))
        head = received[start : start + 7]
        end = start + 6 + int.from_bytes(head[4:6], "big")
        if start >= 0 and head[6:] == self._address and start + 7 < end <= len(received):
            yield received[start + 7 : end]
