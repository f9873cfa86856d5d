"""A run of 30 hours is read in little memory, whatever it recorded."""

import json
import subprocess
import sys

import numpy as np
import pytest
from hardware_bench import short_recipe

from gradcal_jax.hardware.journal import Journal
from gradcal_jax.hardware.run_folder import begin_session, new_folder
from gradcal_jax.hardware.simulate.imu import SensorSamples
from gradcal_jax.hardware.simulate.lab import datagrams
from gradcal_jax.spec.rig import TEMPLATE, parse_rig

RATE_HZ = 125
CYCLE_S, TURN_S = 60.0, 4.0
# After so long the counter of the unit is where it was, and the same bytes follow.
ROUND_S = 16

CHILD = """
import json, sys, threading, time
from pathlib import Path
from gradcal_jax.cli import main
peak_kb = [0]

def look():
    while True:
        status = Path("/proc/self/status").read_text(encoding="ascii")
        peak_kb[0] = max(peak_kb[0], int(status.split("RssAnon:")[1].split()[0]))
        time.sleep(0.01)

threading.Thread(target=look, daemon=True).start()
sys.argv = ["gradcal", "log", sys.argv[1], "--json"]
try:
    main()
except SystemExit as end:
    assert not end.code, end.code
print(json.dumps(peak_kb[0] / 1024), file=sys.stderr)
"""


def recorded_run(path, duration_s):
    """The folder of a run that rests, turns once and rests again, over and over."""
    rig = parse_rig(TEMPLATE)
    folder = new_folder(path, short_recipe(), rig)
    (unit,), (axis,) = rig.imu, rig.axis
    count, random = ROUND_S * RATE_HZ, np.random.default_rng(1)
    rates, forces = random.standard_normal((2, count, 3))
    samples = SensorSamples(np.zeros(count), rates, 1e-3 * forces, np.full(count, 23.0))
    sent = datagrams(samples, 0, float(RATE_HZ))
    with Journal(folder.journal_path) as journal:
        begin_session(journal, 0.0, 0, simulated=False, first_step=0)
        journal.event(0.0, "identity", at_once=False, device=unit.name)
        journal.event(0.0, "configuration", at_once=False, device=unit.name, registers={})
        journal.event(0.0, "homing", at_once=False, axis=axis.name)
        angle_deg = 0.0
        for second in range(int(duration_s)):
            phase_s = second % CYCLE_S
            if phase_s == 0.0:
                number = int(second / CYCLE_S)
                journal.event(second, "step", at_once=False, step="a cycle", number=number)
                step = {"number": number, "begins_s": float(second), "data": True}
                journal.event(second, "step begins", at_once=False, step="a cycle", **step)
            if phase_s == 20.0:
                turn = {"kind": "turn", "angle_deg": 360.0, "rate_dps": 180.0, "acceleration_dps2": 90.0}
                journal.event(second, "move", at_once=False, axis=axis.name, began_s=float(second), **turn)
                angle_deg += 360.0
            elif not 20.0 < phase_s < 20.0 + TURN_S and second % 5 == 0:
                reading = {"time_s": float(second), "position_deg": angle_deg, "moving": False, "planned": True}
                journal.event(second, "angle", at_once=False, axis=axis.name, **reading)
            if second % 5 == 0:
                journal.event(second, "chamber", at_once=False, air_c=23.0)
            first = second * RATE_HZ % count
            data = sent[first : first + RATE_HZ].tobytes()
            journal.bytes_of(unit.name, second + 1.001, data, received=True)
        journal.event(duration_s + 2.0, "end", exit_status="success")
    return path


def memory_mb(folder, rows):
    """The largest memory of a process that makes the log of a run: its own, without the files that are mapped into it,
    which the system takes back where it needs memory."""
    done = subprocess.run([sys.executable, "-c", CHILD, str(folder)], capture_output=True, text=True, check=True)
    assert json.loads(done.stdout)["rows"]["used"] == rows
    return float(done.stderr.splitlines()[-1])


@pytest.mark.long
@pytest.mark.skipif(sys.platform != "linux", reason="the memory of a process is read from /proc")
def test_a_run_of_30_h_is_read_in_little_memory(tmp_path):
    """300 MB, the program itself included: what a run of three minutes takes, and the rest."""
    hour_s = 3600
    alone = memory_mb(recorded_run(tmp_path / "short", 180.0), 180 * RATE_HZ)
    peak = memory_mb(recorded_run(tmp_path / "long", 30.0 * hour_s), 30 * hour_s * RATE_HZ)
    assert alone < 200.0
    assert peak < 300.0, f"{peak:.0f} MB, of which the program has {alone:.0f}"
