"""A unit that somebody else's logger recorded: the run without a unit, the recording, and the log of both."""

from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from hardware_bench import Rig, short_recipe
from hardware_evidence import record
from journal_log import angles_of_rests
from scipy.stats import chi2
from simulated_devices.line_clock import LineClock
from simulated_devices.port_lab import SimulatedLab
from test_end_to_end import SMALL, distance

from gradcal_jax.cli import main
from gradcal_jax.estimation.estimate import estimate_log
from gradcal_jax.estimation.log_rows import Options
from gradcal_jax.hardware.execute import run_session
from gradcal_jax.hardware.run_folder import new_folder
from gradcal_jax.hardware.simulate.imu import SensorSamples
from gradcal_jax.hardware.simulate.plants import AxisPlant
from gradcal_jax.recipe.recipe import Recipe
from gradcal_jax.records import run_log
from gradcal_jax.records.log import Log
from gradcal_jax.records.log_file import read_log

MAP = """\
format = "gradcal-columns/1"
time   = { column = "t", unit = "s" }
[rate]
x = { column = "wx", unit = "deg/s" }
y = { column = "wy", unit = "deg/s" }
"""


class RememberingPlant(AxisPlant):
    """Keeps every phase of the axis's motion, for a unit that is read afterwards."""

    def _replace(self, now_s: float, phases) -> None:
        super()._replace(now_s, phases)
        self.all = [p for p in getattr(self, "all", []) if p.start_s < now_s] + phases


SLOWER = {"rig.table.axis[0].max_acceleration": "300 deg/s^2"}


def run_without_a_unit(folder: Path, made: Recipe) -> RememberingPlant:
    clock = LineClock()
    with Rig(clock) as lab:
        plant = RememberingPlant(None, clock.now())
        lab.table.plant = plant
        rig = lab.rig.model_copy(update={"imu": ()})
        result = run_session(new_folder(folder, made, rig, simulated={}), rig, clock, simulated=True)
    assert (result.exit_status, result.reason, result.verified_safe) == ("success", "", True)
    return plant


def recorded(plant: RememberingPlant, path: Path, seed: int) -> tuple[float, float]:
    """100 Hz from before the run to behind it, by a clock that is 50 ppm fast: host = offset + rate · its own."""
    random = np.random.default_rng(seed)
    rate, began = 1.0 - 50e-6, 5000.0
    time_s = began + np.arange(int((plant.all[-1].start_s + 120.0) * 100.0)) / 100.0
    offset_s = -40.0 - rate * began
    host = offset_s + rate * time_s
    starts = np.array([phase.start_s for phase in plant.all])
    row = np.searchsorted(starts, host, side="right") - 1
    slopes = np.array([(phase.rate_dps, phase.acceleration_dps2) for phase in plant.all])[row.clip(0)]
    turned = np.where(row >= 0, slopes[:, 0] + slopes[:, 1] * (host - starts[row.clip(0)]), 0.0)
    x = rate * turned * 1.0003 + 0.01 + 0.02 * random.standard_normal(len(host))
    y = 0.02 * random.standard_normal(len(host))
    np.savetxt(path, np.stack((time_s, x, y), axis=1), delimiter=",", header="t,wx,wy", comments="", fmt="%.6f")
    return offset_s, rate


def test_the_log_of_a_recording_has_the_table_and_the_chamber(tmp_path: Path, capsys) -> None:
    made = short_recipe(ramp_k=6.0, changes=SLOWER)
    plant = run_without_a_unit(tmp_path / "run", made)
    _, rate = recorded(plant, tmp_path / "unit.csv", seed=3)
    (tmp_path / "map.toml").write_text(MAP)
    asked = ["log", str(tmp_path / "run"), "--recording", str(tmp_path / "unit.csv")]
    assert main([*asked, "--columns", str(tmp_path / "map.toml"), "-o", str(tmp_path / "log.nc")]) == 0
    said = capsys.readouterr().out
    assert "the recording's clock was determined from" in said
    log = read_log(tmp_path / "log.nc")
    assert log.standstill is not None
    rests_rad = angles_of_rests(log)
    assert log.temperature_c is not None
    assert log.host_time_s is not None
    assert (log.axes, log.table_axes) == (("x", "y"), ("x",))
    assert int(log.standstill.max()) == 2 * made.motion[0].repeat
    assert log.temperature_c.min() == pytest.approx(24.0, abs=1.0)
    assert log.temperature_c.max() == pytest.approx(30.0, abs=2.5)
    (std_s,) = (float(word) for word in log.provenance["clock_offset_std_s"].split(", "))
    (rate_std,) = (float(word) for word in log.provenance["clock_rate_std"].split(", "))
    assert std_s < 0.01
    # The log's own clock is the recording's, laid on the computer's where data begin; rate and host time tell the rest.
    found = np.polyfit(log.time_s - log.time_s[0], log.host_time_s, 1)[0]
    assert found == pytest.approx(rate, abs=5.0 * rate_std)
    assert log.time_s[0] == pytest.approx(log.host_time_s[0])
    # What the table turned between two standstills is what the unit has sensed between them.
    for number in range(int(log.standstill.max())):
        last, first = (np.flatnonzero(log.standstill == n) for n in (number, number + 1))
        rows = slice(int(last[-1]) + 1, int(first[0]) + 1)
        sensed = float((log.rate_rad_per_s[0, rows, 0] - np.radians(0.01)).sum()) / 100.0
        turned = float(rests_rad[number + 1] - rests_rad[number])
        assert np.degrees(abs(turned)) == pytest.approx(360.0, abs=0.1)
        assert sensed == pytest.approx(turned, rel=1e-3)
    # No row of a standstill lies in a motion.
    still = log.standstill >= 0
    assert np.abs(np.degrees(log.rate_rad_per_s[0, still, 0])).max() < 0.2


@pytest.mark.long
def test_a_recording_of_another_axis_or_run_is_a_sentence(tmp_path: Path, capsys) -> None:
    plant = run_without_a_unit(tmp_path / "run", short_recipe(ramp_k=6.0, changes=SLOWER))
    moves = [
        {"rest": "9 s", "read_every": "1 s"},
        {"turn": "-720 deg", "peak_rate": "90 deg/s", "shape": "linear ramps"},
        {"rest": "5 s", "read_every": "1 s"},
        {"turn": "720 deg", "peak_rate": "60 deg/s", "shape": "linear ramps"},
    ]
    slower = short_recipe(ramp_k=6.0, changes=SLOWER | {"plan.cycle.moves": moves})
    other = run_without_a_unit(tmp_path / "other", slower)
    recorded(plant, tmp_path / "unit.csv", seed=3)
    recorded(other, tmp_path / "other.csv", seed=4)
    (tmp_path / "map.toml").write_text(MAP)
    (tmp_path / "wrong.toml").write_text(MAP.replace('"wx"', '"w"').replace('"wy"', '"wx"').replace('"w"', '"wy"'))
    for recording, columns in (("unit.csv", "wrong.toml"), ("other.csv", "map.toml")):
        asked = ["log", str(tmp_path / "run"), "--recording", str(tmp_path / recording)]
        assert main([*asked, "--columns", str(tmp_path / columns), "-o", str(tmp_path / "log.nc")]) != 0
        said = capsys.readouterr().err
        assert "another run" in said or "two places" in said
        assert "Traceback" not in said
    assert not (tmp_path / "log.nc").exists()


# --------------------------------------------------------------------------------------------- what is estimated of it

UNSURE_CLOCK = SLOWER | SMALL | {"sensor.sample_clock_error": "50 ppm"}


def recorded_run(folder: Path, made: Recipe, seed: int) -> tuple[Log, dict[str, Any]]:
    """The log of a run without a unit and of what a logger kept of the lab's unit, by a clock of which nobody knows
    the start nor, but for its 50 ppm, the rate; and the hidden truth."""
    clock, kept = LineClock(), list[SensorSamples]()
    with SimulatedLab(made.spec, clock, seed=seed) as lab:
        unit = lab.units["unit1"]
        take = unit.take

        def keeping(count: int) -> SensorSamples:
            kept.append(take(count))
            return kept[-1]

        unit.take = keeping
        rig = lab.rig.model_copy(update={"imu": ()})
        result = run_session(new_folder(folder, made, rig, simulated={}), rig, clock, simulated=True)
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
    return run_log.log(folder, recording=recording), truth


def squares(made: Recipe, log: Log, truth: dict[str, Any], clock: Literal["sensor", "host"]) -> tuple[float, ...]:
    """χ² of the data and of the parameters' errors, and the degrees of freedom of both: data, theirs, errors, theirs"""
    (calibration,) = estimate_log(made.spec, [log], options=Options(clock=clock)).calibrations
    fit = next(test for test in calibration.fit if test.name == "chi-squared of the fit")
    return fit.statistic, fit.degrees, *distance(calibration, truth)


@pytest.mark.evidence
def test_calibrations_of_recordings_are_as_sure_as_they_say(tmp_path: Path) -> None:
    """By the recording's own clock, whose error the spec reckons, and by the run's, as well as the motion tells it."""
    made, runs = short_recipe(ramp_k=6.0, changes=UNSURE_CLOCK), 40
    found: dict[str, list[tuple[float, ...]]] = {"sensor": [], "host": []}
    stds = list[float]()
    for seed in range(runs):
        log, truth = recorded_run(tmp_path / f"run{seed}", made, seed)
        stds.append(float(log.provenance["clock_rate_std"]))
        for clock, sums in found.items():
            sums.append(squares(made, log, truth, clock))
    said = list[str]()
    for clock, sums in found.items():
        data, degrees, errors, count = np.sum(sums, axis=0)
        for value, free in ((data, degrees), (errors, count)):
            assert chi2.ppf(0.005, free) < value < chi2.ppf(0.995, free), (clock, sums)
        said.append(f"by the {clock}'s clock χ² {data:.0f} of {degrees:.0f}, errors {errors:.0f} of {count:.0f}")
    record(
        "calibrations of a unit that was recorded elsewhere (clock off by 50 ppm, 1 sigma, unknown start)",
        f"{runs} runs: {'; '.join(said)}; the rate of the recording's clock known to {1e6 * np.median(stds):.1f} ppm",
        "tests/hardware/test_recorded_elsewhere.py",
    )
