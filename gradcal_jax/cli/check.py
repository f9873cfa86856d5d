"""`gradcal check`: all errors of a spec at once; without any, a summary of its plan."""

import math
from typing import TYPE_CHECKING, Any

from gradcal_jax.cli.console import strong
from gradcal_jax.cli.output import Flag, Json, SpecPath, as_json
from gradcal_jax.cli.precision import use_float64
from gradcal_jax.cli.predict import omitted_lines
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
    """List all errors of a spec, or print what its plan does.

    Without errors, also list what the plan cannot observe.

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

    specification = any_spec_in(spec)
    of_axes = None if isinstance(specification, UnitSpec) else specification
    too = None if of_axes is None else too_large(of_axes)
    wanted = not files_only and not too
    if json:
        record = numbers(specification) | ({} if of_axes is None else {"memory_bytes": needed_bytes(of_axes)})
        print(as_json(record | {"unobservable": blind_of(specification) if wanted else None}))
        return NOT_AS_WISHED if too else DONE
    print(strong(specification.title or str(spec)))
    print(summary_of_unit(specification) if isinstance(specification, UnitSpec) else summary(specification))
    omitted = omitted_lines(specification)
    print("\n".join(omitted)) if omitted else None
    if too:
        print(f"too large: {too}")
        return NOT_AS_WISHED
    blind = blind_of(specification) if wanted else []
    for sentence in blind:
        print(f"{'note' if of_axes is None else 'cannot be observed'}: {sentence}")
    print("the spec is sound" + ("; see what it cannot observe" if blind else ""))
    return DONE


def blind_of(spec: "Spec | UnitSpec") -> list[str]:
    """All warnings of `check`: what the plan cannot observe, and what requirements ask for beyond it."""
    use_float64()
    from gradcal_jax.api.flow import check as check_of

    return check_of(spec)


def numbers(spec: "Spec | UnitSpec") -> dict[str, Any]:
    """A summary of the plan for other programs; times in s."""
    from gradcal_jax.files.absent import absent_terms
    from gradcal_jax.files.unit_spec import UnitSpec

    record: dict[str, Any] = {"title": spec.title, "method": spec.plan.method}
    record |= {f"{name}_s": getattr(spec.schedule, name) for name in ("duration", "soak", "motion")}
    record["requirements"] = [r.name for r in spec.requirement]
    record["omitted"] = [{"key": t.key, "typical": t.typical, "source": t.source} for t in absent_terms(spec)]
    return record | ({} if isinstance(spec, UnitSpec) else {"notes": notes(spec)})


def summary(spec: "Spec") -> str:
    """A summary of the plan as plain text, from the file alone."""
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
    if spec.sensor.gradient_sensitivity is not None:
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
    lines += _first(rows, len(schedule.segments))
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
    return lines + _first([_move(move) for move in cycle.moves[:_MOST_ROWS]], len(cycle.moves), right=(0,))


def _first(rows: list[tuple[str, ...]], count: int, right: tuple[int, ...] = ()) -> list[str]:
    """The first rows of `count`, and the number of further ones."""
    return [columns(rows, right=right), *([f"  … and {count - len(rows)} more"] if count > len(rows) else [])]


def _move(move: "ResolvedMove") -> tuple[str, ...]:
    if move.read_every is not None:
        read = f"read every {time_text(move.read_every)}"
    else:
        read = "read at the end" if move.read_end else "not read"
    steep = "" if move.is_rest else f"{math.degrees(move.peak_acceleration):.4g} deg/s^2"
    return (*_turn(move, move.axis), steep, read)


def _turn(move: "ResolvedMove", axis: str) -> tuple[str, ...]:
    """Number of repetitions, axis, shape, duration, angle and peak rate of a move."""
    count = f"{move.repeat} ×" if move.repeat > 1 else ""
    turn = ("", "")
    if not move.is_rest:
        turn = f"{math.degrees(move.angle):+.6g} deg", f"up to {math.degrees(move.fastest):.4g} deg/s"
    return (count, axis, move.shape, time_text(move.duration), *turn)


def notes(spec: "Spec") -> list[str]:
    """Notes on a sound spec: unused time, and requirements beyond the range of the plan."""
    from gradcal_jax.files.schedule import GradientSchedule

    sentences: list[str] = []
    schedule = spec.schedule
    if isinstance(schedule, GradientSchedule):
        used = [segment for segment in schedule.segments if segment.used]
        visited = [t for segment in used for t in (segment.temperature_start, segment.temperature_end)]
        rates = [move.fastest for move in schedule.cycle.moves] if schedule.cycle is not None else [0.0]
        left = sum(stretch.leftover for stretch in schedule.stretches)
        if schedule.cycle is not None and left > 0.0:
            sentences.append(f"after the last cycle's moves the axis stands for {time_text(left)}")
    else:
        visited, rates = list(schedule.temperatures), [abs(rate) for rate in schedule.rates]
        if any(schedule.rates) and spec.rig.table.rate_accuracy is None:
            sentences.append("rig.table.rate_accuracy is absent: the reference rate counts as exact")
    low, high = min(visited), max(visited)
    for requirement in spec.requirement:
        if requirement.temperature[0] < low - 1e-6 or requirement.temperature[1] > high + 1e-6:
            sentences.append(f'requirement "{requirement.name}" goes beyond the plan\'s {low:.5g} to {high:.5g} degC')
        if requirement.quantity == "scale_factor" or requirement.quantity == "heading":
            required = max(abs(rate) for rate in requirement.rate)
            if required > max(rates) * (1.0 + 1e-6):
                reached = math.degrees(max(rates))
                sentences.append(
                    f'requirement "{requirement.name}" goes beyond the plan\'s fastest rate, {reached:.5g} deg/s'
                )
    return sentences


def summary_of_unit(spec: "UnitSpec") -> str:
    """As `summary`, of a whole unit."""
    from gradcal_jax.files.schedule import StandardSchedule
    from gradcal_jax.files.section import Section

    schedule, table = spec.schedule, spec.rig.table
    skipped = {"axes", "drift", "scale_factor_instability", "temperature_error"}
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
    if isinstance(schedule, StandardSchedule):
        return "\n".join([*lines, *_standard(schedule)])
    lines.append("plan: " + times_text(schedule.duration, schedule.soak, schedule.motion, "temperature motion"))
    cycles = sum(stretch.cycles for stretch in schedule.stretches)
    lines.append(f"cycle: {time_text(schedule.period)}, made {cycles} times")
    rows = [_turn(step.move, table.axis[step.axis].name if step.axis >= 0 else "") for step in schedule.steps]
    lines += _first(rows[:_MOST_OF_UNIT], len(rows))
    left = sum(stretch.leftover for stretch in schedule.stretches)
    if left > 0.0:
        lines.append(f"note: after the last cycle the table stands for {time_text(left)}")
    return "\n".join(lines)
