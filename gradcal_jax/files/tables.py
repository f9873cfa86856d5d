"""Tables of numbers: CSV and other text, NumPy's `.npz` and `.npy`, MATLAB v5 files, netCDF; columns with units.

A column is identified by its name or number; the user gives its unit, scale and zero. The maps (`importers`, `points`),
which consist of these sections, refuse columns without units.
"""

import array
import csv
import importlib
import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final, Literal, TextIO

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from gradcal_jax import units
from gradcal_jax.files.log import Floats, LogError, naming, quietly
from gradcal_jax.files.netcdf import NetcdfError, load_netcdf
from gradcal_jax.files.problems import Problem, instead
from gradcal_jax.files.quantity import Flag, Number, Text, Whole
from gradcal_jax.files.section import Section

Array = NDArray[Any]
Name = Annotated[Text, Field(max_length=100)]

_TEXT: Final = (".csv", ".txt", ".tsv", ".dat", ".log", ".asc")
_DELIMITERS: Final = {"tab": "\t", "whitespace": None}
_APART: Final = {";": ";", "\t": "tab", ",": ",", "|": "|", " ": "whitespace"}
_COMMA: Final = re.compile(r"[+-]?\d+,\d+([eE][+-]?\d+)?")
_HEXADECIMAL: Final = re.compile(r"0[xX][0-9a-fA-F]+")
_LEADER: Final = "\u2024"
"""What stands for a point where the decimal sign is a comma: no number has one."""
_COMMAS: Final = str.maketrans({",": ".", ".": _LEADER})
_POINT: Final = re.compile(rf"[+-]?[\d.{_LEADER}]+{_LEADER}\d[\d.{_LEADER}]*([eE][+-]?\d+)?")
_CERTAIN: Final = (_COMMA, _HEXADECIMAL, _POINT)
"""Patterns of values that are not damaged numbers."""
_WAYS: Final = {
    _COMMA: 'a decimal comma; write decimal = "," under [csv]',
    _POINT: 'a point, where decimal = "," says that the decimal sign is a comma: is it a mark of thousands? Write the '
    "numbers without it",
    _HEXADECIMAL: "hexadecimal counts; write them as decimal numbers",
    re.compile(r"(?=.*[A-Fa-f])[0-9A-Fa-f]{2,16}"): "hexadecimal counts, it seems; write them as decimal numbers",
    re.compile(r"\d{1,4}[-./]\d{1,2}[-./]\d{1,4}.*|\d{1,2}:\d\d(:\d\d.*)?"): (
        "dates or times of day; write stamps as seconds, or leave time out and give sample_rate"
    ),
}


class Source(Section):
    """A column, by name, or by number counted from 0."""

    column: Text | Whole
    """Name of the column, or its number counted from 0."""
    index: Whole | None = None
    """Column of a two-dimensional array."""

    def words(self) -> str:
        """In words, for messages."""
        name = f"number {self.column}" if isinstance(self.column, int) else f"'{self.column}'"
        return f"column {name}" + ("" if self.index is None else f", index {self.index}")


class Measured(Source):
    """A quantity: (number - zero) × scale, in the unit."""

    DIMENSION: ClassVar[str]

    unit: Text
    """Unit of the values."""
    scale: Number = 1.0
    """Factor of the numbers, after `zero` is taken off."""
    zero: Number = 0.0
    """Number that stands for zero."""

    @field_validator("scale")
    @classmethod
    def _counts(cls, value: float) -> float:
        if value == 0.0:
            raise ValueError("must not be zero")
        return value

    @field_validator("unit")
    @classmethod
    def _measures(cls, unit: str) -> str:
        if cls.DIMENSION == "temperature" and unit.strip().lower() in ("k", "kelvin", "kelvins"):
            raise ValueError('for a column in kelvins write unit = "degC" and zero = 273.15')
        units.parse(f"1 {unit}", cls.DIMENSION)
        return unit


class TimeColumn(Measured):
    """Stamps."""

    DIMENSION = "time"


class RateColumn(Measured):
    """An angular rate."""

    DIMENSION = "angular rate"


class ForceColumn(Measured):
    """A specific force."""

    DIMENSION = "acceleration"


class AngleColumn(Measured):
    """An angle."""

    DIMENSION = "angle"


class TemperatureColumn(Measured):
    """An absolute temperature."""

    DIMENSION = "temperature"


class TextTable(Section):
    """How a text file is laid out."""

    delimiter: Annotated[str, Field(min_length=1, max_length=10)] = ","
    """Between columns: ",", ";", "tab" or "whitespace"."""
    header: Flag = True
    """Whether the first line names the columns."""
    comment: Annotated[str, Field(min_length=1, max_length=1)] = "#"
    """A line that begins so is left out."""
    skip: Whole = 0
    """Lines before the table."""
    decimal: Literal[".", ","] = "."
    """The decimal sign."""
    encoding: Text = "utf-8-sig"
    """How text is encoded."""

    @field_validator("encoding")
    @classmethod
    def _codec(cls, value: str) -> str:
        try:
            "".encode(value)
        except (LookupError, ValueError):
            raise ValueError('expected the name of an encoding, such as "utf-8", "latin-1" or "utf-16"') from None
        return value

    def _problems(self) -> Iterator[Problem]:
        if self.decimal == self.delimiter:
            yield Problem(("delimiter",), 'a decimal comma needs another delimiter, such as ";" or "tab"')

    @field_validator("delimiter")
    @classmethod
    def _known(cls, value: str) -> str:
        if value not in _DELIMITERS and (len(value) != 1 or value in ' "\n\r' or value.isalnum()):
            raise ValueError('expected one character such as "," or ";", or "tab" or "whitespace"')
        return value


def read_table(path: Path, layout: TextTable, sources: Sequence[Source], *, netcdf: bool = False) -> "Numbers":
    """The columns of a file, whose ending tells its kind: .csv, .txt, .tsv, .dat, .log, .asc (text), .npz, .npy, .mat
    (MATLAB up to version 7), and .nc where `netcdf`. Errors: `LogError` that names the file.
    """
    kind = path.suffix.lower()
    readers: dict[str, Callable[[Path, TextTable, Sequence[Source]], Numbers]] = {
        ".npz": _read_npz,
        ".npy": _read_npy,
        ".mat": _read_matlab,
        **dict.fromkeys(_TEXT, _read_text_table),
        **({".nc": _read_netcdf} if netcdf else {}),
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
    with naming(path):
        return readers[kind](path, layout, sources)


class Numbers:
    """Named or numbered columns of equal length."""

    def __init__(self, find: Callable[[Source], Array]) -> None:
        self._find = find
        self.rows: int | None = None

    def numbers(self, source: Source) -> Array:
        """One column, unconverted (integers stay integers)."""
        values = self._find(source)
        if values.dtype.kind not in "biuf":
            raise LogError(f"{source.words()} holds no numbers")
        if self.rows is None:
            self.rows = len(values)
        if len(values) != self.rows:
            raise LogError(f"{source.words()} has {len(values)} rows, the columns before it {self.rows}")
        return values

    def measured(self, source: Measured) -> Floats:
        """One column in SI."""
        dimension = source.DIMENSION
        values = self.numbers(source).astype(np.float64)
        at_zero = units.parse(f"0 {source.unit}", dimension)  # not 0 for degF
        factor = units.parse(f"1 {source.unit}", dimension) - at_zero
        with np.errstate(all="ignore"):  # absurd numbers are found and named afterwards
            return (values - source.zero) * (source.scale * factor) + at_zero

    def stamps(self, source: Measured) -> Floats:
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


def _read_text_table(path: Path, layout: TextTable, sources: Sequence[Source]) -> Numbers:
    delimiter = _DELIMITERS.get(layout.delimiter, layout.delimiter)
    try:
        with path.open(encoding=layout.encoding) as lines:
            for _ in range(layout.skip):
                lines.readline()
            header = _header(lines, layout, delimiter) if layout.header else []
            used = sorted({_place(source, header, layout.header) for source in sources})
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
    return Numbers(lambda source: by_place[_place(source, header, layout.header)])


def _pointed(lines: TextIO, layout: TextTable) -> Iterable[str]:
    # (A point among decimal commas is a mark of thousands, or the map is wrong: it must not become a decimal sign.)
    return lines if layout.decimal == "." else (line.translate(_COMMAS) for line in lines)


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
    """Row by row: missing values and texts become NaN, which are counted and named later.

    A column without any number, or in another notation of numbers, is an error.
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
                raise LogError(f"column {names[place]} holds {words}: '{text[:40].replace(_LEADER, '.')}'")
        if place not in readable:
            raise LogError(f"column {names[place]} holds no numbers, but such as '{text[:40].replace(_LEADER, '.')}'")
    return np.frombuffer(numbers, np.float64).reshape(-1, len(names))


def _number(text: str) -> float:
    try:
        return np.nan if "_" in text else float(text)
    except ValueError:
        return np.nan


def _read_npz(path: Path, layout: TextTable, sources: Sequence[Source]) -> Numbers:
    wanted = {str(source.column) for source in sources}

    # Opened here: NumPy leaves the file open where it is no archive.
    kind = "NumPy's .npz (without pickles)"
    with quietly(kind), path.open("rb") as file, np.load(file, allow_pickle=False) as opened:
        # Other arrays are named but not read: they may be large.
        return _of_arrays({str(name): opened[name] if name in wanted else np.empty(0) for name in opened.files})


def _read_npy(path: Path, layout: TextTable, sources: Sequence[Source]) -> Numbers:
    with quietly("NumPy's .npy (without pickles)"), path.open("rb") as file:
        values = np.asarray(np.load(file, allow_pickle=False))
    if values.dtype.names is not None:
        return _of_arrays({name: values[name] for name in values.dtype.names})
    if values.ndim != 2:
        raise LogError("the array needs one row a sample and one column a quantity")

    def find(source: Source) -> Array:
        if not isinstance(source.column, int) or source.index is not None or source.column >= values.shape[1]:
            raise LogError(f"there is no {source.words()}: columns are numbered 0 to {values.shape[1] - 1}")
        return values[:, source.column]

    return Numbers(find)


def _read_matlab(path: Path, layout: TextTable, sources: Sequence[Source]) -> Numbers:
    with path.open("rb") as opened:
        start = opened.read(128)
    if start.startswith(b"MATLAB 7.3") or start[:8] == b"\x89HDF\r\n\x1a\n":
        raise LogError("is a MATLAB 7.3 file: save it again with save(…, '-v7')")
    with quietly("MATLAB v5"):
        arrays: dict[str, Array] = importlib.import_module("scipy.io").loadmat(path, appendmat=False)
        numbers = {k: a for k, a in arrays.items() if not k.startswith("__") and a.dtype.kind in "fiu"}
        return _of_arrays({k: a.ravel() if 1 in a.shape else a for k, a in numbers.items()})


def _read_netcdf(path: Path, layout: TextTable, sources: Sequence[Source]) -> Numbers:
    try:
        dataset = load_netcdf(path)
    except NetcdfError as error:
        raise LogError(f"is no netCDF file that can be read: {error}") from None
    for source in sources:
        stated = dataset[source.column].attrs.get("units") if source.column in dataset.variables else None
        if isinstance(source, Measured) and stated is not None and not _same_unit(str(stated), source.unit):
            raise LogError(f"{source.words()} is in '{stated}' by its own attribute, and in '{source.unit}' by the map")
    return _of_arrays({str(name): dataset[name].values for name in dataset.variables})


def _same_unit(stated: str, unit: str) -> bool:
    """Whether two names of units mean the same; an unknown name passes."""
    for dimension in ("angular rate", "temperature", "time", "angle"):
        try:
            ours = units.parse(f"1 {unit}", dimension)
            return bool(np.isclose(ours, units.parse(f"1 {stated}", dimension), rtol=1e-9))
        except units.UnitError:
            continue
    return True


def _of_arrays(arrays: Mapping[str, Array]) -> Numbers:
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

    return Numbers(find)
