"""`gradcal-registers/1`: the description of a chamber that is read and commanded by Modbus registers, without code;
`presets/devices` has examples.

Every value that is written is read back, from its own register or from the one that `shown_in` names. The order of
commands and their verification are in the driver (`hardware.drivers.registers`).
"""

from collections.abc import Iterator, Mapping
from typing import Annotated, Final, Literal

from pydantic import Field

from gradcal_jax.hardware.line_protocol import Condition, DeviceLimits, DeviceUnits, RequiredSetting, described
from gradcal_jax.tables.problems import Problem, instead
from gradcal_jax.tables.quantity import Count, Flag, Quantity, SizeOfTime, Text, Time
from gradcal_jax.tables.section import Section

FORMAT: Final = "gradcal-registers/1"
_VALUES: Final[Mapping[str, str]] = {
    "setpoint": "setpoint", "ramp": "ramp", "on": "", "off": "", "no_ramp": "", "end_program": "",
}  # fmt: skip


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


class RegisterProtocol(Section):
    """A complete description of a chamber that communicates by registers."""

    format: Literal["gradcal-registers/1"]
    """Name and version of this file format."""
    role: Literal["chamber"]
    """Kind of device."""
    title: Text
    """A title for tables and pages."""
    line: ModbusLine = ModbusLine()
    """Settings of the connection."""
    units: DeviceUnits = DeviceUnits()
    """Units of the numbers that the device sends and receives."""
    limits: DeviceLimits = DeviceLimits()
    """Limits of the device, if it has no registers `lowest` and `highest` that state them."""
    on_first: Flag = False
    """Whether the device accepts a set point only while it is switched on and conditions the chamber."""
    registers: dict[str, Register]
    """Registers of the device, by name. Names that the program knows: air, setpoint, product, mode, lowest, highest,
    model, serial, firmware."""
    tell: dict[str, dict[str, int | float | Text]]
    """Commands, by name: the registers to write, and the values for them."""
    state: dict[str, Condition] = Field(default_factory=dict[str, Condition])
    """States of the device that registers show, by name: conditioning, program, ramps."""
    alarm: dict[str, Condition] = Field(default_factory=dict[str, Condition])
    """Alarms of the device, by name."""
    require: Annotated[tuple[RequiredSetting, ...], Field(max_length=20)] = ()
    """Settings that the device must have before the first command."""

    @property
    def fields(self) -> dict[str, str]:
        """Every field that can be read -> its register."""
        return {name: name for name in self.registers}

    def _problems(self) -> Iterator[Problem]:
        known, needed = self.registers, (("registers", "air"), ("registers", "setpoint"), ("tell", "setpoint"))
        for key in (key for key in needed if key[1] not in getattr(self, key[0])):
            yield Problem(key, "this key is missing; a chamber needs it", kind="missing")
        for name in ("lowest", "highest"):
            if name not in known and getattr(self.limits, name) is None:
                message = f"this key is missing; give it, or describe a register {name}"
                yield Problem(("limits", name), message, kind="missing")
        for tells, state in ((("on", "off"), "conditioning"), (("end_program",), "program"), (("no_ramp",), "ramps")):
            if any(name in self.tell for name in tells) and state not in self.state:
                message = f"this key is missing: without this state, no reply shows the effect of tell.{tells[0]}"
                yield Problem(("state", state), message, kind="missing")
        if ("on" in self.tell) is not ("off" in self.tell):
            yield Problem(("tell",), "expected both commands, on and off, or neither")
        if "ramp" in self.tell and "no_ramp" not in self.tell and self.limits.free_ramp is None:
            message = "this key is missing: it is the command that ends a ramp"
            yield Problem(("tell", "no_ramp"), message, kind="missing")
        yield from self._badly_written()

    def _badly_written(self) -> Iterator[Problem]:
        known = self.registers
        named = [(("registers", name, "shown_in"), entry.shown_in) for name, entry in known.items()]
        named += [(("registers", name, "decimals"), entry.decimals) for name, entry in known.items()]
        for table in ("state", "alarm"):
            named += [((table, name, "field"), entry.field) for name, entry in getattr(self, table).items()]
        for key, name in named:
            if isinstance(name, str) and name not in known:
                yield Problem(key, f"there is no such register; {instead(name, known)}", name)
        for name, writes in self.tell.items():
            if name not in _VALUES:
                message = f"is not a command; those of a chamber are {', '.join(_VALUES)}; {instead(name, _VALUES)}"
                yield Problem(("tell", name), message)
                continue
            for register, value in writes.items():
                entry = known.get(register)
                if entry is None:
                    yield Problem(("tell", name, register), f"there is no such register; {instead(register, known)}")
                elif entry.input or entry.type == "text":
                    yield Problem(("tell", name, register), "this register can only be read")
                allowed = f"{{{_VALUES[name]}}}"
                if isinstance(value, str) and (not _VALUES[name] or value != allowed):
                    message = f"expected a number{f' or {allowed}' if _VALUES[name] else ''}"
                    yield Problem(("tell", name, register), message, value)
            if _VALUES[name] and f"{{{_VALUES[name]}}}" not in writes.values():
                yield Problem(("tell", name), f"the command must write {{{_VALUES[name]}}} to a register")


def register_protocol_of(value: object, changes: object = None) -> RegisterProtocol:
    """The protocol of a rig file: see `line_protocol.described`."""
    return described(RegisterProtocol, FORMAT, value, changes)
