"""What units have in common to which nothing is sent: they are listened to, and their stamps show what was lost.

A counter that wraps early shows losses modulo its modulus, and the log adds the rest by the host's clock; a time or a
long counter shows them all, and that the unit restarted. Without a stamp the rate of samples alone shows a loss.
"""

from typing import Any, ClassVar, Final

import numpy as np

from gradcal_jax import units
from gradcal_jax.hardware.clock import Clock
from gradcal_jax.hardware.drivers.base import DescribedOptions, ExchangeDriver
from gradcal_jax.hardware.errors import FramingError, ReplyTimeout, printable
from gradcal_jax.hardware.framing import LineFramer
from gradcal_jax.hardware.request_reply import Exchange
from gradcal_jax.hardware.roles import Identity, ImuDecoder, ImuSettings, KeptSettings
from gradcal_jax.hardware.transport import Transport

_ENOUGH = 3
_LOOKS_S = 0.1
_LONG = 1 << 16
SECONDS: Final = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}


class SampleTimes:
    """The unit's own times (s) of its samples, from a stamp of each: `kind` "count", "time", or "" for none.

    tick_s   duration of one step of the stamp, s
    modulus  value at which the stamp restarts at 0; None: it never restarts
    """

    def __init__(self, kind: str, rate_hz: float, tick_s: float, modulus: int | None) -> None:
        self._kind, self._rate_hz, self._modulus = kind, rate_hz, modulus
        self.resolution_s = tick_s if kind else 1.0 / rate_hz
        self._step = 1.0 / (rate_hz * self.resolution_s)
        self._short = kind == "count" and modulus is not None and modulus < _LONG
        self.round_samples = round((modulus or 0) / self._step) if self._short else 0
        self._before: tuple[float, float] | None = None
        self._samples = 0

    def push(self, stamps: Any) -> tuple[Any, Any, Any]:
        """For each sample: its time, the samples missing before it, and whether the unit restarted before it."""
        count = len(stamps)
        never = np.zeros(count, np.bool_)
        if not self._kind:
            first, self._samples = self._samples, self._samples + count
            return np.arange(first + 1, first + 1 + count) / self._rate_hz, np.zeros(count, np.int64), never
        stamps = stamps.astype(np.float64)
        stamp, ticks = self._before or (float(stamps[0]) - self._step, 0.0)
        steps = np.diff(stamps, prepend=stamp)
        restarted = steps < 0.0
        if self._modulus is not None:
            steps = np.mod(steps, float(self._modulus))
            restarted = never if self._short else steps > 0.5 * self._modulus
        steps = np.where(restarted, self._step, steps)
        if self._short:
            steps[steps == 0.0] = self._modulus
        counts = ticks + np.cumsum(steps)
        self._before = float(stamps[-1]), float(counts[-1])
        gaps = np.maximum(np.rint(steps / self._step).astype(np.int64) - 1, 0)
        return counts * self.resolution_s, gaps, restarted


def conversion(unit: str, wanted: str, factor: float = 1.0) -> tuple[float, float]:
    """Scale and zero of a linear change of units, times `factor`."""
    zero = units.convert(0.0, unit, wanted) * factor
    return units.convert(1.0, unit, wanted) * factor - zero, zero


class ListeningConfig(DescribedOptions):
    """Options of an IMU to which nothing is sent."""

    role = "imu"
    driver: ClassVar[str]

    def decoder(self) -> ImuDecoder:
        raise NotImplementedError

    @property
    def expected(self) -> str:
        """What the description expects, for a message."""
        raise NotImplementedError

    @property
    def registers(self) -> dict[str, str]:
        """What a run's journal says of the description."""
        raise NotImplementedError

    def link(self, line: Transport, clock: Clock) -> Exchange:
        unit = self.described
        return Exchange(line, LineFramer(), clock, unit.title, float(unit.timeout))

    def device(self, link: Exchange, clock: Clock, name: str = "", encoder: object = None) -> "ListeningImu":
        return ListeningImu(link, self)


class ListeningImu(ExchangeDriver[ListeningConfig]):
    """A unit that sends by itself, and cannot be asked who it is: what it sends is its identity."""

    def __init__(self, exchange: Exchange, config: ListeningConfig) -> None:
        super().__init__(exchange, config)
        self._timeout_s = float(config.described.timeout)
        self._ready_s = self._clock.now() + float(config.described.boot)
        self.settings = KeptSettings()

    def read_bytes(self, timeout_s: float) -> tuple[bytes, float]:
        return self._exchange.transport.read_stamped(timeout_s)

    def decoder(self) -> ImuDecoder:
        return self._config.decoder()

    def identify(self) -> Identity:
        self._listen()
        return Identity(self._config.driver, self._title)

    def configure(self) -> ImuSettings:
        self._listen()
        return ImuSettings(float(self._config.described.rate), self._config.registers)

    def start(self) -> None: ...

    def stop(self) -> None: ...

    def _listen(self) -> None:
        """Wait for samples. Raises with what the unit sent instead."""
        transport, decoder = self._exchange.transport, self.decoder()
        self._clock.sleep_until(self._ready_s)
        transport.drain()
        end = self._clock.now() + self._timeout_s
        samples, received = 0, b""
        while samples < _ENOUGH and self._clock.now() < end:
            self._clock.sleep(_LOOKS_S)
            data = transport.read(0.0)
            received = (received + data)[-1000:]
            samples += len(decoder.push(data, self._clock.now()))
        if samples >= _ENOUGH:
            return
        where, wait = f"{self._title} at {transport.url}", f"in {self._timeout_s:g} s"
        if not received:
            raise ReplyTimeout(f"{where} sent nothing {wait}. Check power, cable, port, baud rate, and `boot`.")
        raise FramingError(
            f"{where} sent {printable(received[-80:])!r} {wait}, but the description expects {self._config.expected}. "
            "Compare them character by character; unreadable text means a wrong baud rate."
        )
