"""Simulated devices have the errors that a spec states and that no residual of a run shows."""

from dataclasses import replace

import numpy as np
import pytest

import gradcal_jax as gj
from gradcal_jax.hardware.simulate.draws import draw_table, draw_truth
from gradcal_jax.hardware.simulate.imu import SimulatedImu
from gradcal_jax.hardware.simulate.plants import AxisPlant
from gradcal_jax.spec import presets

SPEC = gj.parse_spec(presets.text("paper-dynamic-gradient"))
STATED = {
    "sensor.temperature_offset": "2 K",
    "sensor.temperature_lag": "40 s",
    "rig.table.mounting[0].accuracy": "1 deg",
    "rig.table.axis[0].angle.scale_error": "100 ppm",
    "rig.table.axis[0].angle.backlash": "0.02 deg",
    "rig.site.latitude": "unknown",
}
LINE = {"degree": 1, "centre": "20 degC", "scale": "50 K"}
QUIET = {"sensor.gyro.angle_random_walk": "1e-9 deg/sqrt(h)", "sensor.gyro.drift": []}
SEEDS = 300


class Warming:
    """A load that warms by 0.02 K/s."""

    def load_at(self, times_s):
        return 20.0 + 0.02 * times_s


def test_they_have_the_sizes_that_the_spec_states():
    spec = gj.changed(SPEC, STATED)
    sensors = [draw_truth(spec, seed, 1) for seed in range(SEEDS)]
    tables = [draw_table(spec, seed)[:2] for seed in range(SEEDS)]
    assert all(s.names["temperature_offset"] == s.thermometer_offset for s in sensors)
    (encoders,) = zip(*(axes for _, axes in tables), strict=True)
    hung = SPEC.rig.table.mounting[0]
    along = spec.rig.table.axis[0].unit_vector.index(1.0), "xyz".index(hung.z[1])
    for values, size in (
        ([s.thermometer_offset for s in sensors], 2.0),
        ([s.die_lag_s for s in sensors], 40.0),
        ([e.scale_error for e in encoders], 1e-4),
        ([e.backlash_deg for e in encoders], 0.02),
        # Of two angles, each of one degree.
        ([np.arccos(abs(table.mountings[0]).max(axis=0)[along[1]]) for table, _ in tables], np.radians(2.0**0.5)),
    ):
        assert np.sqrt(np.mean(np.square(values))) == pytest.approx(size, rel=0.15)
    assert min(s.die_lag_s for s in sensors) >= 0.0
    assert min(e.backlash_deg for e in encoders) >= 0.0
    # The Earth's rate along the axis is rectangular.
    share = np.sin([table.latitude for table, _ in tables])
    assert np.std(share) == pytest.approx(3.0**-0.5, rel=0.1)


def test_dies_follow_a_thermometer_that_is_off():
    """The bias is that of the dies, and the thermometer shows what they will have."""
    spec = gj.changed(SPEC, STATED | {"sensor.gyro.bias": {"temperature": LINE, "prior": "1 deg/s"}, **QUIET})
    truth, (table, _, _) = draw_truth(spec, 7, 1), draw_table(gj.changed(spec, {"rig.site.latitude": "0 deg"}), 7)
    table = replace(table, earth_rate=0.0)
    imu = SimulatedImu(truth, table, Warming(), [AxisPlant()], sample_rate_hz=1.0, seed=7)
    imu.take(1000)
    shown = imu.take(10)
    load = Warming().load_at(shown.time_s - 0.5)
    np.testing.assert_allclose(shown.temperature_c, load + truth.thermometer_offset, atol=1e-9)
    assert abs(truth.thermometer_offset) > 0.1
    slope, behind = truth.names["gyro_x.a1"] / 50.0, 0.02 * truth.die_lag_s
    assert abs(slope * behind) > 1e-4
    expected = truth.names["gyro_x.a0"] + slope * (load - behind - 20.0)
    np.testing.assert_allclose(np.radians(shown.rate_dps[:, 0]), expected, atol=1e-3 * abs(slope * behind))


OF_BIAS = gj.changed(SPEC, {"sensor.gyro.bias": {"temperature": LINE}})
HIDDEN = {
    "sensor.gyro.scale_factor.discrepancy": {
        "standard_deviation": "20 ppm", "temperature_degree": 5, "rate_degree": 4},
    "sensor.gyro.bias.discrepancy": {"standard_deviation": "3 deg/h", "temperature_degree": 5},
}  # fmt: skip


def test_functions_beyond_the_maps_have_the_size_that_the_spec_says():
    """Simulated devices have the structure that a discrepancy says the maps lack; other draws are as without it."""
    known = draw_truth(OF_BIAS, 3, 0)
    drawn = [draw_truth(gj.changed(OF_BIAS, HIDDEN), seed, 0) for seed in range(200)]
    assert drawn[3].names == known.names
    errors = [truth.triads["gyro"].errors for truth in drawn]
    scales = np.array([of["scale_factor_discrepancy"].values[0].T for of in errors])
    biases = np.array([of["bias_discrepancy"].values[0, 0] for of in errors])
    gyro = OF_BIAS.sensor.gyro
    in_map = np.zeros((6, 5), bool)
    in_map[: gyro.scale_factor.temperature.size, : gyro.scale_factor.rate.size] = True
    assert not np.any(scales[:, in_map])
    assert np.std(scales[:, ~in_map]) == pytest.approx(20e-6, rel=0.05)
    of_t = gyro.bias.temperature.size
    assert not np.any(biases[:, :of_t])
    assert np.std(biases[:, of_t:]) == pytest.approx(np.radians(3.0) / 3600.0, rel=0.1)
