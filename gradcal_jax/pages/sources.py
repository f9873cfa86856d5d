"""The sources of a page (a plan, its run, a calibration, a plan to compare with), and what their numbers rest on."""

import hashlib
import json
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from gradcal_jax.calibration import Calibration, is_calibration, read_calibration
from gradcal_jax.hardware.run_folder import RunFolder
from gradcal_jax.recipe.recipe import Predicted, Recipe, is_recipe, recipe_of, spec_in
from gradcal_jax.spec.absent import absent_terms
from gradcal_jax.spec.bench import Rig
from gradcal_jax.spec.places import places_of, specs_at_places
from gradcal_jax.spec.sensor import Sensor
from gradcal_jax.spec.spec import spec_of
from gradcal_jax.spec.spec_sections import FORMAT, Spec
from gradcal_jax.tables.contracts import Prediction
from gradcal_jax.tables.document import read_text, read_toml

CALIBRATION_IN_RUN = "calibration.toml"


@dataclass(frozen=True)
class Sources:
    """The sources of a page. `plan`: a spec, in the place of a recipe. `limits`: the proven lower limits, by
    requirement. `paths`: name and SHA-256 of each file; `notes`: mismatches between the sources."""

    plan: Spec | None = None
    recipe: Recipe | None = None
    run: RunFolder | None = None
    calibration: Calibration | None = None
    before: Spec | None = None
    before_name: str = ""
    calibration_name: str = ""
    hidden_truth: dict[str, Any] | None = None
    limits: dict[str, float] = field(default_factory=dict[str, float])
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


def read_sources(paths: Sequence[Path], *, before: Path | None = None, limits: Path | None = None) -> Sources:
    """Read the sources of a page: the folder of a run (with the calibration in it), a recipe or spec, a calibration.

    `before`: a spec, or a recipe, whose plan is compared with; `limits`: the output of `gradcal limit --json`. Raises
    `ValueError` with a remedy.
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
        parts["hidden_truth"] = _hidden_truth(run)
    if "plan" in parts and "recipe" in parts:
        raise ValueError("a page shows one plan, and the recipe already contains its spec: leave out the other spec")
    if not parts:
        raise ValueError("nothing to report: name the folder of a run, a recipe, a spec or a calibration")
    if (before is not None or limits is not None) and not parts.keys() & {"plan", "recipe"}:
        raise ValueError("a calibration contains no plan to compare with: also name its recipe or its spec")
    if before is not None:
        parts["before"], parts["before_name"] = spec_in(before), before.name
        named.append((before.name, hashlib.sha256(before.read_bytes()).hexdigest()))
    if limits is not None:
        parts["limits"] = _limits(limits)
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


def _limits(path: Path) -> dict[str, float]:
    try:
        rows: list[dict[str, Any]] = json.loads(read_text(path))
        # A slice raises for an object, which would otherwise be read as an empty list.
        return {str(row["name"]): float(row["certified"]) for row in rows[:]}
    except (ValueError, TypeError, KeyError):
        raise ValueError(f"{path} is not an output of `gradcal limit --json`") from None


def _hidden_truth(run: RunFolder) -> dict[str, Any] | None:
    path = run.path / "hidden_truth.json"
    if not path.is_file() or not run.notes().get("simulated"):
        return None
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except ValueError:
        raise ValueError(f"{path} is damaged: remove it from the folder, or repeat the rehearsal") from None


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


def assumptions(spec: Spec | None, calibration: Calibration | None) -> list[tuple[str, str]]:
    """The figures behind the numbers: those of a plan's spec, with what it leaves out, or of a calibration."""
    if spec is not None:
        left_out = "not stated in the spec, so typical figures of the class are used: "
        omitted = [(term.key, left_out + term.typical) for term in absent_terms(spec)]
        return [*stated_figures(spec), *omitted]
    noise = None if calibration is None else calibration.noise
    names = () if noise is None else ("angle_random_walk", "rate_random_walk", "velocity_random_walk")
    return _stated((name.replace("_", " "), getattr(noise, name)) for name in names)


def stated_figures(spec: Spec) -> list[tuple[str, str]]:
    """The figures that a spec states, by the names that error budgets have for them."""
    return [*_of_sensor(spec.sensor), *_of_rig(spec.rig)]


def _of_sensor(sensor: Sensor) -> list[tuple[str, str]]:
    """The figures of every channel, and those of all channels."""
    rows: list[tuple[str, Any]] = []
    for kind, triad in (("gyro", sensor.gyro), ("accelerometer", sensor.accelerometer)):
        if triad is None:
            continue
        # White noise has a name of its own in either kind, a process that of its kind where it is not a gyro's.
        own = "" if kind == "gyro" else f"{kind} "
        white = ("angle random walk", "velocity random walk")
        rows += [(name, getattr(triad, name.replace(" ", "_"), None)) for name in white]
        processes = {"bias instability": triad.drift, "scale-factor instability": triad.scale_factor_instability}
        rows += [
            (own + name, f"{p.standard_deviation}, correlation time {p.correlation_time}")
            for name, several in processes.items()
            for p in several
        ]
        gradient, thermometer = triad.bias_temperature_gradient, triad.thermometer_noise
        priors = {name: getattr(getattr(triad, name), "prior", None) for name in type(triad).model_fields}
        known = "; ".join(f"{name.replace('_', ' ')} {prior}" for name, prior in priors.items() if prior)
        rows += [
            (own + "temperature measurement", thermometer and str(thermometer.standard_deviation)),
            (own + "prior knowledge", known or None),
            (own + "rate random walk", getattr(triad, "rate_random_walk", None)),
            (own + "turn-on bias", triad.turn_on_bias),
            # Of an estimated one what is known before.
            (own + "bias from dT/dt", getattr(gradient, "prior", gradient)),
        ]
    rows += [
        ("sample clock error", sensor.clock_text),
        ("offset of the temperature", sensor.temperature_offset),
        ("lag of the temperature", sensor.temperature_lag),
        ("thermal lag", sensor.thermal_lag),
    ]
    return _stated(rows)


def _of_rig(rig: Rig) -> list[tuple[str, str]]:
    """The figures of site and table; if there are several axes, those of each axis."""
    from gradcal_jax.information.error_budget import BESIDE_THE_AXIS
    from gradcal_jax.information.gears import SCALE_OF_ANGLE

    table = rig.table
    rows: list[tuple[str, Any]] = [
        ("rate accuracy", table.rate_accuracy),
        ("latitude", None if rig.site.is_unknown else rig.site.latitude),
        ("Earth's rate", "up to 15.04 deg/h" if rig.site.is_unknown else None),
        ("gravity", rig.site.gravity_accuracy or None),
        ("tilt of the base", table.tilt or None),
        ("azimuth of the base", table.azimuth or None),
    ]
    several = len(table.axis) > 1
    for axis in table.axis:
        of, angle = f"{axis.name}: " * several, axis.angle
        rows += [
            (of + "reading noise", angle.reading_noise or None),
            (of + "standstill offset", angle.standstill_offset or None),
            (of + "timing error", angle.timing_error or None),
            (of + SCALE_OF_ANGLE, angle.scale_error or None),
            (of + "backlash", angle.backlash or None),
            (of + "angles between the table's axes", axis.orthogonality or None),
        ]
        rows += [(f"{of}encoder's error that repeats {h.order} times per turn", h.amplitude) for h in angle.harmonics]
    hung, name = table.mounting, "mounting" if several else BESIDE_THE_AXIS
    rows += [(name + f" {k + 1}" * (len(hung) > 1), m.accuracy or None) for k, m in enumerate(hung)]
    return _stated(rows)


def _stated(rows: Iterable[tuple[str, Any]]) -> list[tuple[str, str]]:
    """The rows that have a value, in words."""
    return [(name, str(value)) for name, value in rows if value is not None]


def provenance_rows(sources: Sources) -> list[tuple[str, str]]:
    """Fingerprints, versions, seeds and names of files."""
    from gradcal_jax.information.verdicts import versions_of

    rows: list[tuple[str, str]] = []
    recipe, calibration, run = sources.recipe, sources.calibration, sources.run
    if sources.plan is not None:
        versions = versions_of(("gradcal_jax", "numpy", "scipy", "jax"))
        rows.append(("versions", ", ".join(map(" ".join, versions.items()))))
    if recipe is not None:
        rows += [
            ("recipe", recipe.fingerprint),
            ("recipe written by", recipe.made.by),
            ("versions", ", ".join(f"{name} {number}" for name, number in recipe.made.versions.items())),
        ]
        if recipe.made.seed is not None:
            rows.append(("seed of the optimisation", str(recipe.made.seed)))
    if run is not None:
        notes = run.notes()
        rows += [
            ("run", run.path.name),
            ("run begun", str(notes.get("begun", ""))),
            ("run by", f"gradcal {notes['version']}"),
        ]
        if notes.get("simulated"):
            rows.append(("seed of the simulation", str(notes["simulation"]["seed"])))
    if calibration is not None:
        rows += [("device", calibration.serial_number), ("frame", calibration.frame), ("order", calibration.order)]
        words = {"program": "estimated by", "spec": "model"}
        kept = ("program", "estimator", "readings", "rows", "log", "spec")
        rows += [(words.get(key, key), calibration.provenance[key]) for key in kept if key in calibration.provenance]
    rows += [(f"SHA-256 of {name}", digest) for name, digest in sources.paths]
    return rows
