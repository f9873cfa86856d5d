"""What a gradcal-log/1 holds, for other programs: the netCDF's dimensions, variables with their units, attributes."""

from typing import Annotated, Any, Literal

from pydantic import Field

from gradcal_jax.files.quantity import Text, Whole
from gradcal_jax.files.section import Section

PerSample = tuple[Literal["time"]]
PerUnit = tuple[Literal["unit"], Literal["time"]]
PerAxis = tuple[Literal["unit"], Literal["time"], Literal["axis"]]
PerTableAxis = tuple[Literal["time"], Literal["table_axis"]]


class _Variable(Section):
    description: Text | None = None


class Stamps(_Variable):
    """Strictly increasing, of the sensor's clock (`time`) or the computer's (`host_time`)."""

    dimensions: PerSample
    units: Literal["s"]


class Rates(_Variable):
    """Angular rates: of a row, the mean since the row before."""

    dimensions: PerAxis
    units: Literal["rad s-1"]


class Temperatures(_Variable):
    """Of the sensors."""

    dimensions: PerUnit
    units: Literal["degC"]


class TableAngles(_Variable):
    """Not wrapped."""

    dimensions: PerTableAxis
    units: Literal["rad"]


class TableRates(_Variable):
    """Of the table's axes."""

    dimensions: PerTableAxis
    units: Literal["rad s-1"]


class Standstills(_Variable):
    """Number of the standstill that a row belongs to; -1 while the table moves."""

    dimensions: PerSample
    units: Literal["1"]


class Statuses(_Variable):
    """0: usable; otherwise bits: 1 no rate, 2 saturated, 4 marked, 8 no temperature, 16 it is frozen, 32 left out."""

    dimensions: PerUnit
    units: Literal["1"]


class StretchStarts(_Variable):
    """The rows at which unbroken stretches begin; the first is 0."""

    dimensions: tuple[Literal["stretch"]]
    units: Literal["1"]


class Variables(Section):
    """Of these, `time`, `rate` and `stretch_start` must be there."""

    time: Stamps
    rate: Rates
    stretch_start: StretchStarts
    temperature: Temperatures | None = None
    table_angle: TableAngles | None = None
    table_rate: TableRates | None = None
    standstill: Standstills | None = None
    host_time: Stamps | None = None
    status: Statuses | None = None


class Labels(Section):
    """Coordinates: serial numbers or names of the sensors, names of their axes and of the table's."""

    unit: Annotated[tuple[Text, ...], Field(min_length=1)]
    axis: Annotated[tuple[Text, ...], Field(min_length=1)]
    table_axis: tuple[Text, ...] = ()


class LogContents(Section):
    """gradcal-log/1: a netCDF-4 file with these variables and global attributes.

    `rows_removed` (JSON in the file) counts by reason the rows of the source that could not be kept; `findings` (JSON)
    are the faults found, `provenance` (JSON) texts by name. `simulated` is 1 where no real sensor made the data.
    """

    format: Literal["gradcal-log/1"]
    labels: Labels
    variables: Variables
    rows: Whole
    rows_read: Whole
    rows_removed: dict[str, Whole] = Field(default_factory=dict)
    simulated: Literal[0, 1]
    provenance: dict[str, str] = Field(default_factory=dict)


def contents(dataset: Any) -> LogContents:
    """The description of an opened log (an xarray dataset). Raises `ValueError` where it is none."""
    import json

    names = ["time", *map(str, dataset.data_vars)]
    variables = {
        name: {"dimensions": tuple(map(str, dataset[name].dims)), "units": str(dataset[name].attrs.get("units", "1"))}
        for name in names
    }
    labels = {
        name: tuple(str(label) for label in dataset[name].values)
        for name in ("unit", "axis", "table_axis")
        if name in dataset.coords
    }
    return LogContents.model_validate(
        {
            "format": str(dataset.attrs.get("format")),
            "labels": labels,
            "variables": variables,
            "rows": int(dataset.sizes["time"]),
            "rows_read": int(dataset.attrs.get("rows_read", 0)),
            "rows_removed": json.loads(str(dataset.attrs.get("rows_removed", "{}"))),
            "simulated": int(dataset.attrs.get("simulated", 0)),
            "provenance": json.loads(str(dataset.attrs.get("provenance", "{}"))),
        }
    )
