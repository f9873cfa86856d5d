"""Recordings of other programs -> `Log`: file -> arrays (`table_files`) -> columns in SI by the map (`column_map`),
whose units are held against the names in the file (`column_names`) -> examination."""

import logging
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from gradcal_jax import units
from gradcal_jax.records.column_map import (
    ClockColumn,
    ColumnMap,
    Measured,
    RateColumn,
    Source,
    StatusColumn,
    TimeColumn,
    parse_column_map,
    read_column_map,
)
from gradcal_jax.records.column_names import question_of
from gradcal_jax.records.examination import Columns, at_rows_with_rates, examine
from gradcal_jax.records.log import SENSOR_RATE, Bools, Floats, Log, LogError, naming
from gradcal_jax.records.table_files import FileArrays, read_table, rows_where

_LOG = logging.getLogger(__name__)
_MEND: Final = '(correct the map, or set [policy] values = "keep")'
_MANY: Final = 200
"""If more rows than this have only whole numbers as rates, this is not by chance."""


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
        if columns.policy.values == "refuse":
            _refuse_contradictions(table, columns)
        log = columns_in_si(table, columns, path.name)
        if columns.interpolate:
            log = at_rows_with_rates(log)
        rows_hz = _rows_hz(log)
        per_row = [rate.per == "row" for rate in columns.sensors[0].rate.values()]
        for axis, increments in zip(columns.sensors[0].rate, per_row, strict=True):
            log.values[f"gyro {axis}"] = log.values[f"gyro {axis}"] * (rows_hz if increments else 1.0)
        examined = examine(log if rows is None else log.part(rows), columns.policy)
        if any(per_row):
            # The clock is known now: a row lasts as long as a sample.
            factor = np.where(per_row, 1.0 / (examined.sample_interval_s * rows_hz), 1.0)
            examined = replace(examined, rate_rad_per_s=examined.rate_rad_per_s * factor)
        _LOG.info("read %s: %d rows, %.6g s", path, len(examined.time_s), examined.duration_s)
        for fault in examined.findings:
            _LOG.warning("%s: %s", path, fault.message)
        return examined


def _rows_hz(log: Columns) -> float:
    """Rows a second, before it is known whether some are missing."""
    time = log.values.get("time", np.zeros(0))
    time = time[np.isfinite(time)]
    return 1.0 / max(float(np.median(np.diff(time))), 1e-9) if len(time) > 1 else log.sample_rate_hz or 1.0


def _refuse_contradictions(table: FileArrays, columns: ColumnMap) -> None:
    """Names that state another quantity or unit than the map, and rates in whole numbers alone."""
    for source in columns.sources():
        if not isinstance(source, Measured):
            continue
        for name in table.names(source):
            if question := question_of(name, source):
                raise LogError(f"{question} {_MEND}")
        if isinstance(source, RateColumn) and source.unit in ("deg/s", "rad/s") and source.scale == 1.0:
            values = _numbers(table, source)
            known = values[np.isfinite(values)]
            if len(known) > _MANY and np.ptp(known) > 1.0 and np.all(known == np.rint(known)):
                words = f"{source.words()} has only whole numbers: are they counts? If so, state the scale of one count"
                raise LogError(f"{words} {_MEND}")


def _numbers(table: FileArrays, source: Source) -> Any:
    """One column, unconverted (integers stay integers)."""
    values = table.array(source)
    if values.dtype.kind not in "biuf":
        raise LogError(f"{source.words()} has no numbers")
    return values


def _in_si(table: FileArrays, source: Source) -> Floats:
    """One column in SI; angles per row stay angles, and times count from the first row."""
    values = _numbers(table, source)
    with np.errstate(all="ignore"):  # absurd numbers are found and named afterwards
        if isinstance(source, TimeColumn | ClockColumn) and len(values):
            # Whole numbers are subtracted as such, which keeps the nanoseconds of an epoch.
            values = values.astype(np.int64 if values.dtype.kind in "iu" else np.float64)
            values = values - values[np.flatnonzero(np.isfinite(values))[:1]].sum()
        values = values.astype(np.float64)
        if isinstance(source, ClockColumn):
            return values / float(source.rate)
        if isinstance(source, StatusColumn):
            return (values != source.good).astype(np.float64)
        if not isinstance(source, Measured):
            return values
        at_zero = units.parse(f"0 {source.unit}", source.dimension)  # not 0 for degF
        factor = units.parse(f"1 {source.unit}", source.dimension) - at_zero
        zero = 0.0 if isinstance(source, TimeColumn) else source.zero
        values = (values - zero) * (source.scale * factor) + at_zero
    return values if source.where is None else np.where(_meant(table, source), values, np.nan)


def _meant(table: FileArrays, source: Measured) -> Bools | bool:
    return True if source.where is None else rows_where(source.where, table.array(source.where))


def columns_in_si(table: FileArrays, columns: ColumnMap, name: str) -> Columns:
    """The columns of a table in SI, by its map; `name`: of its source. Raises `LogError` where they do not fit."""
    sensors = columns.sensors
    values = {name: _in_si(table, source) for name, source in columns.of_table().items()}
    for channel in dict.fromkeys(name for sensor in sensors for name in sensor.channels()):
        each = [
            _in_si(table, sensor.channels()[channel]) if channel in sensor.channels() else None for sensor in sensors
        ]
        rows = next(len(one) for one in each if one is not None)
        lacking = np.full(rows, 0.0 if channel == "marked" else np.nan)
        values[channel] = np.stack([lacking if one is None else one for one in each])
    rows = {name: array.shape[-1] for name, array in values.items()}
    if len(set(rows.values())) > 1:
        raise LogError(f"columns have different numbers of rows: {', '.join(f'{k} {v}' for k, v in rows.items())}")
    count = next(iter(rows.values()))
    if columns.where is not None and table.array(columns.where).shape[0] == count:
        chosen = rows_where(columns.where, table.array(columns.where))
        values = {name: array[..., chosen] for name, array in values.items()}
        count = int(np.count_nonzero(chosen))
    if count < 2:
        raise LogError(f"there are {count} rows of numbers; at least two are needed")
    rate = {} if columns.sensor_rate is None else {SENSOR_RATE: f"{float(columns.sensor_rate):.9g} Hz"}
    return Columns(
        tuple(sensor.name for sensor in sensors),
        values,
        sample_rate_hz=None if columns.sample_rate is None else float(columns.sample_rate),
        full_scale_rad_per_s=None if columns.full_scale is None else float(columns.full_scale),
        simulated=columns.simulated,
        provenance={"source": name} | rate,
    )
