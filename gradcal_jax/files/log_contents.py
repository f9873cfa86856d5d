"""The contents of a gradcal-log/1 for other programs: the netCDF's dimensions, variables with units, attributes."""

from typing import Annotated, Generic, Literal, TypeVar

from pydantic import Field

from gradcal_jax.files.quantity import Text, Whole
from gradcal_jax.files.section import Section

Dimensions = TypeVar("Dimensions")
Unit = TypeVar("Unit")
PerSample = tuple[Literal["time"]]
PerUnit = tuple[Literal["unit"], Literal["time"]]
PerAxis = tuple[Literal["unit"], Literal["time"], Literal["axis"]]
PerForceAxis = tuple[Literal["unit"], Literal["time"], Literal["force_axis"]]
PerTableAxis = tuple[Literal["time"], Literal["table_axis"]]


class _Variable(Section, Generic[Dimensions, Unit]):
    description: Text | None = None
    """In words."""
    dimensions: Dimensions
    """Dimensions of the variable."""
    units: Unit
    """Its unit."""


class Stamps(_Variable[PerSample, Literal["s"]]):
    """Strictly increasing, of the sensor's clock (`time`) or the computer's (`host_time`)."""


class Rates(_Variable[PerAxis, Literal["rad s-1"]]):
    """Angular rates: of a row, the mean since the row before."""


class Forces(_Variable[PerForceAxis, Literal["m s-2"]]):
    """Specific forces: +1 g along an axis that points up at rest; of a row, the mean since the row before."""


class Temperatures(_Variable[PerUnit, Literal["degC"]]):
    """Of the sensors."""


class TableAngles(_Variable[PerTableAxis, Literal["rad"]]):
    """Not wrapped."""


class TableRates(_Variable[PerTableAxis, Literal["rad s-1"]]):
    """Of the table's axes."""


class Standstills(_Variable[PerSample, Literal["1"]]):
    """Number of the standstill that a row belongs to; -1 while the table moves."""


class Mountings(_Variable[PerSample, Literal["1"]]):
    """Of the mountings of the unit's spec the number, from 0."""


class Statuses(_Variable[PerUnit, Literal["1"]]):
    """0: usable; otherwise bits: 1 no rate, 2 saturated, 4 marked, 8 no temperature, 16 it is frozen, 32 left out,
    64 no specific force, 128 a value is frozen, 256 far from its neighbours.
    """


class StretchStarts(_Variable[tuple[Literal["stretch"]], Literal["1"]]):
    """The rows at which unbroken stretches begin; the first is 0."""


class Variables(Section):
    """Of these, `time`, `rate` and `stretch_start` must be there."""

    time: Stamps
    """Of the sensor's clock."""
    rate: Rates
    """Output of the gyros."""
    stretch_start: StretchStarts
    """Begins of unbroken stretches."""
    specific_force: Forces | None = None
    """Output of the accelerometers."""
    temperature: Temperatures | None = None
    """Of the sensors."""
    table_angle: TableAngles | None = None
    """Of the table's axes."""
    table_rate: TableRates | None = None
    """Of the table's axes."""
    standstill: Standstills | None = None
    """Number of the standstill of each row."""
    mounting: Mountings | None = None
    """Number of the unit's mounting."""
    host_time: Stamps | None = None
    """Of the computer's clock."""
    status: Statuses | None = None
    """Whether a row is usable."""


class Labels(Section):
    """Coordinates."""

    unit: Annotated[tuple[Text, ...], Field(min_length=1)]
    """Serial numbers or names of the sensors."""
    axis: tuple[Text, ...]
    """Names of their gyro axes; none where they have accelerometers alone."""
    force_axis: tuple[Text, ...] = ()
    """Names of their accelerometers' axes."""
    table_axis: tuple[Text, ...] = ()
    """Names of the table's axes."""


class LogContents(Section):
    """gradcal-log/1: a netCDF-4 file with these variables and global attributes. A checksum of all bytes may follow the
    data, where other programs ignore it.

    `rows_removed` (JSON in the file) counts by reason the rows of the source that could not be kept; `findings` (JSON)
    are the faults found, `provenance` (JSON) texts by name. `simulated` is 1 where no real sensor made the data.
    """

    format: Literal["gradcal-log/1"]
    """Name and version of this file format."""
    labels: Labels
    """Coordinates."""
    variables: Variables
    """Variables."""
    rows: Whole
    """Number of rows."""
    rows_read: Whole
    """Rows of the source."""
    rows_removed: dict[str, Whole] = Field(default_factory=dict)
    """Rows of the source that could not be kept, counted by reason (JSON in the file)."""
    simulated: Literal[0, 1]
    """1 where no real sensor made the data."""
    provenance: dict[str, str] = Field(default_factory=dict)
    """Texts by name (JSON in the file)."""
