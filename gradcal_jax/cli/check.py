"""`gradcal check`: all errors of a spec at once; a summary of its plan, its timeline, or a recipe; and `--upgrade`."""

import csv as comma_separated
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from gradcal_jax.cli.output import DONE, NOT_AS_WISHED, Flag, Force, Json, OptionalOutput, as_json, strong, writable
from gradcal_jax.cli.precision import use_float64
from gradcal_jax.cli.predict import omitted_lines
from gradcal_jax.tables.display import columns
from gradcal_jax.units import time_text, times_text

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from gradcal_jax.spec.motion_plan import PlanSchedule
    from gradcal_jax.spec.moves import ResolvedMove
    from gradcal_jax.spec.requirement import Requirement
    from gradcal_jax.spec.schedule import StandardSchedule
    from gradcal_jax.spec.spec_sections import Spec
    from gradcal_jax.tables.section import Section
    from gradcal_jax.tables.timeline import Timeline

_MOST_ROWS, _MOST_MOVES = 24, 60


def check(
    file: Path,
    /,
    *,
    timeline: Literal["segments", "readings"] | None = None,
    csv: Annotated[bool, Parameter(name="--csv", negative="")] = False,
    files_only: Flag = False,
    upgrade: Flag = False,
    output: OptionalOutput = None,
    force: Force = False,
    json: Json = False,
) -> int:
    """List all errors of a spec, or describe its plan and what the plan cannot observe; print a recipe as a table.

    Parameters
    ----------
    file
        The spec file, or a recipe. The table of a recipe lists the steps of the chamber, the moves of the rate table,
        and the predicted errors.
    timeline
        Print every segment or every reading of the plan instead of the description.
    csv
        Print the rows of the timeline as comma-separated values, in SI units.
    upgrade
        Convert a spec, recipe or calibration of an earlier version to the current format, with the same contents. This
        is optional: every command reads the earlier formats as well.
    output
        The file that --upgrade writes; by default FILE is replaced, and its earlier contents are saved as FILE.old.
    files_only
        Skip the computation of what the plan cannot observe; this computation takes a few seconds.
    json
        Print as JSON: the times of the plan, the notes, and what the plan cannot observe; or the contents of a recipe.
        With --timeline, print gradcal-timeline/3: segments, readings and the models of all sensors, in SI units.
    """
    from gradcal_jax.recipe.recipe import Recipe, spec_or_recipe
    from gradcal_jax.spec.memory import needed_bytes, too_large

    if upgrade:
        return upgrade_file(file, output, force=force)
    if output is not None:
        raise ValueError("--output is only for --upgrade")
    if csv and timeline is None:
        raise ValueError("--csv is only for --timeline segments or --timeline readings")
    contents = spec_or_recipe(file)
    specification = contents.spec if isinstance(contents, Recipe) else contents
    if timeline is not None:
        print_timeline(specification, timeline, csv=csv, json=json)
        return DONE
    if isinstance(contents, Recipe):
        from gradcal_jax.pages.bench_sheet import show

        print(contents.model_dump_json(indent=2, exclude_none=True) if json else show(contents, heading=strong))
        return DONE
    too = too_large(specification)
    wanted = not files_only and not too
    if json:
        record = numbers(specification) | {"memory_bytes": needed_bytes(specification)}
        print(as_json(record | {"unobservable": blind_of(specification) if wanted else None}))
        return NOT_AS_WISHED if too else DONE
    print(strong(specification.title or str(file)))
    print(summary(specification))
    omitted = omitted_lines(specification)
    print("\n".join(omitted)) if omitted else None
    if too:
        print(f"too large: {too}")
        return NOT_AS_WISHED
    blind = blind_of(specification) if wanted else []
    for sentence in blind:
        print(f"{'cannot be observed' if 'cannot observe' in sentence else 'note'}: {sentence}")
    print("the spec has no errors" + ("; read the warnings above" if blind else ""))
    return DONE


def blind_of(spec: "Spec") -> list[str]:
    """All warnings of `check`: what the plan cannot observe, and requirements beyond its range."""
    use_float64()
    from gradcal_jax.information.plan_sentences import check as check_of

    return check_of(spec)


def numbers(spec: "Spec") -> dict[str, Any]:
    """A summary of the plan for other programs; times in s."""
    from gradcal_jax.spec.absent import absent_terms

    record: dict[str, Any] = {"title": spec.title, "method": spec.plan.method}
    record |= {f"{name}_s": getattr(spec.schedule, name) for name in ("duration", "soak", "motion")}
    record["requirements"] = [r.name for r in spec.requirement]
    record["omitted"] = [{"key": t.key, "typical": t.typical, "source": t.source} for t in absent_terms(spec)]
    return record | {"notes": notes(spec)}


def summary(spec: "Spec") -> str:
    """A summary of the plan as plain text, from the file alone."""
    from gradcal_jax.spec.schedule import StandardSchedule

    schedule, table = spec.schedule, spec.rig.table
    lines = [*_sensors(spec), *map(_required, spec.requirement)]
    lines.append(
        f"table: {', '.join(axis.name for axis in table.axis)}"
        + (" (outermost first)" if len(table.axis) > 1 else "")
        + (f"; {len(table.mounting)} mountings" if len(table.mounting) > 1 else "")
    )
    lines += _standard(schedule) if isinstance(schedule, StandardSchedule) else _gradient(spec, schedule)
    return "\n".join([*lines, *(f"note: {note}" for note in notes(spec))])


def _sensors(spec: "Spec") -> "Iterator[str]":
    from gradcal_jax.tables.section import Section

    skipped = {"axes", "drift", "scale_factor_instability", "temperature_error"}
    for name, triad in (("gyro", spec.sensor.gyro), ("accelerometer", spec.sensor.accelerometer)):
        if triad is not None:
            own = [
                key.replace("_", " ") + (f" ({size})" if (size := getattr(part, "size", None)) is not None else "")
                for key, part in triad
                if isinstance(part[0] if isinstance(part, tuple) and part else part, Section) and key not in skipped
            ]
            yield f"to estimate: {name} {', '.join(triad.axes)}: {', '.join(own)}"


def _required(requirement: "Requirement") -> str:
    r: Any = requirement
    over = f"{r.temperature[0]} to {r.temperature[1]}"
    if hasattr(r, "mission"):
        missions = (f"{m.file} ({time_text(r.after or m.rows.time[-1])})" for m in r.mission)
        over = f"{', '.join(missions)}, {over}"
    elif hasattr(r, "latitude"):
        over = f"latitude {r.latitude}, after {r.after}, {over}"
    if isinstance(getattr(r, "rate", None), tuple):
        over += f", {r.rate[0]} to {r.rate[1]}"
    target = f", target {r.target}" if r.target is not None else ""
    return f'required: "{r.name}": {r.quantity.replace("_", " ")}, {r.axis}, {r.statistic}, {over}{target}'


def _standard(schedule: "StandardSchedule") -> list[str]:
    temperatures = ", ".join(f"{temperature:g}" for temperature in schedule.temperatures)
    lines = [
        "plan: standard method, " + times_text(schedule.duration, schedule.soak, schedule.motion, "integration"),
        f"  at {temperatures} degC: soak {time_text(schedule.soak_each)}",
    ]
    rates = ", ".join(f"{math.degrees(rate):g}" for rate in schedule.rates)
    at = f"at {rates} deg/s" if any(schedule.rates) else "standing still"
    lines.append(f"  {at}: {time_text(schedule.integration)} each; {schedule.readings} points")
    return lines


def _gradient(spec: "Spec", schedule: "PlanSchedule") -> list[str]:
    from gradcal_jax.spec.motion_plan import duration_of, row_count

    total = times_text(schedule.duration, schedule.soak, schedule.motion, "temperature motion")
    table = spec.rig.table
    every = time_text(float(table.axis[0].angle.read_every)) if table.standing == "read" else ""
    readings = f"readings: {row_count(schedule, spec.rig.table)}"
    lines = [f"plan: gradient method, {total}; {len(schedule.segments)} segments"]
    rows: list[tuple[str, ...]] = []
    for segment in schedule.segments[:_MOST_ROWS]:
        where = f"{segment.temperature_start:.5g}"
        if segment.kind != "soak":
            where += f" -> {segment.temperature_end:.5g}"
        slope = "" if segment.kind == "soak" else f"{60.0 * segment.slope:+.4g} K/min"
        used = "" if segment.used else "not used"
        rows.append(
            (f"at {time_text(segment.start)}", segment.kind, time_text(segment.duration), f"{where} degC", slope, used)
        )
    lines += _first(rows, len(schedule.segments))
    if not schedule.steps:
        return [*lines, "  the table stands" + (f" and is read every {every}" if every else ""), readings]
    parts = [f"moves {time_text(duration_of(schedule.steps))}"]
    for step, name in zip(schedule.after, ("other axes", "standing"), strict=False):
        parts.append(f"{name} {time_text(step.move.duration)} ({_read(step.move, every)})")
    cycles = sum(stretch.cycles for stretch in schedule.stretches)
    lines.append(f"cycle: {time_text(schedule.period)}, made {cycles} times: {', '.join(parts)}")
    moves = [
        (*_turn(step.move, table.axis[step.axis].name if step.axis >= 0 else ""), _read(step.move, every))
        for step in schedule.steps[:_MOST_MOVES]
    ]
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
            sentences.append("rig.table.rate_accuracy is absent: the reference rate is assumed to be exact")
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


def upgrade_file(file: Path, output: Path | None, *, force: bool) -> int:
    """Write a spec, recipe or calibration in the current format to `output`; by default it replaces the file, which is
    saved as FILE.old."""
    from gradcal_jax.tables.document import read_text, read_toml
    from gradcal_jax.tables.writing import write_toml, write_whole

    text = read_text(file)
    model, done = _upgraded(text, read_toml(text, str(file)), file)
    if not done:
        print(f"{file} already has the current format; nothing was written")
        return DONE
    kept = None if output is not None else file.with_name(f"{file.name}.old")
    writable(output or kept or file, force)
    if kept is not None:
        write_whole(kept, text)
    goal = output or file
    write_toml(model, goal, header=f"Converted by `gradcal check --upgrade` from {file.name}.")
    print("\n".join(f"  {line}" for line in done))
    if any(line.lstrip().startswith("#") or " #" in line for line in text.splitlines()):
        print(f"note: the comments in {kept or file} were not copied to {goal}")
    print(f"wrote {goal}" + (f"; the original file is now {kept}" if kept is not None else ""))
    return DONE


def _upgraded(text: str, document: dict[str, Any], file: Path) -> "tuple[Section, list[str]]":
    """The file's contents, and what of its form is an earlier version's. Raises `SpecError`, and `ValueError` for files
    of other kinds."""
    from gradcal_jax.calibration.file import OLD_FORMATS, is_calibration, parse_calibration
    from gradcal_jax.recipe.recipe import is_recipe, parse_recipe
    from gradcal_jax.spec.axis_as_imu import is_of_axis
    from gradcal_jax.spec.mission import missions_from
    from gradcal_jax.spec.spec import FORMAT, parse_spec

    if is_calibration(document):
        model = parse_calibration(text, str(file))
        if (old := document["format"]) not in OLD_FORMATS:
            return model, []
        channels = ", with a [[channel]] for each sensor axis" if old == OLD_FORMATS[0] else ""
        return model, [f"{old} -> {model.format}{channels}; misalignments are multiplied by the scale factor"]
    if is_recipe(document):
        model = parse_recipe(text, str(file))
        if not is_of_axis(document["spec"]):
            return model, []
        names = 'motion: each move names the axis that it turns; names of parameters: "b00" -> "gyro_x.b00"'
        return model, [*_moved(document["spec"], "spec."), names]
    if document.get("format") != FORMAT:
        raise ValueError(f"{file}: expected a spec, a recipe or a calibration")
    with missions_from(file.parent):
        model = parse_spec(text, str(file))
    return model, _moved(document, "") if is_of_axis(document) else []


def _moved(spec: dict[str, Any], above: str) -> list[str]:
    """What of a spec of one axis has another place."""
    moved = [
        f"[{above}sensor] -> [{above}sensor], and [{above}sensor.gyro] with its axis",
        f"[{above}rig.table] -> [{above}rig.table], and [[{above}rig.table.axis]] with the spacing of its readings",
    ]
    if "earth_rate" in spec["rig"]:
        moved.append(f"{above}rig.earth_rate -> {above}rig.site.latitude")
    if spec.get("requirement"):
        moved.append(f'[[{above}requirement]]: quantities begin with the sensor\'s name, such as "gyro_bias"')
    if spec.get("done"):
        moved.append(f"[[{above}done]]: the same changes in each plan")
    return moved


_MOST_PRINTED = 60


def print_timeline(spec: "Spec", rows: str, *, csv: bool, json: bool) -> None:
    """Print the `rows` of a spec's timeline, "segments" or "readings": as a table, as CSV, or all as JSON."""
    if json and csv:
        raise ValueError("--json and --csv: use only one of them")
    use_float64()
    from gradcal_jax.information import timeline

    contents = timeline.timeline(spec)
    if json:
        print(contents.model_dump_json(indent=2, exclude_none=True))
    elif csv:
        _as_csv(contents.segments if rows == "segments" else contents.readings)
    else:
        print(_table(contents, rows))


def _as_csv(entries: "Sequence[Section]") -> None:
    names = list(type(entries[0]).model_fields)
    writer = comma_separated.writer(sys.stdout, lineterminator="\n")
    writer.writerow(names)
    for entry in entries:
        writer.writerow([_cell(getattr(entry, name)) for name in names])


def _cell(value: object) -> object:
    """A cell of the table: a (nested) list as words with spaces between."""
    if isinstance(value, tuple):
        return " ".join("-" if v is None else str(_cell(v)) for v in value)
    return "" if value is None else value


def _table(plan: "Timeline", rows: str) -> str:
    axes = [f"{axis.name}, deg" for axis in plan.table]
    if rows == "segments":
        table: list[tuple[str, ...]] = [("start", "what", "lasts", *axes, "up, from the IMU", "chamber, degC")]
        for s in plan.segments[:_MOST_PRINTED]:
            what = s.shape if s.axis is None else f"{s.axis}: {s.shape}, {math.degrees(s.angle):+.4g} deg"
            pairs = zip(s.angles_before, s.angles_after, strict=True)
            angles = (_degrees(a) + (f" -> {_degrees(b)}" if a != b else "") for a, b in pairs)
            up = " ".join(f"{round(v, 2) + 0.0:+.2f}" for v in s.attitude[2]) if s.axis is None else ""
            chamber = f"{s.temperature_start:.2f} -> {s.temperature_end:.2f}"
            table.append((time_text(s.start), what, time_text(s.duration), *angles, up, chamber))
    else:
        table = [("from, s", "to, s", "standstill", "read")]
        for r in plan.readings[:_MOST_PRINTED]:
            stands = " ".join("-" if k is None else str(k) for k in r.standstill_ids)
            kinds = dict.fromkeys(name.rpartition("_")[0] + "s" for name in r.channels)
            table.append((f"{r.start:.3f}", f"{r.time:.3f}", stands, ", ".join(kinds)))
    lines, count = [columns(table, indent="")], len(plan.segments if rows == "segments" else plan.readings)
    if count > _MOST_PRINTED:
        lines.append(f"… and {count - _MOST_PRINTED} more rows: --csv or --json prints all")
    lines.append(f"{len(plan.segments)} segments, {len(plan.readings)} readings of {len(plan.channels)} channels")
    return "\n".join(lines)


def _degrees(angle: float) -> str:
    return f"{round(math.degrees(angle), 6) + 0.0:.7g}"
