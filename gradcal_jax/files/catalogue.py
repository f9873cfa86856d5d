"""gradcal-catalogue/1: sensors, rigs, requirements and plans; every combination gets a recipe.

    format = "gradcal-catalogue/1"
    [design]                                  # as in a spec; `minimise` is the requirement's
    free   = ["duration", "peak_rate"]
    starts = 8
    [[sensor]]
    name   = "tactical"
    base   = "tactical-mems"                  # a preset, or the path of a spec, seen from this file: its [sensor]
    change = { angle_random_walk = "0.1 deg/sqrt(h)" }        # keys below [sensor]
    [[rig]]
    name   = "30 arcsec"
    base   = "rig-30arcsec"
    [[requirement]]
    name     = "scale factor"
    base     = "tactical-mems"                # all its [[requirement]]; or written here as `of = [ { … } ]`
    minimise = "scale factor"
    [[plan]]
    name   = "100 min"
    base   = "tactical-mems"
    change = { gradient = "1 K/min" }
    design = { starts = 16 }                  # beyond [design], for this plan

A plan is the start of a search: its duration, temperatures and kind of motion. The bases are all specs of one axis, or
all of an IMU.
"""

import itertools
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import Field

from gradcal_jax.display import summary
from gradcal_jax.files.changes import patched, spec_of, tables_of
from gradcal_jax.files.document import TitledFile, parsed, read_text
from gradcal_jax.files.mission import missions_from
from gradcal_jax.files.problems import Problem, SpecError, repeated_names
from gradcal_jax.files.quantity import Text
from gradcal_jax.files.section import Section
from gradcal_jax.files.spec_sections import Spec
from gradcal_jax.files.sweep import named_spec

FORMAT: Final = "gradcal-catalogue/1"
MOST_CASES: Final = 10_000
_SPEC: Final = "gradcal-spec/1"


class Entry(Section):
    """A sensor, a rig or a plan: a section of a base spec, with some of its keys changed."""

    name: Text
    """Of the entry."""
    base: Text
    """A preset, or the path of a spec, seen from this file."""
    change: dict[str, Any] = Field(default_factory=dict)
    """Changed keys of its section."""


class PlanEntry(Entry):
    """A plan, and changes of the catalogue's [design] for its search."""

    design: dict[str, Any] = Field(default_factory=dict)
    """Changed keys of [design] for this plan."""


class RequirementEntry(Section):
    """Requirements on the calibration: a base spec's, or those of the catalogue itself."""

    name: Text
    """Of the entry."""
    minimise: Text
    """The requirement that the designs minimise."""
    base: Text | None = None
    """A preset or the path of a spec, whose requirements are taken."""
    of: Annotated[tuple[dict[str, Any], ...], Field(min_length=1, max_length=100)] | None = None
    """Requirements written here."""

    def _problems(self) -> Iterator[Problem]:
        if (self.base is None) == (self.of is None):
            yield Problem(("base",), 'give either "base" or "of"', kind="missing")


class CatalogueFile(TitledFile):
    """A whole catalogue."""

    format: Literal["gradcal-catalogue/1"]
    design: dict[str, Any] = Field(default_factory=dict)
    """As in a spec, without `minimise`."""
    sensor: Annotated[tuple[Entry, ...], Field(min_length=1, max_length=1000)]
    """Sensors."""
    rig: Annotated[tuple[Entry, ...], Field(min_length=1, max_length=1000)]
    """Rigs."""
    requirement: Annotated[tuple[RequirementEntry, ...], Field(min_length=1, max_length=1000)]
    """Requirements."""
    plan: Annotated[tuple[PlanEntry, ...], Field(min_length=1, max_length=1000)]
    """Plans, from which the searches begin."""

    def _problems(self) -> Iterator[Problem]:
        kinds: tuple[str, ...] = ("sensor", "rig", "requirement", "plan")
        count = 1
        for kind in kinds:
            names = [slug(entry.name) for entry in getattr(self, kind)]
            count *= len(names)
            yield from repeated_names(kind, "name", names, "another one is called this, or nearly this")
        if count > MOST_CASES:
            yield Problem((), f"makes {count} recipes; at most {MOST_CASES}")


@dataclass(frozen=True)
class CatalogueCase:
    """One combination. `spec` is its spec, or None with the `failure` that says why it has none."""

    names: tuple[str, str, str, str]
    spec: Spec | None
    failure: str = ""

    @property
    def slug(self) -> str:
        """The name of its files."""
        return "__".join(slug(name) for name in self.names)


@dataclass(frozen=True)
class Catalogue:
    """A catalogue file, read, with its cases in order: sensor, rig, requirement, plan, the last fastest."""

    file: CatalogueFile
    text: str
    cases: tuple[CatalogueCase, ...]

    __repr__ = summary


def slug(name: str) -> str:
    """A name for files: small letters, digits, hyphens; units' signs in words."""
    words = {"°": " deg", "″": " arcsec", "′": " arcmin", "√": " sqrt ", "µ": "u"}
    name = name.translate(str.maketrans(words))
    return re.sub(r"[^a-z0-9.]+", "-", name.casefold()).strip("-.") or "case"


def read_catalogue(path: str | Path) -> Catalogue:
    """Read a catalogue and all its bases: sensors, rigs, requirements and plans, quantities as text with units.

    Errors: `SpecError` that lists everything wrong with them.
    """
    return parse_catalogue(read_text(path), str(path), Path(path).parent)


def parse_catalogue(text: str, source: str = "", folder: str | Path = ".") -> Catalogue:
    """A catalogue from the text of a TOML file; `folder` is where relative bases begin. Raises `SpecError`.

    A combination that is no spec (a table too slow for the sensor's range, say) is a case with a failure, not an error.
    """
    file = parsed(CatalogueFile, text, FORMAT, source)
    with missions_from(Path(folder)):
        return Catalogue(file, text, tuple(_cases(file, Path(folder), source)))


def _cases(file: CatalogueFile, folder: Path, source: str) -> Iterator[CatalogueCase]:
    bases: dict[str, Spec] = {}

    def base_of(name: str) -> Spec:
        if name not in bases:
            bases[name] = named_spec(name, folder, source)
        return bases[name]

    def section(entry: Entry, kind: str, place: int) -> Any:
        base, tables, problems = base_of(entry.base), dict[str, Any](), ()
        try:
            tables = patched(base, {f"{kind}.{key}": value for key, value in entry.change.items()})
            spec_of(tables)
        except SpecError as error:
            problems = error.problems
        # A section that does not fit the base's others may fit other sections of the catalogue.
        own = [p for p in problems if p.key[:1] == (kind,)]
        if own:
            raise SpecError([p.under(kind, place, "change") for p in own], source)
        return tables[kind]

    sensors, rigs, plans = (
        [section(entry, kind, i) for i, entry in enumerate(getattr(file, kind))] for kind in ("sensor", "rig", "plan")
    )
    requirements: list[Any] = []
    for i, entry in enumerate(file.requirement):
        of_base = tables_of(base_of(entry.base)).get("requirement", []) if entry.base is not None else ()
        rows = [dict(row) for row in entry.of or of_base]
        names = [row.get("name") for row in rows]
        if entry.minimise not in names:
            message = f"is none of its requirements: {', '.join(map(str, names)) or 'there are none'}"
            raise SpecError([Problem(("requirement", i, "minimise"), message, entry.minimise)], source)
        requirements.append(rows)
    places = itertools.product(*(range(len(x)) for x in (sensors, rigs, requirements, plans)))
    for s, r, q, p in places:
        names = (file.sensor[s].name, file.rig[r].name, file.requirement[q].name, file.plan[p].name)
        design = {**file.design, **file.plan[p].design, "minimise": file.requirement[q].minimise}
        document: Mapping[str, Any] = {
            "format": _SPEC,
            "title": ", ".join(names),
            "sensor": sensors[s],
            "rig": rigs[r],
            "requirement": requirements[q],
            "plan": plans[p],
            "design": design,
        }
        try:
            yield CatalogueCase(names, spec_of(document))
        except SpecError as error:
            yield CatalogueCase(names, None, " ".join(str(error).split()))
