"""The file of a log: netCDF (HDF5), written whole or block by block."""

import itertools
import json
import logging
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Final, cast

import numpy as np
from numpy.typing import NDArray

from gradcal_jax.records.log import (
    FORMAT,
    NEEDED,
    OF_READINGS,
    VARIABLES,
    AngleReadings,
    Finding,
    Log,
    LogError,
    LogVariable,
    Reason,
)
from gradcal_jax.tables.display import printable
from gradcal_jax.tables.netcdf import NetcdfError, NetcdfVariable, load_netcdf, write_netcdf

_LOG = logging.getLogger(__name__)

Columns = Mapping[str, NDArray[Any]]


@dataclass(frozen=True)
class LogInBlocks:
    """A log whose rows are made as they are wanted, because all of them may take more memory than there is."""

    rows: int
    fields: Mapping[str, Any]
    """The fields of `Log` that have no dimension [time]."""
    blocks: Callable[[], Iterator[tuple[int, Columns]]]
    """Yields all rows in order, as blocks: the number of the first row, and the columns by the fields of `Log`."""
    duration_s: float
    standstills: int
    masked: int
    """Rows that the device marked as bad."""

    def checked(self) -> Iterator[tuple[int, Columns]]:
        """The blocks. Errors: `LogError` where the times do not increase from one to the next."""
        last_s = -np.inf
        for first, columns in self.blocks():
            stamps = columns["time_s"]
            if not (np.isfinite(stamps).all() and np.all(np.diff(stamps, prepend=last_s) > 0.0)):
                raise LogError("the times of a log must increase from row to row")
            last_s = float(stamps[-1])
            yield first, columns

    def counts(self) -> dict[str, int]:
        """As `Log.counts`."""
        marked = {Reason.MARKED.words: self.masked} if self.masked else {}
        return {"used": self.rows - self.masked, **self.fields["rows_removed"], **marked}

    def whole(self) -> Log:
        """All of it, in memory."""
        arrays: dict[str, NDArray[Any]] = {}
        for first, columns in self.blocks():
            for name, values in columns.items():
                at, count = _ROWS[name], values.shape[_ROWS[name]]
                if name not in arrays:
                    arrays[name] = np.empty((*values.shape[:at], self.rows, *values.shape[at + 1 :]), values.dtype)
                arrays[name][(slice(None),) * at + (slice(first, first + count),)] = values
        return Log(**arrays, **self.fields)


_ROWS: Final[Mapping[str, int]] = {
    variable.field: variable.dimensions.index("time")
    for variable in VARIABLES.values()
    if "time" in variable.dimensions
}
"""For each field with rows: the position of the dimension [time]."""
_LABELS: Final = {"unit": "units", "axis": "axes", "force_axis": "force_axes", "table_axis": "table_axes"}
"""Dimensions with labels, and the fields of `Log` that have these."""


def write_log(log: Log | LogInBlocks, path: str | Path) -> None:
    """Write a log as netCDF (HDF5), each variable with its unit, for any program that reads labelled arrays.

    Errors: `LogError` where it cannot be written.
    """
    if isinstance(log, LogInBlocks):
        of, rows, blocks = log.fields, log.rows, log.checked()
    else:
        of, rows = {one.name: getattr(log, one.name) for one in fields(log)}, len(log.time_s)
        blocks = iter([(0, {name: values for name in _ROWS if (values := of[name]) is not None})])
    begins = next(blocks)
    labels = {name: of[field] for name, field in _LABELS.items()}
    labels = {name: np.array(words, object) for name, words in labels.items() if words or name == "axis"}
    by_rows = {name: variable for name, variable in VARIABLES.items() if variable.field in begins[1]}
    variables = by_rows | {name: variable for name, variable in VARIABLES.items() if variable.field not in _ROWS}
    whole = {name: of[variable.field] for name, variable in variables.items() if variable.field not in _ROWS}
    if (readings := of["readings"]) is not None:
        variables |= OF_READINGS
        whole |= {name: getattr(readings, variable.field) for name, variable in OF_READINGS.items()}
    sizes = {"time": rows} | {name: len(words) for name, words in labels.items()}
    sizes |= {variables[name].dimensions[0]: len(values) for name, values in whole.items()}

    def contents() -> Iterator[tuple[str, tuple[slice, ...], NDArray[Any]]]:
        for name, values in (*labels.items(), *whole.items()):
            yield name, (), values
        for first, columns in itertools.chain([begins], blocks):
            for name, variable in by_rows.items():
                values, at = columns[variable.field], _ROWS[variable.field]
                rows = slice(first, first + values.shape[at])
                yield name, (*(slice(None),) * at, rows), values

    attributes: dict[str, str | int] = {
        "format": FORMAT,
        "rows_read": of["rows_read"],
        "rows_removed": json.dumps(dict(of["rows_removed"])),
        "findings": json.dumps([asdict(finding) for finding in of["findings"]], ensure_ascii=False),
        "simulated": int(of["simulated"]),
        "provenance": json.dumps(dict(of["provenance"]), ensure_ascii=False),
    }
    written = {
        name: NetcdfVariable(variable.dimensions, variable.kind, {"units": variable.unit, "long_name": variable.words})
        for name, variable in variables.items()
    }
    written |= {name: NetcdfVariable((name,), str, {}) for name in labels}
    try:
        write_netcdf(path, sizes, written, attributes, contents())
    except OSError as error:
        raise LogError(f"{path} cannot be written: {error.strerror or error}") from None


def read_log(path: str | Path) -> Log:
    """Read a log that `write_log` wrote (netCDF): rates in rad/s, times in s, temperatures in °C.

    Errors: `LogError` for anything else, with a sentence.
    """
    path = Path(path)
    if not path.exists():
        raise LogError(f"{path} does not exist")
    try:
        dataset = load_netcdf(path)
    except NetcdfError as error:
        raise LogError(f"{path} cannot be read as a netCDF file: {error}") from None
    except OSError as error:
        raise LogError(f"{path} cannot be read: {error.strerror or error}") from None
    version = str(dataset.attrs.get("format"))
    if version != FORMAT:
        raise LogError(f'{path} has the format "{version}", and this program reads "{FORMAT}"')
    try:
        log = _from_dataset(dataset)
    except LogError as error:
        raise LogError(f"{path}: {error}") from None
    except (KeyError, TypeError, ValueError) as error:
        raise LogError(f"{path} is not a complete log: {error}") from None
    _LOG.info("read %s: %d rows, %.6g s", path, len(log.time_s), log.duration_s)
    return log


def _from_dataset(dataset: Any) -> Log:
    def array(name: str, variable: LogVariable) -> Any:
        if name not in dataset.variables:
            if name in NEEDED:
                raise LogError(f"there is no variable '{name}'")
            return None
        values = dataset[name]
        unit = str(values.attrs.get("units", "1"))
        if unit != variable.unit:
            raise LogError(
                f"'{name}' is in '{unit}', and a log holds it in '{variable.unit}': convert the values, and change "
                "the attribute units"
            )
        if set(values.dims) != set(variable.dimensions):
            raise LogError(f"'{name}' has the dimensions {values.dims} instead of {variable.dimensions}")
        return np.ascontiguousarray(values.transpose(*variable.dimensions).values, dtype=variable.kind)

    def labels(name: str) -> Any:
        return tuple(printable(str(label)) for label in dataset[name].values) if name in dataset.variables else ()

    def table(name: str) -> Any:
        return json.loads(str(dataset.attrs.get(name, "null")))

    readings = None
    if "reading_time" in dataset.variables:
        readings = AngleReadings(**{variable.field: array(name, variable) for name, variable in OF_READINGS.items()})
    return Log(
        **{variable.field: array(name, variable) for name, variable in VARIABLES.items()},
        **{field: labels(name) for name, field in _LABELS.items()},
        readings=readings,
        rows_read=int(dataset.attrs["rows_read"]),
        rows_removed={str(k): int(v) for k, v in cast("dict[str, Any]", table("rows_removed") or {}).items()},
        findings=tuple(Finding(**item) for item in cast("list[dict[str, Any]]", table("findings") or [])),
        simulated=bool(int(dataset.attrs.get("simulated", 0))),
        provenance={
            printable(str(k)): printable(str(v)) for k, v in cast("dict[str, Any]", table("provenance") or {}).items()
        },
    )
