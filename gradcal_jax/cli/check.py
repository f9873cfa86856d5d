"""`gradcal check`: all errors of a spec at once; a summary of its plan, or a recipe as a table."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from gradcal_jax.cli.output import DONE, NOT_AS_WISHED, Flag, Json, as_json, strong
from gradcal_jax.cli.precision import use_float64
from gradcal_jax.tables.table import Cell, Table
from gradcal_jax.units import time_text, times_text

if TYPE_CHECKING:
    from collections.abc import Sequence

    from gradcal_jax.spec.moves import ResolvedMove
    from gradcal_jax.spec.schedule import PlanSchedule
    from gradcal_jax.spec.spec_sections import Spec

_MOST_ROWS: Final = 60


def check(file: Path, /, *, files_only: Flag = False, json: Json = False) -> int:
    """List all errors of a spec, or describe its plan and what the plan cannot observe; print a recipe as a table.

    Parameters
    ----------
    file
        The spec file, or a recipe. The table of a recipe lists the steps of the chamber, the moves of the rate table,
        and the predicted errors.
    files_only
        Skip the computation of what the plan cannot observe; this computation takes a few seconds.
    json
        Print as JSON: the times of the plan, the notes, and what the plan cannot observe; or the contents of a recipe.
    """
    from gradcal_jax.recipe.recipe import Recipe, spec_or_recipe
    from gradcal_jax.spec.memory import needed_bytes, too_large

    contents = spec_or_recipe(file)
    if isinstance(contents, Recipe):
        from gradcal_jax.pages.bench_sheet import show

        print(contents.model_dump_json(indent=2, exclude_none=True) if json else show(contents, heading=strong))
        return DONE
    too = too_large(contents)
    blind = [] if files_only or too else _blind(contents)
    if json:
        record = numbers(contents) | {"memory_bytes": needed_bytes(contents)}
        print(as_json(record | {"unobservable": None if files_only or too else blind}))
        return NOT_AS_WISHED if too else DONE
    print(strong(contents.title or str(file)))
    print(summary(contents))
    if omitted := omitted_lines(contents):
        print("\n".join(omitted))
    if too:
        print(f"too large: {too}")
        return NOT_AS_WISHED
    for sentence in blind:
        print(f"{'cannot be observed' if 'cannot observe' in sentence else 'note'}: {sentence}")
    print("the spec has no errors" + ("; read the warnings above" if blind else ""))
    return DONE


def _blind(spec: "Spec") -> list[str]:
    """What the plan cannot observe, and requirements beyond its range."""
    use_float64()
    from gradcal_jax.information.plan_sentences import check as check_of

    return check_of(spec)


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


def summary(spec: "Spec") -> str:
    """A summary of the plan as plain text, from the file alone."""
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
    lines = [Table.of(heads, required).text()] if required else []
    schedule = spec.schedule
    if isinstance(schedule, StandardSchedule):
        total = times_text(schedule.duration, schedule.soak, schedule.motion, "integration")
        rates = ", ".join(f"{math.degrees(rate):g}" for rate in schedule.rates)
        lines += ["", f"plan: standard method, {total}; {schedule.readings} points", f"at {rates} deg/s each, at"]
        lines.append(", ".join(f"{temperature:g}" for temperature in schedule.temperatures) + " degC")
    else:
        lines += ["", *_gradient(spec, schedule)]
    return "\n".join([*lines, *(f"note: {note}" for note in notes(spec))])


def _gradient(spec: "Spec", schedule: "PlanSchedule") -> list[str]:
    from gradcal_jax.spec.schedule import duration_of, row_count

    total = times_text(schedule.duration, schedule.soak, schedule.motion, "temperature motion")
    table = spec.rig.table
    every = time_text(float(table.axis[0].angle.read_every)) if table.standing == "read" else ""
    rows: list[tuple[Cell, ...]] = []
    for segment in schedule.segments[:_MOST_ROWS]:
        slope = None if segment.kind == "soak" else f"{60.0 * segment.slope:+.4g} K/min"
        times = time_text(segment.start), time_text(segment.duration)
        used = "yes" if segment.used else "no"
        rows.append((times[0], segment.kind, times[1], f"{segment.temperature_end:.5g} degC", slope, used))
    heads = ["at", "chamber", "for", "to", "slope", "used"]
    lines = [
        f"plan: gradient method, {total}; {len(schedule.segments)} segments",
        *_first(heads, rows, schedule.segments),
    ]
    if schedule.steps:
        parts = [f"moves {time_text(duration_of(schedule.steps))}"]
        parts += [f"other axes {time_text(s.move.duration)} ({_read(s.move, every)})" for s in schedule.after]
        cycles = sum(stretch.cycles for stretch in schedule.stretches)
        lines += ["", f"cycle: {time_text(schedule.period)}, made {cycles} times: {', '.join(parts)}"]
        moves: list[tuple[Cell, ...]] = []
        for step in schedule.steps[:_MOST_ROWS]:
            move, turn = step.move, ("", "", "")
            if not move.is_rest:
                turn = (
                    f"{math.degrees(move.angle):+.6g} deg",
                    f"{math.degrees(move.fastest):.4g} deg/s",
                    f"{math.degrees(move.peak_acceleration):.4g} deg/s^2",
                )
            axis = table.axis[step.axis].name if step.axis >= 0 else ""
            moves.append((axis, move.shape, time_text(move.duration), *turn, _read(move, every)))
        heads = ["axis", "move", "duration", "angle", "up to", "acceleration", "readings"]
        lines += _first(heads, moves, schedule.steps)
    else:
        lines.append("the table stands" + (f" and is read every {every}" if every else ""))
    return [*lines, f"readings: {row_count(schedule, table)}"]


def _read(move: "ResolvedMove", every: str) -> str:
    """How a move or a rest is read; `every`: of a table that is read as it stands."""
    if move.read_every is not None:
        return "at the end" if math.isinf(move.read_every) else f"every {time_text(move.read_every)}"
    if move.reads_as_table:
        return f"every {every}" if every else ""
    return "at the end" if move.read_end else "none"


def _first(heads: list[str], rows: list[tuple[Cell, ...]], whole: "Sequence[object]") -> list[str]:
    """The first rows of a whole, and the number of further ones."""
    more = len(whole) - len(rows)
    return [Table.of(heads, rows).text(indent="  "), *([f"  … and {more} more"] if more > 0 else [])]


def notes(spec: "Spec") -> list[str]:
    """Notes on a sound spec: unused time, and a reference that counts as exact."""
    from gradcal_jax.spec.schedule import StandardSchedule

    schedule = spec.schedule
    if isinstance(schedule, StandardSchedule):
        exact = any(schedule.rates) and spec.rig.table.rate_accuracy is None
        return ["state rig.table.rate_accuracy: the reference rate counts as exact"] if exact else []
    left = sum(stretch.leftover for stretch in schedule.stretches)
    rests = schedule.steps and left > 0.0
    return [f"after the moves of the last cycle, the table stays at rest for {time_text(left)}"] if rests else []
