"""The file of a log: netCDF (HDF5)."""

import json
import logging
from collections.abc import Iterator
from dataclasses import asdict
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
)
from gradcal_jax.tables.display import printable
from gradcal_jax.tables.netcdf import NetcdfError, NetcdfVariable, load_netcdf, write_netcdf

_LOG = logging.getLogger(__name__)

_LABELS: Final = {"unit": "units", "axis": "axes", "force_axis": "force_axes", "table_axis": "table_axes"}
"""Dimensions with labels, and the fields of `Log` that have these."""
_BLOCK: Final = 1 << 16
"""Rows that are written at once: those of a run of days are on the disk."""


def write_log(log: Log, path: str | Path) -> None:
    """Write a log as netCDF (HDF5), each variable with its unit, for any program that reads labelled arrays.

    Errors: `LogError` where it cannot be written.
    """
    labels = {name: np.array(getattr(log, field), object) for name, field in _LABELS.items()}
    labels = {name: words for name, words in labels.items() if len(words) or name == "axis"}
    variables: dict[str, LogVariable] = {}
    arrays: dict[str, NDArray[Any]] = {}
    for kinds, holder in ((VARIABLES, log), (OF_READINGS, log.readings)):
        for name, variable in kinds.items() if holder is not None else ():
            if (values := getattr(holder, variable.field)) is not None:
                variables[name], arrays[name] = variable, values
    sizes = {name: len(words) for name, words in labels.items()}
    for name, variable in variables.items():
        sizes |= dict(zip(variable.dimensions, arrays[name].shape, strict=True))

    def contents() -> Iterator[tuple[str, tuple[slice, ...], NDArray[Any]]]:
        for name, words in labels.items():
            yield name, (), words
        for name, values in arrays.items():
            dimensions = variables[name].dimensions
            if "time" not in dimensions:
                yield name, (), values
                continue
            before = (slice(None),) * dimensions.index("time")
            for first in range(0, sizes["time"], _BLOCK):
                place = (*before, slice(first, min(first + _BLOCK, sizes["time"])))
                yield name, place, values[place]

    attributes: dict[str, str | int] = {
        "format": FORMAT,
        "rows_read": log.rows_read,
        "rows_removed": json.dumps(dict(log.rows_removed)),
        "findings": json.dumps([asdict(finding) for finding in log.findings], ensure_ascii=False),
        "simulated": int(log.simulated),
        "provenance": json.dumps(dict(log.provenance), ensure_ascii=False),
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
