"""Loops over the temperature: the plays of a simulated unit, and the laws of the tests (`loop_laws`)."""

import numpy as np
import pytest

from gradcal_jax.hardware.simulate.draws import draw_table, draw_truth
from gradcal_jax.hardware.simulate.imu import PlayTruth, SimulatedImu
from gradcal_jax.hardware.simulate.plants import AxisPlant, ChamberPlant, ChamberTruth
from gradcal_jax.spec import presets
from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.spec import parse_spec

HOUR = np.pi / 180.0 / 3600.0


class Ramp(ChamberPlant):
    """A chamber that is as warm as the time says: up and down by 60 K within 20 min each."""

    def load_at(self, times_s):
        return 60.0 * (1.0 - np.abs(1.0 - np.asarray(times_s) / 1200.0))


def test_a_unit_has_the_loops_that_its_spec_names():
    gradient = {"sensor.gyro.bias_temperature_gradient": "5 deg/h/(K/min)"}
    plain = changed(parse_spec(presets.text("two-axis-table")), gradient)
    spec = changed(
        plain,
        {
            "sensor.gyro.hysteresis": [{"width": "10 K", "prior": "30 deg/h/K"}],
            "sensor.accelerometer.scale_factor_hysteresis": [{"width": "5 K", "prior": "10 ppm/K"}],
        },
    )
    drawn, before = draw_truth(spec, 3, 1), draw_truth(plain, 3, 1)
    (play,), (of_scale,) = drawn.triads["gyro"].loops, drawn.triads["accelerometer"].loops
    assert (play.of_input, of_scale.of_input) == (False, True)
    named = {name: drawn.names[name] for name in drawn.names.keys() - before.names.keys()}
    assert [named[f"gyro_{axis}.hysteresis_10K"] for axis in "xyz"] == list(play.slopes)
    assert [named[f"accelerometer_{axis}.scale_factor_hysteresis_5K"] for axis in "xyz"] == list(of_scale.slopes)
    sizes = np.array([draw_truth(spec, seed, 1).triads["gyro"].loops[0].slopes for seed in range(200)])
    assert np.std(sizes) / HOUR == pytest.approx(30.0, rel=0.1)
    table, _, _ = draw_table(spec, 3)
    # The same seed draws the same noise and sensitivity to dT/dt; what differs is the path.
    outputs = []
    for truth in (drawn, before):
        axes = [AxisPlant(), AxisPlant()]
        unit = SimulatedImu(truth, table, Ramp(ChamberTruth()), axes, sample_rate_hz=1.0, seed=1)
        outputs.append([unit.take(1200) for _ in range(2)])
    apart = [np.radians(a.rate_dps - b.rate_dps) / HOUR for a, b in zip(*outputs, strict=True)]
    assert drawn.triads["gyro"].gradient == before.triads["gyro"].gradient
    at = 600
    hysteresis = apart[0][at] - apart[1][-at - 1]
    # The play is behind the temperature: below it on the way up.
    assert hysteresis == pytest.approx(-2.0 * 10.0 * np.array(play.slopes) / HOUR, rel=0.05)


def test_a_play_is_stepped_sample_by_sample_in_blocks_of_any_size():
    course = 23.0 + np.cumsum(np.random.default_rng(1).normal(0.0, 2.0, 500))
    place, expected = 23.0, []
    for t in course:
        place = max(t - 7.0, min(t + 7.0, place))
        expected.append(place - t)
    for cuts in ([], [1, 2, 250], list(range(1, 500))):
        loop = PlayTruth((1.0, 2.0, 0.0), 7.0).begin(23.0)
        said = np.concatenate([loop(block, 1.0) for block in np.split(course, cuts)])
        np.testing.assert_allclose(said[:, 0], expected, atol=1e-12)
        np.testing.assert_allclose(said[:, 1:], np.outer(expected, [2.0, 0.0]), atol=1e-12)
