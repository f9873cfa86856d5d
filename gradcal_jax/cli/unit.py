"""What `gradcal check` says of a whole unit."""

import math
from typing import TYPE_CHECKING, Any

from gradcal_jax.cli.console import strong
from gradcal_jax.cli.output import as_json
from gradcal_jax.cli.status import DONE
from gradcal_jax.pages.plain_text import columns
from gradcal_jax.units import time_text

if TYPE_CHECKING:
    from gradcal_jax.files.unit_spec import UnitSpec

_MOST_ROWS = 60


def check_unit(spec: "UnitSpec", name: str, *, files_only: bool, json: bool) -> int:
    """Print what a unit's plan does, and what it cannot observe."""
    blind: list[str] | None = None
    if not files_only:
        from gradcal_jax.cli.precision import use_float64

        use_float64()
        from gradcal_jax.api.flow import check

        blind = check(spec)
    schedule = spec.schedule
    if json:
        numbers: dict[str, Any] = {"title": spec.title, "method": spec.plan.method, "duration_s": schedule.duration}
        numbers |= {"soak_s": schedule.soak, "motion_s": schedule.motion}
        numbers |= {"requirements": [r.name for r in spec.requirement], "unobservable": blind}
        print(as_json(numbers))
        return DONE
    print(strong(spec.title or name))
    print("\n".join(_summary(spec)))
    for sentence in blind or ():
        print(f"note: {sentence}")
    print("the spec is sound" + ("; see what it cannot observe" if blind else ""))
    return DONE


def _summary(spec: "UnitSpec") -> list[str]:
    schedule, table = spec.schedule, spec.rig.table
    lines = [f"to be found: {part}" for part in _to_be_found(spec)]
    for r in spec.requirement:
        target = f", target {r.target}" if r.target is not None else ""
        over = f"{r.temperature[0]} to {r.temperature[1]}"
        lines.append(f'required: "{r.name}": {r.quantity.replace("_", " ")}, {r.axis}, {r.statistic}, {over}{target}')
    lines.append(
        f"table: {', '.join(axis.name for axis in table.axis)} (outermost first)"
        + (f"; {len(table.mounting)} mountings" if len(table.mounting) > 1 else "")
    )
    times = (time_text(t) for t in (schedule.duration, schedule.soak, schedule.motion))
    lines.append("plan: {} in all: soak {}, temperature motion {}".format(*times))
    made = sum(stretch.cycles for stretch in schedule.stretches)
    lines.append(f"cycle: {time_text(schedule.period)}, made {made} times")
    rows = [_row(step, table) for step in schedule.steps[:_MOST_ROWS]]
    lines.append(columns(rows))
    if len(schedule.steps) > _MOST_ROWS:
        lines.append(f"  … and {len(schedule.steps) - _MOST_ROWS} more")
    left = sum(stretch.leftover for stretch in schedule.stretches)
    if left > 0.0:
        lines.append(f"note: after the last cycle the table stands for {time_text(left)}")
    return lines


def _to_be_found(spec: "UnitSpec") -> list[str]:
    from gradcal_jax.files.section import Section

    found: list[str] = []
    for name, triad in (("gyro", spec.sensor.gyro), ("accelerometer", spec.sensor.accelerometer)):
        if triad is not None:
            skipped = {"axes", "drift", "scale_factor_instability"}
            sections = [
                key.replace("_", " ") for key, value in triad if isinstance(value, Section) and key not in skipped
            ]
            found.append(f"{name} {', '.join(triad.axes)}: {', '.join(sections)}")
    return found


def _row(step, table) -> tuple[str, ...]:
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
