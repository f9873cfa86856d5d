"""Devices that a rig file describes without code. The drivers of their protocols read fields and send commands
(`lines`, `registers`); here are identity, states and chambers, for all protocols.

* A chamber's commands are read back. A program that runs is ended before a set point; a ramp begins at the temperature
  of the air, its rate is shown before it gets the target, and `hold` and `standby` take it off.
* Only `hold` and `ramp` start a chamber.

Unverified on real hardware: everything; each description says what its sources leave open.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from functools import cached_property
from typing import Any, ClassVar

from gradcal_jax import units
from gradcal_jax.hardware import roles
from gradcal_jax.hardware.clock import Clock
from gradcal_jax.hardware.description import described
from gradcal_jax.hardware.drivers.base import ChamberDriver, DriverOptions, command_and_verify
from gradcal_jax.hardware.errors import FramingError, Rejected
from gradcal_jax.hardware.request_reply import Exchange
from gradcal_jax.hardware.templates import shows
from gradcal_jax.hardware.transport import Transport
from gradcal_jax.tables.problems import Problem, SpecError
from gradcal_jax.tables.quantity import Time
from gradcal_jax.tables.section import Section

Texts = dict[str, str]
"""Fields in the device's own text."""
_SETTLED_K = 2.0
_LOWEST_PLAUSIBLE_C, _HIGHEST_PLAUSIBLE_C = -100.0, 250.0
_LINE = {"baudrate", "bytesize", "parity", "stopbits"}
# What a description needs for a safe state.
_NEEDED = {"standby": {"off"}, "unpower": {"off", "powered"}}


class DescribedOptions(DriverOptions):
    """Options of a device that is described."""

    kind: ClassVar[type[Section]]
    protocol: str | dict[str, Any] = ""
    """Name of one of this program's descriptions, or the tables of one."""
    changes: dict[str, Any] | None = None
    """Tables that differ from it; `false` in the place of one that is left out."""

    @cached_property
    def described(self) -> Any:
        return described(self.kind, self.protocol, self.changes)

    @property
    def line_settings(self) -> dict[str, Any]:
        return self.described.model_dump(include=_LINE)

    def _problems(self) -> Iterator[Problem]:
        try:
            _ = self.described
        except SpecError as error:
            yield from (problem.under("protocol") for problem in error.problems)
        except ValueError as problem:
            yield Problem((), str(problem))


class RequestOptions(DescribedOptions):
    """Options of a device that answers requests."""

    reply_timeout: Time | None = None
    """Timeout for a reply; absent: the description's."""

    @property
    def line_settings(self) -> dict[str, Any]:
        return self.described.line.model_dump(include=_LINE)

    def lacks_for(self, safe: str) -> str:
        if _NEEDED.get(safe, set()) <= {*self.described.tell, *self.described.state}:
            return ""
        instead = '"ambient" or "hold"' if safe == "standby" else '"hold"'
        lacks = "its description lacks [tell.off], or the state that shows its effect"
        return f"{lacks}: add both by `changes`, or choose {instead}"

    def link(self, line: Transport, clock: Clock) -> Exchange:
        said = self.described.line
        waits = (self.reply_timeout or said.timeout, said.pause)
        more = (getattr(said, name, 0.0) for name in ("pause_after_command", "boot"))
        return Exchange(line, clock, self.described.title, *map(float, (*waits, *more)))


class DescribedDevice(ABC):
    """Reads the fields of a device, and sends its commands."""

    name: ClassVar[str]
    """The driver's."""

    def __init__(self, exchange: Exchange, config: Any) -> None:
        self._exchange, self._config, self._said = exchange, config, config.described
        self._title, self._clock = exchange.device, exchange.clock

    @abstractmethod
    def _fields(self, *names: str) -> Texts:
        """The fields of these names, in this order; fields that the description lacks are absent."""

    @abstractmethod
    def _tell(self, name: str, values: Mapping[str, float]) -> None:
        """Send a command, with values in the device's unit."""

    @abstractmethod
    def _expected(self, name: str, values: Mapping[str, float], *, ramps: bool = False) -> Texts:
        """The fields that show a command's effect, and what they must show; that of its own value first. `ramps`: what
        is in force moves towards it."""

    @abstractmethod
    def _step_of(self, command: str) -> float:
        """The resolution of a command's value, in the device's unit; 0: any."""

    def _tell_shown(
        self,
        name: str,
        values: Mapping[str, float],
        *fields: str,
        holds: Callable[[Texts], bool] = lambda texts: True,
        ramps: bool = False,
    ) -> Texts:
        """Send a command until the device shows it, and what it shows in `fields` holds. Returns what it shows, of the
        command's own value first."""
        expected = self._expected(name, values, ramps=ramps)
        shown = command_and_verify(
            self._clock,
            " ".join((f"{self._title}: {name}", *expected.values())),
            lambda: self._tell(name, values),
            lambda: self._fields(*expected, *fields),
            lambda texts: holds(texts) and all(shows(text, texts[field]) for field, text in expected.items()),
        )
        # (A reply has its fields in an order of its own.)
        return {field: shown[field] for field in expected} | shown

    def identify(self) -> roles.Identity:
        known = self._fields("model", "serial", "firmware")
        required = self._said.require
        needed = self._fields(*(need.field for need in required))
        for need in required:
            if not any(shows(text, needed[need.field]) for text in need.equals):
                raise Rejected(f"{self._title} says {need.field} = {needed[need.field]}: {need.why}.")
        model = f"{self._title} {known.get('model', '')}".strip()
        return roles.Identity(self.name, model, known.get("serial", ""), known.get("firmware", ""))

    def _switch(self, name: str, state: str, on: bool) -> None:
        """Send a command until the device shows that state, unless it does already."""
        names = self._fields_of(state)
        if self._is(state, self._fields(*names)) is not on:
            self._tell_shown(name, {}, *names, holds=lambda texts: self._is(state, texts) is on)

    def _is(self, name: str, texts: Texts) -> bool:
        return name in self._said.state and self._holds(self._said.state[name], texts)

    def _holds(self, condition: Any, texts: Texts) -> bool:
        try:
            return condition.holds(texts[condition.field])
        except ValueError:
            raise FramingError(f"{self._title} says {condition.field} = {texts[condition.field]!r}.") from None

    def _fields_of(self, *states: str) -> list[str]:
        return [self._said.state[name].field for name in states if name in self._said.state]


class DescribedChamber(DescribedDevice, ChamberDriver):
    def limits(self) -> roles.ChamberLimits:
        said, ends = self._said.limits, self._fields("lowest", "highest")
        lowest, highest = (
            self._celsius(ends[name]) if name in ends else float(getattr(said, name)) for name in ("lowest", "highest")
        )
        slowest = 0.0 if said.slowest is None else float(said.slowest) * 60.0
        fastest = math.inf if said.fastest is None else float(said.fastest) * 60.0
        ramps, unit = "ramp" in self._said.tell, self._said.units.ramp
        step = units.convert(self._step_of("ramp"), unit, "K/min") if ramps else 0.0
        return roles.ChamberLimits(lowest, highest, ramps, slowest, fastest, step)

    def read(self) -> roles.ChamberReading:
        states = self._fields_of("conditioning", "program")
        alarms = [alarm.field for alarm in self._said.alarm.values()]
        texts = self._fields("air", "setpoint", "product", "mode", "code", "message", *states, *alarms)
        time_s = self._clock.now()
        conditions = "conditioning" not in self._said.state or self._is("conditioning", texts)
        product = self._celsius(texts["product"]) if "product" in texts else None
        air_c, setpoint_c = self._celsius(texts["air"]), self._celsius(texts["setpoint"])
        # As the device calls it, else as the description does.
        own = " ".join(texts[name] for name in ("code", "message") if texts.get(name))
        found = tuple(own or name for name, alarm in self._said.alarm.items() if self._holds(alarm, texts))
        return roles.ChamberReading(time_s, air_c, product, setpoint_c, self._mode(texts), conditions, found)

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
        if "ramp" not in self._said.tell:
            raise Rejected(f"The protocol of {self._title} has no ramps: the run makes them by steps of the set point.")
        limits = self._check(temperature_c, rate_k_per_min)
        self._make_ready()
        now = self.read()
        if not now.conditioning or abs(now.setpoint_c - now.air_c) >= _SETTLED_K:
            # A ramp begins at the set point: set it to the temperature of the air.
            self.hold(min(max(now.air_c, limits.lowest_c), limits.highest_c))
        unit = self._said.units.ramp
        shown, *_ = self._tell_shown("ramp", {"ramp": units.convert(rate_k_per_min, "K/min", unit)}).values()
        self._go_to(temperature_c, ramps=True)
        self._condition(True)
        return units.convert(float(shown), unit, "K/min")

    def standby(self) -> None:
        if "off" not in self._said.tell:
            raise Rejected(f"{self._title} cannot be put into standby: its description has no [tell] off.")
        self._condition(False)
        self._free_ramp()

    def _go_to(self, temperature_c: float, *, ramps: bool = False) -> None:
        value = units.convert(temperature_c, "degC", self._said.units.temperature)
        self._tell_shown("setpoint", {"setpoint": value}, ramps=ramps)

    def _free_ramp(self) -> None:
        """Remove the ramp, which otherwise stays in force, also for the next user of the panel."""
        if "no_ramp" in self._said.tell:
            self._switch("no_ramp", "ramps", False)
        elif "ramp" in self._said.tell:
            self._tell_shown("ramp", {"ramp": self._said.limits.free_ramp})

    def _condition(self, on: bool) -> None:
        if "on" in self._said.tell:
            self._switch("on" if on else "off", "conditioning", on)

    def _make_ready(self) -> None:
        """What some devices need before a set point: no program runs, and they condition."""
        if "end_program" in self._said.tell:
            self._switch("end_program", "program", False)
        if self._said.on_first:
            self._condition(True)

    def _mode(self, texts: Texts) -> str:
        if self._is("program", texts):
            return texts[self._said.state["program"].field]
        condition = self._said.state.get("conditioning")
        return texts.get("mode") or ("on" if condition is None else texts[condition.field])

    def _celsius(self, text: str) -> float:
        temperature_c = units.convert(float(text), self._said.units.temperature, "degC")
        if not _LOWEST_PLAUSIBLE_C <= temperature_c <= _HIGHEST_PLAUSIBLE_C:
            what = f"{self._title} reports {temperature_c} degC, which is not plausible"
            raise FramingError(f"{what}. Check the line, the sensor, and the description of the protocol.")
        return temperature_c
