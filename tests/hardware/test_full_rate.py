"""Three units at 2000 samples/s each, in real time, through a whole run: nothing is lost, and what it costs.

Laboratory and run are processes of their own, so that processor time and memory are the run's.
"""

import json
import math

import pytest
from hardware_bench import sensor_on_table, served, short_recipe
from hardware_evidence import record
from hardware_processes import laboratory, start_run
from simulated_devices.frames import SimulatedFrames

from gradcal_jax.hardware.clock import VirtualClock
from gradcal_jax.hardware.drivers.listening import FramesConfig
from gradcal_jax.hardware.simulate.lab import unit_options
from gradcal_jax.hardware.supervision import read_status
from gradcal_jax.tables.writing import write_toml

RATE_HZ = 2000.0


def test_what_a_port_held_before_the_start_is_not_of_the_run():
    clock = VirtualClock()
    unit = SimulatedFrames(sensor_on_table(clock, sample_rate_hz=RATE_HZ), clock, rate_hz=RATE_HZ)
    config = FramesConfig(**unit_options(RATE_HZ))
    with served(unit, clock, 921600) as (port, line):
        device = config.device(line, clock)
        device.configure()
        decoder = device.decoder()
        # The search for references: for seconds nobody reads, and the port is full.
        for _ in range(20):
            clock.sleep(0.1)
            line.write(b"")
        assert port.lost_bytes > 0
        device.start()
        batches = [decoder.push(*device.read_bytes(0.1)) for _ in range(20)]
    assert sum(len(batch) for batch in batches) > 500
    assert sum(batch.gap_before.sum() for batch in batches) == 0


@pytest.mark.evidence
def test_three_units_at_full_rate_for_ten_minutes_lose_nothing(tmp_path):
    run = tmp_path / "run"
    write_toml(short_recipe(ramp_k=16.0, changes={"plan.gradient": "1.6 K/min"}), tmp_path / "recipe.toml")
    with laboratory(tmp_path, 1.0, units=3, sample_rate_hz=RATE_HZ):
        said, _ = start_run(tmp_path, run, 1.0).communicate(timeout=1800.0)
    ended, used = said.splitlines()[-2:]
    assert ended.startswith("success"), said
    cost = json.loads(used)
    found = read_status(run)["samples"]
    assert len(found) == 3
    assert max(missing for _, missing in found.values()) == 0
    samples = sum(received for received, _ in found.values())
    assert math.isclose(samples, 3 * RATE_HZ * cost["streamed_s"], rel_tol=0.01)
    # What it holds does not grow with the run.
    assert cost["memory_mb"][1] < 1.1 * cost["memory_mb"][0] + 5.0
    load = 100.0 * cost["processor_s"] / cost["took_s"]
    record(
        "three units at 2000 samples/s, in real time, through the runner",
        f"{cost['took_s']:.0f} s, {samples} samples, none missing; the run used {load:.0f} % of one processor and "
        f"{cost['memory_mb'][1]:.0f} MB (after a tenth of the time {cost['memory_mb'][0]:.0f} MB), its journal grew to "
        f"{(run / 'journal').stat().st_size / 1e6:.0f} MB",
        "tests/hardware/test_full_rate.py",
    )
