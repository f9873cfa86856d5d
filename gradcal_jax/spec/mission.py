"""Missions of a requirement: the rate and the temperature of the sensor over time, from a table whose header has units.

    time (s), rate (deg/s), temperature (degC)
    0,   0.0,  21.0
    10, 35.5,  21.4

Commas between columns, points in numbers; other columns, empty lines and lines that begin with "#" are ignored. Between
rows a mission is linear. Once read, a requirement has the text of the table itself, so that a recipe, a sweep's worker
or a spec in another folder needs no other file.
"""

from collections.abc import Generator, Iterable, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Final, NamedTuple, cast

from pydantic import BeforeValidator, Field, model_validator

from gradcal_jax import units
from gradcal_jax.tables.document import read_text
from gradcal_jax.tables.problems import Problem, SpecError
from gradcal_jax.tables.quantity import Text
from gradcal_jax.tables.section import Section

# By column: its dimension, and the least and the largest allowed SI value (°C).
_COLUMNS: Final[Mapping[str, tuple[str, float, float]]] = {
    "time": ("time", -1e12, 1e12),
    "rate": ("angular rate", -1e4, 1e4),
    "temperature": ("temperature", -273.15, 2000.0),
}
_FOLDER: ContextVar[Path] = ContextVar("folder of mission files", default=Path())


@contextmanager
def missions_from(folder: Path) -> Generator[None]:
    """Names of mission files are seen from this folder, the one of the spec that has them; otherwise from here."""
    token = _FOLDER.set(folder)
    try:
        yield
    finally:
        _FOLDER.reset(token)


class MissionRows(NamedTuple):
    """The rows of a mission's table: time since the first row (s), rate (rad/s), temperature (°C)."""

    time: tuple[float, ...]
    rate: tuple[float, ...]
    temperature: tuple[float, ...]


class Mission(Section):
    """One mission: the `file` of its table."""

    file: Text
    """CSV table of time, rate and temperature, with units in its header; the path is relative to the spec's folder."""
    table: str = ""
    """Text of the table, filled in by the program."""

    @model_validator(mode="before")
    @classmethod
    def _read(cls, value: object) -> object:
        if isinstance(value, str):
            value = {"file": value}
        if not isinstance(value, Mapping):
            return value
        entry = dict(cast("Mapping[str, object]", value))
        name = entry.get("file")
        if "table" in entry or not isinstance(name, str) or not name:
            return entry
        try:
            return entry | {"table": read_text(_FOLDER.get() / name, "table of time, rate and temperature (CSV)")}
        except SpecError as error:
            raise SpecError([Problem(("file",), error.problems[0].message, name)]) from None

    def _problems(self) -> Iterable[Problem]:
        try:
            _parse(self.table)
        except ValueError as error:
            yield Problem((), f"{self.file}: {error}")

    @property
    def rows(self) -> MissionRows:
        """The table in SI (°C)."""
        return _parse(self.table)


# Cached, because a spec is built again for every change.
@lru_cache(maxsize=64)
def _parse(text: str) -> MissionRows:
    """The rows of a table. Errors: `ValueError` with the line that is no row of plausible numbers in order of time."""
    lines = [(k, line) for k, line in enumerate(text.splitlines(), 1) if line.strip() and not line.startswith("#")]
    if len(lines) < 3:
        raise ValueError("expected a header and two or more rows")
    columns = _columns(lines[0][1])
    rows: list[list[float]] = []
    for number, line in lines[1:]:
        try:
            row = _row(line.split(","), columns)
        except (ValueError, IndexError):
            raise ValueError(f"line {number}: expected plausible numbers, separated by commas, with points") from None
        if rows and row[0] <= rows[-1][0]:
            raise ValueError(f"line {number}: rows must be in order of time")
        rows.append(row)
    time, rate, temperature = zip(*rows, strict=True)
    return MissionRows(tuple(t - time[0] for t in time), rate, temperature)


def _columns(head: str) -> list[tuple[int, float, float]]:
    """For time, rate and temperature the column, the SI value of 0 and of one unit."""
    names = [field.strip() for field in head.split(",")]
    columns: list[tuple[int, float, float]] = []
    for column, (dimension, _, _) in _COLUMNS.items():
        places = [k for k, name in enumerate(names) if name.startswith(f"{column} (") and name.endswith(")")]
        if len(places) != 1:
            example = units.DIMENSIONS[dimension].usual
            raise ValueError(f"the header needs one column '{column} ({example})', separated by commas")
        unit = names[places[0]].removeprefix(f"{column} (").removesuffix(")")
        zero = units.parse(f"0 {unit}", dimension)
        columns.append((places[0], zero, units.parse(f"1 {unit}", dimension) - zero))
    return columns


def _row(fields: list[str], columns: list[tuple[int, float, float]]) -> list[float]:
    """Time, rate and temperature in SI (°C)."""
    row: list[float] = []
    for (place, zero, factor), (_, least, most) in zip(columns, _COLUMNS.values(), strict=True):
        value = float(fields[place]) * factor + zero
        if not least <= value <= most:
            raise ValueError
        row.append(value)
    return row


def _listed(value: object) -> object:
    return cast("object", [value] if isinstance(value, str | Mapping | Mission) else value)


Missions = Annotated[
    tuple[Mission, ...],
    Field(min_length=1, max_length=100),
    BeforeValidator(_listed, json_schema_input_type=str | Mission | list[str | Mission]),
]
