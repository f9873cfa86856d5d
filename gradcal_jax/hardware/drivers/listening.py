"""Drivers of IMUs to which nothing is sent: they send binary frames, or print lines, as a rig file describes them.

Unverified on real hardware: everything; each description says what its sources leave open.
"""

from collections.abc import Iterable
from functools import cached_property
from typing import ClassVar

from gradcal_jax.hardware.clock import Clock
from gradcal_jax.hardware.drivers.base import DescribedOptions, ExchangeDriver
from gradcal_jax.hardware.errors import FramingError, ReplyTimeout, printable
from gradcal_jax.hardware.frames import FrameDecoder, FramedSensor
from gradcal_jax.hardware.framing import LineFramer
from gradcal_jax.hardware.line_protocol import described
from gradcal_jax.hardware.request_reply import Exchange
from gradcal_jax.hardware.roles import Identity, ImuDecoder, ImuSettings, KeptSettings
from gradcal_jax.hardware.text_unit import TextSensor, TextUnitDecoder
from gradcal_jax.hardware.transport import Transport
from gradcal_jax.tables.problems import Problem

_ENOUGH = 3
_LOOKS_S = 0.1


class ListeningConfig(DescribedOptions):
    """Options of an IMU to which nothing is sent."""

    role = "imu"
    driver: ClassVar[str]

    def decoder(self) -> ImuDecoder:
        raise NotImplementedError

    @property
    def registers(self) -> dict[str, str]:
        """What the description expects, for messages and the journal."""
        raise NotImplementedError

    def link(self, line: Transport, clock: Clock) -> Exchange:
        unit = self.described
        return Exchange(line, LineFramer(), clock, unit.title, float(unit.timeout))

    def device(self, link: Exchange, clock: Clock, name: str = "", encoder: object = None) -> "ListeningImu":
        return ListeningImu(link, self)


class FramesConfig(ListeningConfig):
    """Options of an IMU that sends binary frames."""

    driver = "frames"

    def _misfits(self, described: FramedSensor) -> Iterable[Problem]:
        baudrate, needed = self.line_settings["baudrate"], 10 * described.length * float(described.rate)
        if baudrate < needed:
            message = (
                f"{float(described.rate):g} frames/s of {described.length} bytes need {needed:.0f} bits/s, and the "
                f"line has {baudrate}: raise baudrate (also in the unit) or lower its rate."
            )
            yield Problem((), message)

    @cached_property
    def described(self) -> FramedSensor:
        return described(FramedSensor, self.protocol, self.changes)

    def decoder(self) -> FrameDecoder:
        return FrameDecoder(self.described)

    @property
    def registers(self) -> dict[str, str]:
        return {"sync": self.described.sync, "length": str(self.described.length)}


class TextUnitConfig(ListeningConfig):
    """Options of an IMU that prints lines."""

    driver = "text_unit"

    @cached_property
    def described(self) -> TextSensor:
        return described(TextSensor, self.protocol, self.changes)

    def decoder(self) -> TextUnitDecoder:
        return TextUnitDecoder(self.described)

    @property
    def registers(self) -> dict[str, str]:
        return {"line": self.described.line} | ({"checksum": "xor8"} if self.described.checksum == "xor8" else {})


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
        expected = ", ".join(f"{name} {value!r}" for name, value in self._config.registers.items())
        raise FramingError(
            f"{where} sent {printable(received[-80:])!r} {wait}, but the description expects {expected}. "
            "Compare them character by character; unreadable text means a wrong baud rate."
        )
