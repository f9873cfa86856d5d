"""Execution of a recipe, on a rig or on simulated devices (`gradcal run`)."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final, TypedDict, Unpack

from ..files.recipe import Recipe
from ..files.rig import OPERATOR, TERMINAL, RigFile
from ..files.writing import write_whole
from .clock import RealClock
from .journal import JournalContents
from .run_folder import RunFolder, mounting_of, new_folder, prepare_resume
from .runner import Runner
from .session import run_session
from .setup import configs_of
from .simulate.datagrams import RATES_HZ
from .simulate.lab import SimulatedLab
from .simulate.virtual_clock import VirtualClock
from .states import RunProgress, RunResult
from .supervision import Knows
from .terminal import Terminal

# A resumed simulated run continues this long after its last record.
_LATER_S: Final = 60.0
_MOST_UNITS: Final = 8


class Attended(TypedDict, total=False):
    """The arguments of `session.run_session` for the operator's interface."""

    on_progress: Callable[[RunProgress], None]
    with_runner: Callable[[Runner], None]
    wait_when_paused: bool
    handle_signals: bool
    terminal: Terminal | None
    knows: Knows


def run(
    recipe: Recipe,
    folder: str | Path,
    *,
    rig: RigFile | None = None,
    simulate: bool = False,
    seed: int = 0,
    speed: float | None = None,
    sample_rate_hz: float = 125.0,
    about: Mapping[str, str] | None = None,
    units: int = 1,
    **attended: Unpack[Attended],
) -> RunResult:
    """Execute a recipe and leave everything safe; `folder` becomes the run's, with all bytes sent and received.

    Give either the `rig`, or `simulate`: then the devices are simulated, in virtual time or `speed` times faster than
    the clock, with hidden errors drawn by `seed`, the sensor sampled at `sample_rate_hz` (125, 250, … 2000 Hz), and
    `units` devices on the table; log, calibration and page say so. `attended`: the operator's interface
    (`on_progress`, `with_runner`, `wait_when_paused`, `handle_signals`), and the `terminal` of the operator who turns
    axes by hand. `about`: texts by name, such as operator, unit and note, kept with the run and in its log.

    Returns how it ended: `exit_status` "success", "stopped" or "aborted", `reason`, `steps_done`, `verified_safe`.
    Errors: `ValueError` for a folder that is not empty, for neither or both of rig and simulation, and for another
    sample rate; `HardwareError` where a device keeps the run from starting.
    """
    if simulate == (rig is not None):
        raise ValueError("on what? Give either a rig, or simulate=True")
    path = Path(folder)
    if rig is not None:
        configs_of(rig)
        _require_operator(rig, recipe, attended)
        return run_session(new_folder(path, recipe, rig, about=about), rig, RealClock(), guard=True, **attended)
    if sample_rate_hz not in RATES_HZ:
        known = ", ".join(f"{rate:g}" for rate in RATES_HZ)
        raise ValueError(f"the simulated sensor does not sample at {sample_rate_hz:g} Hz; it does at {known} Hz")
    if not 1 <= units <= _MOST_UNITS:
        message = f"1 to {_MOST_UNITS} units hang on the simulated table; expected another number than {units}"
        raise ValueError(message)
    simulation = {"seed": seed, "speed": speed, "sample_rate_hz": sample_rate_hz, "units": units}
    lab, clock = _laboratory(recipe, simulation)
    made = new_folder(path, recipe, lab.rig, simulated=simulation, about=about)
    write_whole(path / "hidden_truth.json", json.dumps(lab.truths(), indent=2) + "\n")
    return run_session(made, lab.rig, clock, simulated=True, bench=lab.bench, **attended)


def resume(folder: str | Path, *, rig: RigFile | None = None, **attended: Unpack[Attended]) -> RunResult:
    """Resume a run that was ended or lost, with the recipe and the rig (or the simulation) in its folder.

    A `rig` argument must be the one that the run began with.

    The interrupted step is repeated; a simulated run continues 60 s after its last record. `attended` and the result
    are as for `run`. Errors: `ValueError` where the folder holds no run, a complete one, or one of another recipe or
    version; `HardwareError` where other devices answer than at the beginning.
    """
    existing = RunFolder(Path(folder))
    first = prepare_resume(existing, rig)
    notes = existing.notes()
    if notes["simulated"]:
        lab, clock = _laboratory(existing.recipe(), notes["simulation"], existing.events())
        return run_session(existing, lab.rig, clock, first_step=first, simulated=True, bench=lab.bench, **attended)
    _require_operator(existing.rig(), existing.recipe(), attended)
    return run_session(existing, existing.rig(), RealClock(), first_step=first, guard=True, **attended)


def _require_operator(rig: RigFile, recipe: Recipe, attended: Attended) -> None:
    at_terminal = rig.operator is None or rig.operator.port == TERMINAL
    by_hand = any(axis.driver == OPERATOR for axis in rig.axis)
    hung = any(block.hang for block in recipe.motion)
    if hung and at_terminal and not by_hand and attended.get("terminal") is None:
        raise ValueError(
            "in this recipe the operator hangs the units anew, asked at the terminal, and there is none: start the run "
            "from a terminal, its output not redirected, or name a port under [operator] in the rig file"
        )
    names = [axis.name for axis in rig.axis if axis.port == TERMINAL]
    if names and attended.get("terminal") is None:
        raise ValueError(
            f"axis {', '.join(names)} is turned by the operator at the terminal, and there is none: start the run from "
            "a terminal, its output not redirected"
        )


def _laboratory(
    recipe: Recipe, simulation: Mapping[str, Any], before: JournalContents | None = None
) -> tuple[SimulatedLab, VirtualClock]:
    """The simulated laboratory of a run and its clock, which goes on after the records `before`."""
    clock = VirtualClock(0.0 if before is None else before.latest_s + _LATER_S, speed=simulation["speed"])
    settings: Any = {"seed": int(simulation["seed"]), "sample_rate_hz": float(simulation["sample_rate_hz"])}
    mounting = 0 if before is None else max(mounting_of(before) - 1, 0)
    return SimulatedLab(recipe.spec, clock, **settings, units=int(simulation["units"]), mounting=mounting), clock
