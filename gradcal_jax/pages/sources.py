"""The sources of a page: a plan, its run, a calibration, a plan to compare with."""

import hashlib
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from gradcal_jax.calibration import Calibration, is_calibration, read_calibration
from gradcal_jax.hardware.run_folder import RunFolder
from gradcal_jax.recipe.recipe import Predicted, Recipe, is_recipe, recipe_of, spec_in
from gradcal_jax.spec.places import places_of, specs_at_places
from gradcal_jax.spec.spec import spec_of
from gradcal_jax.spec.spec_sections import FORMAT, Spec
from gradcal_jax.tables.contracts import Prediction
from gradcal_jax.tables.document import read_text, read_toml

CALIBRATION_IN_RUN = "calibration.toml"


@dataclass(frozen=True)
class Sources:
    """The sources of a page. `plan`: a spec, in the place of a recipe. `paths`: name and SHA-256 of each file; `notes`:
    mismatches between the sources."""

    plan: Spec | None = None
    recipe: Recipe | None = None
    run: RunFolder | None = None
    calibration: Calibration | None = None
    before: Spec | None = None
    before_name: str = ""
    calibration_name: str = ""
    paths: tuple[tuple[str, str], ...] = ()
    notes: tuple[str, ...] = ()

    @cached_property
    def spec(self) -> Spec | None:
        """The spec of the plan, as rounded in a recipe; of a fixture, that of the calibration's place, or the worst."""
        whole = self._whole
        if whole is None or not whole.rig.table.place:
            return whole
        return specs_at_places(whole)[self._place or getattr(self.prediction, "place", None) or ""]

    @cached_property
    def prediction(self) -> Predicted | Prediction:
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


def read_sources(paths: Sequence[Path], *, before: Path | None = None) -> Sources:
    """Read the sources of a page: the folder of a run (with the calibration in it), a recipe or spec, a calibration.

    `before`: a spec, or a recipe, whose plan is compared with. Raises `ValueError` with a remedy.
    """
    parts: dict[str, Any] = {}
    named: list[tuple[str, str]] = []

    def take(kind: str, value: Any, path: Path) -> None:
        if kind in parts:
            words = kind.replace("_", " ")
            raise ValueError(f"{path} is a second {words}: a page shows one run, one recipe and one calibration")
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
        if "calibration" not in parts and (own := calibrations_in(run.path)):
            if len(own) > 1:
                names = ", ".join(path.name for path in own)
                raise ValueError(
                    f"{run.path} has several calibrations ({names}): also name the one that the page is for"
                )
            take_calibration(own[0])
    if "plan" in parts and "recipe" in parts:
        raise ValueError("a page shows one plan, and the recipe already contains its spec: leave out the other spec")
    if not parts:
        raise ValueError("nothing to report: name the folder of a run, a recipe, a spec or a calibration")
    if before is not None and not parts.keys() & {"plan", "recipe"}:
        raise ValueError("a calibration contains no plan to compare with: also name its recipe or its spec")
    if before is not None:
        parts["before"], parts["before_name"] = spec_in(before), before.name
        named.append((before.name, hashlib.sha256(before.read_bytes()).hexdigest()))
    return Sources(**parts, paths=tuple(named), notes=tuple(_misfits(parts)))


def calibrations_in(folder: Path) -> list[Path]:
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


def _misfits(parts: dict[str, Any]) -> list[str]:
    """Sentences on sources that do not belong together."""
    recipe: Recipe | None = parts.get("recipe")
    calibration: Calibration | None = parts.get("calibration")
    run: RunFolder | None = parts.get("run")
    notes: list[str] = []
    if recipe is not None and calibration is not None:
        if (made_by := calibration.provenance.get("recipe")) is None:
            notes.append(
                "the calibration does not state the recipe with which its log was made, so it cannot be compared with "
                "the recipe on this page"
            )
        elif made_by != recipe.fingerprint:
            notes.append(
                f"the calibration's log was made with a different recipe ({made_by[:12]}) than the one on this page "
                f"({recipe.fingerprint[:12]}): prediction and result belong to different plans"
            )
    if run is not None and recipe is not None and run.notes().get("recipe") != recipe.fingerprint:
        notes.append("the run was begun with a different recipe than the one on this page")
    return notes
