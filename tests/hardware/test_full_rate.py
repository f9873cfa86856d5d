"""Three units at 2000 samples/s each, in real time, through the whole runner: nothing is lost, and what it costs.

The simulated devices live in a process of their own, so that processor time and memory of the run are its own.

python test_full_rate.py serve FOLDER         serves chamber, table and three units until its input closes
python test_full_rate.py run FOLDER SECONDS   runs a track on them; prints its processor time and memory as JSON
"""

import json
import os
import resource
import subprocess
import sys
import threading
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hardware_bench import BOARD_CHANGES, chunks_of, sensor_on_table
from hardware_evidence import record
from simulated_devices.espec import SimulatedEspec
from simulated_devices.frames import SimulatedFrames
from simulated_devices.line_tables import SimulatedGrbl
from simulated_devices.port import SimulatedPort

from gradcal_jax.hardware.clock import RealClock
from gradcal_jax.hardware.journal import Journal, read_journal
from gradcal_jax.hardware.roles import join
from gradcal_jax.hardware.runner import Runner, RunProgress
from gradcal_jax.hardware.setup import config_of, open_rig
from gradcal_jax.hardware.simulate.lab import unit_options
from gradcal_jax.hardware.simulate.plants import AxisPlant, ChamberPlant, ChamberTruth
from gradcal_jax.hardware.track import AxisCommand, Course, Track, TrackStep
from gradcal_jax.spec.rig import read_rig, rig_of
from gradcal_jax.tables.writing import write_toml

RATE_HZ = 2000.0
UNITS = ("unit1", "unit2", "unit3")
CYCLE_S = 20.0


def serve(folder: Path) -> None:
    clock = RealClock()
    chamber = ChamberPlant(ChamberTruth(), clock.now())
    axis = AxisPlant(None, clock.now())
    units = [
        SimulatedFrames(
            sensor_on_table(clock, axis=axis, chamber=chamber, seed=seed, sample_rate_hz=RATE_HZ),
            clock,
            rate_hz=RATE_HZ,
        )
        for seed, _ in enumerate(UNITS)
    ]
    with ExitStack() as stack:
        devices = (SimulatedEspec(chamber, clock), SimulatedGrbl(axis, clock), *units)
        ports = [stack.enter_context(SimulatedPort(device, clock)) for device in devices]
        settings = unit_options(RATE_HZ)
        table = {"protocol": "grbl", "changes": BOARD_CHANGES}
        rig = {
            "format": "gradcal-rig/1",
            "chamber": {"driver": "lines", "port": ports[0].url, "safe": "standby", "options": {"protocol": "espec"}},
            "axis": [
                {"name": "table", "driver": "lines", "port": ports[1].url, "safe": "hold", "gravity_loaded": False}
                | {"options": table}
            ],
            "imu": [
                {"name": name, "driver": "frames", "port": port.url, "options": settings}
                for name, port in zip(UNITS, ports[2:], strict=True)
            ],
        }
        write_toml(rig_of(rig), folder / "rig.toml")
        print("ready", flush=True)
        sys.stdin.read()
        used = resource.getrusage(resource.RUSAGE_SELF)
        print(json.dumps({"processor_s": used.ru_utime + used.ru_stime}), flush=True)


def run(folder: Path, seconds: float) -> None:
    clock = RealClock()
    turn = AxisCommand(1.0, "table", "turn", angle_deg=360.0, rate_dps=120.0, acceleration_dps2=120.0)
    back = AxisCommand(10.0, "table", "turn", angle_deg=-360.0, rate_dps=120.0, acceleration_dps2=120.0)
    reads = tuple(np.arange(0.0, CYCLE_S, 1.0).tolist())
    count = round(seconds / CYCLE_S)
    steps = [
        TrackStep(
            f"cycle {k + 1}",
            CYCLE_S,
            courses=(Course(0.0, 25.0),) if k == 0 else (),
            moves=(turn, back),
            read_at_s=reads,
            data=True,
        )
        for k in range(count)
    ]
    resident: list[int] = []

    def look(progress: RunProgress) -> None:
        if sys.platform == "linux":
            pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
            resident.append(pages * os.sysconf("SC_PAGESIZE"))

    began = time.monotonic()
    with open_rig(read_rig(folder / "rig.toml"), clock) as bench, Journal(folder / "journal") as journal:
        result = Runner(Track(tuple(steps)), bench, journal, clock, on_progress=look).run()
    used = resource.getrusage(resource.RUSAGE_SELF)
    said = {
        "exit_status": result.exit_status,
        "reason": result.reason,
        "verified_safe": result.verified_safe,
        "took_s": time.monotonic() - began,
        "processor_s": used.ru_utime + used.ru_stime,
        "resident_mb": [round(size / 1e6, 1) for size in resident],
        "threads": threading.active_count(),
    }
    print(json.dumps(said), flush=True)


def streamed(folder: Path, seconds: float) -> dict[str, Any]:
    """Run for so long; what the run said of itself, what the devices lost, and of each unit its samples and gaps."""
    program = [sys.executable, __file__]
    with subprocess.Popen(
        [*program, "serve", str(folder)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as devices:
        assert devices.stdin is not None
        assert devices.stdout is not None
        assert devices.stdout.readline() == "ready\n"
        done = subprocess.run(
            [*program, "run", str(folder), str(seconds)],
            capture_output=True,
            text=True,
            check=True,
            timeout=seconds + 60,
        )
        devices.stdin.close()
        served = json.loads(devices.stdout.readline())
    said = json.loads(done.stdout)
    contents = read_journal(folder / "journal")
    assert contents.damaged_bytes == 0
    begin = min(e.data["begins_s"] for e in contents.events if e.name == "step begins")
    end = next(e.time_s for e in contents.events if e.name == "ending")
    units: dict[str, dict[str, float]] = {}
    for device in read_rig(folder / "rig.toml").imu:
        config = config_of(device, "imu", ())
        decoder = config.decoder()
        samples = join([decoder.push(chunk.data, chunk.time_s) for chunk in chunks_of(contents, device.name)])
        during = (samples.host_time_s >= begin) & (samples.host_time_s <= end)
        delays = np.diff(np.array([chunk.time_s for chunk in chunks_of(contents, device.name)]))
        units[device.name] = {
            "samples": int(during.sum()),
            "missing": int(np.maximum(samples.gap_before[1:], 0).sum()),
            "bad_bytes": decoder.bad_bytes,
            "longest_wait_s": float(delays.max()),
        }
    return said | {
        "devices": served,
        "units": units,
        "seconds": end - begin,
        "bytes": os.path.getsize(folder / "journal"),
    }


@pytest.mark.evidence
def test_three_units_at_full_rate_for_ten_minutes_lose_nothing(tmp_path: Path) -> None:
    found = streamed(tmp_path, 600.0)
    assert (found["exit_status"], found["reason"], found["verified_safe"]) == ("success", "", True)
    for unit in found["units"].values():
        assert unit["missing"] == 0
        # The start-up datagrams, before the decoder had locked.
        assert unit["bad_bytes"] <= 20 + 20 + 26
        # The counter repeats after 256 samples; the number of samples excludes that so many are missing.
        assert abs(unit["samples"] - RATE_HZ * found["seconds"]) < 100
    memory = found["resident_mb"]
    # What it holds does not grow with the run.
    assert max(memory[len(memory) // 2 :]) < 1.1 * memory[len(memory) // 10] + 5.0
    samples = sum(unit["samples"] for unit in found["units"].values())
    load = 100.0 * found["processor_s"] / found["took_s"]
    sim = 100.0 * found["devices"]["processor_s"] / found["took_s"]
    wait = max(unit["longest_wait_s"] for unit in found["units"].values())
    record(
        "three units at 2000 samples/s, in real time, through the runner",
        f"{found['seconds']:.0f} s, {samples} samples, none missing; the run used {load:.0f} % of one processor and "
        f"{max(memory):.0f} MB (after a tenth of the time {memory[len(memory) // 10]:.0f} MB), its journal grew to "
        f"{found['bytes'] / 1e6:.0f} MB; longest wait between two chunks {1e3 * wait:.0f} ms; the simulated devices "
        f"beside it used {sim:.0f} %",
        "tests/hardware/test_full_rate.py",
    )


if __name__ == "__main__":
    if sys.argv[1] == "serve":
        serve(Path(sys.argv[2]))
    else:
        run(Path(sys.argv[2]), float(sys.argv[3]))
