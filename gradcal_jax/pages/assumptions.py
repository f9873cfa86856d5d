"""What the numbers of a page rest on: stated and typical figures, fingerprints, versions and names of files."""

from collections.abc import Iterable
from typing import Any

from gradcal_jax.calibration import Calibration
from gradcal_jax.information.gears import SCALE_OF_ANGLE
from gradcal_jax.information.unseen import BESIDE_THE_AXIS
from gradcal_jax.information.verdicts import versions_of
from gradcal_jax.pages.sources import Sources
from gradcal_jax.spec.absent import absent_terms
from gradcal_jax.spec.bench import Rig
from gradcal_jax.spec.sensor import Sensor
from gradcal_jax.spec.spec_sections import Spec


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


def _sizes(prior: Any) -> str:
    return ", ".join(map(str, prior)) if isinstance(prior, tuple) else str(prior)


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
        known = "; ".join(f"{name.replace('_', ' ')} {_sizes(prior)}" for name, prior in priors.items() if prior)
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
