"""Reading and describing a LOG of any kind, for all commands that take one."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

from cyclopts import Parameter

from gradcal_jax.tables.display import columns

if TYPE_CHECKING:
    from gradcal_jax.records.log import Log

LOG_HELP: Final = "A log (.nc), a flight log, or a table of another program with --columns."
LogFile = Annotated[Path, Parameter(help=LOG_HELP)]

_NETCDF: Final = (".nc", ".nc4", ".h5", ".hdf5")


@Parameter(name="*")
@dataclass(frozen=True)
class Recording:
    """How to read a log, and which part to read.

    Parameters
    ----------
    columns
        If LOG is a table of another program: its column map (gradcal-columns/1); see gradcal new column-map.
    begin
        Read the log from this time on, such as "90 s".
    end
        Read the log up to this time.
    rows
        Read only these rows of the file, counted from 0: "1000..250000", or "1000.." for all rows from 1000 on.
    sensor_rate
        If each row is a single sample, but not every sample has a row: the sample rate of the sensor, such as "400 Hz".
        If each row is the mean of several samples: "means".
    """

    columns: Annotated[Path | None, Parameter(name="--columns")] = None
    begin: Annotated[str | None, Parameter(name="--from")] = None
    end: Annotated[str | None, Parameter(name="--to")] = None
    rows: Annotated[str | None, Parameter(name="--rows")] = None
    sensor_rate: Annotated[str | None, Parameter(name="--sensor-rate")] = None


WHOLE: Final = Recording()


def load(path: Path, source: Recording = WHOLE, *, unit: str | None = None) -> "Log":
    """Read the requested part of a log of this program (netCDF), a flight log, or a table with its column map.

    `unit` is needed for a flight log with several IMUs on different clocks. Raises `ValueError`.
    """
    if not path.exists():
        raise ValueError(f"{path} does not exist")
    if (path / "run.json").exists():
        raise ValueError(f"{path} is the folder of a run: name its log, {path}/log.nc (gradcal log {path} writes it)")
    if path.is_dir():
        raise ValueError(f"{path} is a folder: name a recording")
    return _stated(_load(path, source, unit), source)


def _stated(log: "Log", source: Recording) -> "Log":
    """The log with the rate of the sensor that the option states."""
    from gradcal_jax.records.log import SENSOR_RATE

    if source.sensor_rate is None:
        return log
    if source.sensor_rate != "means" and not quantity(source.sensor_rate, "frequency", "--sensor-rate") > 0.0:
        raise ValueError(f"--sensor-rate {source.sensor_rate!r}: must be positive")
    return replace(log, provenance={**log.provenance, SENSOR_RATE: source.sensor_rate})


def _load(path: Path, source: Recording, unit: str | None) -> "Log":
    from gradcal_jax.records.log import part_of
    from gradcal_jax.records.log_file import read_log
    from gradcal_jax.records.vehicle import is_vehicle_log, read_vehicle_log

    begin = None if source.begin is None else quantity(source.begin, "time", "--from")
    end = None if source.end is None else quantity(source.end, "time", "--to")
    rows = None if source.rows is None else _rows(source.rows)
    if path.suffix.lower() in _NETCDF:
        if source.columns is not None:
            raise ValueError(f"{path} is a log of this program, and needs no --columns: leave the option out")
        return part_of(read_log(path), begin_s=begin, end_s=end, rows=rows)
    from gradcal_jax.records.importers import import_log, read_column_map

    if is_vehicle_log(path) and source.columns is None:
        return part_of(read_vehicle_log(path, unit=unit, rows=rows), begin_s=begin, end_s=end)
    if source.columns is None:
        from gradcal_jax.records.column_guess import without_a_map

        raise without_a_map(path)
    return part_of(import_log(path, read_column_map(source.columns), rows=rows), begin_s=begin, end_s=end)


def load_all(path: Path, source: Recording = WHOLE) -> "list[Log]":
    """Like `load`, for a vehicle's log with every gyro: a log for each clock."""
    from gradcal_jax.records.log import part_of
    from gradcal_jax.records.vehicle import is_vehicle_log, read_vehicle_logs

    if not is_vehicle_log(path) or source.columns is not None:
        return [load(path, source)]
    begin = None if source.begin is None else quantity(source.begin, "time", "--from")
    end = None if source.end is None else quantity(source.end, "time", "--to")
    rows = None if source.rows is None else _rows(source.rows)
    return [_stated(part_of(log, begin_s=begin, end_s=end), source) for log in read_vehicle_logs(path, rows=rows)]


def _rows(text: str) -> tuple[int, int | None]:
    ends = text.replace(" ", "").split("..")
    if len(ends) != 2 or not all(end.isascii() and (end.isdigit() or not end) for end in ends) or ends == ["", ""]:
        raise ValueError(f'--rows {text!r}: expected rows counted from 0, such as "1000..250000" or "1000.."')
    first, last = int(ends[0] or 0), int(ends[1]) if ends[1] else None
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


def described(log: "Log", name: str) -> str:
    """A log in a few lines: its contents, the numbers of rows by use, and every fault."""
    lines = [
        f"{name}: {log.duration_s:.6g} s at {1.0 / log.sample_interval_s:.6g} Hz, "
        f"{len(log.units)} IMU{'s' * (len(log.units) != 1)}, axes {', '.join(log.axes)}"
        + (", SIMULATED" if log.simulated else "")
    ]
    counts = log.counts(0)
    if set(counts) != {"used"}:
        parts = ", ".join(f"{count} {reason}" for reason, count in counts.items())
        lines.append(f"of {log.rows_read} rows: {parts}")
    if log.findings:
        lines.append(columns([(f.done, f.message) for f in log.findings]))
    return "\n".join(lines)
