"""The contents of a gradcal-log/1 for other programs: the netCDF's dimensions, variables with units, attributes."""

from collections.abc import Mapping
from types import GenericAlias
from typing import Annotated, Any, Final, Literal, cast

from pydantic import Field, create_model

from gradcal_jax.records.log import NEEDED, OF_READINGS, VARIABLES, LogVariable
from gradcal_jax.tables.quantity import Text, Whole
from gradcal_jax.tables.section import Section


def _described(name: str, variable: LogVariable) -> Any:
    """The type and default of a variable's description."""
    dimensions = GenericAlias(tuple, tuple(Literal[dimension] for dimension in variable.dimensions))  # pyright: ignore[reportInvalidTypeArguments]
    words = f"{variable.words[:1].upper()}{variable.words[1:]}."
    fields: dict[str, Any] = {
        "description": (Text | None, Field(None, description="In words.")),  # pyright: ignore[reportOperatorIssue]
        "dimensions": (dimensions, Field(description="Dimensions of the variable.")),
        "units": (Literal[variable.unit], Field(description="Its unit.")),
    }
    title = "".join(part.capitalize() for part in name.split("_")) + "Variable"
    model = cast("Any", create_model(title, __base__=Section, __doc__=words, **fields))
    return (model, Field(description=words)) if name in NEEDED else (model | None, Field(None, description=words))


_ALL: Final[Mapping[str, LogVariable]] = {**VARIABLES, **OF_READINGS}
Variables: Any = create_model(
    "Variables",
    __base__=Section,
    __doc__="The variables `time`, `rate` and `stretch_start` are required.",
    **{name: _described(name, variable) for name, variable in _ALL.items()},
)


class Labels(Section):
    """Coordinates of the dimensions."""

    unit: Annotated[tuple[Text, ...], Field(min_length=1)]
    """Serial numbers or names of the sensors."""
    axis: tuple[Text, ...]
    """Names of the gyros' axes; empty if the sensors have only accelerometers."""
    force_axis: tuple[Text, ...] = ()
    """Names of the accelerometers' axes."""
    table_axis: tuple[Text, ...] = ()
    """Names of the table's axes."""


class LogContents(Section):
    """gradcal-log/1: a netCDF-4 file with these variables and global attributes.

    `rows_removed` (JSON in the file) gives, for each reason, the number of rows of the source that were removed;
    `findings` (JSON) lists the faults of the recording, and `provenance` (JSON) has texts by name. A specific force is
    +1 g along an axis that points up at rest. Rates and specific forces are means since the previous row."""

    format: Literal["gradcal-log/1"]
    """Name and version of this file format."""
    labels: Labels
    """Coordinates."""
    variables: Variables  # pyright: ignore[reportInvalidTypeForm]
    """Variables."""
    rows: Whole
    """Number of rows."""
    rows_read: Whole
    """Number of rows of the source."""
    rows_removed: dict[str, Whole] = Field(default_factory=dict)
    """Number of rows of the source that were removed, by reason (JSON in the file)."""
    simulated: Literal[0, 1]
    """1 if the data are simulated."""
    provenance: dict[str, str] = Field(default_factory=dict)
    """Texts by name (JSON in the file)."""
