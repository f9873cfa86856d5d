"""`gradcal check --timeline`: every segment and reading of a plan."""

import csv as comma_separated
import math
import sys
from typing import TYPE_CHECKING

from gradcal_jax.cli.precision import use_float64
from gradcal_jax.pages.plain_text import columns
from gradcal_jax.units import time_text

if TYPE_CHECKING:
    from collections.abc import Sequence

    from gradcal_jax.files import Timeline
    from gradcal_jax.files.imu_timeline import ImuTimeline
    from gradcal_jax.files.section import Section
    from gradcal_jax.files.spec_sections import Spec

_MOST_ROWS = 60


def print_timeline(spec: "Spec", rows: str, *, csv: bool, json: bool) -> None:
    """Print the `rows` of a spec's timeline, "segments" or "readings": as a table, as CSV, or all as JSON."""
    if json and csv:
        raise ValueError("--json or --csv: choose one")
    from gradcal_jax.files import Timeline

    use_float64()
    from gradcal_jax import api

    contents = api.timeline(spec)
    if not isinstance(contents, Timeline):
        if rows == "readings":
            raise ValueError("for an IMU every segment lists the channels with a row in it: --timeline segments")
        if json:
            print(contents.model_dump_json(exclude_none=True))
        else:
            _as_csv(contents.segments) if csv else print(_table_of_imu(contents))
    elif json:
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
    if rows == "segments":
        table: list[tuple[str, ...]] = [
            ("start", "axis", "what", "lasts", "angle, deg", "peak, deg/s", "chamber, degC")
        ]
        for s in plan.segments:
            chamber = f"{s.temperature_start:.2f} -> {s.temperature_end:.2f}"
            turns = (f"{math.degrees(s.angle):+.4g}", f"{math.degrees(s.peak_rate):+.4g}") if s.peak_rate else ("", "")
            table.append((time_text(s.start), s.axis, s.shape, time_text(s.duration), *turns, chamber))
    else:
        table = [("time, s", "axis", "kind", "standstill", "white", "common to the standstill")]
        for r in plan.readings:
            unit = "deg" if r.kind == "angle" else "deg/s"
            stands = "" if r.standstill_id is None else str(r.standstill_id)
            noise = (f"{math.degrees(e):.4g} {unit}" for e in (r.white_std, r.offset_std))
            table.append((f"{r.time:.3f}", r.axis, r.kind, stands, *noise))
    lines = [columns(table[: _MOST_ROWS + 1], indent="")]
    if len(table) > _MOST_ROWS + 1:
        lines.append(f"… and {len(table) - _MOST_ROWS - 1} more: --csv or --json gives all")
    lines.append(f"{len(plan.segments)} segments, {len(plan.readings)} readings")
    return "\n".join(lines)


def _table_of_imu(unit: "ImuTimeline") -> str:
    axes = [f"{axis.name}, deg" for axis in unit.table]
    table: list[tuple[str, ...]] = [("start", "what", "lasts", *axes, "up, from the IMU", "chamber, degC", "read")]
    for s in unit.segments[:_MOST_ROWS]:
        what = s.shape if s.axis is None else f"{s.axis}: {s.shape}, {math.degrees(s.angle):+.4g} deg"
        pairs = zip(s.angles_before, s.angles_after, strict=True)
        angles = (_degrees(a) + (f" -> {_degrees(b)}" if a != b else "") for a, b in pairs)
        up = " ".join(f"{round(v, 2) + 0.0:+.2f}" for v in s.attitude[2]) if s.axis is None else ""
        chamber = f"{s.temperature_start:.2f} -> {s.temperature_end:.2f}"
        kinds = dict.fromkeys(name.rpartition("_")[0] + "s" for name in s.read)
        table.append((time_text(s.start), what, time_text(s.duration), *angles, up, chamber, ", ".join(kinds)))
    lines = [columns(table, indent="")]
    if len(unit.segments) > _MOST_ROWS:
        lines.append(f"… and {len(unit.segments) - _MOST_ROWS} more: --csv or --json gives all")
    rows = sum(len(s.read) for s in unit.segments)
    lines.append(f"{len(unit.segments)} segments, {rows} rows of {len(unit.channels)} channels")
    return "\n".join(lines)


def _degrees(angle: float) -> str:
    return f"{round(math.degrees(angle), 6) + 0.0:.7g}"
