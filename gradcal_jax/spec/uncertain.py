"""`uncertain`: the range of a noise figure around its nominal value, and the tables of such figures.

standard_deviation = "1 deg/h"
correlation_time   = "120 s"
uncertain          = "factor 2"                                              # of all figures beside it
uncertain          = { correlation_time = ["1 min", "20 min"] }              # or of each by name
"""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, ClassVar, Final, cast

from pydantic import BeforeValidator

from gradcal_jax.tables.problems import Problem, SpecError, one_of
from gradcal_jax.tables.quantity import Quantity, Text
from gradcal_jax.tables.section import Section, refuse
from gradcal_jax.units import UnitError, unit_of

_FACTOR: Final = re.compile(r"factor\s+([0-9]+(?:\.[0-9]*)?)")
_LARGEST: Final = 1000.0

Ends = tuple[Text, Text]


def _understood(value: object) -> object:
    """One message for a value that is neither of the two."""

    def known(entry: object) -> bool:
        ends = cast("Sequence[object]", entry) if isinstance(entry, list | tuple) else ()
        return isinstance(entry, str) or (len(ends) == 2 and all(isinstance(end, str) for end in ends))

    entries = cast("Mapping[str, object]", value).values() if isinstance(value, Mapping) else [None]
    if not (isinstance(value, str) or all(known(entry) for entry in entries)):
        raise ValueError('expected "factor 2", or a table that gives "factor 2" or [least, largest] for each figure')
    return cast("object", value)


Uncertain = Annotated[Text | dict[str, Text | Ends], BeforeValidator(_understood)]


class UncertainSection(Section):
    """A table of noise figures with a key `uncertain`: "factor 2" for all of them, or a table that gives "factor 2" or
    [least, largest] for each figure."""

    FIGURES: ClassVar[tuple[str, ...]] = ()

    uncertain: Uncertain | None = None
    """Ranges of the noise figures: "factor 2" for all of them, or a table that gives "factor 2" or [least, largest] for
    each figure."""

    def _problems(self) -> Iterator[Problem]:
        try:
            self.ranges()
        except SpecError as error:
            yield from error.problems

    def ranges(self) -> dict[str, tuple[Quantity, Quantity]]:
        """The least and the largest value (SI) of each uncertain figure. Errors: `SpecError`."""
        if self.uncertain is None:
            return {}
        there = [name for name in self.FIGURES if getattr(self, name)]
        if isinstance(self.uncertain, str):
            return {name: self._range(("uncertain",), name, self.uncertain) for name in there}
        unknown = [("uncertain", name) for name in self.uncertain if name not in there]
        known = f"expected {one_of(there)}" if there else "the table has no such figure"
        message = f"is not a figure of this table that can be uncertain; {known}"
        refuse(*(Problem(key, message) for key in unknown))
        return {name: self._range(("uncertain", name), name, value) for name, value in self.uncertain.items()}

    def _range(self, key: tuple[str, ...], name: str, value: str | Ends) -> tuple[Quantity, Quantity]:
        nominal: Quantity = getattr(self, name)
        if isinstance(value, str):
            match = _FACTOR.fullmatch(value.strip())
            factor = float(match.group(1)) if match else math.nan
            if not 1.0 < factor <= _LARGEST:
                refuse(Problem(key, 'expected "factor 2" (a factor above 1), or [least, largest]', value))
            ends = [Quantity.of(nominal * by, unit_of(nominal.text)) for by in (1.0 / factor, factor)]
            return ends[0], ends[1]
        ends: list[Quantity] = []
        for i, text in enumerate(value):
            try:
                ends.append(Quantity.read(text, nominal.dimension))
            except UnitError as error:
                refuse(Problem((*key, i), str(error), text))
        if not 0.0 < ends[0] <= nominal <= ends[1]:
            refuse(Problem(key, f"the stated value, {nominal}, must lie within this range", list(value)))
        return ends[0], ends[1]


def figures_of(key: str, table: object) -> dict[str, tuple[Quantity, Quantity]]:
    """The least and the largest value (SI) of every uncertain figure of a table and of those in it, by its key."""
    figures: dict[str, tuple[Quantity, Quantity]] = {}
    if isinstance(table, UncertainSection):
        figures |= {f"{key}.{name}": ends for name, ends in table.ranges().items()}
    if isinstance(table, Section):
        for name, value in table:
            figures |= figures_of(f"{key}.{name}", value)
    elif isinstance(table, tuple):
        for i, entry in enumerate(cast("tuple[object, ...]", table)):
            figures |= figures_of(f"{key}[{i}]", entry)
    return figures
