"""`gradcal-registers/1`: the description of a chamber that is read and commanded by Modbus registers, without code;
`presets/devices` has examples.

Every value that is written is read back, from its own register or from the one that `shown_in` names. The order of
commands and their verification are in the driver (`hardware.drivers.registers`).
"""

from collections.abc import Iterator, Mapping
from typing import Annotated, Final, Literal

from pydantic import Field

from gradcal_jax.hardware.line_protocol import Condition, DeviceDescription
from gradcal_jax.tables.problems import Problem, instead
from gradcal_jax.tables.quantity import Count, Flag, Quantity, SizeOfTime, Text, Time
from gradcal_jax.tables.section import Section

FORMAT: Final = "gradcal-registers/1"
_COMMANDS: Final = ("setpoint", "ramp", "on", "off", "no_ramp", "end_program")


class ModbusLine(Section):
    """`[line]`."""

    transport: Literal["rtu", "tcp"] = "rtu"
    """RTU frames on a serial line, or messages of Modbus TCP (the port is then `socket://ADDRESS:502`)."""
    baudrate: Count = 9600
    """Bits per second."""
    parity: Literal["N", "E", "O"] = "N"
    """None, even or odd."""
    stopbits: Literal[1, 2] = 1
    """Stop bits of a character."""
    low_word_first: Flag = False
    """Whether the first register of a two-register number has the lower 16 bits."""
    timeout: Time = Quantity(1.0, "1 s", "time")
    """Timeout for a reply."""
    pause: SizeOfTime = Quantity(0.03, "0.03 s", "time")
    """Least time between two messages."""


class Register(Section):
    """`[registers.NAME]`: a register of the device. A text occupies `count` registers, with one character in each."""

    address: Annotated[int, Field(strict=True, ge=0, le=65535)]
    """Number of the register in the message, counted from 0: what a manual calls 40001 or 4x0001 is 0."""
    type: Literal["int16", "uint16", "int32", "uint32", "float32", "text"] = "int16"
    """Type of the number or text in the register."""
    decimals: Annotated[int, Field(strict=True, ge=0, le=6)] | Text = 0
    """Number n of decimals (the register has the value times 10ⁿ), or the name of the register that has this number."""
    count: Annotated[int, Field(strict=True, ge=1, le=60)] = 1
    """Number of registers that a text occupies."""
    input: Flag = False
    """Whether the register is an input register (function 4), which can only be read."""
    codes: dict[str, Text] = Field(default_factory=dict[str, str])
    """Words for the numbers in the register, such as { 0 = "OFF", 1 = "RUN" }."""
    shown_in: Text | None = None
    """Name of the register that shows the value written to this one; absent: this register itself."""


class RegisterProtocol(DeviceDescription):
    """A complete description of a chamber that communicates by registers."""

    format: Literal["gradcal-registers/1"]
    """Name and version of this file format."""
    role: Literal["chamber"]
    """Kind of device."""
    line: ModbusLine = ModbusLine()
    """Settings of the connection."""
    on_first: Flag = False
    """Whether the device accepts a set point only while it is switched on and conditions the chamber."""
    registers: dict[str, Register]
    """Registers of the device, by name. Names that the program knows: air, setpoint, product, mode, lowest, highest,
    model, serial, firmware."""
    tell: dict[str, dict[str, int | float | Text]]
    """Commands, by name: the registers to write, and the values for them."""
    alarm: dict[str, Condition] = Field(default_factory=dict[str, Condition])
    """Alarms of the device, by name."""

    @property
    def fields(self) -> dict[str, Register]:
        """Every field that can be read: its register."""
        return self.registers

    def _problems(self) -> Iterator[Problem]:
        needed = (("registers", "air"), ("registers", "setpoint"), ("tell", "setpoint"))
        for key in (key for key in needed if key[1] not in getattr(self, key[0])):
            yield Problem(key, "this key is missing; a chamber needs it", kind="missing")
        for name in ("lowest", "highest"):
            if name not in self.registers and getattr(self.limits, name) is None:
                message = f"this key is missing; give it, or describe a register {name}"
                yield Problem(("limits", name), message, kind="missing")
        if ("on" in self.tell) is not ("off" in self.tell):
            yield Problem(("tell",), "expected both commands, on and off, or neither")
        if "ramp" in self.tell and "no_ramp" not in self.tell and self.limits.free_ramp is None:
            message = "this key is missing: it is the command that ends a ramp"
            yield Problem(("tell", "no_ramp"), message, kind="missing")
        for name, entry in self.registers.items():
            named = {"shown_in": entry.shown_in, "decimals": entry.decimals}
            for key, other in named.items():
                yield from self._unknown(("registers", name, key), *([other] if isinstance(other, str) else []))
        for name, entry in self.alarm.items():
            yield from self._unknown(("alarm", name, "field"), entry.field)
        for name, writes in self.tell.items():
            yield from self._of_command(name, writes)

    def _of_command(self, name: str, writes: Mapping[str, int | float | str]) -> Iterator[Problem]:
        if name not in _COMMANDS:
            yield Problem(("tell", name), f"is not a command of a chamber; {instead(name, _COMMANDS)}")
        placeholder = f"{{{name}}}" if name in ("setpoint", "ramp") else ""
        for register, value in writes.items():
            key = ("tell", name, register)
            yield from self._unknown(key, register)
            entry = self.registers.get(register)
            if entry is not None and (entry.input or entry.type == "text"):
                yield Problem(key, "this register can only be read")
            if isinstance(value, str) and value != placeholder:
                yield Problem(key, f"expected a number{placeholder and f' or {placeholder}'}", value)
        if placeholder and placeholder not in writes.values():
            yield Problem(("tell", name), f"the command must write {placeholder} to a register")
