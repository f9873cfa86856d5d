"""What drivers share whose device speaks when spoken to: its exchange, its end, and how a chamber is made safe."""

from abc import ABC, abstractmethod
from typing import Generic, TypeVar

from ..exchange import Exchange
from ..roles import ChamberReading, ChamberSafe, SafeReport

Config = TypeVar("Config")


class ExchangeDriver(Generic[Config]):
    """A device of a configuration, on an exchange that several devices may share."""

    def __init__(self, exchange: Exchange, config: Config) -> None:
        self._exchange, self._config, self._clock = exchange, config, exchange.clock

    def close(self) -> None:
        self._exchange.transport.close()


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
