"""`gradcal-lines/1`: the description of a chamber or an axis with a text protocol, without code.

`templates` has the form of lines. A reply must show the value of every command: a protocol in which a set value cannot
be read back is refused. The order and verification of commands are in the drivers (`hardware.drivers`).
"""

from collections.abc import Iterator
from typing import Annotated, ClassVar, Final, Literal

from pydantic import BeforeValidator, Field

from gradcal_jax.hardware.checksums import xor8
from gradcal_jax.hardware.description import Commands, DeviceDescription, TextList, listed, missing
from gradcal_jax.hardware.templates import FIELD, VALUE
from gradcal_jax.tables import quantity as q
from gradcal_jax.tables.problems import Problem
from gradcal_jax.tables.section import Section

LINES: Final = "gradcal-lines/1"
Sent = Annotated[str, Field(strict=True, max_length=2000, pattern="^[\\x00-\\xff]*$")]
"""Text of single-byte characters."""
SentList = Annotated[tuple[Sent, ...], BeforeValidator(listed), Field(min_length=1, max_length=8)]
# A reply may be empty except for its end.
Replies = Annotated[tuple[Annotated[str, Field(strict=True, max_length=2000)], ...], BeforeValidator(listed)]


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
    """Text at the end of every reply; empty: CR, LF or both."""
    timeout: q.Time = q.Quantity(2.0, "2 s", "time")
    """Timeout for a reply."""
    pause: q.SizeOfTime = q.Quantity(0.0, "0 s", "time")
    """Least time between two messages."""
    boot: q.SizeOfTime = q.Quantity(0.0, "0 s", "time")
    """Waiting time after the port is opened, because opening it restarts many boards."""
    pause_after_command: q.SizeOfTime = q.Quantity(0.0, "0 s", "time")
    """Waiting time between a command and the next message."""
    refusal: q.AnyText | None = None
    """Reply by which the device refuses a command."""

    def message(self, text: str, *, bare: bool = False) -> bytes:
        """The bytes of a text; `bare`: without `ends`."""
        body = (self.prefix + text).encode("latin-1")
        if self.frame == "plain":
            return body if bare else body + self.ends.encode("latin-1")
        body = bytes([self.address]) + bytes(byte | 0x80 for byte in body)
        return b"\x02" + body + bytes([xor8(body) | 0x80, 3])

    def texts(self, received: bytes) -> list[str]:
        """The complete messages among bytes; those that are damaged are left out."""
        if self.frame != "plain":
            *framed, _ = received.split(b"\x03")
            bodies = (bytes(byte & 0x7F for byte in frame.rpartition(b"\x02")[2]) for frame in framed if 2 in frame)
            address = self.address & 0x7F
            frames = [body[1:-1] for body in bodies if len(body) > 1 and body[0] == address and not xor8(body)]
        elif self.reply_ends:
            *frames, _ = received.split(self.reply_ends.encode("latin-1"))
        else:
            *lines, _ = received.replace(b"\r", b"\n").split(b"\n")
            frames = list(filter(None, lines))
        texts = [frame.strip(b" \t\r\n\x11\x13").decode("latin-1") for frame in frames]
        return [text for text in texts if text.isprintable()]


class LineQuestion(Section):
    """`[ask.NAME]`: a question to the device. If `last` is given, the reply has several lines; otherwise several
    entries of `reply` are alternative forms of one line, and a text field that a form lacks is empty."""

    send: Sent
    """Text of the question."""
    reply: TextList
    """The reply, with fields in braces; several entries: the lines of one reply, or alternative forms (see above)."""
    last: q.AnyText | None = None
    """The last line of a reply that has several lines."""
    bare: q.Flag = False
    """Whether the question is sent without the text at the end of a line (`ends`)."""

    @property
    def fields(self) -> list[str]:
        """Its fields' names."""
        return [match[1] for reply in self.reply for match in FIELD.finditer(reply) if match[1]]

    def _problems(self) -> Iterator[Problem]:
        fields = ((match for match in FIELD.finditer(reply) if match[1]) for reply in self.reply)
        forms = [sorted(match[1] for match in form if match[2] != "text") for form in fields]
        if self.last is None and any(form != forms[0] for form in forms):
            message = ": the entries of reply have different fields, so they are the lines of one reply"
            yield missing(("last",), message)


class Command(Section):
    """`[tell.NAME]`: a command to the device."""

    send: SentList
    """Text of the command, with values in braces; several entries: several lines."""
    reply: Replies = ()
    """Reply that acknowledges the command, one for all lines or one for each; empty: the device does not reply."""
    shown_by: TextList = ()
    """Fields of replies that show the commanded value."""
    bare: q.Flag = False
    """Whether the command is sent without the text at the end of a line (`ends`)."""
    reply_when_done: q.Flag = False
    """Whether the acknowledgement comes only after completion, for example at the end of a homing."""

    def _problems(self) -> Iterator[Problem]:
        if any({"{", "}"} & set(VALUE.sub("", send)) for send in self.send):
            yield Problem(("send",), "expected values in braces, such as {setpoint:.1f}")
        if self.reply and len(self.reply) not in (1, len(self.send)):
            yield Problem(("reply",), f"expected one reply, or {len(self.send)}: one for each line of send")


class LineProtocol(DeviceDescription):
    """A complete description of a device that communicates by lines of text."""

    commands: ClassVar[Commands] = {
        "chamber": {"setpoint": "setpoint", "ramp": "ramp", "on": "", "off": "", "end_program": ""},
        "axis": {
            "home": "", "stop_homing": "", "stop": "", "on": "", "off": "",
            "rate": "rate", "acceleration": "acceleration",
            "move": "position rate acceleration", "spin": "rate acceleration velocity way",
        },
    }  # fmt: skip

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

    @property
    def needed(self) -> str:
        return _NEEDED[self.role] + " limits.free_ramp" * ("ramp" in self.tell)

    def _problems(self) -> Iterator[Problem]:
        for name, command in self.tell.items():
            for problem in self._of_command(name, command):
                yield problem.under("tell", name)

    def _of_command(self, name: str, command: Command) -> Iterator[Problem]:
        """A command must be sent with values that it has, and a value that is set must be read back."""
        known = self.commands[self.role].get(name, "").split()
        written = {match.groups() for send in command.send for match in VALUE.finditer(send)}
        if wrong := {value for value, _ in written} - set(known):
            allowed = ", ".join(f"{{{value}}}" for value in known) or "none"
            message = f"the placeholder {{{sorted(wrong)[0]}}} cannot be used in this command; allowed: {allowed}"
            yield Problem(("send",), message)
        if (name == "setpoint" or command.shown_by) and len(written) != 1:
            message = "expected one placeholder, with the same format everywhere, such as {setpoint:.1f}"
            yield Problem(("send",), message)
        if name in ("ramp", "rate", "acceleration") and not command.shown_by:
            yield missing(("shown_by",), ": every value that is set must be read back by fields of replies")
        yield from self.unknown(("shown_by",), *command.shown_by)


_NEEDED: Final = {
    "chamber": "ask.air ask.setpoint state.conditioning limits.lowest limits.highest tell.setpoint tell.on tell.off",
    "axis": "ask.position state.moving limits.max_rate limits.max_acceleration limits.step "
    "tell.home tell.move tell.stop",
}
