"""The HTML page of a plan, a run or a calibration: sections of sentences, tables and figures, without external
resources."""

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib import resources
from pathlib import Path
from typing import Any, Final

import gradcal_jax
from gradcal_jax.pages.assumptions import assumptions, provenance_rows
from gradcal_jax.pages.certificate import certificate_part
from gradcal_jax.pages.figures import calibration_pictures, plan_pictures, residual_pictures
from gradcal_jax.pages.history import RunHistory, history_of
from gradcal_jax.pages.residuals import outcome_table, residuals_of
from gradcal_jax.pages.section import PagePart, PageSection
from gradcal_jax.pages.sources import Sources, read_sources
from gradcal_jax.pages.tables import coefficients, errors_of_table, of_path, tests
from gradcal_jax.recipe.bench_tables import CHAMBER_HEAD, block_heading, chamber_rows, chamber_words
from gradcal_jax.spec.rig import read_rig
from gradcal_jax.tables.table import Table
from gradcal_jax.tables.writing import write_whole
from gradcal_jax.units import times_text

# The worst verdict of all requirements is that of the page.
_VERDICTS: Final = {
    "not valid": "Not valid: the data contradict the model, so no stated uncertainty is valid.",
    "unobservable": "Unobservable: a requirement cannot be observed.",
    "not covered": "Not covered: the data do not cover all temperatures and rates of a requirement.",
    "missed": "Missed: a residual exceeds its target.",
    "met": "Met: every target is met.",
}


def report(
    sources: str | Path | Sequence[str | Path], output: str | Path, *, before: str | Path | None = None
) -> dict[str, Any]:
    """Make one HTML page of a plan, a run or a calibration: plan, prediction, run, estimate and how to apply it.

    `sources`: the folder of a run (a calibration in it is taken with it), a recipe or a spec, a calibration, or those
    of them that belong together. `before`: a spec or recipe whose plan to compare with. The page replaces `output`; it
    has no external resources.

    Returns the verdict, and every table of the page by section as plain data: ppm, deg/h, °C and deg/s, 1σ. Errors:
    `ValueError` for sources that cannot be read or do not belong on one page.
    """
    paths = [sources] if isinstance(sources, str | Path) else sources
    return write_page(
        read_sources([Path(path) for path in paths], before=None if before is None else Path(before)), output
    )


def write_page(
    sources: Sources,
    output: str | Path,
    *,
    certificate: Mapping[str, str] | None = None,
    rig: Path | None = None,
) -> dict[str, Any]:
    """Write the page of `sources`, with a `certificate` in front where its number, customer and dates are stated;
    returns its tables as plain data."""
    history = None if sources.run is None else history_of(sources.run)
    parts = [PagePart(_heading(sources, history), _sections(sources, history))]
    if certificate is not None:
        parts.insert(0, certificate_part(sources, None if rig is None else read_rig(rig), certificate))
    calibration = sources.calibration
    simulated = any(of is not None and of.simulated for of in (history, calibration))
    kind = _verdict(sources)
    verdict = {"kind": kind, "words": _VERDICTS.get(kind, "No requirement has a target, so there is no verdict.")}
    context = {"heading": parts[0].heading, "parts": parts, "simulated": simulated, "verdict": verdict}
    write_whole(output, _template("template.html").render(**context, css=_text("style.css")))
    sections = {section.title: section.json() for part in parts for section in part.sections}
    return {"title": parts[-1].heading, "simulated": simulated, "verdict": kind or None, "sections": sections}


def _heading(sources: Sources, history: RunHistory | None) -> str:
    if sources.calibration is not None:
        begun = "" if history is None else f", {history.begun[:10]}"
        return f"Calibration report: {sources.calibration.serial_number}{begun}"
    titled = (of.title for of in (sources.recipe, sources.spec) if of is not None and of.title)
    return next(titled, "Calibration plan")


def _verdict(sources: Sources) -> str:
    """The worst verdict; empty where no requirement has a target."""
    of = sources.calibration.result if sources.calibration is not None else sources.prediction.requirements
    verdicts = {row.verdict for row in of}
    return next((word for word in _VERDICTS if word in verdicts), "")


def _sections(sources: Sources, history: RunHistory | None) -> list[PageSection]:
    found = residuals_of(sources)
    targets = {
        r.requirement.name: float(r.requirement.target) / r.requirement.coverage
        for r in found
        if r.requirement.target is not None
    }
    before = "the priors of the spec" if sources.before is None else f"the plan in {sources.before_name}"
    notes = [f"Note: {note}." for note in _notes(sources)]
    about = "What remains of each error within the stated range: the named statistic of one standard deviation (1σ)."
    sections = [
        PageSection("Requirements", [f"{about} Before: {before}.", *notes], [outcome_table(sources, found)]),
        PageSection("Residuals", pictures=list(residual_pictures(found, targets))),
        _plan(sources, history),
    ]
    if history is not None:
        sections.append(PageSection("Run", history.sentences, [history.waited, history.devices]))
    sections += _calibrated(sources)
    stated = Table.of(["term", "figure", "source"], assumptions(sources.spec, sources.calibration))
    sections.append(PageSection("Assumptions", [], [stated]))
    now = f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC by gradcal {gradcal_jax.__version__}"
    made = [*provenance_rows(sources), ("page made", now)]
    sections.append(PageSection("Provenance", [], [Table.of(["what", "value"], made)]))
    return [section for section in sections if not section.is_empty]


def _notes(sources: Sources) -> list[str]:
    notes = [*sources.notes]
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


def _plan(sources: Sources, history: RunHistory | None) -> PageSection:
    spec, recipe = sources.spec, sources.recipe
    text: list[str] = []
    tables: list[Table] = []
    if spec is not None:
        schedule = spec.schedule
        text += [f"{spec.title}."] if spec.title else []
        text.append(times_text(schedule.duration, schedule.soak, schedule.motion) + ".")
    if recipe is not None:
        text.append(f"{recipe.status}.")
        tables.append(Table.of(["segment", *CHAMBER_HEAD[1:]], chamber_rows(recipe)))
        text += [f"{words}." for words in chamber_words(recipe)]
        text += [f"Table, {block_heading(block)}." for block in recipe.motion]
        text.append("gradcal check prints every move of the recipe as a table.")
    return PageSection("Plan", text, tables, pictures=list(plan_pictures(spec, recipe, history)))


def _calibrated(sources: Sources) -> list[PageSection]:
    """The sections of a calibration, or of the coefficients of a plan alone."""
    calibration, planned = sources.calibration, None if sources.spec is None else sources.prediction
    if calibration is None:
        return [
            PageSection(
                "Coefficients", ["Uncertainty of each coefficient after this plan."], [coefficients(planned, None)]
            )
        ]
    words = (
        "The p-value is the probability that the noise of the spec alone causes a statistic of this size or larger. If "
        "it is below 1 %, the model lacks an effect that is in the data."
    )
    tables = [tests(calibration), of_path(calibration), errors_of_table(calibration)]
    name = sources.calibration_name
    commands = [
        f"gradcal apply {name} LOG -o corrected.nc",
        f"gradcal validate {name} ANOTHER_LOG",
        f"gradcal export {name} --format c-header -o calibration.h",
    ]
    return [
        PageSection(
            "Calibration",
            [f"{calibration.valid_range}.", words],
            [table for table in tables if table.rows],
            pictures=list(calibration_pictures(calibration)),
        ),
        PageSection("Coefficients", [], [coefficients(planned, calibration)]),
        PageSection("How to apply it", [f"{calibration.order}."], commands=commands),
    ]


def _text(name: str) -> str:
    """The text of a file of this room."""
    return (resources.files(__name__.rsplit(".", 1)[0]) / name).read_text(encoding="utf-8")


def _template(name: str) -> Any:
    from jinja2 import Environment, StrictUndefined

    room = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    return room.from_string(_text(name))
