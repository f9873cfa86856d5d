"""`gradcal-registers/1`: the description of a chamber that is read and commanded by Modbus registers, without code.

Every value that is written is read back, from its own register or from the one that `shown_in` names. The order of
commands and their verification are in the drivers (`hardware.drivers`).
"""

from collections.abc import Iterator, Mapping
from typing import Annotated, Final, Literal

from pydantic import Field

from gradcal_jax.hardware.description import DeviceDescription, missing
from gradcal_jax.tables.problems import Problem, instead
from gradcal_jax.tables.quantity import Count, Flag, Quantity, SizeOfTime, Text, Time
from gradcal_jax.tables.section import Section

REGISTERS: Final = "gradcal-registers/1"
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
    registers: dict[str, Register]
    """Registers of the device, by name. Names that the program knows: air, setpoint, product, mode, lowest, highest,
    model, serial, firmware."""
    tell: dict[str, dict[str, int | float | Text]]
    """Commands, by name: the registers to write, and the values for them."""

    @property
    def fields(self) -> dict[str, Register]:
        """Every field that can be read: its register."""
        return self.registers

    def _problems(self) -> Iterator[Problem]:
        for table, name in (("registers", "air"), ("registers", "setpoint"), ("tell", "setpoint")):
            if name not in getattr(self, table):
                yield missing((table, name), "; a chamber needs it")
        for name in ("lowest", "highest"):
            if name not in self.registers and getattr(self.limits, name) is None:
                yield missing(("limits", name), f"; give it, or describe a register {name}")
        if ("on" in self.tell) is not ("off" in self.tell):
            yield Problem(("tell",), "expected both commands, on and off, or neither")
        if "ramp" in self.tell and "no_ramp" not in self.tell:
            yield missing(("tell", "no_ramp"), ": it is the command that ends a ramp")
        for name, entry in self.registers.items():
            yield from self.unknown(("registers", name, "shown_in"), entry.shown_in)
            yield from self.unknown(("registers", name, "decimals"), entry.decimals)
        for name, writes in self.tell.items():
            yield from self._of_command(name, writes)

    def _of_command(self, name: str, writes: Mapping[str, int | float | str]) -> Iterator[Problem]:
        if name not in _COMMANDS:
            yield Problem(("tell", name), f"is not a command of a chamber; {instead(name, _COMMANDS)}")
        placeholder = f"{{{name}}}" if name in ("setpoint", "ramp") else ""
        for register, value in writes.items():
            key = ("tell", name, register)
            yield from self.unknown(key, register)
            entry = self.registers.get(register)
            if entry is not None and (entry.input or entry.type == "text"):
                yield Problem(key, "this register can only be read")
            if isinstance(value, str) and value != placeholder:
                yield Problem(key, f"expected a number{placeholder and f' or {placeholder}'}", value)
        if placeholder and placeholder not in writes.values():
            yield Problem(("tell", name), f"the command must write {placeholder} to a register")
