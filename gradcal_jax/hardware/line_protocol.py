"""`gradcal-lines/1`: the description of a device with a text protocol, without code; `presets/devices` has examples.

In a reply `{name}` is a number, `{name:text}` the text up to the next character of the template, `{name:char}` one
character; a field without a name is ignored. A reply must show the value of every command: a protocol in which a set
value cannot be read back is refused. The order and verification of commands are in the driver
(`hardware.drivers.lines`). There is no logic here, and no regular expression, because a file may be untrusted.
"""

import re
from collections.abc import Iterator, Mapping
from importlib import resources
from typing import Annotated, Any, Final, Literal, cast, get_args

from pydantic import BeforeValidator, Field

from gradcal_jax import units
from gradcal_jax.tables import quantity as q
from gradcal_jax.tables.document import Model, model_of, read_toml
from gradcal_jax.tables.problems import Key, Problem, instead
from gradcal_jax.tables.section import Section

LINES: Final = "gradcal-lines/1"
DeviceState = Literal["conditioning", "program", "ramps", "alarm", "moving", "fault", "powered"]
# The state in which the effect of a command is seen.
CHAMBER_STATES: Final = {"on": "conditioning", "off": "conditioning", "end_program": "program", "no_ramp": "ramps"}
AXIS_STATES: Final = {"on": "powered"}
_FIELD: Final = re.compile(r"\{([a-z_]*)(?::(text|char))?\}")
_VALUE: Final = re.compile(r"\{([a-z]+):(0?\d{0,2}(?:\.\d)?f|g)\}")
# Further decimals of a device are rounding errors.
_FINEST_DECIMALS: Final = 3
NUMBER: Final = r"[-+]?+\d++(?:\.\d*+)?+"
_DEVICES: Final = resources.files("gradcal_jax.spec.presets") / "devices"


def _listed(value: object) -> object:
    return (value,) if isinstance(value, str) else value


Texts = Annotated[tuple[q.AnyText, ...], BeforeValidator(_listed), Field(max_length=8)]
# A reply may be empty except for its end.
Replies = Annotated[tuple[Annotated[str, Field(strict=True, max_length=2000)], ...], BeforeValidator(_listed)]


class Line(Section):
    """`[line]`: the settings of the line. With `frame` "stx-etx-xor8", a message is STX, `address`, the text with bit 7
    set, the exclusive or of these bytes, and ETX."""

    baudrate: q.Count = 9600
    """Bits per second."""
    bytesize: Literal[7, 8] = 8
    """Data bits of a character."""
    parity: Literal["N", "E", "O"] = "N"
    """Parity: none, even or odd."""
    stopbits: Literal[1, 2] = 1
    """Stop bits of a character."""
    frame: Literal["plain", "stx-etx-xor8"] = "plain"
    """"plain" lines, or frames of STX, address, text, checksum and ETX."""
    address: Annotated[int, Field(strict=True, ge=128, le=255)] = 129
    """Address of the device in such frames."""
    prefix: Annotated[str, Field(strict=True, max_length=20)] = ""
    """Text at the beginning of every sent line, such as the device's address."""
    ends: Annotated[str, Field(strict=True, max_length=4)] = "\r\n"
    """Text at the end of every sent line."""
    reply_ends: Annotated[str, Field(strict=True, max_length=4)] = ""
    """Text at the end of every reply; empty: the same as `ends`."""
    timeout: q.Time = q.Quantity(2.0, "2 s", "time")
    """Timeout for a reply."""
    pause: q.SizeOfTime = q.Quantity(0.0, "0 s", "time")
    """Least time between two messages."""
    boot: q.SizeOfTime = q.Quantity(0.0, "0 s", "time")
    """Waiting time after the port is opened, because opening it restarts many boards."""
    pause_after_command: q.SizeOfTime = q.Quantity(0.0, "0 s", "time")
    """Waiting time between a command and the next message."""
    refusal: q.AnyText | None = None
    """Text with which a reply begins if the device refuses a command."""
    hint: q.Text | None = None
    """What to check if the device does not answer."""


def unit_problems(table: Section, kinds: Mapping[str, str]) -> Iterator[Problem]:
    """Keys of a table that hold no unit of their dimension, by `kinds`."""
    for name, kind in kinds.items():
        try:
            units.parse(f"1 {getattr(table, name)}", kind)
        except ValueError as problem:
            yield Problem((name,), str(problem), getattr(table, name))


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


class DeviceUnits(Section):
    """`[units]`: units of the numbers that the device sends and receives."""

    temperature: q.Text = "degC"
    """Unit of temperatures."""
    ramp: q.Text = "K/min"
    """Unit of the chamber's slopes."""
    angle: q.Text = "deg"
    """Unit of angles."""
    rate: q.Text = "deg/s"
    """Unit of rates."""
    acceleration: q.Text = "deg/s^2"
    """Unit of accelerations."""

    def _problems(self) -> Iterator[Problem]:
        kinds = ("temperature", "temperature slope", "angle", "angular rate", "angular acceleration")
        return unit_problems(self, dict(zip(DeviceUnits.model_fields, kinds, strict=True)))


class DeviceLimits(Section):
    """`[limits]`: limits of a chamber or of an axis."""

    lowest: q.Temperature | None = None
    """Coldest temperature that the device accepts."""
    highest: q.Temperature | None = None
    """Warmest temperature that the device accepts."""
    resolution: q.PositiveTemperatureDifference = q.Quantity(0.1, "0.1 K", "temperature difference")
    """Smallest step of the temperature set point."""
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


class LineQuestion(Section):
    """`[ask.NAME]`: a question to the device. If `last` is given, the reply has several lines; otherwise several
    entries of `reply` are alternative forms of one line, and a text field that a form lacks is empty."""

    send: q.AnyText
    """Text of the question."""
    reply: Annotated[Texts, Field(min_length=1)]
    """The reply, with fields in braces; several entries: the lines of one reply, or alternative forms (see above)."""
    last: q.AnyText | None = None
    """The last line of a reply that has several lines."""
    bare: q.Flag = False
    """Whether the question is sent without the text at the end of a line (`ends`)."""

    @property
    def fields(self) -> dict[str, str]:
        """Its fields' names -> their kinds."""
        fields = (match for reply in self.reply for match in _FIELD.finditer(reply))
        return {match[1]: match[2] or "number" for match in fields if match[1]}

    def _problems(self) -> Iterator[Problem]:
        fields = ((match for match in _FIELD.finditer(reply) if match[1]) for reply in self.reply)
        forms = [sorted(match[1] for match in form if match[2] != "text") for form in fields]
        if self.last is None and any(form != forms[0] for form in forms):
            message = (
                "this key is missing: the entries of reply have different fields, so they are the lines of one reply; "
                "state the last line of this reply"
            )
            yield Problem(("last",), message, kind="missing")


class Command(Section):
    """`[tell.NAME]`: a command to the device."""

    send: Annotated[Texts, Field(min_length=1)]
    """Text of the command, with values in braces; several entries: several lines."""
    reply: Replies = ()
    """Reply that acknowledges the command; empty: the device does not reply."""
    shown_by: Texts = ()
    """Fields of replies that show the commanded value."""
    bare: q.Flag = False
    """Whether the command is sent without the text at the end of a line (`ends`)."""
    reply_when_done: q.Flag = False
    """Whether the acknowledgement comes only after completion, for example at the end of a homing."""


class Condition(Section):
    """`[state.NAME]`: the device is in this state if a field equals one of these texts, equals none of them, begins
    with one of them, has a bit set, or is below a number."""

    field: q.Text
    """Name of the field of a reply."""
    equals: Texts = ()
    """The device is in this state if the field equals one of these texts."""
    not_equals: Texts = ()
    """The device is in this state if the field equals none of these texts."""
    begins: Texts = ()
    """The device is in this state if the field begins with one of these texts."""
    bit: q.Whole | None = None
    """The device is in this state if this bit of the field, counted from 0, is set."""
    below: q.Number | None = None
    """The device is in this state if the field is a number below this value."""

    def _problems(self) -> Iterator[Problem]:
        tests = (self.equals, self.not_equals, self.begins, self.bit is not None, self.below is not None)
        if sum(map(bool, tests)) != 1:
            yield Problem((), "use exactly one of equals, not_equals, begins, bit and below")

    def holds(self, text: str) -> bool:
        """Whether the state holds, by the device's reply. An invalid number raises `ValueError`."""
        if self.bit is not None:
            return bool(int(float(text)) >> self.bit & 1)
        if self.below is not None:
            return float(text) < self.below
        if self.not_equals:
            return text not in self.not_equals
        return text in self.equals or (bool(self.begins) and text.startswith(self.begins))


class RequiredSetting(Section):
    """`[[require]]`: a setting that the device must have before the first command, and the reason for it."""

    field: q.Text
    """Name of the field of a reply that shows the setting."""
    equals: Texts
    """Texts that are allowed in the field."""
    why: q.Text
    """What goes wrong if the setting is different."""


class DeviceDescription(Section):
    """What the descriptions of all devices that answer requests have."""

    title: q.Text
    """A title for tables and pages."""
    units: DeviceUnits = DeviceUnits()
    """Units of the numbers that the device sends and receives."""
    limits: DeviceLimits = DeviceLimits()
    """Limits of the device."""
    state: dict[DeviceState, Condition] = Field(default_factory=dict[DeviceState, Condition])
    """States of the device that can be seen in fields, by name."""
    require: Annotated[tuple[RequiredSetting, ...], Field(max_length=20)] = ()
    """Settings that the device must have before the first command."""

    @property
    def fields(self) -> Mapping[str, Any]:
        """Every field that can be read."""
        return {}

    def _unknown(self, key: Key, *fields: str) -> Iterator[Problem]:
        for field in fields:
            if field not in self.fields:
                yield Problem(key, f"no reply has the field {{{field}}}; {instead(field, self.fields)}", field)

    def _problems(self) -> Iterator[Problem]:
        for name, entry in self.state.items():
            yield from self._unknown(("state", name, "field"), entry.field)
        for index, entry in enumerate(self.require):
            yield from self._unknown(("require", index, "field"), entry.field)
        shown_by = CHAMBER_STATES if getattr(self, "role", "") == "chamber" else AXIS_STATES
        for command, state in shown_by.items():
            if command in getattr(self, "tell", ()) and state not in self.state:
                message = f"this key is missing: without this state, no reply shows the effect of tell.{command}"
                yield Problem(("state", state), message, kind="missing")


class LineProtocol(DeviceDescription):
    """A complete description of a device that communicates by lines of text."""

    format: Literal["gradcal-lines/1"]
    """Name and version of this file format."""
    role: Literal["chamber", "axis"]
    """Kind of device."""
    line: Line = Line()
    """Settings of the line."""
    ask: dict[str, LineQuestion]
    """Questions, by name."""
    tell: dict[str, Command]
    """Commands, by name."""

    @property
    def fields(self) -> dict[str, str]:
        """Every field that can be read -> the question that it is in."""
        return {field: name for name, question in self.ask.items() for field in question.fields}

    def _problems(self) -> Iterator[Problem]:
        needed = _NEEDED[self.role] + ("limits.free_ramp",) * ("ramp" in self.tell)
        for key in needed:
            table, name = key.split(".")
            there: Any = self.fields if table == "ask" else getattr(self, table)
            if (getattr(there, name) is None) if table == "limits" else name not in there:
                message = f"this key is missing; a {self.role} needs it"
                message = f"a {self.role} needs a reply with the field {{{name}}}" if table == "ask" else message
                yield Problem((table,) if table == "ask" else (table, name), message, kind="missing")
        commands = _COMMANDS[self.role].split()
        for name, command in self.tell.items():
            if name not in commands:
                yield Problem(("tell", name), f"is not a command of a {self.role}; {instead(name, commands)}")
            for problem in self._of_command(name, command):
                yield Problem(("tell", name, *problem.key), problem.message, problem.value, problem.kind)
        for name, question in self.ask.items():
            for reply in (*question.reply, question.last or ""):
                if message := _unclear(reply):
                    yield Problem(("ask", name, "reply"), message, reply)
        line = self.line
        spoken = [*(question.send for question in self.ask.values()), *(s for c in self.tell.values() for s in c.send)]
        if any(ord(letter) > 255 for text in (*spoken, line.prefix, line.ends, line.reply_ends) for letter in text):
            yield Problem((), "only single-byte characters can be sent")

    def _of_command(self, name: str, command: Command) -> Iterator[Problem]:
        """A command must be sent with values that it has, and a value that is set must be read back."""
        known = _VALUES.get(name, "").split()
        written = {match.groups() for send in command.send for match in _VALUE.finditer(send)}
        if any({"{", "}"} & set(_VALUE.sub("", send)) for send in command.send):
            yield Problem(("send",), "expected values in braces, such as {setpoint:.1f}")
        if wrong := {value for value, _ in written} - set(known):
            allowed = ", ".join(f"{{{value}}}" for value in known) or "none"
            message = (
                f"the placeholder {{{sorted(wrong)[0]}}} cannot be used in this command; it may contain: {allowed}"
            )
            yield Problem(("send",), message)
        if (name == "setpoint" or command.shown_by) and len(written) != 1:
            message = (
                "expected exactly one placeholder, with the same format wherever it appears, such as {setpoint:.1f}"
            )
            yield Problem(("send",), message)
        if command.reply and len(command.reply) not in (1, len(command.send)):
            message = f"expected one reply, or {len(command.send)} replies: one for each line of send"
            yield Problem(("reply",), message)
        if name in _SHOWN_BY_THEMSELVES and not command.shown_by:
            message = "every value that is set must be read back; expected the fields of replies that show it"
            yield Problem(("shown_by",), f"this key is missing: {message}", kind="missing")
        yield from self._unknown(("shown_by",), *command.shown_by)


_NEEDED: Final[Mapping[str, tuple[str, ...]]] = {
    "chamber": (
        "ask.air", "ask.setpoint", "state.conditioning", "limits.lowest", "limits.highest",
        "tell.setpoint", "tell.on", "tell.off",
    ),
    "axis": (
        "ask.position", "state.moving", "limits.max_rate", "limits.max_acceleration", "limits.step",
        "tell.home", "tell.move", "tell.stop",
    ),
}  # fmt: skip
_COMMANDS: Final[Mapping[str, str]] = {
    "chamber": "setpoint ramp on off end_program",
    "axis": "home stop_homing move spin stop rate acceleration on off",
}
_VALUES: Final[Mapping[str, str]] = {
    "setpoint": "setpoint", "ramp": "ramp", "rate": "rate", "acceleration": "acceleration",
    "move": "position rate acceleration", "spin": "position rate acceleration velocity way",
}  # fmt: skip
_SHOWN_BY_THEMSELVES: Final = frozenset({"ramp", "rate", "acceleration"})


def _unclear(template: str) -> str:
    """Why a reply's fields cannot be told apart; empty: they can."""
    if {"{", "}"} & set(_FIELD.sub("", template)):
        return "expected fields in braces, such as {air}, {state:text} or {running:char}"
    for match in _FIELD.finditer(template):
        rest = template[match.end() :]
        after = _FIELD.match(rest)
        if match[2] == "text" and after is not None:
            return "a text field ends at the character that follows it: expected one between two fields"
        if match[2] is None and (rest[:1].isdigit() or rest[:1] == "." or (after is not None and after[2] is None)):
            return "a number ends at a character that no number has: expected one between two numbers or digits"
    return ""


def reply_pattern(template: str, number: str = NUMBER, *, tabs: bool = False, padded: bool = False) -> re.Pattern[str]:
    """The pattern of a line, with the fields as named groups.

    One or more blanks stand for blanks of the template; blanks may also surround commas and colons and, if `padded`,
    numbers. With `tabs`, tabs are blanks. Every part is possessive and no two neighbours accept the same blank, so that
    a line that does not match is refused in a time that is linear in its length, whatever the template.
    """
    blank = r"[ \t]" if tabs else " "
    parts = ["", *_parts(template, number, blank, padded=padded)]
    pattern, gap = "", ""
    for part in parts:
        if part in (_SOME, _ANY):
            gap = _SOME if _SOME in (gap, part) else _ANY
            continue
        pattern += gap and f"{blank}{gap}"
        pattern, gap = pattern + part, ""
    return re.compile(pattern + (gap and f"{blank}{gap}"), re.DOTALL)


# Possessive repetitions: at least one blank, or any number.
_SOME: Final = "++"
_ANY: Final = "*+"


def _parts(template: str, number: str, blank: str, *, padded: bool) -> Iterator[str]:
    """The pattern's parts, and between them the repetitions of blanks."""
    place = 0
    for match in _FIELD.finditer(template):
        yield from _literal(template[place : match.start()])
        place = match.end()
        kind = match[2] or "number"
        if kind == "text":
            end = template[place : place + 1]
            end = blank.strip("[]") if end == " " else re.escape(end)
            group = f"([^{end}]*+)" if end else "(.*+)"
        else:
            group = "(.)" if kind == "char" else f"({number})"
        around = padded and kind == "number"
        if around:
            yield _ANY
        yield group.replace("(", f"(?P<{match[1]}>", 1) if match[1] else group
        if around:
            yield _ANY
    yield from _literal(template[place:])


def _literal(text: str) -> Iterator[str]:
    for piece in re.findall(r" +|[,:]|[^ ,:]+", text):
        if piece[0] == " ":
            yield _SOME
        elif piece in ",:":
            yield from (_ANY, piece, _ANY)
        else:
            yield re.escape(piece)


def formatted(template: str, values: Mapping[str, float]) -> tuple[str, dict[str, str]]:
    """A command with its values, and the text of each value."""
    written: dict[str, str] = {}

    def write(match: re.Match[str]) -> str:
        text = format(values[match[1]], match[2])
        # No minus sign before zero.
        written[match[1]] = text if float(text) else format(0.0, match[2])
        return written[match[1]]

    return _VALUE.sub(write, template), written


def shows(sent: str, reply: str) -> bool:
    """Whether a number that is read back equals the one sent, to half a step of the device's own decimals."""
    decimals = min(len(reply.partition(".")[2]), _FINEST_DECIMALS)
    return abs(float(sent) - float(reply)) <= 0.51 * 10.0**-decimals


def described(kind: type[Model], value: object, changes: object = None) -> Model:
    """The description of a rig file: the name of one of this program's, or its own tables; and what differs from it.

    Raises:
        ValueError: no such name, or (as `SpecError`) everything that is wrong with the tables.
    """
    (form,) = get_args(kind.model_fields["format"].annotation)
    name, names = value if isinstance(value, str) else "", shipped(form)
    if isinstance(value, Mapping):
        tables = cast("Mapping[str, Any]", value)
    elif name in names:
        tables = read_toml(protocol_text(name), name)
    else:
        raise ValueError(f"expected the name of a protocol, or the tables of one; {instead(name, names)}")
    return model_of(kind, changed_tables(tables, changes), form, name)


def changed_tables(tables: Mapping[str, Any], changes: object) -> dict[str, Any]:
    """Tables with some keys changed, table by table; `false` in the place of a table removes it."""
    if changes is None:
        return dict(tables)
    if not isinstance(changes, Mapping):
        raise ValueError("changes must be a table, with the changed keys in the tables of the description")
    result = dict(tables)
    for name, change in cast("Mapping[str, Any]", changes).items():
        before = result.get(name)
        if change is False and not isinstance(before, bool):
            result.pop(name, None)
        elif isinstance(change, Mapping) and isinstance(before, Mapping):
            result[name] = changed_tables(cast("Mapping[str, Any]", before), cast("object", change))
        else:
            result[name] = change
    return result


def shipped(kind: str = LINES) -> tuple[str, ...]:
    """The names of the protocols of a format that come with this program."""
    names = (file.name for file in _DEVICES.iterdir() if file.name.endswith(".toml"))
    return tuple(sorted(n.removesuffix(".toml") for n in names if f'"{kind}"' in (_DEVICES / n).read_text("utf-8")))


def protocol_text(name: str) -> str:
    """The TOML text of a protocol that comes with this program."""
    return (_DEVICES / f"{name}.toml").read_text(encoding="utf-8")
