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
from gradcal_jax.hardware.register_protocol import RegisterProtocol
from gradcal_jax.hardware.request_reply import Exchange

_FINEST_DECIMALS = 3
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
        self._decimals_by_register: dict[str, int] = {}

    def read(self, *names: str) -> Texts:
        return {name: self._text(name) for name in dict.fromkeys(names) if name in self.said.registers}

    def tell(self, name: str, values: Mapping[str, float] | None = None, *, by_itself: bool = False) -> Texts:
        """Write the registers of a command, one after the other, each until it is shown; `by_itself`: where it was
        written, whatever shows its effect."""
        written: Texts = {}
        for register, value in self.said.tell[name].items():
            number = float(value) if not isinstance(value, str) else (values or {})[value.strip("{}")]
            shown_in = None if by_itself else self.said.registers[register].shown_in
            written[register] = self._write(name, register, number, shown_in or register)
        return written

    def tell_shown(self, name: str, value: float, *, ramps: bool = False) -> float:
        return float(self.tell(name, {name: value}, by_itself=ramps)[self._register_of(name)])

    def step_of(self, command: str) -> float:
        name = self._register_of(command)
        return 0.0 if self.said.registers[name].type == "float32" else 10.0 ** -self._decimals(name)

    def _register_of(self, command: str) -> str:
        """The register that gets a command's value, which has the command's name."""
        return next(name for name, written in self.said.tell[command].items() if written == f"{{{command}}}")

    def _write(self, command: str, name: str, value: float, shown_in: str) -> str:
        """Write a number until it is shown; returns it as the device rounds it."""
        entry, decimals = self.said.registers[name], self._decimals(name)
        number = value if entry.type == "float32" else round(value * 10.0**decimals)
        try:
            data = struct.pack(_FORMATS[entry.type], number)
        except (struct.error, OverflowError):
            raise LimitExceeded(f"{value:g} does not fit the register {name} of {self.title}.") from None
        body = write_body(entry.address, self._ordered(struct.unpack(f">{len(data) // 2}H", data)))
        near = 0.51 * 10.0 ** -(_FINEST_DECIMALS if entry.type == "float32" else min(decimals, _FINEST_DECIMALS))

        rounded = value if entry.type == "float32" else number / 10.0**decimals
        what = f"{self.title}: {command} ({name} = {value:g})"
        command_and_verify(
            self.clock,
            what,
            lambda: self._query(body, repeat=False),
            lambda: self._number(shown_in),
            lambda shown: abs(shown - rounded) <= near,
        )
        return f"{rounded:.6g}"

    def _text(self, name: str) -> str:
        entry = self.said.registers[name]
        if entry.type == "text":
            return "".join(chr(word & 0xFF) for word in self._words(name, entry.count) if word & 0xFF).strip()
        text = f"{self._number(name):.{4 if entry.type == 'float32' else self._decimals(name)}f}"
        return entry.codes.get(text, text)

    def _number(self, name: str) -> float:
        entry = self.said.registers[name]
        wanted = _FORMATS[entry.type]
        words = self._ordered(self._words(name, struct.calcsize(wanted) // 2))
        (value,) = struct.unpack(wanted, struct.pack(f">{len(words)}H", *words))
        if not math.isfinite(value):
            raise FramingError(f"{self.title} says that {name} is {value}. Check type and order of the words.")
        return value / 10.0 ** self._decimals(name)

    def _ordered(self, words: tuple[int, ...]) -> tuple[int, ...]:
        return words[::-1] if self.said.line.low_word_first else words

    def _words(self, name: str, count: int) -> tuple[int, ...]:
        entry = self.said.registers[name]
        return words_of(self._query(read_body(entry.address, count, 4 if entry.input else 3)))

    def _query(self, body: bytes, *, repeat: bool = True) -> bytes:
        parse = partial(self._modbus.reply, body=body)
        return self.exchange.query(self._modbus.message(body), parse, repeat=repeat)

    def _decimals(self, name: str) -> int:
        entry = self.said.registers[name]
        power = 0 if entry.type == "float32" else entry.decimals
        if isinstance(power, int):
            return power
        if power not in self._decimals_by_register:
            places = self._number(power)
            if places not in range(7):
                raise FramingError(f"{self.title} reports {places:g} decimals in register {power}; expected 0 to 6.")
            self._decimals_by_register[power] = int(places)
        return self._decimals_by_register[power]
