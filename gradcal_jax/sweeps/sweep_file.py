"""gradcal-sweep/1: one spec, and which of its keys take which values: a design of experiments over plans.
`templates/sweep.toml` is an example. Nothing here draws or computes: `gradcal_jax.sweeps` does.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import numpy as np
from pydantic import Field

from gradcal_jax import units
from gradcal_jax.recipe.recipe import spec_in
from gradcal_jax.spec import presets
from gradcal_jax.spec.changes import changed, tables_of
from gradcal_jax.spec.spec import parse_spec
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.tables.display import summary
from gradcal_jax.tables.document import TitledFile, parsed, read_text
from gradcal_jax.tables.problems import Problem, SpecError, repeated_names, split_key
from gradcal_jax.tables.quantity import Text
from gradcal_jax.tables.section import Section

FORMAT: Final = "gradcal-sweep/1"
MOST_POINTS: Final = 1_000_000

End = str | float | int


class SweptAxis(Section):
    """`[[axis]]`: keys of the spec that vary together, and their values."""

    name: Text | None = None
    """Name of this axis as a dimension of the results; absent: the last word of the key."""
    key: Text | None = None
    """Key of the spec, such as "plan.gradient"."""
    keys: Annotated[tuple[Text, ...], Field(min_length=1, max_length=1000)] | None = None
    """Several keys that take the same values."""
    section: Literal["sensor", "rig", "plan"] | None = None
    """Instead of a key: name of a whole section that is taken from other specs."""
    values: Annotated[tuple[Any, ...], Field(min_length=1, max_length=100_000)] | None = None
    """List of values. If `section` is set: presets, or paths of specs relative to this file."""
    start: End | None = None
    """First value: a text with a unit, or a plain number."""
    stop: End | None = None
    """Last value: like `start`, a text with a unit or a plain number."""
    count: Annotated[int, Field(strict=True, ge=2, le=100_000)] | None = None
    """Number of values from start to stop, both included."""
    spacing: Literal["linear", "logarithmic"] = "linear"
    """Spacing: linear, or logarithmic."""

    def _problems(self) -> Iterator[Problem]:
        if sum(of is not None for of in (self.key, self.keys, self.section)) != 1:
            yield Problem(("key",), 'give exactly one of "key", "keys" and "section"', kind="missing")
        for text in self.changes:
            try:
                split_key(text)
            except ValueError as error:
                yield Problem(("key",), str(error), text)
        spaced = {name: getattr(self, name) for name in ("start", "stop", "count")}
        if self.values is not None:
            for name, value in spaced.items():
                if value is not None:
                    yield Problem((name,), 'cannot be combined with "values"', value)
        elif None in spaced.values() and self.section is None:
            yield Problem((), 'expected either "values", or "start", "stop" and "count"', kind="missing")
        elif self.section is None:
            try:
                low, high = self._ends()
            except ValueError as error:
                yield Problem((), str(error))
                return
            if low == high:
                yield Problem(("stop",), "must differ from start", self.stop)
            elif self.spacing == "logarithmic" and not (low > 0.0 and high > 0.0):
                yield Problem(("spacing",), "logarithmic spacing needs a start and a stop above zero", self.spacing)
        if self.section is not None and not all(isinstance(value, str) for value in self.values or (None,)):
            message = 'must be names of presets or paths of specs if "section" is set'
            yield Problem(("values",), message, self.values)

    @property
    def changes(self) -> tuple[str, ...]:
        """The keys of the spec that this axis sets."""
        return self.keys or tuple(name for name in (self.key, self.section) if name)

    @property
    def label(self) -> str:
        """What the axis is called in the results: its name, or the last word of its key."""
        return self.name or next(part for part in reversed(split_key(self.changes[0])) if isinstance(part, str))

    @property
    def unit(self) -> str | None:
        """The unit that its values are written in; None for plain numbers and for words."""
        first = self.start if self.values is None else self.values[0]
        if not isinstance(first, str) or self.section is not None:
            return None
        try:
            return units.unit_of(first)
        except ValueError:
            return None

    def _ends(self) -> tuple[float, float]:
        """Start and stop as numbers in `unit`. Errors: `ValueError` for others."""
        low, high = self.number_of(self.start), self.number_of(self.stop)
        if low is None or high is None or isinstance(self.start, str) != isinstance(self.stop, str):
            raise ValueError("start and stop must both be texts with a unit, or both plain numbers")
        return low, high

    def listed(self) -> tuple[object, ...]:
        """All values of the axis, as the spec's file holds them, to twelve digits: what is swept can be written again
        by hand."""
        if self.values is not None:
            return self.values
        assert self.count is not None
        spaced = np.geomspace if self.spacing == "logarithmic" else np.linspace
        low, high = self._ends()
        numbers = [f"{number:.12g}" for number in spaced(low, high, self.count).tolist()]
        if self.unit is not None:
            return tuple(f"{number} {self.unit}" for number in numbers)
        whole = isinstance(self.start, int) and isinstance(self.stop, int)
        return tuple(int(n) if whole and n.lstrip("-").isdigit() else float(n) for n in numbers)

    def number_of(self, value: object) -> float | None:
        """A value in the axis's unit: 60 for "60 deg/s", whatever its SI value rounds to; None for words. Errors:
        `UnitError` for another unit."""
        if isinstance(value, str) and self.unit is not None:
            return float(f"{units.to_unit(units.parse(value, units.dimension_of(self.unit)), self.unit):.12g}")
        if isinstance(value, bool) or not isinstance(value, int | float):
            return None
        return float(value)


class SweepFile(TitledFile):
    """A whole sweep file."""

    format: Literal["gradcal-sweep/1"]
    base: Text
    """A preset, or the path of a spec or recipe relative to this file."""
    do: Literal["predict", "optimise"] = "predict"
    """Command that is carried out for each point."""
    change: dict[str, Any] = Field(default_factory=dict)
    """Keys of the base spec to change at every point, with their new values."""
    axis: Annotated[tuple[SweptAxis, ...], Field(min_length=1, max_length=20)]
    """What is varied."""

    def _problems(self) -> Iterator[Problem]:
        message = 'two axes have this name; give one of them a different "name"'
        yield from repeated_names("axis", "name", [axis.label for axis in self.axis], message)
        seen: set[str] = set()
        for i, axis in enumerate(self.axis):
            if again := seen.intersection(axis.changes):
                yield Problem(("axis", i, "key"), "another axis also sets this key", min(again))
            seen.update(axis.changes)
        if self.count > MOST_POINTS:
            yield Problem(("axis",), f"the sweep has {self.count} points; at most {MOST_POINTS} are possible")

    @property
    def count(self) -> int:
        """How many points the sweep has."""
        return math.prod(axis.count or len(axis.listed()) for axis in self.axis)


@dataclass(frozen=True)
class Sweep:
    """A sweep file, read: `text` as it stands on the disk, `base` the spec with `[change]` made, and the tables of the
    `sections` of other specs, by section and name."""

    file: SweepFile
    text: str
    base: Spec
    sections: Mapping[tuple[str, str], Any]

    __repr__ = summary


def read_sweep(path: str | Path) -> Sweep:
    """Read a sweep file and its base spec: which keys take which values, texts with units.

    Errors: `SpecError` that lists everything wrong with them.
    """
    return parse_sweep(read_text(path), str(path), Path(path).parent)


def parse_sweep(text: str, source: str = "", folder: str | Path = ".") -> Sweep:
    """A sweep from the text of a TOML file; `folder` is where a relative `base` begins. Raises `SpecError`."""
    file = parsed(SweepFile, text, FORMAT, source)
    base = named_spec(file.base, folder, source)
    sections = {
        (axis.section, name): tables_of(named_spec(name, folder, source))[axis.section]
        for axis in file.axis
        if axis.section is not None
        for name in axis.values or ()
    }
    base = changed(base, file.change, source)
    for axis in file.axis:
        if axis.section is None:
            _known(axis, base, source)
    return Sweep(file, text, base, sections)


def named_spec(name: str, folder: str | Path, source: str = "") -> Spec:
    """A preset, or the spec (of a recipe, too) in a file seen from `folder`. Raises `SpecError`."""
    path = Path(folder) / name
    if path.suffix or path.exists():
        return spec_in(path)
    if name in presets.names():
        return parse_spec(presets.text(name), name)
    raise SpecError([Problem((), f'"{name}" is neither a preset nor a file; see gradcal start --list')], source)


def _known(axis: SweptAxis, base: Spec, source: str) -> None:
    """A key that no spec has is a slip, and is said at once, not a thousand times."""
    try:
        changed(base, {key: axis.listed()[0] for key in axis.changes})
    except SpecError as error:
        if slips := [problem for problem in error.problems if problem.kind == "unknown"]:
            raise SpecError(slips, source) from None
