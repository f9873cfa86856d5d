"""`gradcal-rig/1`: the devices, their ports and serial numbers, and their safe states.

The file names drivers and ports; `gradcal_jax.hardware.setup` reads a driver's `options`, so that this package needs no
serial library.
"""

import os
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import AfterValidator, Field

from gradcal_jax.files import presets
from gradcal_jax.files.document import TitledFile, from_text, model_of, read_text
from gradcal_jax.files.problems import Problem
from gradcal_jax.files.quantity import Flag, PositiveTemperatureDifference, Quantity, Temperature, Text, Time
from gradcal_jax.files.section import Section

FORMAT: Final = "gradcal-rig/1"
OPERATOR: Final = "operator"
TERMINAL: Final = "terminal"

Name = Annotated[str, Field(strict=True, pattern=r"^[A-Za-z][A-Za-z0-9_-]{0,30}$")]
Options = dict[str, Any]
_HOST: Final = r"(?:\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9.-]+):\d{1,5}"
_PORT: Final = re.compile(
    rf"/(?!.*://)\S+|(?:\\\\\.\\)?COM\d{{1,3}}|socket://{_HOST}|rfc2217://{_HOST}"
    r"(?:\?(?:ign_set_control|poll_modem|timeout=\d+(?:\.\d+)?)(?:&(?:ign_set_control|poll_modem|timeout=\d+))*)?"
)


def _port(text: str) -> str:
    """Serial libraries accept other addresses, too, some of which write files; a rig file may be untrusted."""
    if text == TERMINAL or _PORT.fullmatch(text):
        return text
    raise ValueError("expected a device path, such as /dev/ttyUSB0, or COM3, socket://host:port, rfc2217://host:port")


Port = Annotated[Text, AfterValidator(_port)]


def _adapter(port: str) -> str:
    """One text for all names of an adapter on this computer."""
    return os.path.realpath(port) if port.startswith("/") else port


class ChamberDevice(Section):
    """`[chamber]`: the device that controls the temperature."""

    driver: Text
    """Name of its driver: espec, weiss, or registers or lines with a protocol."""
    port: Port
    """Where it is connected: a device path, COM3, or a socket:// or rfc2217:// address."""
    safe: Literal["standby", "hold", "ambient"]
    """Its state after a run that ends badly."""
    ambient: Temperature = Quantity(23.0, "23 degC", "temperature")
    """Temperature to which "ambient" goes."""
    lag: Time = Quantity(300.0, "5 min", "time")
    """Allowed lag of the air behind the ramp of the set point before a run pauses."""
    band: PositiveTemperatureDifference = Quantity(3.0, "3 K", "temperature difference")
    """Allowed deviation of the air from the temperature profile before a run pauses."""
    never_above: Temperature | None = None
    """Air or load warmer than this ends a run in every state; absent: the chamber's own limit and `band`."""
    never_below: Temperature | None = None
    """Air or load colder than this ends a run in every state; absent: the chamber's own limit and `band`."""
    serial_number: Text | None = None
    """Serial number of the device; a different device at the port is refused."""
    options: Options = Field(default_factory=dict)
    """Options of the driver; see its documentation."""

    def _problems(self) -> Iterator[Problem]:
        above, below = self.never_above, self.never_below
        if above is not None and float(self.ambient) > float(above):
            yield Problem(("never_above",), "it is below `ambient`; expected more", above.text)
        if below is not None and float(self.ambient) < float(below):
            yield Problem(("never_below",), "it is above `ambient`; expected less", below.text)


class EncoderDevice(Section):
    """`[axis.encoder]` of an axis turned by hand: a device with an axis driver, of which only the angle is read."""

    driver: Text
    """Name of its driver."""
    port: Port
    """Where it is connected."""
    options: Options = Field(default_factory=dict)
    """What the driver leaves open."""


class AxisDevice(Section):
    """`[[axis]]`, outermost first: the device that turns an axis of the table.

    The driver "operator" asks a person to turn the axis and type its angle; with an `encoder` the angle is read.
    """

    name: Name
    """Name of the device in runs and logs."""
    driver: Text
    """Name of its driver: zaber, odrive, switch or operator."""
    port: Port
    """Where it is connected; "terminal" for an operator."""
    safe: Literal["hold", "controlled stop", "unpower"]
    """Its state after a run that ends badly."""
    gravity_loaded: Flag
    """Whether it moves by itself without power."""
    serial_number: Text | None = None
    """Serial number of the device; a different device at the port is refused."""
    options: Options = Field(default_factory=dict)
    """Options of the driver; see its documentation."""
    encoder: EncoderDevice | None = None
    """Encoder of an axis that is turned by hand."""

    def _problems(self) -> Iterator[Problem]:
        by_hand = self.driver == OPERATOR
        if by_hand and self.gravity_loaded:
            message = "a person does not hold it all the time, and it would fall; expected false, or another driver"
            yield Problem(("gravity_loaded",), message, "true")
        if self.encoder is not None and not (by_hand and self.encoder.driver != OPERATOR):
            message = (
                f'an encoder is only for an axis with the driver "{OPERATOR}", and needs a different driver itself'
            )
            yield Problem(("encoder", "driver"), message, self.encoder.driver)
        if self.port == TERMINAL and not by_hand:
            yield Problem(("port",), f'only the driver "{OPERATOR}" uses a terminal', self.port)
        if self.safe == "unpower" and self.gravity_loaded:
            yield Problem(
                ("safe",), 'an axis that is loaded by gravity falls without power; expected "hold"', self.safe
            )


class ImuDevice(Section):
    """`[[imu]]`: a unit under calibration."""

    name: Name
    """Name of the device in runs and logs."""
    driver: Text
    """Name of its driver: stim300 or vectornav."""
    port: Port
    """Where it is connected."""
    serial_number: Text | None = None
    """Serial number of the IMU; a different IMU at the port is refused."""
    options: Options = Field(default_factory=dict)
    """Options of the driver; see its documentation."""


class OperatorPlace(Section):
    """`[operator]`: where the operator is asked to change the mounting."""

    port: Port = TERMINAL
    """The port of the operator's terminal."""


class Laboratory(Section):
    """`[laboratory]`: who signs a certificate."""

    name: Text
    """Its name."""
    address: Text | None = None
    """Its address."""
    country: Annotated[str, Field(strict=True, pattern=r"^[A-Z]{2}$")] | None = None
    """Two letters of ISO 3166, such as "DE"; a digital certificate needs it."""
    operator: Text | None = None
    """Who makes the calibration."""


class TraceableReference(Section):
    """`[[reference]]`: a reference that a certificate's values are traced to."""

    device: Literal["table", "encoder", "chamber", "thermometer", "clock"]
    """Which device of the rig."""
    identity: Text
    """Its make and number."""
    certificate: Text | None = None
    """Number of its own certificate."""
    due: Text | None = None
    """Until when that holds."""


class Alarm(Section):
    """`[alarm]`: a program that the run, or its guard, calls if the run pauses by itself or ends badly."""

    command: Annotated[tuple[Text, ...], Field(min_length=1, max_length=20)]
    """Program and its arguments; the reason is added as the last argument. No shell reads it."""


class RigFile(TitledFile):
    """A whole rig file."""

    format: Literal["gradcal-rig/1"]
    chamber: ChamberDevice | None = None
    """The chamber; absent: none."""
    axis: Annotated[tuple[AxisDevice, ...], Field(max_length=6)] = ()
    """Axes of the table."""
    imu: Annotated[tuple[ImuDevice, ...], Field(max_length=64)] = ()
    """IMUs under calibration."""
    longest_pause: Time = Quantity(1800.0, "30 min", "time")
    """How long a run that paused by itself waits for the operator; then it makes everything safe and ends."""
    alarm: Alarm | None = None
    """The command that calls the operator."""
    operator: OperatorPlace | None = None
    """Where the operator is asked to change the mounting; absent: the terminal where the run was started."""
    laboratory: Laboratory | None = None
    """Who signs a certificate."""
    reference: Annotated[tuple[TraceableReference, ...], Field(max_length=20)] = ()
    """The references that a certificate's values are traced to."""

    def _problems(self) -> Iterator[Problem]:
        yield from self._doubles()
        yield from self._shared_ports()
        if self.chamber is None and not self.axis and not self.imu:
            yield Problem((), "there is no device in this rig; expected [chamber], [[axis]] or [[imu]]")

    def _doubles(self) -> list[Problem]:
        names = Counter([device.name for device in (*self.axis, *self.imu)])
        return [
            Problem((kind, index, "name"), "two devices have this name", device.name)
            for kind, devices in (("axis", self.axis), ("imu", self.imu))
            for index, device in enumerate(devices)
            if names[device.name] > 1
        ]

    def _shared_ports(self) -> list[Problem]:
        """Only axes of one controller share a port: they speak one protocol, by address."""
        encoders = [axis.encoder for axis in self.axis if axis.encoder is not None]
        alone = (*self.imu, *encoders, *([self.chamber] if self.chamber else []))
        users = Counter([_adapter(device.port) for device in alone])
        drivers: dict[str, set[str]] = {}
        for axis in self.axis:
            drivers.setdefault(_adapter(axis.port), set()).add(axis.driver)
        wrong = {port for port in (*users, *drivers) if users[port] + len(drivers.get(port, ())) > 1}
        places = [
            *((("chamber", "port"), device) for device in ([self.chamber] if self.chamber else [])),
            *((("axis", index, "port"), device) for index, device in enumerate(self.axis)),
            *((("imu", index, "port"), device) for index, device in enumerate(self.imu)),
        ]
        return [
            Problem(key, "two devices use this port; only axes of one controller can share one", device.port)
            for key, device in places
            if _adapter(device.port) in wrong
        ]


def read_rig(path: str | Path) -> RigFile:
    """Read a rig file: which device hangs on which port, and what "safe" means for it; quantities with units.

    Errors: `SpecError` that lists everything wrong with it, options of drivers excepted.
    """
    return parse_rig(read_text(path), str(path))


def parse_rig(text: str, source: str = "") -> RigFile:
    """A rig from the text of a TOML file; `source` names it in messages. Raises `SpecError`."""
    return from_text(rig_of, text, source)


def rig_of(document: Mapping[str, Any], source: str = "") -> RigFile:
    """A rig from tables as TOML gives them. Raises `SpecError` that lists everything wrong."""
    return model_of(RigFile, document, FORMAT, source, lambda _: ())


TEMPLATE: Final = presets.template("rig.toml")
"""What `gradcal rig new` writes: a commented rig to be edited."""
