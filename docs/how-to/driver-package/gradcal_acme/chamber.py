"""A chamber that is asked `T?`, `SP?` and `ON?`, and told `SP 25.0`, `ON` and `OFF`. It has no ramps of its own."""

from gradcal_jax.hardware.clock import Clock
from gradcal_jax.hardware.drivers.base import ChamberDriver, DriverOptions, command_and_verify
from gradcal_jax.hardware.errors import Rejected
from gradcal_jax.hardware.request_reply import Exchange
from gradcal_jax.hardware.roles import ChamberLimits, ChamberReading, Identity
from gradcal_jax.hardware.transport import Transport
from gradcal_jax.tables.quantity import Quantity, Temperature, Time


class AcmeConfig(DriverOptions):
    """Options of the rig file."""

    role = "chamber"
    reply_timeout: Time = Quantity.read("1 s", "time")
    lowest: Temperature = Quantity.read("-40 degC", "temperature")
    highest: Temperature = Quantity.read("120 degC", "temperature")

    def link(self, line: Transport, clock: Clock) -> Exchange:
        return Exchange(line, clock, "The ACME chamber", float(self.reply_timeout))

    def device(self, link: Exchange, clock: Clock, name: str = "", encoder: object = None) -> "AcmeChamber":
        return AcmeChamber(link, self)


class AcmeChamber(ChamberDriver):
    """`safe` is the base's, by `hold`, `standby` and `read`."""

    def identify(self) -> Identity:
        return Identity("acme", "ACME 1", serial_number=f"{self._number('SN?'):.0f}")

    def limits(self) -> ChamberLimits:
        return ChamberLimits(float(self._config.lowest), float(self._config.highest), hardware_ramp=False)

    def read(self) -> ChamberReading:
        air, setpoint, on = (self._number(question) for question in ("T?", "SP?", "ON?"))
        return ChamberReading(self._clock.now(), air, None, setpoint, "ON" if on else "OFF", bool(on), ())

    def hold(self, temperature_c: float) -> None:
        self.set_point(temperature_c)
        self._until("ON", "ON?", 1.0)

    def set_point(self, temperature_c: float) -> None:
        self._check(temperature_c)
        self._until(f"SP {temperature_c:.1f}", "SP?", round(temperature_c, 1))

    def ramp(self, temperature_c: float, rate_k_per_min: float) -> float:
        raise Rejected("This chamber has no ramps; it is ramped by steps of its set point.")

    def standby(self) -> None:
        self._until("OFF", "ON?", 0.0)

    def _until(self, command: str, question: str, value: float) -> None:
        """Command until the chamber shows it."""
        words = command.encode() + b"\n"
        send, near = lambda: self._exchange.write(words), lambda shown: abs(shown - value) < 0.05
        command_and_verify(self._clock, command, send, lambda: self._number(question), near)

    def _number(self, question: str) -> float:
        def parse(received: bytes) -> float | None:
            """The reply among all bytes that have come; None: it is not, or not yet, there."""
            *lines, _ = received.split(b"\n")
            try:
                return float(lines[0]) if lines else None
            except ValueError:
                return None

        return self._exchange.query(question.encode() + b"\n", parse)
