"""Execution of a recipe, on a rig or on simulated devices (`gradcal run`): sessions of a run, from opening the ports to
closing them.

Ctrl-C, SIGTERM and SIGHUP make safe and end; a run is continued by `resume`.
"""

import json
import signal
import sys
import threading
import time
from collections.abc import Callable, Generator, Mapping
from contextlib import ExitStack, closing, contextmanager
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Final, TypedDict, Unpack

from gradcal_jax.hardware.clock import Clock, RealClock, VirtualClock, repeating
from gradcal_jax.hardware.errors import HardwareError
from gradcal_jax.hardware.guard import BEAT_S, Guard
from gradcal_jax.hardware.interlocks import InterlockLimits, limits_of
from gradcal_jax.hardware.journal import Journal, Recorder
from gradcal_jax.hardware.run_folder import (
    RunFolder,
    begin_session,
    identities_of,
    mounting_of,
    new_folder,
    prepare_resume,
    sessions,
)
from gradcal_jax.hardware.runner import Runner
from gradcal_jax.hardware.setup import Bench, configs_of, open_rig, require_the_same
from gradcal_jax.hardware.simulate.lab import RATES_HZ, SimulatedLab
from gradcal_jax.hardware.supervision import RunProgress, RunResult, ended, sound_alarm, status_file
from gradcal_jax.hardware.transport import Terminal
from gradcal_jax.recipe.recipe import Recipe
from gradcal_jax.spec.rig import OPERATOR, TERMINAL, RigFile
from gradcal_jax.tables.writing import write_whole

# A resumed simulated run continues this long after its last record.
_LATER_S: Final = 60.0
_MOST_UNITS: Final = 8
# Longer than the run's own thread ever waits for one device: homing takes minutes.
_HANGS_S: Final = 300.0
CTRL_C: Final = "Ctrl-C"


class Attended(TypedDict, total=False):
    """The operator's interface: `on_progress` is called beside the status file, and ends the run by what it raises.
    `terminal`: of the operator who turns axes by hand."""

    on_progress: Callable[[RunProgress], None]
    terminal: Terminal | None


def run(
    recipe: Recipe,
    folder: str | Path,
    *,
    rig: RigFile | None = None,
    simulate: bool = False,
    seed: int = 0,
    sample_rate_hz: float = 125.0,
    about: Mapping[str, str] | None = None,
    units: int = 1,
    **attended: Unpack[Attended],
) -> RunResult:
    """Execute a recipe and leave everything safe; `folder` becomes the run's, with all bytes sent and received.

    Give either the `rig`, or `simulate`: then the devices are simulated, in virtual time, with hidden errors drawn by
    `seed`, the sensor sampled at `sample_rate_hz` (125, 250, … 2000 Hz), and `units` devices on the table; log,
    calibration and page say so. `attended`: see `Attended`. `about`: texts by name, such as operator, unit and note,
    kept with the run and in its log.

    Returns how it ended: `exit_status` "success" or "aborted", `reason`, `steps_done`, `verified_safe`. Errors:
    `ValueError` for a folder that is not empty, for neither or both of rig and simulation, and for another sample rate;
    `HardwareError` where a device keeps the run from starting.
    """
    if simulate == (rig is not None):
        raise ValueError("on what? Give either a rig, or simulate=True")
    if rig is not None:
        configs_of(rig)
        _require_operator(rig, recipe, attended)
        return run_session(new_folder(Path(folder), recipe, rig, about=about), RealClock(), guard=True, **attended)
    if sample_rate_hz not in RATES_HZ:
        known = ", ".join(f"{rate:g}" for rate in RATES_HZ)
        raise ValueError(f"the simulated sensor does not sample at {sample_rate_hz:g} Hz; possible are {known} Hz")
    if not 1 <= units <= _MOST_UNITS:
        raise ValueError(f"the simulated table holds 1 to {_MOST_UNITS} IMUs, not {units}")
    clock = VirtualClock()
    lab = SimulatedLab(recipe.spec, clock, seed=seed, sample_rate_hz=sample_rate_hz, units=units)
    simulation = {"seed": seed, "sample_rate_hz": sample_rate_hz, "units": units}
    made = new_folder(Path(folder), recipe, lab.rig, simulated=simulation, about=about)
    write_whole(made.path / "hidden_truth.json", json.dumps(lab.truths(), indent=2) + "\n")
    return run_session(made, clock, bench=lab.bench, **attended)


def resume(folder: str | Path, **attended: Unpack[Attended]) -> RunResult:
    """Resume a run that was ended or lost, with the recipe and the rig (or the simulation) in its folder.

    The interrupted step is repeated; a simulated run continues 60 s after its last record. `attended` and the result
    are as for `run`. Errors: `ValueError` where the folder holds no run, a complete one, or one of another recipe or
    version.
    """
    run = RunFolder(Path(folder))
    first = prepare_resume(run)
    if simulation := run.notes()["simulation"]:
        before = run.events()
        clock = VirtualClock(before.latest_s + _LATER_S)
        lab = SimulatedLab(run.recipe().spec, clock, **simulation, mounting=max(mounting_of(before) - 1, 0))
        return run_session(run, clock, first_step=first, bench=lab.bench, **attended)
    _require_operator(run.rig(), run.recipe(), attended)
    return run_session(run, RealClock(), first_step=first, guard=True, **attended)


def _require_operator(rig: RigFile, recipe: Recipe, attended: Attended) -> None:
    needed = [f"axis {axis.name} is turned by the operator" for axis in rig.axis if axis.port == TERMINAL]
    at_terminal = rig.operator is None or rig.operator.port == TERMINAL
    if at_terminal and any(block.hang for block in recipe.motion) and all(axis.driver != OPERATOR for axis in rig.axis):
        needed.append("in this recipe the mounting of the IMUs is changed by the operator")
    if needed and attended.get("terminal") is None:
        raise ValueError(
            f"{needed[0]}, who is asked at the terminal, but there is none: start the run from a terminal, without "
            "redirected output, or name a port under [operator] in the rig file"
        )


def run_session(
    folder: RunFolder,
    clock: Clock,
    *,
    first_step: int = 0,
    bench: Bench | None = None,
    guard: bool = False,
    limits: InterlockLimits | None = None,
    safe_deadline_s: float = 60.0,
    **attended: Unpack[Attended],
) -> RunResult:
    """Execute a run's recipe from `first_step` on, and leave everything safe. In the main thread it handles signals.

    `bench`: the open devices, where they are not at the ports of the rig file. `guard`: a process beside this one makes
    the rig safe where this one does not. Raises `HardwareError` where the run cannot start; later problems are in the
    result.
    """
    rig, resumed, simulated = folder.rig(), folder.events(), bool(folder.notes()["simulated"])
    units = {device.port for device in rig.imu}
    with ExitStack() as stack:
        journal = stack.enter_context(Journal(folder.journal_path))
        watched = stack.enter_context(closing(Guard(folder.path))) if guard else None

        def recorder_of(url: str) -> Recorder | None:
            # A unit's stream goes into the journal separately, under the unit's name.
            return None if url in units else journal.recorder(f"port {url}")

        bench = stack.enter_context(bench or open_rig(rig, clock, recorder_of, terminal=attended.get("terminal")))
        begin_session(journal, clock.now(), sessions(resumed), simulated=simulated, first_step=first_step)
        if journal.problem:
            raise HardwareError(journal.problem)

        if known := identities_of(resumed):
            require_the_same(bench, known)

        def changes(device: str, name: str, value: str) -> None:
            if watched is not None:
                watched.remember(device, name, value)
            journal.event(clock.now(), "setting changed", at_once=False, device=device, setting=name, before=value)

        for name, settings in bench.settings.items():
            settings.on_first_change = partial(changes, name)
        change_status = stack.enter_context(status_file(folder.path, simulated=simulated))

        def show(progress: RunProgress) -> None:
            change_status(progress.as_status())
            attended.get("on_progress", str)(progress)

        runner = Runner(
            folder.track(),
            bench,
            journal,
            clock,
            limits or limits_of(rig),
            show,
            safe_deadline_s=safe_deadline_s,
            first_step=first_step,
            mounting=mounting_of(resumed),
        )
        if threading.current_thread() is threading.main_thread():
            stack.enter_context(signals_to(runner))
        if watched is not None:
            runner.on_begin = watched.begun
            stack.enter_context(repeating(partial(_beat, watched, runner, journal, clock), BEAT_S))
        result = runner.run()
        end = ended(result.exit_status, result.reason, result.verified_safe)
        change_status(end | {"steps_done": result.steps_done})
        unsafe = ", ".join(outcome.name for outcome in result.outcomes if not outcome.verified)
        if unsafe or result.exit_status == "aborted":
            said = f"The run was {result.exit_status}: {result.reason}"
            sound_alarm(rig, f"{said} NOT VERIFIED SAFE: {unsafe}" if unsafe else said)
        # A start that commanded nothing leaves nothing to the guard, which would keep the ports from the next one.
        if watched is not None and not (unsafe and result.begun):
            watched.done()
        return result


def _beat(watched: Guard, runner: Runner, journal: Journal, clock: Clock) -> None:
    """Tell the guard that the run is alive, if the run's own thread is."""
    if time.monotonic() - runner.ticked_s > _HANGS_S:
        return
    try:
        sentence = watched.beat()
    except Exception as problem:
        sentence = str(problem)
    if sentence:
        print(sentence, file=sys.stderr, flush=True)
        journal.event(clock.now(), "guard", what=sentence)


@contextmanager
def signals_to(runner: Runner) -> Generator[None, None, None]:
    """Ctrl-C, SIGTERM and SIGHUP make safe and end. Only in the main thread (Python's rule for signals)."""

    def end(number: int, frame: FrameType | None) -> None:
        runner.abort(CTRL_C if number == signal.SIGINT else signal.Signals(number).name)

    numbers = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
    before = {number: signal.signal(number, end) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
