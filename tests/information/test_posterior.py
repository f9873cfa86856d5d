"""Priors, unweighted least squares, the residual with a discrepancy, and what cannot be observed."""

import os
import subprocess
import sys

import numpy as np
import pytest
from helpers import (
    DEG_PER_H,
    DRIFT,
    SCENES,
    Act,
    Polynomial,
    Scene,
    core,
    engine_of,
    knowledge,
)

from gradcal_jax import model as models
from gradcal_jax import motion as trajectory
from gradcal_jax.information import (
    at_readings,
    noise_steps,
    residual,
    statistic,
    unobservable_combinations,
    whiten,
)
from gradcal_jax.information.posterior import least_squares_of_means, noise_of_sums, spread_of
from gradcal_jax.model import SCALE_FACTOR, Bins, BSpline, gyro_model, make_map

LINEAR = Polynomial(1, 20.0, 50.0)


def test_the_turn_on_biass_prior_is_a_rank_one_update():
    basis = Polynomial(3, 20.0, 50.0)
    model = gyro_model(make_map(basis, prior_std=2e-3, common_std=5e-3), None, 1e-5)
    rows = np.asarray(model.prior_rows())
    reported = basis.to_reported
    constant = np.eye(4)[0]
    wanted = np.linalg.inv(2e-3**2 * np.eye(4) + 5e-3**2 * np.outer(constant, constant))
    np.testing.assert_allclose(rows.T @ rows, reported.T @ wanted @ reported, rtol=1e-11, atol=1e-6)
    spline = make_map(BSpline((-30.0, 0.0, 70.0), 2), prior_std=2e-3, common_std=5e-3)
    rows = np.asarray(gyro_model(spline, None, 1e-5).prior_rows())
    wanted = np.linalg.inv(2e-3**2 * np.eye(4) + 5e-3**2 * np.ones((4, 4)))
    np.testing.assert_allclose(rows.T @ rows, wanted, rtol=1e-10)


def test_smoothness_priors_join_neighbours():
    bins = make_map(Bins((0.0, 1.0, 2.0, 3.0)), Bins((-1.0, 0.0, 1.0)), smoothness_std=0.5)
    rows = np.asarray(gyro_model(None, bins, 1e-5).prior_rows())
    assert rows.shape == (2 * 2 + 3 * 1, 6)
    np.testing.assert_array_equal(rows.sum(1), 0.0)
    value = np.array([[1.0, 4.0], [2.0, 2.0], [5.0, -1.0]])
    wanted = (np.sum(np.diff(value, axis=0) ** 2) + np.sum(np.diff(value, axis=1) ** 2)) / 0.25
    assert np.sum((rows @ value.ravel()) ** 2) == pytest.approx(wanted)


@pytest.mark.parametrize("basis", [Bins((-60.0, 0.0, 40.0, 60.0)), BSpline((-60.0, 0.0, 40.0, 60.0), 2)])
def test_smoothness_reaches_where_the_plan_does_not(basis):
    """The ramp ends at 10 °C: without smoothness the warm coefficients are unknown, with it they lean on the others."""
    scene = Scene(-30.0, ((160.0, 0.25),), (), read_every=5.0, noises=(DRIFT,), bias=basis)
    plan, _ = core(scene)
    drift = models.gauss_markov(DRIFT.size, DRIFT.tau)
    reference = models.angle_reference(scene.reading_noise)
    free, smooth = (
        gyro_model(make_map(basis, smoothness_std=s), None, scene.arw, drift, reference)
        for s in (np.inf, 5 * DEG_PER_H)
    )
    blind = knowledge(plan, free)
    warm = np.array([55.0])
    assert unobservable_combinations(blind, free)
    assert np.isinf(residual(blind, free, "bias", warm, np.zeros(1)))
    seeing = knowledge(plan, smooth)
    assert unobservable_combinations(seeing, smooth) == []
    cold_and_warm = residual(seeing, smooth, "bias", np.array([-20.0, 55.0]), np.zeros(1))[:, 0]
    assert np.all(np.isfinite(cold_and_warm))
    assert cold_and_warm[1] > cold_and_warm[0] + 3 * DEG_PER_H


def unweighted(line, model):
    """Covariance of ordinary least squares on the mean rate errors of a standard plan."""
    of = least_squares_of_means(at_readings(line, model), np.asarray(line.read), line.duration)
    return spread_of(of, noise_of_sums(noise_steps(line, model), of.weights))


def test_unweighted_least_squares_by_hand():
    temperatures, rates = [-20.0, 10.0, 50.0], [-3.0, -1.0, 2.0, 4.0]
    plan = trajectory.standard_plan(temperatures, 100.0, 60.0, rates, points="independent")
    scale = make_map(LINEAR, Polynomial(2, 0.0, 5.0))
    drift = models.gauss_markov(2e-5, 100.0) + models.gauss_markov(1e-4, 50.0, bias_gain=0.0, rate_gain=1.0)
    model = gyro_model(None, scale, 3e-5, drift, models.angle_reference(rate_accuracy=1e-4))
    t, w = (g.ravel() for g in np.meshgrid([-20.0, 10.0, 50.0], [-3.0, -1.0, 2.0, 4.0], indexing="ij"))
    x = (t - 20.0) / 50.0
    rows = np.stack([x**i * (w / 5.0) ** j * w for i in range(2) for j in range(3)], axis=1)
    mean = lambda sigma, tau: 2 * sigma**2 * (tau / 60 - (tau / 60) ** 2 * (1 - np.exp(-60 / tau)))  # noqa: E731
    variance = 3e-5**2 / 60 + mean(2e-5, 100.0) + w**2 * mean(1e-4, 50.0) + (1e-4 * w) ** 2
    reported = np.kron(LINEAR.to_reported, scale.rate.to_reported)
    line = plan.trajectory()
    inverse = np.linalg.pinv(rows)
    wanted = np.sqrt(np.diagonal(inverse @ np.diag(variance) @ inverse.T))
    np.testing.assert_allclose(unweighted(line, model).deviations(reported), wanted, rtol=1e-10)
    # The best linear estimator weighs the points; it cannot do worse in any parameter.
    best = np.sqrt(np.diagonal(np.linalg.inv(rows.T @ (rows / variance[:, None]))))
    result = knowledge(plan, model).deviations(reported)
    np.testing.assert_allclose(result, best, rtol=1e-10)
    assert np.all(result <= wanted)


def test_what_is_common_to_a_run_stays_common_among_its_points():
    """Both estimators against the covariance of all points written out by the processes' kernels."""
    temperatures, rates, soak, lasts = [-20.0, 10.0, 50.0], [-3.0, -1.0, 2.0, 4.0], 100.0, 60.0
    plan = trajectory.standard_plan(temperatures, soak, lasts, rates)
    scale = make_map(LINEAR, Polynomial(2, 0.0, 5.0))
    noise = models.gauss_markov(2e-5, 100.0) + models.gauss_markov(1e-4, 500.0, bias_gain=0.0, rate_gain=1.0)
    noise = noise + models.constant(1e-3, rate_gain=1.0) + models.rate_random_walk(1e-7)
    model = gyro_model(None, scale, 3e-5, noise, models.angle_reference(rate_accuracy=1e-4))
    t, w = (g.ravel() for g in np.meshgrid(temperatures, rates, indexing="ij"))
    stay = soak + lasts * len(rates)
    start = np.concatenate([k * stay + soak + lasts * np.arange(len(rates)) for k in range(len(temperatures))])
    apart = np.abs(start[:, None] - start[None]) - lasts

    def markov(sigma, tau):
        between = sigma**2 * tau**2 * np.exp(-np.maximum(apart, 0.0) / tau) * (1 - np.exp(-lasts / tau)) ** 2
        own = 2 * sigma**2 * tau * (lasts - tau * (1 - np.exp(-lasts / tau)))
        return np.where(np.eye(len(start), dtype=bool), own, between)

    # A walk is zero where the first data begin, after the first soak.
    first = np.minimum(start[:, None], start[None]) - soak
    walk = 1e-14 * lasts**2 * np.where(apart < 0.0, first + lasts / 3, first + lasts / 2)
    variance = markov(2e-5, 100.0) + np.outer(w, w) * (markov(1e-4, 500.0) + (1e-3 * lasts) ** 2) + walk
    variance += np.diag(3e-5**2 * lasts + (1e-4 * w * lasts) ** 2)
    x = (t - 20.0) / 50.0
    rows = lasts * np.stack([x**i * (w / 5.0) ** j * w for i in range(2) for j in range(3)], axis=1)
    reported = np.kron(LINEAR.to_reported, scale.rate.to_reported)
    best = np.sqrt(np.diagonal(np.linalg.inv(rows.T @ np.linalg.solve(variance, rows))))
    np.testing.assert_allclose(knowledge(plan, model).deviations(reported), best, rtol=1e-8)
    inverse = np.linalg.pinv(rows)
    plain = np.sqrt(np.diagonal(inverse @ variance @ inverse.T))
    np.testing.assert_allclose(unweighted(plan.trajectory(), model).deviations(reported), plain, rtol=1e-8)
    # The clock is a constant of the scale factor, and no number of points takes it off.
    assert knowledge(plan, model).deviations(reported)[0] > 1e-3


def test_the_residual_with_a_discrepancy_is_the_errors_own_variance():
    """Against the estimator's gain written out: `error = ψᵀ(β − β̂) + χᵀγ` with γ estimated and then thrown away."""
    scene = Scene(
        -30.0, ((200.0, 0.4),),
        (Act("cosine ramps", 8.0, 4.0, ramp=3.0), Act("cosine ramps", 6.0, -3.0, ramp=2.0), Act("rest", 4.0)),
        noises=(DRIFT,), read_every=5.0,
    )  # fmt: skip
    plan = trajectory.gradient_plan(
        trajectory.programme(-30.0, [(200.0, 0.4)]),
        (
            trajectory.turn("cosine ramps", 4.0, 8.0, ramp=3.0),
            trajectory.turn("cosine ramps", -3.0, 6.0, ramp=2.0),
            trajectory.rest(4.0, 2.0),
        ),
    )
    scale = make_map(LINEAR, Polynomial(1, 0.0, 5.0), prior_std=1e-2, discrepancy=(1e-4, 2, 3))
    reference = models.angle_reference(scene.reading_noise)
    model = gyro_model(None, scale, scene.arw, models.gauss_markov(DRIFT.size, DRIFT.tau), reference)
    made = engine_of(plan, model)
    data, prior = whiten(made.steps, made.columns), made.prior
    known = knowledge(plan, model)
    temperatures, rates = np.array([-10.0, 60.0]), np.array([-4.5, 1.0])
    result = residual(known, model, "scale_factor", temperatures, rates).ravel()
    rows = np.concatenate([data, prior])
    size = np.linalg.norm(rows, axis=0)
    gain = np.linalg.lstsq(rows / size, np.eye(len(rows)), rcond=None)[0] / size[:, None]
    c, g = model.where(SCALE_FACTOR), model.where(scale.beyond.name)
    truth = np.linalg.inv(prior)  # columns: one standard deviation of each independent prior direction
    t, w = (x.ravel() for x in np.meshgrid(temperatures, rates, indexing="ij"))
    psi, chi = scale.values(t, w), scale.beyond.values(t, w)
    # The error as a linear function of the independent unit draws: the truth's and the readings' noise. The prior's
    # pseudo-data are zero, so only the data rows respond to the truth.
    of_truth = gain[:, : len(data)] @ data @ truth
    error_truth = psi @ (truth[c] - of_truth[c]) + chi @ truth[g]
    error_noise = psi @ gain[c][:, : len(data)]
    wanted = np.sqrt(np.sum(error_truth**2, axis=1) + np.sum(error_noise**2, axis=1))
    np.testing.assert_allclose(result, wanted, rtol=1e-8)
    plain = gyro_model(
        None, make_map(LINEAR, Polynomial(1, 0.0, 5.0), prior_std=1e-2), scene.arw, model.processes, reference
    )
    without = residual(knowledge(plan, plain), plain, "scale_factor", temperatures, rates).ravel()
    assert np.all(result > without)


@pytest.mark.parametrize(
    ("acts", "names"),
    [
        # Turns of one kind see one sum of the powers of rate: b00 + k·b10, k = ∫ω²/∫ω over the scale of 5 rad/s.
        ((Act("cosine ramps", 20.0, 2.0, ramp=1.0),), ["- 0.395·b00 + b10", "- 0.395·b01 + b11"]),
        # Two kinds see everything.
        ((Act("cosine ramps", 20.0, 2.0, ramp=1.0), Act("cosine ramps", 9.0, -4.0, ramp=1.0)), []),
        # Rest alone sees no scale factor at all.
        ((Act("rest", 20.0, every=4.0),), ["b00", "b10", "b01", "b11"]),
    ],
)
def test_what_cannot_be_observed_is_named(acts, names):
    scene = Scene(-30.0, ((200.0, 0.4),), acts, noises=(DRIFT,), scale=(LINEAR, Polynomial(1, 0.0, 5.0)))
    plan, model = core(scene)
    known = knowledge(plan, model)
    result = unobservable_combinations(known, model)
    assert sorted(result) == sorted(names)
    values = residual(known, model, "scale_factor", np.array([20.0]), np.array([1.0]))
    assert not np.any(np.isnan(values))
    assert np.all(np.isinf(values)) == bool(names)


def test_a_combination_is_written_out():
    """At constant temperature nothing tells a0 from a1: the sensor stands at x = (35 − 20)/50 = 0.3."""
    scene = Scene(35.0, ((100.0, 0.0),), (), read_every=10.0, bias=LINEAR)
    plan, model = core(scene)
    known = knowledge(plan, model)
    assert unobservable_combinations(known, model) == ["- 0.3·a0 + a1"]
    there, elsewhere = (float(residual(known, model, "bias", np.array([t]), np.zeros(1))[0, 0]) for t in (35.0, 60.0))
    assert np.isfinite(there)
    assert there > 0.0
    assert np.isinf(elsewhere)


IN_SINGLE_PRECISION = """
import jax
import jax.numpy as jnp
from gradcal_jax import information, motion as trajectory
from gradcal_jax import model as models
plan = trajectory.gradient_plan(trajectory.programme(0.0, [(20.0, 0.1)]), read_every=5.0)
bias = models.make_map(models.Polynomial(0, 0.0, 1.0))
none = models.no_processes()
angle = models.angle_reference(1e-3)
model = models.gyro_model(bias, None, 1e-5, none, angle)
try:
    information.information(jax.tree.map(jnp.asarray, plan.trajectory()), model)
except ValueError as error:
    print(error)
"""


def test_single_precision_is_refused_with_the_remedy():
    """In a process of its own, where JAX is as it comes."""
    quiet = {**os.environ, "JAX_ENABLE_X64": "0"}
    ran = subprocess.run(
        [sys.executable, "-c", IN_SINGLE_PRECISION], capture_output=True, text=True, env=quiet, check=True
    )
    assert "single precision" in ran.stdout
    assert "jax_enable_x64" in ran.stdout


def test_statistics_of_a_map():
    values = np.array([[1.0, 2.0], [3.0, 0.0]])
    assert statistic("mean of max", values) == 2.5
    assert statistic("max", values) == 3.0
    assert statistic("mean", values) == 1.5
    assert statistic("rms", values) == pytest.approx(np.sqrt(3.5))


def test_another_axis_is_rest():
    """The channel that stands sees as many readings as it is given, no motion, and no scale factor."""
    scene = SCENES["other axis"]
    for channel in ("x", "y"):
        plan, model = core(scene, channel)
        line = plan.trajectory()
        mine = {k for k, a in enumerate(scene.moves) if a.axis == channel and a.shape != "rest"}
        assert set(plan.pieces.move[line.moving].tolist()) == mine
        assert float(line.start[-1] + line.duration[-1]) == pytest.approx(260.0)
        assert np.all(line.turned()[~line.moving] == 0.0)
        seen = engine_of(plan, model).columns[:, model.where(SCALE_FACTOR)]
        assert np.any(seen != 0.0)
        before_it_moves = np.cumsum(line.moving) == 0
        assert np.all(seen[before_it_moves] == 0.0)
