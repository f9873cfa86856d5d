"""Chambers that are read and commanded by Modbus registers which a rig file describes (`hardware.register_protocol`).

Every register that is written is read back, from itself or from the one that shows its effect; a set point that a
controller accepts and ignores is noticed so. A program that runs is ended before a set point, and a ramp is taken off
by `hold` and `standby`.

Unverified on real hardware: everything; each description says what its sources leave open.
"""

import math
import struct
from collections.abc import Mapping
from functools import cached_property
from typing import Annotated

from pydantic import Field

from gradcal_jax.hardware.clock import Clock
from gradcal_jax.hardware.drivers.base import DescribedChamber, RequestOptions, Texts
from gradcal_jax.hardware.errors import FramingError, LimitExceeded
from gradcal_jax.hardware.framing import Modbus, Rtu, Tcp, parse_words, parse_written, read_body, write_body
from gradcal_jax.hardware.line_protocol import described
from gradcal_jax.hardware.register_protocol import RegisterProtocol
from gradcal_jax.hardware.request_reply import Exchange
from gradcal_jax.hardware.transport import Transport

_FINEST_DECIMALS = 3
_FORMATS = {"int16": ">h", "uint16": ">H", "int32": ">i", "uint32": ">I", "float32": ">f"}


class RegistersConfig(RequestOptions):
    """Options of the rig file."""

    role = "chamber"
    address: Annotated[int, Field(strict=True, ge=0, le=255)] = 1
    """Address of the device on its line."""

    @cached_property
    def described(self) -> RegisterProtocol:
        return described(RegisterProtocol, self.protocol, self.changes)

    def link(self, line: Transport, clock: Clock) -> Exchange:
        return self.exchange(line, clock, self.modbus.framer())

    def device(self, link: Exchange, clock: Clock, name: str = "", encoder: object = None) -> "RegistersChamber":
        return RegistersChamber(link, self)

    @cached_property
    def modbus(self) -> Modbus:
        return (Tcp if self.described.line.transport == "tcp" else Rtu)(self.address)

    def lacks_for(self, safe: str) -> str:
        if safe != "standby" or "off" in self.described.tell:
            return ""
        return 'its description has no [tell] on and off: add them by `changes`, or choose "ambient" or "hold"'


class RegistersChamber(DescribedChamber[RegistersConfig]):
    _DRIVER = "registers"

    def __init__(self, exchange: Exchange, config: RegistersConfig) -> None:
        super().__init__(exchange, config)
        self._protocol, self._modbus = config.described, config.modbus
        self._powers: dict[str, int] = {}

    def _read(self, *names: str) -> Texts:
        return {name: self._text(name) for name in dict.fromkeys(names) if name in self._protocol.registers}

    def _tell(self, name: str, values: Mapping[str, float] | None = None, *, by_itself: bool = False) -> Texts:
        """Write the registers of a command, one after the other, each until it is shown; `by_itself`: where it was
        written, whatever shows its effect."""
        written: Texts = {}
        for register, value in self._protocol.tell[name].items():
            number = float(value) if not isinstance(value, str) else (values or {})[value.strip("{}")]
            shown_in = self._protocol.registers[register].shown_in
            written[register] = self._write(name, register, number, register if by_itself else shown_in or register)
        return written

    def _tell_shown(self, name: str, value: float, *, ramps: bool = False) -> float:
        return float(self._tell(name, {name: value}, by_itself=ramps)[self._register_of(name)])

    def _resolution_k(self) -> float:
        return self._step_of("setpoint") or super()._resolution_k()

    def _make_ready(self) -> None:
        super()._make_ready()
        if self._protocol.on_first:
            self._condition(True)

    def _alarm_fields(self) -> list[str]:
        return [condition.field for condition in self._protocol.alarm.values()]

    def _alarms(self, texts: Texts) -> tuple[str, ...]:
        return tuple(name for name, alarm in self._protocol.alarm.items() if alarm.holds(texts[alarm.field]))

    def _mode(self, texts: Texts) -> str:
        if self._is("program", texts):
            return texts[self._protocol.state["program"].field]
        condition = self._protocol.state.get("conditioning")
        return texts.get("mode") or ("on" if condition is None else texts[condition.field])

    def _register_of(self, command: str) -> str:
        """The register that gets a command's value, which has the command's name."""
        return next(name for name, written in self._protocol.tell[command].items() if written == f"{{{command}}}")

    def _step_of(self, command: str) -> float:
        name = self._register_of(command)
        return 0.0 if self._protocol.registers[name].type == "float32" else 10.0 ** -self._decimals(name)

    def _write(self, command: str, name: str, value: float, shown_in: str) -> str:
        """Write a number until it is shown; returns it as the device rounds it."""
        entry, decimals = self._protocol.registers[name], self._decimals(name)
        try:
            number = value if entry.type == "float32" else round(value * 10.0**decimals)
            data = struct.pack(_FORMATS[entry.type], number)
        except (struct.error, OverflowError):
            raise LimitExceeded(f"{value:g} does not fit the register {name} of {self._title}.") from None
        words = struct.unpack(f">{len(data) // 2}H", data)
        words = words[::-1] if self._protocol.line.low_word_first else words
        body = write_body(entry.address, words)
        near = 0.51 * 10.0 ** -(_FINEST_DECIMALS if entry.type == "float32" else min(decimals, _FINEST_DECIMALS))

        def send() -> None:
            sent = self._modbus.message(body)
            self._exchange.query(sent, lambda frame: parse_written(self._modbus, frame, sent), repeat=False)

        rounded = value if entry.type == "float32" else number / 10.0**decimals
        what = f"{self._title}: {command} ({name} = {value:g})"
        self._verify(what, send, lambda: self._number(shown_in), lambda shown: abs(shown - rounded) <= near)
        return f"{rounded:.6g}"

    def _text(self, name: str) -> str:
        entry = self._protocol.registers[name]
        if entry.type == "text":
            return "".join(chr(word & 0xFF) for word in self._words(name, entry.count) if word & 0xFF).strip()
        if entry.type == "float32":
            return f"{self._number(name):.4f}"
        text = f"{self._number(name):.{self._decimals(name)}f}"
        return entry.codes.get(text, text)

    def _number(self, name: str) -> float:
        entry = self._protocol.registers[name]
        wanted = _FORMATS[entry.type]
        words = self._words(name, struct.calcsize(wanted) // 2)
        words = words[::-1] if self._protocol.line.low_word_first else words
        (value,) = struct.unpack(wanted, struct.pack(f">{len(words)}H", *words))
        if not math.isfinite(value):
            raise FramingError(f"{self._title} says that {name} is {value}. Check type and order of the words.")
        return float(value) if entry.type == "float32" else value / 10.0 ** self._decimals(name)

    def _words(self, name: str, count: int) -> tuple[int, ...]:
        entry = self._protocol.registers[name]
        sent = self._modbus.message(read_body(entry.address, count, 4 if entry.input else 3))
        return self._exchange.query(sent, lambda frame: parse_words(self._modbus, frame, sent, count))

    def _decimals(self, name: str) -> int:
        power = self._protocol.registers[name].decimals
        if isinstance(power, int):
            return power
        if power not in self._powers:
            places = self._number(power)
            if places not in range(7):
                raise FramingError(
                    f"{self._title} reports {places:g} decimals in register {power}; 0 to 6 were expected."
                )
            self._powers[power] = int(places)
        return self._powers[power]
