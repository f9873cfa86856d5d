"""The HTML page of a plan, a run or a calibration: sections of sentences, tables and figures, without external
resources."""

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib import resources
from pathlib import Path
from typing import Any, Final

from jinja2 import Environment, StrictUndefined

import gradcal_jax
from gradcal_jax.pages.certificate import certificate_part
from gradcal_jax.pages.figures import calibration_pictures, plan_pictures, residual_pictures, run_picture
from gradcal_jax.pages.history import RunHistory, history_of
from gradcal_jax.pages.residuals import outcome_table, residuals_left
from gradcal_jax.pages.section import PagePart, PageSection
from gradcal_jax.pages.sources import Sources, read_sources
from gradcal_jax.pages.tables import coefficients, errors_of_table, of_path, tests
from gradcal_jax.recipe.bench_tables import block_heading, chamber_table, chamber_words
from gradcal_jax.spec.absent import absent_terms, class_terms
from gradcal_jax.spec.rig import read_rig
from gradcal_jax.tables.table import Table
from gradcal_jax.tables.writing import to_toml, write_whole
from gradcal_jax.units import times_text

# The worst verdict of all requirements is that of the page.
_VERDICTS: Final = {
    "not valid": "Not valid: the data contradict the model, so no stated uncertainty is valid.",
    "unobservable": "Unobservable: a requirement cannot be observed.",
    "not covered": "Not covered: the data do not cover all temperatures and rates of a requirement.",
    "missed": "Missed: a residual exceeds its target.",
    "met": "Met: every target is met.",
}


def report(sources: str | Path | Sequence[str | Path], output: str | Path) -> dict[str, Any]:
    """Make one HTML page of a plan, a run or a calibration: plan, prediction, run, estimate and how to apply it.

    `sources`: the folder of a run (a calibration in it is taken with it), a recipe or a spec, a calibration, or those
    of them that belong together. The page replaces `output`; it has no external resources.

    Returns the verdict, and every table of the page by section as plain data: ppm, deg/h, °C and deg/s, 1σ. Errors:
    `ValueError` for sources that cannot be read or do not belong on one page.
    """
    paths = [sources] if isinstance(sources, str | Path) else sources
    return write_page(read_sources([Path(path) for path in paths]), output)


def write_page(
    sources: Sources,
    output: str | Path,
    *,
    certificate: Mapping[str, str] | None = None,
    rig: Path | None = None,
) -> dict[str, Any]:
    """Write the page of `sources`, with a `certificate` in front where its number and customer are stated;
    returns its tables as plain data."""
    history, calibration = None if sources.run is None else history_of(sources.run), sources.calibration
    titles = [of.title for of in (sources.recipe, sources.spec) if of is not None and of.title]
    heading = titles[0] if titles else "Calibration plan"
    if calibration is not None:
        begun = "" if history is None else f", {history.begun[:10]}"
        heading = f"Calibration report: {calibration.serial_number}{begun}"
    parts = [PagePart(heading, _sections(sources, history))]
    if certificate is not None:
        parts.insert(0, certificate_part(sources, None if rig is None else read_rig(rig), certificate))
    simulated = any(of is not None and of.simulated for of in (history, calibration))
    kind = _verdict(sources)
    verdict = {"kind": kind, "words": _VERDICTS.get(kind, "No requirement has a target, so there is no verdict.")}
    context = {"heading": parts[0].heading, "parts": parts, "simulated": simulated, "verdict": verdict}
    room = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    write_whole(output, room.from_string(_text("template.html")).render(**context, css=_text("style.css")))
    sections = {section.title: section.json() for part in parts for section in part.sections}
    return {"title": heading, "simulated": simulated, "verdict": kind or None, "sections": sections}


def _verdict(sources: Sources) -> str:
    """The worst verdict; empty where no requirement has a target."""
    of = sources.calibration.result if sources.calibration is not None else sources.prediction.requirements
    verdicts = {row.verdict for row in of}
    return next((word for word in _VERDICTS if word in verdicts), "")


def _sections(sources: Sources, history: RunHistory | None) -> list[PageSection]:
    spec, recipe, calibration = sources.spec, sources.recipe, sources.calibration
    found = residuals_left(sources)
    outcomes = outcome_table(sources, found)
    about = "What remains of each error within the stated range: the named statistic of one standard deviation (1σ)."
    if any(column.name == "before" for column in outcomes.columns):
        about += " Before: by the priors of the spec."
    notes = [f"Note: {note}." for note in _notes(sources)]
    sections = [
        PageSection("Requirements", [about, *notes], [outcomes]),
        PageSection("Residuals", pictures=list(residual_pictures(found))),
    ]
    if spec is not None:
        schedule = spec.schedule
        text = [f"{spec.title}."] if spec.title else []
        text.append(times_text(schedule.duration, schedule.soak, schedule.motion) + ".")
        tables: list[Table] = []
        if recipe is not None:
            text.append(f"{recipe.status}.")
            tables.append(chamber_table(recipe.tracks))
            text += [f"{words}." for words in chamber_words(recipe)]
            text += [f"Table, {block_heading(block)}." for block in recipe.motion]
            text.append("gradcal check prints every move of the recipe as a table.")
        sections.append(PageSection("Plan", text, tables, pictures=list(plan_pictures(spec))))
    if history is not None:
        pictures = [] if history.chamber_s.size == 0 else [run_picture(history)]
        sections.append(PageSection("Run", history.sentences, [history.devices], pictures=pictures))
    planned = None if spec is None else sources.prediction
    if calibration is not None:
        tables = [tests(calibration), of_path(calibration), errors_of_table(calibration)]
        pictures = list(calibration_pictures(calibration))
        sections.append(
            PageSection("Calibration", [f"{calibration.valid_range}.", _P_VALUE], tables, pictures=pictures)
        )
    words = [] if calibration is not None else ["Uncertainty of each coefficient after this plan."]
    sections.append(PageSection("Coefficients", words, [coefficients(planned, calibration)]))
    if calibration is not None:
        name = sources.calibration_name
        lines = [f"gradcal apply {name} LOG -o corrected.nc", f"gradcal validate {name} ANOTHER_LOG"]
        lines.append(f"gradcal export {name} --format c-header -o calibration.h")
        sections.append(PageSection("How to apply it", [f"{calibration.order}."], lines=lines))
    if spec is not None:
        typical = [(t.key, t.typical, t.source) for t in (*class_terms(spec), *absent_terms(spec))]
        table = Table.of(["typical of the class", "figure", "source"], typical)
        sections.append(PageSection("Assumptions", [], [table], lines=[to_toml(spec)]))
    sections.append(PageSection("Provenance", [], [Table.of(["what", "value"], _provenance(sources))]))
    return [section for section in sections if not section.is_empty]


_P_VALUE: Final = (
    "The p-value is the probability that the noise of the spec alone causes a statistic of this size or larger. If it "
    "is below 1 %, the model lacks an effect that is in the data."
)


def _notes(sources: Sources) -> list[str]:
    notes = [*sources.misfits]
    if sources.spec is not None:
        notes += sources.prediction.warnings
    if sources.recipe is not None:
        notes += sources.recipe.notes
    calibration = sources.calibration
    if calibration is not None:
        if calibration.contradicted:
            notes.append(f"the data contradict the model: {', '.join(calibration.contradicted)}")
        if calibration.unobservable:
            notes.append(f"the data do not observe: {', '.join(calibration.unobservable)}")
    return list(dict.fromkeys(note.rstrip(".") for note in notes))


def _provenance(sources: Sources) -> list[tuple[str, str]]:
    """Fingerprints, versions, seeds and names of files."""
    rows = [("page made", f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC by gradcal {gradcal_jax.__version__}")]
    if (recipe := sources.recipe) is not None:
        made = [recipe.made.by, *map(" ".join, recipe.made.versions.items())]
        rows += [("recipe", recipe.fingerprint), ("recipe written by", ", ".join(made))]
        rows += [] if recipe.made.seed is None else [("seed of the optimisation", str(recipe.made.seed))]
    if sources.run is not None:
        notes = sources.run.notes()
        rows.append(("run", f"{sources.run.path.name}, begun {notes.get('begun')}, by gradcal {notes['version']}"))
        rows += [("seed of the simulation", str(notes["simulation"]["seed"]))] if notes.get("simulated") else []
    if (calibration := sources.calibration) is not None:
        rows += [("device", calibration.serial_number), ("frame", calibration.frame)]
        rows += [(f"calibration: {name.replace('_', ' ')}", text) for name, text in calibration.provenance.items()]
    return [*rows, *((f"SHA-256 of {name}", digest) for name, digest in sources.paths)]


def _text(name: str) -> str:
    """The text of a file of this room."""
    return (resources.files(__name__.rsplit(".", 1)[0]) / name).read_text(encoding="utf-8")
