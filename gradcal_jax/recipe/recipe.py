"""gradcal-recipe/1: an executable plan.

A recipe is a spec, whose plan is rounded to the controllers' steps, with its prediction; the tracks follow from the
spec, and are not in the file. Nothing here imports JAX: `design.recipe_of_plan` builds a recipe, and this package has
all that a runner needs of it.
"""

import hashlib
import json
from collections.abc import Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any, Final, Literal

from pydantic import Field

from gradcal_jax import units
from gradcal_jax.recipe.bench_tables import show
from gradcal_jax.recipe.tracks import ChamberSegment, MotionBlock, Stability, Tracks, tracks_of
from gradcal_jax.spec.changes import tables_of
from gradcal_jax.spec.contracts import Prediction, outcomes
from gradcal_jax.spec.spec import spec_of
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.tables.document import TitledFile, model_of, read_text, read_toml
from gradcal_jax.tables.problems import Problem, SpecError
from gradcal_jax.tables.quantity import Text, Whole
from gradcal_jax.tables.section import Section

FORMAT: Final = "gradcal-recipe/1"


class RecipeOrigin(Section):
    """The program that made the recipe."""

    by: Text
    """Name and version of the program."""
    versions: dict[str, str]
    """Versions of the packages that it used."""
    seed: Whole | None = None
    """Seed of the search for the plan; absent: there was no search."""


class Recipe(TitledFile):
    """A recipe: a plan in executable form."""

    format: Literal["gradcal-recipe/1"]
    status: Text
    """How the plan was made, in a sentence ("not optimised", "converged: …")."""
    notes: tuple[Text, ...] = ()
    """Notes on the plan, in sentences; some state differences between the plan and what the controllers execute."""
    made: RecipeOrigin
    """The program that made the recipe."""
    stability: Stability
    """Conditions under which a temperature counts as stable."""
    prediction: Prediction
    """Prediction for the rounded plan, without the covariance."""
    optimisation: dict[str, Any] | None = None
    """Record of the optimisation: objective, its value before and after, number of starts, limits."""
    spec_fingerprint: Text
    """A hash of the spec, which one that was changed by hand does not have."""
    spec: Spec = Field(title="gradcal-spec/1")
    """The spec, with the plan that the recipe executes."""

    def _problems(self) -> Iterator[Problem]:
        if self.spec_fingerprint != fingerprint_of(self.spec):
            message = "was changed by hand, and the prediction is of another plan: make the recipe again, from a spec"
            yield Problem(("spec",), message)

    def __str__(self) -> str:
        return show(self)

    def _shown(self) -> list[str]:
        rows, figures = self.prediction.requirements, self.prediction
        return [
            f"Recipe: {self.title}" if self.title else "Recipe",
            self.status,
            units.times_text(figures.duration_s, figures.soak_s, figures.motion_s),
            outcomes(rows, limits=False).text(),
        ]

    @cached_property
    def tracks(self) -> Tracks:
        """What chamber and table do."""
        return tracks_of(self.spec)

    @property
    def chamber(self) -> tuple[ChamberSegment, ...]:
        """What the chamber does."""
        return self.tracks.chamber

    @property
    def motion(self) -> tuple[MotionBlock, ...]:
        """What the table does, in blocks."""
        return self.tracks.motion

    @property
    def duration_s(self) -> float:
        """Duration of the plan, without waiting for stable temperatures."""
        return self.spec.schedule.duration

    @property
    def fingerprint(self) -> str:
        """A hash of the contents, the same on every computer, which a resumed run compares."""
        return fingerprint_of(self)


def fingerprint_of(contents: Section) -> str:
    """A hash of the contents of a file, the same on every computer."""
    text = json.dumps(tables_of(contents), sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    return hashlib.sha256(text.encode()).hexdigest()


def read_recipe(path: str | Path) -> Recipe:
    """Read a recipe file: prediction (ppm, deg/h), and the spec inside, rounded to the controllers' steps.

    Errors: `SpecError` that lists everything wrong with it, and where its spec was changed by hand.
    """
    return parse_recipe(read_text(path), str(path))


def spec_in(path: str | Path) -> Spec:
    """The spec in a file, or inside a recipe, whose plan is the rounded one. Raises `SpecError`."""
    contents = spec_or_recipe(path)
    return contents.spec if isinstance(contents, Recipe) else contents


def spec_or_recipe(path: str | Path) -> Spec | Recipe:
    """The spec or the recipe in a file. Raises `SpecError`."""
    document, source = read_toml(read_text(path), str(path)), str(path)
    return recipe_of(document, source) if is_recipe(document) else spec_of(document, source)


def parse_recipe(text: str, source: str = "") -> Recipe:
    """A recipe from the text of a TOML file; `source` names it in messages. Raises `SpecError`."""
    return recipe_of(read_toml(text, source), source)


def recipe_of(document: Mapping[str, Any], source: str = "") -> Recipe:
    """A recipe from tables as TOML gives them. Raises `SpecError` that lists everything wrong."""
    if document.get("format") == "gradcal-spec/1":
        message = "this file is a spec; make a recipe from it: gradcal optimise SPEC --steps 0 -o recipe.toml"
        raise SpecError([Problem(("format",), message, document["format"])], source)
    return model_of(Recipe, document, FORMAT, source)


def is_recipe(document: Mapping[str, Any]) -> bool:
    """Whether tables are a recipe of any version."""
    version = document.get("format")
    return isinstance(version, str) and version.split("/")[0] == FORMAT.split("/")[0]
