"""Recordings of other programs -> `Log`: CSV and other text tables, NumPy's `.npz` and `.npy`, MATLAB v5 files.

What the columns mean is said in a small TOML file, with units:

    format      = "gradcal-columns/1"
    sample_rate = "100 Hz"                    # as stated; needed where there is no time
    full_scale  = "500 deg/s"                 # optional: where rates saturate
    skip_first  = 1                           # rows left out on request, and counted as such

    time        = { column = "t", unit = "us" }
    host_time   = { column = "pc", unit = "s" }
    temperature = { column = "temp", unit = "degC" }
    status      = { column = "flags", good = 0 }
    standstill  = { column = "rest" }         # truth values, or the number of the standstill (negative: moving)
    [rate]
    x = { column = "gx", unit = "deg/s", scale = 0.0305, zero = 12 }      # (number - zero) × scale, in the unit
    y = { column = "gyro", index = 1, unit = "rad/s" }                    # one column of a two-dimensional array
    [table_angle]
    inner = { column = 4, unit = "deg" }      # text and .npy: also by number, counted from 0
    [csv]
    delimiter = ";"                           # ",", ";", "tab" or "whitespace"; header = false, comment = "#", skip = 0
    decimal   = ","                           # 1,5 for one and a half; encoding = "latin-1" where it is not UTF-8
    [policy]
    gaps = "refuse"                           # see gradcal_jax.files.log_faults

Several sensors on one table: `[[sensor]]` tables with `name`, `rate`, `temperature` and `status`, in the place of those
at the top. Times count from the first row.
"""

import array
import csv
import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Final, Literal, TextIO, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator, model_validator

from gradcal_jax import units
from gradcal_jax.files.document import model_of, read_text, read_toml
from gradcal_jax.files.lines import with_lines
from gradcal_jax.files.log import Log, LogError
from gradcal_jax.files.log_faults import Columns, Policy, examine
from gradcal_jax.files.matlab_file import read_matlab
from gradcal_jax.files.problems import Problem, instead
from gradcal_jax.files.quantity import Flag, Number, Of, PositiveRate, Quantity, Text, Whole
from gradcal_jax.files.section import Section, refuse

FORMAT: Final = "gradcal-columns/1"
Array = NDArray[Any]
Floats = NDArray[np.float64]
_Result = TypeVar("_Result")
Frequency = Annotated[Quantity, Of("frequency", above="0 Hz")]
Name = Annotated[Text, Field(max_length=100)]

_TEXT: Final = (".csv", ".txt", ".tsv", ".dat", ".log", ".asc")
_DELIMITERS: Final = {"tab": "\t", "whitespace": None}
_APART: Final = {";": ";", "\t": "tab", ",": ",", "|": "|", " ": "whitespace"}
_COMMA: Final = re.compile(r"[+-]?\d+,\d+([eE][+-]?\d+)?")
_HEXADECIMAL: Final = re.compile(r"0[xX][0-9a-fA-F]+")
_CERTAIN: Final = (_COMMA, _HEXADECIMAL)
"""What no damaged number looks like."""
_WAYS: Final = {
    _COMMA: 'a decimal comma; write decimal = "," under [csv]',
    _HEXADECIMAL: "hexadecimal counts; write them as decimal numbers",
    re.compile(r"(?=.*[A-Fa-f])[0-9A-Fa-f]{2,16}"): "hexadecimal counts, it seems; write them as decimal numbers",
    re.compile(r"\d{1,4}[-./]\d{1,2}[-./]\d{1,4}.*|\d{1,2}:\d\d(:\d\d.*)?"): (
        "dates or times of day; write stamps as seconds, or leave time out and give sample_rate"
    ),
}


class Source(Section):
    """Where the numbers of a column stand: by name, or by number counted from 0."""

    column: Text | Whole
    index: Whole | None = None

    def words(self) -> str:
        """As people say it."""
        name = f"number {self.column}" if isinstance(self.column, int) else f"'{self.column}'"
        return f"column {name}" + ("" if self.index is None else f", index {self.index}")


class _Measured(Source):
    unit: Text
    scale: Number = 1.0
    zero: Number = 0.0

    @field_validator("scale")
    @classmethod
    def _counts(cls, value: float) -> float:
        if value == 0.0:
            raise ValueError("must not be zero")
        return value


class _Of:
    """A validator for a column's unit."""

    def __init__(self, dimension: str) -> None:
        self.dimension = dimension

    def __call__(self, unit: str) -> str:
        if self.dimension == "temperature" and unit.strip().lower() in ("k", "kelvin", "kelvins"):
            raise ValueError('for a column in kelvins write unit = "degC" and zero = 273.15')
        units.parse(f"1 {unit}", self.dimension)
        return unit


class TimeColumn(_Measured):
    """Stamps."""

    _unit = field_validator("unit")(_Of("time"))


class RateColumn(_Measured):
    """An angular rate."""

    _unit = field_validator("unit")(_Of("angular rate"))


class AngleColumn(_Measured):
    """An angle."""

    _unit = field_validator("unit")(_Of("angle"))


class TemperatureColumn(_Measured):
    """An absolute temperature."""

    _unit = field_validator("unit")(_Of("temperature"))


class StatusColumn(Source):
    """The device's own status; rows in which it is anything but `good` are marked bad."""

    good: Number = 0.0


class SensorColumns(Section):
    """What belongs to one of several sensors."""

    name: Name
    rate: Annotated[dict[Name, RateColumn], Field(min_length=1, max_length=20)]
    temperature: TemperatureColumn | None = None
    status: StatusColumn | None = None


class TextTable(Section):
    """How a text file is laid out."""

    delimiter: Annotated[str, Field(min_length=1, max_length=10)] = ","
    header: Flag = True
    comment: Annotated[str, Field(min_length=1, max_length=1)] = "#"
    skip: Whole = 0
    decimal: Literal[".", ","] = "."
    encoding: Text = "utf-8-sig"

    @field_validator("encoding")
    @classmethod
    def _codec(cls, value: str) -> str:
        try:
            "".encode(value)
        except (LookupError, ValueError):
            raise ValueError('expected the name of an encoding, such as "utf-8", "latin-1" or "utf-16"') from None
        return value

    @model_validator(mode="after")
    def _apart(self) -> "TextTable":
        if self.decimal == self.delimiter:
            refuse(Problem(("delimiter",), 'a decimal comma needs another delimiter, such as ";" or "tab"'))
        return self

    @field_validator("delimiter")
    @classmethod
    def _known(cls, value: str) -> str:
        if value not in _DELIMITERS and (len(value) != 1 or value in ' "\n\r' or value.isalnum()):
            raise ValueError('expected one character such as "," or ";", or "tab" or "whitespace"')
        return value


class ColumnMap(Section):
    """What the columns of a recording mean; see the module's head."""

    format: Literal["gradcal-columns/1"]
    name: Name = "sensor"
    sample_rate: Frequency | None = None
    full_scale: PositiveRate | None = None
    skip_first: Whole = 0
    simulated: Flag = False
    time: TimeColumn | None = None
    host_time: TimeColumn | None = None
    rate: Annotated[dict[Name, RateColumn], Field(max_length=20, default_factory=dict[str, RateColumn])]
    temperature: TemperatureColumn | None = None
    status: StatusColumn | None = None
    standstill: Source | None = None
    table_angle: Annotated[dict[Name, AngleColumn], Field(max_length=20, default_factory=dict[str, AngleColumn])]
    table_rate: Annotated[dict[Name, RateColumn], Field(max_length=20, default_factory=dict[str, RateColumn])]
    sensor: Annotated[tuple[SensorColumns, ...], Field(max_length=1000)] = ()
    csv: TextTable = TextTable()
    policy: Policy = Policy()

    @model_validator(mode="after")
    def _together(self) -> "ColumnMap":
        problems: list[Problem] = []
        if self.sensor and (self.rate or self.temperature or self.status):
            text = "stands in each [[sensor]], or at the top where there is one sensor only"
            problems.append(Problem(("sensor",), f"rate, temperature and status {text}"))
        if not self.sensor and not self.rate:
            problems.append(Problem(("rate",), "this key is missing; name at least one axis", kind="missing"))
        axes = {tuple(sensor.rate) for sensor in self.sensor}
        if len(axes) > 1:
            problems.append(Problem(("sensor",), "every sensor needs the same axes, in the same order"))
        if len({sensor.name for sensor in self.sensor}) < len(self.sensor):
            problems.append(Problem(("sensor",), "two sensors have the same name"))
        if self.time is None and self.sample_rate is None:
            problems.append(Problem(("time",), 'give the time\'s column, or sample_rate = "100 Hz"', kind="missing"))
        if self.table_angle and self.table_rate and list(self.table_angle) != list(self.table_rate):
            problems.append(Problem(("table_rate",), "names other axes than table_angle"))
        refuse(*problems)
        return self

    @property
    def sensors(self) -> tuple[SensorColumns, ...]:
        """The sensors, one made of what stands at the top where `[[sensor]]` is absent."""
        if self.sensor:
            return self.sensor
        return (SensorColumns(name=self.name, rate=self.rate, temperature=self.temperature, status=self.status),)


def parse_column_map(text: str, source: str = "") -> ColumnMap:
    """The column map (gradcal-columns/1) in a TOML text: what columns of a recording mean, and in which units.

    Errors: `SpecError` with every fault.
    """
    with with_lines(text):
        return model_of(ColumnMap, read_toml(text, source), FORMAT, source)


def read_column_map(path: str | Path) -> ColumnMap:
    """The column map in a file. Raises `SpecError` with every fault."""
    return parse_column_map(read_text(path), str(path))


def import_log(path: str | Path, columns: ColumnMap, *, rows: tuple[int, int | None] | None = None) -> Log:
    """The log in a recording of another program, examined by the map's policy; of some rows only, if asked.

    The ending tells the kind: .csv, .txt, .tsv, .dat, .log, .asc (text), .npz, .npy, .mat (MATLAB up to version 7).

    **Raises:** `LogError` with a sentence, for a file that is not what its ending says, for columns that are not there,
    and for faults that the policy refuses.
    """
    path = Path(path)
    kind = path.suffix.lower()
    readers: dict[str, Callable[[Path, ColumnMap], _Table]] = {
        ".npz": _read_npz,
        ".npy": _read_npy,
        ".mat": _read_matlab,
        **dict.fromkeys(_TEXT, _read_text_table),
    }
    if kind not in readers:
        raise LogError(f"{path}: the ending tells the kind of file; known are {', '.join(sorted(readers))}")
    try:
        if path.is_dir():
            raise LogError(f"{path} is a directory")
        size = path.stat().st_size
    except FileNotFoundError:
        raise LogError(f"{path} does not exist") from None
    except (OSError, ValueError) as error:
        raise LogError(f"{path} cannot be read: {error}") from None
    if size == 0:
        raise LogError(f"{path} is empty")
    try:
        found = _columns(readers[kind](path, columns), columns, path.name)
        return examine(found if rows is None else found.part(rows), columns.policy)
    except LogError as error:
        raise LogError(f"{path}: {error}") from None


class _Table:
    """Named or numbered columns of equal length."""

    def __init__(self, find: Callable[[Source], Array]) -> None:
        self._find = find
        self.rows: int | None = None

    def numbers(self, source: Source) -> Array:
        """One column, as it stands (integers stay integers)."""
        values = self._find(source)
        if values.dtype.kind not in "biuf":
            raise LogError(f"{source.words()} holds no numbers")
        if self.rows is None:
            self.rows = len(values)
        if len(values) != self.rows:
            raise LogError(f"{source.words()} has {len(values)} rows, the columns before it {self.rows}")
        return values

    def measured(self, source: _Measured, dimension: str) -> Floats:
        """One column in SI."""
        values = self.numbers(source).astype(np.float64)
        at_zero = units.parse(f"0 {source.unit}", dimension)  # not 0 for degF
        factor = units.parse(f"1 {source.unit}", dimension) - at_zero
        with np.errstate(all="ignore"):  # absurd numbers are found and named afterwards
            return (values - source.zero) * (source.scale * factor) + at_zero

    def stamps(self, source: _Measured) -> Floats:
        """Times since the first row; whole numbers are subtracted as such, which keeps the nanoseconds of an epoch."""
        values = self.numbers(source)
        factor = units.parse(f"1 {source.unit}", "time") * source.scale
        if values.dtype.kind in "iu" and len(values):
            with np.errstate(all="ignore"):
                return (values.astype(np.int64) - values[:1].astype(np.int64)).astype(np.float64) * factor
        floats = values.astype(np.float64)
        known = floats[np.isfinite(floats)]
        with np.errstate(all="ignore"):
            return (floats - (known[0] if len(known) else 0.0)) * factor


def _columns(table: _Table, columns: ColumnMap, name: str) -> Columns:
    sensors = columns.sensors
    rate = np.stack(
        [
            np.stack([table.measured(column, "angular rate") for column in sensor.rate.values()], axis=-1)
            for sensor in sensors
        ]
    )
    rows = rate.shape[1]
    if rows < 2:
        raise LogError(f"there are {rows} rows of numbers; at least two are needed")
    temperature = np.full((len(sensors), rows), np.nan)
    marked = np.zeros((len(sensors), rows), bool)
    for unit, sensor in enumerate(sensors):
        if sensor.temperature is not None:
            temperature[unit] = table.measured(sensor.temperature, "temperature")
        if sensor.status is not None:
            marked[unit] = table.numbers(sensor.status) != sensor.status.good
    left_out = np.zeros(rows, bool)
    left_out[: columns.skip_first] = True
    table_axes = tuple(columns.table_angle or columns.table_rate)
    angles = [table.measured(column, "angle") for column in columns.table_angle.values()]
    rates = [table.measured(column, "angular rate") for column in columns.table_rate.values()]
    standstill = None if columns.standstill is None else table.numbers(columns.standstill).astype(np.float64)
    return Columns(
        rate_rad_per_s=rate,
        units=tuple(sensor.name for sensor in sensors),
        axes=tuple(sensors[0].rate),
        time_s=None if columns.time is None else table.stamps(columns.time),
        sample_rate_hz=None if columns.sample_rate is None else float(columns.sample_rate),
        full_scale_rad_per_s=None if columns.full_scale is None else float(columns.full_scale),
        temperature_c=temperature if any(sensor.temperature for sensor in sensors) else None,
        table_axes=table_axes,
        table_angle_rad=np.stack(angles, axis=1) if angles else None,
        table_rate_rad_per_s=np.stack(rates, axis=1) if rates else None,
        standstill=standstill,
        host_time_s=None if columns.host_time is None else table.stamps(columns.host_time),
        marked=marked if any(sensor.status for sensor in sensors) else None,
        left_out=left_out if columns.skip_first else None,
        simulated=columns.simulated,
        provenance={"source": name},
    )


def _sources(columns: ColumnMap) -> Iterator[Source]:
    """Every column that the map names."""
    for source in (columns.time, columns.host_time, columns.standstill):
        if source is not None:
            yield source
    for sensor in columns.sensors:
        yield from sensor.rate.values()
        for source in (sensor.temperature, sensor.status):
            if source is not None:
                yield source
    yield from columns.table_angle.values()
    yield from columns.table_rate.values()


def _read_text_table(path: Path, columns: ColumnMap) -> _Table:
    layout = columns.csv
    delimiter = _DELIMITERS.get(layout.delimiter, layout.delimiter)
    try:
        with path.open(encoding=layout.encoding) as lines:
            for _ in range(layout.skip):
                lines.readline()
            header = _header(lines, layout, delimiter) if layout.header else []
            used = sorted({_place(source, header, layout.header) for source in _sources(columns)})
            start = lines.tell()
            values = _quick(_pointed(lines, layout), delimiter, layout.comment, used)
            if values is None:
                lines.seek(start)
                names = {place: f"'{header[place]}'" if place < len(header) else f"number {place}" for place in used}
                values = _patient(_pointed(lines, layout), delimiter, layout.comment, names)
    except UnicodeError:
        name = "UTF-8" if layout.encoding == "utf-8-sig" else layout.encoding
        text = f'is not text in {name}: name its encoding under [csv], such as encoding = "latin-1" or "utf-16"'
        raise LogError(f"{text}, or is it another kind of file?") from None
    except OSError as error:
        raise LogError(f"cannot be read: {error.strerror or error}") from None
    by_place = {place: values[:, number] for number, place in enumerate(used)}
    return _Table(lambda source: by_place[_place(source, header, layout.header)])


def _pointed(lines: TextIO, layout: TextTable) -> Iterable[str]:
    return lines if layout.decimal == "." else (line.replace(",", ".") for line in lines)


def _header(lines: TextIO, layout: TextTable, delimiter: str | None) -> list[str]:
    """The names, with `lines` left at the first row of numbers; a header may itself be commented out."""
    remark = ""
    while True:
        start = lines.tell()
        line = lines.readline()
        plain = line.strip()
        if plain.startswith(layout.comment):
            remark = plain.lstrip(layout.comment).strip() or remark
            continue
        if plain:
            names = [name.strip() for name in _split(plain, delimiter)]
            if any(np.isnan(_number(name)) and name.lower() != "nan" for name in names):
                return names
        elif line:
            continue
        if remark:
            lines.seek(start)
            return [name.strip() for name in _split(remark, delimiter)]
        raise LogError("there is no line of column names: write header = false under [csv] if there is none")


def _split(line: str, delimiter: str | None) -> list[str]:
    if delimiter is None:
        return line.split()
    try:
        return next(csv.reader([line], delimiter=delimiter), list[str]())
    except csv.Error:
        return line.split(delimiter)


def _place(source: Source, header: list[str], named: bool) -> int:
    if source.index is not None:
        raise LogError(f"{source.words()}: a text table has no index; name the column itself")
    if isinstance(source.column, int):
        if named and source.column >= len(header):
            raise LogError(f"there is no {source.words()}: the header has {len(header)}, counted from 0")
        return source.column
    if not named:
        raise LogError(f"{source.words()} needs a header; without one columns are numbered from 0")
    if source.column not in header:
        apart = next((name for mark, name in _APART.items() if len(header) == 1 and mark in header[0]), None)
        hint = f'; or is it delimiter = "{apart}", under [csv]?' if apart else ""
        raise LogError(f"there is no {source.words()}; {instead(source.column, header)}{hint}")
    if header.count(source.column) > 1:
        places = " or ".join(str(place) for place, name in enumerate(header) if name == source.column)
        raise LogError(f"several columns are named '{source.column}': say which by its number, {places}, from 0")
    return header.index(source.column)


def _quick(lines: Iterable[str], delimiter: str | None, comment: str, used: list[int]) -> Floats | None:
    """All rows at once, by NumPy's compiled reader, where every row is whole; otherwise None."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            return np.loadtxt(lines, np.float64, comments=comment, delimiter=delimiter, usecols=used, ndmin=2)
    except (ValueError, IndexError, OverflowError, UserWarning, DeprecationWarning):
        return None


def _patient(lines: Iterable[str], delimiter: str | None, comment: str, names: Mapping[int, str]) -> Floats:
    """Row by row: what is missing or no number becomes NaN, and is counted and named later on.

    A column of which nothing is a number, or that is written in another way than numbers are here, is an error.
    """
    numbers = array.array("d")
    odd: dict[int, str] = {}
    readable: set[int] = set()
    for line in lines:
        plain = line.split(comment, 1)[0].strip()
        if not plain:
            continue
        fields = _split(plain, delimiter)
        for place in names:
            text = fields[place].strip() if place < len(fields) else ""
            number = _number(text)
            numbers.append(number)
            if number == number:
                readable.add(place)
            elif text.lower() not in ("", "nan") and not any(way.fullmatch(odd.get(place, "")) for way in _CERTAIN):
                odd[place] = text
    if not numbers:
        raise LogError("there are no rows below the header")
    for place, text in odd.items():
        for way, words in _WAYS.items():
            if way.fullmatch(text) and (place not in readable or way in _CERTAIN):
                raise LogError(f"column {names[place]} holds {words}: '{text[:40]}'")
        if place not in readable:
            raise LogError(f"column {names[place]} holds no numbers, but such as '{text[:40]}'")
    return np.frombuffer(numbers, np.float64).reshape(-1, len(names))


def _number(text: str) -> float:
    try:
        return np.nan if "_" in text else float(text)
    except ValueError:
        return np.nan


def _read_npz(path: Path, columns: ColumnMap) -> _Table:
    wanted = {str(source.column) for source in _sources(columns)}

    def load() -> dict[str, Array]:
        # Opened here: NumPy leaves the file open where it is no archive.
        with path.open("rb") as file, np.load(file, allow_pickle=False) as opened:
            # Other arrays are named but not read: they may be large.
            return {str(name): opened[name] if name in wanted else np.empty(0) for name in opened.files}

    return _of_arrays(_loaded(load, "NumPy's .npz (without pickles)"))


def _read_npy(path: Path, columns: ColumnMap) -> _Table:
    def load() -> Array:
        with path.open("rb") as file:
            return np.asarray(np.load(file, allow_pickle=False))

    values = _loaded(load, "NumPy's .npy (without pickles)")
    if values.dtype.names is not None:
        return _of_arrays({name: values[name] for name in values.dtype.names})
    if values.ndim != 2:
        raise LogError("the array needs one row a sample and one column a quantity")

    def find(source: Source) -> Array:
        if not isinstance(source.column, int) or source.index is not None or source.column >= values.shape[1]:
            raise LogError(f"there is no {source.words()}: columns are numbered 0 to {values.shape[1] - 1}")
        return values[:, source.column]

    return _Table(find)


def _read_matlab(path: Path, columns: ColumnMap) -> _Table:
    with path.open("rb") as opened:
        start = opened.read(128)
    if start.startswith(b"MATLAB 7.3") or start[:8] == b"\x89HDF\r\n\x1a\n":
        raise LogError("is a MATLAB 7.3 file: save it again with save(…, '-v7')")

    return _of_arrays(_loaded(lambda: read_matlab(path), "MATLAB v5"))


def _loaded(load: Callable[[], _Result], kind: str) -> _Result:
    """What a reader makes of a file, or one sentence for whatever it makes of bytes that are something else."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return load()
    except Exception as error:
        name = type(error).__name__
        raise LogError(f"cannot be read as {kind} ({name}): is it damaged, or of another kind?") from None


def _of_arrays(arrays: Mapping[str, Array]) -> _Table:
    def find(source: Source) -> Array:
        name = str(source.column)
        if name not in arrays:
            raise LogError(f"there is no {source.words()}; {instead(name, arrays)}")
        values = arrays[name]
        if values.ndim == 1 and source.index is None:
            return values
        if values.ndim == 2 and source.index is not None and source.index < values.shape[1]:
            return values[:, source.index]
        raise LogError(
            f"{source.words()}: the array has the shape {values.shape}; give the index of one of its columns"
        )

    return _Table(find)
