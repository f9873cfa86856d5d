"""Base classes of drivers whose device answers requests: its exchange, verified commands, and the safe state of a
chamber; the scale of an axis, and the wait until it stands."""

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from typing import Generic, Protocol, TypeVar

from ..errors import DeviceFault, FramingError, LimitExceeded, NotVerified, Rejected
from ..request_reply import Exchange, Reply, command_and_verify
from ..roles import AxisReading, AxisSafe, ChamberLimits, ChamberReading, ChamberSafe, SafeReport

Config = TypeVar("Config")
_OVER_S = 0.4
_LOWEST_PLAUSIBLE_C, _HIGHEST_PLAUSIBLE_C = -100.0, 250.0


class ExchangeDriver(Generic[Config]):
    """A device of a configuration, on an exchange that several devices may share."""

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
        """Command until the read-back shows it (`command_and_verify`)."""
        return command_and_verify(send, read, shows, what=what, clock=self._clock, looks=looks)


class ImuDriver(ExchangeDriver[Config]):
    """A unit that streams."""

    def read_bytes(self, timeout_s: float) -> tuple[bytes, float]:
        return self._exchange.transport.read_stamped(timeout_s)


class ChamberDriver(ExchangeDriver[Config], ABC):
    """A chamber, whose safe state is verified by its read-back."""

    _BOUNDS: str
    """What the limits `low` and `high` of a set point are, and what to do about them."""

    @abstractmethod
    def limits(self) -> ChamberLimits: ...

    @abstractmethod
    def read(self) -> ChamberReading: ...

    @abstractmethod
    def hold(self, temperature_c: float) -> None: ...

    @abstractmethod
    def standby(self) -> None: ...

    @abstractmethod
    def _air_c(self) -> float: ...

    def _plausible(self, temperature_c: float) -> float:
        if not _LOWEST_PLAUSIBLE_C <= temperature_c <= _HIGHEST_PLAUSIBLE_C:
            what = f"{self._title} reports {temperature_c} degC, which is not plausible"
            raise FramingError(f"{what}. Check the line, the sensor, and what is known of the protocol.")
        return temperature_c

    def _check(self, temperature_c: float) -> None:
        limits = self.limits()
        if not limits.lowest_c <= temperature_c <= limits.highest_c:
            bounds = self._BOUNDS.format(low=limits.lowest_c, high=limits.highest_c, device=self._title)
            raise LimitExceeded(f"{temperature_c:.1f} degC lies outside {bounds}")

    def _evidence(self, reading: ChamberReading) -> str:
        return f"mode {reading.mode}, set point {reading.setpoint_c} degC"

    def safe(self, policy: ChamberSafe, ambient_c: float = 23.0) -> SafeReport:
        if policy is ChamberSafe.STANDBY:
            self.standby()
        else:
            limits = self.limits()
            wanted_c = self._air_c() if policy is ChamberSafe.HOLD else ambient_c
            self.hold(min(max(wanted_c, limits.lowest_c), limits.highest_c))
        reading = self.read()
        verified = reading.conditioning is (policy is not ChamberSafe.STANDBY)
        return SafeReport(policy.value, verified, self._evidence(reading))


class Placed(Protocol):
    """The options of every axis: the rig's angle at the device's 0, and +1 or -1."""

    @property
    def zero_deg(self) -> float: ...
    @property
    def direction(self) -> int: ...


Place = TypeVar("Place", bound=Placed)


class AxisDriver(ExchangeDriver[Place], ABC):
    """An axis with a scale of its own: its angles, what it may be commanded, and the wait until it stands."""

    _POLL_S = 0.05

    @abstractmethod
    def read(self) -> AxisReading: ...

    @abstractmethod
    def _per_turn(self) -> float:
        """How many of the device's units a turn of the table has."""

    def _units(self, angle_deg: float) -> float:
        """An angle, a rate or an acceleration in the device's units."""
        return angle_deg / 360.0 * self._per_turn()

    def _own(self, position_deg: float) -> float:
        """The device's position at an angle of the rig."""
        return self._units((position_deg - self._config.zero_deg) * self._config.direction)

    def _degrees(self, own: float) -> float:
        """The rig's angle at a position of the device."""
        return self._config.zero_deg + self._config.direction * (own * 360.0 / self._per_turn())

    def _require_travel(self, position_deg: float, travel_deg: tuple[float, float]) -> None:
        lowest, highest = travel_deg
        if not lowest - 1e-9 <= position_deg <= highest + 1e-9:
            raise LimitExceeded(f"{position_deg:g} deg lies outside the travel {lowest:g} to {highest:g} deg.")

    def _require_motion(self, rate_dps: float, fastest_dps: float, acceleration_dps2: float, most_dps2: float) -> None:
        for value, most, unit in ((rate_dps, fastest_dps, "deg/s"), (acceleration_dps2, most_dps2, "deg/s²")):
            if not 0.0 < value <= most * (1.0 + 1e-9):
                raise LimitExceeded(f"{value:g} {unit} lies outside 0 to {most:g} {unit}.")

    def _require_ready(self, *, referenced: bool) -> None:
        """Raise where the axis has a fault, or no reference though a move needs it."""
        reading = self.read()
        if reading.faults or (referenced and not reading.referenced):
            raise DeviceFault(
                f"The axis cannot be moved: {', '.join(reading.faults) or 'it has no reference'}. Home it first."
            )

    def _left_safe(self, policy: AxisSafe, lack: str, unpower: Callable[[], object]) -> SafeReport:
        """The end of `safe`, where the axis stands: without power, if that is wanted and nothing lacks for it."""
        if policy is AxisSafe.UNPOWER:
            if lack:
                raise Rejected(f"{self._title} cannot be unpowered: {lack}.")
            unpower()
        reading = self.read()
        state = "; ".join((*reading.faults, *reading.warnings)) or "no faults"
        return SafeReport(policy.value, not reading.moving, f"stands at {reading.position_deg:.4f} deg, {state}")

    def _until_still(self, longest_s: float, doing: str, *, raise_faults: bool = True) -> AxisReading:
        end = self._clock.now() + longest_s
        while (reading := self.read()).moving:
            if self._clock.now() > end:
                raise NotVerified(f"The axis still turns after {longest_s:g} s of {doing}. Look at it.")
            self._clock.sleep(self._POLL_S)
        if raise_faults and reading.faults:
            raise DeviceFault(f"The axis reports {', '.join(reading.faults)} after {doing}.")
        return reading


class Unwatched:
    """An axis without a watchdog."""

    def arm_watchdog(self) -> None: ...

    def heartbeat(self) -> None: ...


class MeanRate:
    """An axis's rate from its positions, for controllers that do not report it: the mean since a reading at least 0.4 s
    before, because a noisy encoder that is read twice in a millisecond could show any rate. The time is from the
    earlier request to the later reply: a host that was busy in between makes a rate too small, never too large.
    """

    def __init__(self) -> None:
        # The times of requests, and the positions.
        self._recent: deque[tuple[float, float]] = deque()

    def of(self, asked_s: float, time_s: float, position_deg: float, *, moving: bool) -> float:
        """The rate at a reading with these times of request and reply; 0 for an axis that stands."""
        recent = self._recent
        while len(recent) > 1 and time_s - recent[1][0] >= _OVER_S:
            recent.popleft()
        rate = 0.0
        if recent and moving and time_s - recent[0][0] >= _OVER_S:
            rate = (position_deg - recent[0][1]) / (time_s - recent[0][0])
        recent.append((asked_s, position_deg))
        return rate
