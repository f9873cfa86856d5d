"""How much memory a run of 27 hours takes to resume, to watch and to make a log of.

    python experiments/benchmarks/journal_memory.py [--hours 27]        # writes journal_memory.md, in some minutes

The journal is written by the package's own `Journal`: a STIM300 at 125 samples/s in pieces of 64 ms, a table and a
chamber with their lines, and the events of the recipe's own track. Each command is measured in a process of its own;
its peak memory is the whole process's, of its children too.
"""

import argparse
import os
import platform
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE.parents[1] / "tests" / "hardware"), str(HERE.parents[1] / "tests")]
RATE_HZ, PIECE = 125, 8
IRNG = "400,400,400,10,10,10,1.7,1.7,1.7,NA"
MOST_MB = 300.0


def made(folder: Path, hours: float) -> Path:
    """A folder of a run that was killed a minute before its end."""
    from hardware_bench import short_recipe

    from gradcal_jax.hardware.journal import Journal
    from gradcal_jax.hardware.run_folder import begin_session, new_folder
    from gradcal_jax.hardware.track import track_of
    from gradcal_jax.spec.rig import TEMPLATE, parse_rig

    ramp_k = min(100.0, 60.0 * hours)
    changes = {
        "plan.temperature": ["-30 degC", f"{ramp_k - 30.0:g} degC"],
        "plan.gradient": f"{ramp_k / hours / 60.0} K/min",
    }
    rests = [{"rest": "150 s", "read_every": "5 s"}, {"turns": 1, "peak_rate": "200 deg/s", "shape": "linear ramps"}]
    changes |= {"plan.cycle.moves": [*rests, rests[0], {**rests[1], "turns": -1}]}
    recipe, rig = short_recipe(changes=changes), parse_rig(TEMPLATE)
    run = new_folder(folder / "run", recipe, rig)
    track = track_of(recipe, ["table"])
    frames = _datagrams()
    began_s = now_s = 1000.0
    with Journal(run.journal_path) as journal:
        begin_session(journal, now_s, 0, rig, simulated=False, first_step=0)
        for device, driver in (("table", "zaber"), ("chamber", "espec"), ("unit1", "stim300")):
            about = {"device": device, "driver": driver, "model": "m", "serial_number": "1", "firmware": "1"}
            journal.event(now_s, "identity", **about)
        journal.event(now_s, "configuration", device="unit1", registers={"irng": IRNG, "it": "921600,1,N,1,0,0"})
        taken, seconds = 0, 0
        for number, step in enumerate(track.steps):
            journal.event(now_s, "step", at_once=False, step=step.name, number=number)
            begins = {"begins_s": now_s, "data": bool(step.read_at_s)}
            journal.event(now_s, "step begins", at_once=False, step=step.name, number=number, **begins)
            happens = sorted([(move.start_s, move) for move in step.moves] + [(at_s, None) for at_s in step.read_at_s],
                             key=lambda pair: pair[0])  # fmt: skip
            ends_s, turned = now_s + step.duration_s, 0.0
            while now_s < ends_s:
                while happens and begins["begins_s"] + happens[0][0] <= now_s:
                    at_s, move = happens.pop(0)
                    turned += 0.0 if move is None else move.angle_deg
                    _happened(journal, begins["begins_s"] + at_s, step.name, move, turned)
                piece = b"".join(frames[(taken + k) % 16] for k in range(PIECE))
                journal.bytes_of("unit1", now_s + 0.001, piece, received=True)
                taken += PIECE
                now_s = began_s + taken / RATE_HZ
                if now_s - began_s > seconds:
                    seconds += 5
                    _polled(journal, now_s)
                # The queue of the writing thread, like the disk's in a run, stays short.
                while journal._waiting_bytes > 1 << 22:
                    time.sleep(0.01)
            journal.event(now_s, "step done", at_once=False, step=step.name, number=number)
            if number == len(track.steps) - 2:
                break
    return run.path


def _happened(journal: Any, at_s: float, step: str, move: Any, turned_deg: float) -> None:
    from gradcal_jax.hardware.journal import event_fields

    if move is not None:
        journal.event(at_s, "move", at_once=False, step=step, began_s=at_s, **event_fields(move))
        at_s += move.duration_s
    reading = {"time_s": at_s, "position_deg": turned_deg, "rate_dps": 0.0, "moving": False, "referenced": True}
    journal.event(at_s, "angle", at_once=False, axis="table", planned=True, **reading, faults=[], warnings=[])


def _polled(journal: Any, now_s: float) -> None:
    """What the run asks the chamber and the table every five seconds."""
    for sent, received in ((b"TEMP?\r\n", b"-30.0,-30.0,125.0,-50.0\r\n"), (b"MODE?,DETAIL\r\n", b"CONSTANT\r\n")):
        journal.bytes_of("port /dev/ttyUSB0", now_s, sent, received=False)
        journal.bytes_of("port /dev/ttyUSB0", now_s, received, received=True)
    journal.bytes_of("port /dev/ttyUSB1", now_s, b"/1 1 7 get pos:5B\n", received=False)
    journal.bytes_of("port /dev/ttyUSB1", now_s, b"@01 1 07 OK IDLE -- 1152000:5B\r\n", received=True)
    reading = {"time_s": now_s, "air_c": -30.0, "product_c": None, "setpoint_c": -30.0, "mode": "CONSTANT"}
    journal.event(now_s, "chamber", at_once=False, **reading, conditioning=True, alarms=[])


def _datagrams() -> list[bytes]:
    """One round of the unit's counter."""
    from hardware_bench import sensor_on_table
    from simulated_devices.line_clock import LineClock
    from simulated_devices.stim300 import SimulatedStim300, Stim300Options

    clock = LineClock()
    unit = SimulatedStim300(sensor_on_table(clock), clock, Stim300Options(rate_code=0, start_up_s=0.0))
    unit._waiting.clear()
    found: list[bytes] = []
    while len(found) < 16:
        clock.sleep(1.0)
        found += unit.emit(clock.now())
    return found[:16]


COMMANDS = {
    "resume": "all that `run --resume` reads before it opens a port, and its journal opened",
    "watch": "`gradcal rig watch --known`",
    "log": "`gradcal log`",
}


def measured(what: str, run: Path) -> None:
    """Prints seconds and MB."""
    began = time.perf_counter()
    if what == "resume":
        from gradcal_jax.hardware.journal import Journal
        from gradcal_jax.hardware.run_folder import RunFolder, mounting_of, prepare_resume, sessions

        folder = RunFolder(run)
        prepare_resume(folder)
        contents = folder.events()
        assert (sessions(contents), mounting_of(contents)) == (1, 0)
        Journal(folder.journal_path).close()
    else:
        from gradcal_jax.cli import main

        words = (
            ["rig", "watch", str(run), "--known"] if what == "watch" else ["log", str(run), "-o", str(run / "log.nc")]
        )
        sys.stdout.flush()
        kept = os.dup(1)
        os.dup2(2, 1)
        assert main(words) == 0
        sys.stdout.flush()
        os.dup2(kept, 1)
    peak = max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)) / 1024
    print(f"{time.perf_counter() - began:.0f} {peak:.0f}")


def main() -> None:
    """The table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--hours", type=float, default=27.0)
    parser.add_argument("--folder", type=Path, help="a run that was made before; absent: one is made, and removed")
    hours, given = (values := parser.parse_args()).hours, values.folder
    folder = Path(tempfile.mkdtemp()) if given is None else given
    try:
        run = folder / "run" if (folder / "run").exists() else made(folder, hours)
        size = (run / "journal").stat().st_size / 1e6
        rows: list[str] = []
        for what, words in COMMANDS.items():
            program = [sys.executable, __file__, what, str(run)]
            found = subprocess.run(program, stdout=subprocess.PIPE, text=True, check=True).stdout.split()
            rows.append(f"| {words} | {found[0]} | {found[1]} |")
            print(rows[-1], flush=True)
    finally:
        if given is None:
            shutil.rmtree(folder)
    text = (
        f"# Benchmark of a long run's journal\n\n{time.strftime('%Y-%m-%d')}, {os.cpu_count()} cores, "
        f"{platform.system()} {platform.machine()}, Python {platform.python_version()}, NumPy {np.__version__}; "
        f"`python experiments/benchmarks/journal_memory.py`.\nA journal of {hours:g} h, {size:.0f} MB; load "
        f"{os.getloadavg()[0]:.1f}.\n\n| command | seconds | peak MB |\n|---|---|---|\n" + "\n".join(rows) + "\n"
    )
    (HERE / "journal_memory.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    measured(sys.argv[1], Path(sys.argv[2])) if sys.argv[1:2] and sys.argv[1] in COMMANDS else main()
