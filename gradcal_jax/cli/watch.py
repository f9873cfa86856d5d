"""`gradcal rig watch`: the state of a run, by its status file, on any terminal of the computer."""

import sys
import time
from pathlib import Path
from typing import Any

from gradcal_jax.cli.console import complain
from gradcal_jax.cli.output import Flag, Json, RunPath, as_json
from gradcal_jax.cli.precision import use_float64
from gradcal_jax.cli.progress import MovingLine
from gradcal_jax.cli.status import DONE, FAILED
from gradcal_jax.pages.plain_text import amount
from gradcal_jax.units import time_text

_SILENT_S = 60.0
_LOOKS_S = 1.0


def watch(run: RunPath, /, *, once: Flag = False, known: Flag = False, json: Json = False) -> int:
    """Show the state of a run until it ends: step, temperature, planned temperature, angles, samples, residuals.

    It only reads the status file, and may be closed at any time. The exit status is 3 if the run ended badly, or does
    not respond.

    Parameters
    ----------
    once
        Show the state once, and do not wait for the end.
    known
        Print only the residuals: after the part that was executed (by the journal), and after the whole run.
    json
        Print the status as JSON, once.
    """
    from gradcal_jax.hardware.supervision import read_status

    if known:
        rows = _known(run)
        print(as_json(rows) if json else known_text(rows))
        return DONE
    with MovingLine(sys.stdout) as line:
        shown: Any = None
        while True:
            status = read_status(run)
            if json:
                print(as_json(status))
            elif status["at_s"] != shown:
                shown = status["at_s"]
                line.show(status_text(status), number=status.get("state"))
            silent_s = time.time() - float(status["at_s"])
            if "exit_status" in status:
                return DONE if status["exit_status"] == "success" and status["verified_safe"] else FAILED
            if silent_s > _SILENT_S:
                line.end()
                complain(f"the run has been silent for {time_text(float(round(silent_s)))}: it may have been killed")
                return FAILED
            if once or json:
                return DONE
            time.sleep(_LOOKS_S)


def _known(run: Path) -> list[dict[str, Any]]:
    from gradcal_jax.hardware.run_folder import RunFolder, goes_on_at, stretches_of

    folder = RunFolder(run)
    spec, spans = folder.recipe().spec, [(part.start_s, part.end_s) for part in stretches_of(folder)]
    use_float64()
    from gradcal_jax.api.replan import known_so_far

    return [row._asdict() for row in known_so_far(spec, spans, goes_on_at(folder))]


def known_text(rows: list[dict[str, Any]]) -> str:
    """The residuals so far and at the end, by requirement, in one line."""
    unobserved = {None: "cannot be observed"}
    amounts = [
        [unobserved.get(row[when]) or amount(row[when], row["unit"]) for when in ("now", "at_end")] for row in rows
    ]
    return "; ".join(
        f"{row['name']}, axis {row['axis']}: now {now}, at the end {at_end}"
        for row, (now, at_end) in zip(rows, amounts, strict=True)
    )


def status_text(status: dict[str, Any]) -> str:
    """A status in one line."""
    steps, done = status["steps"], status["steps_done"]
    why = status.get("why")
    parts = ["simulated" if status["simulated"] else "", status["state"] + (f": {why}" if why else "")]
    parts.append(f"step {min(done + 1, steps)} of {steps}, {status['step']}")
    if (chamber := status.get("chamber")) is not None:
        text = f"air {chamber['air_c']:.1f} degC"
        if (course := status.get("course_c")) is not None:
            text += f" (course {course[0]:.1f}" + (f" to {course[1]:.1f})" if course[0] != course[1] else ")")
        parts += [text, *(f"ALARM {alarm}" for alarm in chamber["alarms"])]
    for name, axis in status["axes"].items():
        angle = "?" if axis["position_deg"] is None else f"{axis['position_deg']:.3f} deg"
        parts.append(f"{name} {angle}" + (" moving" if axis["moving"] else ""))
        parts += [f"FAULT {fault}" for fault in axis["faults"]]
    for name, (received, missing) in status["samples"].items():
        parts.append(f"{name} {received} samples" + (f", {missing} missing" if missing else ""))
    parts.append(known_text(status.get("known", [])))
    if "exit_status" in status:
        parts.append(f"ended: {status['exit_status']}" + (f", {status['reason']}" if status["reason"] else ""))
    else:
        parts.append(f"{time_text(float(round(status['track_left_s'])))} left")
    return "; ".join(part for part in parts if part)
