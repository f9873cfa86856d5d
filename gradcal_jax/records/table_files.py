"""Files of numbers -> `FileTable`: CSV and other text, NumPy's `.npz` and `.npy`, MATLAB v5 files, Parquet.

Text is read line by line, cell by cell: every row is counted, whatever is torn in it.
"""

import contextlib
import csv
import importlib
import itertools
import math
import re
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, TextIO

import numpy as np
from numpy.typing import NDArray

from gradcal_jax.records.column_map import DELIMITERS, ColumnMap, Measured, Source, TextTable, Where
from gradcal_jax.records.log import Bools, LogError, library, naming, quietly
from gradcal_jax.tables.problems import instead
from gradcal_jax.tables.sizes import check_size

Array = NDArray[Any]
# Lines that are searched for rows of several sensors, and for a header.
_LOOKED_AT, _PREAMBLE = 200, 500
# More values than this number and share of a column that cannot be read are no damaged numbers.
_MANY_UNREAD, _SHARE_UNREAD = 20, 0.02
_TEXT: Final = (".csv", ".txt", ".tsv", ".dat", ".log", ".asc")
_WHICH: Final = re.compile(
    r"(?:(?:sensor|imu|device|unit|node|board|channel|gyro|topic|frame|msg|message|source)[ _]?)?"
    r"(?:id|name|index|no|nr|num|number|type|kind|sensor|imu|device|unit|node|topic|source|instance|axis|signal)",
    re.IGNORECASE,
)
"""Names of columns whose values may identify one of several sensors."""
_MISSING: Final = re.compile(
    r"[+-]?(nan|inf(inity)?|1\.?#[a-z]+)?(\([a-z0-9]*\))?|n/?a|#[a-z/0]+[!?]?|null|none|missing|-+|\?+", re.IGNORECASE
)
"""Words for a missing value."""
_CHECKSUM: Final = re.compile(r"\*[0-9A-Fa-f]{2,8}\s*$")
_POINT: Final = "\u2024"
"""Replaces the points of a column with decimal commas: no number contains this character."""
_COMMA: Final = re.compile(rf"[+-]?[\d.]*[,{_POINT}]\d[\d.,{_POINT}]*([eE][+-]?\d+)?")
_DATE: Final = re.compile(r"\d{1,4}[-./]\d{1,2}[-./]\d{1,4}.*|\d{1,2}:\d\d(:\d\d.*)?")


@dataclass
class FileTable:
    """The arrays `(rows,)` or `(rows, columns)` of a file by name or number, and what the file calls them: the name,
    and the name with the unit that stands in a row of its own below the names."""

    arrays: Mapping[str | int, Array]
    called: Mapping[str | int, list[str]] = field(default_factory=dict[str | int, list[str]])

    def names(self, source: Source) -> list[str]:
        """What the file calls a column."""
        return self.called.get(source.column, [str(source.column)])

    def array(self, source: Source) -> Array:
        """One column `(rows,)` of any type. Raises `LogError` where there is none."""
        if source.column not in self.arrays:
            raise LogError(f"there is no {source.words()}; {instead(str(source.column), map(str, self.arrays))}")
        values = self.arrays[source.column]
        if values.ndim == 1 and source.index is None:
            return values
        if values.ndim == 2 and source.index is not None and source.index < values.shape[1]:
            return values[:, source.index]
        raise LogError(
            f"{source.words()}: the array has the shape {values.shape}: give the index of one of its columns"
        )

    def rows_where(self, where: Where) -> Bools:
        """`(rows,)`: the rows that are taken. Raises `LogError` where there are none."""
        return rows_where(where, self.array(where))


def rows_where(where: Where, values: Array) -> Bools:
    """`(rows,)`: the rows with the value. Raises `LogError` where there are none."""
    kinds, places = np.unique(values, return_inverse=True)
    meant = np.array([where.means(kind) for kind in kinds.tolist()], bool)
    if not meant.any():
        equals = f'"{where.equals}"' if isinstance(where.equals, str) else f"{where.equals:g}"
        some = ", ".join(str(kind) for kind in kinds[:8].tolist())
        raise LogError(f"where: no row has {equals} in {where.words()}; values in this column include {some}")
    return meant[places]


def read_table(path: Path, columns: ColumnMap) -> FileTable:
    """The columns of a map; of a text with `where` its rows alone. The ending tells the kind: .csv, .txt, .tsv, .dat,
    .log, .asc (text), .npz, .npy, .mat (MATLAB up to version 7), .parquet.

    Errors: `LogError` that names the file.
    """
    kind = path.suffix.lower()
    if kind not in (*_TEXT, *_READERS):
        words = f"{path}: unknown file name extension; known are {', '.join([*_TEXT, *_READERS])}"
        if kind in (".json", ".jsonl", ".ndjson"):
            words += (
                f". Lines of JSON become a table by pandas: pd.read_json({path.name!r}, lines=True)"
                f'.to_csv("{path.stem}.csv", index=False)'
            )
        raise LogError(words)
    if path.is_dir() or not path.exists():
        raise LogError(f"{path} {'is a directory' if path.is_dir() else 'does not exist'}")
    sources = list(columns.named().values())
    chosen = [one.where for one in sources if isinstance(one, Measured) and one.where is not None]
    with naming(path):
        try:
            if path.stat().st_size == 0:
                raise LogError("is empty")
            if kind in _TEXT:
                return _TextReader(path, columns.csv, sources, chosen, columns.where).table
            wanted = {one.column for one in (*sources, *chosen, *([columns.where] if columns.where else []))}
            return FileTable(_READERS[kind](path, wanted))
        except OSError as error:
            raise LogError(f"cannot be read: {error.strerror or error}") from None


class _TextReader:
    """Reads a text table."""

    def __init__(
        self, path: Path, layout: TextTable, sources: Sequence[Source], chosen: Sequence[Where], where: Where | None
    ) -> None:
        self._layout, self._where = layout, where
        self._delimiter = DELIMITERS.get(layout.delimiter, layout.delimiter)
        if any(source.index is not None for source in sources):
            raise LogError("in a text table, a column has no index: give only the name or number of the column")
        numbers = {source.column for source in sources}
        texts = {one.column for one in (*chosen, *([where] if where else []))}
        try:
            with path.open(encoding=layout.encoding) as lines:
                self._read(lines, numbers, texts)
        except UnicodeError:
            name = "UTF-8" if layout.encoding == "utf-8-sig" else layout.encoding
            text = f'is not text in {name}: state its encoding under [csv], such as encoding = "latin-1" or "utf-16"'
            raise LogError(f"{text}; or is it a file of another kind?") from None

    def _read(self, lines: TextIO, numbers: set[str | int], texts: set[str | int]) -> None:
        for _ in range(self._layout.skip):
            lines.readline()
        begin = list(itertools.islice(lines, _PREAMBLE))
        header, width = list[str](), 0
        if self._layout.header:
            place, header = self._header(begin, {one for one in numbers if isinstance(one, str)})
            width = 0 if begin[place].lstrip().startswith("#") else len(header)
            begin = begin[place + 1 :]
        places = {one: self._place(one, header) for one in numbers | texts}
        cells = {places[one]: _Cells(f"'{one}'" if isinstance(one, str) else f"number {one}") for one in numbers}
        words = {places[one]: list[str]() for one in texts}
        first, kinds = list[list[str]](), set[str]()
        count, wide, widest = 0, 0, list[str]()
        for row in self._rows(itertools.chain(begin, lines)):
            if len(first) < _LOOKED_AT:
                first.append(row)
            count += 1
            if width and any(row[width:]):
                wide, widest = wide + 1, widest or row
            if self._where is not None:
                kinds.add(kind := _cell(row, places[self._where.column]))
                if not self._where.means(kind):
                    continue
            for place, texts_of in words.items():
                texts_of.append(_cell(row, place))
            for place, column in cells.items():
                if place not in words:
                    column.add(_cell(row, place))
        if not count:
            raise LogError("there are no rows below the header")
        if self._where is not None:
            rows_where(self._where, np.array(sorted(kinds)))
        if wide > max(_MANY_UNREAD, _SHARE_UNREAD * count):
            raise LogError(
                f"{wide} of {count} rows have more fields than the {width} names of the header, such as "
                f"'{','.join(widest)[:60]}': do the numbers contain commas, or does the first column have no name? "
                "Correct the file, or refer to the columns by numbers, with header = false and skip = 1 under [csv]"
            )
        if not texts and not self._layout.lines:
            _refuse_several(first, header, set(cells))
        arrays: dict[int, Array] = {place: column.numbers() for place, column in cells.items() if place not in words}
        arrays |= {place: np.array(held, str) for place, held in words.items()}
        self.table = FileTable({one: arrays[place] for one, place in places.items()}, _called(places, header, first[0]))

    def _rows(self, lines: Iterable[str]) -> Iterator[list[str]]:
        """The fields of the rows, without other lines, remarks and checksums, with decimal points."""
        commas = str.maketrans({",": ".", ".": _POINT}) if self._layout.decimal == "," else None
        for line in lines:
            if not line.startswith(self._layout.lines):
                continue
            if "#" in line:
                line = line.partition("#")[0]
            if "*" in line:
                line = _CHECKSUM.sub("", line)
            if not line or line.isspace():
                continue
            yield self._split(line.translate(commas) if commas else line)

    def _split(self, line: str) -> list[str]:
        fields = line.split(self._delimiter)
        if self._delimiter is not None and '"' in line:
            with contextlib.suppress(csv.Error):
                fields = next(csv.reader([line], delimiter=self._delimiter), list[str]())
        return [one.strip() for one in fields]

    def _header(self, lines: Sequence[str], wanted: set[str]) -> tuple[int, list[str]]:
        """The line with the names: the first with all names of the map, or else the first that is not all numbers, or
        the last remark above the numbers."""
        split = [self._split(line.strip().lstrip("#")) for line in lines]
        if wanted:
            for place, names in enumerate(split):
                if wanted <= set(names):
                    return place, names
        remark: tuple[int, list[str]] | None = None
        for place, names in enumerate(split):
            if lines[place].lstrip().startswith("#"):
                remark = place, names
            elif any(np.isnan(_number(name)) and name.lower() != "nan" for name in names) and any(names):
                return place, names
            elif any(names):
                break
        if remark is None:
            raise LogError("the file has no line of column names: write header = false under [csv]")
        return remark

    def _place(self, column: str | int, header: list[str]) -> int:
        if isinstance(column, int):
            if self._layout.header and column >= len(header):
                raise LogError(f"there is no column number {column}: the header has {len(header)} columns, from 0")
            return column
        if not self._layout.header:
            raise LogError(f"column '{column}' is a name, and the file has no header: give its number, from 0")
        places = [str(place) for place, name in enumerate(header) if name == column]
        if len(places) == 1:
            return int(places[0])
        if places:
            raise LogError(
                f"several columns are named '{column}': give the number of the column instead, {' or '.join(places)} "
                "(numbered from 0)"
            )
        marks = {";": ";", "\t": "tab", ",": ","} if len(header) == 1 else {}
        mark = next((name for mark, name in marks.items() if mark in header[0]), None)
        hint = f'; or is delimiter = "{mark}" missing under [csv]?' if mark else ""
        raise LogError(f"there is no column '{column}'; {instead(column, header)}{hint}")


def _called(places: Mapping[str | int, int], header: list[str], first: list[str]) -> dict[str | int, list[str]]:
    """What the file calls its columns. A row of units may stand below the names: no word of it is a number."""
    called: dict[str | int, list[str]] = {one: [header[place]] for one, place in places.items() if place < len(header)}
    if all(np.isnan(_number(text)) for text in first):
        for one, names in called.items():
            unit = _cell(first, places[one]).strip("()[] ")
            names += [f"{names[0]} ({unit})"] * bool(unit)
    return called


def _refuse_several(rows: Sequence[Sequence[str]], header: Sequence[str], used: set[int]) -> None:
    """A table whose first lines are of several kinds, or of several sensors."""
    for place in [k for k, name in enumerate(header) if _WHICH.fullmatch(name)] if header else [0]:
        values = [row[place] for row in rows if len(row) > place]
        kinds = list(dict.fromkeys(values))
        turns = sum(a != b for a, b in itertools.pairwise(values))
        if place in used or not 1 < len(kinds) <= 0.1 * len(values) or turns < 0.2 * len(values):
            continue
        some = ", ".join(kinds[:4])
        number = not np.isnan(_number(kinds[0]))
        if header:
            equals = kinds[0] if number else f'"{kinds[0]}"'
            raise LogError(
                f"column '{header[place]}' has {len(kinds)} alternating values ({some}): does the table mix rows of "
                "several sensors? Select the rows of one sensor, such as "
                f'where = {{ column = "{header[place]}", equals = {equals} }}, for the whole map or one of its columns'
            )
        if not number:
            raise LogError(
                f"the file mixes lines of several kinds ({some}): select the lines of one kind under [csv], such as "
                f'lines = "{kinds[0]}"'
            )


class _Cells:
    """The cells of a column of numbers; those that are none, and no word for a missing value."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._values = array("d")
        self._unread = list[str]()

    def add(self, text: str) -> None:
        value = _number(text)
        self._values.append(value)
        if value != value and not _MISSING.fullmatch(text):
            self._unread.append(text)

    def numbers(self) -> Array:
        """The numbers, NaN for others. Raises `LogError` for a column that is not one of numbers."""
        values, unread = np.array(self._values), self._unread
        for text in unread:
            if _COMMA.fullmatch(text):
                shown = text[:40].replace(_POINT, ".")
                raise LogError(
                    f"column {self._name} has a decimal comma or a thousands separator: '{shown}'; write decimal = "
                    '"," under [csv] for decimal commas, and numbers without marks of thousands'
                )
        if unread and not np.isfinite(values).any():
            if _DATE.fullmatch(unread[-1]):
                raise LogError(
                    f"column {self._name} has dates or times of day; write them as seconds, in pandas: table = "
                    "pd.read_csv(file); time = pd.to_datetime(table[column]); table[column] = (time - "
                    "time[0]).dt.total_seconds(); table.to_csv(file, index=False). Or leave out time and give "
                    f"sample_rate: '{unread[-1][:40]}'"
                )
            raise LogError(
                f"column {self._name} has no numbers, only texts such as '{unread[-1][:40]}' (hexadecimal counts must "
                "be written as decimal numbers)"
            )
        if len(unread) > max(_MANY_UNREAD, _SHARE_UNREAD * len(values)):
            raise LogError(
                f"column {self._name}: {len(unread)} of {len(values)} rows have no number but text, for example "
                f"'{unread[-1][:40]}': is this another notation of numbers? Correct these cells, or leave them empty"
            )
        return values


def _cell(row: Sequence[str], place: int) -> str:
    return row[place] if place < len(row) else ""


def _number(text: str) -> float:
    try:
        return math.nan if "_" in text else float(text.replace("\u2212", "-"))
    except ValueError:
        return math.nan


def _check_size(declared: int, path: Path) -> None:
    try:
        check_size(declared, path.stat().st_size)
    except ValueError as error:
        raise LogError(f"is damaged, or {error}") from None


def _read_npz(path: Path, wanted: set[str | int]) -> dict[str | int, Array]:
    # Opened here: NumPy leaves the file open where it is no archive.
    kind = "NumPy's .npz (without pickles)"
    with quietly(kind), path.open("rb") as file, np.load(file, allow_pickle=False) as opened:
        # Other arrays are named but not read: they may be large.
        infos = [one for one in opened.zip.infolist() if one.filename.removesuffix(".npy") in wanted]
        _check_size(sum(info.file_size for info in infos), path)
        return {name: opened[name] if name in wanted else np.empty(0) for name in opened.files}


def _read_npy(path: Path, wanted: set[str | int]) -> dict[str | int, Array]:
    with quietly("NumPy's .npy (without pickles)"), path.open("rb") as file:
        values = np.asarray(np.load(file, allow_pickle=False))
    if values.ndim != 2:
        raise LogError("the array must have one row for each sample and one column for each quantity")
    return dict(enumerate(values.T))


def _read_matlab(path: Path, wanted: set[str | int]) -> dict[str | int, Array]:
    with path.open("rb") as opened:
        start = opened.read(128)
    if start.startswith(b"MATLAB 7.3") or start[:8] == b"\x89HDF\r\n\x1a\n":
        raise LogError("is a MATLAB 7.3 file: save it again with save(…, '-v7')")
    with quietly("MATLAB v5"):
        reader: Any = importlib.import_module("scipy.io")
        shapes = (shape for _, shape, _ in reader.whosmat(path, appendmat=False))
        _check_size(sum(8 * math.prod(shape) for shape in shapes), path)
        return dict(_leaves(reader.loadmat(path, appendmat=False, simplify_cells=True)))


def _leaves(held: Any, before: str = "") -> Iterator[tuple[str, Array]]:
    """The arrays of numbers, those within structs by dotted names."""
    for name, value in held.items():
        if type(value) is dict:
            yield from _leaves(value, f"{before}{name}.")
        elif getattr(value, "dtype", np.dtype(object)).kind in "fiu" and value.ndim:
            yield before + name, value


def _read_parquet(path: Path, wanted: set[str | int]) -> dict[str | int, Array]:
    parquet = library("pyarrow.parquet", "pyarrow")
    with quietly("Parquet"):
        file = parquet.ParquetFile(path)
        _check_size(8 * file.metadata.num_rows * len(wanted), path)
        arrays: dict[str | int, Array] = {str(name): np.empty(0) for name in file.schema_arrow.names}
        table = file.read(columns=[name for name in arrays if name in wanted])
        for name in table.column_names:
            values: Array = table.column(name).to_numpy()
            # Stamps of a date are counts of its resolution: nanoseconds as a rule.
            arrays[name] = values.astype(np.int64) if values.dtype.kind == "M" else values
        return arrays


_READERS: Final[Mapping[str, Callable[[Path, set[str | int]], dict[str | int, Array]]]] = {
    ".npz": _read_npz,
    ".npy": _read_npy,
    ".mat": _read_matlab,
    ".parquet": _read_parquet,
}
