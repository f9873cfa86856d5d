"""Logs of 1 to 10 rows a second, as factories record: standstills are found, and estimates keep their covariance."""

from dataclasses import replace

import numpy as np
import pytest
from logs_zoo import estimated
from report_samples import calibration, recipe
from scipy.stats import chi2
from simulated_log import simulate_log

import gradcal_jax as gj
from gradcal_jax.tables.quantity import Quantity

CHANGES = {
    "sensor.gyro.scale_factor.temperature.degree": 1,
    "sensor.gyro.scale_factor.rate.degree": 1,
    "plan.cycle.moves": [
        {"rest": "12 s", "read_every": "1 s"},
        {"turn": "1800 deg", "peak_rate": "200 deg/s", "shape": "cosine ramps"},
        {"rest": "12 s", "read_every": "1 s"},
        {"turn": "-720 deg", "peak_rate": "60 deg/s", "shape": "cosine ramps"},
    ],
}


@pytest.fixture(scope="module")
def spec() -> gj.Spec:
    return gj.changed(gj.parse_spec(gj.presets.text("paper-dynamic-gradient")), CHANGES)


@pytest.mark.parametrize(("rate_hz", "marked"), [(1.0, True), (10.0, False)])
def test_an_axis_is_estimated_within_its_covariance(spec, rate_hz, marked):
    log, truth = simulate_log(spec, sample_rate_hz=rate_hz, seed=3)
    (channel,) = estimated(spec, log if marked else replace(log, standstill=None), axis="x")
    estimate = channel.solution
    root = estimate.known.spread
    white = np.linalg.solve(root, estimate.parameters - truth["x"][0])
    assert chi2.sf(white @ white, len(white)) > 1e-3
    assert 1e-3 < chi2.sf(estimate.chi_squared, estimate.degrees) < 1.0 - 1e-3


def test_a_long_rest_is_validated_by_ranges_of_temperature():
    """One rest of 18 min and 38 K had one mean, in which errors of both signs cancel."""
    count, hz = 18 * 60 * 2, 2.0
    time = np.arange(1, count + 1) / hz
    warmth = np.linspace(22.0, 60.0, count)
    error = np.radians(1.0) / 3600.0 * 300.0 * (warmth - 41.0) / 19.0
    rest = gj.Log(
        time, error[None, :, None], ("u",), ("x",), temperature_c=warmth[None], standstill=np.zeros(count, np.int64)
    )
    found = calibration(recipe())
    wide = tuple(Quantity.read(text, "temperature") for text in ("-40 degC", "90 degC"))
    channel = found.channel[0].model_copy(update={"valid_temperature": wide})
    (of,) = gj.validate(found.model_copy(update={"channel": (channel,)}), rest)
    assert of.rests == 1
    cells = [cell for cell in of.cells if cell.unit == "deg/h"]
    assert [cell.temperature_c for cell in cells] == [
        pytest.approx((22.0 + 38.0 / 3.0 * k, 22.0 + 38.0 / 3.0 * (k + 1)), abs=0.02) for k in range(3)
    ]
    assert [cell.before for cell in cells] == pytest.approx([-200.0, 0.0, 200.0], abs=1.0)
    assert of.rms["deg/h"][0] == pytest.approx(np.sqrt(2.0 / 3.0) * 200.0, rel=0.01)
