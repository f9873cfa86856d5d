"""What all descriptions of devices in rig files have; `presets/devices` has examples.

A description has no logic, and no regular expression, because a file may be untrusted. A device that answers requests
has fields (readings as its own text, by name), states and alarms (conditions on fields), commands, limits, units, and
settings that it must have.
"""

from collections.abc import Callable, Iterator, Mapping
from importlib import resources
from typing import Annotated, Any, ClassVar, Final, Literal, get_args

from pydantic import AfterValidator, BeforeValidator, Field

from gradcal_jax import units
from gradcal_jax.tables import quantity as q
from gradcal_jax.tables.document import Model, model_of, read_toml
from gradcal_jax.tables.problems import Key, Problem, instead
from gradcal_jax.tables.section import Section

DeviceState = Literal["conditioning", "program", "ramps", "moving", "fault", "powered"]
# The state in which the effect of a command is seen.
SHOWN_IN: Final = {"on": ("conditioning", "powered"), "end_program": ("program",), "no_ramp": ("ramps",)}
_DEVICES: Final = resources.files("gradcal_jax.spec.presets") / "devices"


def listed(value: object) -> object:
    return (value,) if isinstance(value, str) else value


def _unit_of(dimension: str) -> Callable[[str], str]:
    def check(text: str) -> str:
        units.parse(f"1 {text}", dimension)
        return text

    return check


TextList = Annotated[tuple[q.AnyText, ...], BeforeValidator(listed), Field(min_length=1, max_length=8)]
TemperatureUnit = Annotated[q.Text, AfterValidator(_unit_of("temperature"))]
RampUnit = Annotated[q.Text, AfterValidator(_unit_of("temperature slope"))]
AngleUnit = Annotated[q.Text, AfterValidator(_unit_of("angle"))]
RateUnit = Annotated[q.Text, AfterValidator(_unit_of("angular rate"))]
AngularAccelerationUnit = Annotated[q.Text, AfterValidator(_unit_of("angular acceleration"))]
AccelerationUnit = Annotated[q.Text, AfterValidator(_unit_of("acceleration"))]
Modulus = Annotated[int, Field(strict=True, ge=2, le=2**64)]
"""The value at which a counter or a time restarts at 0."""


class DeviceUnits(Section):
    """`[units]`: units of the numbers that the device sends and receives."""

    temperature: TemperatureUnit = "degC"
    """Unit of temperatures."""
    ramp: RampUnit = "K/min"
    """Unit of the chamber's slopes."""
    angle: AngleUnit = "deg"
    """Unit of angles."""
    rate: RateUnit = "deg/s"
    """Unit of rates."""
    acceleration: AngularAccelerationUnit = "deg/s^2"
    """Unit of accelerations."""


class DeviceLimits(Section):
    """`[limits]`: limits of a chamber or of an axis."""

    lowest: q.Temperature | None = None
    """Coldest temperature that the device accepts."""
    highest: q.Temperature | None = None
    """Warmest temperature that the device accepts."""
    slowest: q.PositiveTemperatureSlope | None = None
    """Slowest ramp that the device accepts."""
    fastest: q.PositiveTemperatureSlope | None = None
    """Fastest ramp that the device accepts."""
    free_ramp: q.Number | None = None
    """Number that the device interprets as a ramp "as fast as possible"."""
    max_rate: q.PositiveRate | None = None
    """Largest rate of the axis."""
    max_acceleration: q.PositiveAcceleration | None = None
    """Largest acceleration of the axis."""
    step: q.PositiveAngle | None = None
    """Smallest step of the angle set point."""
    lowest_angle: q.Angle | None = None
    """Lowest angle that the device accepts."""
    highest_angle: q.Angle | None = None
    """Highest angle that the device accepts."""
    spin_angle: q.PositiveAngle | None = None
    """Largest angle of a turn at constant rate (a spin)."""


class Condition(Section):
    """`[state.NAME]` or `[alarm.NAME]`: it holds if a field equals one of these texts, equals none of them, begins with
    one of them, or has a bit set."""

    field: q.Text
    """Name of the field."""
    equals: TextList = ()
    """It holds if the field equals one of these texts."""
    not_equals: TextList = ()
    """It holds if the field equals none of these texts."""
    begins: TextList = ()
    """It holds if the field begins with one of these texts."""
    bit: q.Whole | None = None
    """It holds if this bit of the field, counted from 0, is set."""

    def _problems(self) -> Iterator[Problem]:
        if len(self.model_fields_set) != 2:
            yield Problem((), "use exactly one of equals, not_equals, begins and bit")

    def holds(self, text: str) -> bool:
        """Whether it holds, by the device's reply. An invalid number raises `ValueError`."""
        if self.bit is not None:
            return bool(int(float(text)) >> self.bit & 1)
        if self.not_equals:
            return text not in self.not_equals
        return text in self.equals or text.startswith(self.begins)


class RequiredSetting(Section):
    """`[[require]]`: a setting that the device must have before the first command, and the reason for it."""

    field: q.Text
    """Name of the field of a reply that shows the setting."""
    equals: TextList
    """Texts that are allowed in the field."""
    why: q.Text
    """What goes wrong if the setting is different."""


Commands = Mapping[str, Mapping[str, str]]
"""The commands of each role, and the values that they may contain."""


class DeviceDescription(Section):
    """What the descriptions of all devices that answer requests have."""

    title: q.Text
    """A title for tables and pages."""
    on_first: q.Flag = False
    """Whether the device accepts a set point only while it is switched on and conditions the chamber."""
    units: DeviceUnits = DeviceUnits()
    """Units of the numbers that the device sends and receives."""
    limits: DeviceLimits = DeviceLimits()
    """Limits of the device."""
    state: dict[DeviceState, Condition] = Field(default_factory=dict[DeviceState, Condition])
    """States of the device that can be seen in fields, by name."""
    alarm: dict[str, Condition] = Field(default_factory=dict[str, Condition])
    """Alarms of a chamber, by name."""
    require: Annotated[tuple[RequiredSetting, ...], Field(max_length=20)] = ()
    """Settings that the device must have before the first command."""

    commands: ClassVar[Commands]

    @property
    def fields(self) -> Mapping[str, Any]:
        """Every field that can be read."""
        return {}

    @property
    def needed(self) -> str:
        """The keys that it must have; for those of `ask` and `registers` a field."""
        return ""

    def unknown(self, key: Key, *fields: str) -> Iterator[Problem]:
        """Fields that no reply has."""
        for field in fields:
            if field not in self.fields:
                yield Problem(key, f"no reply has the field {{{field}}}; {instead(field, self.fields)}", field)

    def _problems(self) -> Iterator[Problem]:
        conditions = {("state", name): entry for name, entry in self.state.items()}
        conditions |= {("alarm", name): entry for name, entry in self.alarm.items()}
        conditions |= {("require", index): entry for index, entry in enumerate(self.require)}
        for place, entry in conditions.items():
            yield from self.unknown((*place, "field"), entry.field)
        described: Any = self
        for command, states in SHOWN_IN.items():
            if command in described.tell and not set(states) & set(self.state):
                yield missing(
                    ("state", states[0]), f": without this state, no reply shows the effect of tell.{command}"
                )
        for key in self.needed.split():
            table, name = key.split(".")
            there = self.fields if table in ("ask", "registers") else dict(getattr(self, table))
            if there.get(name) is None:
                yield missing((table, name), f"; a {described.role} needs it")
        known = self.commands[described.role]
        for name in described.tell:
            if name not in known:
                yield Problem(("tell", name), f"is not a command of a {described.role}; {instead(name, known)}")


class DescribedSensor(Section):
    """What the descriptions of all sensors have."""

    title: q.Text = "The sensor"
    """A title for tables and pages."""
    rate: q.Frequency
    """Number of samples per second."""
    baudrate: q.Count | Annotated[int, Field(strict=True, gt=10**6, le=10**7)] = 115200
    """Bits per second."""
    boot: q.SizeOfTime = q.Quantity(0.0, "0 s", "time")
    """Waiting time after the port is opened, because opening it restarts many boards."""
    timeout: q.Time = q.Quantity(3.0, "3 s", "time")
    """Timeout for the sensor's first samples."""


def missing(key: Key, message: str) -> Problem:
    """A key that is missing, and why it is needed."""
    return Problem(key, f"this key is missing{message}", kind="missing")


def described(kind: type[Model], value: str | Mapping[str, Any], changes: Mapping[str, Any] | None = None) -> Model:
    """The description of a rig file: the name of one of this program's, or its own tables; and what differs from it.

    Raises:
        ValueError: no such name, or (as `SpecError`) everything that is wrong with the tables.
    """
    (form,) = get_args(kind.model_fields["format"].annotation)
    name, names = "", shipped(form)
    if isinstance(value, str):
        if value not in names:
            raise ValueError(f"expected the name of a protocol, or the tables of one; {instead(value, names)}")
        name, value = value, read_toml(protocol_text(value), value)
    return model_of(kind, changed_tables(value, changes or {}), form, name)


def changed_tables(tables: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Tables with some keys changed, table by table; `false` in the place of a table removes it."""
    result = dict(tables)
    for name, change in changes.items():
        before = result.get(name)
        if change is False and not isinstance(before, bool):
            result.pop(name, None)
        elif isinstance(change, Mapping) and isinstance(before, Mapping):
            result[name] = changed_tables(before, change)  # pyright: ignore[reportUnknownArgumentType]
        else:
            result[name] = change
    return result


def shipped(kind: str) -> tuple[str, ...]:
    """The names of the descriptions of a format that come with this program."""
    files = (file for file in _DEVICES.iterdir() if f'"{kind}"' in file.read_text("utf-8"))
    return tuple(sorted(file.name.removesuffix(".toml") for file in files))


def protocol_text(name: str) -> str:
    """The TOML text of a description that comes with this program."""
    return (_DEVICES / f"{name}.toml").read_text(encoding="utf-8")
