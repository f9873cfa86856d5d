"""`gradcal run`: execute a recipe on a rig, or rehearse it on simulated devices."""

import sys
import threading
from dataclasses import asdict
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING

from gradcal_jax.cli.output import DONE, FAILED, INTERRUPTED, Json, OptionalOutput, Switch, complain, show
from gradcal_jax.cli.progress import MovingLine
from gradcal_jax.cli.rig import status_text
from gradcal_jax.units import parse, time_text

if TYPE_CHECKING:
    from gradcal_jax.hardware.execute import Attended
    from gradcal_jax.hardware.supervision import RunProgress, RunResult
    from gradcal_jax.recipe.recipe import Recipe
    from gradcal_jax.spec.rig import RigFile

_SAFE = {True: "safe", False: "NOT VERIFIED SAFE"}
_REHEARSAL = "simulated devices: a rehearsal, not a measurement"


def run(
    recipe: Path | None = None,
    /,
    *,
    rig: Path | None = None,
    output: OptionalOutput = None,
    resume: Path | None = None,
    simulate: Switch = False,
    seed: int = 0,
    sample_rate: str = "125 Hz",
    dry_run: Switch = False,
    yes: Switch = False,
    note: str = "",
    units: int = 1,
    json: Json = False,
) -> int:
    """Execute a recipe on a rig, or rehearse it on simulated devices. However the run ends, the rig is left in a safe
    state.

    Ctrl-C makes all devices safe and ends the run. --resume continues a run that was ended or killed: the interrupted
    step is repeated. With --simulate the run uses simulated devices, and all its results are marked as simulated. The
    exit status is 3 if a device or the run failed.

    Parameters
    ----------
    recipe
        The recipe file.
    rig
        The rig file.
    output
        The folder for the files of the run; it is created.
    resume
        Continue the run in this folder, with its own recipe and rig.
    simulate
        Use simulated devices instead of a rig.
    seed
        For a simulated run: the seed of the devices' errors; the estimate does not know these errors.
    sample_rate
        For a simulated run: the sample rate of the sensor, "125 Hz", "250 Hz", "500 Hz", "1000 Hz" or "2000 Hz".
    dry_run
        Read the limits of the rig's devices, print what each of them is asked to do, and end; nothing moves.
    yes
        Begin without asking the operator to confirm the checklist.
    note
        A note that is stored with the run.
    units
        For a simulated run: the number of IMUs on the table.
    json
        Print only the result of the run, as JSON.
    """
    if resume is not None:
        if recipe is not None or output is not None or simulate or rig is not None:
            raise ValueError("--resume needs only the folder: the run continues with its own rig, or in simulation")
        return _resume(resume, json)
    if recipe is not None and dry_run:
        if rig is None:
            raise ValueError("name the rig file with --rig RIG")
        return _dry_run(recipe, rig, json)
    if recipe is None or output is None:
        raise ValueError(
            "the recipe or the output folder is missing: gradcal run RECIPE --rig RIG -o RUN/, or with --simulate "
            "instead of --rig RIG"
        )
    either = "name the rig with --rig RIG or use --simulate (not both)"
    if simulate == (rig is not None):
        raise ValueError(either)
    from gradcal_jax.hardware.execute import run as execute
    from gradcal_jax.recipe.recipe import read_recipe
    from gradcal_jax.spec.rig import read_rig

    executable, bench = read_recipe(recipe), None if rig is None else read_rig(rig)
    rate = parse(sample_rate, "frequency")
    if simulate and not json:
        print(_REHEARSAL)
    about = {"note": note} if note else {}
    if bench is not None and not (yes or json) and not _confirmed(executable, bench, about):
        complain("the run did not begin; nothing was moved")
        return INTERRUPTED
    with _Watcher(simulate, quiet=json) as watcher:
        simulation = {"simulate": simulate, "seed": seed, "sample_rate_hz": rate, "units": units}
        result = execute(executable, output, rig=bench, about=about, **simulation, **watcher.attends())
    return _say(output, result, json)


def _dry_run(recipe: Path, rig: Path, json: bool) -> int:
    from gradcal_jax.hardware.clock import RealClock
    from gradcal_jax.hardware.dry_run import dry_run_of
    from gradcal_jax.hardware.setup import check_each
    from gradcal_jax.hardware.track import track_of
    from gradcal_jax.recipe.recipe import read_recipe
    from gradcal_jax.spec.rig import read_rig

    bench = read_rig(rig)
    track = track_of(read_recipe(recipe), [axis.name for axis in bench.axis])
    reports = check_each(bench, RealClock())
    plan = dry_run_of(track, {report.name: report.limits for report in reports})
    problems = [*(f"{report.name}: {report.problem}" for report in reports if report.problem), *plan.problems]
    lines = [f"{name}: {what}" for name, what in plan.devices.items()]
    lines.append(f"{len(track.steps)} steps, {time_text(track.duration_s)} plus waiting times")
    lines += problems or ["every device accepts the recipe; nothing was moved"]
    found = {"duration_s": track.duration_s, "devices": plan.devices, "problems": problems}
    show("\n".join(lines), found, json=json)
    return FAILED if problems else DONE


def _confirmed(recipe: "Recipe", rig: "RigFile", about: dict[str, str]) -> bool:
    """Print the checklist before a run and, on a terminal, ask the operator to confirm it."""
    from gradcal_jax.hardware.dry_run import dry_run_of
    from gradcal_jax.hardware.track import track_of

    track = track_of(recipe, [axis.name for axis in rig.axis])
    rows = [f"{name}: {text}" for name, text in about.items()]
    rows.append(f"takes {time_text(float(round(track.duration_s)))} plus waiting times")
    rows += [f"{name}: {what}" for name, what in dry_run_of(track, {}).devices.items()]
    rows.append("does everything in the chamber tolerate this; are the axes' paths clear, and the cables long enough?")
    safe = [f'axis {axis.name} "{axis.safe}"' for axis in rig.axis]
    safe += [] if rig.chamber is None else [f'the chamber "{rig.chamber.safe}"']
    rows.append("safe states at the end of the run: " + ", ".join(safe))
    rows.append("IMUs: " + (", ".join(unit.name for unit in rig.imu) or "none; is the IMU's own logger recording?"))
    if rig.alarm is not None:
        rows.append(f"command that an alarm executes: {' '.join(rig.alarm.command)}")
    print("before the run begins:\n" + "\n".join(f"  {row}" for row in rows), flush=True)
    if not sys.stdin.isatty():
        raise ValueError("there is no terminal at which to confirm this list: read it, and run the command with --yes")
    print("press Enter to begin; type anything else to end without a run: ", end="", flush=True)
    return sys.stdin.readline() == "\n"


def _resume(path: Path, json: bool) -> int:
    from gradcal_jax.hardware.execute import resume
    from gradcal_jax.hardware.run_folder import RunFolder, prepare_resume

    folder = RunFolder(path)
    first, notes = prepare_resume(folder), folder.notes()
    simulated = bool(notes["simulated"])
    if not json:
        print(f"continuing with step {first + 1}" + (f"\n{_REHEARSAL}" if simulated else ""))
    with _Watcher(simulated, quiet=json) as watcher:
        result = resume(path, **watcher.attends())
    return _say(path, result, json)


def _say(folder: Path, result: "RunResult", json: bool) -> int:
    lines = [f"{of.name}: {_SAFE[of.verified]} ({of.action}; {of.evidence})" for of in result.outcomes]
    lines += [f"done; next, write the log: gradcal log {folder}"] if result.exit_status == "success" else []
    show("\n".join(lines), {"folder": str(folder), **asdict(result), "verified_safe": result.verified_safe}, json=json)
    if result.exit_status == "success":
        return DONE if result.verified_safe else FAILED
    if result.begun:
        complain(
            f"the run {result.exit_status} after {result.steps_done} steps: {result.reason}\n"
            f"The data recorded so far can be used. To continue: gradcal run --resume {folder}"
        )
    else:
        complain(
            f"the run did not begin, and no command was sent: {result.reason}\n"
            f"Correct this, then run: gradcal run --resume {folder}"
        )
    from gradcal_jax.hardware.execute import CTRL_C

    by_operator = result.reason in (CTRL_C, "interrupted from the keyboard")
    return INTERRUPTED if by_operator and result.verified_safe else FAILED


class _Watcher:
    """Shows the progress of a run: one moving line on a terminal, a line for each step elsewhere; nothing if `quiet`.

    It has a thread of its own, so that a stopped terminal (Ctrl-S) stops no move and no interlock.
    """

    def __init__(self, simulated: bool, *, quiet: bool) -> None:
        from gradcal_jax.hardware.transport import Terminal

        self._simulated = simulated
        self._quiet = quiet
        # A terminal on which the operator can be asked to turn an axis.
        seen = sys.stdin.isatty() and sys.stdout.isatty()
        self._terminal = Terminal(keyboard=sys.stdin.fileno(), screen=sys.stdout) if seen else None
        self._line = MovingLine(sys.stdout)
        self._last: tuple[str, str] = ("", "")
        self._news: SimpleQueue[RunProgress | None] = SimpleQueue()
        self._shows = threading.Thread(target=self._show_all, daemon=True, name="showing the run")

    def __enter__(self) -> "_Watcher":
        self._shows.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._news.put(None)
        self._shows.join(timeout=2.0)
        self._line.end()

    def attends(self) -> "Attended":
        """Arguments of the run that is shown."""
        return {"on_progress": self._news.put, "terminal": self._terminal}

    def _show_all(self) -> None:
        for progress in iter(self._news.get, None):
            now = (progress.state, progress.step)
            # While the operator is asked, this line is typed on.
            asked = self._terminal is not None and self._terminal.asking
            if not (self._quiet or asked) and (now != self._last or not self._line.plain):
                text = status_text({"simulated": self._simulated, **progress.as_status()})
                self._line.show(text, number=progress.state)
                self._last = now
