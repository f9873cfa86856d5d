"""Files of numbers -> arrays: CSV and other text (also `.gz`), NumPy's `.npz` and `.npy`, MATLAB v5 files, Parquet.

A file becomes a mapping of arrays `(rows,)` or `(rows, columns)` by name or number; of a text table it holds those that
the map names. Text is read by pandas where all cells are numbers or empty, and cell by cell otherwise.
"""

import contextlib
import csv
import gzip
import importlib
import io
import itertools
import math
import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, TextIO, cast

import numpy as np
from numpy.typing import NDArray

from gradcal_jax.records.column_map import DELIMITERS, Measured, Source, TextTable, Where
from gradcal_jax.records.log import LogError, library, naming, quietly
from gradcal_jax.tables.problems import instead
from gradcal_jax.tables.sizes import check_size

Array = NDArray[Any]
Arrays = dict[str | int, Array]
# Lines that are searched for rows of several sensors or a checksum; lines that may stand above a header.
_LOOKED_AT, _PREAMBLE = 200, 500
# If more values of a column (number, share) than this cannot be read, it is no numeric column with damaged values.
_MANY_UNREAD, _SHARE_UNREAD = 20, 0.02
_TEXT: Final = (".csv", ".txt", ".tsv", ".dat", ".log", ".asc")
_WHICH: Final = re.compile(
    r"(?:(?:sensor|imu|device|unit|node|board|channel|gyro|topic|frame|msg|message|source)[ _]?)?"
    r"(?:id|name|index|no|nr|num|number|type|kind|sensor|imu|device|unit|node|topic|source|instance|axis|signal|quantity|variable)",
    re.IGNORECASE,
)
"""Names of columns whose values may identify one of several sensors."""
_MISSING: Final = re.compile(
    r"[+-]?(nan|inf(inity)?|1\.?#[a-z]+)?(\([a-z0-9]*\))?|n/?a|#[a-z/0]+[!?]?|null|none|missing|-+|\?+", re.IGNORECASE
)
"""Words for a missing value."""
_LEADER: Final = "\u2024"
"""Replaces the points of a column with decimal commas: no number contains this character."""
_CERTAIN: Final = {
    re.compile(r"[+-]?\d+,\d+([eE][+-]?\d+)?"): 'a decimal comma; write decimal = "," under [csv]',
    re.compile(rf"[+-]?[\d.{_LEADER}]+{_LEADER}\d[\d.{_LEADER}]*([eE][+-]?\d+)?"): (
        'a decimal point, although decimal = "," states a decimal comma: is the point a thousands separator? Write the '
        "numbers without it"
    ),
    re.compile(r"0[xX][0-9a-fA-F]+"): "hexadecimal counts; write them as decimal numbers",
}
"""Patterns of values that are in another notation, and not damaged numbers."""
_LIKELY: Final = {
    re.compile(r"(?=.*[A-Fa-f])[0-9A-Fa-f]{2,16}"): (
        "values that look like hexadecimal counts; write them as decimal numbers"
    ),
    re.compile(r"\d{1,4}[-./]\d{1,2}[-./]\d{1,4}.*|\d{1,2}:\d\d(:\d\d.*)?"): (
        "dates or times of day; write them as seconds, in pandas: table = pd.read_csv(file); time = "
        "pd.to_datetime(table[column]); table[column] = (time - time[0]).dt.total_seconds(); table.to_csv(file, "
        "index=False). Or leave out time and give sample_rate"
    ),
}
"""The same where a column has no number."""


class FileArrays:
    """The arrays of a file, and what the file calls them: the name, and the name with the unit that stands in a row of
    its own below the names."""

    def __init__(self, arrays: Arrays, names: Mapping[str | int, list[str]] | None = None) -> None:
        self._arrays = arrays
        self._names = names or {}

    def names(self, source: Source) -> list[str]:
        """What the file calls a column."""
        return self._names.get(source.column, [str(source.column)])

    def array(self, source: Source) -> Array:
        """One column `(rows,)` of any type. Raises `LogError` where there is none."""
        if source.column not in self._arrays:
            raise LogError(f"there is no {source.words()}; {instead(str(source.column), map(str, self._arrays))}")
        values = self._arrays[source.column]
        if values.ndim == 1 and source.index is None:
            return values
        if values.ndim == 2 and source.index is not None and source.index < values.shape[1]:
            return values[:, source.index]
        raise LogError(
            f"{source.words()}: the array has the shape {values.shape}: give the index of one of its columns"
        )


def read_table(path: Path, layout: TextTable, sources: Sequence[Source], *, where: Where | None = None) -> FileArrays:
    """The columns of a file, whose ending tells its kind: .csv, .txt, .tsv, .dat, .log, .asc (text; also with .gz
    behind it), .npz, .npy, .mat (MATLAB up to version 7), .parquet; of a text the rows `where` alone.
    Errors: `LogError` that names the file.
    """
    kind = path.suffix.lower()
    if kind == ".gz" and Path(path.stem).suffix.lower() in _TEXT:
        kind = Path(path.stem).suffix.lower()
    if kind not in (*_TEXT, *_READERS):
        words = f"{path}: unknown file name extension (it determines the kind of file); known are "
        words += ", ".join([*sorted((*_TEXT, *_READERS)), ".csv.gz"])
        if kind in (".json", ".jsonl", ".ndjson"):
            words += (
                f". Lines of JSON become a table by pandas: pd.read_json({path.name!r}, lines=True)"
                f'.to_csv("{path.stem}.csv", index=False)'
            )
        raise LogError(words)
    if path.is_dir() or not path.exists():
        raise LogError(f"{path} {'is a directory' if path.is_dir() else 'does not exist'}")
    with naming(path):
        try:
            if path.stat().st_size == 0:
                raise LogError("is empty")
            named = [one.where for one in sources if isinstance(one, Measured) and one.where is not None]
            if kind in _TEXT:
                return _read_text(path, layout, sources, named, where)
            wanted = {source.column for source in (*sources, *named, *([where] if where else []))}
            return FileArrays(_READERS[kind](path, wanted))
        except OSError as error:
            raise LogError(f"cannot be read: {error.strerror or error}") from None


def _read_text(
    path: Path, layout: TextTable, sources: Sequence[Source], named: Sequence[Where], where: Where | None
) -> FileArrays:
    delimiter = DELIMITERS.get(layout.delimiter, layout.delimiter)
    numbers = {source.column for source in sources}
    texts = {one.column for one in (*named, *([where] if where else []))}
    try:
        with _opened(path, layout) as lines:
            for _ in range(layout.skip):
                lines.readline()
            header, whole = _header(lines, delimiter, layout.comment, numbers) if layout.header else ([], False)
            places = {one: _place(one, header, layout.header) for one in numbers | texts}
            if any(source.index is not None for source in sources):
                raise LogError("in a text table, a column has no index: give only the name or number of the column")
            rows = _prepared(lines, layout)
    except (UnicodeError, EOFError, gzip.BadGzipFile) as error:
        if not isinstance(error, UnicodeError):
            raise LogError("is not a complete gzip file: was it cut off?") from None
        name = "UTF-8" if layout.encoding == "utf-8-sig" else layout.encoding
        text = f'is not text in {name}: state its encoding under [csv], such as encoding = "latin-1" or "utf-16"'
        raise LogError(f"{text}; or is it a file of another kind?") from None
    first = [_split(line, delimiter) for line in rows[:_LOOKED_AT]]
    if not texts and layout.lines is None:
        _refuse_several(first, header, {places[one] for one in numbers})
    used = {places[one]: f"'{one}'" if isinstance(one, str) else f"number {one}" for one in numbers}
    width = len(header) * whole
    marks = map(str.count, rows, itertools.repeat(delimiter)) if delimiter else map(len, map(str.split, rows))
    # (Of whitespace fields are counted, not delimiters.)
    wide = width > 0 and max(marks, default=0) >= width + (delimiter is None)
    columns = None if texts or wide else _quick(rows, delimiter, list(used))
    if columns is None:
        kept = None if where is None else (where, places[where.column])
        columns = _by_cell(rows, delimiter, used, {places[one] for one in texts}, width, kept)
    called: dict[str | int, list[str]] = {one: [header[place]] for one, place in places.items() if place < len(header)}
    # A row of units stands below the names: no word of it is a number.
    if first and all(_number(text) != _number(text) for text in first[0]):
        for one, names in called.items():
            unit = "".join(first[0][places[one] : places[one] + 1]).strip("()[] ")
            names += [f"{names[0]} ({unit})"] * bool(unit)
    return FileArrays({one: columns[place] for one, place in places.items()}, called)


def _opened(path: Path, layout: TextTable) -> TextIO:
    if path.suffix.lower() != ".gz":
        return path.open(encoding=layout.encoding)
    with path.open("rb") as packed:
        packed.seek(max(0, path.stat().st_size - 4))
        # The end of a gzip file states its size.
        declared = int.from_bytes(packed.read(4), "little")
    try:
        check_size(declared, path.stat().st_size)
    except ValueError as error:
        raise LogError(f"is not a complete gzip file, or {error}") from None
    return gzip.open(path, "rt", encoding=layout.encoding)


def _prepared(lines: TextIO, layout: TextTable) -> list[str]:
    """The lines of the table as tables of numbers have them: without others, remarks, checksums, decimal commas."""
    wanted = None if layout.lines is None else re.compile(layout.lines)
    rows = [line for line in lines if wanted is None or wanted.search(line)]
    if any(layout.comment in line for line in rows):
        rows = [line.split(layout.comment, 1)[0] + "\n" for line in rows]
    rows = [line for line in rows if not line.isspace()]
    tail = re.compile(layout.strip)
    if any(tail.search(line) for line in rows[:_LOOKED_AT]):
        rows = [tail.sub("", line) + "\n" for line in rows]
    if layout.decimal == ",":
        # (A point among decimal commas is a mark of thousands, or the map is wrong: it must not become a decimal sign.)
        commas = str.maketrans({",": ".", ".": _LEADER})
        rows = [line.translate(commas) for line in rows]
    if not rows:
        raise LogError("there are no rows below the header")
    return rows


def _header(lines: TextIO, delimiter: str | None, comment: str, used: Iterable[str | int]) -> tuple[list[str], bool]:
    """The names, with `lines` left at the first row of numbers: the first line with all names of the map, or else the
    first that is not all numbers; either may itself be commented out, and whether it is not."""
    wanted = {one for one in used if isinstance(one, str)}
    begin = lines.tell()
    remark = list[str]()
    for every in ([True] if wanted else []) + [False]:
        lines.seek(begin)
        for _ in range(_PREAMBLE):
            start = lines.tell()
            if not (line := lines.readline()):
                break
            plain = line.strip()
            commented = plain.startswith(comment)
            names = _split(plain.lstrip(comment), delimiter)
            if every:
                if wanted <= set(names):
                    return names, not commented
            elif commented:
                remark = names
            elif plain and any(np.isnan(_number(name)) and name.lower() != "nan" for name in names):
                return names, True
            elif plain:
                lines.seek(start)
                break
    if remark:
        return remark, False
    raise LogError("the file has no line of column names: write header = false under [csv]")


def _split(line: str, delimiter: str | None) -> list[str]:
    fields = line.split(delimiter)
    if delimiter is not None and '"' in line:
        with contextlib.suppress(csv.Error):
            fields = next(csv.reader([line], delimiter=delimiter), list[str]())
    return [field.strip() for field in fields]


def _place(column: str | int, header: list[str], named: bool) -> int:
    if isinstance(column, int):
        if named and column >= len(header):
            raise LogError(f"there is no column number {column}: the header has {len(header)} columns, from 0")
        return column
    if not named:
        raise LogError(
            f"column '{column}' is a name, and the file has no header: give the number of the column, from 0"
        )
    if column not in header:
        apart = {";": ";", "\t": "tab", ",": ",", "|": "|", " ": "whitespace"} if len(header) == 1 else {}
        mark = next((name for mark, name in apart.items() if mark in header[0]), None)
        hint = f'; or is delimiter = "{mark}" missing under [csv]?' if mark else ""
        raise LogError(f"there is no column '{column}'; {instead(column, header)}{hint}")
    places = [str(place) for place, name in enumerate(header) if name == column]
    if len(places) > 1:
        raise LogError(
            f"several columns are named '{column}': give the number of the column instead, {' or '.join(places)} "
            "(numbered from 0)"
        )
    return int(places[0])


def _refuse_several(rows: Sequence[Sequence[str]], header: Sequence[str], used: set[int]) -> None:
    """A table whose first lines are of several kinds, or of several sensors."""
    for place in [k for k, name in enumerate(header) if _WHICH.fullmatch(name)] if header else [0]:
        values = [row[place] for row in rows if len(row) > place]
        kinds = list(dict.fromkeys(values))
        turns = sum(a != b for a, b in itertools.pairwise(values))
        if place in used or not 1 < len(kinds) <= 0.1 * len(values) or turns < 0.2 * len(values):
            continue
        some = ", ".join(kinds[:4])
        numbers = _number(kinds[0]) == _number(kinds[0])
        if header:
            equals = kinds[0] if numbers else f'"{kinds[0]}"'
            raise LogError(
                f"column '{header[place]}' has {len(kinds)} alternating values ({some}): does the table mix rows of "
                "several sensors? Select the rows of one sensor, such as "
                f'where = {{ column = "{header[place]}", equals = {equals} }}, for the whole map or one of its columns'
            )
        if not numbers:
            raise LogError(
                f"the file mixes lines of several kinds ({some}): select the lines of one kind under [csv], such as "
                f"lines = '{re.escape(kinds[0])}'"
            )


def _quick(rows: Sequence[str], delimiter: str | None, used: list[int]) -> dict[int, Array] | None:
    """All rows at once, where every cell is a number, empty or absent; otherwise None."""
    text = "".join(rows)
    # (Words that pandas reads as numbers.)
    if any(word in text for word in ("rue", "alse", "RUE", "ALSE")):
        return None
    pandas: Any = importlib.import_module("pandas")
    # (From 3.1 on numbers are exact without that, and asking for it is deprecated.)
    before = tuple(int(part) for part in pandas.__version__.split(".")[:2]) < (3, 1)
    exact = {"float_precision": "round_trip"} if before else {}
    try:
        with warnings.catch_warnings(action="error"):
            table = pandas.read_csv(
                io.StringIO(text), sep=r"\s+" if delimiter is None else delimiter, header=None, usecols=used,
                dtype=np.float64, quoting=csv.QUOTE_NONE, keep_default_na=False,
                na_values=["", "nan", "NaN", "NAN", "-nan"], **exact,
            )  # fmt: skip
    except (ValueError, OverflowError, Warning):  # (Pandas' own errors are of these.)
        return None
    return {place: table[place].to_numpy() for place in used}


def _by_cell(
    lines: Sequence[str],
    delimiter: str | None,
    used: Mapping[int, str],
    texts: set[int],
    width: int,
    where: tuple[Where, int] | None,
) -> dict[int, Array]:
    """The columns `used` (names by place) as numbers and those of `texts` as text, of the rows `where` alone. Missing
    values and single texts become NaN. Raises `LogError` for a column that is not one of numbers, and for many rows of
    more fields than the header's `width` (0: there is none)."""
    rows = [_split(line, delimiter) for line in lines]
    wide = [row for row in rows if width and any(row[width:])]
    if len(wide) > max(_MANY_UNREAD, _SHARE_UNREAD * len(rows)):
        raise LogError(
            f"{len(wide)} of {len(rows)} rows have more fields than the {width} names of the header, such as "
            f"'{','.join(wide[0])[:60]}': do the numbers contain commas, or does the first column have no name? "
            "Correct the file, or refer to the columns by numbers, with header = false and skip = 1 under [csv]"
        )

    def cells(place: int) -> list[str]:
        return [row[place] if place < len(row) else "" for row in rows]

    if where is not None:
        chosen = rows_where(where[0], np.array(cells(where[1])))
        rows = [row for row, one in zip(rows, chosen.tolist(), strict=True) if one]
    columns: dict[int, Array] = {place: np.array(cells(place)) for place in texts}
    for place, name in used.items():
        if place not in columns:
            columns[place] = _numbers(name, cells(place))
    return columns


def _numbers(name: str, cells: Sequence[str]) -> Array:
    """The numbers of a column, NaN for others."""
    values = np.array([_number(cell) for cell in cells])
    none = not np.isfinite(values).any()
    unread = [cells[row] for row in np.flatnonzero(np.isnan(values)).tolist() if not _MISSING.fullmatch(cells[row])]
    for text in unread:
        for way, meaning in (_CERTAIN | (_LIKELY if none else {})).items():
            if way.fullmatch(text):
                raise LogError(f"column {name} has {meaning}: '{text[:40].replace(_LEADER, '.')}'")
    if unread and none:
        raise LogError(f"column {name} has no numbers, only texts such as '{unread[-1][:40]}'")
    if len(unread) > max(_MANY_UNREAD, _SHARE_UNREAD * len(cells)):
        raise LogError(
            f"column {name}: {len(unread)} of {len(cells)} rows have no number but text, for example "
            f"'{unread[-1][:40]}': is this another notation of numbers? Correct these cells, or leave them empty"
        )
    return values


def rows_where(where: Where, values: Array) -> NDArray[np.bool_]:
    """`(rows,)`: the rows that are taken. Raises `LogError` where there are none."""
    kinds, places = np.unique(values, return_inverse=True)
    meant = np.array([where.means(kind) for kind in kinds.tolist()], bool)
    if not meant.any():
        equals = f'"{where.equals}"' if isinstance(where.equals, str) else f"{where.equals:g}"
        some = ", ".join(str(kind) for kind in kinds[:8].tolist())
        raise LogError(f"where: no row has {equals} in {where.words()}; values in this column include {some}")
    return meant[places]


def _number(text: str) -> float:
    try:
        return np.nan if "_" in text else float(text.replace("\u2212", "-"))
    except ValueError:
        return np.nan


def _check_size(declared: int, path: Path) -> None:
    try:
        check_size(declared, path.stat().st_size)
    except ValueError as error:
        raise LogError(str(error)) from None


def _read_npz(path: Path, wanted: set[str | int]) -> Arrays:
    # Opened here: NumPy leaves the file open where it is no archive.
    kind = "NumPy's .npz (without pickles)"
    with quietly(kind), path.open("rb") as file, np.load(file, allow_pickle=False) as opened:
        # Other arrays are named but not read: they may be large.
        infos = [one for one in opened.zip.infolist() if one.filename.removesuffix(".npy") in wanted]
        _check_size(sum(info.file_size for info in infos), path)
        return {name: opened[name] if name in wanted else np.empty(0) for name in opened.files}


def _read_npy(path: Path, wanted: set[str | int]) -> Arrays:
    with quietly("NumPy's .npy (without pickles)"), path.open("rb") as file:
        values = np.asarray(np.load(file, allow_pickle=False))
    if values.dtype.names is not None:
        return {name: values[name] for name in values.dtype.names}
    if values.ndim != 2:
        raise LogError("the array must have one row for each sample and one column for each quantity")
    return dict(enumerate(values.T))


def _read_matlab(path: Path, wanted: set[str | int]) -> Arrays:
    with path.open("rb") as opened:
        start = opened.read(128)
    if start.startswith(b"MATLAB 7.3") or start[:8] == b"\x89HDF\r\n\x1a\n":
        raise LogError("is a MATLAB 7.3 file: save it again with save(…, '-v7')")
    with quietly("MATLAB v5"):
        reader: Any = importlib.import_module("scipy.io")
        shapes = (shape for _, shape, _ in reader.whosmat(path, appendmat=False))
        _check_size(sum(8 * math.prod(shape) for shape in shapes), path)
        arrays: dict[str, Any] = reader.loadmat(path, appendmat=False, struct_as_record=False)
        numbers = _leaves({name: array for name, array in arrays.items() if not name.startswith("__")})
        return {name: array.ravel() if 1 in array.shape else array for name, array in numbers}


def _leaves(arrays: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, Array]]:
    """The arrays of numbers, those within structs by dotted names."""
    for name, held in arrays.items():
        if not isinstance(held, np.ndarray):
            continue
        values = cast("Array", held)
        if values.dtype.kind in "fiu":
            yield before + name, values
        elif values.dtype == object and values.size == 1:
            # (A struct is a 1 x 1 array of an object with its fields.)
            struct: Any = values.item()
            fields: Sequence[str] = getattr(struct, "_fieldnames", ())
            yield from _leaves({field: getattr(struct, field) for field in fields}, f"{before}{name}.")


def _read_parquet(path: Path, wanted: set[str | int]) -> Arrays:
    parquet = library("pyarrow.parquet", "pyarrow")
    with quietly("Parquet"):
        file = parquet.ParquetFile(path)
        _check_size(8 * file.metadata.num_rows * len(wanted), path)
        arrays: Arrays = {str(name): np.empty(0) for name in file.schema_arrow.names}
        table = file.read(columns=[name for name in arrays if name in wanted])
        for name in table.column_names:
            values: Array = table.column(name).to_numpy()
            # Stamps of a date are counts of its resolution: nanoseconds as a rule.
            arrays[name] = values.astype(np.int64) if values.dtype.kind == "M" else values
        return arrays


_READERS: Final[Mapping[str, Callable[[Path, set[str | int]], Arrays]]] = {
    ".npz": _read_npz,
    ".npy": _read_npy,
    ".mat": _read_matlab,
    ".parquet": _read_parquet,
}
