"""The simulated unit of the hardware room on a course of the twin: what it feels off the axes."""

from dataclasses import replace

import imu_twin as twin
import numpy as np

from gradcal_jax.hardware.simulate.draws import draw_table, draw_truth
from gradcal_jax.hardware.simulate.imu import SimulatedImu
from gradcal_jax.hardware.simulate.plants import AxisPlant, ChamberPlant, ChamberTruth
from gradcal_jax.spec import presets
from gradcal_jax.spec.spec import parse_spec

SPEC = parse_spec(presets.text("two-axis-table"))
RATE_HZ = 500.0
LEGS = [
    twin.Leg(-1, 0.5),
    twin.Leg(1, 2.1, np.radians(300.0), 0.6),
]


class Course(AxisPlant):
    """An axis that goes as the twin's does."""

    def __init__(self, axis: int) -> None:
        AxisPlant.__init__(self)
        self.axis = axis

    def position(self, times_s):
        return np.degrees(twin.Course(LEGS, times_s).along(twin.angles_of(LEGS, (0.3, -1.1)))[0][:, self.axis])


class Oven(ChamberPlant):
    """A chamber that is as warm as the twin's."""

    def load_at(self, times_s):
        return 12.0 + 3.0 * np.asarray(times_s)


def silent(truth):
    """Without noise and drift, its clock right, all sensors where the axes meet."""
    quiet = {kind: replace(triad, white=0.0, walk=0.0, drifts=()) for kind, triad in truth.triads.items()}
    return replace(truth, triads=quiet, lever=(0.0, 0.0, 0.0), gyro_lever=(0.0, 0.0, 0.0), clock_error=0.0)


def simulated(truth, table, seconds: float):
    axes, oven = [Course(0), Course(1)], Oven(ChamberTruth())
    return SimulatedImu(truth, table, oven, axes, sample_rate_hz=RATE_HZ, seed=1).take(round(seconds * RATE_HZ))


def test_what_is_off_the_axes_feels_the_turning() -> None:
    drawn, (table, _, _) = draw_truth(SPEC, 5, 1), draw_table(SPEC, 5)
    at_the_axes = silent(drawn)
    lever = np.array([0.05, 0.0, 0.0])
    seconds = 1.8
    off = simulated(replace(at_the_axes, lever=tuple(lever)), table, seconds)
    there = simulated(at_the_axes, table, seconds)
    np.testing.assert_array_equal(off.rate_dps, there.rate_dps)
    # In the middle of the turn about z the rate is even: 200 deg/s about z, 0.05 m along x.
    rows = slice(round(1.3 * RATE_HZ), round(1.7 * RATE_HZ))
    felt = 9.80665 * (off.acceleration_g - there.acceleration_g)[rows]
    np.testing.assert_allclose(felt[:, 0], -(np.radians(200.0) ** 2) * 0.05, rtol=0.05)
    np.testing.assert_allclose(felt[:, 1:], 0.0, atol=0.02)
    # A gyro there says what its g-sensitivity makes of the same force.
    turned = simulated(replace(at_the_axes, gyro_lever=tuple(lever)), table, seconds)
    np.testing.assert_array_equal(turned.acceleration_g, there.acceleration_g)
    said = np.radians(turned.rate_dps - there.rate_dps)[rows]
    by_force = drawn.triads["gyro"].errors["g_sensitivity"]
    np.testing.assert_allclose(said, felt @ by_force.values[..., 0].T, rtol=0.05, atol=1e-7)
