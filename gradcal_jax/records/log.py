"""gradcal-log/1: what was recorded, as labelled NumPy arrays with units; `log_file` keeps them in netCDF files.

A column's dimensions, unit and meaning are those that stand beside it: `unit`, the sensors on one table, by serial
number or name; `time`, one clock for all of them, strictly increasing; `reading`, events at which the table's angle was
read.

The table's angle is known at its readings alone. `table_angle` is a column of another logger, which read the encoder at
every row.

A log never loses a row silently: `rows_read` counts the rows of the source, `rows_removed` those that could not be kept
(by reason), and `status` is 0 for every usable row of a unit and the reason otherwise.
"""

import contextlib
import hashlib
import importlib
import io
import warnings
from collections.abc import Generator, Mapping
from dataclasses import dataclass, field, fields, replace
from enum import IntEnum, IntFlag
from pathlib import Path
from typing import Annotated, Any, Final, NamedTuple, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from gradcal_jax.tables.display import summary
from gradcal_jax.tables.problems import instead

FORMAT: Final = "gradcal-log/1"
SERIAL_NUMBER: Final = "serial_number"
"""Key, in the provenance of a log and of its calibration, of the serial number that the device itself stated."""
SENSOR_RATE: Final = "sensor_rate"
"""Key, in the provenance of a log, of the sensor's own sample rate ("400 Hz") if rows are single samples; "means": rows
are means of samples; "unknown": the rows of a raw channel are far apart, and may be either."""
Floats = NDArray[np.float64]
Whole = NDArray[np.int64]
Flags = NDArray[np.uint16]
Bools = NDArray[np.bool_]


class LogError(ValueError):
    """A record that cannot be used; the message says why and what to do."""


@contextlib.contextmanager
def naming(path: str | Path) -> Generator[None]:
    """Context in which a file is read: adds its name to errors. Raises `LogError` where there is no file."""
    try:
        if Path(path).is_dir():
            raise LogError("is a directory")
        if not Path(path).exists():
            raise LogError("does not exist")
        yield
    except LogError as error:
        raise LogError(f"{path}: {error}") from None
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror or error}") from None


@contextlib.contextmanager
def quietly(kind: str) -> Generator[None]:
    """Context for a library on bytes that may be damaged: drops its prints, and turns exceptions into one sentence."""
    try:
        with (
            contextlib.redirect_stdout(io.StringIO()),
            contextlib.redirect_stderr(io.StringIO()),
            warnings.catch_warnings(action="ignore"),
        ):
            yield
    except LogError:
        raise
    except Exception as error:  # whatever a reader makes of bytes that are something else
        name = type(error).__name__
        raise LogError(f"cannot be read as {kind} ({name}): is it damaged, or a file of another kind?") from None


def library(name: str, package: str) -> Any:
    """A reader's library. Raises `LogError` with a sentence on how to install it."""
    try:
        return importlib.import_module(name)
    except ImportError:
        raise LogError(
            f'reading it needs the package {package}, of the extra "logs": pip install "gradcal_jax[logs]"'
        ) from None


class Reason(IntFlag):
    """Why a row of a unit is masked; a row may have several, and is counted under the first."""

    MISSING_RATE = 1
    SATURATED = 2
    MARKED = 4
    MISSING_TEMPERATURE = 8
    FROZEN_TEMPERATURE = 16
    LEFT_OUT = 32
    MISSING_FORCE = 64
    FROZEN_VALUES = 128
    FAR_FROM_NEIGHBOURS = 256

    @property
    def words(self) -> str:
        """In words: ``frozen temperature``."""
        return (self.name or "").lower().replace("_", " ")


class ReadingKind(IntEnum):
    """What a reading of the table's angle stands for."""

    PLANNED = 0
    """The axis was at rest, and the recipe takes a reading here."""
    STANDING = 1
    """The axis was at rest; the recipe does not contain this reading."""
    MOVING = 2
    """The axis moved."""


class LogVariable(NamedTuple):
    """A column of a log in a file: its name, dimensions, unit, meaning and type."""

    name: str
    shape: str
    unit: str
    words: str
    kind: type[np.generic] = np.float64

    @property
    def dimensions(self) -> tuple[str, ...]:
        return tuple(self.shape.split())


def variables_of(holder: type[Any]) -> dict[str, LogVariable]:
    """The columns of a `Log` or of `AngleReadings` by their fields."""
    hints = get_type_hints(holder, include_extras=True)
    return {name: hint.__metadata__[0] for name, hint in hints.items() if get_origin(hint) is Annotated}


_BITS: Final = ", ".join(f"{reason.value} {reason.words}" for reason in Reason)
_KINDS: Final = ", ".join(f"{kind.value} {kind.name.lower()}" for kind in ReadingKind)


@dataclass(frozen=True)
class AngleReadings:
    """Readings of the table's angle, in order of time. All arrays `[reading]`.

    `row`: at the end of this row of the log the axis stands at the angle that was read (of a moving axis the row of the
    time). `standard_deviation_rad`: NaN where it is that of the spec.
    """

    time_s: Annotated[
        Floats,
        LogVariable("reading_time", "reading", "s", "time of the reading of the table's angle, on the log's clock"),
    ]
    row: Annotated[
        Whole, LogVariable("reading_row", "reading", "1", "row at the end of which this angle is valid", np.int64)
    ]
    axis: Annotated[Whole, LogVariable("reading_axis", "reading", "1", "number of the table axis, from 0", np.int64)]
    angle_rad: Annotated[Floats, LogVariable("reading_angle", "reading", "rad", "angle read, not wrapped")]
    standard_deviation_rad: Annotated[
        Floats, LogVariable("reading_std", "reading", "rad", "standard deviation; NaN: the value in the spec")
    ]
    kind: Annotated[Whole, LogVariable("reading_kind", "reading", "1", f"kind of the reading: {_KINDS}", np.int64)]

    __repr__ = summary

    def of_axis(self, axis: int, *kinds: ReadingKind) -> "AngleReadings":
        """The readings of one table axis (its index), of the `kinds` (default: all)."""
        return self.chosen((self.axis == axis) & (np.isin(self.kind, kinds) if kinds else True))

    def chosen(self, rows: Bools) -> "AngleReadings":
        """Some of the readings."""
        return AngleReadings(**{one.name: getattr(self, one.name)[rows] for one in fields(self)})


class Finding(NamedTuple):
    """One kind of fault in a record."""

    kind: str
    """``gap``, ``duplicate stamp``, ``unordered stamp``, ``unreadable row``, ``missing rate``, ``saturated``, …"""
    message: str
    """The fault in a sentence."""


@dataclass(frozen=True)
class EvenSeries:
    """One axis of one unit on an even grid, the input of `gradcal_jax.identify`."""

    rate_rad_per_s: Floats
    valid: Bools
    sample_interval_s: float
    temperature_c: Floats | None
    row: Whole
    """The row of the log behind each point; -1: a gap."""


@dataclass(frozen=True)
class Log:
    """A recording. Arrays are SI (°C for temperatures) and never changed in place; shapes stand beside the fields.

    `read_log` and `import_log` read one, `log` makes one of a run. Errors: `LogError` where the shapes do not fit, or
    times do not increase.
    """

    time_s: Annotated[Floats, LogVariable("time", "time", "s", "time stamp of the sensor's clock")]
    rate_rad_per_s: Annotated[
        Floats, LogVariable("rate", "unit time axis", "rad s-1", "mean angular rate since the previous row")
    ]
    """No axis if the IMU has only accelerometers."""
    units: tuple[str, ...]
    axes: tuple[str, ...]
    temperature_c: Annotated[
        Floats | None, LogVariable("temperature", "unit time", "degC", "temperature of the sensor")
    ] = None
    table_axes: tuple[str, ...] = ()
    table_angle_rad: Annotated[
        Floats | None, LogVariable("table_angle", "time table_axis", "rad", "angle of the table, not wrapped")
    ] = None
    """The encoder's angle in every row, if a logger recorded it so."""
    table_rate_rad_per_s: Annotated[
        Floats | None, LogVariable("table_rate", "time table_axis", "rad s-1", "rate of the table")
    ] = None
    standstill: Annotated[
        Whole | None, LogVariable("standstill", "time", "1", "number of the standstill; -1: the table moves", np.int64)
    ] = None
    mounting: Annotated[
        Whole | None, LogVariable("mounting", "time", "1", "number of the mounting, from 0", np.int64)
    ] = None
    """The number of the IMU's mounting in its spec. `None`: always the first."""
    host_time_s: Annotated[Floats | None, LogVariable("host_time", "time", "s", "time stamp of the computer")] = None
    """If the sensor has a clock of its own."""
    status: Annotated[
        Flags | None, LogVariable("status", "unit time", "1", f"0: usable; otherwise bits: {_BITS}", np.uint16)
    ] = None
    """`Reason`s. `None`: all usable."""
    stretch_starts: Annotated[
        Whole, LogVariable("stretch_start", "stretch", "1", "row at which a stretch begins", np.int64)
    ] = field(default_factory=lambda: np.zeros(1, np.int64))
    """The first is 0."""
    rows_read: int = -1
    """Rows of the source; -1: exactly these rows."""
    rows_removed: Mapping[str, int] = field(default_factory=dict[str, int])
    findings: tuple[Finding, ...] = ()
    simulated: bool = False
    provenance: Mapping[str, str] = field(default_factory=dict[str, str])
    specific_force_m_per_s2: Annotated[
        Floats | None, LogVariable("specific_force", "unit time force_axis", "m s-2", "specific force")
    ] = None
    """+1 g along an axis that points up at rest."""
    force_axes: tuple[str, ...] = ()
    readings: AngleReadings | None = None
    """Readings of the table's angle. `None`: their times are not recorded; `table_angle_rad` is valid in every row."""

    __repr__ = summary

    def summary_lines(self) -> list[str]:
        """Its contents in lines: length, units, channels, arrays, the numbers of rows by use, faults."""
        fields = ("temperature_c", "host_time_s", "table_angle_rad", "readings")
        has = [name for name in fields if getattr(self, name) is not None]
        counts = ", ".join(f"{count} {reason}" for reason, count in self.counts().items())
        return [
            f"log of {', '.join(self.units[:3])}: {self.duration_s:.6g} s at {1.0 / self.sample_interval_s:.6g} Hz"
            + ", SIMULATED" * self.simulated,
            f"  with {', '.join([*self.channels(), *has])}, in {len(self.stretch_starts)} stretches",
            f"  of {self.rows_read} rows: {counts}",
            *(f"  {finding.message}" for finding in self.findings),
        ]

    _shown = summary_lines

    def __post_init__(self) -> None:
        rows = len(self.time_s)
        labels = {"unit": self.units, "axis": self.axes, "force_axis": self.force_axes, "table_axis": self.table_axes}
        for name, of in labels.items():
            if len(set(of)) != len(of):
                raise LogError(f"two of the log's {name.replace('_', ' ')} labels are the same: {', '.join(of)}")
        if rows < 2 or not self.units or not self.axes + self.force_axes:
            raise LogError(f"a log needs at least two rows, a unit and an axis; this one has {rows} rows")
        if not (np.isfinite(self.time_s).all() and np.all(self.time_s[1:] > self.time_s[:-1])):
            raise LogError("the times of a log must increase from row to row")
        sizes = {"time": rows, "stretch": len(self.stretch_starts)} | {name: len(of) for name, of in labels.items()}
        _check_shapes(self, sizes)
        if (known := self.readings) is not None:
            _check_shapes(known, {"reading": len(known.time_s)})
            for name, values, end in (("row", known.row, rows), ("axis", known.axis, len(self.table_axes))):
                if np.any((values < 0) | (values >= end)):
                    raise LogError(f"a reading of the table's angle has a {name} that the log does not have")
            if not np.isfinite([known.time_s, known.angle_rad]).all():
                raise LogError("a reading of the table's angle has no time or no angle")
        starts = self.stretch_starts
        if len(starts) == 0 or starts[0] != 0 or np.any(np.diff(starts) <= 0) or starts[-1] >= rows:
            raise LogError("stretch_starts must increase, and the first stretch of a log must begin at row 0")
        removed = sum(self.rows_removed.values())
        if self.rows_read < 0:
            object.__setattr__(self, "rows_read", rows + removed)
        if self.rows_read != rows + removed:
            raise LogError(
                f"{self.rows_read} rows were read, but {rows} kept and {removed} removed rows do not add up to this "
                "number"
            )

    @property
    def duration_s(self) -> float:
        """From the first stamp to the last, s."""
        return float(self.time_s[-1] - self.time_s[0])

    @property
    def sample_interval_s(self) -> float:
        """Mean interval within the stretches, s; the median where no stretch has two rows."""
        return mean_interval(self.time_s, self.stretch_starts)

    def unit_index(self, unit: str | int) -> int:
        """The number of a unit given by name or number. Raises `LogError`."""
        if unit in self.units:
            return self.units.index(str(unit))
        if isinstance(unit, str) or unit >= len(self.units):
            raise LogError(f"there is no unit '{unit}' in this log; {instead(str(unit), self.units)}")
        return unit

    def channel(self, name: str, unit: str | int = 0) -> Floats:
        """`(n,)`: the rates or specific forces of a channel: "gyro x". Raises `LogError`."""
        channels = self.channels(unit)
        if name not in channels:
            raise LogError(f"there is no {name} in this log; {instead(name, channels)}")
        return channels[name]

    def channels(self, unit: str | int = 0) -> dict[str, Floats]:
        """The rates and specific forces `(n,)` of a unit by the names of their channels: "gyro x"."""
        number = self.unit_index(unit)
        named = {f"gyro {axis}": self.rate_rad_per_s[number, :, k] for k, axis in enumerate(self.axes)}
        if self.specific_force_m_per_s2 is not None:
            for k, axis in enumerate(self.force_axes):
                named[f"accelerometer {axis}"] = self.specific_force_m_per_s2[number, :, k]
        return named

    def triads(self, unit: str | int = 0) -> tuple[Floats, Floats]:
        """Rates and specific forces `(n, 3)` along x, y, z; NaN for axes that the log does not have."""
        channels = self.channels(unit)
        none = np.full(len(self.time_s), np.nan)
        rates, forces = (
            np.stack([channels.get(f"{kind} {axis}", none) for axis in "xyz"], axis=1)
            for kind in ("gyro", "accelerometer")
        )
        return rates, forces

    def usable(self, unit: str | int = 0) -> Bools:
        """Which rows of a unit are not masked. [time]"""
        if self.status is None:
            return np.ones(len(self.time_s), bool)
        return self.status[self.unit_index(unit)] == 0

    def fingerprint(self, unit: str | int = 0) -> str:
        """SHA-256 of a unit's times and rates: the same for the same recording, under whatever name."""
        digest = hashlib.sha256(np.ascontiguousarray(self.time_s).tobytes())
        for values in (self.rate_rad_per_s, self.specific_force_m_per_s2):
            if values is not None:
                digest.update(np.ascontiguousarray(values[self.unit_index(unit)]).tobytes())
        return digest.hexdigest()

    def bridged_temperature(self, unit: str | int = 0) -> Floats | None:
        """A unit's temperature at every row, missing ones interpolated linearly; None without any. [time]"""
        values: Floats | None = None if self.temperature_c is None else self.temperature_c[self.unit_index(unit)]
        if values is None or not (known := np.isfinite(values)).any():
            return None
        if known.all():
            return values
        return np.asarray(np.interp(self.time_s, self.time_s[known], values[known]), np.float64)

    def counts(self, unit: str | int = 0) -> dict[str, int]:
        """Counts of rows: ``used``, then removed and masked rows by reason. They add up to `rows_read`."""
        result = {"used": int(np.count_nonzero(self.usable(unit))), **self.rows_removed}
        if self.status is not None:
            status = self.status[self.unit_index(unit)]
            first = status & (~status + np.uint16(1))  # the lowest bit alone
            for reason in Reason:
                if count := int(np.count_nonzero(first == reason.value)):
                    result[reason.words] = result.get(reason.words, 0) + count
        return result

    def even(self, channel: str, unit: str | int = 0) -> EvenSeries:
        """A channel ("gyro x") on an even grid, with one invalid point for each gap of any length: no window may span
        one. The interval is the mean one; jitter of the stamps about it has no effect on sums of rates.
        """
        row = np.insert(np.arange(len(self.time_s)), self.stretch_starts[1:], -1)
        there = row >= 0
        valid = there & self.usable(unit)[row]
        values, temperature = self.channel(channel, unit), None
        if self.temperature_c is not None:
            temperature = np.where(there, self.temperature_c[self.unit_index(unit), row], np.nan)
        return EvenSeries(np.where(valid, values[row], 0.0), valid, self.sample_interval_s, temperature, row)


def without_masked(log: Log) -> Log:
    """The log with NaN for every value of a masked row that its reason concerns: no computation can use one.

    Rates are NaN for every reason but a missing force, forces for every reason but a missing rate, and temperatures
    where they, or the whole row, are masked. A saturated value stays: it tells that a limit cuts off the noise.
    """
    if log.status is None or not log.status.any():
        return log
    concerned = {
        "rate_rad_per_s": ~(Reason.MISSING_FORCE | Reason.SATURATED),
        "specific_force_m_per_s2": ~(Reason.MISSING_RATE | Reason.SATURATED),
        "temperature_c": Reason.MARKED | Reason.LEFT_OUT | Reason.MISSING_TEMPERATURE | Reason.FROZEN_TEMPERATURE,
    }
    changed = dict[str, Floats]()
    for name, reasons in concerned.items():
        values: Floats | None = getattr(log, name)
        rows = (log.status & np.uint16(reasons.value)) != 0
        if values is not None and rows.any():
            changed[name] = values.copy()
            changed[name][rows] = np.nan
    return replace(log, **changed)


def _check_shapes(holder: Any, sizes: Mapping[str, int]) -> None:
    for name, variable in variables_of(holder.__class__).items():
        array: NDArray[Any] | None = getattr(holder, name)
        wanted = tuple(sizes[dimension] for dimension in variable.dimensions)
        if array is not None and array.shape != wanted:
            words = f"expected [{', '.join(variable.dimensions)}] = {wanted}"
            raise LogError(f"the {variable.name.replace('_', ' ')} has the shape {array.shape}; {words}")


def mean_interval(time_s: Floats, stretch_starts: Whole) -> float:
    """The mean interval of stamps within the stretches, s; the median of all where no stretch has two rows."""
    interval = np.diff(time_s)
    within = np.delete(interval, stretch_starts[1:] - 1)
    return float(within.mean()) if len(within) else float(np.median(interval))
