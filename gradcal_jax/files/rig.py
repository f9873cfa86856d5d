"""`gradcal-rig/1`: which device hangs on which port, who it must be, and what it does when a run ends badly.

The file names drivers and ports; what a driver's `options` mean is the driver's own affair and is read by
`gradcal_jax.hardware.setup`, so that this room needs no serial library.
"""

import re
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import AfterValidator, Field, ValidationError, model_validator

from gradcal_jax.files.document import format_problem, read_text, read_toml
from gradcal_jax.files.lines import with_lines
from gradcal_jax.files.problems import Problem, SpecError, from_validation
from gradcal_jax.files.quantity import Flag, PositiveTemperatureDifference, Quantity, Temperature, Text, Time
from gradcal_jax.files.section import Section, refuse

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
    """Serial libraries know other addresses, too, some of which write files: a rig file may come from anybody."""
    if text == TERMINAL or _PORT.fullmatch(text):
        return text
    raise ValueError("expected a device path, such as /dev/ttyUSB0, or COM3, socket://host:port, rfc2217://host:port")


Port = Annotated[Text, AfterValidator(_port)]


class ChamberDevice(Section):
    """`[chamber]`. `safe` says what it does when a run ends badly; `ambient` is where "ambient" goes.

    While a run follows its course, the air may be `lag` behind it and `band` beside it; more pauses the run.

    `serial_number`, where given, must be the device's own: another chamber on the same cable is refused.
    """

    driver: Text
    port: Port
    safe: Literal["standby", "hold", "ambient"]
    ambient: Temperature = Quantity(23.0, "23 degC", "temperature")
    lag: Time = Quantity(300.0, "5 min", "time")
    band: PositiveTemperatureDifference = Quantity(3.0, "3 K", "temperature difference")
    serial_number: Text | None = None
    options: Options = Field(default_factory=dict)


class EncoderDevice(Section):
    """`[axis.encoder]` of an axis that is turned by hand: a device that could drive an axis, of which only the angle is
    read."""

    driver: Text
    port: Port
    options: Options = Field(default_factory=dict)


class AxisDevice(Section):
    """`[[axis]]`, outermost first. `gravity_loaded` says that it moves by itself without power.

    The driver "operator" is a person who turns the axis and types its angle, at the port "terminal" where the run was
    started; with an `encoder` the angle is read from there.
    """

    name: Name
    driver: Text
    port: Port
    safe: Literal["hold", "controlled stop", "unpower"]
    gravity_loaded: Flag
    serial_number: Text | None = None
    options: Options = Field(default_factory=dict)
    encoder: EncoderDevice | None = None

    @model_validator(mode="after")
    def _does_not_fall(self) -> "AxisDevice":
        by_hand = self.driver == OPERATOR
        if by_hand and self.gravity_loaded:
            message = "a person lets go of it now and then, and it would fall; expected false, or another driver"
            refuse(Problem(("gravity_loaded",), message, "true"))
        if self.encoder is not None and not (by_hand and self.encoder.driver != OPERATOR):
            message = f'an encoder belongs to an axis whose driver is "{OPERATOR}", and has another one itself'
            refuse(Problem(("encoder", "driver"), message, self.encoder.driver))
        if self.port == TERMINAL and not by_hand:
            refuse(Problem(("port",), f'only the driver "{OPERATOR}" speaks with a terminal', self.port))
        if self.safe == "unpower" and self.gravity_loaded:
            refuse(
                Problem(("safe",), 'an axis that is loaded by gravity falls without power; expected "hold"', self.safe)
            )
        return self


class ImuDevice(Section):
    """`[[imu]]`: a unit under calibration."""

    name: Name
    driver: Text
    port: Port
    serial_number: Text | None = None
    options: Options = Field(default_factory=dict)


class OperatorPlace(Section):
    """`[operator]`: where somebody is asked to hang the units anew; absent: the terminal where the run was started."""

    port: Port = TERMINAL


class Laboratory(Section):
    """`[laboratory]`: who signs a certificate."""

    name: Text
    address: Text | None = None
    operator: Text | None = None


class TraceableReference(Section):
    """`[[reference]]`: what a certificate's values are traced to; `due`: until when its own certificate holds."""

    device: Literal["table", "encoder", "chamber", "thermometer", "clock"]
    identity: Text
    certificate: Text | None = None
    due: Text | None = None


class RigFile(Section):
    """A whole rig file."""

    format: Literal["gradcal-rig/1"]
    title: Text | None = None
    chamber: ChamberDevice | None = None
    axis: Annotated[tuple[AxisDevice, ...], Field(max_length=6)] = ()
    imu: Annotated[tuple[ImuDevice, ...], Field(max_length=64)] = ()
    operator: OperatorPlace | None = None
    laboratory: Laboratory | None = None
    reference: Annotated[tuple[TraceableReference, ...], Field(max_length=20)] = ()

    @model_validator(mode="after")
    def _consistent(self) -> "RigFile":
        refuse(*self._doubles(), *self._shared_ports())
        if self.chamber is None and not self.axis and not self.imu:
            refuse(Problem((), "there is no device in this rig; expected [chamber], [[axis]] or [[imu]]"))
        return self

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
        users = Counter([device.port for device in (*self.imu, *encoders, *([self.chamber] if self.chamber else []))])
        drivers: dict[str, set[str]] = {}
        for axis in self.axis:
            drivers.setdefault(axis.port, set()).add(axis.driver)
        wrong = {port for port in (*users, *drivers) if users[port] + len(drivers.get(port, ())) > 1}
        places = [
            *((("chamber", "port"), device) for device in ([self.chamber] if self.chamber else [])),
            *((("axis", index, "port"), device) for index, device in enumerate(self.axis)),
            *((("imu", index, "port"), device) for index, device in enumerate(self.imu)),
        ]
        return [
            Problem(key, "two devices use this port; only axes of one controller can share one", device.port)
            for key, device in places
            if device.port in wrong
        ]


def read_rig(path: str | Path) -> RigFile:
    """Read a rig file: which device hangs on which port, and what "safe" means for it; quantities with units.

    Errors: `SpecError` that lists everything wrong with it, options of drivers excepted.
    """
    return parse_rig(read_text(path), str(path))


def parse_rig(text: str, source: str = "") -> RigFile:
    """A rig from the text of a TOML file; `source` names it in messages. Raises `SpecError`."""
    with with_lines(text):
        return rig_of(read_toml(text, source), source)


def rig_of(document: Mapping[str, Any], source: str = "") -> RigFile:
    """A rig from tables as TOML gives them. Raises `SpecError` that lists everything wrong."""
    problem = format_problem(document, FORMAT)
    if problem is not None and isinstance(document.get("format"), str):
        raise SpecError([problem], source)
    try:
        return RigFile.model_validate(document)
    except ValidationError as error:
        problems = from_validation(error)
    except SpecError as error:
        problems = list(error.problems)
    if problem is not None:
        problems = [problem, *(p for p in problems if p.key != ("format",))]
    raise SpecError(problems, source)


TEMPLATE: Final = """\
format = "gradcal-rig/1"
title  = "my bench"

# What hangs on which port. A port is a device path, COM3, or a URL such as socket://192.168.0.7:10001.
# `gradcal rig check` reads everything back from the devices.

[chamber]
driver  = "espec"            # espec, weiss or watlow_f4
port    = "/dev/ttyUSB0"
safe    = "standby"          # when a run ends badly: standby, hold or ambient
ambient = "23 degC"
lag     = "5 min"            # in a run the air may be so far behind its course,
band    = "3 K"              # and so far beside it
# [chamber.options]          # what the driver leaves open; see its documentation
# baudrate = 19200

[[axis]]                     # outermost first
name           = "table"
driver         = "zaber"     # zaber or odrive; or operator: somebody turns it by hand (see below)
port           = "/dev/ttyUSB1"
safe           = "hold"      # hold, controlled stop or unpower
gravity_loaded = false       # true: it moves by itself without power
[axis.options]
max_rate         = "300 deg/s"
max_acceleration = "300 deg/s^2"

# A gimbal that is moved by hand: `gradcal run` asks for each turn where it was started, and for the angle afterwards.
# [[axis]]
# name           = "gimbal"
# driver         = "operator"
# port           = "terminal"
# safe           = "hold"
# gravity_loaded = false
# options        = { max_rate = "120 deg/s", travel = "1080 deg", unit = "deg" }   # unit: of a bare number
# encoder        = { driver = "odrive", port = "/dev/ttyUSB3" }   # read instead of typed; its motor is left alone

[[imu]]
name   = "unit1"
driver = "stim300"           # stim300 or vectornav
port   = "/dev/ttyUSB2"
# serial_number = "N25582405002002"   # refuse any other unit
[imu.options]
sample_rate = "125 Hz"

# Who hangs a whole unit anew, where its spec has several mountings; without it, whoever started the run.
# [operator]
# port = "/dev/ttyUSB4"

# For `gradcal report --certificate`: who signs, and what the values are traced to.
# [laboratory]
# name     = "Calibration laboratory"
# operator = "A. Person"
# [[reference]]
# device      = "encoder"    # table, encoder, chamber, thermometer or clock
# identity    = "RON 905, 12345"
# certificate = "K-2026-17"
# due         = "2027-06-30"
"""
"""What `gradcal rig new` writes: a commented rig to be edited."""
