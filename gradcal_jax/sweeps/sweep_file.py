"""gradcal-sweep/1: one spec, and which of its keys take which values: a design of experiments over plans.
`templates/sweep.toml` is an example. Nothing here draws or computes: `gradcal_jax.sweeps` does.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from decimal import Context, Decimal
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import numpy as np
from pydantic import Field, model_validator

from gradcal_jax import units
from gradcal_jax.recipe.recipe import spec_of_either
from gradcal_jax.spec import presets
from gradcal_jax.spec.changes import changed, split_key, tables_of
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.tables.display import summary
from gradcal_jax.tables.document import TitledFile, parsed, read_text, read_toml
from gradcal_jax.tables.problems import Problem, SpecError, repeated_names
from gradcal_jax.tables.quantity import Text
from gradcal_jax.tables.section import Section, refuse

FORMAT: Final = "gradcal-sweep/1"
MOST_POINTS: Final = 1_000_000
_DIGITS: Final = Context(prec=12)

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

    @model_validator(mode="after")
    def _whole(self) -> "SweptAxis":
        problems: list[Problem] = []
        if sum(of is not None for of in (self.key, self.keys, self.section)) != 1:
            problems.append(Problem(("key",), 'give exactly one of "key", "keys" and "section"', kind="missing"))
        if self.section is not None and not all(isinstance(value, str) for value in self.values or (None,)):
            problems.append(
                Problem(("values",), 'must be names of presets or paths of specs if "section" is set', self.values)
            )
        for text in self.changes:
            try:
                split_key(text)
            except ValueError as error:
                problems.append(Problem(("key",), str(error), text))
        limits = [name for name in ("start", "stop", "count") if getattr(self, name) is not None]
        if self.values is not None:
            problems += [Problem((name,), 'cannot be combined with "values"', getattr(self, name)) for name in limits]
        elif None in (self.start, self.stop, self.count):
            problems.append(Problem((), 'expected either "values", or "start", "stop" and "count"', kind="missing"))
        refuse(*problems)
        if self.values is None:
            try:
                self.ends()
            except SpecError:
                raise
            except ValueError as error:
                refuse(Problem((), str(error)))
        return self

    @property
    def changes(self) -> tuple[str, ...]:
        """The keys of the spec that this axis sets."""
        one = self.key or self.section
        return self.keys if self.keys is not None else (() if one is None else (one,))

    @property
    def label(self) -> str:
        """What the axis is called in the results: its name, or the last word of its key."""
        if self.name is not None:
            return self.name
        return next(part for part in reversed(split_key(self.changes[0])) if isinstance(part, str))

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

    def ends(self) -> tuple[float, float]:
        """Start and stop as numbers in `unit`. Raises `SpecError`."""
        assert self.start is not None
        assert self.stop is not None
        low, high = (self._number(name, end) for name, end in (("start", self.start), ("stop", self.stop)))
        if low == high:
            refuse(Problem(("stop",), "must differ from start", self.stop))
        if self.spacing == "logarithmic" and not (low > 0.0 and high > 0.0):
            refuse(Problem(("spacing",), "logarithmic spacing needs a start and a stop above zero", self.spacing))
        return low, high

    def _number(self, name: str, end: End) -> float:
        unit = self.unit
        if isinstance(end, bool) or isinstance(end, str) != (unit is not None):
            refuse(Problem((name,), "start and stop must both be texts with a unit, or both plain numbers", end))
        if not isinstance(end, str):
            return float(end)
        assert unit is not None
        try:
            return _in(end, unit)
        except ValueError as error:
            refuse(Problem((name,), str(error), end))
            raise

    def _written(self, number: float) -> object:
        """A number as the file writes it, to twelve digits: what is swept can be written again by hand."""
        if self.unit is not None:
            return f"{_short(number)} {self.unit}"
        whole = all(isinstance(end, int) for end in (self.start, self.stop))
        return round(number) if whole and abs(number - round(number)) < 1e-9 else float(_short(number))

    def listed(self) -> tuple[object, ...]:
        """All values of the axis, as the spec's file holds them."""
        if self.values is not None:
            return self.values
        assert self.count is not None
        spaced = np.geomspace if self.spacing == "logarithmic" else np.linspace
        return tuple(self._written(float(number)) for number in spaced(*self.ends(), self.count))

    def number_of(self, value: object) -> float | None:
        """A value in the axis's unit, for the results' coordinate; None for words."""
        if isinstance(value, bool):
            return None
        if isinstance(value, int | float):
            return float(value)
        unit = self.unit
        if not isinstance(value, str) or unit is None:
            return None
        try:
            return _in(value, unit)
        except ValueError:
            return None


def _in(text: str, unit: str) -> float:
    """The number of a quantity in a unit: 60 for "60 deg/s", whatever its SI value rounds to."""
    return float(_short(units.to_unit(units.parse(text, units.dimension_of(unit)), unit)))


def _short(number: float) -> str:
    """A float's decimal to twelve digits, without needless ones."""
    rounded = _DIGITS.create_decimal(Decimal(repr(number)))
    return format(rounded.normalize(_DIGITS), "f") if -6 < rounded.adjusted() < 12 or rounded == 0 else f"{rounded:e}"


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

    def _problems(self) -> Iterable[Problem]:
        message = 'two axes have this name; give one of them a different "name"'
        problems = repeated_names("axis", "name", [axis.label for axis in self.axis], message)
        seen: set[str] = set()
        for i, axis in enumerate(self.axis):
            for key in axis.changes:
                if key in seen:
                    problems.append(Problem(("axis", i, "key"), "another axis also sets this key", key))
                seen.add(key)
        if not problems and self.count > MOST_POINTS:
            problems.append(
                Problem(("axis",), f"the sweep has {self.count} points; at most {MOST_POINTS} are possible")
            )
        return problems

    @property
    def count(self) -> int:
        """How many points the sweep has."""
        return math.prod(len(axis.listed()) for axis in self.axis)


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
    base = named_spec(file.base, Path(folder), source)
    sections = {
        (axis.section, name): tables_of(named_spec(name, Path(folder), source))[axis.section]
        for axis in file.axis
        if axis.section is not None
        for name in axis.values or ()
    }
    try:
        if file.change:
            base = changed(base, file.change)
        for axis in file.axis:
            if axis.section is None:
                _known(axis, base)
    except SpecError as error:
        raise SpecError(error.problems, source) from None
    return Sweep(file, text, base, sections)


def named_spec(name: str, folder: Path, source: str = "") -> Spec:
    """A preset, or the spec (of a recipe, too) in a file seen from `folder`. Raises `SpecError`."""
    tables, place = _named(name, folder, source)
    return spec_of_either(tables, place)


def _named(name: str, folder: Path, source: str) -> tuple[Mapping[str, Any], str]:
    path = folder / name
    if path.suffix or path.exists():
        return read_toml(read_text(path), str(path)), str(path)
    if name in presets.names():
        return read_toml(presets.text(name), name), name
    raise SpecError([Problem((), f'"{name}" is neither a preset nor a file; see gradcal start --list')], source)


def _known(axis: SweptAxis, base: Spec) -> None:
    """A key that no spec has is a slip, and is said at once, not a thousand times."""
    trial = {key: axis.listed()[0] for key in axis.changes}
    try:
        changed(base, trial)
    except SpecError as error:
        slips = [
            p
            for p in error.problems
            if p.kind == "unknown" or "there is no" in p.message or "the list has" in p.message
        ]
        if slips:
            raise SpecError(slips) from None
