"""Assumptions and provenance of a page's numbers."""

from gradcal_jax.files.absent import absent_terms
from gradcal_jax.files.calibration import Calibration
from gradcal_jax.files.recipe import Recipe
from gradcal_jax.files.unit_spec import UnitSpec
from gradcal_jax.pages.sources import Sources


def assumed_noise(recipe: Recipe | None, calibration: Calibration | None) -> list[tuple[str, str]]:
    """The noise figures behind the numbers: the spec's, or those of the calibration."""
    rows: list[tuple[str, str]] = []
    if recipe is not None:
        sensor, angle = recipe.axis_spec.sensor, recipe.axis_spec.rig.table.angle
        rows.append(("angle random walk", str(sensor.angle_random_walk)))
        for drift in sensor.drift:
            rows.append(("bias instability", f"{drift.standard_deviation}, correlation time {drift.correlation_time}"))
        for wander in sensor.scale_factor_instability:
            words = f"{wander.standard_deviation}, correlation time {wander.correlation_time}"
            rows.append(("scale-factor instability", words))
        figures = (
            ("rate random walk", sensor.rate_random_walk),
            ("turn-on bias", sensor.turn_on_bias),
            ("sample clock error", sensor.clock_text),
            ("offset of the temperature", sensor.temperature_offset),
            ("lag of the temperature", sensor.temperature_lag),
            ("input axis beside the table's axis", recipe.axis_spec.rig.table.mounting_accuracy),
            ("scale of the table's angle", angle.scale_error),
            ("Earth's rate", recipe.axis_spec.rig.earth_rate),
            ("thermal lag", sensor.thermal_lag),
            ("reading noise", angle.reading_noise or None),
            ("standstill offset", angle.standstill_offset or None),
            ("timing error", angle.timing_error or None),
        )
        rows += [(name, str(value)) for name, value in figures if value is not None]
        return rows + omitted_rows(recipe.axis_spec)
    if calibration is not None and calibration.noise is not None:
        names = ("angle_random_walk", "rate_random_walk", "velocity_random_walk")
        known = {name.replace("_", " "): getattr(calibration.noise, name) for name in names}
        rows += [(name, str(figure)) for name, figure in known.items() if figure is not None]
    return rows


def omitted_rows(spec: UnitSpec) -> list[tuple[str, str]]:
    """The error terms that a spec leaves out, with the figures that count for them."""
    words = "not stated, and so counted as is typical of its class: "
    return [(term.key, words + term.typical) for term in absent_terms(spec)]


def provenance_rows(sources: Sources) -> list[tuple[str, str]]:
    """Fingerprints, versions, seeds and names of files."""
    rows: list[tuple[str, str]] = []
    recipe, calibration, run = sources.recipe, sources.calibration, sources.run
    if recipe is not None:
        rows += [
            ("recipe", recipe.fingerprint),
            ("recipe made by", recipe.made.by),
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
        rows += [("unit", calibration.serial_number), ("frame", calibration.frame), ("order", calibration.order)]
        names = {
            "program": "estimated by",
            **{key: key for key in ("estimator", "readings", "rows", "log")},
            "spec": "model",
        }
        rows += [(words, calibration.provenance[key]) for key, words in names.items() if key in calibration.provenance]
    rows += [(f"SHA-256 of {name}", digest) for name, digest in sources.paths]
    return rows
