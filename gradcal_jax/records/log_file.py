"""The file of a log: netCDF (HDF5)."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gradcal_jax.records.log import FORMAT, AngleReadings, Finding, Log, LogError, naming, variables_of
from gradcal_jax.tables.display import printable
from gradcal_jax.tables.netcdf import NetcdfError, NetcdfVariable, load_netcdf, write_netcdf

_LABELS: Final = {"unit": "units", "axis": "axes", "force_axis": "force_axes", "table_axis": "table_axes"}
"""Dimensions with labels, and the fields of `Log` that have these."""
_NEEDED: Final = ("time", "rate", "stretch_start")
_BLOCK: Final = 1 << 16
"""Rows that are written at once: those of a run of days are on the disk."""


def write_log(log: Log, path: str | Path) -> None:
    """Write a log as netCDF (HDF5), each variable with its unit, for any program that reads labelled arrays.

    Errors: `LogError` where it cannot be written.
    """
    sizes, written, arrays = dict[str, int](), dict[str, NetcdfVariable](), dict[str, NDArray[Any]]()
    for name, field in _LABELS.items():
        words = np.array(getattr(log, field), object)
        if len(words) or name == "axis":
            arrays[name], written[name] = words, NetcdfVariable((name,), str, {})
            sizes[name] = len(words)
    for holder in (log, *([] if log.readings is None else [log.readings])):
        for field, variable in variables_of(type(holder)).items():
            if (values := getattr(holder, field)) is not None:
                attributes = {"units": variable.unit, "long_name": variable.words}
                arrays[variable.name] = values
                written[variable.name] = NetcdfVariable(variable.dimensions, variable.kind, attributes)
                sizes |= dict(zip(variable.dimensions, values.shape, strict=True))

    def contents() -> Iterator[tuple[str, tuple[slice, ...], NDArray[Any]]]:
        for name, values in arrays.items():
            dimensions = written[name].dimensions
            if "time" not in dimensions:
                yield name, (), values
                continue
            before = (slice(None),) * dimensions.index("time")
            for first in range(0, sizes["time"], _BLOCK):
                place = (*before, slice(first, min(first + _BLOCK, sizes["time"])))
                yield name, place, values[place]

    of_file: dict[str, str | int] = {
        "format": FORMAT,
        "rows_read": log.rows_read,
        "rows_removed": json.dumps(dict(log.rows_removed)),
        "findings": json.dumps(log.findings, ensure_ascii=False),
        "simulated": int(log.simulated),
        "provenance": json.dumps(dict(log.provenance), ensure_ascii=False),
    }
    try:
        write_netcdf(path, sizes, written, of_file, contents())
    except OSError as error:
        raise LogError(f"{path} cannot be written: {error.strerror or error}") from None


def read_log(path: str | Path) -> Log:
    """Read a log that `write_log` wrote (netCDF): rates in rad/s, times in s, temperatures in °C.

    Errors: `LogError` for anything else, with a sentence.
    """
    path = Path(path)
    with naming(path):
        try:
            dataset = load_netcdf(path)
        except NetcdfError as error:
            raise LogError(f"cannot be read as a netCDF file: {error}") from None
        version = str(dataset.attrs.get("format"))
        if version != FORMAT:
            raise LogError(f'has the format "{version}", and this program reads "{FORMAT}"')
        try:
            return _from_dataset(dataset)
        except LogError:
            raise
        except (KeyError, TypeError, ValueError) as error:
            raise LogError(f"is not a complete log: {error}") from None


def _arrays(dataset: Any, holder: type[Log | AngleReadings]) -> dict[str, Any]:
    """The columns of a dataset by the fields of a `Log` or of `AngleReadings`."""
    arrays = dict[str, Any]()
    for field, variable in variables_of(holder).items():
        name = variable.name
        if name not in dataset.variables:
            if name in _NEEDED:
                raise LogError(f"there is no variable '{name}'")
            continue
        values = dataset[name]
        unit = str(values.attrs.get("units", "1"))
        if unit != variable.unit:
            raise LogError(
                f"'{name}' is in '{unit}', and a log holds it in '{variable.unit}': convert the values, and change "
                "the attribute units"
            )
        if set(values.dims) != set(variable.dimensions):
            raise LogError(f"'{name}' has the dimensions {values.dims} instead of {variable.dimensions}")
        arrays[field] = np.ascontiguousarray(values.transpose(*variable.dimensions).values, dtype=variable.kind)
    return arrays


def _from_dataset(dataset: Any) -> Log:
    def table(name: str) -> Any:
        return json.loads(str(dataset.attrs.get(name, "null"))) or {}

    labels: dict[str, Any] = {
        field: tuple(printable(str(label)) for label in dataset[name].values)
        for name, field in _LABELS.items()
        if name in dataset.variables
    }
    read = "reading_time" in dataset.variables
    return Log(
        **_arrays(dataset, Log),
        **labels,
        readings=AngleReadings(**_arrays(dataset, AngleReadings)) if read else None,
        rows_read=int(dataset.attrs["rows_read"]),
        rows_removed={str(name): int(count) for name, count in table("rows_removed").items()},
        findings=tuple(Finding(*item) for item in table("findings")),
        simulated=bool(int(dataset.attrs.get("simulated", 0))),
        provenance={printable(str(name)): printable(str(text)) for name, text in table("provenance").items()},
    )
