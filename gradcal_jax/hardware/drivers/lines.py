"""Devices with a text protocol that a rig file describes (`hardware.line_protocol`): chambers and axes.

An axis that moves is stopped before another command, unless commands can be read back; after the command of a move the
driver verifies that the axis moves or has arrived. Damage can turn a line without a checksum into another valid line: a
move is verified only by the axis's final angle, which the caller must compare (`hardware.axis_control` does).

Unverified on real hardware: everything; each description says what its sources leave open.
"""

import math
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import cache, cached_property, partial
from typing import Literal

from gradcal_jax import units
from gradcal_jax.hardware.clock import Clock
from gradcal_jax.hardware.drivers.base import command_and_verify, require_within
from gradcal_jax.hardware.drivers.described import DescribedChamber, DescribedDevice, RequestOptions, Texts
from gradcal_jax.hardware.errors import DeviceFault, FramingError, NotVerified, Rejected, ReplyTimeout
from gradcal_jax.hardware.line_protocol import Line, LineProtocol, LineQuestion
from gradcal_jax.hardware.request_reply import Exchange
from gradcal_jax.hardware.roles import AxisLimits, AxisReading, KeptSettings, MotionAxis, SafeReport
from gradcal_jax.hardware.templates import formatted, reply_pattern, shows
from gradcal_jax.tables.quantity import Angle, Quantity, Time

_POLL_S = 0.05
_STOPS_AGAIN_S, _LONGEST_STOP_S = 1.0, 30.0
_RATE_OVER_S = 0.4
# How far the angle of an axis that stands may seem to go meanwhile.
_STILL_DEG = 0.2
_pattern = cache(reply_pattern)


class LinesConfig(RequestOptions):
    """Options of the rig file."""

    kind = LineProtocol
    direction: Literal[-1, 1] = 1
    """Sign of the axis's direction."""
    zero: Angle = Quantity(0.0, "0 deg", "angle")
    """The rig's angle at the axis's 0."""
    home_timeout: Time = Quantity(120.0, "120 s", "time")
    """Longest search for the reference."""

    def device(
        self, link: Exchange, clock: Clock, name: str = "", encoder: object = None
    ) -> "LinesChamber | LinesAxis":
        return (LinesChamber if self.described.role == "chamber" else LinesAxis)(link, self)


class Lines(DescribedDevice):
    name = "lines"

    def __init__(self, exchange: Exchange, config: LinesConfig) -> None:
        super().__init__(exchange, config)
        self._line: Line = self._said.line
        self._homes = self._cut_short = False

    def _fields(self, *names: str) -> Texts:
        fields: Texts = {}
        where = self._said.fields
        for question in dict.fromkeys(where[name] for name in names if name in where):
            fields |= self._ask(self._said.ask[question])
        return fields

    def _ask(self, question: LineQuestion) -> Texts:
        forms = [_pattern(reply) for reply in question.reply]
        last = None if question.last is None else _pattern(question.last)
        # Lines that one reply lacks may be in the next.
        fields: Texts = {} if last else dict.fromkeys(question.fields, "")

        def parse(received: bytes) -> Texts | None:
            for text in self._line.texts(received):
                if last is not None and last.fullmatch(text) and set(question.fields) <= set(fields):
                    return fields
                # Devices do not refuse queries, so one that is refused was damaged on its way; and the late
                # acknowledgement of a command is no answer.
                if self._refused(text) or (last is None and self._acknowledges(text)):
                    continue
                match = next((match for form in forms if (match := form.fullmatch(text))), None)
                if match is not None:
                    fields.update(match.groupdict())
                    if last is None:
                        return fields
            return None

        return self._exchange.query(self._line.message(question.send, bare=question.bare), parse)

    def _tell(self, name: str, values: Mapping[str, float]) -> None:
        command = self._said.tell[name]
        longest_s = float(self._config.home_timeout) if command.reply_when_done else None
        for number, send in enumerate(command.send):
            message = self._line.message(formatted(send, values)[0], bare=command.bare)
            if not command.reply:
                self._exchange.write(message)
                continue
            parse = partial(self._acknowledgement, command.reply[min(number, len(command.reply) - 1)])
            self._exchange.query(message, parse, repeat=False, reply_timeout_s=longest_s)

    def _acknowledgement(self, reply: str, received: bytes) -> str | None:
        for text in self._line.texts(received):
            if self._homes and self._cut_short:
                raise Rejected("It was interrupted by a stop.")
            if self._refused(text):
                raise Rejected(f"It refuses: {text!r}. See its manual.")
            if _pattern(reply).fullmatch(text):
                return text
        return None

    def _refused(self, text: str) -> bool:
        refusal = self._said.line.refusal
        return refusal is not None and _pattern(refusal).fullmatch(text) is not None

    def _acknowledges(self, text: str) -> bool:
        return any(_pattern(reply).fullmatch(text) for command in self._said.tell.values() for reply in command.reply)

    def _expected(self, name: str, values: Mapping[str, float], *, ramps: bool = False) -> Texts:
        if not values:
            return {}
        shown_by = self._said.tell[name].shown_by or ("target" if "target" in self._said.fields else "setpoint",)
        return dict.fromkeys(shown_by, self._text_of(name, values))

    def _text_of(self, command: str, values: Mapping[str, float]) -> str:
        """The text of the value of a command that has one."""
        (text,) = {text for send in self._said.tell[command].send for text in formatted(send, values)[1].values()}
        return text

    def _step_of(self, command: str) -> float:
        decimals = self._text_of(command, {command: 1.0}).partition(".")[2]
        return 10.0 ** -len(decimals) if decimals else 0.0

    def _search(self) -> None:
        self._homes, self._cut_short = True, False
        try:
            self._tell("home", {})
        finally:
            self._homes = False

    def _stop_search(self) -> None:
        """A device that answers the command to home only when it has homed hears nothing else until then, but a
        command that interrupts the search; what it says then ends the wait for its answer."""
        interrupt = self._said.tell.get("stop_homing")
        if interrupt is None or not self._homes:
            return
        self._cut_short = True
        for send in interrupt.send:
            self._exchange.transport.write(self._line.message(send, bare=interrupt.bare))


class LinesChamber(Lines, DescribedChamber):
    """Role `TemperatureChamber`."""


class LinesAxis(Lines, MotionAxis):
    """Role `MotionAxis`. An axis is referenced after this driver has homed it, until it shows a fault."""

    def __init__(self, exchange: Exchange, config: LinesConfig) -> None:
        Lines.__init__(self, exchange, config)
        self._referenced = self._moved = self._powered = False
        # The times of requests of readings, and the positions.
        self._recent: deque[tuple[float, float]] = deque()
        self.settings = KeptSettings(self._setting, self._set, lambda left, right: shows(right, left))

    def limits(self) -> AxisLimits:
        said = self._said.limits
        rate, acceleration, step = (math.degrees(of) for of in (said.max_rate, said.max_acceleration, said.step))
        lowest, highest = (
            None if end is None else math.degrees(end) for end in (said.lowest_angle, said.highest_angle)
        )
        return AxisLimits(min(rate, self._own_max_rate_dps), acceleration, lowest, highest, step)

    @cached_property
    def _own_max_rate_dps(self) -> float:
        """Read once: some boards refuse to show their settings while the axis moves."""
        shown = self._fields("max_rate").get("max_rate")
        return math.inf if shown is None else units.convert(float(shown), self._said.units.rate, "deg/s")

    def read(self) -> AxisReading:
        # The motion is read first: a position read after that is the final one if the axis stood.
        names = self._fields_of("moving", "fault", "powered")
        asked_s = self._clock.now()
        texts = self._fields(*names)
        if self._moved and not self._is("moving", texts):
            # One damaged character can turn motion into a standstill: the query is sent twice.
            asked_s = self._clock.now()
            texts = self._fields(*names)
        if "position" not in texts:
            asked_s = self._clock.now()
            texts |= self._fields("position")
        time_s = self._clock.now()
        moving = self._moved = self._is("moving", texts)
        faults = (texts[self._said.state["fault"].field],) if self._is("fault", texts) else ()
        self._referenced = self._referenced and not faults
        own_deg = units.convert(float(texts["position"]), self._said.units.angle, "deg")
        position_deg = self._zero_deg + self._config.direction * own_deg
        rate_dps = self._mean_rate(asked_s, time_s, position_deg) if moving else 0.0
        self._recent.append((asked_s, position_deg))
        return AxisReading(time_s, position_deg, rate_dps, moving, self._referenced, faults)

    def _mean_rate(self, asked_s: float, time_s: float, position_deg: float) -> float:
        """The mean rate since a reading at least 0.4 s before, because a noisy encoder that is read twice in a
        millisecond could show any rate. A host that was busy in between makes it too small, never too large."""
        recent = self._recent
        while len(recent) > 1 and time_s - recent[1][0] >= _RATE_OVER_S:
            recent.popleft()
        if not recent or time_s - recent[0][0] < _RATE_OVER_S:
            return 0.0
        return (position_deg - recent[0][1]) / (time_s - recent[0][0])

    def home(self) -> None:
        self._powered = False
        self._power()
        self._halt()
        self._search()
        end_s = self._clock.now() + float(self._config.home_timeout)
        while (reading := self.read()).moving:
            if self._clock.now() > end_s:
                raise NotVerified(f"The axis still turns after {self._config.home_timeout} of homing. Look at it.")
            self._clock.sleep(_POLL_S)
        if reading.faults:
            raise DeviceFault(f"The axis did not find its reference: {reading.faults[0]}.")
        self._referenced = True

    def move_to(self, position_deg: float, rate_dps: float, acceleration_dps2: float) -> None:
        values = self._prepare(rate_dps, acceleration_dps2, position_deg)
        own_deg = (position_deg - self._zero_deg) * self._config.direction
        values["position"] = units.convert(own_deg, "deg", self._said.units.angle)
        near_deg = math.degrees(self._said.limits.step)
        self._begin(
            f"The move to {position_deg:g} deg",
            "move",
            values,
            lambda reading: reading.moving or abs(reading.position_deg - position_deg) <= near_deg,
        )

    def spin(self, rate_dps: float, acceleration_dps2: float) -> None:
        if "spin" not in self._said.tell:
            raise Rejected(f"The protocol of {self._title} has no command for a constant rate: use turns in the plan.")
        shown_by = self._said.tell["spin"].shown_by
        values = self._prepare(abs(rate_dps), acceleration_dps2, stands=not shown_by)
        signed = rate_dps * self._config.direction
        values["velocity"] = math.copysign(values["rate"], signed)
        if self._said.limits.spin_angle is not None:
            far = units.to_unit(float(self._said.limits.spin_angle), self._said.units.angle)
            values["way"] = math.copysign(far, signed)
        if shown_by:
            self._tell_shown("spin", values)
        else:
            self._begin(f"The rate {rate_dps:g} deg/s", "spin", values, lambda reading: reading.moving)

    def stop(self) -> None:
        # A stop is harmless when repeated: it is sent until the axis stands.
        end_s = self._clock.now() + _LONGEST_STOP_S
        self._stop_search()
        while self._clock.now() <= end_s:
            with suppress(ReplyTimeout, FramingError):
                self._tell("stop", {})
            again_s = self._clock.now() + _STOPS_AGAIN_S
            while self._clock.now() < again_s:
                if not self.read().moving:
                    return
                self._clock.sleep(_POLL_S)
        raise NotVerified(f"The axis is still moving {_LONGEST_STOP_S:g} s after the stop command.")

    def safe(self, policy: str) -> SafeReport:
        self.stop()
        if policy == "unpower":
            if lack := self._config.lacks_for(policy):
                raise Rejected(f"{self._title} cannot be unpowered: {lack}.")
            self._switch("off", "powered", False)
        before_deg = self.read().position_deg
        self._clock.sleep(_RATE_OVER_S)
        reading = self.read()
        went_deg, state = abs(reading.position_deg - before_deg), "; ".join(reading.faults) or "no faults"
        if went_deg > _STILL_DEG:
            state = f"but went {went_deg:.1f} deg in {_RATE_OVER_S:g} s: it turns, whatever it reports; {state}"
        stands = not reading.moving and went_deg <= _STILL_DEG
        return SafeReport(stands, f"stands at {reading.position_deg:.4f} deg, {state}")

    @property
    def _zero_deg(self) -> float:
        return math.degrees(self._config.zero)

    def _prepare(
        self, rate_dps: float, acceleration_dps2: float, position_deg: float | None = None, *, stands: bool = True
    ) -> dict[str, float]:
        """What comes before a motion; returns the values of its command. Settings that the device keeps between moves
        are restored at the end of a run."""
        require_within(self.limits().beyond(rate_dps, acceleration_dps2, position_deg))
        reading = self.read()
        if reading.faults or (position_deg is not None and not reading.referenced):
            raise DeviceFault(
                f"The axis cannot be moved: {', '.join(reading.faults) or 'it has no reference'}. Home it first."
            )
        self._power()
        if stands:
            self._halt()
        unit = self._said.units
        acceleration = units.convert(acceleration_dps2, "deg/s^2", unit.acceleration)
        values = {"acceleration": acceleration, "rate": units.convert(rate_dps, "deg/s", unit.rate)}
        for name in values:
            if name in self._said.tell:
                self.settings.change(name, self._text_of(name, values))
        return values

    def _begin(self, what: str, command: str, values: dict[str, float], begun: Callable[[AxisReading], bool]) -> None:
        command_and_verify(self._clock, what, lambda: self._tell(command, values), self.read, begun)

    def _power(self) -> None:
        """Power the motor the first time; what is without power later was switched off by a person, and stays off."""
        if "on" not in self._said.tell:
            return
        if self._powered and not self._is("powered", self._fields(*self._fields_of("powered"))):
            raise DeviceFault(f"The motor of {self._title} is off, and this run did not switch it off.")
        self._switch("on", "powered", True)
        self._powered = True

    def _halt(self) -> None:
        if self.read().moving:
            self.stop()

    def _setting(self, name: str) -> str:
        shown_by = self._said.tell[name].shown_by
        return self._fields(*shown_by)[shown_by[0]]

    def _set(self, name: str, value: str) -> None:
        self._tell_shown(name, {name: float(value)})
