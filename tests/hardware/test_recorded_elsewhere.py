"""A unit that somebody else's logger recorded: the run without a unit, the recording, and the log of both."""

import numpy as np
import pytest
from hardware_bench import short_recipe
from journal_log import angles_of_rests
from simulated_devices.port_lab import SimulatedLab

from gradcal_jax.cli import main
from gradcal_jax.hardware.clock import VirtualClock
from gradcal_jax.hardware.execute import run_session
from gradcal_jax.hardware.run_folder import new_folder
from gradcal_jax.records.log import Log
from gradcal_jax.records.log_file import read_log

MAP = """\
format = "gradcal-columns/1"
time   = { column = "t", unit = "s" }
[rate]
x = { column = "wx", unit = "deg/s" }
"""
UNSURE_CLOCK = {"rig.table.axis[0].max_acceleration": "300 deg/s^2", "sensor.sample_clock_error": "50 ppm"}


def recorded_run(folder, made, seed):
    """A run without a unit: what a logger kept of the lab's unit, by a clock of which nobody knows the start nor, but
    for its 50 ppm, the rate; and the hidden truth."""
    clock, kept = VirtualClock(), []
    with SimulatedLab(made.spec, clock, seed=seed) as lab:
        unit = lab.units["unit1"]

        def keep(_):
            kept.append(unit.take(unit.due(clock.now())))

        rig = lab.rig.model_copy(update={"imu": ()})
        result = run_session(new_folder(folder, made, rig, simulated={}), clock, on_progress=keep)
        truth = lab.truths()
    assert (result.exit_status, result.reason) == ("success", "")
    rate = np.concatenate([part.rate_dps[:, 0] for part in kept])
    began_s = np.random.default_rng(seed).uniform(0.0, 1e5)
    recording = Log(
        began_s + np.arange(1.0, len(rate) + 1.0) / 125.0,
        np.radians(rate)[None, :, None],
        ("SN7",),
        ("x",),
        np.concatenate([part.temperature_c for part in kept])[None],
    )
    return recording, truth


def test_the_log_of_a_recording_has_the_table_and_the_chamber(tmp_path, capsys):
    made, run = short_recipe(ramp_k=6.0, changes=UNSURE_CLOCK), tmp_path / "run"
    recording, truth = recorded_run(run, made, seed=3)
    rates = np.degrees(recording.rate_rad_per_s[0, :, 0])
    (tmp_path / "map.toml").write_text(MAP)
    for name, column in (("unit.csv", rates), ("other.csv", np.roll(rates, 4000) * 0.7)):
        table = np.stack((recording.time_s, column), axis=1)
        np.savetxt(tmp_path / name, table, delimiter=",", header="t,wx", comments="", fmt="%.6f")
    words = ["--columns", str(tmp_path / "map.toml"), "-o", str(tmp_path / "log.nc")]
    # One of another run is a sentence.
    assert main(["log", str(run), "--recording", str(tmp_path / "other.csv"), *words]) != 0
    said = capsys.readouterr().err
    assert "another run" in said or "two places" in said
    assert not (tmp_path / "log.nc").exists()
    assert main(["log", str(run), "--recording", str(tmp_path / "unit.csv"), *words]) == 0
    assert "the recording's clock was determined from" in capsys.readouterr().out
    log = read_log(tmp_path / "log.nc")
    assert int(log.standstill.max()) == 2 * made.motion[0].repeat
    assert log.temperature_c.min() == pytest.approx(24.0, abs=1.0)
    assert log.temperature_c.max() == pytest.approx(30.0, abs=2.5)
    # The log's own clock is the recording's, laid on the computer's where data begin; rate and host time tell the rest.
    (rate_std,) = (float(word) for word in log.provenance["clock_rate_std"].split(", "))
    found = np.polyfit(log.time_s - log.time_s[0], log.host_time_s, 1)[0]
    assert found - 1.0 == pytest.approx(-truth["units"]["unit1"]["sample_clock"], abs=5.0 * rate_std)
    assert log.time_s[0] == pytest.approx(log.host_time_s[0])
    # What the table turned between two standstills is what the unit has sensed between them; no row of one moves.
    turned = np.diff(angles_of_rests(log))
    for number, angle in enumerate(turned):
        last, first = (np.flatnonzero(log.standstill == n) for n in (number, number + 1))
        rows = slice(int(last[-1]) + 1, int(first[0]) + 1)
        sensed = float(log.rate_rad_per_s[0, rows, 0].sum()) / 125.0
        assert sensed == pytest.approx(angle, rel=2e-2)
    assert np.degrees(np.abs(turned)) == pytest.approx(360.0, abs=0.3)
    still = np.degrees(log.rate_rad_per_s[0, log.standstill >= 0, 0])
    assert np.abs(still - np.median(still)).max() < 0.5
