"""Criteria, the proven limit, and the search, on plans small enough to know."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.polynomial import legendre
from scipy.optimize import minimize

from gradcal_jax.design import (
    Coordinates,
    Element,
    Frame,
    Limits,
    Optimality,
    criterion,
    gated_noise_density,
    least_noise_density,
    limit,
    make_coordinates,
    polish,
    scale_factor_floor,
    search,
)
from gradcal_jax.information import information, posterior, residual, square_root, statistic, whitened_rows
from gradcal_jax.model import Polynomial, SensorModel, angle_reference, constant, gauss_markov, make_map

DEG = np.pi / 180.0
WALK = 0.1 * DEG / 60.0
MAX = 300 * DEG


def model(degree_t: int, degree_w: int) -> SensorModel:
    scale = make_map(Polynomial(degree_t, 20.0, 50.0), Polynomial(degree_w, 0.0, MAX))
    drift, zero = gauss_markov(DEG / 3600.0, 120.0), jnp.zeros(())
    return SensorModel(None, scale, jnp.asarray(WALK), drift, angle_reference(0.05 * DEG), zero, jnp.asarray(np.inf))


def small_plan(turns: int) -> Coordinates:
    elements = tuple(Element("rest" if i % 2 else "cosine ramps", 2.0) for i in range(2 * turns - 1))
    return make_coordinates(
        elements,
        Limits(MAX, 300 * DEG, np.inf, 2.0 / 60.0),
        Frame(120.0, 240.0, 3000.0, -30.0, 70.0, 1.0),
        cycles=4,
        others_read=True,
        free=frozenset({"duration", "peak_rate", "ramp"}),
    )


TEMPERATURES, RATES = np.linspace(-30, 70, 11), np.linspace(-MAX, MAX, 13)
LINEAR = model(1, 1)
CRITERION = criterion(LINEAR, "scale_factor", TEMPERATURES, RATES, "mean of max")
PLAN = small_plan(2)


@eqx.filter_jit
def rows_of(z):
    return square_root(whitened_rows(PLAN.decode(z).timeline(), LINEAR))


def objective(z, sharpness):
    return CRITERION(rows_of(z), sharpness) * 1e6


POINT = jnp.asarray(np.random.default_rng(3).standard_normal(PLAN.size))


def test_the_exact_criterion_is_the_reported_statistic_and_the_smooth_one_lies_just_above():
    known = posterior(information(PLAN.decode(POINT).timeline(), LINEAR))
    reported = statistic("mean of max", residual(known, LINEAR, "scale_factor", TEMPERATURES, RATES)) * 1e6
    exact = float(objective(POINT, None))
    assert exact == pytest.approx(reported, rel=1e-10)
    for sharpness in (10.0, 100.0, 1000.0):
        smooth = float(objective(POINT, jnp.asarray(sharpness)))
        assert exact <= smooth <= exact * len(TEMPERATURES) ** (1.0 / sharpness) * (1 + 1e-12)


def test_the_gradient_is_the_difference():
    sharpness = jnp.asarray(50.0)
    value = jax.jit(lambda z: jnp.log(objective(z, sharpness)))
    gradient = np.asarray(jax.jit(jax.grad(value))(POINT))
    step = 1e-5
    eye = np.eye(PLAN.size)
    difference = np.array([float(value(POINT + step * e) - value(POINT - step * e)) / (2 * step) for e in eye])
    assert np.max(np.abs(gradient - difference)) < 1e-6 * np.linalg.norm(gradient)


def limit_of(criterion_, constant_in_t: SensorModel, seconds: float):
    return limit(
        criterion_,
        constant_in_t,
        motion_time=seconds,
        temperatures=np.array([20.0]),
        fixed_programme=True,
        max_rate=MAX,
        noise_density=WALK**2,
        tolerance=1e-7,
    )


def test_the_limit_meets_the_known_g_optimum():
    """M = b0 + b1·x, x = ω/ω_max: all the time at x = ±1 is best, and leaves √2·N/(ω_max·√time) at the ends."""
    constant_in_t = model(0, 1)
    worst = criterion(constant_in_t, "scale_factor", np.array([20.0]), np.linspace(-MAX, MAX, 21), "max")
    found = limit_of(worst, constant_in_t, 1000.0)
    known = np.sqrt(2.0) * WALK / (MAX * np.sqrt(1000.0))
    assert found.certified <= known * (1 + 1e-12)
    assert found.certified == pytest.approx(known, rel=1e-6)
    assert found.reached == pytest.approx(known, rel=1e-6)


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_the_limit_meets_the_known_d_optimum(degree):
    """Polynomials without a constant, x … x^(d+1): their D-optimal weights and places are found here by a search of
    their own, over symmetric designs, of which one is optimal."""
    constant_in_t = model(0, degree)
    found = limit_of(Optimality(jnp.eye(degree + 1), "D"), constant_in_t, 1000.0)
    powers = np.arange(1, degree + 2)

    def negative(z):
        inner = 1.0 / (1.0 + np.exp(-z[:1]))
        places = np.concatenate([[1.0], inner])
        weights = np.exp(np.append(z[1:], 0.0))
        weights = np.repeat(weights / np.sum(weights) / 2.0, 2)
        rows = np.stack([places, -places], axis=1).ravel()[:, None] ** powers
        return -np.linalg.slogdet((rows * weights[:, None]).T @ rows)[1]

    best = min(
        minimize(negative, z, method="Nelder-Mead", options={"xatol": 1e-11, "fatol": 1e-14}).fun
        for z in ([0.0, 0.0], [-1.0, 1.0], [1.0, -1.0])
    )
    # The model's columns are Legendre polynomials: their leading coefficients are the change of determinant.
    leading = np.prod([legendre.leg2poly(np.eye(degree + 1)[k])[-1] for k in range(degree + 1)])
    known = WALK / (MAX * np.sqrt(1000.0)) * np.exp((best - 2 * np.log(leading)) / (2 * (degree + 1)))
    assert found.certified <= known * (1 + 1e-9)
    assert found.certified == pytest.approx(known, rel=1e-6)
    assert found.reached == pytest.approx(known, rel=1e-6)


def test_drift_and_readings_only_raise_the_limit():
    density = least_noise_density(LINEAR, 1.0)
    assert density > WALK**2
    quiet = eqx.tree_at(lambda m: m.reference.reading_noise, LINEAR, jnp.zeros(()))
    assert least_noise_density(quiet, 1.0) == pytest.approx(WALK**2, rel=1e-3)


def test_turns_in_windows_meet_more_noise_than_turns_at_any_time():
    windows = [(360.0 * k, 360.0 * k + 120.0) for k in range(4)]
    free = least_noise_density(LINEAR, 1.0)
    gated = gated_noise_density(LINEAR, 1.0, windows)
    assert free < gated
    # One window of the whole time is no restriction but for its ends.
    assert gated_noise_density(LINEAR, 1.0, [(0.0, 20000.0)]) == pytest.approx(free, rel=0.02)


def test_what_multiplies_the_rate_stays_as_known():
    """The best mean of a stationary Gauss-Markov process over a time: its variance is 2τσ²/(time + 2τ)."""
    drift, time, tau = LINEAR.processes, 6000.0, 1200.0
    unstable = gauss_markov(20e-6, tau, bias_gain=0.0, rate_gain=1.0)
    clock = constant(3e-6, rate_gain=1.0)
    with_ = lambda more: eqx.tree_at(lambda m: m.processes, model(0, 1), more)  # noqa: E731
    times, at = time * (np.arange(600) + 0.5) / 600, np.array([-30.0, 20.0])
    known = 2 * tau * 20e-6**2 / (time + 2 * tau)
    found = scale_factor_floor(with_(drift + unstable), times, 0.0 * times, at)
    np.testing.assert_allclose(found, known, rtol=2e-3)
    np.testing.assert_allclose(scale_factor_floor(with_(clock), times[:0], times[:0], at), 3e-6**2)
    both = scale_factor_floor(with_(drift + unstable + clock), times, 0.0 * times, at)
    np.testing.assert_allclose(both, found + 3e-6**2, rtol=1e-12)
    np.testing.assert_array_equal(scale_factor_floor(with_(drift), times, times, at), 0.0)


def test_a_prior_leaves_of_what_stays_as_much_as_one_reading_of_it_would():
    """Of M = c + d with d seen and a prior on c of variance P: shared out, the quarter of it counts."""
    clock, std = constant(3e-6, rate_gain=1.0), 5e-6
    sure = eqx.tree_at(
        lambda m: (m.processes, m.scale),
        model(0, 1),
        (clock, make_map(Polynomial(0, 20.0, 50.0), Polynomial(1, 0.0, MAX), prior_std=std)),
    )
    found = scale_factor_floor(sure, np.zeros(0), np.zeros(0), np.array([20.0]))
    np.testing.assert_allclose(found, 1.0 / (4.0 / std**2 + 1.0 / 3e-6**2), rtol=1e-9)
    loose = eqx.tree_at(lambda m: m.scale.prior_std, sure, np.asarray(1.0))
    np.testing.assert_allclose(
        scale_factor_floor(loose, np.zeros(0), np.zeros(0), np.array([20.0])), 3e-6**2, rtol=1e-9
    )


def test_a_floor_under_the_residual_raises_the_limit_and_stays_below_what_is_reached():
    floor = (1e-6 * np.linspace(1.0, 2.0, len(TEMPERATURES))) ** 2
    raised = eqx.tree_at(lambda c: c.beyond, CRITERION, jnp.asarray(np.repeat(floor, len(RATES))))
    options = {
        "motion_time": 480.0,
        "temperatures": np.linspace(-30, 70, 9),
        "fixed_programme": True,
        "max_rate": MAX,
        "noise_density": WALK**2,
    }
    alone, together = limit(CRITERION, LINEAR, **options), limit(raised, LINEAR, **options)
    assert together.certified <= together.reached * (1 + 1e-12)
    assert together.certified == pytest.approx(together.reached, rel=5e-3)
    assert max(alone.certified, 2e-6) < together.certified
    assert together.certified < alone.reached + 2e-6


def without_limits(z, sharpness):
    return objective(z, sharpness), jnp.zeros(0)


def test_the_search_improves_goes_on_where_it_was_and_never_beats_the_limit():
    options = {"starts": 2, "seed": 0, "steps": 80, "chunk": 20, "hops": 1}
    whole = [p.state for p in search(without_limits, PLAN.size, **options)]
    rest = [p.state for p in search(without_limits, PLAN.size, **options, state=whole[1])]
    best = whole[-1]
    assert len(rest) == len(whole) - 2
    assert rest[-1].best == best.best
    assert np.array_equal(rest[-1].best_point, best.best_point)
    found = polish(without_limits, best.best_point)
    assert found.value <= best.best <= best.first
    assert found.value == pytest.approx(float(objective(jnp.asarray(found.point), None)), rel=1e-12)
    assert found.converged, found.sentence
    proven = limit(
        CRITERION,
        LINEAR,
        motion_time=4 * 120.0,
        temperatures=np.linspace(-30, 70, 41),
        fixed_programme=True,
        max_rate=MAX,
        noise_density=least_noise_density(LINEAR, 1.0),
    )
    assert proven.certified <= proven.reached * (1 + 1e-12)
    assert proven.certified * 1e6 <= found.value


def test_a_limit_that_binds_is_held_and_priced():
    """Minimise x² + y² under x + y ≥ 2: the optimum is (1, 1), where the limit binds."""

    def under_a_limit(z, sharpness):
        del sharpness
        return 1.0 + z @ z, jnp.log(2.0 / jnp.maximum(jnp.sum(z) + 10.0, 0.1) * 6.0)[None]

    *_, last = search(under_a_limit, 2, starts=2, seed=0, steps=80, chunk=20, hops=0)
    found = polish(under_a_limit, last.state.best_point)
    assert np.allclose(found.point, [1.0, 1.0], atol=1e-5)
    assert found.converged, found.sentence
    assert found.gradient_norm < 1e-5
