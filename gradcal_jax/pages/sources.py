"""The sources of a page: a plan, its run, a calibration."""

import hashlib
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from gradcal_jax.calibration.file import Calibration, is_calibration, read_calibration
from gradcal_jax.hardware.run_folder import RunFolder
from gradcal_jax.recipe.recipe import Recipe, is_recipe, recipe_of
from gradcal_jax.spec.contracts import Prediction
from gradcal_jax.spec.places import places_of, specs_at_places
from gradcal_jax.spec.spec import spec_of
from gradcal_jax.spec.spec_sections import FORMAT, Spec
from gradcal_jax.tables.document import read_text, read_toml

CALIBRATION_IN_RUN = "calibration.toml"


@dataclass(frozen=True)
class Sources:
    """The sources of a page. `plan`: a spec, in the place of a recipe. `paths`: name and SHA-256 of each file."""

    plan: Spec | None = None
    recipe: Recipe | None = None
    run: RunFolder | None = None
    calibration: Calibration | None = None
    calibration_name: str = ""
    paths: tuple[tuple[str, str], ...] = ()

    @cached_property
    def spec(self) -> Spec | None:
        """The spec of the plan, as rounded in a recipe; of a fixture, that of the calibration's place, or the worst."""
        whole = self._whole
        if whole is None or not whole.rig.table.place:
            return whole
        return specs_at_places(whole)[self._place or self.prediction.place or ""]

    @cached_property
    def prediction(self) -> Prediction:
        """The prediction of the plan: a recipe's own, or that of its spec."""
        whole = self._whole
        assert whole is not None
        if self.recipe is not None and not whole.rig.table.place:
            return self.recipe.prediction
        from gradcal_jax.information.prediction import predict

        return predict(whole, limits=True, place=self._place)

    @property
    def _whole(self) -> Spec | None:
        return self.plan if self.recipe is None else self.recipe.spec

    @property
    def _place(self) -> str | None:
        """The place of the calibration's IMU in the fixture."""
        whole = self._whole
        if whole is None or self.calibration is None or not (name := self.calibration.provenance.get("unit")):
            return None
        names = [name] if self.run is None else [device.name for device in self.run.rig().imu]
        return places_of(whole, names if name in names else [name])[name]

    @property
    def misfits(self) -> list[str]:
        """Sentences on sources that do not belong together."""
        made: dict[str, Any] = {}
        if self.calibration is not None:
            made["the calibration"] = self.calibration.provenance.get("recipe")
        if self.run is not None:
            made["the run"] = self.run.notes().get("recipe")
        own = None if self.recipe is None else self.recipe.fingerprint
        return [
            f"{what} was made with a different recipe than the one on this page, or does not state its recipe: "
            "prediction and result may belong to different plans"
            for what, by in made.items()
            if own not in (None, by)
        ]


def read_sources(paths: Sequence[Path]) -> Sources:
    """Read the sources of a page: the folder of a run (with the calibration in it), a recipe or spec, a calibration.
    Raises `ValueError` with a remedy."""
    parts: dict[str, Any] = {}
    named: list[tuple[str, str]] = []

    def take(kind: str, value: Any, path: Path) -> None:
        if kind in parts:
            raise ValueError(f"{path} is a second {kind}: a page shows one run, one plan and one calibration")
        parts[kind] = value
        if path.is_file():
            named.append((path.name, hashlib.sha256(path.read_bytes()).hexdigest()))

    def take_calibration(path: Path) -> None:
        take("calibration", read_calibration(path), path)
        parts["calibration_name"] = str(path)

    for path in paths:
        if path.is_dir():
            folder = RunFolder(path)
            folder.notes()
            take("run", folder, path)
            continue
        document = read_toml(read_text(path), str(path))
        if document.get("format") == FORMAT:
            take("plan", spec_of(document, str(path)), path)
        elif is_recipe(document):
            take("recipe", recipe_of(document, str(path)), path)
        elif is_calibration(document):
            take_calibration(path)
        else:
            raise ValueError(f"{path} is neither the folder of a run, nor a spec, a recipe or a calibration")
    run: RunFolder | None = parts.get("run")
    if run is not None:
        if "recipe" not in parts:
            take("recipe", run.recipe(), run.path / "recipe.toml")
        if "calibration" not in parts and (own := _calibrations_in(run.path)):
            if len(own) > 1:
                names = ", ".join(path.name for path in own)
                raise ValueError(f"{run.path} has several calibrations ({names}): also name one; each has its own page")
            take_calibration(own[0])
    if "plan" in parts and "recipe" in parts:
        raise ValueError("a page shows one plan, and the recipe already contains its spec: leave out the other spec")
    if not parts:
        raise ValueError("nothing to report: name the folder of a run, a recipe, a spec or a calibration")
    return Sources(**parts, paths=tuple(named))


def _calibrations_in(folder: Path) -> list[Path]:
    """The calibrations in a run's folder: `CALIBRATION_IN_RUN` alone, or all of other names."""
    if (usual := folder / CALIBRATION_IN_RUN).is_file():
        return [usual]
    found: list[Path] = []
    for path in sorted(folder.glob("*.toml")):
        # A file that cannot be read is no calibration; what it is meant to be does not matter here.
        with suppress(ValueError, OSError):
            if is_calibration(read_toml(read_text(path), str(path))):
                found.append(path)
    return found
