"""`gradcal check`: all errors of a spec at once; its plan, or that of a recipe, as tables."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from gradcal_jax.cli.output import Json, Switch, show, strong
from gradcal_jax.cli.precision import use_float64
from gradcal_jax.tables.table import Table
from gradcal_jax.units import times_text

if TYPE_CHECKING:
    from gradcal_jax.spec.spec_sections import Spec


def check(file: Path, /, *, files_only: Switch = False, json: Json = False) -> int:
    """List all errors of a spec, or describe its plan and what the plan cannot observe; print a recipe as a table.

    Parameters
    ----------
    file
        The spec file, or a recipe. The tables list the steps of the chamber and the moves of the rate table; for a
        recipe also the predicted errors.
    files_only
        Skip the computation of what the plan cannot observe; this computation takes a few seconds.
    json
        Print as JSON: the times of the plan, the notes, and what the plan cannot observe; or the contents of a recipe.
    """
    from gradcal_jax.recipe.bench_tables import show as sheet
    from gradcal_jax.recipe.recipe import Recipe, spec_or_recipe
    from gradcal_jax.spec.memory import needed_bytes, too_large

    contents = spec_or_recipe(file)
    if isinstance(contents, Recipe):
        return show(sheet(contents, heading=strong), contents.model_dump(mode="json", exclude_none=True), json=json)
    too = too_large(contents)
    blind: list[str] = []
    if not (files_only or too):
        use_float64()
        from gradcal_jax.information.plan_sentences import check as check_of

        blind = check_of(contents)
    record = numbers(contents) | {"memory_bytes": needed_bytes(contents)}
    record["unobservable"] = None if files_only or too else blind
    lines = [strong(contents.title or str(file)), text_of_spec(contents), *omitted_lines(contents)]
    lines += [f"note: {sentence}" for sentence in blind]
    sound = "the spec has no errors" + ("; read the notes above" if blind else "")
    lines.append(f"too large: {too}" if too else sound)
    return show("\n".join(lines), record, json=json, wished=not too)


def numbers(spec: "Spec") -> dict[str, Any]:
    """A summary of the plan for other programs; times in s."""
    from gradcal_jax.spec.absent import absent_terms, class_terms

    record: dict[str, Any] = {"title": spec.title, "method": spec.plan.method}
    record |= {f"{name}_s": getattr(spec.schedule, name) for name in ("duration", "soak", "motion")}
    record["requirements"] = [r.name for r in spec.requirement]
    for name, terms in (("omitted", absent_terms(spec)), ("of_class", class_terms(spec))):
        record[name] = [{"key": t.key, "typical": t.typical, "source": t.source} for t in terms]
    return record | {"notes": notes(spec)}


def omitted_lines(spec: "Spec") -> list[str]:
    """Error terms that are absent from the file, with the typical figures that count for them."""
    from gradcal_jax.spec.absent import absent_terms, attitude_sentences, branch_sentences, class_terms
    from gradcal_jax.spec.typical import sensor_grade, table_grade

    lines: list[str] = []
    for words, terms in (
        ("these terms have typical figures of the stated class; state your own if you can", class_terms(spec)),
        ("these terms are not in the file, so figures typical of the class count", absent_terms(spec)),
    ):
        if terms:
            rows = [(term.key, term.typical, term.source) for term in terms]
            lines += ["", f"{words}; 0 (or an empty list) means that there is no such error:"]
            lines.append(Table.of(["term", "typical figure", "source"], rows).text(width=120))
    if lines:
        for name, grade in (("sensor", sensor_grade(spec.sensor)), ("table", table_grade(spec))):
            lines.append(f"class of the {name}: {grade.name} ({grade.like}), from {grade.reason}")
    return [*lines, *branch_sentences(spec), *attitude_sentences(spec)]


def text_of_spec(spec: "Spec") -> str:
    """Requirements and plan as plain text, from the file alone."""
    from gradcal_jax.recipe.bench_tables import plan_lines
    from gradcal_jax.recipe.tracks import tracks_of
    from gradcal_jax.spec.schedule import StandardSchedule

    required: list[tuple[str, ...]] = []
    for requirement in spec.requirement:
        r: Any = requirement
        over = f"{r.temperature[0]} to {r.temperature[1]}"
        if isinstance(getattr(r, "rate", None), tuple):
            over += f", {r.rate[0]} to {r.rate[1]}"
        target = "" if r.target is None else str(r.target)
        required.append((r.name, r.quantity.replace("_", " "), r.axis, r.statistic, over, target))
    heads = ["requirement", "quantity", "axis", "statistic", "within", "target"]
    schedule = spec.schedule
    moving = "integration" if isinstance(schedule, StandardSchedule) else "temperature motion"
    lines = [Table.of(heads, required).text(), ""] if required else []
    lines.append(
        f"plan: {spec.plan.method} method, {times_text(schedule.duration, schedule.soak, schedule.motion, moving)}"
    )
    try:
        lines += plan_lines(tracks_of(spec), strong)
    except ValueError as error:
        lines.append(f"note: the plan cannot be made a recipe: {error}")
    return "\n".join([*lines, *(f"note: {note}" for note in notes(spec))])


def notes(spec: "Spec") -> list[str]:
    """Notes on a sound spec: a reference that counts as exact."""
    from gradcal_jax.spec.schedule import StandardSchedule

    schedule = spec.schedule
    exact = isinstance(schedule, StandardSchedule) and any(schedule.rates) and spec.rig.table.rate_accuracy is None
    return ["state rig.table.rate_accuracy: the reference rate counts as exact"] if exact else []
