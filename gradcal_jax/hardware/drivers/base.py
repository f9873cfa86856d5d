"""Base classes of drivers: verified commands on an exchange, the safe state of a chamber, the scale of an axis and the
wait until it stands; and devices that a rig file describes without code, in lines or in registers.

A description has `fields` (readings as the device's own text, by name), `state` (conditions on fields), `tell`
(commands), `limits`, `units` and `require`. The driver of a format speaks: it reads fields and sends commands.
"""

import math
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cached_property
from typing import Annotated, Any, ClassVar, Generic, Literal, TypeVar

from pydantic import Field

from gradcal_jax import units
from gradcal_jax.hardware import roles
from gradcal_jax.hardware.clock import Clock
from gradcal_jax.hardware.errors import DeviceFault, FramingError, LimitExceeded, NotVerified, Rejected, ReplyTimeout
from gradcal_jax.hardware.framing import Framer
from gradcal_jax.hardware.request_reply import TRIES, Exchange, Reply
from gradcal_jax.tables.problems import Problem, SpecError
from gradcal_jax.tables.quantity import Angle, Flag, Quantity, Time
from gradcal_jax.tables.section import Section

Config = TypeVar("Config")
Rates = Annotated[int, Field(strict=True, ge=1, le=10**7)]
_BETWEEN_LOOKS_S = 0.2
_OVER_S, _SETTLED_K = 0.4, 2.0
_LOWEST_PLAUSIBLE_C, _HIGHEST_PLAUSIBLE_C = -100.0, 250.0


class ExchangeDriver(Generic[Config]):
    def __init__(self, exchange: Exchange, config: Config) -> None:
        self._exchange, self._config, self._clock = exchange, config, exchange.clock
        self._title = exchange.device

    def _verify(
        self,
        what: str,
        send: Callable[[], object],
        read: Callable[[], Reply],
        shows: Callable[[Reply], bool],
        looks: int = 3,
    ) -> Reply:
        """Command, then read back until the read-back shows it; nothing else repeats a command.

        `send` is repeated only after `looks` read-backs, some time apart, have shown that it did not take effect: a
        lost acknowledgement alone repeats nothing. A refusal by the device is raised at once; `NotVerified` after three
        commands, whose message `what` begins.
        """
        seen: Reply | None = None
        unanswered = ""
        for _ in range(TRIES):
            try:
                send()
            except (ReplyTimeout, FramingError) as problem:
                unanswered = f" ({problem})"
            for look in range(looks):
                if look:
                    self._clock.sleep(_BETWEEN_LOOKS_S)
                seen = read()
                if shows(seen):
                    return seen
        raise NotVerified(
            f"{what} was sent {TRIES} times and the read-back still says {seen!r}{unanswered}. "
            "Look at the device's own display: it may be in local mode, locked, or limited."
        )


def _require(problems: list[str]) -> None:
    if problems:
        raise LimitExceeded(f"This command {' It '.join(problems)} Change the plan.")


class ChamberDriver(ExchangeDriver[Config], roles.TemperatureChamber, ABC):
    def _plausible(self, temperature_c: float) -> float:
        if not _LOWEST_PLAUSIBLE_C <= temperature_c <= _HIGHEST_PLAUSIBLE_C:
            what = f"{self._title} reports {temperature_c} degC, which is not plausible"
            raise FramingError(f"{what}. Check the line, the sensor, and the description of the protocol.")
        return temperature_c

    def _check(self, temperature_c: float, ramp_k_per_min: float | None = None) -> roles.ChamberLimits:
        """The limits. Raises `LimitExceeded` for a command beyond them."""
        limits = self.limits()
        _require(limits.beyond(temperature_c, ramp_k_per_min))
        return limits

    def safe(self, policy: str, ambient_c: float = 23.0) -> roles.SafeReport:
        if policy == "standby":
            self.standby()
        else:
            limits, reading = self.limits(), self.read()
            if reading.conditioning:
                wanted_c = reading.air_c if policy == "hold" else ambient_c
                self.set_point(min(max(wanted_c, limits.lowest_c), limits.highest_c))
                reading = self.read()
            if not reading.conditioning:
                return roles.SafeReport(True, f"mode {reading.mode}: it is off, and nothing starts it")
        reading = self.read()
        verified = reading.conditioning is (policy != "standby")
        return roles.SafeReport(verified, f"mode {reading.mode}, set point {reading.setpoint_c} degC")


class DriverOptions(Section):
    """The options of a driver in a rig file, and the driver: as many devices of a port share one `link`."""

    role: ClassVar[Literal["chamber", "axis", "imu"] | None] = None
    """Role of the device; None: its description states it."""
    bytesize: Literal[7, 8] | None = None
    """Data bits of a character."""
    parity: Literal["N", "E", "O"] | None = None
    """Parity: none, even or odd."""
    stopbits: Literal[1, 2] | None = None
    """Stop bits of a character."""
    baudrate: Rates | None = None
    """Bits per second."""

    @property
    def line_settings(self) -> dict[str, Any]:
        """The settings of its line: these options, then its description's."""
        described = getattr(self, "described", None)
        places = (self, getattr(described, "line", described))
        settings: dict[str, Any] = {}
        for name in ("baudrate", "bytesize", "parity", "stopbits"):
            known = [value for place in places if (value := getattr(place, name, None)) is not None]
            settings |= {name: known[0]} if known else {}
        return settings

    def link(self, line: Any, clock: Clock) -> Any:
        """What talks to the devices of an open line."""
        raise NotImplementedError

    def device(self, link: Any, clock: Clock, name: str = "", encoder: roles.MotionAxis | None = None) -> Any:
        """The device; its `name` in the rig file, and the `encoder` of an axis that is turned by hand."""
        raise NotImplementedError

    def lacks_for(self, safe: str) -> str:
        """Why the device cannot take a safe state of the rig file; empty: it can."""
        return ""


class AxisOptions(DriverOptions):
    """Options of every axis."""

    direction: Literal[-1, 1] = 1
    """Sign of the device's direction."""
    zero: Angle = Quantity(0.0, "0 deg", "angle")
    """The rig's angle at the device's 0."""
    home_timeout: Time = Quantity(120.0, "120 s", "time")
    """Longest search for the reference."""
    stop_timeout: Time = Quantity(30.0, "30 s", "time")
    """Longest stop."""


Options = TypeVar("Options", bound=AxisOptions)


class AxisDriver(ExchangeDriver[Options], roles.MotionAxis, ABC):
    """An axis with a scale of its own: its angles, what it may be commanded, and the wait until it stands."""

    _POLL_S = 0.05

    @abstractmethod
    def _per_turn(self) -> float:
        """How many of the device's units a turn of the table has."""

    def _units(self, angle_deg: float) -> float:
        """An angle, a rate or an acceleration in the device's units."""
        return angle_deg / 360.0 * self._per_turn()

    def _own(self, position_deg: float) -> float:
        return self._units((position_deg - self._zero_deg) * self._config.direction)

    def _degrees(self, own: float) -> float:
        return self._zero_deg + self._config.direction * (own * 360.0 / self._per_turn())

    @property
    def _zero_deg(self) -> float:
        return units.to_unit(float(self._config.zero), "deg")

    def _check(self, rate_dps: float, acceleration_dps2: float, position_deg: float | None = None) -> roles.AxisLimits:
        """The limits. Raises `LimitExceeded` for a command beyond them."""
        limits = self.limits()
        _require(limits.beyond(rate_dps, acceleration_dps2, position_deg))
        return limits

    def _require_ready(self, *, referenced: bool) -> None:
        reading = self.read()
        if reading.faults or (referenced and not reading.referenced):
            raise DeviceFault(
                f"The axis cannot be moved: {', '.join(reading.faults) or 'it has no reference'}. Home it first."
            )

    @cached_property
    def _recent(self) -> deque[tuple[float, float]]:
        """The times of requests of readings, and the positions."""
        return deque()

    def _mean_rate(self, asked_s: float, time_s: float, position_deg: float, *, moving: bool) -> float:
        """The rate (deg/s) at a reading with these times of request and reply, for controllers that do not report it; 0
        for an axis that stands.

        It is the mean since a reading at least 0.4 s before, because a noisy encoder that is read twice in a
        millisecond could show any rate. A host that was busy in between makes it too small, never too large.
        """
        recent, rate = self._recent, 0.0
        while len(recent) > 1 and time_s - recent[1][0] >= _OVER_S:
            recent.popleft()
        if recent and moving and time_s - recent[0][0] >= _OVER_S:
            rate = (position_deg - recent[0][1]) / (time_s - recent[0][0])
        recent.append((asked_s, position_deg))
        return rate

    def _left_safe(self, policy: str, lack: str, unpower: Callable[[], object]) -> roles.SafeReport:
        """The end of `safe`, where the axis stands: without power, if that is wanted and nothing lacks for it."""
        if policy == "unpower":
            if lack:
                raise Rejected(f"{self._title} cannot be unpowered: {lack}.")
            unpower()
        reading = self.read()
        state = "; ".join(reading.faults) or "no faults"
        return roles.SafeReport(not reading.moving, f"stands at {reading.position_deg:.4f} deg, {state}")

    def _until_still(self, longest_s: float, doing: str, *, raise_faults: bool = True) -> roles.AxisReading:
        end = self._clock.now() + longest_s
        while (reading := self.read()).moving:
            if self._clock.now() > end:
                raise NotVerified(f"The axis still turns after {longest_s:g} s of {doing}. Look at it.")
            self._clock.sleep(self._POLL_S)
        if raise_faults and reading.faults:
            raise DeviceFault(f"The axis reports {', '.join(reading.faults)} after {doing}.")
        return reading


Texts = dict[str, str]
"""Fields in the device's own text."""


class DescribedOptions(DriverOptions):
    """Options of a device that is described."""

    protocol: Any = ""
    """Name of one of this program's descriptions, or the tables of one."""
    changes: Any = None
    """Tables that differ from it; `false` in the place of one that is left out."""

    @cached_property
    def described(self) -> Any:
        raise NotImplementedError

    def _misfits(self, described: Any) -> Iterable[Problem]:
        """Options that do not fit the description."""
        return ()

    def _problems(self) -> Iterator[Problem]:
        try:
            yield from self._misfits(self.described)
        except SpecError as error:
            yield from (problem.under("protocol") for problem in error.problems)
        except ValueError as problem:
            yield Problem((), str(problem))


class RequestOptions(DescribedOptions):
    """Options of a device that answers requests."""

    reply_timeout: Time | None = None
    """Timeout for a reply; absent: the description's."""
    require: Flag = True
    """Whether the settings that the description requires are asked for."""

    def exchange(self, line: Any, clock: Clock, framer: Framer, *, boot_s: float = 0.0) -> Exchange:
        known = self.described
        timeout_s, pause_s = float(self.reply_timeout or known.line.timeout), float(known.line.pause)
        return Exchange(line, framer, clock, known.title, timeout_s, pause_s, boot_s=boot_s)


Described = TypeVar("Described", bound=RequestOptions)


class DescribedDevice(ExchangeDriver[Described], ABC):
    _DRIVER: str

    @abstractmethod
    def _read(self, *names: str) -> Texts:
        """The fields of these names, in this order; fields that the description lacks are absent."""

    @abstractmethod
    def _tell(self, name: str, values: Mapping[str, float] | None = None) -> Texts:
        """Send a command; returns its values as text."""

    def identify(self) -> roles.Identity:
        known = self._read("model", "serial", "firmware")
        required = self._config.described.require if self._config.require else ()
        needed = self._read(*(need.field for need in required))
        for need in required:
            if not any(needed[need.field] == text or _same_number(needed[need.field], text) for text in need.equals):
                raise Rejected(f"{self._title} says {need.field} = {needed[need.field]}: {need.why}.")
        model = f"{self._title} {known.get('model', '')}".strip()
        return roles.Identity(self._DRIVER, model, known.get("serial", ""), known.get("firmware", ""))

    def _switch(self, name: str, state: str, on: bool) -> None:
        """Send "on" or "off" until the device shows that state, unless it does already."""
        names = self._asks_of(state)
        if self._is(state, self._read(*names)) is not on:
            self._verify(
                f"{self._title} {name}",
                lambda: self._tell(name),
                lambda: self._read(*names),
                lambda texts: self._is(state, texts) is on,
            )

    def _is(self, name: str, texts: Texts) -> bool:
        condition = self._config.described.state.get(name)
        if condition is None:
            return False
        try:
            return condition.holds(texts[condition.field])
        except ValueError:
            raise FramingError(f"{self._title} says {condition.field} = {texts[condition.field]!r}.") from None

    def _asks_of(self, *states: str) -> list[str]:
        return [self._config.described.state[name].field for name in states if name in self._config.described.state]


class DescribedChamber(DescribedDevice[Described], ChamberDriver[Described]):
    @abstractmethod
    def _tell_shown(self, name: str, value: float, *, ramps: bool = False) -> float:
        """Send a command's value, in the device's unit, until the device shows it; returns the value shown. `ramps`:
        what is in force moves towards it."""

    @abstractmethod
    def _step_of(self, command: str) -> float:
        """The resolution of a command's value, in the device's unit; 0: any."""

    def _resolution_k(self) -> float:
        return float(self._config.described.limits.resolution)

    def limits(self) -> roles.ChamberLimits:
        known, ends = self._config.described.limits, self._read("lowest", "highest")
        lowest, highest = (
            self._celsius(ends[name]) if name in ends else float(limit) if limit is not None else math.nan
            for name, limit in (("lowest", known.lowest), ("highest", known.highest))
        )
        slowest = 0.0 if known.slowest is None else float(known.slowest) * 60.0
        fastest = math.inf if known.fastest is None else float(known.fastest) * 60.0
        ramps, unit = "ramp" in self._config.described.tell, self._config.described.units.ramp
        step = units.convert(self._step_of("ramp"), unit, "K/min") if ramps else 0.0
        return roles.ChamberLimits(lowest, highest, self._resolution_k(), ramps, slowest, fastest, step)

    def read(self) -> roles.ChamberReading:
        states = self._asks_of("conditioning", "alarm", "program")
        texts = self._read("air", "setpoint", "product", "mode", *states, *self._alarm_fields())
        time_s = self._clock.now()
        conditions = "conditioning" not in self._config.described.state or self._is("conditioning", texts)
        product = self._celsius(texts["product"]) if "product" in texts else None
        air_c, setpoint_c = self._celsius(texts["air"]), self._celsius(texts["setpoint"])
        mode = self._mode(texts)
        return roles.ChamberReading(time_s, air_c, product, setpoint_c, mode, conditions, self._alarms(texts))

    def hold(self, temperature_c: float) -> None:
        self._check(temperature_c)
        self._make_ready()
        self._free_ramp()
        self._go_to(temperature_c)
        self._condition(True)

    def set_point(self, temperature_c: float) -> None:
        self._check(temperature_c)
        self._free_ramp()
        self._go_to(temperature_c)

    def ramp(self, temperature_c: float, rate_k_per_min: float) -> float:
        if "ramp" not in self._config.described.tell:
            raise Rejected(f"The protocol of {self._title} has no ramps: the run makes them by steps of the set point.")
        limits = self._check(temperature_c, rate_k_per_min)
        self._make_ready()
        now = self.read()
        if not now.conditioning or abs(now.setpoint_c - now.air_c) >= _SETTLED_K:
            # A ramp begins at the set point: set it to the temperature of the air.
            self.hold(min(max(now.air_c, limits.lowest_c), limits.highest_c))
        unit = self._config.described.units.ramp
        shown = self._tell_shown("ramp", units.convert(rate_k_per_min, "K/min", unit))
        self._go_to(temperature_c, ramps=True)
        self._condition(True)
        return units.convert(shown, unit, "K/min")

    def standby(self) -> None:
        if "off" not in self._config.described.tell:
            raise Rejected(f"{self._title} cannot be put into standby: its description has no [tell] off.")
        self._condition(False)
        self._free_ramp()

    def _go_to(self, temperature_c: float, *, ramps: bool = False) -> None:
        unit = self._config.described.units.temperature
        self._tell_shown("setpoint", units.convert(temperature_c, "degC", unit), ramps=ramps)

    def _free_ramp(self) -> None:
        """Remove the ramp, which otherwise stays in force, also for the next user of the panel."""
        tell, free = self._config.described.tell, self._config.described.limits.free_ramp
        if "no_ramp" in tell:
            self._switch("no_ramp", "ramps", False)
        elif "ramp" in tell and free is not None:
            self._tell_shown("ramp", free)

    def _condition(self, on: bool) -> None:
        if "on" in self._config.described.tell:
            self._switch("on" if on else "off", "conditioning", on)

    def _make_ready(self) -> None:
        """What some devices need before a set point: no program runs, and they condition."""
        if "end_program" in self._config.described.tell:
            self._switch("end_program", "program", False)

    def _alarm_fields(self) -> list[str]:
        return []

    def _alarms(self, texts: Texts) -> tuple[str, ...]:
        if not self._is("alarm", texts):
            return ()
        named = [texts[name] for name in ("code", "message") if texts.get(name)]
        return (" ".join(named) or texts[self._config.described.state["alarm"].field],)

    def _mode(self, texts: Texts) -> str:
        return texts[self._config.described.state["conditioning"].field]

    def _celsius(self, text: str) -> float:
        return self._plausible(units.convert(float(text), self._config.described.units.temperature, "degC"))


def _same_number(left: str, right: str) -> bool:
    try:
        return float(left) == float(right)
    except ValueError:
        return False
