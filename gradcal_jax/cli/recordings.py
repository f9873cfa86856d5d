"""What the commands that take a LOG share: reading it, whatever its kind, and saying what was found wrong with it."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from gradcal_jax.pages.plain_text import columns

if TYPE_CHECKING:
    from gradcal_jax.files.log import Log

Axes = Annotated[tuple[str, ...], Parameter(name="--axis", negative="")]
ColumnMapFile = Annotated[Path | None, Parameter(name="--columns")]

_NETCDF = (".nc", ".nc4", ".h5", ".hdf5")


def load(path: Path, column_map: Path | None) -> "Log":
    """A log of this program (netCDF), or a recording of another with its column map. Raises `ValueError`s."""
    from gradcal_jax.files.importers import import_log, read_column_map
    from gradcal_jax.files.log import LogError, read_log

    if path.suffix.lower() in _NETCDF:
        if column_map is not None:
            raise ValueError(f"{path} is a log of this program, which needs no --columns: leave the option out")
        return read_log(path)
    if column_map is None:
        raise LogError(
            f"{path} is no netCDF log (.nc): say what its columns mean in a file and give it with --columns; "
            "gradcal schema columns describes such a file"
        )
    return import_log(path, read_column_map(column_map))


def quantity(text: str, dimension: str, option: str) -> float:
    """An option's quantity in SI. Raises `ValueError` that names the option."""
    from gradcal_jax import units

    try:
        return units.parse(text, dimension)
    except units.UnitError as error:
        raise ValueError(f"{option} {text!r}: {error}") from None


def described(log: "Log", name: str) -> str:
    """A log in a few lines: what it holds, where its rows went, and every fault that was found."""
    lines = [
        f"{name}: {log.duration_s:.6g} s at {1.0 / log.sample_interval_s:.6g} Hz, "
        f"{_count(len(log.units), 'unit')}, axes {', '.join(log.axes)}" + (", SIMULATED" if log.simulated else "")
    ]
    counts = log.counts(0)
    if set(counts) != {"used"}:
        parts = ", ".join(f"{count} {reason}" for reason, count in counts.items())
        lines.append(f"of {log.rows_read} rows: {parts}")
    if log.findings:
        lines.append(columns([(f.done, f.message) for f in log.findings]))
    return "\n".join(lines)


def _count(number: int, word: str) -> str:
    return f"{number} {word}" + ("" if number == 1 else "s")
