"""Reading and describing a LOG of any kind, for all commands that take one."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

from cyclopts import Parameter

if TYPE_CHECKING:
    from gradcal_jax.records.log import Log

LogFile = Annotated[Path, Parameter(help="A log (.nc), a flight log, or a table of another program with --columns.")]
ColumnMapOption = Annotated[
    Path | None,
    Parameter(
        name="--columns",
        help="If LOG is a table of another program: its column map (gradcal-columns/1); see gradcal start column-map.",
    ),
]
RowsOption = Annotated[
    str | None,
    Parameter(
        name="--rows",
        help='Of a table or a flight log only these rows, from 0: "1000..250000", or "1000.." for all from 1000 on.',
    ),
]
UnitOption = Annotated[str | None, Parameter(name="--unit", help="Which IMU, if the log has several.")]

_NETCDF: Final = (".nc", ".nc4", ".h5", ".hdf5")


def load(path: Path, columns: Path | None = None, rows: str | None = None, *, unit: str | None = None) -> "Log":
    """Read a log of this program (netCDF), or the requested rows of a flight log or a table with its column map.

    `unit` is needed for a flight log with several IMUs on different clocks. Raises `ValueError`.
    """
    from gradcal_jax.records.flight_logs import is_vehicle_log, read_vehicle_log
    from gradcal_jax.records.log_file import read_log

    _exists(path)
    between = None if rows is None else _rows(rows)
    if path.suffix.lower() in _NETCDF:
        if columns is not None or rows is not None:
            raise ValueError(f"{path} is a log of this program: leave out --columns and --rows")
        return read_log(path)
    from gradcal_jax.records.importers import import_log, read_column_map

    if columns is not None:
        return import_log(path, read_column_map(columns), rows=between)
    if is_vehicle_log(path):
        return read_vehicle_log(path, unit=unit, rows=between)
    from gradcal_jax.records.column_names import without_a_map

    raise without_a_map(path)


def load_all(path: Path, columns: Path | None = None, rows: str | None = None) -> "list[Log]":
    """Like `load`, for a vehicle's log with every gyro: a log for each clock."""
    from gradcal_jax.records.flight_logs import is_vehicle_log, read_vehicle_logs

    _exists(path)
    if columns is not None or not is_vehicle_log(path):
        return [load(path, columns, rows)]
    return list(read_vehicle_logs(path, rows=None if rows is None else _rows(rows)))


def _exists(path: Path) -> None:
    if not path.exists():
        raise ValueError(f"{path} does not exist")
    if (path / "run.json").exists():
        raise ValueError(f"{path} is the folder of a run: name its log, {path}/log.nc (gradcal log {path} writes it)")
    if path.is_dir():
        raise ValueError(f"{path} is a folder: name a recording")


def _rows(text: str) -> tuple[int, int | None]:
    ends = text.replace(" ", "").split("..")
    if len(ends) != 2 or not all(end.isascii() and (end.isdigit() or not end) for end in ends) or ends == ["", ""]:
        raise ValueError(f'--rows {text!r}: expected rows counted from 0, such as "1000..250000" or "1000.."')
    first = int(ends[0] or 0)
    last = int(ends[1]) if ends[1] else None
    if last is not None and last <= first:
        raise ValueError(f"--rows {text!r}: no row lies between these numbers")
    return first, last


def span(text: str, option: str) -> tuple[float, float]:
    """A span of time such as "123 s..130 s", in s. Raises `ValueError` that names the option."""
    ends = text.split("..")
    if len(ends) != 2:
        raise ValueError(f'{option} {text!r}: expected a span such as "123 s..130 s"')
    first, last = (quantity(end.strip(), "time", option) for end in ends)
    if last < first:
        raise ValueError(f"{option} {text!r}: ends before it begins")
    return first, last


def quantity(text: str, dimension: str, option: str) -> float:
    """An option's quantity in SI. Raises `ValueError` that names the option."""
    from gradcal_jax import units

    try:
        return units.parse(text, dimension)
    except units.UnitError as error:
        raise ValueError(f"{option} {text!r}: {error}") from None


def text_of_log(log: "Log", name: str) -> str:
    """A log in a few lines: its contents, the numbers of rows by use, and every fault."""
    return f"{name}: " + "\n".join(log.summary_lines())
