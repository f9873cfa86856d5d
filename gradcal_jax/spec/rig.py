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

from gradcal_jax.spec import presets
from gradcal_jax.tables.document import TitledFile, model_of, read_text, read_toml
from gradcal_jax.tables.problems import Problem
from gradcal_jax.tables.quantity import Flag, PositiveTemperatureDifference, Quantity, Temperature, Text, Time
from gradcal_jax.tables.section import Section

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


class _Device(Section):
    driver: Text
    """Name of the driver: of a chamber "registers" or "lines", of an axis "lines" or "operator", of an IMU "frames" or
    "text_unit"."""
    port: Port
    """Port of the device: a device path, COM3, or a socket:// or rfc2217:// address; "terminal" for an operator."""
    options: Options = Field(default_factory=dict)
    """Options of the driver, such as its protocol; see its documentation."""


class _KnownDevice(_Device):
    serial_number: Text | None = None
    """Serial number of the device; a different device at the port is refused."""


class ChamberDevice(_KnownDevice):
    """`[chamber]`: the device that controls the temperature."""

    safe: Literal["standby", "hold", "ambient"]
    """State in which every run leaves the chamber."""
    ambient: Temperature = Quantity(23.0, "23 degC", "temperature")
    """Temperature of the state "ambient"."""
    lag: Time = Quantity(300.0, "5 min", "time")
    """If the air lags behind the ramp of the set point by more than this, the run pauses."""
    band: PositiveTemperatureDifference = Quantity(3.0, "3 K", "temperature difference")
    """If the air deviates from the temperature profile by more than this, the run pauses."""
    never_above: Temperature | None = None
    """If air or load is warmer than this, the run ends, whatever it is doing; absent: the chamber's own limit plus
    `band`."""
    never_below: Temperature | None = None
    """If air or load is colder than this, the run ends, whatever it is doing; absent: the chamber's own limit minus
    `band`."""

    def _problems(self) -> Iterator[Problem]:
        above, below = self.never_above, self.never_below
        if above is not None and float(self.ambient) > float(above):
            yield Problem(("never_above",), "must not be below `ambient`", above.text)
        if below is not None and float(self.ambient) < float(below):
            yield Problem(("never_below",), "must not be above `ambient`", below.text)


class EncoderDevice(_Device):
    """`[axis.encoder]` of an axis turned by hand: a device with an axis driver; only its angle is read."""


class AxisDevice(_KnownDevice):
    """`[[axis]]`: the device that turns one axis of the table; the axes are listed from the outermost inwards. The
    driver "operator" asks a person to
    turn the axis and to type its angle; if there is an `encoder`, the angle is read from it instead."""

    name: Name
    """Name of the device in runs and logs."""
    safe: Literal["hold", "controlled stop", "unpower"]
    """State in which every run leaves the axis."""
    gravity_loaded: Flag
    """Whether gravity moves the axis if its motor has no power."""
    encoder: EncoderDevice | None = None
    """Encoder of an axis that is turned by hand."""

    def _problems(self) -> Iterator[Problem]:
        by_hand = self.driver == OPERATOR
        if by_hand and self.gravity_loaded:
            message = (
                "gravity turns this axis if nothing holds it, and a person cannot hold it all the time: expected "
                "false, or another driver"
            )
            yield Problem(("gravity_loaded",), message, "true")
        if self.encoder is not None and not (by_hand and self.encoder.driver != OPERATOR):
            message = (
                f'an encoder is only for an axis with the driver "{OPERATOR}", and must itself have a different driver'
            )
            yield Problem(("encoder", "driver"), message, self.encoder.driver)
        if self.port == TERMINAL and not by_hand:
            yield Problem(("port",), f'"terminal" is only for the driver "{OPERATOR}"', self.port)
        if self.safe == "unpower" and self.gravity_loaded:
            message = 'gravity turns this axis if its motor has no power; expected "hold"'
            yield Problem(("safe",), message, self.safe)


class ImuDevice(_KnownDevice):
    """`[[imu]]`: an IMU under calibration."""

    name: Name
    """Name of the device in runs and logs."""


class OperatorPlace(Section):
    """`[operator]`: the terminal at which the operator is asked to change the mounting."""

    port: Port = TERMINAL
    """Port of this terminal."""


class Laboratory(Section):
    """`[laboratory]`: the laboratory that signs a certificate."""

    name: Text
    """Name of the laboratory."""
    address: Text | None = None
    """Address of the laboratory."""
    operator: Text | None = None
    """Person who makes the calibration."""


class TraceableReference(Section):
    """`[[reference]]`: a reference to which a certificate's values are traced."""

    device: Literal["table", "encoder", "chamber", "thermometer", "clock"]
    """Device of the rig that is the reference."""
    identity: Text
    """Make and serial number of the device."""
    certificate: Text | None = None
    """Number of the device's own certificate."""
    due: Text | None = None
    """Date until which this certificate is valid."""


class Alarm(Section):
    """`[alarm]`: a program that is called if the run pauses by itself or ends badly."""

    command: Annotated[tuple[Text, ...], Field(min_length=1, max_length=20)]
    """Program and its arguments; the reason is added as the last argument. The command does not pass through a
    shell."""


class RigFile(TitledFile):
    """A rig file: devices and their ports."""

    format: Literal["gradcal-rig/1"]
    chamber: ChamberDevice | None = None
    """The chamber; absent: there is none."""
    axis: Annotated[tuple[AxisDevice, ...], Field(max_length=6)] = ()
    """Axes of the table."""
    imu: Annotated[tuple[ImuDevice, ...], Field(max_length=64)] = ()
    """IMUs under calibration."""
    alarm: Alarm | None = None
    """Command that calls the operator."""
    operator: OperatorPlace | None = None
    """Terminal at which the operator is asked to change the mounting; absent: the terminal in which the run was
    started."""
    laboratory: Laboratory | None = None
    """Laboratory that signs a certificate."""
    reference: Annotated[tuple[TraceableReference, ...], Field(max_length=20)] = ()
    """References to which a certificate's values are traced."""

    def _problems(self) -> Iterator[Problem]:
        named = [(("axis", k), axis) for k, axis in enumerate(self.axis)]
        named += [(("imu", k), imu) for k, imu in enumerate(self.imu)]
        names = Counter(device.name for _, device in named)
        for key, device in named:
            if names[device.name] > 1:
                yield Problem((*key, "name"), "two devices have this name", device.name)
        # Only axes of one controller share a port: they speak one protocol, by address.
        chamber = () if self.chamber is None else (self.chamber,)
        encoders = (axis.encoder for axis in self.axis if axis.encoder is not None)
        users = Counter(_adapter(device.port) for device in (*self.imu, *encoders, *chamber))
        users.update(port for port, _ in {(_adapter(axis.port), axis.driver) for axis in self.axis})
        for key, device in (*((("chamber",), one) for one in chamber), *named):
            if users[_adapter(device.port)] > 1:
                message = "two devices use this port, and only axes of one controller can share a port"
                yield Problem((*key, "port"), message, device.port)
        if not (chamber or named):
            yield Problem((), "this rig has no device: expected [chamber], [[axis]] or [[imu]]")


def read_rig(path: str | Path) -> RigFile:
    """Read a rig file: which device hangs on which port, and what "safe" means for it; quantities with units.

    Errors: `SpecError` that lists everything wrong with it, options of drivers excepted.
    """
    return parse_rig(read_text(path), str(path))


def parse_rig(text: str, source: str = "") -> RigFile:
    """A rig from the text of a TOML file; `source` names it in messages. Raises `SpecError`."""
    return rig_of(read_toml(text, source), source)


def rig_of(document: Mapping[str, Any], source: str = "") -> RigFile:
    """A rig from tables as TOML gives them. Raises `SpecError` that lists everything wrong."""
    return model_of(RigFile, document, FORMAT, source)


TEMPLATE: Final = presets.template("rig.toml")
"""A commented rig to be edited."""
