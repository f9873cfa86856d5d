"""Tables of points: a sensor's output at a temperature and a reference rate, the data of the standard method.

A row a point; text, .npz, .npy, .mat or netCDF (.nc), where columns are variables. The map of the columns,
gradcal-points/1, is alike to that of a recording (`importers`): `templates/points.toml` is one to start from.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

import numpy as np

from gradcal_jax.records.log import Floats, LogError, naming
from gradcal_jax.records.table_readers import read_table
from gradcal_jax.records.tables import Name, RateColumn, Source, TemperatureColumn, TextTable
from gradcal_jax.spec import presets
from gradcal_jax.tables.document import model_of, read_text, read_toml
from gradcal_jax.tables.quantity import Flag
from gradcal_jax.tables.section import Section

FORMAT: Final = "gradcal-points/1"

EXAMPLE: Final = presets.template("points.toml")


class PointMap(Section):
    """Meaning of the columns in a table of points."""

    format: Literal["gradcal-points/1"]
    """Name and version of this file format."""
    name: Name = "sensor"
    """Name or serial number of the sensor."""
    axis: Name = "x"
    """Name of the sensor's axis."""
    simulated: Flag = False
    """Whether the data are simulated."""
    temperature: TemperatureColumn
    """Column of the temperature."""
    reference_rate: RateColumn
    """Column of the rate of the table."""
    output: RateColumn
    """Column of the sensor's output."""
    sigma: RateColumn | None = None
    """Column of the output's standard deviation; absent: it follows from the noise in the spec."""
    csv: TextTable = TextTable()
    """Layout of a text file."""

    def sources(self) -> Iterator[Source]:
        """Every column that the map names."""
        yield from filter(None, (self.temperature, self.reference_rate, self.output, self.sigma))


@dataclass(frozen=True)
class RatePoints:
    """Points of one axis, `(n,)` each: °C, rad/s; `sigma` of the output, or None where it is not known."""

    unit: str
    axis: str
    temperature_c: Floats
    reference_rad_per_s: Floats
    output_rad_per_s: Floats
    sigma_rad_per_s: Floats | None
    source: str
    simulated: bool


def parse_point_map(text: str, source: str = "") -> PointMap:
    """The map (gradcal-points/1) in a TOML text. Errors: `SpecError` with every fault."""
    return model_of(PointMap, read_toml(text, source), FORMAT, source)


def read_points(path: str | Path, columns: PointMap | str | Path) -> RatePoints:
    """A table of points by its map, or by the map in a file. Errors: `LogError` and `SpecError` with sentences."""
    path = Path(path)
    if not isinstance(columns, PointMap):
        columns = parse_point_map(read_text(columns), str(columns))
    table = read_table(path, columns.csv, list(columns.sources()), netcdf=True)
    with naming(path):
        temperature = table.measured(columns.temperature)
        reference, output = (table.measured(c) for c in (columns.reference_rate, columns.output))
        sigma = None
        if columns.sigma is not None:
            sigma = table.measured(columns.sigma.model_copy(update={"zero": 0.0}))
            if not np.all(sigma > 0.0):
                raise LogError(f"sigma in row {int(np.argmin(sigma > 0.0))} must be above zero")
        for words, values in (("temperature", temperature), ("reference rate", reference), ("output", output)):
            if not (finite := np.isfinite(values)).all():
                raise LogError(f"the {words} of row {np.argmin(finite)} is not a number: leave this row out")
        # Except for its bias, a sensor's output is the table's rate: a factor of a hundred is a wrong unit.
        slope = float(output @ reference / (reference @ reference)) if reference.any() else 1.0
        if not 0.5 < abs(slope) < 2.0:
            raise LogError(
                f"the output is {slope:.3g} times the reference: does one of them have another unit or scale?"
            )
    series = (temperature, reference, output, sigma)
    return RatePoints(columns.name, columns.axis, *series, path.name, columns.simulated)
