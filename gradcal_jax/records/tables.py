"""Columns of tables of numbers, with units, and how a text table is laid out; `table_readers` reads them.

A column is identified by its name or number; the user gives its unit, scale and zero. The maps (`importers`, `points`),
which consist of these sections, refuse columns without units.
"""

import itertools
import re
from collections.abc import Callable, Iterable, Iterator
from typing import Annotated, Any, ClassVar, Final, Literal, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field, ValidationInfo, field_validator

from gradcal_jax import units
from gradcal_jax.records.log import Floats, LogError
from gradcal_jax.tables.problems import Problem
from gradcal_jax.tables.quantity import Flag, Number, Text, Whole
from gradcal_jax.tables.section import Section

Array = NDArray[Any]
Name = Annotated[Text, Field(max_length=100)]

DELIMITERS: Final = {"tab": "\t", "whitespace": None}
"""Words for delimiters, and the characters that they stand for."""


class Source(Section):
    """A column of a table."""

    column: Text | Whole
    """Name of the column, or its number, counted from 0."""
    index: Whole | None = None
    """Number of the column in a two-dimensional array, counted from 0."""

    def words(self) -> str:
        """In words, for messages."""
        name = f"number {self.column}" if isinstance(self.column, int) else f"'{self.column}'"
        return f"column {name}" + ("" if self.index is None else f", index {self.index}")


class Where(Source):
    """Selects the rows of one sensor, if several sensors share the columns."""

    equals: Text | Number
    """Value that the column has in the rows of this sensor."""

    def means(self, value: object) -> bool:
        """Whether this is the value of the rows that are taken."""
        if isinstance(self.equals, str):
            return str(value) == self.equals
        try:
            return float(cast("float | str", value)) == self.equals
        except ValueError:
            return False

    def absent(self, values: Iterable[object]) -> LogError:
        """The error where no row has the value, but these."""
        equals = f'"{self.equals}"' if isinstance(self.equals, str) else f"{self.equals:g}"
        some = ", ".join(str(value) for value in itertools.islice(values, 8))
        return LogError(f"where: no row has {equals} in {self.words()}; values in this column include {some}")

    def chosen(self, values: Array) -> NDArray[np.bool_]:
        """The rows that are taken. Raises `LogError` where there are none."""
        kinds, places = np.unique(values, return_inverse=True)
        meant = np.array([self.means(kind) for kind in kinds.tolist()], bool)
        if not meant.any():
            raise self.absent(kinds.tolist())
        return meant[places]


class Measured(Source):
    """A column of a quantity, whose value is (number − zero) × scale in the unit."""

    DIMENSION: ClassVar[str]

    per: Literal["second", "row"] = "second"
    """"row" for a rate whose values are the angles turned since the row before; `unit` is then that of an angle."""
    unit: Text
    """Unit of the values, after `zero` and `scale` are applied."""
    scale: Number = 1.0
    """Factor by which the numbers are multiplied, after `zero` is subtracted."""
    zero: Number = 0.0
    """Number in the column that stands for the value zero."""
    where: Where | None = None
    """If several sensors share the column: selects the rows of this sensor, such as `{ column = "id", equals = "gyro"
    }`; needs `interpolate = true`."""

    @field_validator("scale")
    @classmethod
    def _counts(cls, value: float) -> float:
        if value == 0.0:
            raise ValueError("must not be zero")
        return value

    @field_validator("unit")
    @classmethod
    def _measures(cls, unit: str, info: ValidationInfo) -> str:
        per_row = info.data.get("per") == "row"
        if per_row and cls.DIMENSION != "angular rate":
            raise ValueError('only a column of a rate can have per = "row"')
        if cls.DIMENSION == "temperature" and unit.strip().lower() in ("k", "kelvin", "kelvins"):
            raise ValueError('for a column in kelvins, write unit = "degC" and zero = 273.15')
        units.parse(f"1 {unit}", "angle" if per_row else cls.DIMENSION)
        return unit


class TimeColumn(Measured):
    """A column of time stamps."""

    DIMENSION = "time"


class RateColumn(Measured):
    """A column of an angular rate."""

    DIMENSION = "angular rate"


class ForceColumn(Measured):
    """A column of a specific force."""

    DIMENSION = "acceleration"


class AngleColumn(Measured):
    """A column of an angle."""

    DIMENSION = "angle"


class TemperatureColumn(Measured):
    """A column of a temperature."""

    DIMENSION = "temperature"


def _pattern(value: str) -> str:
    try:
        re.compile(value)
    except re.error as error:
        raise ValueError(f"is not a regular expression: {error}") from None
    plain = re.sub(r"\\.|\[[^\]]*\]", "x", value)
    if len(re.findall(r"[*+]|\{\d*,\}", plain)) > 1 or re.search(r"\)[*+{]|\(\?P?=", plain):
        raise ValueError("at most one *, + or {n,}, and none behind a group: others can take hours for one line")
    return value


Pattern = Annotated[str, Field(min_length=1, max_length=200), AfterValidator(_pattern)]


class TextTable(Section):
    """Layout of a text file."""

    delimiter: Annotated[str, Field(min_length=1, max_length=10)] = ","
    """Character between columns: ",", ";", "tab" or "whitespace"."""
    header: Flag = True
    """Whether a line names the columns. This line is the first one that has all names of the map; other lines may stand
    above it."""
    comment: Annotated[str, Field(min_length=1, max_length=1)] = "#"
    """Lines that begin with this text are left out."""
    skip: Whole = 0
    """Number of lines above the table."""
    decimal: Literal[".", ","] = "."
    """Decimal sign of the numbers."""
    lines: Pattern | None = None
    """Regular expression, such as "^.VNYMR": below the header, only lines that match it are read."""
    strip: Pattern = r"\*[0-9A-Fa-f]{2,8}\s*$"
    """Regular expression of a text that is removed from every line; a checksum after an asterisk is always removed."""
    encoding: Text = "utf-8-sig"
    """Encoding of the file's text."""

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
        if value not in DELIMITERS and (len(value) != 1 or value in ' "\n\r' or value.isalnum()):
            raise ValueError('expected one character such as "," or ";", or "tab" or "whitespace"')
        return value


class Numbers:
    """Named or numbered columns of equal length; of the rows `kept`, where it is set."""

    def __init__(self, find: Callable[[Source], Array]) -> None:
        self._find = find
        self.rows: int | None = None
        self.kept: NDArray[np.bool_] | None = None

    def raw(self, source: Source) -> Array:
        """One column of any type, all rows."""
        return self._find(source)

    def names(self, source: Source) -> list[str]:
        """What the file calls a column; with the unit behind it that stands in a row of its own, if there is one."""
        return [source.column] if isinstance(source.column, str) else []

    def numbers(self, source: Source) -> Array:
        """One column, unconverted (integers stay integers)."""
        values = self.raw(source)
        if values.dtype.kind not in "biuf":
            raise LogError(f"{source.words()} has no numbers")
        if self.rows is None:
            self.rows = len(values)
        if len(values) != self.rows:
            raise LogError(f"{source.words()} has {len(values)} rows, and the columns before it have {self.rows}")
        return values if self.kept is None else values[self.kept]

    def measured(self, source: Measured) -> Floats:
        """One column in SI; angles per row stay angles."""
        dimension = "angle" if source.per == "row" else source.DIMENSION
        values = self.numbers(source).astype(np.float64)
        at_zero = units.parse(f"0 {source.unit}", dimension)  # not 0 for degF
        factor = units.parse(f"1 {source.unit}", dimension) - at_zero
        if source.where is not None:
            of_all = source.where.chosen(self.raw(source.where))
            values[~(of_all if self.kept is None else of_all[self.kept])] = np.nan
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
