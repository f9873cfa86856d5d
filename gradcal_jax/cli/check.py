"""`gradcal check`: everything wrong with a spec at once; if nothing is, what its plan does."""

import math
from typing import TYPE_CHECKING, Any

from gradcal_jax.cli.console import strong
from gradcal_jax.cli.output import Flag, Json, SpecPath, as_json
from gradcal_jax.cli.precision import use_float64
from gradcal_jax.cli.predict import counted_as_zero
from gradcal_jax.cli.status import DONE, NOT_AS_WISHED
from gradcal_jax.pages.plain_text import columns, times_text
from gradcal_jax.units import time_text

if TYPE_CHECKING:
    from gradcal_jax.files import Spec
    from gradcal_jax.files.moves import ResolvedMove
    from gradcal_jax.files.schedule import GradientSchedule, ResolvedCycle, StandardSchedule
    from gradcal_jax.files.unit_spec import UnitSpec

_MOST_ROWS, _MOST_OF_UNIT = 24, 60


def check(spec: SpecPath, /, *, files_only: Flag = False, json: Json = False) -> int:
    """Say all that is wrong with a spec, or what its plan does.

    If nothing is wrong, it also says what the plan cannot observe.

    Parameters
    ----------
    files_only
        Leave out what the plan cannot observe, which takes a few seconds to work out.
    json
        Print the plan's times, notes, and what it cannot observe, as JSON.
    """
    from gradcal_jax.files.memory import needed_bytes, too_large
    from gradcal_jax.files.recipe import any_spec_in
    from gradcal_jax.files.unit_spec import UnitSpec

    found = any_spec_in(spec)
    if isinstance(found, UnitSpec):
        return check_unit(found, str(spec), files_only=files_only, json=json)
    if json:
        too = too_large(found)
        blind = None if files_only or too else unobservable_of(found)
        print(as_json(numbers(found) | {"memory_bytes": needed_bytes(found), "unobservable": blind}))
        return NOT_AS_WISHED if too else DONE
    print(strong(found.title or str(spec)))
    print(summary(found))
    said = counted_as_zero(found)
    print("\n".join(said)) if said else None
    if too := too_large(found):
        print(f"too large: {too}")
        return NOT_AS_WISHED
    blind = [] if files_only else unobservable_of(found)
    for sentence in blind:
        print(f"cannot be observed: {sentence}")
    print("the spec is sound" + ("; see what it cannot observe" if blind else ""))
    return DONE


def unobservable_of(spec: "Spec") -> list[str]:
    """A sentence for each combination of parameters that the plan cannot observe."""
    use_float64()
    from gradcal_jax import api

    return api.unobservable(spec)


def numbers(spec: "Spec") -> dict[str, Any]:
    """What the plan does, for other programs: times in s."""
    from gradcal_jax.files.absent import absent_terms

    schedule = spec.schedule
    told = {"title": spec.title, "method": spec.plan.method, "duration_s": schedule.duration, "soak_s": schedule.soak}
    return told | {
        "motion_s": schedule.motion,
        "requirements": [r.name for r in spec.requirement],
        "notes": notes(spec),
        "counted_as_zero": [{"key": t.key, "typical": t.typical, "source": t.source} for t in absent_terms(spec)],
    }


def summary(spec: "Spec") -> str:
    """What the plan does, in lines of plain text, from the file alone."""
    from gradcal_jax.files.schedule import GradientSchedule

    schedule = spec.schedule
    lines = _gradient(schedule) if isinstance(schedule, GradientSchedule) else _standard(schedule)
    return "\n".join([*_sensor(spec), *lines, *(f"note: {note}" for note in notes(spec))])


def _sensor(spec: "Spec") -> list[str]:
    parts: list[str] = []
    if spec.sensor.bias is not None:
        parts.append(f"bias ({spec.sensor.bias.size})")
    if spec.sensor.scale_factor is not None:
        parts.append(f"scale factor ({spec.sensor.scale_factor.size})")
    if spec.sensor.bias_temperature_gradient is not None:
        parts.append("bias temperature gradient (1)")
    lines = [f"to be found: {', '.join(parts)}"]
    for requirement in spec.requirement:
        box = f"{requirement.temperature[0]} to {requirement.temperature[1]}"
        if requirement.quantity == "heading":
            missions = (f"{m.file} ({time_text(requirement.after or m.rows.time[-1])})" for m in requirement.mission)
            box = f"{', '.join(missions)}, {box}"
        elif requirement.quantity == "north":
            box = f"latitude {requirement.latitude}, after {requirement.after}, {box}"
        if requirement.quantity == "scale_factor" or requirement.quantity == "heading":
            box += f", {requirement.rate[0]} to {requirement.rate[1]}"
        target = f", target {requirement.target}" if requirement.target is not None else ""
        what = requirement.quantity.replace("_", " ")
        lines.append(f'required: "{requirement.name}": {what}, {requirement.statistic}, {box}{target}')
    return lines


def _standard(schedule: "StandardSchedule") -> list[str]:
    temperatures = ", ".join(f"{temperature:g}" for temperature in schedule.temperatures)
    lines = [
        "plan: standard method, " + times_text(schedule.duration, schedule.soak, schedule.motion, "integration"),
        f"  at {temperatures} degC: soak {time_text(schedule.soak_each)}",
    ]
    rates = ", ".join(f"{math.degrees(rate):g}" for rate in schedule.rates)
    at = f"at {rates} deg/s" if any(schedule.rates) else "standing still"
    lines.append(f"  {at}: {time_text(schedule.integration)} each; {len(schedule.points)} points")
    return lines


def _gradient(schedule: "GradientSchedule") -> list[str]:
    total = times_text(schedule.duration, schedule.soak, schedule.motion, "temperature motion")
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
    lines.append(columns(rows))
    if len(schedule.segments) > _MOST_ROWS:
        lines.append(f"  … and {len(schedule.segments) - _MOST_ROWS} more")
    if schedule.cycle is not None:
        lines += _cycle(schedule.cycle, schedule)
    elif schedule.read_every is not None:
        lines.append(f"  the axis stands and is read every {time_text(schedule.read_every)}")
    lines.append(f"readings: {schedule.readings}")
    return lines


def _cycle(cycle: "ResolvedCycle", schedule: "GradientSchedule") -> list[str]:
    parts = [f"moves {time_text(cycle.moving)}"]
    if cycle.other:
        read = "not read" if cycle.other_read_every is None else f"read every {time_text(cycle.other_read_every)}"
        parts.append(f"other axes {time_text(cycle.other)} ({read})")
    if cycle.idle:
        parts.append(f"standing {time_text(cycle.idle)} (not read)")
    lines = [f"cycle: {time_text(cycle.duration)}, made {schedule.cycles} times: {', '.join(parts)}"]
    lines.append(columns([_move(move) for move in cycle.moves[:_MOST_ROWS]], right=(0,)))
    if len(cycle.moves) > _MOST_ROWS:
        lines.append(f"  … and {len(cycle.moves) - _MOST_ROWS} more")
    return lines


def _move(move: "ResolvedMove") -> tuple[str, ...]:
    count = f"{move.repeat} ×" if move.repeat > 1 else ""
    if move.read_every is not None:
        read = f"read every {time_text(move.read_every)}"
    else:
        read = "read at the end" if move.read_end else "not read"
    if move.is_rest:
        return (count, move.axis, "rest", time_text(move.duration), "", "", "", read)
    return (
        count,
        move.axis,
        move.shape,
        time_text(move.duration),
        f"{math.degrees(move.angle):+.6g} deg",
        f"up to {math.degrees(move.fastest):.4g} deg/s",
        f"{math.degrees(move.peak_acceleration):.4g} deg/s^2",
        read,
    )


def notes(spec: "Spec") -> list[str]:
    """What is no fault but worth knowing: time left over, and requirements further out than the plan goes."""
    from gradcal_jax.files.schedule import GradientSchedule

    said: list[str] = []
    schedule = spec.schedule
    if isinstance(schedule, GradientSchedule):
        used = [segment for segment in schedule.segments if segment.used]
        visited = [t for segment in used for t in (segment.temperature_start, segment.temperature_end)]
        rates = [move.fastest for move in schedule.cycle.moves] if schedule.cycle is not None else [0.0]
        left = sum(stretch.leftover for stretch in schedule.stretches)
        if schedule.cycle is not None and left > 0.0:
            said.append(f"after the last cycle's moves the axis stands for {time_text(left)}")
    else:
        visited, rates = list(schedule.temperatures), [abs(rate) for rate in schedule.rates]
        if any(schedule.rates) and spec.rig.table.rate_accuracy is None:
            said.append("rig.table.rate_accuracy is absent: the reference rate counts as exact")
    low, high = min(visited), max(visited)
    for requirement in spec.requirement:
        if requirement.temperature[0] < low - 1e-6 or requirement.temperature[1] > high + 1e-6:
            said.append(f'requirement "{requirement.name}" goes beyond the plan\'s {low:.5g} to {high:.5g} degC')
        if requirement.quantity == "scale_factor" or requirement.quantity == "heading":
            asked = max(abs(rate) for rate in requirement.rate)
            if asked > max(rates) * (1.0 + 1e-6):
                reached = math.degrees(max(rates))
                said.append(
                    f'requirement "{requirement.name}" goes beyond the plan\'s fastest rate, {reached:.5g} deg/s'
                )
    return said


def check_unit(spec: "UnitSpec", name: str, *, files_only: bool, json: bool) -> int:
    """Print what a unit's plan does, and what it cannot observe."""
    blind: list[str] | None = None
    if not files_only:
        use_float64()
        from gradcal_jax.api.flow import check as blind_of

        blind = blind_of(spec)
    schedule = spec.schedule
    if json:
        numbers: dict[str, Any] = {"title": spec.title, "method": spec.plan.method, "duration_s": schedule.duration}
        numbers |= {"soak_s": schedule.soak, "motion_s": schedule.motion}
        numbers |= {"requirements": [r.name for r in spec.requirement], "unobservable": blind}
        print(as_json(numbers))
        return DONE
    print(strong(spec.title or name))
    print("\n".join(_summary_of_unit(spec)))
    for sentence in blind or ():
        print(f"note: {sentence}")
    print("the spec is sound" + ("; see what it cannot observe" if blind else ""))
    return DONE


def _summary_of_unit(spec: "UnitSpec") -> list[str]:
    from gradcal_jax.files.section import Section

    schedule, table = spec.schedule, spec.rig.table
    skipped = {"axes", "drift", "scale_factor_instability"}
    lines: list[str] = []
    for name, triad in (("gyro", spec.sensor.gyro), ("accelerometer", spec.sensor.accelerometer)):
        if triad is not None:
            own = [key.replace("_", " ") for key, part in triad if isinstance(part, Section) and key not in skipped]
            lines.append(f"to be found: {name} {', '.join(triad.axes)}: {', '.join(own)}")
    for r in spec.requirement:
        target = f", target {r.target}" if r.target is not None else ""
        over = f"{r.temperature[0]} to {r.temperature[1]}"
        lines.append(f'required: "{r.name}": {r.quantity.replace("_", " ")}, {r.axis}, {r.statistic}, {over}{target}')
    lines.append(
        f"table: {', '.join(axis.name for axis in table.axis)} (outermost first)"
        + (f"; {len(table.mounting)} mountings" if len(table.mounting) > 1 else "")
    )
    lines.append("plan: " + times_text(schedule.duration, schedule.soak, schedule.motion, "temperature motion"))
    made = sum(stretch.cycles for stretch in schedule.stretches)
    lines.append(f"cycle: {time_text(schedule.period)}, made {made} times")
    rows = [_row_of_unit(step, table) for step in schedule.steps[:_MOST_OF_UNIT]]
    lines.append(columns(rows))
    if len(schedule.steps) > _MOST_OF_UNIT:
        lines.append(f"  … and {len(schedule.steps) - _MOST_OF_UNIT} more")
    left = sum(stretch.leftover for stretch in schedule.stretches)
    if left > 0.0:
        lines.append(f"note: after the last cycle the table stands for {time_text(left)}")
    return lines


def _row_of_unit(step, table) -> tuple[str, ...]:
    move = step.move
    count = f"{move.repeat} ×" if move.repeat > 1 else ""
    if step.axis < 0:
        return (count, "", "rest", time_text(move.duration), "", "")
    return (
        count,
        table.axis[step.axis].name,
        move.shape,
        time_text(move.duration),
        f"{math.degrees(move.angle):+.6g} deg",
        f"up to {math.degrees(move.fastest):.4g} deg/s",
    )
