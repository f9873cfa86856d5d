"""gradcal-recipe/1: an executable plan. Tracks of chamber and table, the predicted residual, the spec.

The tracks follow from the spec inside, whose plan is rounded to the controllers' steps; a file in which they do not was
changed by hand, and is refused. Nothing here imports JAX: `information.prediction` builds a recipe, and this
package has all that a runner needs of it.
"""

import hashlib
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final, Literal

from pydantic import Field

from gradcal_jax import units
from gradcal_jax.recipe.rounding import ControllerSteps
from gradcal_jax.recipe.tracks import ChamberTrack, MotionBlock, Stability, tracks_of
from gradcal_jax.spec.changes import differences, tables_of
from gradcal_jax.spec.spec import spec_of
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.tables.contracts import (
    ParameterRow,
    PlaceRow,
    Prediction,
    RequirementRow,
    Size,
    outcomes,
)
from gradcal_jax.tables.display import whole_text
from gradcal_jax.tables.document import TitledFile, model_of, read_text, read_toml
from gradcal_jax.tables.problems import Problem, SpecError
from gradcal_jax.tables.quantity import Text, Whole
from gradcal_jax.tables.section import Section

FORMAT: Final = "gradcal-recipe/1"


class PredictedParameter(ParameterRow):
    """A coefficient and its predicted standard deviation."""

    std: Size | None = None
    """Standard deviation after the calibration; absent: this plan cannot observe the coefficient."""


class Predicted(Section):
    """The prediction for the rounded plan, as from `gradcal predict`, without the covariance."""

    duration_s: Size
    """Duration of the whole plan (s)."""
    soak_s: Size
    """Total duration of the soaks (s)."""
    motion_s: Size
    """Duration of the ramp (s)."""
    requirements: tuple[RequirementRow, ...] = ()
    """Residuals, one entry for each requirement."""
    parameters: tuple[PredictedParameter, ...] = ()
    """Coefficients with their standard deviations."""
    warnings: tuple[Text, ...] = ()
    """Warnings, in sentences."""
    places: tuple[PlaceRow, ...] = ()
    """For a fixture of several IMUs: residuals at every place; all other results are for the worst place."""
    place: Text | None = None
    """For a fixture of several IMUs: name of the worst place."""

    @classmethod
    def of(cls, prediction: Prediction) -> "Predicted":
        """From the contract."""
        tables = prediction.model_dump(exclude_none=True, exclude={"format", "title", "covariance", "omitted"})
        return cls.model_validate(tables)


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
    rounded: tuple[Text, ...] = ()
    """Changes that rounding made to the plan, one sentence each."""
    made: RecipeOrigin
    """The program that made the recipe."""
    resolution: ControllerSteps
    """Steps of the controllers to which the plan is rounded."""
    stability: Stability
    """Conditions under which a temperature counts as stable."""
    chamber: ChamberTrack
    """What the chamber does."""
    motion: tuple[MotionBlock, ...]
    """What the table does, in blocks."""
    prediction: Predicted
    """Prediction for the rounded plan."""
    optimisation: dict[str, Any] | None = None
    """Record of the optimisation: objective, its value before and after, number of starts, limits."""
    spec: Spec = Field(title="gradcal-spec/1")
    """The spec, with the plan that the recipe executes."""

    __str__ = whole_text

    def _problems(self) -> Iterable[Problem]:
        step = self.resolution.acceleration
        chamber, motion = tracks_of(self.spec, None if step is None else float(step))
        expected, written = (
            {"chamber": track.model_dump(mode="json"), "motion": [block.model_dump(mode="json") for block in blocks]}
            for track, blocks in ((chamber, motion), (self.chamber, self.motion))
        )
        message = (
            "does not agree with the spec in this recipe: to change a plan, change the spec and make the recipe again"
        )
        return [Problem(key, message, value) for key, _, value in differences(expected, written, ())][:5]

    def _shown(self) -> list[str]:
        rows = self.prediction.requirements
        return [
            f"Recipe: {self.title}" if self.title else "Recipe",
            self.status,
            units.times_text(self.prediction.duration_s, self.prediction.soak_s, self.prediction.motion_s),
            f"segments of the chamber: {len(self.chamber.programme)}; cycles of the table: "
            f"{sum(block.repeat for block in self.motion)}",
            outcomes(rows, limits=False).text(),
        ]

    @property
    def duration_s(self) -> float:
        """Duration of the plan, without waiting for stable temperatures."""
        return self.spec.schedule.duration

    @property
    def fingerprint(self) -> str:
        """A hash of the contents, the same on every computer, which a resumed run compares."""
        text = json.dumps(tables_of(self), sort_keys=True, separators=(",", ":"), ensure_ascii=False)
        return hashlib.sha256(text.encode()).hexdigest()


def read_recipe(path: str | Path) -> Recipe:
    """Read a recipe file: tracks in SI (°C), rounded to the controllers' steps, prediction (ppm, deg/h), spec inside.

    Errors: `SpecError` that lists everything wrong with it, and where its tracks do not follow from its spec.
    """
    return parse_recipe(read_text(path), str(path))


def spec_in(path: str | Path) -> Spec:
    """The spec in a file, or inside a recipe, whose plan is the rounded one. Raises `SpecError`."""
    return spec_of_either(read_toml(read_text(path), str(path)), str(path))


def spec_or_recipe(path: str | Path) -> Spec | Recipe:
    """The spec or the recipe in a file. Raises `SpecError`."""
    return _spec_or_recipe_of(read_toml(read_text(path), str(path)), str(path))


def spec_of_either(document: Mapping[str, Any], source: str = "") -> Spec:
    """The spec from the tables of a spec or recipe. Raises `SpecError`."""
    contents = _spec_or_recipe_of(document, source)
    return contents.spec if isinstance(contents, Recipe) else contents


def _spec_or_recipe_of(document: Mapping[str, Any], source: str = "") -> Spec | Recipe:
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
