"""Readings of axes that are held: a run takes as many as are predicted, and an estimate counts those that it took."""

from dataclasses import replace

import numpy as np
import pytest
from imu_bench import made, short

from gradcal_jax.estimation import executed_imu, readings_counted
from gradcal_jax.estimation.log_rows import Options, imu_rows
from gradcal_jax.hardware import execute
from gradcal_jax.hardware.axis_control import AxisControl
from gradcal_jax.hardware.clock import VirtualClock
from gradcal_jax.hardware.roles import AxisLimits
from gradcal_jax.hardware.run_folder import RunFolder
from gradcal_jax.hardware.simulate.lab import SimulatedAxis
from gradcal_jax.hardware.simulate.plants import AxisPlant
from gradcal_jax.model.build import build_imu
from gradcal_jax.records import run_log
from gradcal_jax.records.log import ReadingKind
from gradcal_jax.spec.changes import changed

EVERY_S = 1.5
MOVES = [
    {"rest": "7 s"},
    {"turn": "360 deg", "axis": "spin", "peak_rate": "100 deg/s"},
    {"rest": "5 s"},
    {"turn": "90 deg", "axis": "tilt", "peak_rate": "80 deg/s"},
    {"turn": "-360 deg", "axis": "spin", "peak_rate": "130 deg/s"},
    {"turn": "360 deg", "axis": "spin", "peak_rate": "170 deg/s"},
    {"rest": "4 s"},
    {"turn": "-360 deg", "axis": "spin", "peak_rate": "90 deg/s"},
    {"turn": "-90 deg", "axis": "tilt", "peak_rate": "80 deg/s"},
]
RAMP = "20 K/min"


@pytest.fixture(scope="module")
def ran(tmp_path_factory):
    """Two ramps, and a soak between them that is not used, by a noisy encoder."""
    folder = tmp_path_factory.mktemp("held") / "run"
    angle = {"reading_noise": "0.01 deg", "standstill_offset": "0.001 deg", "read_every": f"{EVERY_S} s"}
    soaked = {"soak": "100 s", "used": False}
    ways = [{"ramp_to": f"{end} degC", "rate": RAMP} for end in (32, 20)]
    spec = changed(short(), {
        "plan.temperature": None, "plan.gradient": None,
        "plan.programme": [{"soak": "30 s", "at": "20 degC"}, ways[0], soaked, ways[1]],
        "plan.cycle.moves": MOVES,
        "rig.chamber.max_cooling": "60 K/min",
        "rig.table.axis[0].angle": angle, "rig.table.axis[1].angle": angle,
    })  # fmt: skip
    result = execute.run(made(spec), folder, simulate=True, seed=5)
    assert (result.exit_status, result.verified_safe) == ("success", True), result.reason
    return folder, run_log.log(folder), build_imu(RunFolder(folder).recipe().spec)


def executed(log, built):
    rows, _ = imu_rows(built, [log], log.units[0], Options())
    return readings_counted(executed_imu(rows, built.motion.geometry), built.model)


class Told(SimulatedAxis):
    """Remembers where it was sent."""

    def move_to(self, position_deg, rate_dps, acceleration_dps2):
        self.sent.append(position_deg)
        super().move_to(position_deg, rate_dps, acceleration_dps2)


def test_an_axis_goes_to_its_start_unless_it_stands_there():
    clock = VirtualClock()
    stage = Told(AxisPlant(None, clock.now()), clock, AxisLimits(100.0, 100.0, None, None, 0.001))
    axes = AxisControl({"tilt": stage}, clock, lambda name, **data: None)

    def started(angle):
        stage.sent = []
        axes.go_to_start("a step", {"tilt": angle}, lambda: clock.sleep(0.1))
        return stage.sent

    with clock.party():
        stage.home()
        assert (started(30.0), started(30.0), started(40.0)) == ([30.0], [], [40.0])
        # Whoever moved it by more than a motor holds is seen.
        stage.plant.move_to(clock.now(), 55.0, 60.0, 60.0)
        clock.sleep(3.0)
        axes.read()
        assert started(40.0) == [40.0]


def test_an_estimate_counts_as_many_readings_as_are_predicted(ran):
    _, log, built = ran
    done = executed(log, built)
    line, moves = done.motion.line, done.motion.axis >= 0
    # The soak's readings are not in the log; a reading more or less where the grid is off a standstill's begin.
    through = np.searchsorted(np.flatnonzero(moves), np.flatnonzero(np.asarray(line.gap))) - 1
    assert len(through) == 1
    within = np.ones(int(moves.sum()), bool)
    for axis in range(2):
        own = np.flatnonzero(done.motion.axis[moves] == axis)
        within[own[np.searchsorted(own, through[0], "right") - 1]] = False
    assert np.count_nonzero(~within) == 2
    share = np.asarray(line.share)[moves]
    assert np.all(share[~within] < 0.7)
    # Nor are samples that came after the last step, when nothing is read any more.
    assert np.all((share[within] >= 1.0) & (share[within] < 1.51))
    assert np.mean(share[within]) < 1.1


def test_readings_that_were_not_made_are_not_counted(ran):
    """The first one of each standstill is left."""
    _, log, built = ran
    whole = executed(log, built)
    read = log.readings
    _, first = np.unique(np.stack([read.axis, log.standstill[read.row]]), axis=1, return_index=True)
    kept = (read.kind != ReadingKind.PLANNED) | (log.standstill[read.row] < 0)
    kept[first] = True
    fewer = replace(log, readings=read.chosen(kept))
    half = executed(fewer, built)
    made = [np.sum(of[:, 0]) for of in (whole.averaged[0], half.averaged[0])]
    assert made[1] < 0.65 * made[0]
