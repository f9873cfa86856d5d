"""`gradcal check`: all errors of a spec at once; a summary of its plan, or a recipe as a table."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from gradcal_jax.cli.output import DONE, NOT_AS_WISHED, Flag, Json, as_json, strong
from gradcal_jax.cli.precision import use_float64
from gradcal_jax.tables.display import columns
from gradcal_jax.units import time_text, times_text

if TYPE_CHECKING:
    from collections.abc import Iterator

    from gradcal_jax.spec.motion_plan import PlanSchedule
    from gradcal_jax.spec.moves import ResolvedMove
    from gradcal_jax.spec.requirement import Requirement
    from gradcal_jax.spec.schedule import StandardSchedule
    from gradcal_jax.spec.spec_sections import Spec

_MOST_ROWS: Final = 24
_MOST_MOVES: Final = 60


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

    absent, supplied = absent_terms(spec), class_terms(spec)
    others = [*branch_sentences(spec), *attitude_sentences(spec)]
    lines: list[str] = []
    if supplied:
        rows = [(term.key, term.typical, term.source) for term in supplied]
        lines += ["these terms have typical figures of the stated class; state your own in the file if you can:"]
        lines.append(columns(rows, width=120))
    if not absent:
        return [*lines, *others]
    sensor, table = sensor_grade(spec.sensor), table_grade(spec)
    return [
        *lines,
        "these terms are not in the file, so figures typical of the class count:",
        columns([(term.key, term.typical) for term in absent]),
        f"  class of the sensor: {sensor.name} grade ({sensor.like}), from {sensor.reason}",
        f"  class of the table: {table.name} ({table.like}), from {table.reason}",
        "enter your own figures in the file; 0 (or an empty list) means that there is no such error",
        *others,
    ]


def summary(spec: "Spec") -> str:
    """A summary of the plan as plain text, from the file alone."""
    from gradcal_jax.spec.schedule import StandardSchedule

    schedule, table = spec.schedule, spec.rig.table
    lines = [*_sensors(spec), *map(_required, spec.requirement)]
    words = f"table: {', '.join(axis.name for axis in table.axis)}"
    words += " (outermost first)" if len(table.axis) > 1 else ""
    words += f"; {len(table.mounting)} mountings" if len(table.mounting) > 1 else ""
    lines.append(words)
    lines += _standard(schedule) if isinstance(schedule, StandardSchedule) else _gradient(spec, schedule)
    return "\n".join([*lines, *(f"note: {note}" for note in notes(spec))])


def _sensors(spec: "Spec") -> "Iterator[str]":
    from gradcal_jax.tables.section import Section

    skipped = {"axes", "drift", "scale_factor_instability", "temperature_error"}
    for name, triad in (("gyro", spec.sensor.gyro), ("accelerometer", spec.sensor.accelerometer)):
        if triad is None:
            continue
        own: list[str] = []
        for key, part in triad:
            first = part[0] if isinstance(part, tuple) and part else part
            if isinstance(first, Section) and key not in skipped:
                size = getattr(part, "size", None)
                own.append(key.replace("_", " ") + (f" ({size})" if size is not None else ""))
        yield f"to estimate: {name} {', '.join(triad.axes)}: {', '.join(own)}"


def _required(requirement: "Requirement") -> str:
    r: Any = requirement
    over = f"{r.temperature[0]} to {r.temperature[1]}"
    if hasattr(r, "mission"):
        missions = (f"{m.file} ({time_text(m.rows.time[-1])})" for m in r.mission)
        over = f"{', '.join(missions)}, {over}"
    if isinstance(getattr(r, "rate", None), tuple):
        over += f", {r.rate[0]} to {r.rate[1]}"
    target = f", target {r.target}" if r.target is not None else ""
    return f'required: "{r.name}": {r.quantity.replace("_", " ")}, {r.axis}, {r.statistic}, {over}{target}'


def _standard(schedule: "StandardSchedule") -> list[str]:
    temperatures = ", ".join(f"{temperature:g}" for temperature in schedule.temperatures)
    rates = ", ".join(f"{math.degrees(rate):g}" for rate in schedule.rates)
    at = f"at {rates} deg/s" if any(schedule.rates) else "standing still"
    return [
        "plan: standard method, " + times_text(schedule.duration, schedule.soak, schedule.motion, "integration"),
        f"  at {temperatures} degC: soak {time_text(schedule.soak_each)}",
        f"  {at}: {time_text(schedule.integration)} each; {schedule.readings} points",
    ]


def _gradient(spec: "Spec", schedule: "PlanSchedule") -> list[str]:
    from gradcal_jax.spec.motion_plan import duration_of, row_count

    total = times_text(schedule.duration, schedule.soak, schedule.motion, "temperature motion")
    table = spec.rig.table
    every = time_text(float(table.axis[0].angle.read_every)) if table.standing == "read" else ""
    readings = f"readings: {row_count(schedule, spec.rig.table)}"
    lines = [f"plan: gradient method, {total}; {len(schedule.segments)} segments"]
    rows: list[tuple[str, ...]] = []
    for segment in schedule.segments[:_MOST_ROWS]:
        soaks = segment.kind == "soak"
        where = f"{segment.temperature_start:.5g}" + ("" if soaks else f" -> {segment.temperature_end:.5g}")
        slope = "" if soaks else f"{60.0 * segment.slope:+.4g} K/min"
        used = "" if segment.used else "not used"
        begins = f"at {time_text(segment.start)}"
        rows.append((begins, segment.kind, time_text(segment.duration), f"{where} degC", slope, used))
    lines += _first(rows, len(schedule.segments))
    if not schedule.steps:
        return [*lines, "  the table stands" + (f" and is read every {every}" if every else ""), readings]
    parts = [f"moves {time_text(duration_of(schedule.steps))}"]
    parts += [f"other axes {time_text(s.move.duration)} ({_read(s.move, every)})" for s in schedule.after]
    cycles = sum(stretch.cycles for stretch in schedule.stretches)
    lines.append(f"cycle: {time_text(schedule.period)}, made {cycles} times: {', '.join(parts)}")
    moves: list[tuple[str, ...]] = []
    for step in schedule.steps[:_MOST_MOVES]:
        axis = table.axis[step.axis].name if step.axis >= 0 else ""
        moves.append((*_turn(step.move, axis), _read(step.move, every)))
    return [*lines, *_first(moves, len(schedule.steps), right=(0,)), readings]


def _read(move: "ResolvedMove", every: str) -> str:
    """How a move or a rest is read; `every`: of a table that is read as it stands."""
    if move.read_every is not None:
        return "read at the end" if math.isinf(move.read_every) else f"read every {time_text(move.read_every)}"
    if move.reads_as_table:
        return f"read every {every}" if every else ""
    return "read at the end" if move.read_end else "not read"


def _first(rows: list[tuple[str, ...]], count: int, right: tuple[int, ...] = ()) -> list[str]:
    """The first rows of `count`, and the number of further ones."""
    return [columns(rows, right=right), *([f"  … and {count - len(rows)} more"] if count > len(rows) else [])]


def _turn(move: "ResolvedMove", axis: str) -> tuple[str, ...]:
    """Number of repetitions, axis, shape, duration, angle, peak rate and acceleration of a move."""
    count = f"{move.repeat} ×" if move.repeat > 1 else ""
    turn = ("", "", "")
    if not move.is_rest:
        turn = (
            f"{math.degrees(move.angle):+.6g} deg",
            f"up to {math.degrees(move.fastest):.4g} deg/s",
            f"{math.degrees(move.peak_acceleration):.4g} deg/s^2",
        )
    return (count, axis, move.shape, time_text(move.duration), *turn)


def notes(spec: "Spec") -> list[str]:
    """Notes on a sound spec: unused time, and requirements beyond the temperatures of the plan."""
    from gradcal_jax.spec.schedule import StandardSchedule

    sentences: list[str] = []
    schedule = spec.schedule
    if isinstance(schedule, StandardSchedule):
        visited = list(schedule.temperatures)
        if any(schedule.rates) and spec.rig.table.rate_accuracy is None:
            sentences.append("state rig.table.rate_accuracy: the reference rate counts as exact")
    else:
        used = [segment for segment in schedule.segments if segment.used]
        visited = [t for segment in used for t in (segment.temperature_start, segment.temperature_end)]
        left = sum(stretch.leftover for stretch in schedule.stretches)
        if schedule.steps and left > 0.0:
            sentences.append(f"after the moves of the last cycle, the table stays at rest for {time_text(left)}")
    low, high = min(visited), max(visited)
    for requirement in spec.requirement:
        if requirement.temperature[0] < low - 1e-6 or requirement.temperature[1] > high + 1e-6:
            sentences.append(
                f'requirement "{requirement.name}" includes temperatures outside the plan\'s range, '
                f"{low:.5g} to {high:.5g} degC"
            )
    return sentences
