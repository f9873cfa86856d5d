"""An axis whose motor is told to turn and to stop, and nothing else: a drill, a record player, a motor behind a relay.

It turns at one rate, `rate`, more or less; a turn is "forward" or "backward", a time, and "stop". Nothing shows where
it stands or whether it does: its readings are where it was told to go, for plans whose reference is gravity. After
"stop" it counts as moving for another `coast`. The words are lines of text on the port; with `answer`, the device
confirms each with that line.
"""

import threading
from dataclasses import dataclass

from gradcal_jax.hardware.clock import Clock
from gradcal_jax.hardware.drivers.base import ExchangeDriver
from gradcal_jax.hardware.errors import FramingError, LimitExceeded, NotVerified, Rejected, ReplyTimeout
from gradcal_jax.hardware.framing import LineFramer, NotThisReply
from gradcal_jax.hardware.request_reply import Exchange
from gradcal_jax.hardware.roles import AxisLimits, AxisReading, AxisSafe, Identity, KeptSettings, MotionAxis, SafeReport
from gradcal_jax.hardware.transport import Transport

_ANSWERS_S = 1.0


@dataclass(frozen=True)
class SwitchConfig:
    """Options of the rig file: the words that are sent, each a line, and what the motor does."""

    rate_dps: float = 60.0
    coast_s: float = 1.0
    forward: str = "forward"
    backward: str = "backward"
    stop: str = "stop"
    answer: str = ""
    baudrate: int = 9600

    def __post_init__(self) -> None:
        if not (self.rate_dps > 0.0 and self.coast_s >= 0.0):
            raise ValueError("rate must be above zero, and coast must not be negative.")

    def lacks_for(self, safe: str) -> str:
        lack = 'a motor that is switched off has no holding torque; expected "unpower"'
        return lack if safe != AxisSafe.UNPOWER.value else ""


def open_exchange(transport: Transport, clock: Clock, config: SwitchConfig) -> Exchange:
    return Exchange(transport, LineFramer(), clock, "The motor", _ANSWERS_S)


class SwitchAxis(ExchangeDriver[SwitchConfig], MotionAxis):
    def __init__(self, exchange: Exchange, config: SwitchConfig) -> None:
        super().__init__(exchange, config)
        self.settings = KeptSettings()
        self._at_deg, self._stands_s = 0.0, -1.0
        self._turn = 0
        self._lock = threading.Lock()

    def identify(self) -> Identity:
        return Identity("switch", "commands to turn and stop, without an angle")

    def limits(self) -> AxisLimits:
        rate = self._config.rate_dps
        # It reaches its rate at once, as far as anybody knows.
        return AxisLimits(rate, 100.0 * rate, None, None, 0.01, hardware_watchdog=False, told=True)

    def read(self) -> AxisReading:
        now = self._clock.now()
        return AxisReading(now, self._at_deg, 0.0, now < self._stands_s, True, (), ())

    def home(self) -> None:
        """Wherever it stands is its zero."""
        self.stop()
        self._at_deg = 0.0

    def move_to(self, position_deg: float, rate_dps: float, acceleration_dps2: float) -> None:
        if rate_dps > self._config.rate_dps * (1.0 + 1e-9):
            raise LimitExceeded(f"{rate_dps:g} deg/s exceeds the rate of the motor, {self._config.rate_dps:g} deg/s.")
        way, now = position_deg - self._at_deg, self._clock.now()
        lasts_s = abs(way) / self._config.rate_dps
        self._at_deg, self._stands_s = position_deg, now + lasts_s + self._config.coast_s
        if not way:
            return
        with self._lock:
            self._turn += 1
            turn = self._turn
            self._say(self._config.forward if way > 0.0 else self._config.backward)

        def stop_in_time() -> None:
            self._clock.sleep_until(now + lasts_s)
            with self._lock:
                # A later command, or a stop, came first.
                if turn == self._turn:
                    self._say(self._config.stop)

        threading.Thread(target=stop_in_time, daemon=True, name="stopping a switched axis").start()

    def spin(self, rate_dps: float, acceleration_dps2: float) -> None:
        raise Rejected("a motor that is only switched on and off has no known rate.")

    def stop(self) -> None:
        with self._lock:
            self._turn += 1
            self._say(self._config.stop)
        self._stands_s = self._clock.now() + self._config.coast_s
        self._clock.sleep(self._config.coast_s)

    def safe(self, policy: AxisSafe) -> SafeReport:
        self.stop()
        unseen = "command sent; nothing shows that the axis is at rest: look at the axis"
        said = "confirmed" if self._config.answer else unseen
        return SafeReport(policy.value, bool(self._config.answer), f'"{self._config.stop}" {said}')

    def _say(self, word: str) -> None:
        answer = self._config.answer

        def confirms(frame: bytes) -> None:
            if frame.decode("latin-1") != answer:
                raise NotThisReply

        if not answer:
            self._exchange.write(f"{word}\n".encode())
            return
        try:
            self._exchange.query(f"{word}\n".encode(), confirms, repeat=False)
        except (ReplyTimeout, FramingError) as problem:
            raise NotVerified(f"The motor did not confirm {word!r} with {answer!r}. {problem}") from None
