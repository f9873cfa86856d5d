"""Execution of a recipe, on a rig or on simulated devices (`gradcal run`)."""

import json
import os
import sys
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, TypedDict, Unpack

from ..files.recipe import Recipe
from ..files.rig import OPERATOR, TERMINAL, RigFile
from ..files.unit_spec import UnitSpec
from ..files.writing import write_whole
from .clock import RealClock
from .run_folder import RunFolder, mounting_of, new_folder, prepare_resume
from .runner import Runner
from .session import run_session
from .setup import configs_of
from .simulate.datagrams import RATES_HZ
from .simulate.lab import SimulatedLab
from .simulate.unit_lab import SimulatedUnitLab
from .simulate.virtual_clock import VirtualClock
from .states import RunProgress, RunResult
from .supervision import Knows
from .terminal import Terminal

# A resumed simulated run continues this long after its last record.
_LATER_S: Final = 60.0
_MOST_UNITS: Final = 8
_ONE: Final = "one sensor hangs on the simulated table of a single axis"


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
    `units` whole units on the table; log, calibration and page say so. `attended`: the operator's interface
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
        return _on_rig(new_folder(path, recipe, rig, about=about), 0, attended)
    if sample_rate_hz not in RATES_HZ:
        known = ", ".join(f"{rate:g}" for rate in RATES_HZ)
        raise ValueError(f"the simulated sensor does not sample at {sample_rate_hz:g} Hz; it does at {known} Hz")
    if not 1 <= units <= (_MOST_UNITS if isinstance(recipe.spec, UnitSpec) else 1):
        most = f"1 to {_MOST_UNITS} units hang on the simulated table" if isinstance(recipe.spec, UnitSpec) else _ONE
        raise ValueError(f"{most}; expected another number than {units}")
    simulation = {"seed": seed, "speed": speed, "sample_rate_hz": sample_rate_hz, "units": units}
    return _simulated(path, recipe, simulation, None, attended, about)


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
        return _simulated(existing.path, existing.recipe(), notes["simulation"], first, attended)
    _require_operator(existing.rig(), existing.recipe(), attended)
    return _on_rig(existing, first, attended)


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


def _on_rig(folder: RunFolder, first_step: int, attended: Attended) -> RunResult:
    return run_session(folder, folder.rig(), RealClock(), first_step=first_step, guard=True, **attended)


def _simulated(
    path: Path,
    recipe: Recipe,
    simulation: Mapping[str, Any],
    resumed: int | None,
    attended: Attended,
    about: Mapping[str, str] | None = None,
) -> RunResult:
    folder = RunFolder(path)
    latest = 0.0
    if resumed is not None:
        latest = folder.events().latest_s + _LATER_S
    clock = VirtualClock(latest, speed=simulation["speed"])
    settings: Any = {"seed": int(simulation["seed"]), "sample_rate_hz": float(simulation["sample_rate_hz"])}
    if isinstance(recipe.spec, UnitSpec):
        mounting = 0 if resumed is None else max(mounting_of(folder.events()) - 1, 0)
        lab = SimulatedUnitLab(recipe.spec, clock, **settings, units=int(simulation["units"]), mounting=mounting)
    else:
        lab = SimulatedLab(recipe.spec, clock, **settings)
    with _on_one_core():
        if resumed is None:
            folder = new_folder(path, recipe, lab.rig, simulated=dict(simulation), about=about)
            write_whole(path / "hidden_truth.json", json.dumps(lab.truths(), indent=2) + "\n")
        first_step = resumed or 0
        return run_session(folder, lab.rig, clock, first_step=first_step, simulated=True, bench=lab.bench, **attended)


@contextmanager
def _on_one_core() -> Generator[None, None, None]:
    """Context whose threads stay on one core: the threads of a rehearsal take turns, and changing cores costs a quarter
    of its time."""
    if sys.platform != "linux":
        yield
        return
    cores, core = os.sched_getaffinity(0), Path("/proc/thread-self/stat").read_text().rpartition(")")[2].split()[36]
    os.sched_setaffinity(0, {int(core)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, cores)
