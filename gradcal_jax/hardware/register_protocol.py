"""`gradcal-registers/1`: the description of a chamber that is read and commanded by Modbus registers, without code.

Every value that is written is read back, from its own register or from the one that `shown_in` names. The order of
commands and their verification are in the drivers (`hardware.drivers`).
"""

from collections.abc import Iterator
from typing import Annotated, ClassVar, Final, Literal

from pydantic import Field

from gradcal_jax.hardware.description import Commands, DeviceDescription
from gradcal_jax.tables.problems import Problem
from gradcal_jax.tables.quantity import Count, Flag, Quantity, SizeOfTime, Text, Time
from gradcal_jax.tables.section import Section

REGISTERS: Final = "gradcal-registers/1"


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
    """`[registers.NAME]`: a register of the device, or two for a number of 32 bits."""

    address: Annotated[int, Field(strict=True, ge=0, le=65535)]
    """Number of the register in the message, counted from 0: what a manual calls 40001 or 4x0001 is 0."""
    type: Literal["int16", "uint16", "int32", "uint32", "float32"] = "int16"
    """Type of the number in the register."""
    decimals: Annotated[int, Field(strict=True, ge=0, le=6)] = 0
    """Number n of decimals: the register has the value times 10ⁿ. Where it can be changed at the device, `require` the
    register that shows it."""
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
    registers: dict[str, Register]
    """Registers of the device, by name. Names that the program knows: air, setpoint, product, mode, lowest, highest,
    model, serial, firmware."""
    tell: dict[str, dict[str, int | float | Text]]
    """Commands, by name: the registers to write, and the values for them."""

    commands: ClassVar[Commands] = {
        "chamber": {"setpoint": "{setpoint}", "ramp": "{ramp}", "on": "", "off": "", "no_ramp": "", "end_program": ""}
    }

    @property
    def fields(self) -> dict[str, Register]:
        """Every field that can be read: its register."""
        return self.registers

    @property
    def needed(self) -> str:
        needs = ["registers.air", "registers.setpoint", "tell.setpoint"]
        needs += [f"limits.{end}" for end in ("lowest", "highest") if end not in self.registers]
        needs += [f"tell.{_WITH[name]}" for name in self.tell if name in _WITH]
        return " ".join(needs)

    def _problems(self) -> Iterator[Problem]:
        for name, entry in self.registers.items():
            yield from self.unknown(("registers", name, "shown_in"), entry.shown_in or name)
        for name, writes in self.tell.items():
            placeholder = self.commands["chamber"].get(name, "")
            for register, value in writes.items():
                key = ("tell", name, register)
                yield from self.unknown(key, register)
                if register in self.registers and self.registers[register].input:
                    yield Problem(key, "this register can only be read")
                if isinstance(value, str) and value != placeholder:
                    yield Problem(key, f"expected a number{placeholder and f' or {placeholder}'}", value)
            if placeholder and placeholder not in writes.values():
                yield Problem(("tell", name), f"the command must write {placeholder} to a register")


# Commands, and what takes back their effect.
_WITH: Final = {"on": "off", "off": "on", "ramp": "no_ramp"}
