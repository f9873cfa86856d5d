"""`gradcal run`: execute a recipe on a rig, or rehearse it on simulated devices."""

import sys
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import App, Parameter

from gradcal_jax.cli.console import complain, is_plain, time_text

if TYPE_CHECKING:
    from gradcal_jax.hardware.clock import Clock
    from gradcal_jax.hardware.run_folder import RunFolder
    from gradcal_jax.hardware.runner import Progress, Runner, RunResult

DEVICE_FAILURE, INTERRUPTED = 3, 130


def register(app: App) -> None:
    """Add the commands of this family."""
    app.command(run)


def run(
    recipe: Path | None = None,
    /,
    *,
    rig: Path | None = None,
    output: Annotated[Path | None, Parameter(name=["--output", "-o"])] = None,
    resume: Path | None = None,
    simulate: Annotated[bool, Parameter(negative="")] = False,
    speed: float | None = None,
    seed: int = 0,
    sample_rate: str = "125 Hz",
) -> int:
    """Execute a recipe, and leave the rig safe whatever happens.

    Ctrl-C once pauses after the step; again, it makes everything safe and ends. A run that was ended or killed is gone
    on with by --resume. With --simulate the same run goes through simulated devices on pseudo-terminals and is marked
    as simulated everywhere. The exit status is 3 when a device or the run failed.

    Parameters
    ----------
    recipe
        The recipe file.
    rig
        The rig file.
    output
        The folder of the run, to be made.
    resume
        Go on with the run in this folder; a recipe and a rig are not given.
    simulate
        Use simulated devices in the place of a rig.
    speed
        Of a simulated run: so many times faster than real time; absent: as fast as it goes.
    seed
        Of a simulated run: what its devices' hidden errors are drawn by.
    sample_rate
        Of a simulated sensor: "125 Hz", "250 Hz", "500 Hz", "1000 Hz" or "2000 Hz".
    """
    if resume is not None:
        if recipe is not None or rig is not None or output is not None or simulate:
            raise ValueError("--resume takes nothing but the folder: recipe, rig and simulation are those of its run")
        return _resume(resume)
    if recipe is None or output is None:
        raise ValueError("what to run, and where to? gradcal run RECIPE --rig RIG -o RUN/, or --simulate for --rig")
    if simulate == (rig is not None):
        raise ValueError("on what? Give either --rig RIG, or --simulate")
    from gradcal_jax.files.recipe import read_recipe
    from gradcal_jax.hardware.run_folder import new_folder

    found = read_recipe(recipe)
    if rig is not None:
        from gradcal_jax.files.rig import read_rig
        from gradcal_jax.hardware.setup import configs_of

        bench = read_rig(rig)
        configs_of(bench)
        return _on_rig(new_folder(output, found, bench), 0)
    notes = {"seed": seed, "speed": speed, "sample_rate_hz": _rate(sample_rate)}
    return _simulated(output, found, notes)


def _rate(text: str) -> float:
    from gradcal_jax import units

    found = units.parse(text, "frequency")
    if found not in (125.0, 250.0, 500.0, 1000.0, 2000.0):
        raise ValueError(f'the simulated sensor does not sample at {text}; it does at "125 Hz", "250 Hz", … "2000 Hz"')
    return found


def _resume(path: Path) -> int:
    from gradcal_jax.hardware.run_folder import RunFolder, prepare_resume

    folder = RunFolder(path)
    first = prepare_resume(folder)
    print(f"going on with step {first + 1}")
    notes = folder.notes()
    if notes["simulated"]:
        return _simulated(path, folder.recipe(), notes["simulation"], first_step=first)
    return _on_rig(folder, first)


def _on_rig(folder: "RunFolder", first_step: int) -> int:
    from gradcal_jax.hardware.clock import RealClock

    return _session(folder, folder.rig(), RealClock(), first_step, simulated=False)


def _simulated(path: Path, recipe: Any, notes: dict[str, Any], *, first_step: int | None = None) -> int:
    import json

    from gradcal_jax.files.writing import write_whole
    from gradcal_jax.hardware.clock import VirtualClock
    from gradcal_jax.hardware.run_folder import RunFolder, new_folder
    from gradcal_jax.hardware.simulate.lab import SimulatedLab

    folder = RunFolder(path)
    latest = 0.0
    if first_step is not None:
        latest = max((record.time_s for record in folder.contents().records), default=0.0) + 60.0
    clock = VirtualClock(latest, speed=notes["speed"])
    with SimulatedLab(
        recipe.spec, clock, seed=int(notes["seed"]), sample_rate_hz=float(notes["sample_rate_hz"])
    ) as lab:
        if first_step is None:
            folder = new_folder(path, recipe, lab.rig, simulated=notes)
            truth = json.dumps(lab.truth.tables(lab.axes), indent=2) + "\n"
            write_whole(path / "hidden_truth.json", truth)
        print("simulated devices: a rehearsal, not a measurement")
        return _session(folder, lab.rig, clock, first_step or 0, simulated=True)


def _session(folder: "RunFolder", rig: Any, clock: "Clock", first_step: int, *, simulated: bool) -> int:
    from gradcal_jax.hardware.session import run_session

    watcher = _Watcher(simulated)
    with watcher:
        result = run_session(
            folder,
            rig,
            clock,
            first_step=first_step,
            simulated=simulated,
            guard=not simulated,
            on_progress=watcher.show,
            with_runner=watcher.attend,
            # Where nobody can answer, what would pause the run ends it, safe.
            wait_when_paused=sys.stdin.isatty(),
            handle_signals=threading.current_thread() is threading.main_thread(),
        )
    return _say(folder, result)


def _say(folder: "RunFolder", result: "RunResult") -> int:
    for outcome in result.outcomes:
        verified = "safe" if outcome.verified else "NOT VERIFIED SAFE"
        print(f"{outcome.name}: {verified} ({outcome.action}; {outcome.evidence})")
    if result.exit_status == "success":
        print(f"done; make its log: gradcal log {folder.path}")
        return 0 if result.verified_safe else DEVICE_FAILURE
    complain(
        f"the run {result.exit_status} after {result.steps_done} steps: {result.reason}\n"
        f"What was recorded is sound. Go on with it: gradcal run --resume {folder.path}"
    )
    asked = result.reason in ("Ctrl-C", "interrupted from the keyboard")
    return INTERRUPTED if asked and result.verified_safe else DEVICE_FAILURE


class _Watcher:
    """Shows what the run does: one moving line on a terminal, a line for each step elsewhere."""

    def __init__(self, simulated: bool) -> None:
        self._simulated = simulated
        self._plain = is_plain(sys.stdout)
        self._last: tuple[str, str] = ("", "")
        self._runner: Runner | None = None
        self._asked = False

    def __enter__(self) -> "_Watcher":
        return self

    def __exit__(self, *_: object) -> None:
        if not self._plain:
            print()

    def attend(self, runner: "Runner") -> None:
        """The run that is shown."""
        self._runner = runner

    def show(self, progress: "Progress") -> None:
        """Called by the run itself, so it must be quick."""
        now = (progress.state.value, progress.step)
        if self._plain:
            if now != self._last:
                print(progress_text(progress, self._simulated), flush=True)
        else:
            print(f"\r\x1b[2K{progress_text(progress, self._simulated)}", end="", flush=True)
        self._last = now
        if progress.state.value == "paused" and not self._asked:
            self._asked = True
            threading.Thread(target=self._ask, daemon=True).start()
        elif progress.state.value == "running":
            self._asked = False

    def _ask(self) -> None:
        if not sys.stdin.isatty():
            return
        print("\npaused; press Enter to go on, Ctrl-C to make everything safe and end", flush=True)
        if sys.stdin.readline() and self._runner is not None:
            self._runner.request("resume", "Enter")


def progress_text(progress: "Progress", simulated: bool) -> str:
    """State, step, temperatures, angles and time left, in one line."""
    parts = ["simulated" if simulated else "", progress.state.value]
    parts.append(f"step {min(progress.steps_done + 1, progress.steps)} of {progress.steps}, {progress.step}")
    if progress.step_left_s is None and progress.state.value == "running":
        parts.append("waiting")
    if (chamber := progress.chamber) is not None:
        load = "" if chamber.product_c is None else f", load {chamber.product_c:.1f}"
        parts.append(f"air {chamber.air_c:.1f}{load} (set {chamber.setpoint_c:.1f}) degC")
        parts += [f"ALARM {alarm}" for alarm in chamber.alarms]
    for name, axis in progress.axes.items():
        parts.append(f"{name} {axis.position_deg:.3f} deg" + (" moving" if axis.moving else ""))
        parts += [f"FAULT {fault}" for fault in axis.faults]
    parts.append(f"{time_text(progress.track_left_s)} left")
    return "; ".join(part for part in parts if part)
