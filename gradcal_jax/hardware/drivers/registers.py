"""Chambers that are read and commanded by Modbus registers which a rig file describes (`hardware.register_protocol`).

Every register that is written is read back, from itself or from the one that shows its effect; a set point that a
controller accepts and ignores is noticed so. Unverified on real hardware: everything.
"""

import math
import struct
from collections.abc import Mapping
from functools import partial
from typing import Annotated

from pydantic import Field

from gradcal_jax.hardware.clock import Clock
from gradcal_jax.hardware.drivers.described import DescribedChamber, RequestOptions, Speaker, Texts
from gradcal_jax.hardware.errors import FramingError, LimitExceeded
from gradcal_jax.hardware.modbus import Rtu, Tcp, read_body, words_of, write_body
from gradcal_jax.hardware.register_protocol import Register, RegisterProtocol
from gradcal_jax.hardware.request_reply import Exchange

# Of floats so many decimals are read.
_OF_FLOATS = 4
_FORMATS = {"int16": ">h", "uint16": ">H", "int32": ">i", "uint32": ">I", "float32": ">f"}


class RegistersConfig(RequestOptions):
    """Options of the rig file."""

    role = "chamber"
    kind = RegisterProtocol
    address: Annotated[int, Field(strict=True, ge=0, le=255)] = 1
    """Address of the device on its line."""

    def device(self, link: Exchange, clock: Clock, name: str = "", encoder: object = None) -> DescribedChamber:
        return DescribedChamber(Registers(link, self))

    def lacks_for(self, safe: str) -> str:
        if safe != "standby" or "off" in self.described.tell:
            return ""
        return 'its description has no [tell] on and off: add them by `changes`, or choose "ambient" or "hold"'


class Registers(Speaker):
    name = "registers"

    def __init__(self, exchange: Exchange, config: RegistersConfig) -> None:
        super().__init__(exchange, config)
        self._modbus = (Tcp if self.said.line.transport == "tcp" else Rtu)(config.address)

    def read(self, *names: str) -> Texts:
        known = self.said.registers
        return {name: _text(known[name], self._number(known[name])) for name in names if name in known}

    def tell(self, name: str, values: Mapping[str, float]) -> None:
        for register, value in self.said.tell[name].items():
            entry = self.said.registers[register]
            number = values[name] if isinstance(value, str) else value
            if entry.type != "float32":
                number = round(number * 10.0**entry.decimals)
            try:
                data = struct.pack(_FORMATS[entry.type], number)
            except (struct.error, OverflowError):
                raise LimitExceeded(f"{self.title}: {number:g} does not fit the register {register}.") from None
            words = struct.unpack(f">{len(data) // 2}H", data)
            self._query(write_body(entry.address, self._ordered(words)), repeat=False)

    def expected(self, name: str, values: Mapping[str, float], *, ramps: bool = False) -> Texts:
        texts: Texts = {}
        for register, value in sorted(self.said.tell[name].items(), key=lambda item: not isinstance(item[1], str)):
            field = register if ramps else self.said.registers[register].shown_in or register
            number = values[name] if isinstance(value, str) else value
            texts[field] = _text(self.said.registers[field], number)
        return texts

    def step_of(self, command: str) -> float:
        (name,) = (name for name, written in self.said.tell[command].items() if isinstance(written, str))
        entry = self.said.registers[name]
        return 0.0 if entry.type == "float32" else 10.0**-entry.decimals

    def _number(self, entry: Register) -> float:
        form = _FORMATS[entry.type]
        count = struct.calcsize(form) // 2
        words = words_of(self._query(read_body(entry.address, count, 4 if entry.input else 3)))
        (value,) = struct.unpack(form, struct.pack(f">{count}H", *self._ordered(words)))
        if not math.isfinite(value):
            raise FramingError(f"{self.title}: register {entry.address} is {value}. Check type and order of the words.")
        return value if entry.type == "float32" else value / 10.0**entry.decimals

    def _ordered(self, words: tuple[int, ...]) -> tuple[int, ...]:
        return words[::-1] if self.said.line.low_word_first else words

    def _query(self, body: bytes, *, repeat: bool = True) -> bytes:
        parse = partial(self._modbus.reply, body=body)
        return self.exchange.query(self._modbus.message(body), parse, repeat=repeat)


def _text(entry: Register, number: float) -> str:
    text = f"{number:.{_OF_FLOATS if entry.type == 'float32' else entry.decimals}f}"
    return entry.codes.get(text, text)
