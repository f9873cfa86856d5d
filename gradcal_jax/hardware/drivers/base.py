"""What drivers share whose device speaks when spoken to: its exchange, its end, and how a chamber is made safe."""

from abc import ABC, abstractmethod
from collections import deque
from typing import Generic, TypeVar

from ..request_reply import Exchange
from ..roles import ChamberReading, ChamberSafe, SafeReport

Config = TypeVar("Config")
_OVER_S = 0.4


class ExchangeDriver(Generic[Config]):
    """A device of a configuration, on an exchange that several devices may share."""

    def __init__(self, exchange: Exchange, config: Config) -> None:
        self._exchange, self._config, self._clock = exchange, config, exchange.clock

    def close(self) -> None:
        self._exchange.transport.close()


class ImuDriver(ExchangeDriver[Config]):
    """A unit that streams: nothing that it does can be unsafe."""

    def read_bytes(self, timeout_s: float) -> tuple[bytes, float]:
        return self._exchange.transport.read_stamped(timeout_s)

    def safe(self) -> SafeReport:
        unit = self._exchange.device.replace("The", "a", 1)
        return SafeReport("left streaming", True, f"{unit} has nothing that can be unsafe")


class ChamberDriver(ExchangeDriver[Config], ABC):
    """A chamber: it is safe as its read-back says."""

    @abstractmethod
    def read(self) -> ChamberReading: ...

    @abstractmethod
    def hold(self, temperature_c: float) -> None: ...

    @abstractmethod
    def standby(self) -> None: ...

    @abstractmethod
    def _kept_c(self, policy: ChamberSafe, ambient_c: float) -> float:
        """Where it is held by a policy that holds it, °C, within its limits."""

    def _evidence(self, reading: ChamberReading) -> str:
        return f"mode {reading.mode}, set point {reading.setpoint_c} degC"

    def safe(self, policy: ChamberSafe, ambient_c: float = 23.0) -> SafeReport:
        if policy is ChamberSafe.STANDBY:
            self.standby()
        else:
            self.hold(self._kept_c(policy, ambient_c))
        reading = self.read()
        verified = reading.conditioning is (policy is not ChamberSafe.STANDBY)
        return SafeReport(policy.value, verified, self._evidence(reading))


class MeanRate:
    """An axis's rate from its positions, for controllers that do not tell it: the mean since a reading at least 0.4 s
    before. A noisy encoder that is read twice in a millisecond would make any rate of nothing. The time is taken from
    when the earlier position was asked for to when the later had come: a host that was busy in between makes a rate too
    small, and never too large.
    """

    def __init__(self) -> None:
        # When a position was asked for, and the position.
        self._recent: deque[tuple[float, float]] = deque()

    def of(self, asked_s: float, time_s: float, position_deg: float, *, moving: bool) -> float:
        """The rate at a reading that was asked for and had come at these times; 0 of an axis that stands."""
        recent = self._recent
        while len(recent) > 1 and time_s - recent[1][0] >= _OVER_S:
            recent.popleft()
        rate = 0.0
        if recent and moving and time_s - recent[0][0] >= _OVER_S:
            rate = (position_deg - recent[0][1]) / (time_s - recent[0][0])
        recent.append((asked_s, position_deg))
        return rate
