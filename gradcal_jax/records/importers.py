"""Recordings of other programs -> `Log`: file -> arrays (`table_files`) -> columns in SI by the map (`column_map`),
whose units are held against the names in the file (`column_names`) -> examination."""

import logging
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
from gradcal_jax.records.log import SENSOR_RATE, Floats, Log, LogError, naming
from gradcal_jax.records.table_files import FileTable, read_table, rows_where

_LOG = logging.getLogger(__name__)
_MANY: Final = 200
"""If more rows than this have only whole numbers as rates, this is not by chance."""


def import_log(path: str | Path, columns: ColumnMap | str | Path, *, rows: tuple[int, int | None] | None = None) -> Log:
    """The log in a recording of another program, examined by the map's policy; of some rows only, if asked.

    `columns`: the column map (gradcal-columns/1, quantities with units), the name of its file, or its TOML text.

    The ending tells the kind: .csv, .txt, .tsv, .dat, .log, .asc (text), .npz, .npy, .mat (MATLAB up to version 7),
    .parquet.

    **Raises:** `LogError` with a sentence, for a file that is not what its ending says, for columns that are not there,
    and for faults that the policy refuses.
    """
    path = Path(path)
    if isinstance(columns, str | Path):
        text = isinstance(columns, str) and "\n" in columns
        columns = parse_column_map(str(columns)) if text else read_column_map(columns)
    table = read_table(path, columns)
    with naming(path):
        if columns.policy.values == "refuse":
            _refuse_contradictions(table, columns)
        raw = columns_in_si(table, columns, path.name)
        if columns.interpolate:
            raw = at_rows_with_rates(raw)
        log = examine(raw if rows is None else raw.part(rows), columns.policy)
        for fault in log.findings:
            _LOG.warning("%s: %s", path, fault.message)
        return log


def _refuse_contradictions(table: FileTable, columns: ColumnMap) -> None:
    """Names that state another quantity or unit than the map, and rates in whole numbers alone."""
    for source in columns.named().values():
        if not isinstance(source, Measured):
            continue
        questions = [question_of(name, source) for name in table.names(source)]
        if isinstance(source, RateColumn) and source.unit in ("deg/s", "rad/s") and source.scale == 1.0:
            values = _numbers(table, source)
            known = values[np.isfinite(values)]
            if len(known) > _MANY and np.ptp(known) > 1.0 and np.all(known == np.rint(known)):
                asks = "has only whole numbers: are they counts? If so, state the scale of one count"
                questions.append(f"{source.words()} {asks}")
        for question in filter(None, questions):
            raise LogError(f'{question} (correct the map, or set [policy] values = "keep")')


def elapsed(values: Any) -> Any:
    """Stamps `(n,)` of any type since the first. Whole numbers are subtracted as such, which keeps the nanoseconds of
    an epoch."""
    values = values.astype(np.int64 if values.dtype.kind in "iu" else np.float64)
    return values - values[np.flatnonzero(np.isfinite(values))[:1]].sum()


def to_si(values: Any, unit: str, dimension: str, scale: float = 1.0) -> Floats:
    """Numbers `(n,)`, of `scale` units each, in SI."""
    at_zero = units.parse(f"0 {unit}", dimension)  # not 0 for degF
    factor = units.parse(f"1 {unit}", dimension) - at_zero
    return values.astype(np.float64) * (scale * factor) + at_zero


def _numbers(table: FileTable, source: Source) -> Any:
    """One column, unconverted (integers stay integers)."""
    values = table.array(source)
    if values.dtype.kind not in "biuf":
        raise LogError(f"{source.words()} has no numbers")
    return values


def _in_si(table: FileTable, source: Source) -> Floats:
    """One column in SI; angles per row stay angles, and times count from the first row."""
    values = _numbers(table, source)
    with np.errstate(all="ignore"):  # absurd numbers are found and named afterwards
        if isinstance(source, ClockColumn):
            return elapsed(values) / float(source.rate)
        if isinstance(source, StatusColumn):
            return (values.astype(np.float64) != source.good).astype(np.float64)
        if not isinstance(source, Measured):
            return values.astype(np.float64)
        values = elapsed(values) if isinstance(source, TimeColumn) else values.astype(np.float64) - source.zero
        values = to_si(values, source.unit, source.dimension, source.scale)
    if source.where is None:
        return values
    return np.where(rows_where(source.where, table.array(source.where)), values, np.nan)


def columns_in_si(table: FileTable, columns: ColumnMap, name: str) -> Columns:
    """The columns of a table in SI, by its map; `name`: of its source. Raises `LogError` where they do not fit."""
    values = {name: _in_si(table, source) for name, source in columns.named().items()}
    counts = {name: len(array) for name, array in values.items()}
    if len(set(counts.values())) > 1:
        raise LogError(f"columns have different numbers of rows: {', '.join(f'{k} {v}' for k, v in counts.items())}")
    provenance = {"source": name}
    if columns.sensor_rate is not None:
        provenance[SENSOR_RATE] = f"{columns.sensor_rate:.9g} Hz"
    raw = Columns(
        columns.name,
        values,
        sample_rate_hz=columns.sample_rate,
        full_scale_rad_per_s=columns.full_scale,
        increments=tuple(f"gyro {axis}" for axis, rate in columns.rate.items() if rate.per == "row"),
        simulated=columns.simulated,
        provenance=provenance,
    )
    if columns.where is not None:
        raw = raw.of_rows(rows_where(columns.where, table.array(columns.where)))
    if raw.rows < 2:
        raise LogError(f"there are {raw.rows} rows of numbers; at least two are needed")
    return raw
