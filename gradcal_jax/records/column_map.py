"""gradcal-columns/1: what the columns of a table of numbers mean, with a unit for every column.

`templates/columns.toml` is a map to start from. A number is (number - zero) × scale in the column's unit; columns of
text and `.npy` are named by number, too, and those of a two-dimensional array by `index`.
Raw counts of unknown scale are kept unchanged with `values = "keep"` under [policy].
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, ClassVar, Final, Literal

from pydantic import Field, ValidationInfo, field_validator

from gradcal_jax import units
from gradcal_jax.records.stamps import Policy
from gradcal_jax.tables.document import parsed, read_text
from gradcal_jax.tables.problems import Problem
from gradcal_jax.tables.quantity import Flag, Frequency, Number, PositiveRate, Text, Whole
from gradcal_jax.tables.section import Section

FORMAT: Final = "gradcal-columns/1"
Name = Annotated[Text, Field(max_length=100)]


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
            return float(str(value)) == self.equals
        except ValueError:
            return False


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

    @property
    def dimension(self) -> str:
        """The dimension of the unit."""
        return "angle" if self.per == "row" else self.DIMENSION

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


class TextTable(Section):
    """Layout of a text file."""

    delimiter: Literal[",", ";", "|", "tab", "whitespace"] = ","
    """Character between columns."""
    header: Flag = True
    """Whether a line names the columns: the first that has all names of the map."""
    skip: Whole = 0
    """Number of lines above the table."""
    decimal: Literal[".", ","] = "."
    """Decimal sign of the numbers."""
    lines: Text = ""
    """If lines of other kinds stand between the rows: the text that those of the table begin with, such as "$VNYMR"."""
    encoding: Text = "utf-8-sig"
    """Encoding of the file's text."""

    def _problems(self) -> Iterator[Problem]:
        if self.decimal == self.delimiter:
            yield Problem(("delimiter",), 'a decimal comma needs another delimiter, such as ";" or "tab"')

    @property
    def mark(self) -> str | None:
        """The character between columns; None: blanks."""
        return {"tab": "\t", "whitespace": None}.get(self.delimiter, self.delimiter)


class StatusColumn(Source):
    """Column of the device's status; rows whose status is not `good` are marked as bad."""

    good: Number = 0.0
    """Value that usable rows have in this column."""


class ClockColumn(Source):
    """Column of a counter of the samples, as a clock."""

    rate: Frequency
    """Number of samples a second."""


class ColumnMap(Section):
    """What the columns of a recording mean."""

    format: Literal["gradcal-columns/1"]
    """Name and version of this file format."""
    name: Name = "sensor"
    """Name or serial number of the sensor."""
    rate: Annotated[dict[Name, RateColumn], Field(max_length=20, default_factory=dict[str, RateColumn])]
    """Columns of the gyros' rates, by axis."""
    force: Annotated[dict[Name, ForceColumn], Field(max_length=20, default_factory=dict[str, ForceColumn])]
    """Columns of the accelerometers' specific forces, by axis."""
    temperature: TemperatureColumn | None = None
    """Column of the temperature."""
    status: StatusColumn | None = None
    """Column of the device's status."""
    sample_rate: Frequency | None = None
    """Stated sample rate; required if there is no `time`."""
    sensor_rate: Frequency | None = None
    """Rate of the sensor's own samples, if each row of the recording is a single sample (such as every 400th one);
    leave this key out if each row is the mean of several samples."""
    full_scale: PositiveRate | None = None
    """Rate at which the gyros saturate."""
    simulated: Flag = False
    """Whether the data are simulated."""
    time: TimeColumn | None = None
    """Column of the sensor's time."""
    clock: ClockColumn | None = None
    """Instead of `time`: a counter of the samples, such as `{ column = "index", rate = "100 Hz" }`."""
    host_time: TimeColumn | None = None
    """Column of the computer's time."""
    standstill: Source | None = None
    """Column that is true at rest and false in motion, or that has the index of the standstill (negative in
    motion)."""
    table_angle: Annotated[dict[Name, AngleColumn], Field(max_length=20, default_factory=dict[str, AngleColumn])]
    """Columns of the table's angles, by axis."""
    table_rate: Annotated[dict[Name, RateColumn], Field(max_length=20, default_factory=dict[str, RateColumn])]
    """Columns of the table's rates, by axis."""
    interpolate: Flag = False
    """Set this key if different channels are in different rows: the rows with rates are used, and the other channels
    are interpolated."""
    where: Where | None = None
    """If the rows of several sensors are mixed: selects the rows of one sensor, such as `{ column = "id", equals = 1
    }`."""
    csv: TextTable = TextTable()
    """Layout of a text file."""
    policy: Policy = Policy()
    """What to do with each kind of fault in the recording."""

    def _problems(self) -> Iterator[Problem]:
        if not self.rate:
            yield Problem(("rate",), "this key is missing; name at least one axis", kind="missing")
        if self.time is not None and self.clock is not None:
            yield Problem(("clock",), "cannot be combined with `time`: keep one of them")
        if self.time is None and self.clock is None and self.sample_rate is None:
            message = 'give the column of the time, or the sample rate as in sample_rate = "100 Hz"'
            yield Problem(("time",), message, kind="missing")
        if not self.interpolate and any(
            isinstance(one, Measured) and one.where is not None for one in self.named().values()
        ):
            text = "expected true, because columns that are selected by `where` are in different rows"
            yield Problem(("interpolate",), text, self.interpolate)
        if self.table_angle and self.table_rate and list(self.table_angle) != list(self.table_rate):
            yield Problem(("table_rate",), "must name the same axes as table_angle")

    def named(self) -> dict[str, Source]:
        """The columns by the names that they have in an examination."""
        named: dict[str, Source | None] = {f"gyro {axis}": column for axis, column in self.rate.items()}
        named |= {f"accelerometer {axis}": column for axis, column in self.force.items()}
        named |= {f"table angle {axis}": one for axis, one in self.table_angle.items()}
        named |= {f"table rate {axis}": one for axis, one in self.table_rate.items()}
        named |= {
            "temperature": self.temperature,
            "time": self.time or self.clock,
            "host time": self.host_time,
            "standstill": self.standstill,
        }
        named["marked"] = self.status
        return {name: column for name, column in named.items() if column is not None}

    def sources(self) -> list[Source]:
        """The columns."""
        return list(self.named().values())

    def wheres(self) -> list[Where]:
        """The columns that select rows."""
        own = [one.where for one in self.sources() if isinstance(one, Measured)]
        return [one for one in (*own, self.where) if one is not None]


def parse_column_map(text: str, source: str = "") -> ColumnMap:
    """The column map (gradcal-columns/1) in a TOML text: what columns of a recording mean, and in which units.

    Errors: `SpecError` with every fault.
    """
    return parsed(ColumnMap, text, FORMAT, source)


def read_column_map(path: str | Path) -> ColumnMap:
    """The column map in a file. Raises `SpecError` with every fault."""
    return parse_column_map(read_text(path), str(path))
