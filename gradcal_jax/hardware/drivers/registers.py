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
from gradcal_jax.hardware.drivers.base import command_and_verify
from gradcal_jax.hardware.drivers.described import DescribedChamber, RequestOptions, Speaker, Texts
from gradcal_jax.hardware.errors import FramingError, LimitExceeded
from gradcal_jax.hardware.modbus import Rtu, Tcp, read_body, words_of, write_body
from gradcal_jax.hardware.register_protocol import Register, RegisterProtocol
from gradcal_jax.hardware.request_reply import Exchange

# Of floats so many decimals are read.
_OF_FLOATS, _FINEST_DECIMALS = 4, 3
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
        return {name: self._text(self.said.registers[name]) for name in names if name in self.said.registers}

    def tell(self, name: str, values: Mapping[str, float] | None = None) -> None:
        self.tell_shown(name, values or {})

    def tell_shown(self, name: str, values: Mapping[str, float], *, ramps: bool = False) -> float:
        """Write the registers of a command, one after the other, each until it is shown: where it was written, or by
        the register that shows its effect, but not by one that only moves towards it (`ramps`)."""
        result = 0.0
        for register, value in self.said.tell[name].items():
            entry = self.said.registers[register]
            number = values[name] if isinstance(value, str) else float(value)
            shown_in = entry if ramps or entry.shown_in is None else self.said.registers[entry.shown_in]
            written = self._write(f"{self.title}: {name} ({register} = {number:g})", entry, number, shown_in)
            if isinstance(value, str):
                result = written
        return result

    def step_of(self, command: str) -> float:
        (name,) = (name for name, written in self.said.tell[command].items() if isinstance(written, str))
        entry = self.said.registers[name]
        return 0.0 if entry.type == "float32" else 10.0**-entry.decimals

    def _write(self, what: str, entry: Register, value: float, shown_in: Register) -> float:
        """Write a number until it is shown; returns it as the device rounds it."""
        number, factor = value, 10.0**entry.decimals
        if entry.type != "float32":
            number = round(value * factor)
            value = number / factor
        try:
            data = struct.pack(_FORMATS[entry.type], number)
        except (struct.error, OverflowError):
            raise LimitExceeded(f"{what}: the number does not fit the register.") from None
        words = struct.unpack(f">{len(data) // 2}H", data)
        body = write_body(entry.address, self._ordered(words))
        near = 0.51 * 10.0 ** -min(_decimals(entry), _FINEST_DECIMALS)
        command_and_verify(
            self.clock,
            what,
            lambda: self._query(body, repeat=False),
            lambda: self._number(shown_in),
            lambda shown: abs(shown - value) <= near,
        )
        return value

    def _text(self, entry: Register) -> str:
        text = f"{self._number(entry):.{_decimals(entry)}f}"
        return entry.codes.get(text, text)

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


def _decimals(entry: Register) -> int:
    return _OF_FLOATS if entry.type == "float32" else entry.decimals
