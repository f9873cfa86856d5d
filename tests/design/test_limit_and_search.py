"""Criteria, the proven limit, and the search, on plans small enough to know."""

import os

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.polynomial import legendre
from scipy.optimize import minimize

from gradcal_jax.design import (
    Case,
    Compiled,
    Coordinates,
    Element,
    Frame,
    Limits,
    Objective,
    Optimality,
    criterion,
    least_noise_density,
    limit,
    make_coordinates,
    multipliers,
    polish,
    scale_factor_floor,
    search,
)
from gradcal_jax.design.search import _NOWHERE, _program
from gradcal_jax.information import information, posterior, residual, statistic
from gradcal_jax.model import Polynomial, SensorModel, angle_reference, constant, gauss_markov, gyro_model, make_map
from gradcal_jax.motion import rule_of

DEG = np.pi / 180.0
WALK = 0.1 * DEG / 60.0
MAX = 300 * DEG


def model(degree_t: int, degree_w: int, **prior) -> SensorModel:
    scale = make_map(Polynomial(degree_t, 20.0, 50.0), Polynomial(degree_w, 0.0, MAX), **prior)
    return gyro_model(None, scale, WALK, gauss_markov(DEG / 3600.0, 120.0), angle_reference(0.05 * DEG))


def small_plan(turns: int, *, motion: float = 3000.0, cycles: int = 4) -> Coordinates:
    elements = tuple(Element("rest" if i % 2 else "cosine ramps", 2.0) for i in range(2 * turns - 1))
    return make_coordinates(
        elements,
        Limits(MAX, 300 * DEG, np.inf, 2.0 / 60.0),
        Frame(120.0, 240.0, motion, -30.0, 70.0, 1.0),
        cycles=cycles,
        others_read=True,
        free=frozenset({"duration", "peak_rate", "ramp"}),
    )


TEMPERATURES, RATES = np.linspace(-30, 70, 11), np.linspace(-MAX, MAX, 13)
LINEAR = model(1, 1)
CRITERION = criterion(LINEAR, "scale_factor", TEMPERATURES, RATES, "mean of max")
PLAN = small_plan(2)


RULE = rule_of(LINEAR, PLAN.decode(np.zeros(PLAN.size)).trajectory())
CASE = Case(LINEAR, None, (CRITERION,), (), np.asarray(1.0), RULE)
PPM = np.array([1e6])
POINT = np.random.default_rng(3).standard_normal(PLAN.size)


def compiled(coordinates: Coordinates = PLAN, case: Case = CASE) -> Compiled:
    padded = coordinates.padded()
    return Compiled(Objective(padded, (case,), PPM, np.zeros(0)), padded.size, coordinates.places_in(padded))


def test_the_exact_criterion_is_the_reported_statistic_and_the_smooth_one_lies_just_above():
    known = posterior(information(PLAN.decode(POINT).trajectory(), LINEAR))
    reported = statistic("mean of max", residual(known, LINEAR, "scale_factor", TEMPERATURES, RATES)) * 1e6
    at = compiled()
    exact = np.exp(at(POINT).logs[0])
    assert exact == pytest.approx(reported, rel=1e-10)
    for sharpness in (10.0, 100.0, 1000.0):
        smooth = np.exp(at(POINT, sharpness).logs[0])
        assert exact <= smooth <= exact * len(TEMPERATURES) ** (1.0 / sharpness) * (1 + 1e-12)


def test_the_gradients_are_the_differences():
    at, step, eye = compiled(), 1e-5, np.eye(PLAN.size)
    gradient = at(POINT, 50.0).of_z[0]
    value = lambda z: at(z, 50.0).logs[0]  # noqa: E731
    difference = np.array([(value(POINT + step * e) - value(POINT - step * e)) / (2 * step) for e in eye])
    assert np.max(np.abs(gradient - difference)) < 1e-6 * np.linalg.norm(gradient)


def test_a_discrepancy_counts_in_the_search_as_in_the_prediction():
    hidden = model(1, 1, discrepancy=(5e-6, 2, 3))
    asked = criterion(hidden, "scale_factor", TEMPERATURES, RATES, "mean of max")
    rule = rule_of(hidden, PLAN.decode(POINT).trajectory())
    at = compiled(case=Case(hidden, None, (asked,), (), np.asarray(1.0), rule))
    known = posterior(information(PLAN.decode(POINT).trajectory(), hidden))
    reported = statistic("mean of max", residual(known, hidden, "scale_factor", TEMPERATURES, RATES)) * 1e6
    result = at(POINT)
    assert np.exp(result.logs[0]) == pytest.approx(reported, rel=1e-9)
    assert reported > np.exp(compiled()(POINT).logs[0]) + 1.0
    direction = np.random.default_rng(4).standard_normal(PLAN.size)
    difference = (at(POINT + 1e-5 * direction).logs[0] - at(POINT - 1e-5 * direction).logs[0]) / 2e-5
    assert result.of_z[0] @ direction == pytest.approx(difference, rel=1e-5)


def test_one_program_serves_every_plan_of_its_class():
    """Another structure, other times and rates, other sharpnesses: nothing is compiled again."""
    other = small_plan(2, motion=3300.0, cycles=4)
    one, two = compiled(), compiled(other)
    one(POINT)
    before = _program.cache_info().currsize, one._program._cache_size()
    for at in (one, two):
        at(POINT, 8.0), at(POINT, np.inf)
    assert two._program is one._program
    assert (_program.cache_info().currsize, one._program._cache_size()) == before


def test_a_search_compiles_its_descents_alone_and_their_program_has_the_exact_merit():
    """The program of the slopes, which takes as long to compile, waits for the polish."""
    at = Compiled(UnderALimit(np.asarray(2.0)), 3, np.array([0, 2]))
    before = at._program._cache_size()
    *_, last = search(at, starts=2, seed=0, steps=80, hops=0)
    assert at._program._cache_size() == before
    for z in (last.state.best_point, np.array([0.3, 0.4]), np.array([-2.0, 5.0])):
        assert at.merit(z) == pytest.approx(at(z).merit()[0], rel=1e-12)
    for z in (np.array([np.nan, 0.0]), np.array([1e200, 0.0])):
        assert at.merit(z) == at(z).merit()[0] == _NOWHERE


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
    result = limit_of(worst, constant_in_t, 1000.0)
    known = np.sqrt(2.0) * WALK / (MAX * np.sqrt(1000.0))
    assert result.certified <= known * (1 + 1e-12)
    assert result.certified == pytest.approx(known, rel=1e-6)
    assert result.reached == pytest.approx(known, rel=1e-6)


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_the_limit_meets_the_known_d_optimum(degree):
    """Polynomials without a constant, x … x^(d+1): their D-optimal weights and places are found here by a search of
    their own, over symmetric designs, of which one is optimal."""
    constant_in_t = model(0, degree)
    result = limit_of(Optimality(np.eye(degree + 1), "D"), constant_in_t, 1000.0)
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
    assert result.certified <= known * (1 + 1e-9)
    assert result.certified == pytest.approx(known, rel=1e-6)
    assert result.reached == pytest.approx(known, rel=1e-6)


def test_drift_and_readings_only_raise_the_limit():
    density = least_noise_density(LINEAR, 1.0)
    assert density > WALK**2
    quiet = eqx.tree_at(lambda m: m.reference.reading_noise, LINEAR, np.zeros(()))
    assert least_noise_density(quiet, 1.0) == pytest.approx(WALK**2, rel=1e-3)


def still(t):
    return np.full(np.shape(t), 20.0), np.zeros(np.shape(t))


def test_what_multiplies_the_rate_stays_as_known():
    """The best mean of a stationary Gauss-Markov process over a time: its variance is 2τσ²/(time + 2τ), for any τ."""
    drift, time = LINEAR.processes, 6000.0
    clock = constant(3e-6, rate_gain=1.0)
    with_ = lambda more: eqx.tree_at(lambda m: m.processes, model(0, 1), more)  # noqa: E731
    at = np.array([-30.0, 20.0])
    # In one window, in touching ones, and almost in one: what is not looked at for a moment tells next to nothing.
    for windows in ([(0.0, time)], [(0.0, 2000.0), (2000.0, time)], [(0.0, 2000.0), (2000.001, time)]):
        for tau in (1.0, 1200.0, 1e5):
            unstable = gauss_markov(20e-6, tau, bias_gain=0.0, rate_gain=1.0)
            known = 2 * tau * 20e-6**2 / (time + 2 * tau)
            result = scale_factor_floor(with_(drift + unstable), windows, still, at)
            np.testing.assert_allclose(result, known, rtol=2e-3)
    np.testing.assert_allclose(scale_factor_floor(with_(clock), [], still, at), 3e-6**2)
    both = scale_factor_floor(with_(drift + unstable + clock), [(0.0, time)], still, at)
    np.testing.assert_allclose(both, known + 3e-6**2, rtol=1e-9)
    np.testing.assert_array_equal(scale_factor_floor(with_(drift), [(0.0, time)], still, at), 0.0)


def test_a_continuous_look_is_what_ever_closer_samples_come_to():
    """A cubic in a temperature that ramps, in windows: against generalised least squares of dense samples."""
    tau, windows = 50.0, [(0.0, 120.0), (300.0, 380.0)]
    unstable = gauss_markov(20e-6, tau, bias_gain=0.0, rate_gain=1.0)
    ramp = lambda t: (-30.0 + 0.25 * t, np.full(np.shape(t), 0.25))  # noqa: E731
    cubic = eqx.tree_at(lambda m: m.processes, model(3, 1), unstable)
    at = np.array([-20.0, 10.0, 60.0])
    result = scale_factor_floor(cubic, windows, ramp, at)
    times = np.concatenate([np.linspace(a, b, 401) for a, b in windows])
    kernel = 20e-6**2 * np.exp(-np.abs(times[:, None] - times[None]) / tau)
    seen, wanted = (cubic.scale.temperature(t) for t in (ramp(times)[0], at))
    covariance = np.linalg.inv(seen.T @ np.linalg.solve(kernel, seen))
    np.testing.assert_allclose(result, np.einsum("gi,ij,gj->g", wanted, covariance, wanted), rtol=1e-4)


def test_a_prior_leaves_of_what_stays_as_much_as_one_reading_of_it_would():
    """Of M = c + d with d seen and a prior on c of variance P: shared out, the quarter of it counts."""
    clock, std = constant(3e-6, rate_gain=1.0), 5e-6
    sure = eqx.tree_at(lambda m: m.processes, model(0, 1, prior_std=std), clock)
    result = scale_factor_floor(sure, [], still, np.array([20.0]))
    np.testing.assert_allclose(result, 1.0 / (4.0 / std**2 + 1.0 / 3e-6**2), rtol=1e-9)
    loose = eqx.tree_at(lambda m: m.terms[0].prior_std, sure, np.asarray(1.0))
    np.testing.assert_allclose(scale_factor_floor(loose, [], still, np.array([20.0])), 3e-6**2, rtol=1e-9)


def test_a_floor_under_the_residual_raises_the_limit_and_stays_below_what_is_reached():
    floor = (1e-6 * np.linspace(1.0, 2.0, len(TEMPERATURES))) ** 2
    options = {
        "motion_time": 480.0,
        "temperatures": np.linspace(-30, 70, 9),
        "fixed_programme": True,
        "max_rate": MAX,
        "noise_density": WALK**2,
    }
    alone = limit(CRITERION, LINEAR, **options)
    together = limit(CRITERION, LINEAR, **options, floor=np.repeat(floor, len(RATES)))
    assert together.certified <= together.reached * (1 + 1e-12)
    assert together.certified == pytest.approx(together.reached, rel=5e-3)
    assert max(alone.certified, 2e-6) < together.certified
    assert together.certified < alone.reached + 2e-6


def test_the_search_improves_and_never_beats_the_limit():
    options = {"starts": 2, "seed": 0, "steps": 80, "hops": 1}
    at = compiled()
    *_, last = search(at, **options)
    best = last.state
    result = polish(at, best.best_point)
    assert result.value <= best.best <= best.first
    assert result.value == pytest.approx(np.exp(at(result.point).logs[0]), rel=1e-12)
    assert result.converged, result.sentence
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
    assert proven.certified * 1e6 <= result.value


@pytest.mark.long
def test_a_gpu_descends_side_by_side_to_the_same_plans(monkeypatch):
    """(The program for a GPU runs here on the CPU.)"""
    at, options = compiled(), {"starts": 2, "seed": 0, "steps": 40, "hops": 1}
    by_threads = [p.state for p in search(at, **options)]
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    side_by_side = [p.state for p in search(compiled(), **options)]
    assert len(side_by_side) == len(by_threads)
    assert side_by_side[-1].best == pytest.approx(by_threads[-1].best, rel=1e-4)
    np.testing.assert_allclose(side_by_side[5].values[:6], by_threads[5].values[:6], rtol=1e-3)


def test_a_search_that_is_stopped_ends_at_once_with_its_best():
    asked = []

    def stop() -> bool:
        asked.append(1)
        return len(asked) > 3

    *_, last = search(compiled(), starts=4, seed=0, steps=80, stop=stop)
    # Descents go on side by side, one for each core.
    assert last.step <= 1 + (os.cpu_count() or 1)
    assert last.best <= last.first


class UnderALimit(eqx.Module):
    """1 + x² + y² under x + y ≥ 2: the optimum is (1, 1), where the limit binds."""

    offset: np.ndarray

    @property
    def cost(self) -> int:
        return 0

    @property
    def limited(self) -> bool:
        return True

    def value(self, z, sharpness):
        del sharpness
        return self.offset + z @ z, jnp.log(2.0 / jnp.maximum(jnp.sum(z) + 10.0, 0.1) * 6.0)[None]


def test_a_limit_that_binds_is_held():
    at = Compiled(UnderALimit(np.asarray(1.0)), 2)
    *_, last = search(at, starts=2, seed=0, steps=80, hops=0)
    result = polish(at, last.state.best_point)
    assert np.allclose(result.point, [1.0, 1.0], atol=1e-5)
    assert result.converged, result.sentence
    assert result.gradient_norm < 1e-5
    # d log f = 2/3 (1, 1) there, and the logarithm of the excess falls by 1/12 (1, 1).
    np.testing.assert_allclose(multipliers(at, result.point), [8.0], rtol=1e-4)
