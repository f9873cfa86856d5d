"""From a rig file to open devices: drivers by name, options in units, ports shared where axes share one.

A driver's options are the fields of its configuration class. A field with a unit in its name is written in the file
without it, as text with a unit: `reply_timeout_s` is `reply_timeout = "3 s"`.
"""

import dataclasses
import importlib
import types
import typing
from collections.abc import Callable, Collection, Mapping
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from typing import Annotated, Any, Final, Literal

from pydantic import ConfigDict, ValidationError, create_model

from gradcal_jax.hardware import roles
from gradcal_jax.hardware.clock import Clock
from gradcal_jax.hardware.drivers.operator import Console, OperatorConfig
from gradcal_jax.hardware.errors import HardwareError, WrongIdentity
from gradcal_jax.hardware.journal import Recorder
from gradcal_jax.hardware.transport import Terminal, TextLine, Transport, same_port
from gradcal_jax.spec.rig import (
    OPERATOR,
    TERMINAL,
    AxisDevice,
    ChamberDevice,
    EncoderDevice,
    ImuDevice,
    OperatorPlace,
    RigFile,
)
from gradcal_jax.tables.problems import Problem, SpecError, from_validation, hint, one_of
from gradcal_jax.tables.quantity import Of, Quantity
from gradcal_jax.tables.section import Section
from gradcal_jax.units import to_unit

LEFT: Final = "left streaming"
"""What happens to an IMU at the end of a run: it has no unsafe state."""
Role = Literal["chamber", "axis", "imu"]
Device = ChamberDevice | AxisDevice | ImuDevice


ENTRY_POINTS: Final = "gradcal.drivers"
"""The group of entry points by which other packages add drivers: each names a `Driver`."""


@dataclass(frozen=True)
class Driver:
    """A driver's module, and the names of its device's and its configuration's class in it.

    The module also has `open_exchange(line, clock, config)`; the configuration of a unit has `decoder()`. A
    configuration may have `lacks_for(safe)`: a sentence where a device with these options cannot take a safe state of
    the rig file, else an empty text.
    """

    role: Role | None
    """Role of the device; None: the configuration states it."""
    module: str
    device_class: str
    config_class: str

    def load(self) -> types.ModuleType:
        return importlib.import_module(self.module)

    def config(self) -> type[Any]:
        return getattr(self.load(), self.config_class)

    def device(self) -> Callable[..., Any]:
        return getattr(self.load(), self.device_class)


_HERE: Final = f"{__package__}.drivers"
DRIVERS: Final[Mapping[str, Driver]] = {
    "registers": Driver("chamber", f"{_HERE}.registers", "RegistersChamber", "RegistersConfig"),
    "lines": Driver(None, f"{_HERE}.lines", "lines_device", "LinesConfig"),
    OPERATOR: Driver("axis", f"{_HERE}.operator", "OperatorAxis", "OperatorConfig"),
    "frames": Driver("imu", f"{_HERE}.frames", "ListeningImu", "FramesConfig"),
    "text_unit": Driver("imu", f"{_HERE}.text_unit", "ListeningImu", "TextUnitConfig"),
}
"""The drivers that come with this program; `driver_of` knows those of other packages, too."""


def driver_names(role: Role) -> list[str]:
    """The drivers that a device of a role may have. Drivers of other packages are imported for it."""
    outside = sorted({entry.name for entry in entry_points(group=ENTRY_POINTS)} - set(DRIVERS))
    drivers = {**DRIVERS, **{name: driver_of(name) for name in outside}}
    return [name for name, driver in drivers.items() if driver is not None and _fits(driver, role)]


def driver_of(name: str) -> Driver | None:
    """A driver by its name in the rig file: this program's, which cannot be replaced, or another package's.

    Raises `ValueError` where two packages have a driver of this name, or where it cannot be loaded.
    """
    if name in DRIVERS:
        return DRIVERS[name]
    entries = list(entry_points(group=ENTRY_POINTS, name=name))
    if not entries:
        return None
    where = " and ".join(sorted(str(entry.dist.name if entry.dist else entry.value) for entry in entries))
    if len(entries) > 1:
        raise ValueError(f"several packages have a driver of this name: {where}; uninstall all but one")
    try:
        driver = entries[0].load()
    except Exception as problem:
        why = f"{type(problem).__name__}: {problem}"
        raise ValueError(f"the driver of this name in the package {where} cannot be loaded: {why}") from None
    if not isinstance(driver, Driver):
        raise ValueError(f"the package {where} has {entries[0].value} as a driver, but this is not a `setup.Driver`")
    return driver


def known_driver(name: str) -> Driver:
    """A driver that `config_of` has accepted."""
    driver = driver_of(name)
    assert driver is not None
    return driver


def _fits(driver: Driver, role: Role) -> bool:
    return driver.role == role or (driver.role is None and role != "imu")


# Ending of a field's name -> dimension of its text, unit of its number. Longest first.
_UNITS: Final = (
    ("_dps2", "angular acceleration", "deg/s^2"),
    ("_dps", "angular rate", "deg/s"),
    ("_deg", "angle", "deg"),
    ("_hz", "frequency", "Hz"),
    ("_c", "temperature", "degC"),
    ("_s", "time", "s"),
)


# Options of every device on a serial line, beside its driver's.
_LINE_OPTIONS: Final[Mapping[str, Any]] = {
    "bytesize": Literal[7, 8],
    "parity": Literal["N", "E", "O"],
    "stopbits": Literal[1, 2],
}


def option_names(driver: str) -> dict[str, str]:
    """The options of a driver, in the file's spelling -> the fields of its configuration."""
    return {_spelt(f.name)[0]: f.name for f in dataclasses.fields(known_driver(driver).config())}


class _Options(Section):
    """The options of a device, whose fields are made from its driver's configuration."""

    model_config = ConfigDict(strict=True)


def _options_of(driver: Driver, *, line: bool = True) -> type[Section]:
    """The table of a driver's options; `line`: with those of a serial line."""
    fields: dict[str, Any] = {}
    kinds = typing.get_type_hints(driver.config(), include_extras=True)
    for option in dataclasses.fields(driver.config()):
        spelt, dimension, _ = _spelt(option.name)
        fields[spelt] = (Annotated[Quantity, Of(dimension)] if dimension else kinds[option.name], None)
    for name, choices in _LINE_OPTIONS.items() if line else ():
        fields.setdefault(name, (choices, None))
    return create_model("Options", __base__=_Options, **fields)


def config_of(device: Device | EncoderDevice, role: Role, place: tuple[str | int, ...]) -> Any:
    """The driver's configuration for a device of the rig file.

    Raises:
        SpecError: no such driver, a driver of another role, unknown options, wrong values; all at once, with keys.
    """
    try:
        driver = driver_of(device.driver)
    except ValueError as problem:
        raise SpecError([Problem((*place, "driver"), str(problem), device.driver)]) from None
    if driver is None or not _fits(driver, role):
        fitting = driver_names(role)
        ending = hint(device.driver, fitting)
        raise SpecError([Problem((*place, "driver"), f"expected {one_of(fitting)}{ending}", device.driver)])
    config, place = driver.config(), (*place, "options")
    try:
        options = _options_of(driver, line=device.port != TERMINAL).model_validate(device.options)
    except ValidationError as error:
        raise SpecError([problem.under(*place) for problem in from_validation(error)]) from None
    values: dict[str, Any] = {}
    for spelt, name in option_names(device.driver).items():
        if spelt in options.model_fields_set:
            value, unit = getattr(options, spelt), _spelt(name)[2]
            values[name] = to_unit(float(value), unit) if unit else value
    try:
        built = config(**values)
    except SpecError as error:
        raise SpecError([problem.under(*place, "protocol") for problem in error.problems]) from None
    except ValueError as problem:
        raise SpecError([Problem(place, str(problem))]) from None
    if driver.role is None and built.role != role:
        raise SpecError([Problem((*place, "protocol"), f"describes an {built.role}; expected a {role}")])
    return built


def configs_of(rig: RigFile) -> dict[tuple[str | int, ...], Any]:
    """The configurations of all devices, by their place in the file. Raises `SpecError` with every problem."""
    configs: dict[tuple[str | int, ...], Any] = {}
    problems: list[Problem] = []
    for role, place, _, device in _entries(rig):
        try:
            configs[place] = config_of(device, role, place)
            # Drivers that declare nothing can take every safe state.
            lacks_for: Callable[[str], str] = getattr(configs[place], "lacks_for", lambda safe: "")
            if not isinstance(device, ImuDevice) and (lack := lacks_for(device.safe)):
                problems.append(
                    Problem((*place, "safe"), f"this device does not support this safe state: {lack}", device.safe)
                )
            if isinstance(device, AxisDevice) and device.encoder is not None:
                configs[*place, "encoder"] = config_of(device.encoder, role, (*place, "encoder"))
        except SpecError as error:
            problems += error.problems
    if problems:
        raise SpecError(problems)
    return configs


def _spelt(name: str) -> tuple[str, str, str]:
    for ending, dimension, unit in _UNITS:
        if name.endswith(ending):
            return name.removesuffix(ending), dimension, unit
    return name, "", ""


def _entries(rig: RigFile) -> list[tuple[Role, tuple[str | int, ...], str, Device]]:
    """All devices of a rig: role, place in the file, name and table; the chamber's name is "chamber". Axes are first,
    because what turns is made safe first."""
    chamber = () if rig.chamber is None else (rig.chamber,)
    return [
        *(("axis", ("axis", index), axis.name, axis) for index, axis in enumerate(rig.axis)),
        *(("chamber", ("chamber",), "chamber", entry) for entry in chamber),
        *(("imu", ("imu", index), imu.name, imu) for index, imu in enumerate(rig.imu)),
    ]


@dataclass
class Bench(AbstractContextManager["Bench"]):
    """The open devices of a rig. Closing it closes every port; it does not make anything safe (see `guard`)."""

    rig: RigFile
    chamber: roles.TemperatureChamber | None = None
    axes: dict[str, roles.MotionAxis] = field(default_factory=dict[str, roles.MotionAxis])
    imus: dict[str, roles.ImuStream] = field(default_factory=dict[str, roles.ImuStream])
    console: roles.OperatorAsked | None = None
    """Where the operator is asked to change the mounting."""
    lines: dict[str, Transport] = field(default_factory=dict[str, Transport])
    """The open serial line of every device, by its name; absent for the terminal."""
    simulated: bool = False
    """Whether its devices are simulated and wait on the run's clock, instead of on lines."""
    _ports: ExitStack = field(default_factory=ExitStack)

    @property
    def settings(self) -> dict[str, roles.KeptSettings]:
        return {name: device.settings for name, device in (*self.axes.items(), *self.imus.items())}

    def chamber_limits(self) -> roles.ChamberLimits | None:
        if self.chamber is None or self.rig.chamber is None:
            return None
        limits, below, above = self.chamber.limits(), self.rig.chamber.never_below, self.rig.chamber.never_above
        lowest = limits.lowest_c if below is None else max(limits.lowest_c, float(below))
        highest = limits.highest_c if above is None else min(limits.highest_c, float(above))
        return dataclasses.replace(limits, lowest_c=lowest, highest_c=highest)

    def devices(self) -> list[tuple[str, Device, roles.MotionAxis | roles.TemperatureChamber | roles.ImuStream]]:
        """Name, entry in the rig file, and device: of the axes, the chamber and the units."""
        opened: dict[str, Any] = {**self.axes, **self.imus, "chamber": self.chamber}
        return [(name, entry, opened[name]) for _, _, name, entry in _entries(self.rig) if opened.get(name)]

    def close(self) -> None:
        self._ports.close()

    def __exit__(self, *_: object) -> None:
        self.close()


def open_rig(
    rig: RigFile,
    clock: Clock,
    recorder_of: Callable[[str], Recorder | None] | None = None,
    *,
    terminal: Terminal | None = None,
) -> Bench:
    """Open every port of a rig. `recorder_of` gives the recorder of a port; `terminal` is the
    operator's, absent where there is none.

    Raises:
        SpecError: options that a driver does not have.
        PortRefused: a port that cannot be opened; those opened before are closed again.
    """
    configs = configs_of(rig)
    bench, exchanges, lines = Bench(rig), dict[str, Any](), dict[str, Transport]()

    def opened(device: Device | EncoderDevice | OperatorPlace, config: Any) -> TextLine:
        url, recorder = device.port, None if recorder_of is None else recorder_of(device.port)
        if url == TERMINAL:
            line = terminal or Terminal()
            line.clock, line.recorder = clock, recorder
        else:
            options = {} if isinstance(device, OperatorPlace) else device.options
            settings: dict[str, Any] = dict(getattr(config, "line_settings", {}))
            settings |= {name: options[name] for name in _LINE_OPTIONS if name in options}
            settings["baudrate"] = config.baudrate
            line = lines[same_port(url)] = Transport(url, clock=clock, recorder=recorder, **settings)
        bench._ports.callback(line.close)  # pyright: ignore[reportPrivateUsage]
        return line

    def axis_or_chamber(device: Device | EncoderDevice, config: Any, *more: Any) -> Any:
        driver, port = known_driver(device.driver), same_port(device.port)
        if port not in exchanges:
            exchanges[port] = driver.load().open_exchange(opened(device, config), clock, config)
        return driver.device()(exchanges[port], config, *more)

    try:
        for _, place, _, device in _entries(rig):
            config = configs[place]
            if isinstance(device, ImuDevice):
                bench.imus[device.name] = known_driver(device.driver).device()(opened(device, config), clock, config)
            elif isinstance(device, ChamberDevice):
                bench.chamber = axis_or_chamber(device, config)
            else:
                more: tuple[Any, ...] = ()
                if device.driver == OPERATOR:
                    encoder = device.encoder
                    read = None if encoder is None else axis_or_chamber(encoder, configs[*place, "encoder"])
                    more = (clock, device.name, read)
                bench.axes[device.name] = axis_or_chamber(device, config, *more)
        for name, (port, _) in lines_of(rig).items():
            if same_port(port) in lines:
                bench.lines[name] = lines[same_port(port)]
        consoles = [exchange for exchange in exchanges.values() if isinstance(exchange, Console)]
        if consoles:
            bench.console = consoles[0]
        elif rig.operator is not None or terminal is not None:
            bench.console = Console(opened(rig.operator or OperatorPlace(), OperatorConfig()), clock)
    except BaseException:
        bench.close()
        raise
    return bench


@dataclass(frozen=True)
class DeviceReport:
    """A device's identity and limits, or the sentence why there are none."""

    name: str
    driver: str
    port: str
    identity: roles.Identity | None = None
    limits: roles.ChamberLimits | roles.AxisLimits | roles.ImuSettings | None = None
    problem: str = ""
    remark: str = ""
    """A fault of a device that answers, such as late answers; the operator should correct it."""

    @property
    def good(self) -> bool:
        return not self.problem


def only_of(rig: RigFile, names: Collection[str]) -> RigFile:
    """The rig with these devices alone; the chamber's name is "chamber"."""
    chosen = {role: tuple(of for of in getattr(rig, role) if of.name in names) for role in ("axis", "imu")}
    return rig.model_copy(update={"chamber": rig.chamber if "chamber" in names else None, **chosen})


def lines_of(rig: RigFile) -> dict[str, tuple[str, str]]:
    return {name: (device.port, getattr(device, "safe", LEFT)) for _, _, name, device in _entries(rig)}


def check_rig(bench: Bench) -> list[DeviceReport]:
    """Ask every device for identity, limits and a reading; compare serial numbers with the rig file. Nothing moves."""
    # The chamber first, as in the rig file.
    devices = sorted(bench.devices(), key=lambda device: device[0] != "chamber")
    reports = [_report(bench, *device) for device in devices]
    late = {name: line.late for name, line in bench.lines.items()}
    return [dataclasses.replace(report, remark=late.get(report.name, "")) for report in reports]


def check_each(rig: RigFile, clock: Clock) -> list[DeviceReport]:
    """Open and ask one device after the other; a refused port becomes a report. Raises `SpecError`."""
    configs_of(rig)
    reports: list[DeviceReport] = []
    for _, _, name, device in sorted(_entries(rig), key=lambda entry: entry[0] != "chamber"):
        try:
            with open_rig(only_of(rig, {name}), clock) as bench:
                reports += check_rig(bench)
        except HardwareError as problem:
            reports.append(DeviceReport(name, device.driver, device.port, problem=str(problem)))
    return reports


def _report(
    bench: Bench, name: str, entry: Device, device: roles.MotionAxis | roles.TemperatureChamber | roles.ImuStream
) -> DeviceReport:
    identity = None
    try:
        identity = device.identify()
        require_identity(name, entry, identity)
        if isinstance(device, roles.ImuStream):
            limits = device.configure()
        else:
            limits = bench.chamber_limits() if device is bench.chamber else device.limits()
            # Identity and limits may stand in the rig file alone: at least this is asked of the device.
            reading = device.read()
            if isinstance(reading, roles.ChamberReading):
                faults = reading.alarms
            else:
                # Many controllers report a missing reference as a fault: a run homes the axis first.
                faults = reading.faults if reading.referenced else ()
            if faults:
                return DeviceReport(name, entry.driver, entry.port, identity, problem=f"ALARM {', '.join(faults)}")
        return DeviceReport(name, entry.driver, entry.port, identity, limits)
    except HardwareError as problem:
        return DeviceReport(name, entry.driver, entry.port, identity, problem=str(problem))


def require_identity(name: str, entry: Device, identity: roles.Identity) -> None:
    """Raises `WrongIdentity` when the rig file names another serial number than the device."""
    if entry.serial_number is not None and entry.serial_number != identity.serial_number:
        raise WrongIdentity(
            f"{name} at {entry.port} has the serial number {identity.serial_number or '(none reported)'}, but the "
            f"rig file states {entry.serial_number}. Connect the right device or correct the rig file."
        )
