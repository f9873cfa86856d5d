"""The HTML page of a plan, a run or a calibration: numbers and figures in a template, without external resources."""

import os
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import gradcal_jax
from gradcal_jax.calibration import FRAME_OF_CASE
from gradcal_jax.information.imu_residual import UNITS_OF_TERMS
from gradcal_jax.pages.coefficients import coefficient_table, hidden_values, symbols
from gradcal_jax.pages.figures import calibration_pictures, map_pictures, pose_picture, track_pictures
from gradcal_jax.pages.numbers import figures, one_sign, unbroken_options
from gradcal_jax.pages.report_data import ReportData, report_data_of
from gradcal_jax.pages.requirements import RequirementFact
from gradcal_jax.pages.sources import Sources, read_sources
from gradcal_jax.pages.templates import page_file, page_templates
from gradcal_jax.recipe.bench_tables import CHAMBER_HEAD, block_heading, chamber_rows, chamber_words
from gradcal_jax.recipe.recipe import Recipe
from gradcal_jax.spec.schedule import StandardSchedule
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.tables.writing import write_whole
from gradcal_jax.units import DEG_PER_S, count_text, time_text, times_text

# Moves of a cycle that a page shows.
_MOST_MOVES: Final = 80


def page(sources: Sources, data: ReportData) -> str:
    """The whole page as HTML, in one file: styles and figures inside, and no script."""
    template = page_templates(figures=figures, sentence=sentence, options=unbroken_options).get_template("page.html")
    spec, recipe, calibration = sources.spec, sources.recipe, sources.calibration
    targets = {r.name: r.target / r.coverage for r in data.requirements if r.target is not None}
    tracks = [] if spec is None or spec.is_one_axis else [pose_picture(spec)]
    tracks += track_pictures(recipe, data.history)
    context: dict[str, Any] = {
        "data": data,
        "recipe": recipe,
        "calibration_name": sources.calibration_name,
        "css": page_file("style.css"),
        "heading": _heading(data, sources),
        "words": _words(data, sources),
        "map_groups": map_pictures(data.maps, targets),
        "tracks": tracks,
        "calibration_pictures": [] if calibration is None else calibration_pictures(calibration),
        "chamber_head": ["segment", *CHAMBER_HEAD[1:]],
        "chamber": [] if recipe is None else chamber_rows(recipe),
    }
    return one_sign(template.render(**context))


def sentence(text: str) -> str:
    """Text that begins with a capital and ends with a full stop."""
    return text[:1].upper() + text[1:] + ("" if text.endswith((".", "!", "?")) else ".")


def _heading(data: ReportData, sources: Sources) -> str:
    """The title of the page, with sensor and date if there is a calibration."""
    if sources.calibration is None:
        return data.title
    begun = "" if data.history is None else str(data.history.begun)[:10]
    return ", ".join(filter(None, (f"Calibration report: {sources.calibration.serial_number}", begun)))


def _words(data: ReportData, sources: Sources) -> dict[str, Any]:
    """Rows of cells and sentences for the template."""
    spec, recipe, calibration = sources.spec, sources.recipe, sources.calibration
    (head, *cells), numbers = coefficient_table(data.parameters)
    return {
        "plan": None if spec is None else _plan(spec),
        "verdict": _verdict(data),
        "chamber": [] if recipe is None else chamber_words(recipe),
        "motion": [] if recipe is None else [block_heading(block) for block in recipe.motion],
        "optimised": [] if recipe is None else _optimised(recipe),
        "walks": spec is not None and spec.sensor.gyro is not None and bool(spec.sensor.gyro.rate_random_walk),
        "thermometer_off": "temperature_offset" in hidden_values(sources.hidden_truth, calibration),
        "mounted": calibration is not None and calibration.frame == FRAME_OF_CASE,
        "converged": recipe is None or (recipe.optimisation or {}).get("converged", True),
        "done": _done(data),
        "waited": [
            (row.step, time_text(row.waited_s), f"{figures(row.temperature_c)} °C")
            for row in (() if data.history is None else data.history.waited)
        ],
        "devices": [] if data.history is None else [tuple(device) for device in data.history.devices],
        "terms": [
            [
                (t.name, figures(t.value), "not observable" if t.std is None else figures(t.std, 3), t.unit, t.computed)
                for t in axis.terms
            ]
            for axis in data.axes
        ],
        "fit": [
            (name, figures(value), str(degrees), figures(chance, 2))
            if degrees
            else (name, "–", "0", "too few readings")
            for name, value, degrees, chance in data.fit
        ],
        "table": _table_errors(sources),
        "order": "" if calibration is None else calibration.order,
        "basis": symbols(spec, calibration)
        + ("" if data.axes else " Uncertainty of each coefficient after this plan."),
        "exports": [(row.target, row.command, "; ".join(row.largest) or "nothing") for row in data.exports],
        "provenance": [*data.provenance, ("page made", _time_and_version())],
        "parameters": {"head": head, "rows": cells, "numbers": numbers},
        **_requirements(data),
    }


def _plan(spec: Spec) -> dict[str, Any]:
    """The times of a plan, and the moves of its cycle."""
    schedule = spec.schedule
    lasts = times_text(schedule.duration, schedule.soak, schedule.motion)
    if isinstance(schedule, StandardSchedule):
        return {"times": f"{lasts}. {schedule.readings} points.", "moves": [], "more": ""}
    cycles = sum(stretch.cycles for stretch in schedule.stretches)
    hung = len(spec.rig.table.mounting)
    left = len(schedule.steps) - _MOST_MOVES
    lasts += f". A cycle of {time_text(schedule.period)}, repeated {count_text(cycles, 'time')}" if cycles else ""
    return {
        "times": lasts + (f", in {hung} mountings." if hung > 1 else "."),
        "moves": [
            (
                spec.rig.table.axis[step.axis].name if step.axis >= 0 else "",
                step.move.shape,
                time_text(step.move.duration),
                f"{figures(step.move.angle * DEG_PER_S, 6)} deg" if step.axis >= 0 else "",
                f"{figures(step.move.fastest * DEG_PER_S)} deg/s" if step.axis >= 0 else "",
                str(step.move.repeat) if step.move.repeat > 1 else "",
            )
            for step in schedule.steps[:_MOST_MOVES]
        ],
        "more": f"… and {left} more moves; gradcal check --timeline segments prints all of them." if left > 0 else "",
    }


def _verdict(data: ReportData) -> str:
    achieved = any(row.achieved is not None for row in data.requirements)
    with_target = [row for row in data.requirements if row.target is not None]
    done = "achieved" if achieved else "predicted"
    if data.verdict == "not valid":
        failed = [test.replace("_", " ") for test in data.contradicted]
        return f"Not valid: the data contradict the model ({'; '.join(failed)}), so no stated uncertainty is valid."
    if data.verdict == "met":
        return f"Met: every target is met by the {done} residuals ({_against(with_target)})."
    if data.verdict == "missed":
        missed = [row for row in with_target if row.verdict == "missed"]
        return f"Missed: a {done} residual exceeds its target ({_against(missed)})."
    names = ", ".join(dict.fromkeys(row.name for row in data.requirements if row.verdict == data.verdict))
    if data.verdict == "not covered":
        return f"Not covered: the data do not cover all temperatures and rates of {names}, so there is no verdict."
    if data.verdict == "unobservable":
        return f"Unobservable: this plan cannot observe {names}."
    return "No requirement has a target, so there is no verdict."


def _against(rows: list[RequirementFact]) -> str:
    parts: list[str] = []
    for row in rows:
        value = row.predicted if row.achieved is None else row.achieved
        assert row.target is not None
        text = "not observable" if value is None else f"{figures(value)} {row.unit}"
        parts.append(f"{row.name}: {text} against {figures(row.target)} {row.unit}")
    return "; ".join(parts)


def _requirements(data: ReportData) -> dict[str, Any]:
    rows = data.requirements
    several = len({row.axis for row in rows} & set("xyz")) > 1
    fields = {
        "before": "before",
        "predicted": "predicted",
        "achieved": "achieved",
        "from the named terms alone": "named",
        "no plan leaves less than": "limit",
        "own noise of the IMU, which remains": "own",
        "target": "target",
        "verdict": "verdict",
        "limited by": "limited_by",
    }
    kept = {head: name for head, name in fields.items() if any(getattr(row, name) not in (None, "") for row in rows)}
    cells: list[list[str]] = []
    for row in rows:
        name = f"{row.name} ({_box(row)})".replace(f"{row.name} ({row.name}, ", f"{row.name} (")
        name += f", axis {row.axis}" if several else ""
        cells.append([name, row.statistic, *(_cell(getattr(row, field), row.unit) for field in kept.values())])
    return {"requirement_head": ["requirement", "statistic", *kept], "requirement_rows": cells}


def _cell(value: float | str | None, unit: str) -> str:
    if value is None or isinstance(value, str):
        return value or ""
    return f"{figures(value)}\N{NO-BREAK SPACE}{unit}"


def _box(row: RequirementFact) -> str:
    words = row.quantity.replace("_", " ")
    if row.temperature_c is None:
        return words
    words = "" if words == row.name else words + ", "
    words += f"{figures(row.temperature_c[0])} to {figures(row.temperature_c[1])} °C"
    if row.rate_dps is None:
        return words
    return words + f", {figures(row.rate_dps[0])} to {figures(row.rate_dps[1])} deg/s"


def _table_errors(sources: Sources) -> dict[str, Any] | None:
    """The estimated errors of the table, beside the spec's uncertainty and a simulation's true values."""
    calibration = sources.calibration
    if calibration is None or not calibration.table:
        return None
    hidden = hidden_values(sources.hidden_truth, calibration)
    rows: list[tuple[str, ...]] = []
    for error in calibration.table:
        unit, factor = UNITS_OF_TERMS.get(error.unit, (error.unit, 1.0))
        numbers = (error.value, error.standard_deviation, error.prior, *([hidden.get(error.name)] if hidden else []))
        shown = ("" if number is None else figures(number * factor) for number in numbers)
        rows.append((error.name.replace("_", " "), *shown, unit))
    head = ["error of the table", "estimate", "1σ", "known to", *(["hidden truth"] if hidden else []), "unit"]
    return {"head": head, "rows": rows, "numbers": tuple(range(1, len(head) - 1))}


def _optimised(recipe: Recipe) -> list[str]:
    record = recipe.optimisation
    if not record:
        return []
    unit = record.get("unit", "")
    lines: list[str] = []
    now, before = record.get("now"), record.get("before")
    if isinstance(now, float | int):
        begun = f"{figures(float(before))} {unit} → " if isinstance(before, float | int) else ""
        lines.append(f"{record.get('objective', 'objective')}: {begun}{figures(float(now))} {unit}.")
    if record.get("structure"):
        lines.append(sentence(str(record["structure"])))
    if record.get("active_limits"):
        lines.append(f"Limits that the plan reaches: {'; '.join(map(str, record['active_limits']))}.")
    return lines


def _done(data: ReportData) -> list[str]:
    history = data.history
    if history is None:
        return []
    parts = "in one part" if history.sessions == 1 else f"in {history.sessions} parts"
    waited = sum(row.waited_s for row in history.waited)
    lines = [
        f"Run begun {history.begun}, {parts}: {history.status}, {count_text(history.steps, 'step')}, "
        f"{time_text(history.duration_s)} in total, including {time_text(waited)} of waiting for stable "
        "temperatures.",
        "Every device was verified to be safe at the end."
        if history.verified_safe
        else "NOT every device was verified to be safe at the end.",
    ]
    if history.seams:
        lines.append(f"The run was paused or resumed {count_text(history.seams, 'time')}.")
    if history.damaged_bytes:
        lines.append(f"{history.damaged_bytes} bytes of the journal belong to no valid record.")
    return lines


def _time_and_version() -> str:
    epoch = os.environ.get("SOURCE_DATE_EPOCH")
    now = datetime.fromtimestamp(int(epoch), UTC) if epoch and epoch.isdigit() else datetime.now(UTC)
    return f"{now:%Y-%m-%d %H:%M} UTC by gradcal {gradcal_jax.__version__}"


def report(
    sources: str | Path | Sequence[str | Path],
    output: str | Path,
    *,
    before: str | Path | None = None,
    limits: str | Path | None = None,
) -> ReportData:
    """Make one HTML page of a plan, a run or a calibration: plan, prediction, run, estimate and how to apply it.

    `sources`: the folder of a run (a calibration in it is taken with it), a recipe or a spec, a calibration, or those
    of them that belong together. `before`: a spec or recipe whose plan to compare with.
    `limits`: the output of `gradcal limit --json`. The page
    replaces `output`; it has no external resources.

    Returns every number of the page, once (`pages.report_data.ReportData`): ppm, deg/h, °C and deg/s, 1σ. Terms are
    those of IEEE 952, 1431 and 1780. Errors: `ValueError` for sources that cannot be read or do not belong on one page.
    """
    paths = [sources] if isinstance(sources, str | Path) else sources
    documents = read_sources(
        [Path(source) for source in paths],
        before=None if before is None else Path(before),
        limits=None if limits is None else Path(limits),
    )
    return write_page(documents, output)


def write_page(sources: Sources, output: str | Path) -> ReportData:
    """Write the page of `sources`."""
    data = report_data_of(sources)
    write_whole(output, page(sources, data))
    return data
