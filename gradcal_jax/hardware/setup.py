"""From a rig file to open devices: drivers by name, ports shared where axes share one."""

import dataclasses
from collections.abc import Callable, Collection, Mapping
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, field
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Final, Literal

from pydantic import ValidationError

from gradcal_jax.hardware import roles
from gradcal_jax.hardware.clock import Clock
from gradcal_jax.hardware.drivers.base import DriverOptions
from gradcal_jax.hardware.drivers.operator import Console
from gradcal_jax.hardware.errors import HardwareError, WrongIdentity
from gradcal_jax.hardware.interlocks import limits_of
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
from gradcal_jax.tables.problems import Key, Problem, SpecError, from_validation, hint, one_of

LEFT: Final = "left streaming"
"""What happens to an IMU at the end of a run: it has no unsafe state."""
Role = Literal["chamber", "axis", "imu"]
Opened = roles.MotionAxis | roles.TemperatureChamber | roles.ImuStream
Device = ChamberDevice | AxisDevice | ImuDevice

ENTRY_POINTS: Final = "gradcal.drivers"
"""The group of entry points by which other packages add drivers: each names a class of `DriverOptions`."""
_HERE: Final = f"{__package__}.drivers"
DRIVERS: Final[Mapping[str, str]] = {
    "registers": f"{_HERE}.registers:RegistersConfig",
    "lines": f"{_HERE}.lines:LinesConfig",
    OPERATOR: f"{_HERE}.operator:OperatorConfig",
    "frames": f"{_HERE}.listening:FramesConfig",
    "text_unit": f"{_HERE}.listening:TextUnitConfig",
}
"""The drivers that come with this program; `driver_of` knows those of other packages, too."""


def driver_names(role: Role) -> list[str]:
    """The drivers that a device of a role may have. Drivers of other packages are imported for it."""
    outside = sorted({entry.name for entry in entry_points(group=ENTRY_POINTS)} - set(DRIVERS))
    return [name for name in (*DRIVERS, *outside) if _fits(driver_of(name), role)]


def driver_of(name: str) -> type[DriverOptions] | None:
    """A driver by its name in the rig file: this program's, which cannot be replaced, or another package's.

    Raises `ValueError` where two packages have a driver of this name, or where it cannot be loaded.
    """
    if name in DRIVERS:
        return EntryPoint(name, DRIVERS[name], ENTRY_POINTS).load()
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
    if not (isinstance(driver, type) and issubclass(driver, DriverOptions)):
        raise ValueError(f"the package {where} has {entries[0].value} as a driver, but this is no `DriverOptions`")
    return driver


def _fits(driver: type[DriverOptions] | None, role: Role) -> bool:
    return driver is not None and (driver.role == role or (driver.role is None and role != "imu"))


def config_of(device: Device | EncoderDevice, role: Role, place: Key) -> Any:
    """The options of a device of the rig file.

    Raises:
        SpecError: no such driver, a driver of another role, unknown options, wrong values; all at once, with keys.
    """
    try:
        driver = driver_of(device.driver)
        if driver is None or not _fits(driver, role):
            fitting = driver_names(role)
            raise ValueError(f"expected {one_of(fitting)}{hint(device.driver, fitting)}")
    except ValueError as problem:
        raise SpecError([Problem((*place, "driver"), str(problem), device.driver)]) from None
    place = (*place, "options")
    try:
        config: Any = driver.model_validate(device.options)
    except ValidationError as error:
        raise SpecError([problem.under(*place) for problem in from_validation(error)]) from None
    if driver.role is None and config.described.role != role:
        message = f"describes an {config.described.role}; expected a {role}"
        raise SpecError([Problem((*place, "protocol"), message)])
    return config


def configs_of(rig: RigFile) -> dict[Key, Any]:
    """The options of all devices, by their place in the file. Raises `SpecError` with every problem."""
    configs: dict[Key, Any] = {}
    problems: list[Problem] = []
    for role, place, _, device in _entries(rig):
        try:
            configs[place] = config_of(device, role, place)
            if not isinstance(device, ImuDevice) and (lack := configs[place].lacks_for(device.safe)):
                message = f"this device does not support this safe state: {lack}"
                problems.append(Problem((*place, "safe"), message, device.safe))
            if isinstance(device, AxisDevice) and device.encoder is not None:
                configs[*place, "encoder"] = config_of(device.encoder, role, (*place, "encoder"))
        except SpecError as error:
            problems += error.problems
    if problems:
        raise SpecError(problems)
    return configs


def _entries(rig: RigFile) -> list[tuple[Role, Key, str, Device]]:
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
    _ports: ExitStack = field(default_factory=ExitStack)

    @property
    def settings(self) -> dict[str, roles.KeptSettings]:
        return {name: device.settings for name, device in self.axes.items()}

    def devices(self) -> list[tuple[str, Device, Opened]]:
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
    recorder_of: Callable[[str], Recorder | None] = lambda url: None,
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
    bench, lines = Bench(rig), dict[str, Transport]()

    def opened(url: str, **settings: Any) -> TextLine:
        if url == TERMINAL:
            line = terminal or Terminal()
            line.clock, line.recorder = clock, recorder_of(url)
        else:
            line = lines[same_port(url)] = Transport(url, clock=clock, recorder=recorder_of(url), **settings)
        bench._ports.callback(line.close)  # pyright: ignore[reportPrivateUsage]
        return line

    links: dict[str, Any] = {}

    def build(entry: Device | EncoderDevice, name: str, config: DriverOptions, encoder: Any = None) -> Any:
        port = same_port(entry.port)
        if port not in links:
            links[port] = config.link(opened(entry.port, **config.line_settings), clock)
        return config.device(links[port], clock, name, encoder)

    try:
        for role, place, name, entry in _entries(rig):
            encoder = None
            if isinstance(entry, AxisDevice) and entry.encoder is not None:
                encoder = build(entry.encoder, name, configs[*place, "encoder"])
            device = build(entry, name, configs[place], encoder)
            if role == "chamber":
                bench.chamber = device
            else:
                (bench.axes if role == "axis" else bench.imus)[name] = device
            if same_port(entry.port) in lines:
                bench.lines[name] = lines[same_port(entry.port)]
        consoles = [link for link in links.values() if isinstance(link, Console)]
        if consoles:
            bench.console = consoles[0]
        elif rig.operator is not None or terminal is not None:
            bench.console = Console(opened((rig.operator or OperatorPlace()).port), clock)
    except BaseException:
        bench.close()
        raise
    return bench


@dataclass(frozen=True)
class DeviceReport:
    """A device's identity and limits, and what is wrong with it."""

    name: str
    driver: str
    port: str
    identity: roles.Identity | None = None
    limits: roles.ChamberLimits | roles.AxisLimits | roles.ImuSettings | None = None
    problem: str = ""


def only_of(rig: RigFile, names: Collection[str]) -> RigFile:
    """The rig with these devices alone, and nobody to ask; the chamber's name is "chamber"."""
    chosen = {role: tuple(of for of in getattr(rig, role) if of.name in names) for role in ("axis", "imu")}
    chamber = rig.chamber if "chamber" in names else None
    return rig.model_copy(update={"chamber": chamber, "operator": None, **chosen})


def lines_of(rig: RigFile) -> dict[str, tuple[str, str]]:
    """The port and the safe state of each device."""
    return {name: (device.port, getattr(device, "safe", LEFT)) for _, _, name, device in _entries(rig)}


def check_each(rig: RigFile, clock: Clock) -> list[DeviceReport]:
    """Open one device after the other, and ask it for identity, limits and a reading; compare its serial number with
    the rig file. Nothing moves; a refused port becomes a report. Raises `SpecError`."""
    configs_of(rig)
    reports: list[DeviceReport] = []
    # The chamber first, as in the rig file.
    for _, _, name, entry in sorted(_entries(rig), key=lambda entry: entry[0] != "chamber"):
        try:
            with open_rig(only_of(rig, {name}), clock) as bench:
                reports += [report_of(bench, *device) for device in bench.devices()]
        except HardwareError as problem:
            reports.append(DeviceReport(name, entry.driver, entry.port, problem=str(problem)))
    return reports


def report_of(bench: Bench, name: str, entry: Device, device: Opened) -> DeviceReport:
    """What a device says of itself."""
    identity, limits, faults = None, None, ()
    try:
        identity = device.identify()
        if entry.serial_number is not None and entry.serial_number != identity.serial_number:
            raise WrongIdentity(
                f"{name} at {entry.port} has the serial number {identity.serial_number or '(none reported)'}, but the "
                f"rig file states {entry.serial_number}. Connect the right device or correct the rig file."
            )
        if isinstance(device, roles.ImuStream):
            limits = device.configure()
        else:
            limits = device.limits()
            if isinstance(limits, roles.ChamberLimits):
                rules = limits_of(bench.rig)
                lowest, highest = max(limits.lowest_c, rules.never_below_c), min(limits.highest_c, rules.never_above_c)
                limits = dataclasses.replace(limits, lowest_c=lowest, highest_c=highest)
            # Identity and limits may stand in the rig file alone: at least this is asked of the device.
            reading = device.read()
            if isinstance(reading, roles.ChamberReading):
                faults = reading.alarms
            else:
                # Many controllers report a missing reference as a fault: a run homes the axis first.
                faults = reading.faults if reading.referenced else ()
        problem = f"ALARM {', '.join(faults)}" if faults else ""
    except HardwareError as error:
        problem = str(error)
    return DeviceReport(name, entry.driver, entry.port, identity, limits, problem)


def require_the_same(bench: Bench, known: Mapping[str, Mapping[str, Any]]) -> None:
    """Raises `WrongIdentity` where a device is not that with which a run began, by its `known` identity: nothing is
    commanded then, for the other device may be at work for somebody else."""
    for name, entry, device in bench.devices():
        before = known.get(name, {})
        of = {key: (value, before.get(key, value)) for key, value in vars(device.identify()).items()}
        if changed := [f"{key} {now!r}, was {then!r}" for key, (now, then) in of.items() if now != then]:
            raise WrongIdentity(
                f"{name} at {entry.port} is another device than at the beginning of the run ({'; '.join(changed)}). "
                "Connect the device that the run began with, or begin a new run."
            )
