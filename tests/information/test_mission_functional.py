"""A mission's functional and the noise of the unit in it, against brute force and closed forms."""

import numpy as np
import pytest
from helpers import gyro_x, scale_map

from gradcal_jax import model
from gradcal_jax.information.missions import Flight, mission_contrasts, mission_rows, own_variance
from gradcal_jax.model import Bins, BSpline, Polynomial

FLIGHT = Flight(np.array([0.0, 40.0, 41.0, 100.0]), np.array([0.0, 2.0, -1.0, 0.5]), np.array([20.0, 20.0, 24.0, -5.0]))


def brute(flight: Flight, of, end: float, steps: int = 200_001) -> np.ndarray:
    t = np.linspace(0.0, end, steps)
    values = of(np.interp(t, flight.time, flight.temperature), np.interp(t, flight.time, flight.rate))
    return np.sum(np.diff(t)[:, None] * (values[1:] + values[:-1]) / 2.0, axis=0)


@pytest.mark.parametrize(
    ("of_temperature", "of_rate", "tolerance"),
    [
        (Polynomial(3, 20.0, 50.0), Polynomial(3, 0.0, 5.0), 1e-8),
        (BSpline((-40.0, 0.0, 40.0), 3), BSpline((-5.0, 0.0, 5.0), 2), 1e-4),
        (Bins((-40.0, 0.0, 40.0)), Bins((-5.0, 0.0, 5.0)), 2e-3),
    ],
)
def test_the_rows_are_integrals_along_the_mission(of_temperature, of_rate, tolerance):
    hidden = (1e-5, 5, 5) if isinstance(of_rate, Polynomial) else None
    bias, scale = model.make_map(of_temperature), scale_map(of_temperature, of_rate, discrepancy=hidden)
    sensor = gyro_x((bias, scale, model.GradientOfBias(std=np.ones(()), has_prior=True)))
    at = np.array([10.0, 41.0, 90.0])
    rows = mission_rows(sensor, FLIGHT, at)
    for row, end in zip(rows, at, strict=True):
        of_b = brute(FLIGHT, lambda t, w: bias.values(t, w), end)
        of_m = brute(FLIGHT, lambda t, w: scale.values(t, w) * w[:, None], end)
        np.testing.assert_allclose(row[sensor.where("bias")], of_b, rtol=tolerance, atol=tolerance * end)
        np.testing.assert_allclose(row[sensor.where("scale_factor")], of_m, rtol=tolerance, atol=tolerance * end)
        change = np.interp(end, FLIGHT.time, FLIGHT.temperature) - 20.0
        assert row[sensor.where("bias_temperature_gradient")] == pytest.approx(change, abs=1e-9)
    turned = [brute(FLIGHT, lambda t, w: w[:, None], end)[0] for end in at]
    np.testing.assert_allclose(FLIGHT.angle(at), turned, rtol=1e-7)
    if hidden is not None:
        places = mission_contrasts(sensor, rows)
        where = sensor.where("scale_factor_discrepancy")
        assert np.array_equal(places.alone[:, where], rows[:, where])
        assert np.count_nonzero(np.delete(places.alone, np.arange(where.start, where.stop), axis=1)) == 0
        np.testing.assert_allclose(places.beyond, 1e-10 * np.sum(rows[:, where] ** 2, axis=1))


def test_closed_forms_of_the_units_own_noise():
    time, sigma, tau = 700.0, 3.0, 200.0
    still = Flight(np.array([0.0, time]), np.ones(2), np.zeros(2))
    drift = model.gauss_markov(sigma, tau)
    square = 2.0 * (sigma * tau) ** 2 * (time / tau - 1.0 + np.exp(-time / tau))
    assert own_variance(still, drift, [0], time) == pytest.approx(square, rel=1e-9)
    # The rate is 1 rad/s throughout: what it multiplies is the same.
    scaled = model.gauss_markov(sigma, tau, bias_gain=0.0, rate_gain=1.0)
    assert own_variance(still, scaled, [0], time) == pytest.approx(square, rel=1e-9)
    assert own_variance(still, model.rate_random_walk(2.0), [0], time) == pytest.approx(4.0 * time**3 / 3.0, rel=1e-6)
    assert own_variance(still, model.constant(2.0, bias_gain=1.0, rate_gain=0.5), [0], time) == pytest.approx(
        (3.0 * time) ** 2
    )
    both = drift + scaled
    assert own_variance(still, both, [0, 1], time) == pytest.approx(2.0 * square, rel=1e-9)


def test_noise_that_the_rate_multiplies_against_a_double_sum():
    process = model.gauss_markov(2.0, 15.0, bias_gain=0.3, rate_gain=1.0)
    t = np.linspace(0.0, 100.0, 2001)
    middle = (t[1:] + t[:-1]) / 2.0
    gain = 0.3 + np.interp(middle, FLIGHT.time, FLIGHT.rate)
    apart = np.abs(middle[:, None] - middle[None, :])
    expected = 4.0 * (0.05**2) * gain @ np.exp(-apart / 15.0) @ gain
    assert own_variance(FLIGHT, process, [0], 100.0) == pytest.approx(expected, rel=1e-3)
