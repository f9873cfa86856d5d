"""Processes for the tests: a simulated laboratory that outlives the runs on it, and a run that can be killed.

python hardware_processes.py serve FOLDER SPEED SEED UNITS RATE_HZ    serves until its input closes; writes
                                                                      FOLDER/rig.toml and FOLDER/hidden_truth.json
python hardware_processes.py run FOLDER RUN SPEED [guard]
"""

import json
import math
import os
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

from simulated_devices.port import FastClock
from simulated_devices.port_lab import SimulatedLab

from gradcal_jax.hardware import guard as watching
from gradcal_jax.hardware.execute import run_session
from gradcal_jax.hardware.interlocks import InterlockLimits
from gradcal_jax.hardware.run_folder import RunFolder, new_folder, prepare_resume
from gradcal_jax.recipe.recipe import read_recipe
from gradcal_jax.spec.rig import read_rig
from gradcal_jax.tables.writing import write_toml, write_whole


def serve(at, speed, seed, units, sample_rate_hz):
    folder, clock = Path(at), FastClock(float(speed))
    spec, burst_s = read_recipe(folder / "recipe.toml").spec, 0.016 if clock.speed == 1.0 else 0.5
    options = {"seed": int(seed), "units": int(units), "sample_rate_hz": float(sample_rate_hz)}
    with SimulatedLab(spec, clock, burst_s=burst_s, room_c=20.0, **options) as lab:
        write_toml(lab.rig, folder / "rig.toml")
        write_whole(folder / "hidden_truth.json", json.dumps(lab.truths()))
        print("ready", flush=True)
        for line in sys.stdin:
            if line.strip() == "state":
                rate = max(abs(plant.state(clock.now())[1]) for plant in lab.axis_plants)
                print(lab.chamber.mode, rate, flush=True)


def run(at, to, times, *guard):
    folder, path, speed = Path(at), Path(to), float(times)
    clock = FastClock(speed)
    if (path / "run.json").exists():
        made, first = RunFolder(path), prepare_resume(RunFolder(path))
    else:
        made, first = new_folder(path, read_recipe(folder / "recipe.toml"), read_rig(folder / "rig.toml")), 0
    write_whole(path / "pid", str(os.getpid()))
    watching._SILENT_S = float(os.environ.get("SILENT_S", watching._SILENT_S))
    limits = InterlockLimits(imu_stale_s=2.0 * speed, temperature_band_k=math.inf, latest_s=1.0 * speed)
    began_s, memory_mb = clock.now(), []

    def look(progress):
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1]) if sys.platform == "linux" else 0
        memory_mb.append(pages * os.sysconf("SC_PAGESIZE") / 1e6)

    result = run_session(
        made, clock, first_step=first, guard=bool(guard), limits=limits, safe_deadline_s=20.0 * speed,
        on_progress=look,
    )  # fmt: skip
    used, took_s = os.times(), clock.now() - began_s
    started_s = next((e.time_s for e in made.contents().events if e.name == "step"), began_s)
    cost = {"took_s": took_s, "processor_s": used.user + used.system, "streamed_s": began_s + took_s - started_s}
    cost["memory_mb"] = memory_mb[len(memory_mb) // 10 :: max(1, len(memory_mb) - len(memory_mb) // 10 - 1)]
    print(f"{result.exit_status} {result.reason}\n{json.dumps(cost)}", flush=True)
    return 0 if result.exit_status == "success" and result.verified_safe else 3


@contextmanager
def laboratory(folder, speed, seed=0, *, units=1, sample_rate_hz=125.0):
    """A laboratory in a process of its own for the recipe in a folder, ready to be used; `hidden_truth.json` there says
    what it hides."""
    process = subprocess.Popen(
        [sys.executable, __file__, "serve", str(folder), *map(str, (speed, seed, units, sample_rate_hz))],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert process.stdout.readline() == "ready\n"
        yield process
    finally:
        process.stdin.close()
        process.wait(timeout=30.0)
        process.stdout.close()


def require_standing(laboratory):
    """Of a laboratory: its chamber is in standby, and its axes do not turn."""
    laboratory.stdin.write("state\n")
    laboratory.stdin.flush()
    assert laboratory.stdout.readline().split() == ["STANDBY", "0.0"]


def start_run(folder, path, speed, *, guard=False, silent_s=20.0):
    words = [sys.executable, __file__, "run", str(folder), str(path), str(speed)] + (["guard"] if guard else [])
    environment = os.environ | {"SILENT_S": str(silent_s)}
    return subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment)


if __name__ == "__main__":
    sys.exit({"serve": serve, "run": run}[sys.argv[1]](*sys.argv[2:]))
