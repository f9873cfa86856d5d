"""`gradcal timeline`: every segment and reading of a plan."""

import csv as comma_separated
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import App, Parameter

from gradcal_jax.cli.output import Json
from gradcal_jax.cli.status import DONE
from gradcal_jax.pages.plain_text import columns
from gradcal_jax.units import time_text

if TYPE_CHECKING:
    from gradcal_jax.files import Timeline

_MOST_ROWS = 60


def register(app: App) -> None:
    """Add the commands of this family."""
    app.command(timeline)


def timeline(
    spec: Path,
    /,
    *,
    json: Json = False,
    csv: Annotated[bool, Parameter(name="--csv", negative="")] = False,
    rows: Literal["segments", "readings"] = "segments",
) -> int:
    """Print every segment and reading of a spec's plan.

    Parameters
    ----------
    spec
        The spec file.
    json
        Print gradcal-timeline/2: segments, readings and the sensor's model, in SI.
    csv
        Print the rows as comma-separated values, in SI.
    rows
        Which rows --csv and the plain table show.
    """
    if json and csv:
        raise ValueError("--json or --csv: choose one")
    from gradcal_jax.cli.precision import use_float64
    from gradcal_jax.files.recipe import spec_in

    found = spec_in(spec)
    use_float64()
    from gradcal_jax import assemble

    written = assemble.timeline(found)
    if json:
        print(written.model_dump_json(indent=2, exclude_none=True))
    elif csv:
        _as_csv(written, rows)
    else:
        print(_table(written, rows))
    return DONE


def _as_csv(written: "Timeline", rows: str) -> None:
    entries = written.segments if rows == "segments" else written.readings
    names = list(type(entries[0]).model_fields)
    writer = comma_separated.writer(sys.stdout, lineterminator="\n")
    writer.writerow(names)
    for entry in entries:
        values = (getattr(entry, name) for name in names)
        writer.writerow(["" if v is None else " ".join(map(str, v)) if isinstance(v, tuple) else v for v in values])


def _table(written: "Timeline", rows: str) -> str:
    if rows == "segments":
        table: list[tuple[str, ...]] = [
            ("start", "axis", "what", "lasts", "angle, deg", "peak, deg/s", "chamber, degC")
        ]
        for s in written.segments:
            chamber = f"{s.temperature_start:.2f} -> {s.temperature_end:.2f}"
            turns = (f"{math.degrees(s.angle):+.4g}", f"{math.degrees(s.peak_rate):+.4g}") if s.peak_rate else ("", "")
            table.append((time_text(s.start), s.axis, s.shape, time_text(s.duration), *turns, chamber))
    else:
        table = [("time, s", "axis", "kind", "standstill", "white", "common to the standstill")]
        for r in written.readings:
            unit = "deg" if r.kind == "angle" else "deg/s"
            stands = "" if r.standstill_id is None else str(r.standstill_id)
            noise = (f"{math.degrees(e):.4g} {unit}" for e in (r.white_std, r.offset_std))
            table.append((f"{r.time:.3f}", r.axis, r.kind, stands, *noise))
    lines = [columns(table[: _MOST_ROWS + 1], indent="")]
    if len(table) > _MOST_ROWS + 1:
        lines.append(f"… and {len(table) - _MOST_ROWS - 1} more: --csv or --json gives all")
    lines.append(f"{len(written.segments)} segments, {len(written.readings)} readings")
    return "\n".join(lines)
