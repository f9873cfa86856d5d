"""The relaxed problem of a scale factor's limit, on cases small enough to know."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import scale_map

from gradcal_jax.design.noise_floor import scale_factor_floor, seen_continuously
from gradcal_jax.design.relaxed_limit import RelaxedProblem, relaxed_limit
from gradcal_jax.model import Map, Polynomial, constant, gauss_markov, no_processes

DEG = np.pi / 180.0
WALK = 0.1 * DEG / 60.0
MAX = 300 * DEG
DRIFT = gauss_markov(DEG / 3600.0, 120.0)


def scale_factor(degree_t: int, degree_w: int, **prior) -> Map:
    return scale_map(Polynomial(degree_t, 20.0, 50.0), Polynomial(degree_w, 0.0, MAX), **prior)


def problem_of(scale: Map, temperature, rate, statistic: str, seconds: float, *, at=(20.0,)) -> RelaxedProblem:
    grid = np.meshgrid(temperature, rate, indexing="ij")
    rows, prior = scale.values(*grid), np.asarray(scale.prior_rows())
    return RelaxedProblem((scale,), rows, np.zeros(len(rows)), statistic, prior, np.array(at), MAX, seconds / WALK**2)


def test_the_limit_meets_the_known_g_optimum():
    """M = b0 + b1·x, x = ω/ω_max: all the time at x = ±1 is best, and leaves √2·N/(ω_max·√time) at the ends."""
    problem = problem_of(scale_factor(0, 1), [20.0], np.linspace(-MAX, MAX, 21), "max", 1000.0)
    result = relaxed_limit(problem, tolerance=1e-7)
    known = np.sqrt(2.0) * WALK / (MAX * np.sqrt(1000.0))
    assert result <= known * (1 + 1e-12)
    assert result == pytest.approx(known, rel=1e-6)


def still(t):
    return np.full(np.shape(t), 20.0)


def test_what_multiplies_the_rate_stays_as_known():
    """The best mean of a stationary Gauss-Markov process over a time: its variance is 2τσ²/(time + 2τ), for any τ."""
    time, scale = 6000.0, scale_factor(0, 1)
    clock = constant(3e-6, rate_gain=1.0)
    at = np.array([-30.0, 20.0])
    # In one window, in touching ones, and almost in one: what is not looked at for a moment tells next to nothing.
    for windows in ([(0.0, time)], [(0.0, 2000.0), (2000.0, time)], [(0.0, 2000.0), (2000.001, time)]):
        for tau in (1.0, 1200.0, 1e5):
            unstable = gauss_markov(20e-6, tau, bias_gain=0.0, rate_gain=1.0)
            known = 2 * tau * 20e-6**2 / (time + 2 * tau)
            result = scale_factor_floor(scale, DRIFT + unstable, windows, still, at)
            np.testing.assert_allclose(result, known, rtol=2e-3)
    np.testing.assert_allclose(scale_factor_floor(scale, DRIFT + clock, [], still, at), 3e-6**2)
    both = scale_factor_floor(scale, DRIFT + unstable + clock, [(0.0, time)], still, at)
    np.testing.assert_allclose(both, known + 3e-6**2, rtol=1e-9)
    for quiet in (DRIFT, no_processes()):
        np.testing.assert_array_equal(scale_factor_floor(scale, quiet, [(0.0, time)], still, at), 0.0)


def test_a_continuous_look_is_what_ever_closer_samples_come_to():
    """A cubic in a temperature that ramps, in windows: against generalised least squares of dense samples."""
    tau, windows, cubic = 50.0, [(0.0, 120.0), (300.0, 380.0)], scale_factor(3, 1)
    unstable = gauss_markov(20e-6, tau, bias_gain=0.0, rate_gain=1.0)
    ramp = lambda t: -30.0 + 0.25 * t  # noqa: E731
    at = np.array([-20.0, 10.0, 60.0])
    result = scale_factor_floor(cubic, unstable, windows, ramp, at)
    times = np.concatenate([np.linspace(a, b, 401) for a, b in windows])
    kernel = 20e-6**2 * np.exp(-np.abs(times[:, None] - times[None]) / tau)
    seen, wanted = (cubic.temperature(t) for t in (ramp(times), at))
    covariance = np.linalg.inv(seen.T @ np.linalg.solve(kernel, seen))
    np.testing.assert_allclose(result, np.einsum("gi,ij,gj->g", wanted, covariance, wanted), rtol=1e-4)


def test_of_a_bias_in_white_noise_every_second_counts():
    """Against the rows of a dense sum; with a drift besides, more stays."""
    basis, at = Polynomial(2, 20.0, 50.0), np.array([-30.0, 20.0, 70.0])
    course, windows = lambda t: -30.0 + t / 60.0, [(0.0, 3000.0), (3600.0, 6000.0)]
    times = np.concatenate([np.arange(a, b, 0.1) + 0.05 for a, b in windows])
    rows = basis(course(times)) * np.sqrt(0.1) / WALK
    wanted = np.linalg.norm(np.linalg.solve(np.linalg.qr(rows, mode="r").T, basis(at).T), axis=0)
    seen = windows, course, basis(at)
    found = seen_continuously(basis, np.zeros((0, 3)), WALK, no_processes(), *seen)
    np.testing.assert_allclose(found, wanted, rtol=1e-5)
    assert np.all(seen_continuously(basis, np.zeros((0, 3)), WALK, DRIFT, *seen) > 1.5 * wanted)


def test_a_prior_leaves_of_what_stays_as_much_as_one_reading_of_it_would():
    """Of M = c + d with d seen and a prior on c of variance P: shared out, the quarter of it counts."""
    clock, std = constant(3e-6, rate_gain=1.0), 5e-6
    sure = scale_factor(0, 1, prior_std=std)
    result = scale_factor_floor(sure, clock, [], still, np.array([20.0]))
    np.testing.assert_allclose(result, 1.0 / (4.0 / std**2 + 1.0 / 3e-6**2), rtol=1e-9)
    loose = replace(sure, prior_std=np.asarray(1.0))
    np.testing.assert_allclose(scale_factor_floor(loose, clock, [], still, np.array([20.0])), 3e-6**2, rtol=1e-9)


def test_a_floor_under_the_residual_raises_the_limit_and_stays_below_what_is_reached():
    temperatures, rates = np.linspace(-30, 70, 11), np.linspace(-MAX, MAX, 13)
    floor = (1e-6 * np.linspace(1.0, 2.0, len(temperatures))) ** 2
    without = problem_of(scale_factor(1, 1), temperatures, rates, "mean of max", 480.0, at=np.linspace(-30, 70, 9))
    alone = relaxed_limit(without)
    together = relaxed_limit(without._replace(floor=floor))
    assert max(alone, 2e-6) < together < 1.002 * alone + 2e-6
