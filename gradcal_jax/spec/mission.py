"""Missions of a requirement: the rate and the temperature of the sensor over time, from a table whose header has units.

    time (s), rate (deg/s), temperature (degC)
    0,   0.0,  21.0
    10, 35.5,  21.4

Commas between columns, points in numbers; other columns, empty lines and lines that begin with "#" are ignored. Between
rows a mission is linear. Once read, a requirement has the text of the table itself, so that a recipe, a sweep's worker
or a spec in another folder needs no other file.
"""

import csv
import math
import re
from collections.abc import Generator, Iterable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Final, NamedTuple, cast

from pydantic import BeforeValidator, Field, model_validator

from gradcal_jax import units
from gradcal_jax.tables.document import read_text
from gradcal_jax.tables.problems import Problem, SpecError, instead
from gradcal_jax.tables.quantity import Number, Text
from gradcal_jax.tables.section import Section

# By column: its dimension, and the least and the largest allowed SI value (°C).
_COLUMNS: Final[Mapping[str, tuple[str, float, float]]] = {
    "time": ("time", -1e12, 1e12),
    "rate": ("angular rate", -1e4, 1e4),
    "temperature": ("temperature", -273.15, 2000.0),
}
_HEAD: Final = re.compile(r"\s*([^()\[\]]*?)\s*(?:\((.*)\)|\[(.*)\])\s*")
_NUMBER: Final = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,4})?")
_COMMA: Final = re.compile(r"[+-]?\d+,\d+")
_MOST_ROWS: Final = 500_000
# Of the faults of one table.
_MOST_FAULTS: Final = 5
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
    """The rows of a mission's table: time since the first row (s), rate (rad/s), temperature (°C), and line in the
    file."""

    time: tuple[float, ...]
    rate: tuple[float, ...]
    temperature: tuple[float, ...]
    line: tuple[int, ...]


class Mission(Section):
    """One mission: the `file` of its table, and its `weight`."""

    file: Text
    """CSV table of time, rate and temperature, with units in its header; the path is relative to the spec's folder."""
    weight: Annotated[Number, Field(gt=0.0, le=1e6)] = 1.0
    """Weight of this mission relative to the other missions."""
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
        return [Problem((), f"{self.file}, {fault}") for fault in self._parsed if isinstance(fault, str)]

    @property
    def _parsed(self) -> tuple[MissionRows | str, ...]:
        return _parse(self.table)

    @property
    def rows(self) -> MissionRows:
        """The table in SI (°C)."""
        return cast("MissionRows", self._parsed[0])


# Cached, because a spec is built again for every change.
@lru_cache(maxsize=64)
def _parse(text: str) -> tuple[MissionRows | str, ...]:
    return tuple(_rows_or_faults(text))


def _rows_or_faults(text: str) -> Iterator[MissionRows | str]:
    """The rows, or sentences that begin with the number of the faulty line."""
    lines = ((k, line) for k, line in enumerate(text.splitlines(), 1) if line.strip() and not line.startswith("#"))
    at, head = next(lines, (1, ""))
    columns = list(_columns(head))
    faults = [f"line {at}: {fault}" for fault in columns if isinstance(fault, str)]
    if faults:
        yield from faults
        return
    places = cast("list[tuple[int, float, float]]", columns)
    count = len(_fields(head))
    series: list[list[float]] = [[], [], []]
    numbers: list[int] = []
    for number, line in lines:
        row = _row(_fields(line), places, count)
        if not isinstance(row, str) and series[0] and row[0] <= series[0][-1]:
            row = f"the time is not later than that of line {numbers[-1]}; rows must be in order of time"
        if not isinstance(row, str) and len(numbers) >= _MOST_ROWS:
            row = f"there are more than {_MOST_ROWS} rows; average them to a smaller number"
        if isinstance(row, str):
            yield f"line {number}: {row}"
            faults.append(row)
            if len(faults) >= _MOST_FAULTS or len(numbers) >= _MOST_ROWS:
                return
            continue
        numbers.append(number)
        for column, value in zip(series, row, strict=True):
            column.append(value)
    if faults:
        return
    if len(numbers) < 2:
        yield f"line {at}: there are fewer than two rows after the header"
        return
    time, rate, temperature = series
    yield MissionRows(tuple(t - time[0] for t in time), tuple(rate), tuple(temperature), tuple(numbers))


def _fields(line: str) -> list[str]:
    try:
        return [field.strip() for field in next(csv.reader([line], skipinitialspace=True), list[str]())]
    except csv.Error:
        return [field.strip() for field in line.split(",")]


def _columns(head: str) -> Iterator[tuple[int, float, float] | str]:
    """For time, rate and temperature the column, the SI value of 0 and of one unit; or the problem."""
    fields = _fields(head)
    named = [match.groups() if (match := _HEAD.fullmatch(field)) else (field, None, None) for field in fields]
    names = [str(name) for name, _, _ in named]
    for column, (dimension, _, _) in _COLUMNS.items():
        example = units.DIMENSIONS[dimension].usual
        if names.count(column) != 1:
            if column in names:
                yield f"{names.count(column)} columns are named '{column}'"
            elif len(fields) == 1 and (";" in head or "\t" in head):
                yield "columns must be separated by commas"
                return
            else:
                yield f"there is no column '{column} ({example})'; {instead(column, names)}"
            continue
        place = names.index(column)
        unit = named[place][1] or named[place][2]
        if not unit:
            yield f"column '{column}' has no unit; write it in the header, such as '{column} ({example})'"
            continue
        try:
            zero = units.parse(f"0 {unit}", dimension)
            yield place, zero, units.parse(f"1 {unit}", dimension) - zero
        except units.UnitError as error:
            yield f"column '{column} ({unit})': {error}"


def _row(fields: list[str], places: list[tuple[int, float, float]], count: int) -> list[float] | str:
    """Time, rate and temperature of a row; or its problem."""
    if len(fields) != count:
        words = f"this line has {len(fields)} columns, and the header has {count}"
        return f"{words}; write numbers with a decimal point, not a comma"
    row: list[float] = []
    for (place, zero, factor), (column, (_, least, most)) in zip(places, _COLUMNS.items(), strict=True):
        text = fields[place]
        if not _NUMBER.fullmatch(text):
            if _COMMA.fullmatch(text):
                return f"{column} is '{text}', with a decimal comma; write a decimal point"
            return f"{column} is '{text[:40]}', which is not a number" if text else f"{column} is empty"
        value = float(text) * factor + zero
        if not (math.isfinite(value) and least <= value <= most):
            return f"{column} is {text}, which is not plausible for a mission"
        row.append(value)
    return row


def _listed(value: object) -> object:
    return cast("object", [value] if isinstance(value, str | Mapping | Mission) else value)


Missions = Annotated[
    tuple[Mission, ...],
    Field(min_length=1, max_length=100),
    BeforeValidator(_listed, json_schema_input_type=str | Mission | list[str | Mission]),
]
