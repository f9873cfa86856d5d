"""What the numbers of a page rest on: stated and typical figures, fingerprints, versions and names of files."""

from typing import Any

from gradcal_jax.calibration import Calibration
from gradcal_jax.information.verdicts import versions_of
from gradcal_jax.pages.sources import Sources
from gradcal_jax.spec.absent import absent_terms, class_terms
from gradcal_jax.spec.changes import tables_of
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.tables.problems import dotted, leaves


def assumptions(spec: Spec | None, calibration: Calibration | None) -> list[tuple[str, str, str]]:
    """The figures behind the numbers, each with its key and source: those that a plan's spec states of sensor and rig,
    and typical ones of the class, or the noise of a calibration."""
    if spec is None:
        noise = None if calibration is None or calibration.noise is None else calibration.noise
        return [] if noise is None else [(key, text, "calibration") for key, text in _figures(tables_of(noise))]
    tables = tables_of(spec)
    stated = _figures({"sensor": tables["sensor"], "rig": tables["rig"]})
    typical = [
        (term.key, term.typical, f"typical: {term.source}") for term in (*class_terms(spec), *absent_terms(spec))
    ]
    return [*((key, text, "spec") for key, text in stated), *typical]


def _figures(tables: dict[str, Any]) -> list[tuple[str, str]]:
    """The quantities in the tables of a file, with their keys."""
    texts = ((dotted(key), text) for key, text in leaves(tables) if isinstance(text, str))
    return [(key, text) for key, text in texts if any(letter.isdigit() for letter in text)]


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
