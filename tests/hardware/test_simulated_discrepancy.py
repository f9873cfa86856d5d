"""Simulated devices have the structure that a discrepancy says the maps lack."""

import numpy as np
import pytest

import gradcal_jax as gj
from gradcal_jax.hardware.simulate.draws import draw_truth
from gradcal_jax.spec import presets

OF_BIAS = {"degree": 1, "centre": "20 degC", "scale": "50 K"}
SPEC = gj.changed(gj.parse_spec(presets.text("paper-dynamic-gradient")), {"sensor.gyro.bias": {"temperature": OF_BIAS}})
HIDDEN = {
    "sensor.gyro.scale_factor.discrepancy": {
        "standard_deviation": "20 ppm", "temperature_degree": 5, "rate_degree": 4},
    "sensor.gyro.bias.discrepancy": {"standard_deviation": "3 deg/h", "temperature_degree": 5},
}  # fmt: skip


PLAIN = draw_truth(SPEC, 0, 0).triads["gyro"].errors


def drawn(spec, count=200):
    """The hidden scale factors and biases of many devices, along x."""
    triads = [draw_truth(spec, seed, 0).triads["gyro"].errors for seed in range(count)]
    beyond = [error for errors in triads for error in errors[len(PLAIN) :]]
    scales = [error.values[0].T for error in beyond if callable(error.factors)]
    return np.array(scales), np.array([error.values[0, 0] for error in beyond if error.factors == "one"])


def test_functions_beyond_the_maps_have_the_size_that_the_spec_says():
    scales, biases = drawn(gj.changed(SPEC, HIDDEN))
    kept_t, kept_w = SPEC.sensor.gyro.scale_factor.temperature.size, SPEC.sensor.gyro.scale_factor.rate.size
    assert scales.shape[1:] == (6, 5)
    assert not np.any(scales[:, :kept_t, :kept_w])
    beyond = np.ones((6, 5), bool)
    beyond[:kept_t, :kept_w] = False
    assert np.std(scales[:, beyond]) == pytest.approx(20e-6, rel=0.05)
    assert not np.any(biases[:, : SPEC.sensor.gyro.bias.temperature.size])
    assert np.std(biases[:, SPEC.sensor.gyro.bias.temperature.size :]) == pytest.approx(
        np.radians(3.0) / 3600.0, rel=0.1
    )


def test_other_draws_are_as_without_it():
    plain, hidden = (draw_truth(spec, 3, 0).names for spec in (SPEC, gj.changed(SPEC, HIDDEN)))
    assert plain == hidden
    assert not len(drawn(SPEC, 2)[0])
