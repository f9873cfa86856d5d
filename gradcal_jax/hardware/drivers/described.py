"""Devices that a rig file describes without code: what is common to descriptions in lines and in registers.

A description has `fields` (readings as the device's own text, by name), `state` (conditions on fields), `tell`
(commands), `limits`, `units` and `require`. The driver of a format speaks: it reads fields and sends commands.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import TypeVar

from ... import units
from ...files.line_protocol import LineProtocol
from ...files.register_protocol import RegisterProtocol
from ..errors import FramingError, LimitExceeded, Rejected
from ..request_reply import Exchange
from ..roles import ChamberLimits, ChamberReading, Identity
from .base import ChamberDriver, ExchangeDriver

Texts = dict[str, str]
"""Fields in the device's own text."""

_SETTLED_K = 2.0


Description = LineProtocol | RegisterProtocol
Options = TypeVar("Options")


class DescribedDevice(ExchangeDriver[Options], ABC):
    """Common to all roles: fields, commands, states."""

    _DRIVER: str

    def __init__(self, exchange: Exchange, config: Options, description: Description, *, require: bool) -> None:
        super().__init__(exchange, config)
        self._description, self._requires = description, require

    @abstractmethod
    def _read(self, *names: str) -> Texts:
        """The fields of these names, in this order; fields that the description lacks are absent."""

    @abstractmethod
    def _tell(self, name: str, values: Mapping[str, float] | None = None) -> Texts:
        """Send a command; returns its values as text."""

    def identify(self) -> Identity:
        known = self._read("model", "serial", "firmware")
        required = self._description.require if self._requires else ()
        needed = self._read(*(need.field for need in required))
        for need in required:
            if not any(needed[need.field] == text or _same_number(needed[need.field], text) for text in need.equals):
                raise Rejected(f"{self._title} says {need.field} = {needed[need.field]}: {need.why}.")
        model = f"{self._title} {known.get('model', '')}".strip()
        return Identity(self._DRIVER, model, known.get("serial", ""), known.get("firmware", ""))

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
        condition = self._description.state.get(name)
        if condition is None:
            return False
        try:
            return condition.holds(texts[condition.field])
        except ValueError:
            raise FramingError(f"{self._title} says {condition.field} = {texts[condition.field]!r}.") from None

    def _asks_of(self, *states: str) -> list[str]:
        return [self._description.state[name].field for name in states if name in self._description.state]


class DescribedChamber(DescribedDevice[Options], ChamberDriver[Options]):
    """Role `Chamber`."""

    _BOUNDS = "{low:g} to {high:g} degC, the limits in the protocol of {device}. Change the plan."

    @abstractmethod
    def _tell_shown(self, name: str, values: Mapping[str, float], shown_by: tuple[str, ...]) -> Texts:
        """Send a value until the device shows it in these fields; returns them."""

    @abstractmethod
    def _go_to(self, temperature_c: float, *, ramps: bool = False) -> None:
        """Send a set point until the device shows it."""

    @abstractmethod
    def _resolution_k(self) -> float: ...

    @abstractmethod
    def _tell_ramp(self, rate: float) -> float:
        """Send a ramp's rate, in the device's unit, until the device shows it; returns the rate shown."""

    @abstractmethod
    def _ramp_step(self) -> float:
        """The resolution of a ramp, K/min."""

    @abstractmethod
    def _free_ramp(self) -> None:
        """Remove the ramp, which otherwise stays in force, also for the next user of the panel."""

    def limits(self) -> ChamberLimits:
        known, ends = self._description.limits, self._read("lowest", "highest")
        lowest, highest = (
            self._celsius(ends[name]) if name in ends else float(limit) if limit is not None else math.nan
            for name, limit in (("lowest", known.lowest), ("highest", known.highest))
        )
        slowest = 0.0 if known.slowest is None else float(known.slowest) * 60.0
        fastest = math.inf if known.fastest is None else float(known.fastest) * 60.0
        ramps = "ramp" in self._description.tell
        return ChamberLimits(lowest, highest, self._resolution_k(), ramps, slowest, fastest, self._ramp_step())

    def read(self) -> ChamberReading:
        states = self._asks_of("conditioning", "alarm", "program")
        texts = self._read("air", "setpoint", "product", "mode", *states, *self._alarm_fields())
        time_s = self._clock.now()
        conditions = "conditioning" not in self._description.state or self._is("conditioning", texts)
        product = self._celsius(texts["product"]) if "product" in texts else None
        air_c, setpoint_c = self._celsius(texts["air"]), self._celsius(texts["setpoint"])
        mode = self._mode(texts)
        return ChamberReading(time_s, air_c, product, setpoint_c, mode, conditions, self._alarms(texts))

    def hold(self, temperature_c: float) -> None:
        self._check(temperature_c)
        self._make_ready()
        self._free_ramp()
        self._go_to(temperature_c)
        self._condition(True)

    def ramp(self, temperature_c: float, rate_k_per_min: float) -> float:
        if "ramp" not in self._description.tell:
            raise Rejected(f"The protocol of {self._title} has no ramps: it is ramped by steps of its set point.")
        limits = self.limits()
        if not max(limits.slowest_ramp_k_per_min, 1e-9) <= rate_k_per_min <= limits.fastest_ramp_k_per_min:
            raise LimitExceeded(f"{rate_k_per_min:g} K/min lies outside what {self._title} can do.")
        self._check(temperature_c)
        self._make_ready()
        now = self.read()
        if not now.conditioning or abs(now.setpoint_c - now.air_c) >= _SETTLED_K:
            # A ramp begins at the set point: set it to the temperature of the air.
            self.hold(min(max(now.air_c, limits.lowest_c), limits.highest_c))
        unit = self._description.units.ramp
        shown = self._tell_ramp(units.convert(rate_k_per_min, "K/min", unit))
        self._go_to(temperature_c, ramps=True)
        self._condition(True)
        return units.convert(shown, unit, "K/min")

    def standby(self) -> None:
        if "off" not in self._description.tell:
            raise Rejected(f"{self._title} cannot be put into standby: its description has no [tell] off.")
        self._condition(False)
        self._free_ramp()

    def _air_c(self) -> float:
        return self._celsius(self._read("air")["air"])

    def _condition(self, on: bool) -> None:
        if "on" in self._description.tell:
            self._switch("on" if on else "off", "conditioning", on)

    def _make_ready(self) -> None:
        """What some devices need before a set point: no program runs, and they condition."""
        if "end_program" in self._description.tell:
            self._switch("end_program", "program", False)

    def _alarm_fields(self) -> list[str]:
        return []

    def _alarms(self, texts: Texts) -> tuple[str, ...]:
        if not self._is("alarm", texts):
            return ()
        named = [texts[name] for name in ("code", "message") if texts.get(name)]
        return (" ".join(named) or texts[self._description.state["alarm"].field],)

    def _mode(self, texts: Texts) -> str:
        return texts[self._description.state["conditioning"].field]

    def _celsius(self, text: str) -> float:
        return self._plausible(units.convert(float(text), self._description.units.temperature, "degC"))


def _same_number(left: str, right: str) -> bool:
    try:
        return float(left) == float(right)
    except ValueError:
        return False
