"""What drivers share: options in a rig file, commands that are read back, and the safe state of a chamber."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar, Literal, TypeVar

from gradcal_jax.hardware import roles
from gradcal_jax.hardware.clock import Clock
from gradcal_jax.hardware.errors import FramingError, LimitExceeded, NotVerified, ReplyTimeout
from gradcal_jax.hardware.request_reply import TRIES, Exchange
from gradcal_jax.tables.section import Section

Reply = TypeVar("Reply")
_LOOKS, _BETWEEN_LOOKS_S = 3, 0.2


class DriverOptions(Section, ABC):
    """The options of a driver in a rig file, and the driver: as many devices of a port share one `link`."""

    role: ClassVar[Literal["chamber", "axis", "imu"] | None] = None
    """Role of the device; None: its description states it."""

    @property
    def line_settings(self) -> dict[str, Any]:
        """The settings of its line: baudrate, bytesize, parity, stopbits; those that differ from 9600, 8, "N", 1."""
        return {}

    @abstractmethod
    def link(self, line: Any, clock: Clock) -> Any:
        """What talks to the devices of an open line."""

    @abstractmethod
    def device(self, link: Any, clock: Clock, name: str = "", encoder: roles.MotionAxis | None = None) -> Any:
        """The device; its `name` in the rig file, and the `encoder` of an axis that is turned by hand."""

    def lacks_for(self, safe: str) -> str:
        """Why the device cannot take a safe state of the rig file; empty: it can."""
        return ""


def command_and_verify(
    clock: Clock, what: str, send: Callable[[], object], read: Callable[[], Reply], shows: Callable[[Reply], bool]
) -> Reply:
    """Command, then read back until the read-back shows it; nothing else repeats a command.

    `send` is repeated only after three read-backs, some time apart, have shown that it did not take effect: a lost
    acknowledgement alone repeats nothing. A refusal by the device is raised at once; `NotVerified` after three
    commands, whose message `what` begins.
    """
    seen: Reply | None = None
    unanswered = ""
    for _ in range(TRIES):
        try:
            send()
        except (ReplyTimeout, FramingError) as problem:
            unanswered = f" ({problem})"
        for look in range(_LOOKS):
            if look:
                clock.sleep(_BETWEEN_LOOKS_S)
            seen = read()
            if shows(seen):
                return seen
    raise NotVerified(
        f"{what} was sent {TRIES} times and the read-back still says {seen!r}{unanswered}. "
        "Look at the device's own display: it may be in local mode, locked, or limited."
    )


def require_within(problems: list[str]) -> None:
    """Raises `LimitExceeded` for what of a command is beyond a device's limits (`beyond` of these)."""
    if problems:
        raise LimitExceeded(f"This command {' It '.join(problems)} Change the plan.")


class ChamberDriver(roles.TemperatureChamber, ABC):
    """The base of chambers: their safe state, by `limits`, `read`, `set_point` and `standby`."""

    def __init__(self, exchange: Exchange, config: Any) -> None:
        self._exchange, self._config, self._clock = exchange, config, exchange.clock
        self._title = exchange.device

    def _check(self, temperature_c: float, ramp_k_per_min: float | None = None) -> roles.ChamberLimits:
        """The limits. Raises `LimitExceeded` for a command beyond them."""
        limits = self.limits()
        require_within(limits.beyond(temperature_c, ramp_k_per_min))
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
