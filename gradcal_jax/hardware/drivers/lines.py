"""Devices with a text protocol that a rig file describes (`hardware.line_protocol`): chambers and axes.

The description has the queries, commands and replies; this driver has their order and verification:

* a chamber's commands are read back; it shows a ramp's rate before it gets the target, so that no lost line makes it go
  at full speed;
* an axis that moves is stopped before another command, unless commands can be read back; after the command of a move
  the driver verifies that the axis moves or has arrived.

Damage can turn a line without a checksum into another valid line: a move is verified only by the axis's final angle,
which the caller must compare (`hardware.axis_control` does).

Unverified on real hardware: everything; each description says what its sources leave open.
"""

import math
import re
import threading
from collections.abc import Mapping
from functools import cache, cached_property

from gradcal_jax import units
from gradcal_jax.hardware.checksums import xor8
from gradcal_jax.hardware.clock import Clock
from gradcal_jax.hardware.drivers.base import (
    AxisDriver,
    AxisOptions,
    DescribedChamber,
    DescribedDevice,
    RequestOptions,
    Texts,
)
from gradcal_jax.hardware.errors import (
    ChecksumError,
    DeviceFault,
    FramingError,
    NotVerified,
    Rejected,
    ReplyTimeout,
    printable,
)
from gradcal_jax.hardware.framing import LineFramer, NotThisReply
from gradcal_jax.hardware.line_protocol import LineProtocol, LineQuestion, described, formatted, reply_pattern, shows
from gradcal_jax.hardware.request_reply import Exchange
from gradcal_jax.hardware.roles import AxisLimits, AxisReading, Identity, KeptSettings, SafeReport
from gradcal_jax.hardware.transport import Transport
from gradcal_jax.tables.quantity import Angle, PositiveAcceleration, PositiveRate

_STOPS_AGAIN_S = 1.0
_pattern = cache(reply_pattern)


class LinesConfig(RequestOptions, AxisOptions):
    """Options of the rig file; limits that are absent are the description's."""

    max_rate: PositiveRate | None = None
    """Largest rate of the axis."""
    max_acceleration: PositiveAcceleration | None = None
    """Largest acceleration of the axis."""
    lowest: Angle | None = None
    """Lowest angle of the axis."""
    highest: Angle | None = None
    """Highest angle of the axis."""

    @cached_property
    def described(self) -> LineProtocol:
        return described(LineProtocol, self.protocol, self.changes)

    def link(self, line: Transport, clock: Clock) -> Exchange:
        return self.exchange(line, clock, Codec(self.described).framer(), boot_s=float(self.described.line.boot))

    def device(
        self, link: Exchange, clock: Clock, name: str = "", encoder: object = None
    ) -> "LinesChamber | LinesAxis":
        return (LinesChamber if self.described.role == "chamber" else LinesAxis)(link, self)

    def lacks_for(self, safe: str) -> str:
        if safe != "unpower" or {"off", "powered"} <= {*self.described.tell, *self.described.state}:
            return ""
        return 'its protocol lacks [tell.off], or [state.powered] that shows its effect: add both, or choose "hold"'


class Codec:
    def __init__(self, protocol: LineProtocol) -> None:
        self._protocol = protocol
        self._framed = protocol.line.frame == "stx-etx-xor8"

    def framer(self) -> LineFramer:
        ends = b"\x03" if self._framed else self._protocol.line.reply_ends.encode("latin-1")
        return LineFramer(ends or None, keep_empty=bool(ends))

    def message(self, text: str, *, bare: bool = False) -> bytes:
        body = (self._protocol.line.prefix + text).encode("latin-1")
        if not self._framed:
            return body if bare else body + self._protocol.line.ends.encode("latin-1")
        body = bytes([self._protocol.line.address]) + bytes(byte | 0x80 for byte in body)
        return b"\x02" + body + bytes([xor8(body) | 0x80, 3])

    def text(self, frame: bytes) -> str:
        """Raises `ChecksumError`, `FramingError`, and `Rejected` for a refusal."""
        if self._framed:
            begins = frame.rfind(b"\x02")
            body = bytes(byte & 0x7F for byte in frame[begins + 1 :])
            if begins < 0 or len(body) < 2 or body[0] != self._protocol.line.address & 0x7F or xor8(body):
                raise ChecksumError(f"{printable(frame)!r} has a wrong checksum. Check the line's shielding.")
            frame = body[1:-1]
        text = frame.strip(b" \t\r\n\x11\x13").decode("latin-1")
        if not text.isprintable():
            raise FramingError(f"{self._protocol.title} answered {printable(frame)!r}, which is not text. Baud rate?")
        refusal = self._protocol.line.refusal
        if refusal is not None and _pattern(refusal).fullmatch(text) is not None:
            raise Rejected(f"{self._protocol.title} refuses: {text!r}. See its manual.")
        return text


class _Spoken(DescribedDevice[LinesConfig]):
    _DRIVER = "lines"

    def __init__(self, exchange: Exchange, config: LinesConfig) -> None:
        super().__init__(exchange, config)
        self._protocol, self._codec = config.described, Codec(config.described)
        replies = (reply for command in self._protocol.tell.values() for reply in command.reply)
        self._acknowledgements = [_pattern(reply) for reply in replies]
        self._homes = False
        self._cut_short = threading.Event()

    def identify(self) -> Identity:
        try:
            return super().identify()
        except ReplyTimeout as silence:
            raise ReplyTimeout(f"{silence} {self._protocol.line.hint or ''}".strip()) from None

    def _read(self, *names: str) -> Texts:
        fields: Texts = {}
        where = self._protocol.fields
        for question in dict.fromkeys(where[name] for name in names if name in where):
            fields |= self._ask(self._protocol.ask[question])
        return fields

    def _ask(self, question: LineQuestion) -> Texts:
        fields: Texts = {}

        def parse(frame: bytes) -> Texts:
            try:
                text = self._codec.text(frame)
            except Rejected as refused:
                # Devices do not refuse queries: it was damaged on its way, and is repeated.
                raise FramingError(str(refused)) from None
            if question.last is None and any(known.fullmatch(text) for known in self._acknowledgements):
                # The late acknowledgement of a command is no answer to a question.
                raise NotThisReply
            for reply in question.reply:
                if (match := _pattern(reply).fullmatch(text)) is not None:
                    fields.update({} if question.last else dict.fromkeys(question.fields, ""), **match.groupdict())
                    break
            else:
                if question.last is None:
                    raise FramingError(f"{self._title} answered {question.send!r} by {text!r}. Is it the right device?")
            if question.last is not None and _pattern(question.last).fullmatch(text) is None:
                raise NotThisReply
            if missing := set(question.fields) - set(fields):
                raise FramingError(f"The reply to {question.send!r} has no {', '.join(sorted(missing))}.")
            return fields

        return self._exchange.query(self._codec.message(question.send, bare=question.bare), parse)

    def _tell(self, name: str, values: Mapping[str, float] | None = None) -> Texts:
        command = self._protocol.tell[name]
        written: Texts = {}
        for number, send in enumerate(command.send):
            text, values_sent = formatted(send, values or {})
            written |= values_sent
            message = self._codec.message(text, bare=command.bare)
            if not command.reply:
                self._exchange.write(message, pause_after_s=float(self._protocol.line.pause_after_command))
                continue
            reply = _pattern(command.reply[min(number, len(command.reply) - 1)])
            self._exchange.query(
                message,
                lambda frame, text=text, reply=reply: self._acknowledged(frame, text, reply),
                repeat=False,
                reply_timeout_s=float(self._config.home_timeout) if command.reply_when_done else None,
                pause_after_s=float(self._protocol.line.pause_after_command) or None,
            )
        return written

    def _acknowledged(self, frame: bytes, text: str, reply: re.Pattern[str]) -> None:
        received = self._codec.text(frame)
        if self._homes and self._cut_short.is_set():
            raise Rejected(f"{text!r} was interrupted by a stop.")
        if reply.fullmatch(received) is None:
            raise FramingError(
                f"{self._title} acknowledged {text!r} by {received!r}, which is the reply to a different command."
            )

    def _until_shown(self, name: str, values: Mapping[str, float], *shown_by: str) -> Texts:
        """Send a command's value until the device shows it in these fields; returns them."""
        (value,) = {text for send in self._protocol.tell[name].send for text in formatted(send, values)[1].values()}
        return self._verify(
            f"{name} {value}",
            lambda: self._tell(name, values),
            lambda: self._read(*shown_by),
            lambda shown: all(shows(value, shown[part]) for part in shown_by),
        )


class LinesChamber(_Spoken, DescribedChamber[LinesConfig]):
    def _tell_shown(self, name: str, value: float, *, ramps: bool = False) -> float:
        target = ("target" if "target" in self._protocol.fields else "setpoint",)
        shown_by = target if name == "setpoint" else self._protocol.tell[name].shown_by
        return float(self._until_shown(name, {name: value}, *shown_by)[shown_by[0]])

    def _step_of(self, command: str) -> float:
        text = formatted(self._protocol.tell[command].send[0], {command: 1.0})[1][command]
        return 10.0 ** -len(text.partition(".")[2])

    def _free_ramp(self) -> None:
        shown_by = self._protocol.tell["ramp"].shown_by if "ramp" in self._protocol.tell else ()
        shown = self._read(*shown_by)
        if not all(shows(str(self._protocol.limits.free_ramp), shown[part]) for part in shown_by):
            super()._free_ramp()


class LinesAxis(_Spoken, AxisDriver[LinesConfig]):
    """Role `MotionAxis`. An axis is referenced after this driver has homed it, until it shows a fault."""

    def __init__(self, exchange: Exchange, config: LinesConfig) -> None:
        _Spoken.__init__(self, exchange, config)
        self._referenced = self._moved = self._powered = False
        self._own_max_rate: float | None = None
        self.settings = KeptSettings(self._setting, self._set, lambda left, right: shows(right, left))

    def limits(self) -> AxisLimits:
        known, config = self._protocol.limits, self._config
        fastest: list[float | None] = [known.max_rate, config.max_rate]
        if "max_rate" in self._protocol.fields:
            # Read once: some boards refuse to show their settings while the axis moves.
            if self._own_max_rate is None:
                shown = float(self._read("max_rate")["max_rate"])
                self._own_max_rate = units.convert(shown, self._protocol.units.rate, "rad/s")
            fastest.append(self._own_max_rate)
        strongest = [known.max_acceleration, config.max_acceleration]
        lowest = known.lowest_angle if config.lowest is None else config.lowest
        highest = known.highest_angle if config.highest is None else config.highest
        rate, acceleration = (min(value for value in values if value is not None) for values in (fastest, strongest))
        first, last = (None if end is None else math.degrees(end) for end in (lowest, highest))
        step_deg = math.degrees(known.step or 0.0)
        return AxisLimits(math.degrees(rate), math.degrees(acceleration), first, last, step_deg)

    def read(self) -> AxisReading:
        # The motion is read first: a position read after that is the final one if the axis stood.
        names = self._asks_of("moving", "fault", "powered")
        asked_s = self._clock.now()
        texts = self._read(*names)
        if self._moved and not self._is("moving", texts):
            # One damaged character can turn motion into a standstill: the query is sent twice.
            asked_s = self._clock.now()
            texts = self._read(*names)
        if "position" not in texts:
            asked_s = self._clock.now()
            texts |= self._read("position")
        time_s = self._clock.now()
        moving = self._moved = self._is("moving", texts)
        faults = (texts[self._protocol.state["fault"].field],) if self._is("fault", texts) else ()
        self._referenced = self._referenced and not faults
        position = self._degrees(float(texts["position"]))
        rate = self._mean_rate(asked_s, time_s, position, moving=moving)
        return AxisReading(time_s, position, rate, moving, self._referenced, faults)

    def home(self) -> None:
        self._powered = False
        self._make_ready()
        self._cut_short.clear()
        self._homes = True
        try:
            self._tell("home")
        finally:
            self._homes = False
        reading = self._until_still(float(self._config.home_timeout), "homing", raise_faults=False)
        if reading.faults:
            raise DeviceFault(f"The axis did not find its reference: {reading.faults[0]}.")
        self._referenced = True

    def move_to(self, position_deg: float, rate_dps: float, acceleration_dps2: float) -> None:
        limits = self._check(rate_dps, acceleration_dps2, position_deg)
        self._require_ready(referenced=True)
        self._make_ready()
        self._prepare(rate_dps, acceleration_dps2)
        values = {"position": self._own(position_deg), **self._motion(rate_dps, acceleration_dps2)}
        self._verify(
            f"The move to {position_deg:g} deg",
            lambda: self._tell("move", values),
            self.read,
            lambda reading: reading.moving or abs(reading.position_deg - position_deg) <= limits.resolution_deg,
        )

    def spin(self, rate_dps: float, acceleration_dps2: float) -> None:
        if "spin" not in self._protocol.tell:
            raise Rejected(f"The protocol of {self._title} has no command for a constant rate: use turns in the plan.")
        self._check(abs(rate_dps), acceleration_dps2)
        self._require_ready(referenced=False)
        shown_by = self._protocol.tell["spin"].shown_by
        self._make_ready(stands=not shown_by)
        self._prepare(abs(rate_dps), acceleration_dps2)
        signed = rate_dps * self._config.direction
        velocity = units.convert(signed, "deg/s", self._protocol.units.rate)
        values = {"velocity": velocity, **self._motion(abs(rate_dps), acceleration_dps2)}
        if self._protocol.limits.spin_angle is not None:
            far = units.to_unit(float(self._protocol.limits.spin_angle), self._protocol.units.angle)
            values["way"] = math.copysign(far, signed)
        if shown_by:
            self._until_shown("spin", values, *shown_by)
        else:
            what = f"The rate {rate_dps:g} deg/s"
            self._verify(what, lambda: self._tell("spin", values), self.read, lambda reading: reading.moving)

    def stop(self) -> None:
        # A stop is harmless when repeated: it is sent until the axis stands.
        end = self._clock.now() + float(self._config.stop_timeout)
        self._stop_homing()
        while True:
            try:
                self._tell("stop")
            except (ReplyTimeout, FramingError) as problem:
                if self._clock.now() > end:
                    raise problem from None
            again = self._clock.now() + _STOPS_AGAIN_S
            while self._clock.now() < again:
                if not self.read().moving:
                    return
                self._clock.sleep(self._POLL_S)
            if self._clock.now() > end:
                raise NotVerified(
                    f"The axis is still moving {float(self._config.stop_timeout):g} s after the stop command."
                )

    def _stop_homing(self) -> None:
        """A device that answers the command to home only when it has homed hears nothing else until then, but a
        command that interrupts the search; what it says then ends the wait for its answer."""
        interrupt = self._protocol.tell.get("stop_homing")
        if interrupt is None or not self._homes:
            return
        self._cut_short.set()
        for send in interrupt.send:
            self._exchange.transport.write(self._codec.message(send, bare=interrupt.bare))

    def safe(self, policy: str) -> SafeReport:
        self.stop()
        lack = self._config.lacks_for(policy)
        return self._left_safe(policy, lack, lambda: self._switch("off", "powered", False))

    def _per_turn(self) -> float:
        return units.convert(360.0, "deg", self._protocol.units.angle)

    def _motion(self, rate_dps: float, acceleration_dps2: float) -> dict[str, float]:
        unit = self._protocol.units
        acceleration = units.convert(acceleration_dps2, "deg/s^2", unit.acceleration)
        return {"rate": units.convert(rate_dps, "deg/s", unit.rate), "acceleration": acceleration}

    def _make_ready(self, *, stands: bool = True) -> None:
        """Power the motor the first time; what is without power later was switched off by a person, and stays off."""
        if "on" in self._protocol.tell:
            if self._powered and not self._is("powered", self._read(*self._asks_of("powered"))):
                raise DeviceFault(f"The motor of {self._title} is off, and this run did not switch it off.")
            self._switch("on", "powered", True)
            self._powered = True
        if stands and self.read().moving:
            self.stop()

    def _prepare(self, rate_dps: float, acceleration_dps2: float) -> None:
        """Settings that the device keeps between moves are set before a move, and restored at the end of a run."""
        values = self._motion(rate_dps, acceleration_dps2)
        for name in ("acceleration", "rate"):
            if name in self._protocol.tell:
                (template, *_) = self._protocol.tell[name].send
                self.settings.change(name, formatted(template, values)[1][name])

    def _setting(self, name: str) -> str:
        shown_by = self._protocol.tell[name].shown_by
        return self._read(*shown_by)[shown_by[0]]

    def _set(self, name: str, value: str) -> None:
        self._until_shown(name, {name: float(value)}, *self._protocol.tell[name].shown_by)
