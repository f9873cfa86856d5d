"""The simulated unit of the hardware room against the twin of quaternions: written apart, they say the same."""

from dataclasses import replace

import imu_twin as twin
import numpy as np
import pytest

from gradcal_jax.hardware.simulate.draws import draw_table, draw_truth
from gradcal_jax.hardware.simulate.imu import SimulatedImu
from gradcal_jax.hardware.simulate.plants import AxisPlant, ChamberPlant, ChamberTruth
from gradcal_jax.spec import presets
from gradcal_jax.spec.spec import parse_spec

SPEC = parse_spec(presets.text("two-axis-table"))
RATE_HZ = 500.0
LEGS = [
    twin.Leg(-1, 0.5),
    twin.Leg(1, 2.1, np.radians(300.0), np.radians(200.0), 0.6),
    twin.Leg(0, 1.3, np.radians(-80.0), np.radians(-100.0), 0.5),
    twin.Leg(-1, 0.4),
    twin.Leg(1, 1.3, np.radians(45.0), np.radians(60.0), 0.55),
]


START = (0.3, -1.1)


def temperature(times_s):
    return 12.0 + 3.0 * np.asarray(times_s)


class Course(AxisPlant):
    """An axis that goes as the twin's does."""

    def __init__(self, axis: int) -> None:
        AxisPlant.__init__(self)
        self.axis = axis

    def position(self, times_s):
        return np.degrees(twin.commanded(LEGS, START, times_s)[0][:, self.axis])


class Oven(ChamberPlant):
    """A chamber that is as warm as the twin's."""

    def load_at(self, times_s):
        return temperature(times_s)


def silent(truth):
    """Without noise and drift, its clock right, all sensors where the axes meet."""
    quiet = {kind: replace(triad, white=0.0, walk=0.0, drifts=()) for kind, triad in truth.triads.items()}
    return replace(truth, triads=quiet, lever=(0.0, 0.0, 0.0), gyro_lever=(0.0, 0.0, 0.0), clock_error=0.0)


def simulated(truth, table, seconds: float):
    axes, oven = [Course(0), Course(1)], Oven(ChamberTruth())
    return SimulatedImu(truth, table, oven, axes, sample_rate_hz=RATE_HZ, seed=1).take(round(seconds * RATE_HZ))


@pytest.mark.parametrize("seed", range(3))
def test_the_simulated_unit_is_the_twin(seed: int) -> None:
    drawn, (table, _, shared) = draw_truth(SPEC, seed, 1), draw_table(SPEC, seed)
    truth = drawn.names | {name: value for name, value in shared.items() if not name.startswith("angle_")}
    truth["sample_clock"] = 0.0
    rig = SPEC.rig
    bench = twin.Bench(
        tuple(np.array(axis.unit_vector) for axis in rig.table.axis),
        np.array(rig.table.mounting[0].columns).T,
        float(rig.site.latitude),
        float(rig.site.gravity),
        {},
        {},
        (0.0, 0.0),
        (0.0, 0.0),
        (1.0, 1.0),
        lever=(0.0, 0.0, 0.0),
        pace=float(SPEC.sensor.gyro.scale_factor.rate.scale),
    )
    names = tuple(axis.name for axis in rig.table.axis)
    rng = np.random.default_rng(0)
    other = twin.record(bench, LEGS, START, truth, temperature, rng, rate_hz=RATE_HZ, noisy=False, names=names)
    own = simulated(silent(drawn), table, sum(leg.duration for leg in LEGS))
    np.testing.assert_allclose(np.radians(own.rate_dps), other.rate[: len(own.rate_dps)], atol=2e-6)
    np.testing.assert_allclose(9.80665 * own.acceleration_g, other.force[: len(own.rate_dps)], atol=2e-5)
    # At rest nothing turns within a sample, and both are exact: there each of the table's errors shows, too.
    rest = slice(round(4.0 * RATE_HZ), round(4.2 * RATE_HZ))

    def apart(said: twin.Recorded) -> float:
        rate = np.abs(np.radians(own.rate_dps) - said.rate[: len(own.rate_dps)])[rest].max()
        return max(rate, np.abs(9.80665 * own.acceleration_g - said.force[: len(own.rate_dps)])[rest].max())

    assert apart(other) < 1e-10
    for name in ("tilt_east", "tilt_north", "azimuth", f"orthogonality_{names[0]}_{names[1]}"):
        bad = truth | {name: -truth[name]}
        wrong = twin.record(bench, LEGS, START, bad, temperature, rng, rate_hz=RATE_HZ, noisy=False, names=names)
        assert apart(wrong) > 1e-8, name


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
    (by_force,) = (error for error in drawn.triads["gyro"].errors if error.factors == "force")
    np.testing.assert_allclose(said, felt @ by_force.values[..., 0].T, rtol=0.05, atol=1e-7)


def test_noise_is_as_strong_as_the_spec_says() -> None:
    drawn, (table, _, _) = draw_truth(SPEC, 7, 1), draw_table(SPEC, 7)
    quiet = simulated(silent(drawn), table, 5.5)
    noisy = simulated(replace(drawn, lever=(0.0, 0.0, 0.0), gyro_lever=(0.0, 0.0, 0.0), clock_error=0.0), table, 5.5)
    # Differences of neighbours: the drifts, slower than a minute, fall out.
    for said, other, density in (
        (noisy.rate_dps, quiet.rate_dps, np.degrees(float(SPEC.sensor.gyro.angle_random_walk))),
        (noisy.acceleration_g, quiet.acceleration_g, float(SPEC.sensor.accelerometer.velocity_random_walk) / 9.80665),
    ):
        white = np.std(np.diff(said - other, axis=0), axis=0) / np.sqrt(2.0)
        np.testing.assert_allclose(white, density * np.sqrt(RATE_HZ), rtol=0.05)
