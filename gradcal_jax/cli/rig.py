"""`gradcal rig check`: the devices of a rig; and `rig watch`, the state of a run."""

import sys
import time
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cyclopts import App

from gradcal_jax.cli.output import DONE, FAILED, Json, RunPath, complain, show, strong
from gradcal_jax.cli.progress import MovingLine
from gradcal_jax.tables.display import printable
from gradcal_jax.tables.table import Table
from gradcal_jax.units import time_text

if TYPE_CHECKING:
    from gradcal_jax.hardware.setup import DeviceReport

_SILENT_S = 60.0
_LOOKS_S = 1.0


def watch(run: RunPath, /, *, json: Json = False) -> int:
    """Show the state of a run until the run ends: step, actual and planned temperature, angles, samples.

    The command only reads the status file of the run, so you can end the command at any time. The exit status is 3 if
    the run ended badly or does not respond.

    Parameters
    ----------
    json
        Print the state once, as JSON.
    """
    from gradcal_jax.hardware.supervision import read_status

    with MovingLine(sys.stdout) as line:
        shown: Any = None
        while True:
            status = read_status(run)
            try:
                text, silent_s = printable(status_text(status)), time.time() - float(status["at_s"])
                ended = "exit_status" in status
                good = ended and status["exit_status"] == "success" and status["verified_safe"] is True
            except (AttributeError, KeyError, TypeError, ValueError, IndexError, OverflowError):
                raise ValueError(f"the status file in {run} was not written by a run of this program") from None
            if json:
                show("", status, json=True)
            elif status["at_s"] != shown:
                shown = status["at_s"]
                line.show(text, number=status.get("state"))
            if ended:
                return DONE if good else FAILED
            if silent_s > _SILENT_S:
                line.end()
                complain(
                    f"the run has not written its status for {time_text(float(round(silent_s)))}: it may have "
                    "been killed"
                )
                return FAILED
            if json:
                return DONE
            time.sleep(_LOOKS_S)


def status_text(status: dict[str, Any]) -> str:
    """A status in one line."""
    steps, done = status["steps"], status["steps_done"]
    parts = ["simulated" if status["simulated"] else "", status["state"]]
    parts.append(f"step {min(done + 1, steps)} of {steps}, {status['step']}")
    if status.get("step_left_s", 0.0) is None and status["state"] == "running":
        parts.append("waiting")
    if (chamber := status.get("chamber")) is not None:
        text = f"air {chamber['air_c']:.1f} degC"
        if (course := status.get("course_c")) is not None:
            low, high = (f"{end:.1f}" for end in course)
            text += f" (set point {low} degC)" if low == high else f" (recent set points from {low} to {high} degC)"
        parts += [text, *(f"ALARM {alarm}" for alarm in chamber["alarms"])]
    for name, axis in status["axes"].items():
        angle = "turned by hand" if axis["position_deg"] is None else f"{axis['position_deg']:.3f} deg"
        parts.append(f"{name} {angle}" + (" moving" if axis["moving"] else ""))
        parts += [f"FAULT {fault}" for fault in axis["faults"]]
    for name, (received, missing) in status["samples"].items():
        parts.append(f"{name} {received} samples" + (f", {missing} missing" if missing else ""))
    if "exit_status" in status:
        parts.append(f"ended: {status['exit_status']}" + (f", {status['reason']}" if status["reason"] else ""))
    else:
        parts += [f"{time_text(float(round(status['track_left_s'])))} left", *status.get("remarks", ())]
    return "; ".join(part for part in parts if part)


rig_app = App(name="rig", help="Check the devices of a rig, or watch a run.")
rig_app.command(watch)


@rig_app.command
def check(rig: Path, /, *, json: Json = False) -> int:
    """Read the identity and the limits of every device of a rig. Nothing moves.

    `gradcal run RECIPE --rig RIG --dry-run` compares a recipe with these limits. The exit status is 3 if a device does
    not answer correctly.

    Parameters
    ----------
    rig
        The rig file.
    json
        Print the devices' answers as JSON.
    """
    from gradcal_jax.hardware.clock import RealClock
    from gradcal_jax.hardware.journal import json_of
    from gradcal_jax.hardware.setup import check_each
    from gradcal_jax.spec.rig import read_rig

    description = read_rig(rig)
    reports = check_each(description, RealClock())
    good = not any(report.problem for report in reports)
    answers = [row for report in reports for row in _rows(report)]
    lines = [strong(description.title or str(rig))]
    lines.append(Table.of(["device", "driver", "port", "what it says"], answers).text(width=120))
    safe = [(f"axis {entry.name}", entry.safe) for entry in description.axis]
    safe += [] if description.chamber is None else [("the chamber", description.chamber.safe)]
    lines += [f'  safe state of {name} at the end of a run: "{state}"' for name, state in safe]
    lines.append("every device answers as the rig file states" if good else "the rig is not ready")
    show("\n".join(lines), [json_of(asdict(report)) for report in reports], json=json)
    return DONE if good else FAILED


def _rows(report: "DeviceReport") -> list[tuple[str, ...]]:
    head = (report.name, report.driver, report.port)
    if report.problem:
        return [(*head, report.problem)]
    identity = report.identity
    described = [] if identity is None else [identity.model, identity.serial_number, identity.firmware]
    limits = {} if report.limits is None else asdict(report.limits)
    limits.pop("registers", None)
    known = {name: value for name, value in limits.items() if value and value != float("inf")}
    rows = [f"{name} {value:g}" if isinstance(value, float) else f"{name} {value}" for name, value in known.items()]
    return [(*head, " ".join(described).strip()), *(("", "", "", row) for row in rows)]
