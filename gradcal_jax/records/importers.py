"""Recordings of other programs -> `Log`: text tables, NumPy's `.npz` and `.npy`, MATLAB v5 files, Parquet.

A small TOML file, the column map, has the meaning of the columns, with units: `templates/columns.toml` is one to start
from. A number is (number - zero) × scale in the column's unit; columns of text and `.npy` are named by number, too, and
those of a two-dimensional array by `index`. Times count from the first row. Of several sensors on one table there are
`[[sensor]]` tables with `name`, `rate`, `force`, `temperature` and `status`, in place of those at the top. Raw counts
of unknown scale are kept unchanged with `values = "keep"` under [policy].
"""

import logging
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Final, Literal

import numpy as np
from pydantic import Field

from gradcal_jax.records.column_names import question_of
from gradcal_jax.records.log import SENSOR_RATE, Floats, Log, LogError, naming
from gradcal_jax.records.log_faults import Columns, Policy, at_rows_with_rates, examine
from gradcal_jax.records.table_readers import read_table
from gradcal_jax.records.tables import (
    AngleColumn,
    ForceColumn,
    Measured,
    Name,
    Numbers,
    RateColumn,
    Source,
    TemperatureColumn,
    TextTable,
    TimeColumn,
    Where,
)
from gradcal_jax.tables.document import parsed, read_text
from gradcal_jax.tables.problems import Problem
from gradcal_jax.tables.quantity import Flag, Frequency, Number, PositiveRate, Whole
from gradcal_jax.tables.section import Section

_LOG = logging.getLogger(__name__)

FORMAT: Final = "gradcal-columns/1"
_MEND: Final = '(correct the map, or set [policy] values = "keep")'
_MANY: Final = 200
"""If more rows than this have only whole numbers as rates, this is not by chance."""


class StatusColumn(Source):
    """Column of the device's status; rows whose status is not `good` are marked as bad."""

    good: Number = 0.0
    """Value that usable rows have in this column."""


class ClockColumn(Source):
    """Column of a counter of the samples, as a clock."""

    rate: Frequency
    """Number of samples a second."""


class SensorColumns(Section):
    """Columns of one sensor, if a recording has several."""

    name: Name
    """Name or serial number of the sensor."""
    rate: Annotated[dict[Name, RateColumn], Field(min_length=1, max_length=20)]
    """Columns of the gyros' rates, by axis."""
    force: Annotated[dict[Name, ForceColumn], Field(max_length=20, default_factory=dict[str, ForceColumn])]
    """Columns of the accelerometers' specific forces, by axis."""
    temperature: TemperatureColumn | None = None
    """Column of the temperature."""
    second_temperature: TemperatureColumn | None = None
    """Column of a second thermometer's temperature, for example on the case."""
    status: StatusColumn | None = None
    """Column of the device's status."""


class ColumnMap(SensorColumns):
    """What the columns of a recording mean."""

    format: Literal["gradcal-columns/1"]
    """Name and version of this file format."""
    name: Name = "sensor"
    rate: Annotated[dict[Name, RateColumn], Field(max_length=20, default_factory=dict[str, RateColumn])]
    sample_rate: Frequency | None = None
    """Stated sample rate; required if there is no `time`."""
    sensor_rate: Frequency | None = None
    """Rate of the sensor's own samples, if each row of the recording is a single sample (such as every 400th one);
    leave this key out if each row is the mean of several samples."""
    full_scale: PositiveRate | None = None
    """Rate at which the gyros saturate."""
    skip_first: Whole = 0
    """Number of rows to leave out at the beginning."""
    simulated: Flag = False
    """Whether the data are simulated."""
    time: TimeColumn | None = None
    """Column of the sensor's time."""
    clock: ClockColumn | None = None
    """Instead of `time`: a counter of the samples, such as `{ column = "index", rate = "100 Hz" }`."""
    host_time: TimeColumn | None = None
    """Column of the computer's time."""
    standstill: Source | None = None
    """Column that is true at rest and false in motion, or that has the index of the standstill (negative in
    motion)."""
    table_angle: Annotated[dict[Name, AngleColumn], Field(max_length=20, default_factory=dict[str, AngleColumn])]
    """Columns of the table's angles, by axis."""
    table_rate: Annotated[dict[Name, RateColumn], Field(max_length=20, default_factory=dict[str, RateColumn])]
    """Columns of the table's rates, by axis."""
    sensor: Annotated[tuple[SensorColumns, ...], Field(max_length=1000)] = ()
    """Columns of several sensors, instead of `rate`, `force`, `temperature` and `status` at the top."""
    interpolate: Flag = False
    """Set this key if different channels are in different rows: the rows with rates are used, and the other channels
    are interpolated."""
    where: Where | None = None
    """If the rows of several sensors are mixed: selects the rows of one sensor, such as `{ column = "id", equals = 1
    }`."""
    csv: TextTable = TextTable()
    """Layout of a text file."""
    policy: Policy = Policy()
    """What to do with each kind of fault in the recording."""

    def _problems(self) -> Iterator[Problem]:
        if self.sensor and (self.rate or self.force or self.temperature or self.status):
            text = "belong in each [[sensor]], or at the top if there is only one sensor"
            yield Problem(("sensor",), f"rate, force, temperature and status {text}")
        if not self.sensor and not self.rate:
            yield Problem(("rate",), "this key is missing; name at least one axis", kind="missing")
        axes = {(tuple(sensor.rate), tuple(sensor.force)) for sensor in self.sensor}
        if len(axes) > 1:
            yield Problem(("sensor",), "every sensor needs the same axes, in the same order")
        if len({sensor.name for sensor in self.sensor}) < len(self.sensor):
            yield Problem(("sensor",), "two sensors have the same name")
        if self.time is not None and self.clock is not None:
            yield Problem(("clock",), "cannot be combined with `time`: keep one of them")
        if self.time is None and self.clock is None and self.sample_rate is None:
            message = 'give the column of the time, or the sample rate as in sample_rate = "100 Hz"'
            yield Problem(("time",), message, kind="missing")
        own = self.sources() if self.rate or self.sensor else ()
        if not self.interpolate and any(isinstance(one, Measured) and one.where is not None for one in own):
            text = "expected true, because columns that are selected by `where` are in different rows"
            yield Problem(("interpolate",), text, self.interpolate)
        if self.table_angle and self.table_rate and list(self.table_angle) != list(self.table_rate):
            yield Problem(("table_rate",), "must name the same axes as table_angle")

    @property
    def sensors(self) -> tuple[SensorColumns, ...]:
        """The sensors; the map itself where `[[sensor]]` is absent."""
        return self.sensor or (self,)

    def sources(self) -> Iterator[Source]:
        """Every column that the map names."""
        yield from filter(None, (self.time, self.clock, self.host_time, self.standstill))
        for sensor in self.sensors:
            yield from sensor.rate.values()
            yield from sensor.force.values()
            yield from filter(None, (sensor.temperature, sensor.second_temperature, sensor.status))
        yield from self.table_angle.values()
        yield from self.table_rate.values()


def parse_column_map(text: str, source: str = "") -> ColumnMap:
    """The column map (gradcal-columns/1) in a TOML text: what columns of a recording mean, and in which units.

    Errors: `SpecError` with every fault.
    """
    return parsed(ColumnMap, text, FORMAT, source)


def read_column_map(path: str | Path) -> ColumnMap:
    """The column map in a file. Raises `SpecError` with every fault."""
    return parse_column_map(read_text(path), str(path))


def import_log(path: str | Path, columns: ColumnMap | str | Path, *, rows: tuple[int, int | None] | None = None) -> Log:
    """The log in a recording of another program, examined by the map's policy; of some rows only, if asked.

    `columns`: the column map (gradcal-columns/1, quantities with units), the name of its file, or its TOML text.

    The ending tells the kind: .csv, .txt, .tsv, .dat, .log, .asc (text; also .csv.gz), .npz, .npy, .mat (MATLAB up to
    version 7), .parquet.

    **Raises:** `LogError` with a sentence, for a file that is not what its ending says, for columns that are not there,
    and for faults that the policy refuses.
    """
    path = Path(path)
    if isinstance(columns, str | Path):
        text = isinstance(columns, str) and "\n" in columns
        columns = parse_column_map(str(columns)) if text else read_column_map(columns)
    table = read_table(path, columns.csv, list(columns.sources()), where=columns.where)
    with naming(path):
        _refuse_contradictions(table, columns)
        log = _columns(table, columns, path.name)
        if columns.interpolate:
            log = at_rows_with_rates(log)
        per_row = np.array([[rate.per == "row" for rate in sensor.rate.values()] for sensor in columns.sensors], bool)
        rows_hz = _rows_hz(log)
        log.rate_rad_per_s = log.rate_rad_per_s * np.where(per_row, rows_hz, 1.0)[:, None, :]
        examined = examine(log if rows is None else log.part(rows), columns.policy)
        if per_row.any():
            # The clock is known now: a row lasts as long as a sample.
            factor = np.where(per_row, 1.0 / (examined.sample_interval_s * rows_hz), 1.0)[:, None, :]
            examined = replace(examined, rate_rad_per_s=examined.rate_rad_per_s * factor)
        _refuse_counts(table, columns)
        _LOG.info("read %s: %d rows, %.6g s", path, len(examined.time_s), examined.duration_s)
        for fault in examined.findings:
            _LOG.warning("%s: %s", path, fault.message)
        return examined


def _rows_hz(log: Columns) -> float:
    """Rows a second, before it is known whether some are missing."""
    if log.time_s is None:
        return log.sample_rate_hz or 1.0
    time = log.time_s[np.isfinite(log.time_s)]
    return 1.0 / max(float(np.median(np.diff(time))), 1e-9) if len(time) > 1 else 1.0


def _refuse_contradictions(table: Numbers, columns: ColumnMap) -> None:
    """Unless units are to be kept whatever they are."""
    measured = [source for source in columns.sources() if isinstance(source, Measured)]
    for source in measured if columns.policy.values == "refuse" else ():
        for name in table.names(source):
            if question := question_of(name, source):
                raise LogError(f"{question} {_MEND}")


def _refuse_counts(table: Numbers, columns: ColumnMap) -> None:
    """Where rates in degrees or radians a second are whole numbers alone."""
    for source in columns.sources() if columns.policy.values == "refuse" else ():
        if isinstance(source, RateColumn) and source.unit in ("deg/s", "rad/s") and source.scale == 1.0:
            values = table.numbers(source)
            known = values[np.isfinite(values)]
            if len(known) > _MANY and np.ptp(known) > 1.0 and np.all(known == np.rint(known)):
                words = f"{source.words()} has only whole numbers: are they counts? If so, state the scale of one count"
                raise LogError(f"{words} {_MEND}")


def _columns(table: Numbers, columns: ColumnMap, name: str) -> Columns:
    sensors = columns.sensors

    def side_by_side(columns: Mapping[str, Measured]) -> Floats:
        return np.stack([table.measured(column) for column in columns.values()], axis=-1)

    rate = np.stack([side_by_side(sensor.rate) for sensor in sensors])
    force = np.stack([side_by_side(sensor.force) for sensor in sensors]) if sensors[0].force else None
    rows = rate.shape[1]
    if rows < 2:
        raise LogError(f"there are {rows} rows of numbers; at least two are needed")
    warm = {key: np.full((len(sensors), rows), np.nan) for key in ("temperature", "second_temperature")}
    marked = np.zeros((len(sensors), rows), bool)
    for unit, sensor in enumerate(sensors):
        for key, values in warm.items():
            if (column := getattr(sensor, key)) is not None:
                values[unit] = table.measured(column)
        if sensor.status is not None:
            marked[unit] = table.numbers(sensor.status) != sensor.status.good
    left_out = np.zeros(rows, bool)
    left_out[: columns.skip_first] = True
    standstill = None if columns.standstill is None else table.numbers(columns.standstill).astype(np.float64)
    time = None if columns.time is None else table.stamps(columns.time)
    if columns.clock is not None:
        count = table.numbers(columns.clock).astype(np.float64)
        time = (count - count[np.isfinite(count)][:1]) / float(columns.clock.rate)
    return Columns(
        rate_rad_per_s=rate,
        units=tuple(sensor.name for sensor in sensors),
        axes=tuple(sensors[0].rate),
        time_s=time,
        sample_rate_hz=None if columns.sample_rate is None else float(columns.sample_rate),
        full_scale_rad_per_s=None if columns.full_scale is None else float(columns.full_scale),
        specific_force_m_per_s2=force,
        force_axes=tuple(sensors[0].force),
        temperature_c=warm["temperature"] if any(s.temperature for s in sensors) else None,
        second_temperature_c=warm["second_temperature"] if any(s.second_temperature for s in sensors) else None,
        table_axes=tuple(columns.table_angle or columns.table_rate),
        table_angle_rad=side_by_side(columns.table_angle) if columns.table_angle else None,
        table_rate_rad_per_s=side_by_side(columns.table_rate) if columns.table_rate else None,
        standstill=standstill,
        host_time_s=None if columns.host_time is None else table.stamps(columns.host_time),
        marked=marked if any(sensor.status for sensor in sensors) else None,
        left_out=left_out if columns.skip_first else None,
        simulated=columns.simulated,
        provenance={"source": name}
        | ({} if columns.sensor_rate is None else {SENSOR_RATE: f"{float(columns.sensor_rate):.9g} Hz"}),
    )
