"""Drivers of IMUs to which nothing is sent: they send binary frames, or print lines, as a rig file describes them.

Unverified on real hardware: everything; each description says what its sources leave open.
"""

from gradcal_jax.hardware.clock import Clock
from gradcal_jax.hardware.drivers.described import DescribedOptions
from gradcal_jax.hardware.errors import FramingError, ReplyTimeout, printable
from gradcal_jax.hardware.frames import FramedSensor
from gradcal_jax.hardware.roles import Identity, ImuDecoder, ImuSettings
from gradcal_jax.hardware.text_unit import TextSensor
from gradcal_jax.hardware.transport import Transport

_ENOUGH = 3
_LOOKS_S = 0.1


class ListeningConfig(DescribedOptions):
    """Options of an IMU to which nothing is sent."""

    role = "imu"

    def decoder(self) -> ImuDecoder:
        """A new decoder of what the IMU sends; a log is read by it without the device."""
        return self.described.decoder()

    def link(self, line: Transport, clock: Clock) -> Transport:
        return line

    def device(self, link: Transport, clock: Clock, name: str = "", encoder: object = None) -> "ListeningImu":
        return ListeningImu(link, clock, self)


class FramesConfig(ListeningConfig):
    """Options of an IMU that sends binary frames."""

    kind = FramedSensor


class TextUnitConfig(ListeningConfig):
    """Options of an IMU that prints lines."""

    kind = TextSensor


class ListeningImu:
    """A unit that sends by itself, and cannot be asked who it is: what it sends is its identity."""

    def __init__(self, line: Transport, clock: Clock, config: ListeningConfig) -> None:
        self._line, self._clock, self._config, self._said = line, clock, config, config.described
        self._ready_s = clock.now() + float(self._said.boot)

    def read_bytes(self, timeout_s: float) -> tuple[bytes, float]:
        return self._line.read_stamped(timeout_s)

    def decoder(self) -> ImuDecoder:
        return self._config.decoder()

    def start(self) -> None:
        """The stream begins now: what the port held from before is dropped. Where it was full, samples are lost."""
        self._line.drain()

    def identify(self) -> Identity:
        self._listen()
        return Identity(self._said.format, self._said.title)

    def configure(self) -> ImuSettings:
        self._listen()
        return ImuSettings(float(self._said.rate), self._said.expected)

    def _listen(self) -> None:
        """Wait for samples. Raises with what the unit sent instead."""
        decoder, timeout_s = self.decoder(), float(self._said.timeout)
        self._clock.sleep_until(self._ready_s)
        self._line.drain()
        end_s = self._clock.now() + timeout_s
        samples, received = 0, b""
        while samples < _ENOUGH and self._clock.now() < end_s:
            self._clock.sleep(_LOOKS_S)
            data = self._line.read(0.0)
            received = (received + data)[-1000:]
            samples += len(decoder.push(data, self._clock.now()))
        if samples >= _ENOUGH:
            return
        where, wait = f"{self._said.title} at {self._line.url}", f"in {timeout_s:g} s"
        if not received:
            raise ReplyTimeout(f"{where} sent nothing {wait}. Check power, cable, port, baud rate, and `boot`.")
        expected = ", ".join(f"{name} {value!r}" for name, value in self._said.expected.items())
        raise FramingError(
            f"{where} sent {printable(received[-80:])!r} {wait}, but the description expects {expected}. "
            "Compare them character by character; unreadable text means a wrong baud rate."
        )
