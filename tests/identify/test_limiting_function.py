from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gradcal_jax.identify.limiting_function import (
    _floating,
    alignment_variance,
    drift_shape_of_mean,
    limiting_function,
    limiting_function_of_mean,
)

DEG_PER_H = np.pi / 180 / 3600
DEG_PER_ROOT_H = np.pi / 180 / 60
PAPER = (1 * DEG_PER_H, 120.0, 0.1 * DEG_PER_ROOT_H)

positive = st.floats(-6, 6).map(lambda exponent: 10.0**exponent)


def gauss_legendre(function, end):
    """Integral of a smooth function over [0, end], to rounding, over pieces no longer than one."""
    nodes, weights = np.polynomial.legendre.leggauss(20)
    edges = np.linspace(0, end, int(np.ceil(end)) + 1)
    return sum((b - a) / 2 * weights @ function((a + b) / 2 + (b - a) / 2 * nodes) for a, b in pairwise(edges))


def test_the_papers_half_hour_without_alignment():
    rate = limiting_function(1800.0, *PAPER)
    assert float(np.rad2deg(1800.0 * rate)) == pytest.approx(0.190, abs=5e-5)
    assert float(rate / DEG_PER_H) == pytest.approx(0.38, abs=5e-4)


def test_the_kalman_alignment_shrinks_to_its_prior():
    t = np.geomspace(1.0, 1e4, 50)
    unaligned = limiting_function(t, *PAPER)
    assert np.allclose(limiting_function(t, *PAPER, 0.0), unaligned, rtol=1e-14, atol=0.0)
    aligned = [limiting_function(t, *PAPER, delta) for delta in (0.0, 1.0, 10.0, 100.0, 1000.0)]
    for shorter, longer in pairwise(aligned):
        assert bool(np.all(longer < shorter))
    # Ten seconds: the mean's own error is 1.9 deg/h, the Kalman filter's never exceeds the prior's 1 deg/h.
    assert float(limiting_function_of_mean(1800.0, *PAPER, 10.0) / DEG_PER_H) > 1.9
    assert float(limiting_function(1800.0, *PAPER, 10.0) / DEG_PER_H) < 0.38


def test_alignment_variance_of_a_constant_bias_and_of_a_noiseless_sensor():
    assert float(alignment_variance(*_floating(30.0, 2.0, 1e9, 5.0))) == pytest.approx(
        4.0 * 25.0 / (25.0 + 4.0 * 30.0), rel=1e-6
    )
    assert float(alignment_variance(*_floating(30.0, 2.0, 100.0, 0.0))) == 0.0
    assert float(alignment_variance(*_floating(0.0, 2.0, 100.0, 0.0))) == 4.0
    assert float(limiting_function(30.0, 0.0, 100.0, 0.0, 10.0)) == 0.0


def test_a_discrete_kalman_filter_leaves_the_same_angle_error():
    """The whole experiment in discrete time, every covariance by brute force, with the step sent towards zero."""
    sigma, tau, walk, delta, t = 2.0, 40.0, 5.0, 25.0, 60.0

    def discrete(step):
        time = np.concatenate([-delta + step * (np.arange(round(delta / step)) + 0.5), [0.0]])
        count = len(time) - 1
        later = step * (np.arange(round(t / step)) + 0.5)
        times = np.concatenate([time, later])
        covariance = sigma**2 * np.exp(-np.abs(times[:, None] - times[None, :]) / tau)
        data = covariance[:count, :count] + walk**2 / step * np.eye(count)
        angle = np.zeros(len(times))
        angle[count + 1 :] = step  # the integral over the run, by the midpoint rule
        decay = tau * -np.expm1(-t / tau)
        gain = np.linalg.solve(data, covariance[:count, count])
        error = angle.copy()
        error[:count] -= decay * gain
        return np.sqrt(error @ covariance @ error + decay**2 * walk**2 / step * gain @ gain + walk**2 * t) / t

    coarse, fine = discrete(0.5), discrete(0.25)
    extrapolated = fine + (fine - coarse) / 3
    exact = float(limiting_function(t, sigma, tau, walk, delta))
    assert extrapolated == pytest.approx(exact, rel=1e-6)


@given(t=positive, delta=positive, tau=positive)
@settings(max_examples=200, deadline=None)
def test_mean_shape_keeps_its_digits_however_short_the_windows(t, delta, tau):
    """Against quadratures of positive integrands, r(u) = 2/u² ∫ (1 - e⁻ʷ)² dw, over twelve decades of t/τ."""

    def conditional_variance(u):
        if u > 200:
            return (2 * u - 3) / u**2
        return 2 / u**2 * gauss_legendre(lambda w: np.expm1(-w) ** 2, u)

    def loss(u):
        return 1.0 if u > 1e15 else gauss_legendre(lambda w: -np.expm1(-w), u) / u if u < 200 else 1 - 1 / u

    u, v = t / tau, delta / tau
    expected = conditional_variance(u) + conditional_variance(v) + (loss(u) - loss(v)) ** 2
    assert float(drift_shape_of_mean(t, delta, tau)) == pytest.approx(expected, rel=1e-12)
