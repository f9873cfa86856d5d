"""Files of numbers -> `FileTable`: CSV and other text, NumPy's `.npz` and `.npy`, MATLAB v5 files, Parquet.

Every row of a text is counted, whatever is torn in it.
"""

import contextlib
import csv
import importlib
import itertools
import math
import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, TextIO

import numpy as np
from numpy.typing import NDArray

from gradcal_jax.records.column_map import ColumnMap, Source, TextTable, Where
from gradcal_jax.records.log import Bools, LogError, library, naming, quietly
from gradcal_jax.tables.problems import instead
from gradcal_jax.tables.sizes import check_size

Array = NDArray[Any]
# Lines that are searched for rows of several sensors, and for a header.
_LOOKED_AT, _PREAMBLE = 200, 500
# Characters of a line: thousands of columns fit in, and a disk's zeros after a loss of power do not.
_LONGEST_LINE = 1_000_000
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
    with naming(path):
        if path.stat().st_size == 0:
            raise LogError("is empty")
        if kind in _TEXT:
            return _read_text(path, columns)
        return FileTable(_READERS[kind](path, {one.column for one in (*columns.sources(), *columns.wheres())}))


def _lines_of(file: TextIO) -> Iterator[str]:
    while line := file.readline(_LONGEST_LINE):
        if len(line) == _LONGEST_LINE:
            raise LogError(f"a line is longer than {_LONGEST_LINE} characters: it is no table of text, or is damaged")
        yield line


class _Lines:
    """Lines as a file to read."""

    def __init__(self, lines: Iterator[str]) -> None:
        self._lines = lines

    def __iter__(self) -> Iterator[str]:
        return self._lines

    def read(self, _: int) -> str:
        """Some of the lines; none at the end."""
        return "".join(itertools.islice(self._lines, 4096))


def _read_text(path: Path, columns: ColumnMap) -> FileTable:
    layout, where = columns.csv, columns.where
    texts = {one.column for one in columns.wheres()}
    wanted = {one.column for one in columns.sources()} | texts
    if any(source.index is not None for source in columns.sources()):
        raise LogError("in a text table, a column has no index: give only the name or number of the column")
    try:
        with path.open(encoding=layout.encoding) as file:
            lines = _lines_of(file)
            begin = list(itertools.islice(lines, layout.skip, layout.skip + _PREAMBLE))
            above, header = _header(begin, wanted, layout) if layout.header else (0, list[str]())
            places = {one: _place(one, header, layout) for one in wanted}
            rows = _rows(itertools.chain(begin[above:], lines), layout)
            first = list(itertools.islice(rows, _LOOKED_AT))
            # A remark may name other columns than those of the rows.
            width = len(header) if header and not begin[above - 1].lstrip().startswith("#") else 0
            as_text = {places[one] for one in texts} | ({width} if width else set[int]())
            cells = _cells(itertools.chain(first, rows), as_text.union(places.values()), as_text, layout)
    except (UnicodeError, LookupError):
        name = "UTF-8" if layout.encoding == "utf-8-sig" else layout.encoding
        text = f'is not text in {name}: state its encoding under [csv], such as encoding = "latin-1" or "utf-16"'
        raise LogError(f"{text}; or is it a file of another kind?") from None
    if not first:
        raise LogError("there are no rows below the header")
    if where is not None:
        cells = cells[rows_where(where, _words(cells[places[where.column]]))]
    extra: Any = cells[width].dropna() if width else cells[:0]
    if len(extra) > max(_MANY_UNREAD, _SHARE_UNREAD * len(cells)):
        raise LogError(
            f"{len(extra)} of {len(cells)} rows have more fields than the {width} names of the header, such as "
            f"'{extra.iloc[0][:40]}': do the numbers contain commas, or does the first column have no name? "
            "Correct the file, or refer to the columns by numbers, with header = false and skip = 1 under [csv]"
        )
    fields = [_fields(line, layout.mark) for line in first]
    if not texts and not layout.lines:
        _refuse_several(fields, header, set(places.values()))
    arrays = {one: _words(cells[at]) if one in texts else _numbers(one, cells[at]) for one, at in places.items()}
    called = {one: header[at : at + 1] for one, at in places.items()}
    # A row of units may stand below the names: no word of it is a number.
    if all(np.isnan(_number(text)) for text in fields[0]):
        for one, names in called.items():
            unit = "".join(fields[0][places[one] : places[one] + 1]).strip("()[] ")
            names += [f"{name} ({unit})" for name in names if unit]
    return FileTable(arrays, called)


def _cells(rows: Iterator[str], places: set[int], texts: set[int], layout: TextTable) -> Any:
    """The columns at some places, those of `texts` as such, as a data frame."""
    pandas: Any = importlib.import_module("pandas")
    names = range(max(places) + 1)
    # A row of zeros says how many fields a row may have.
    zeros = (layout.mark or " ").join("0" for _ in names) + "\n"
    with warnings.catch_warnings(action="ignore"):
        cells = pandas.read_csv(
            _Lines(itertools.chain([zeros], rows)),
            sep=layout.mark or r"\s+",
            header=None,
            names=names,
            usecols=sorted(places),
            index_col=False,
            dtype=dict.fromkeys(texts, str),
            quoting=csv.QUOTE_NONE,
            skipinitialspace=True,
            skip_blank_lines=False,
            low_memory=False,
        )
    return cells.iloc[1:]


def _rows(lines: Iterable[str], layout: TextTable) -> Iterator[str]:
    """The rows without other lines, remarks, checksums and quotes, with decimal points."""
    commas = str.maketrans({",": ".", ".": _POINT}) if layout.decimal == "," else None
    for line in lines:
        if not line.startswith(layout.lines):
            continue
        row = line.partition("#")[0] if "#" in line else line
        if "*" in row:
            row = _CHECKSUM.sub("", row)
        if not row or row.isspace():
            continue
        if commas:
            row = row.translate(commas)
        if '"' in row and layout.mark:
            # (A mark within quotes is a thousands separator, or part of a text.)
            row = layout.mark.join(field.replace(layout.mark, _POINT) for field in _fields(row, layout.mark))
        yield row if row.endswith("\n") else row + "\n"


def _fields(line: str, mark: str | None) -> list[str]:
    fields = line.split(mark)
    if mark and '"' in line:
        with contextlib.suppress(csv.Error):
            fields = next(csv.reader([line], delimiter=mark), list[str]())
    return [one.strip() for one in fields]


def _header(lines: Sequence[str], wanted: set[str | int], layout: TextTable) -> tuple[int, list[str]]:
    """The number of lines down to the names, and these: the first with all names of the map, or else the first that is
    not all numbers, or the last remark above the numbers."""
    known, found = {one for one in wanted if isinstance(one, str)}, 0
    split = [_fields(line.strip().lstrip("#"), layout.mark) for line in lines]
    for at, names in enumerate(split, 1):
        if known and known <= set(names):
            return at, names
    for at, names in enumerate(split, 1):
        if lines[at - 1].lstrip().startswith("#"):
            found = at
        elif any(names):
            found = at if any(np.isnan(_number(name)) and name.lower() != "nan" for name in names) else found
            break
    if not found:
        raise LogError("the file has no line of column names: write header = false under [csv]")
    return found, split[found - 1]


def _place(column: str | int, header: Sequence[str], layout: TextTable) -> int:
    if isinstance(column, int):
        if layout.header and column >= len(header):
            raise LogError(f"there is no column number {column}: the header has {len(header)} columns, from 0")
        return column
    if not layout.header:
        raise LogError(f"column '{column}' is a name, and the file has no header: give its number, from 0")
    places = [str(place) for place, name in enumerate(header) if name == column]
    if len(places) == 1:
        return int(places[0])
    if places:
        raise LogError(
            f"several columns are named '{column}': give the number of the column instead, {' or '.join(places)} "
            "(numbered from 0)"
        )
    mark = next((mark for mark in (";", "\t", ",") if len(header) == 1 and mark in header[0]), None)
    hint = f'; or is delimiter = "{mark}" missing under [csv]?'.replace("\t", "tab") if mark else ""
    raise LogError(f"there is no column '{column}'; {instead(column, header)}{hint}")


def _refuse_several(rows: Sequence[Sequence[str]], header: Sequence[str], used: set[int]) -> None:
    """A table whose first lines are of several kinds, or of several sensors."""
    for place, name in enumerate(header or [""]):
        values = [row[place] for row in rows if len(row) > place]
        kinds = list(dict.fromkeys(values))
        turns = sum(a != b for a, b in itertools.pairwise(values))
        known = _WHICH.fullmatch(name) if header else np.isnan(_number(kinds[0]))
        if known and place not in used and 1 < len(kinds) <= 0.1 * len(values) and turns >= 0.2 * len(values):
            raise LogError(
                f"column '{name or 0}' has {len(kinds)} alternating values ({', '.join(kinds[:4])}): "
                "does the table mix rows of several sensors, or lines of several kinds? Select the rows of one, such "
                f'as where = {{ column = "{name}", equals = "{kinds[0]}" }}, for the whole map or one of its columns, '
                f'or the lines of one kind under [csv], such as lines = "{kinds[0]}"'
            )


def _words(cells: Any) -> Array:
    return cells.fillna("").str.strip().to_numpy(str)


def _numbers(column: str | int, cells: Any) -> Array:
    """The numbers of a column, NaN for others. Raises `LogError` for a column that is not one of numbers."""
    if cells.dtype.kind in "iuf":
        return cells.to_numpy()
    name = f"'{column}'" if isinstance(column, str) else f"number {column}"
    texts = ["" if cell != cell else str(cell).strip() for cell in cells.tolist()]
    values = np.array([_number(text) for text in texts])
    unread = [texts[row] for row in np.flatnonzero(np.isnan(values)) if not _MISSING.fullmatch(texts[row])]
    for text in unread:
        if _COMMA.fullmatch(text):
            shown = text[:40].replace(_POINT, ".")
            raise LogError(
                f"column {name} has a decimal comma or a thousands separator: '{shown}'; write decimal = "
                '"," under [csv] for decimal commas, and numbers without marks of thousands'
            )
    if unread and not np.isfinite(values).any():
        if _DATE.fullmatch(unread[-1]):
            raise LogError(
                f"column {name} has dates or times of day; write them as seconds, in pandas: table = "
                "pd.read_csv(file); time = pd.to_datetime(table[column]); table[column] = (time - "
                "time[0]).dt.total_seconds(); table.to_csv(file, index=False). Or leave out time and give "
                f"sample_rate: '{unread[-1][:40]}'"
            )
        raise LogError(
            f"column {name} has no numbers, only texts such as '{unread[-1][:40]}' (hexadecimal counts must "
            "be written as decimal numbers)"
        )
    if len(unread) > max(_MANY_UNREAD, _SHARE_UNREAD * len(values)):
        raise LogError(
            f"column {name}: {len(unread)} of {len(values)} rows have no number but text, for example "
            f"'{unread[-1][:40]}': is this another notation of numbers? Correct these cells, or leave them empty"
        )
    return values


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


def _read_numpy(path: Path, wanted: set[str | int]) -> dict[str | int, Array]:
    # Opened here: NumPy leaves the file open where it is no archive.
    with quietly(f"NumPy's {path.suffix} (without pickles)"), path.open("rb") as file:
        opened: Any = np.load(file, allow_pickle=False)
        if path.suffix.lower() == ".npy":
            if opened.ndim != 2:
                raise LogError("the array must have one row for each sample and one column for each quantity")
            columns: Array = opened.T
            return dict(enumerate(columns))
        # Other arrays are named but not read: they may be large.
        infos = [one for one in opened.zip.infolist() if one.filename.removesuffix(".npy") in wanted]
        _check_size(sum(info.file_size for info in infos), path)
        return {name: opened[name] if name in wanted else np.empty(0) for name in opened.files}


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
        names = [str(name) for name in file.schema_arrow.names]
        frame = file.read(columns=[name for name in names if name in wanted]).to_pandas()
        arrays: dict[str | int, Array] = {name: np.empty(0) for name in names}
        # Stamps of a date are counts of its resolution: nanoseconds as a rule.
        for name, column in frame.items():
            arrays[name] = column.to_numpy(np.int64 if column.dtype.kind == "M" else None)
        return arrays


_READERS: Final[Mapping[str, Callable[[Path, set[str | int]], dict[str | int, Array]]]] = {
    ".npz": _read_numpy,
    ".npy": _read_numpy,
    ".mat": _read_matlab,
    ".parquet": _read_parquet,
}
