"""A scale factor that is unsteady multiplies all that a sensor senses, what it senses across its axis included."""

import numpy as np
from estimate_scenes import draw_truth, scene
from imu_twin import record

from gradcal_jax.estimation.fit_of_log import fit_readings
from gradcal_jax.estimation.log_rows import Options, imu_rows
from gradcal_jax.model.build import build_imu
from gradcal_jax.spec.changes import changed

UNSTEADY = [{"standard_deviation": "200 ppm", "correlation_time": "10 min"}]
LEANS = 0.02


def test_noise_of_a_scale_factor_acts_on_what_is_sensed_across_the_axis():
    spec = changed(scene("two axes", 1.0), {"sensor.gyro.scale_factor_instability": UNSTEADY})
    rng = np.random.default_rng(2)
    (log,) = record(spec, draw_truth(spec, rng), rng)
    built = build_imu(spec)
    rows, _ = imu_rows(built, [log], "SN7", Options())
    readings = fit_readings(built, "SN7", rows, rows.temperature_c).readings
    model, straight = built.model, np.zeros(built.model.size)
    leaning = straight.copy()
    leaning[model.names().index("gyro_y.m_x0")] = LEANS
    of = {c.name: k for k, c in enumerate(model.channels)}
    state, places = len(model.channels), {}
    for c in model.channels:
        gains = np.asarray(c.processes.rate_gain)
        places[c.name] = state + np.flatnonzero(gains)
        state += c.processes.count
    before, after = (np.asarray(readings.linear(about)[0].transition) for about in (straight, leaning))

    def by_scale_factor(transition: np.ndarray, name: str) -> np.ndarray:
        return transition[:, of[name], places[name]]

    across = by_scale_factor(after, "gyro_y") - by_scale_factor(before, "gyro_y")
    along_x = by_scale_factor(before, "gyro_x")
    assert np.max(np.abs(along_x)) > 1.0
    np.testing.assert_allclose(across, LEANS * along_x, atol=1e-3 * LEANS)
    np.testing.assert_array_equal(by_scale_factor(after, "gyro_z"), by_scale_factor(before, "gyro_z"))
