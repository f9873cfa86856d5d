"""Tables of numbers: CSV and other text (also `.gz`), NumPy's `.npz` and `.npy`, MATLAB v5 files, Parquet."""

import array
import csv
import gzip
import importlib
import io
import itertools
import math
import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final, TextIO, cast

import numpy as np

from gradcal_jax.records.log import Floats, LogError, library, naming, quietly
from gradcal_jax.records.tables import DELIMITERS, Array, Measured, Numbers, Source, TextTable, Where
from gradcal_jax.tables.problems import instead
from gradcal_jax.tables.sizes import check_size

_LOOKED_AT, _PREAMBLE, _BLOCK = 200, 500, 1 << 14
"""Numbers of lines: those at the start that are searched for rows of several sensors or a checksum; those that may
stand above a header; those that are read at once."""
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
_NANS: Final = ["", "nan", "NaN", "NAN", "-nan"]
_TRUTHS: Final = ("rue", "alse", "RUE", "ALSE")
"""Parts of words that pandas reads as numbers."""
_MANY_UNREAD, _SHARE_UNREAD = 20, 0.02
"""If more values of a column (number, share) than this cannot be read as numbers, it is not a numeric column with a few
damaged values."""
_TEXT: Final = (".csv", ".txt", ".tsv", ".dat", ".log", ".asc")
_APART: Final = {";": ";", "\t": "tab", ",": ",", "|": "|", " ": "whitespace"}
_COMMA: Final = re.compile(r"[+-]?\d+,\d+([eE][+-]?\d+)?")
_HEXADECIMAL: Final = re.compile(r"0[xX][0-9a-fA-F]+")
_MINUS: Final = "\u2212"
_LEADER: Final = "\u2024"
"""Replaces the points of a column with decimal commas: no number contains this character."""
_COMMAS: Final = str.maketrans({",": ".", ".": _LEADER})
_POINT: Final = re.compile(rf"[+-]?[\d.{_LEADER}]+{_LEADER}\d[\d.{_LEADER}]*([eE][+-]?\d+)?")
_CERTAIN: Final = (_COMMA, _HEXADECIMAL, _POINT)
"""Patterns of values that are certainly in another notation, and not damaged numbers."""
_WAYS: Final = {
    _COMMA: 'a decimal comma; write decimal = "," under [csv]',
    _POINT: 'a decimal point, although decimal = "," states a decimal comma: is the point a thousands separator? Write '
    "the numbers without it",
    _HEXADECIMAL: "hexadecimal counts; write them as decimal numbers",
    re.compile(
        r"(?=.*[A-Fa-f])[0-9A-Fa-f]{2,16}"
    ): "values that look like hexadecimal counts; write them as decimal numbers",
    re.compile(r"\d{1,4}[-./]\d{1,2}[-./]\d{1,4}.*|\d{1,2}:\d\d(:\d\d.*)?"): (
        "dates or times of day; write them as seconds, in pandas: table = pd.read_csv(file); time = "
        "pd.to_datetime(table[column]); table[column] = (time - time[0]).dt.total_seconds(); table.to_csv(file, "
        "index=False). Or leave out time and give sample_rate"
    ),
}


def read_table(path: Path, layout: TextTable, sources: Sequence[Source], *, where: Where | None = None) -> Numbers:
    """The columns of a file, whose ending tells its kind: .csv, .txt, .tsv, .dat, .log, .asc (text; also with .gz
    behind it), .npz, .npy, .mat (MATLAB up to version 7), .parquet; of the rows `where` alone.
    Errors: `LogError` that names the file.
    """
    kind = path.suffix.lower()
    if kind == ".gz":
        kind = Path(path.stem).suffix.lower()
        kind = kind if kind in _TEXT else ".gz"
    readers: dict[str, Callable[[Path, TextTable, Sequence[Source]], Numbers]] = {
        ".npz": _read_npz,
        ".npy": _read_npy,
        ".mat": _read_matlab,
        ".parquet": _read_parquet,
        **dict.fromkeys(_TEXT, partial(_read_text_table, where=where)),
    }
    if kind not in readers:
        known = ", ".join([*sorted(readers), ".csv.gz"])
        words = f"{path}: unknown file name extension (it determines the kind of file); known are {known}"
        if kind in (".json", ".jsonl", ".ndjson"):
            words += (
                f". Lines of JSON become a table by pandas: pd.read_json({path.name!r}, lines=True)"
                f'.to_csv("{path.stem}.csv", index=False)'
            )
        raise LogError(words)
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
        others = [] if kind in _TEXT else [*_wheres(sources), *([] if where is None else [where])]
        table = readers[kind](path, layout, [*sources, *others])
        if where is not None and kind not in _TEXT:
            table.kept = where.chosen(table.raw(where))
        return table


def _read_text_table(path: Path, layout: TextTable, sources: Sequence[Source], where: Where | None = None) -> Numbers:
    delimiter = DELIMITERS.get(layout.delimiter, layout.delimiter)
    try:
        with _opened(path, layout) as lines:
            for _ in range(layout.skip):
                lines.readline()
            header, whole = _header(lines, layout, delimiter, sources) if layout.header else ([], False)
            used = sorted({_place(source, header, layout.header) for source in sources})
            start = lines.tell()
            first = list(itertools.islice(_tables(iter(lines.readline, ""), layout), _LOOKED_AT))
            lines.seek(start)
            some = [[field.strip() for field in _split(line, delimiter)] for line in first]
            told_apart = where is not None or any(_wheres(sources))
            _refuse_several(some, layout, header, used, told_apart)
            rows = _prepared(lines, layout, first)
            if where is not None:
                rows = _only(rows, where, _place(where, header, layout.header), delimiter)
            names = {place: f"'{header[place]}'" if place < len(header) else f"number {place}" for place in used}
            words = dict.fromkeys(_place(one, header, layout.header) for one in _wheres(sources))
            values, found = _values(rows, delimiter, layout.comment, names, list(words), len(header) * whole)
    except (UnicodeError, EOFError, gzip.BadGzipFile) as error:
        if not isinstance(error, UnicodeError):
            raise LogError("is not a complete gzip file: was it cut off?") from None
        name = "UTF-8" if layout.encoding == "utf-8-sig" else layout.encoding
        text = f'is not text in {name}: state its encoding under [csv], such as encoding = "latin-1" or "utf-16"'
        raise LogError(f"{text}; or is it a file of another kind?") from None
    except OSError as error:
        raise LogError(f"cannot be read: {error.strerror or error}") from None
    by_place = {place: values[:, number] for number, place in enumerate(names)}
    texts = {
        place: np.array(list(found))[values[:, number].astype(np.int64)]
        for number, place in enumerate(words, start=len(names))
    }

    return _OfText(by_place, texts, header, some[0] if some else [], layout.header)


class _OfText(Numbers):
    def __init__(
        self,
        numbers: Mapping[int, Array],
        texts: Mapping[int, Array],
        header: list[str],
        first: Sequence[str],
        named: bool,
    ) -> None:
        super().__init__(lambda source: (texts if isinstance(source, Where) else numbers)[self._place_of(source)])
        self._header, self._named = header, named
        # A row of units stands below the names: no word of it is a number.
        self._units = first if named and all(_number(text) != _number(text) for text in first) else ()

    def _place_of(self, source: Source) -> int:
        return _place(source, self._header, self._named)

    def names(self, source: Source) -> list[str]:
        place = self._place_of(source)
        if place >= len(self._header):
            return []
        name = self._header[place]
        unit = self._units[place].strip("()[] ") if place < len(self._units) else ""
        return [name, f"{name} ({unit})"] if unit else [name]


def _wheres(sources: Iterable[Source]) -> Iterator[Where]:
    """What the columns of several sensors are told apart by."""
    for source in sources:
        if isinstance(source, Measured) and source.where is not None:
            yield source.where


def _opened(path: Path, layout: TextTable) -> TextIO:
    if path.suffix.lower() == ".gz":
        with path.open("rb") as packed:
            packed.seek(max(0, path.stat().st_size - 4))
            # The end of a gzip file states its size.
            _check_size(int.from_bytes(packed.read(4), "little"), path)
        return gzip.open(path, "rt", encoding=layout.encoding)
    return path.open(encoding=layout.encoding)


def _tables(lines: Iterable[str], layout: TextTable) -> Iterator[str]:
    """The lines of the table alone, as they are."""
    wanted = None if layout.lines is None else re.compile(layout.lines)
    for line in lines:
        if (wanted is None or wanted.search(line)) and line.strip() and not line.lstrip().startswith(layout.comment):
            yield line


def _prepared(lines: TextIO, layout: TextTable, some: Sequence[str]) -> Iterable[str]:
    """The lines as tables of numbers have them: without others, checksums, decimal commas."""
    rows: Iterable[str] = lines if layout.lines is None else _tables(lines, layout)
    tail = re.compile(layout.strip)
    if any(tail.search(line) for line in some):
        rows = (tail.sub("", line) + "\n" for line in rows)
    # (A point among decimal commas is a mark of thousands, or the map is wrong: it must not become a decimal sign.)
    return rows if layout.decimal == "." else (line.translate(_COMMAS) for line in rows)


def _only(rows: Iterable[str], where: Where, place: int, delimiter: str | None) -> Iterator[str]:
    """The lines of one of several sensors."""
    meant = dict[str, bool]()
    for line in rows:
        fields = _split(line, delimiter)
        text = fields[place].strip() if place < len(fields) else ""
        if text not in meant:
            meant[text] = where.means(text)
        if meant[text]:
            yield line
    if not any(meant.values()):
        raise where.absent(meant)


def _refuse_several(
    rows: Sequence[Sequence[str]],
    layout: TextTable,
    header: Sequence[str],
    used: Sequence[int],
    told_apart: bool,
) -> None:
    """A table whose first lines are of several kinds, or of several sensors."""
    places = [k for k, name in enumerate(header) if _WHICH.fullmatch(name)] if layout.header else [0]
    for place in () if told_apart or layout.lines is not None else places:
        values = [row[place] for row in rows if len(row) > place]
        kinds = list(dict.fromkeys(values))
        turns = sum(a != b for a, b in itertools.pairwise(values))
        if place in used or not 1 < len(kinds) <= 0.1 * len(values) or turns < 0.2 * len(values):
            continue
        if layout.header:
            equals = kinds[0] if _number(kinds[0]) == _number(kinds[0]) else f'"{kinds[0]}"'
            raise LogError(
                f"column '{header[place]}' has {len(kinds)} alternating values ({', '.join(kinds[:4])}): does the "
                "table mix rows of several sensors? Select the rows of one sensor, such as where = "
                f'{{ column = "{header[place]}", equals = {equals} }}, for the whole map or for one of its columns'
            )
        if not any(_number(kind) == _number(kind) for kind in kinds):
            raise LogError(
                f"the file mixes lines of several kinds ({', '.join(kinds[:4])}): select the lines of one kind "
                f"under [csv], such as lines = '{re.escape(kinds[0])}'"
            )


def _header(
    lines: TextIO, layout: TextTable, delimiter: str | None, sources: Sequence[Source]
) -> tuple[list[str], bool]:
    """The names, with `lines` left at the first row of numbers: the first line with all names of the map, or else the
    first that is not all numbers; either may itself be commented out, and whether it is not."""
    wanted = {source.column for source in sources if isinstance(source.column, str)}
    first = lines.tell()
    for _ in range(_PREAMBLE if wanted else 0):
        if not (line := lines.readline()):
            break
        names = [name.strip() for name in _split(line.strip().lstrip(layout.comment).strip(), delimiter)]
        if wanted <= set(names):
            return names, not line.lstrip().startswith(layout.comment)
    lines.seek(first)
    return _first_names(lines, layout, delimiter)


def _first_names(lines: TextIO, layout: TextTable, delimiter: str | None) -> tuple[list[str], bool]:
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
                return names, True
        elif line:
            continue
        if remark:
            lines.seek(start)
            return [name.strip() for name in _split(remark, delimiter)], False
        raise LogError("the file has no line of column names: write header = false under [csv]")


def _split(line: str, delimiter: str | None) -> list[str]:
    if delimiter is None or '"' not in line:
        return line.split(delimiter)
    try:
        return next(csv.reader([line], delimiter=delimiter), list[str]())
    except csv.Error:
        return line.split(delimiter)


def _place(source: Source, header: list[str], named: bool) -> int:
    if source.index is not None:
        raise LogError(
            f"{source.words()}: in a text table, a column has no index: give only the name or number of the column"
        )
    if isinstance(source.column, int):
        if named and source.column >= len(header):
            raise LogError(f"there is no {source.words()}: the header has {len(header)} columns, numbered from 0")
        return source.column
    if not named:
        raise LogError(f"{source.words()} is a name, and the file has no header: give the number of the column, from 0")
    if source.column not in header:
        apart = next((name for mark, name in _APART.items() if len(header) == 1 and mark in header[0]), None)
        hint = f'; or is delimiter = "{apart}" missing under [csv]?' if apart else ""
        raise LogError(f"there is no {source.words()}; {instead(source.column, header)}{hint}")
    if header.count(source.column) > 1:
        places = " or ".join(str(place) for place, name in enumerate(header) if name == source.column)
        raise LogError(
            f"several columns are named '{source.column}': give the number of the column instead, {places} "
            "(numbered from 0)"
        )
    return header.index(source.column)


def _values(
    lines: Iterable[str],
    delimiter: str | None,
    comment: str,
    names: Mapping[int, str],
    words: Sequence[int],
    width: int,
) -> tuple[Floats, Mapping[str, int]]:
    """The numbers `(rows, names and words)` in columns by their place; those of `words` are numbers of texts in the
    table behind.

    Blocks of numbers and empty cells are read by pandas' compiled reader. In others missing values and texts become
    NaN; the latter are counted and named later. A column without any number, or in another notation of numbers, is an
    error, and so are many rows of more fields than the header's `width` (0: there is none).
    """
    blocks, texts, wide = list[Floats](), dict[str, int](), list[str]()
    odd, unread, readable = dict[int, str](), dict.fromkeys(names, 0), set[int]()
    unbroken = iter(lines)
    while block := list(itertools.islice(unbroken, _BLOCK)):
        if width:
            marks = itertools.repeat(width) if delimiter is None else map(str.count, block, itertools.repeat(delimiter))
            long = (line for line, count in zip(block, marks, strict=False) if count >= width)
            wide += [line for line in long if _is_wide(line, delimiter, comment, width)]
        values = None if words else _quick(block, delimiter, comment, list(names))
        if values is None:
            numbers = array.array("d")
            for line in block:
                if not (plain := line.split(comment, 1)[0].strip()):
                    continue
                fields = [field.strip() for field in _split(plain, delimiter)]
                for place in names:
                    text = fields[place] if place < len(fields) else ""
                    number = _number(text)
                    numbers.append(number)
                    if number == number:
                        readable.add(place)
                    elif not _MISSING.fullmatch(text):
                        unread[place] += 1
                        if not any(way.fullmatch(odd.get(place, "")) for way in _CERTAIN):
                            odd[place] = text
                for place in words:
                    text = fields[place] if place < len(fields) else ""
                    numbers.append(texts.setdefault(text, len(texts)))
            values = np.frombuffer(numbers, np.float64).reshape(-1, len(names) + len(words))
        else:
            readable.update(place for place, column in zip(names, values.T, strict=True) if not np.isnan(column).all())
        blocks.append(values)
    values = np.concatenate(blocks) if blocks else np.empty((0, 1))
    if not len(values):
        raise LogError("there are no rows below the header")
    if len(wide) > max(_MANY_UNREAD, _SHARE_UNREAD * len(values)):
        raise LogError(
            f"{len(wide)} of {len(values)} rows have more fields than the {width} names of the header, such as "
            f"'{wide[0].strip()[:60]}': do the numbers contain commas, or does the first column have no name? "
            "Correct the file, or refer to the columns by numbers, with header = false and skip = 1 under [csv]"
        )
    for place, text in odd.items():
        shown = text[:40].replace(_LEADER, ".")
        for way, meaning in _WAYS.items():
            if way.fullmatch(text) and (place not in readable or way in _CERTAIN):
                raise LogError(f"column {names[place]} has {meaning}: '{shown}'")
        if place not in readable:
            raise LogError(f"column {names[place]} has no numbers, only texts such as '{shown}'")
        if unread[place] > max(_MANY_UNREAD, _SHARE_UNREAD * len(values)):
            raise LogError(
                f"column {names[place]}: {unread[place]} of {len(values)} rows have no number but text, for example "
                f"'{shown}': is this another notation of numbers? Correct these cells, or leave them empty"
            )
    return values, texts


def _is_wide(line: str, delimiter: str | None, comment: str, width: int) -> bool:
    plain = line.split(comment, 1)[0].strip()
    return len(plain) > 0 and any(field.strip() for field in _split(plain, delimiter)[width:])


def _quick(lines: Sequence[str], delimiter: str | None, comment: str, used: list[int]) -> Floats | None:
    """All rows at once, where every cell is a number, empty or absent; otherwise None."""
    text = "".join(lines)
    # (A single letter is found several times faster than a word, and numbers have neither.)
    if any(letter in text for letter in "uUlL") and any(word in text for word in _TRUTHS):
        return None
    pandas: Any = importlib.import_module("pandas")
    # (From 3.1 on numbers are exact without that, and asking for it is deprecated.)
    before = tuple(int(part) for part in pandas.__version__.split(".")[:2]) < (3, 1)
    exact = {"float_precision": "round_trip"} if before else {}
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            table = pandas.read_csv(
                io.StringIO(text), sep=r"\s+" if delimiter is None else delimiter, header=None, usecols=used,
                dtype=np.float64, comment=comment, quoting=csv.QUOTE_NONE, keep_default_na=False, na_values=_NANS,
                **exact,
            )  # fmt: skip
    except (ValueError, OverflowError, Warning):  # (Pandas' own errors are of these.)
        return None
    return table[used].to_numpy()


def _number(text: str) -> float:
    try:
        return np.nan if "_" in text else float(text.replace(_MINUS, "-"))
    except ValueError:
        return np.nan


def _check_size(declared: int, path: Path) -> None:
    try:
        check_size(declared, path.stat().st_size)
    except ValueError as error:
        raise LogError(str(error)) from None


def _read_npz(path: Path, layout: TextTable, sources: Sequence[Source]) -> Numbers:
    wanted = {str(source.column) for source in sources}

    # Opened here: NumPy leaves the file open where it is no archive.
    kind = "NumPy's .npz (without pickles)"
    with quietly(kind), path.open("rb") as file, np.load(file, allow_pickle=False) as opened:
        # Other arrays are named but not read: they may be large.
        infos = opened.zip.infolist()
        declared = sum(info.file_size for info in infos if info.filename.removesuffix(".npy") in wanted)
        _check_size(declared, path)
        return _of_arrays({str(name): opened[name] if name in wanted else np.empty(0) for name in opened.files})


def _read_npy(path: Path, layout: TextTable, sources: Sequence[Source]) -> Numbers:
    with quietly("NumPy's .npy (without pickles)"), path.open("rb") as file:
        values = np.asarray(np.load(file, allow_pickle=False))
    if values.dtype.names is not None:
        return _of_arrays({name: values[name] for name in values.dtype.names})
    if values.ndim != 2:
        raise LogError("the array must have one row for each sample and one column for each quantity")

    def find(source: Source) -> Array:
        if not isinstance(source.column, int) or source.index is not None or source.column >= values.shape[1]:
            raise LogError(f"there is no {source.words()}: the columns are numbered 0 to {values.shape[1] - 1}")
        return values[:, source.column]

    return Numbers(find)


def _read_matlab(path: Path, layout: TextTable, sources: Sequence[Source]) -> Numbers:
    with path.open("rb") as opened:
        start = opened.read(128)
    if start.startswith(b"MATLAB 7.3") or start[:8] == b"\x89HDF\r\n\x1a\n":
        raise LogError("is a MATLAB 7.3 file: save it again with save(…, '-v7')")
    with quietly("MATLAB v5"):
        reader: Any = importlib.import_module("scipy.io")
        shapes = (shape for _, shape, _ in reader.whosmat(path, appendmat=False))
        _check_size(sum(8 * math.prod(shape) for shape in shapes), path)
        arrays: dict[str, Any] = reader.loadmat(path, appendmat=False, struct_as_record=False)
        numbers = dict(_leaves({k: a for k, a in arrays.items() if not k.startswith("__")}))
        return _of_arrays({k: a.ravel() if 1 in a.shape else a for k, a in numbers.items()})


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


def _read_parquet(path: Path, layout: TextTable, sources: Sequence[Source]) -> Numbers:
    parquet = library("pyarrow.parquet", "pyarrow")
    with quietly("Parquet"):
        file = parquet.ParquetFile(path)
        wanted = [str(source.column) for source in sources]
        _check_size(8 * file.metadata.num_rows * len(wanted), path)
        table = file.read(columns=[name for name in file.schema_arrow.names if name in wanted])
        arrays: dict[str, Array] = {str(name): np.empty(0) for name in file.schema_arrow.names}
        for name in table.column_names:
            values: Array = table.column(name).to_numpy()
            # Stamps of a date are counts of its resolution: nanoseconds as a rule.
            arrays[name] = values.astype(np.int64) if values.dtype.kind == "M" else values
        return _of_arrays(arrays)


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
            f"{source.words()}: the array has the shape {values.shape}: give the index of one of its columns"
        )

    return Numbers(find)
