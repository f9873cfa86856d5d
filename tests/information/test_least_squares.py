"""A gyro along the only axis of a table: its covariance by dense generalised least squares and by the paper's augmented
Kalman filter, priors, unweighted least squares, the residual with a discrepancy, and what cannot be observed."""

import os
import subprocess
import sys

import numpy as np
import pytest
from helpers import (
    DEG,
    DRIFT,
    SCENES,
    Act,
    BSpline,
    Engine,
    Polynomial,
    Scene,
    augmented_kalman,
    core,
    dense_gls,
    encoder,
    gyro_x,
    one_axis,
    reference,
    scale_map,
)

from gradcal_jax import model as models
from gradcal_jax import motion as trajectory
from gradcal_jax.information import grid_element, map_rows, statistic, whiten
from gradcal_jax.information.noise_steps import _chi, _phi1
from gradcal_jax.information.plan_information import imu_unweighted
from gradcal_jax.model import SCALE_FACTOR, make_map

LINEAR = Polynomial(1, 20.0, 50.0)


def residual(made: Engine, name: str, temperatures, rates) -> np.ndarray:
    t, w = (g.ravel() for g in np.meshgrid(temperatures, rates, indexing="ij"))
    of = grid_element(made.model, "x", map_rows(made.model, made.model.channels[0], name, t, w))
    return of.deviations(made.posterior()).reshape(len(temperatures), len(rates))


# --- three roads to one covariance ------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SCENES)
def test_the_filter_is_dense_least_squares(name):
    made = core(SCENES[name])
    prior = made.model.prior_rows()
    found = made.posterior().deviations(np.eye(made.model.size))
    np.testing.assert_allclose(found, dense_gls(*reference(SCENES[name], made), prior), rtol=1e-9, atol=0)
    if len(prior) == made.model.size:
        inverse = np.linalg.inv(prior)
        covariance = augmented_kalman(*made.system(), inverse @ inverse.T)
        np.testing.assert_allclose(np.sqrt(np.diagonal(covariance)), found, rtol=1e-9, atol=0)


@pytest.mark.parametrize("x", [1e-12, 9.9e-9, 1.01e-8, 1e-3, 0.2999999, 0.3, 0.3000001, 500.0])
def test_the_series_meet_the_closed_forms(x):
    """Of the angle's variance by a process, as λD → 0; ten digits more than float64 have."""
    from decimal import Decimal, localcontext

    with localcontext(prec=60):
        d = Decimal(x)
        phi, chi = (1 - (-d).exp()) / d, (2 * d - 3 + 4 * (-d).exp() - (-2 * d).exp()) / (2 * d**3)
    assert float(_phi1(np.asarray(x))) == pytest.approx(float(phi), rel=1e-14)
    assert float(_chi(np.asarray(x))) == pytest.approx(float(chi), rel=1e-12)


# --- priors -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("basis", [Polynomial(3, 20.0, 50.0), BSpline((-30.0, 0.0, 70.0), 2)])
def test_the_turn_on_biass_prior_is_a_rank_one_update(basis):
    rows = np.asarray(make_map(basis, prior_std=2e-3, common_std=5e-3).prior_rows())
    reported, constant = basis.to_reported, basis.to_reported @ basis.constant
    wanted = np.linalg.inv(2e-3**2 * np.eye(4) + 5e-3**2 * np.outer(constant, constant))
    np.testing.assert_allclose(rows.T @ rows, reported.T @ wanted @ reported, rtol=1e-10, atol=1e-6)


# --- the standard method ----------------------------------------------------------------------------------------------

TEMPERATURES, RATES, SOAK, LASTS = [-20.0, 10.0, 50.0], [-3.0, -1.0, 2.0, 4.0], 100.0, 60.0


def standard(points: str, processes) -> tuple[Engine, np.ndarray, np.ndarray]:
    """Points that are read as rates; and the rows of their integrals in reported coefficients, with their rates."""
    plan = trajectory.standard_plan(TEMPERATURES, SOAK, LASTS, RATES, points=points)
    scale = scale_map(LINEAR, Polynomial(2, 0.0, 5.0))
    made = one_axis(plan, gyro_x((scale,), 3e-5, processes), encoder(rate=1e-4))
    t, w = (g.ravel() for g in np.meshgrid(TEMPERATURES, RATES, indexing="ij"))
    x = (t - 20.0) / 50.0
    return made, LASTS * np.stack([x**i * (w / 5.0) ** j * w for i in range(2) for j in range(3)], axis=1), w


def unweighted(made: Engine) -> np.ndarray:
    return imu_unweighted(made.motion, made.model, made.nodes).deviations(made.model.to_reported)


def both(rows, variance) -> tuple[np.ndarray, np.ndarray]:
    """Standard deviations by weighted and by ordinary least squares."""
    best = np.linalg.inv(rows.T @ np.linalg.solve(variance, rows))
    inverse = np.linalg.pinv(rows)
    return np.sqrt(np.diagonal(best)), np.sqrt(np.diagonal(inverse @ variance @ inverse.T))


def test_independent_points_by_hand():
    processes = models.gauss_markov(2e-5, 100.0) + models.gauss_markov(1e-4, 50.0, bias_gain=0.0, rate_gain=1.0)
    made, rows, w = standard("independent", processes)
    mean = lambda sigma, tau: 2 * sigma**2 * (tau / 60 - (tau / 60) ** 2 * (1 - np.exp(-60 / tau)))  # noqa: E731
    variance = 3e-5**2 / 60 + mean(2e-5, 100.0) + w**2 * mean(1e-4, 50.0) + (1e-4 * w) ** 2
    best, plain = both(rows, LASTS**2 * np.diag(variance))
    np.testing.assert_allclose(made.deviations(), best, rtol=1e-10)
    np.testing.assert_allclose(unweighted(made), plain, rtol=1e-10)
    assert np.all(made.deviations() <= plain)


def test_what_is_common_to_a_run_stays_common_among_its_points():
    """Both estimators against the covariance of all points written out by the processes' kernels."""
    noise = models.gauss_markov(2e-5, 100.0) + models.gauss_markov(1e-4, 500.0, bias_gain=0.0, rate_gain=1.0)
    noise = noise + models.constant(1e-3, rate_gain=1.0) + models.rate_random_walk(1e-7)
    made, rows, w = standard("one run", noise)
    stay, count = SOAK + LASTS * len(RATES), len(TEMPERATURES)
    start = np.concatenate([k * stay + SOAK + LASTS * np.arange(len(RATES)) for k in range(count)])
    apart = np.abs(start[:, None] - start[None]) - LASTS

    def markov(sigma, tau):
        between = sigma**2 * tau**2 * np.exp(-np.maximum(apart, 0.0) / tau) * (1 - np.exp(-LASTS / tau)) ** 2
        own = 2 * sigma**2 * tau * (LASTS - tau * (1 - np.exp(-LASTS / tau)))
        return np.where(np.eye(len(start), dtype=bool), own, between)

    # A walk is zero where the first data begin, after the first soak.
    first = np.minimum(start[:, None], start[None]) - SOAK
    walk = 1e-14 * LASTS**2 * np.where(apart < 0.0, first + LASTS / 3, first + LASTS / 2)
    variance = markov(2e-5, 100.0) + np.outer(w, w) * (markov(1e-4, 500.0) + (1e-3 * LASTS) ** 2) + walk
    best, plain = both(rows, variance + np.diag(3e-5**2 * LASTS + (1e-4 * w * LASTS) ** 2))
    np.testing.assert_allclose(made.deviations(), best, rtol=1e-8)
    np.testing.assert_allclose(unweighted(made), plain, rtol=1e-8)
    # The clock is a constant of the scale factor, and no number of points takes it off.
    assert made.deviations()[0] > 1e-3


# --- residuals --------------------------------------------------------------------------------------------------------


def test_the_residual_with_a_discrepancy_is_the_errors_own_variance():
    """Against the estimator's gain written out: `error = ψᵀ(β − β̂) + χᵀγ` with γ estimated and then thrown away."""
    moves = (
        trajectory.turn("cosine ramps", 4.0, 8.0, ramp=3.0),
        trajectory.turn("cosine ramps", -3.0, 6.0, ramp=2.0),
        trajectory.rest(4.0, 2.0),
    )
    plan = trajectory.gradient_plan(trajectory.programme(-30.0, [(200.0, 0.4)]), moves)
    drift, bases = models.gauss_markov(DRIFT.size, DRIFT.tau), (LINEAR, Polynomial(1, 0.0, 5.0))
    make = lambda **more: one_axis(  # noqa: E731
        plan, gyro_x((scale_map(*bases, prior_std=1e-2, **more),), 3e-5, drift), encoder(0.05 * DEG)
    )
    made = make(discrepancy=(1e-4, 2, 3))
    (channel,) = made.model.channels
    temperatures, rates = np.array([-10.0, 60.0]), np.array([-4.5, 1.0])
    result = residual(made, SCALE_FACTOR, temperatures, rates).ravel()
    data, prior = whiten(*made.system()), made.model.prior_rows()
    rows = np.concatenate([data, prior])
    size = np.linalg.norm(rows, axis=0)
    gain = np.linalg.lstsq(rows / size, np.eye(len(rows)), rcond=None)[0] / size[:, None]
    scale = channel.map(SCALE_FACTOR)
    c, g = channel.where(SCALE_FACTOR), channel.where(scale.beyond.name)
    truth = np.linalg.inv(prior)  # columns: one standard deviation of each independent prior direction
    t, w = (x.ravel() for x in np.meshgrid(temperatures, rates, indexing="ij"))
    psi, chi = scale.values(t, w), scale.beyond.values(t, w)
    # The prior's pseudo-data are zero, so only the data rows respond to the truth.
    of_truth = gain[:, : len(data)] @ data @ truth
    error_truth = psi @ (truth[c] - of_truth[c]) + chi @ truth[g]
    error_noise = psi @ gain[c][:, : len(data)]
    wanted = np.sqrt(np.sum(error_truth**2, axis=1) + np.sum(error_noise**2, axis=1))
    np.testing.assert_allclose(result, wanted, rtol=1e-8)
    assert np.all(result > residual(make(), SCALE_FACTOR, temperatures, rates).ravel())


def test_the_discrepancys_functions_are_the_polynomials_left_out():
    beyond = scale_map(Polynomial(1, 20.0, 50.0), Polynomial(2, 0.0, 5.0), discrepancy=(1e-3, 2, 4)).beyond
    # Of M: one more degree in T times five in ω, and two more in ω times the two in T.
    assert beyond.size == 1 * 5 + 2 * 2
    pairs = [(i, j) for i in range(3) for j in range(5) if i > 1 or j > 2]
    t, w = np.array([-10.0, 70.0, 33.0]), np.array([4.0, 5.0, -2.0])
    one = np.polynomial.legendre.legval
    wanted = [one((t - 20.0) / 50.0, np.eye(3)[i]) * one(w / 5.0, np.eye(5)[j]) for i, j in pairs]
    np.testing.assert_allclose(beyond.values(t, w), np.stack(wanted, axis=1), rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize(
    ("acts", "hidden"),
    [
        # Turns of one kind see one sum of the powers of rate: b00 + k·b10, k = ∫ω²/∫ω over the scale of 5 rad/s.
        ((Act("cosine ramps", 20.0, 2.0, ramp=1.0),), [(-0.395, 1.0, 0.0, 0.0), (0.0, 0.0, -0.395, 1.0)]),
        # Two kinds see everything.
        ((Act("cosine ramps", 20.0, 2.0, ramp=1.0), Act("cosine ramps", 9.0, -4.0, ramp=1.0)), np.zeros((0, 4))),
        # Rest alone sees no scale factor at all.
        ((Act("rest", 20.0, every=4.0),), np.eye(4)),
    ],
)
def test_what_cannot_be_observed_is_apart(acts, hidden):
    made = core(Scene(-30.0, ((200.0, 0.4),), acts, noises=(DRIFT,), scale=(LINEAR, Polynomial(1, 0.0, 5.0))))
    found, wanted = made.model.to_reported @ made.posterior().hidden, np.array(hidden).T
    assert found.shape == wanted.shape
    along, _ = np.linalg.qr(found)
    np.testing.assert_allclose(along @ (along.T @ wanted), wanted, atol=1e-3)
    value = residual(made, SCALE_FACTOR, [20.0], [1.0])
    assert not np.isnan(value)
    assert np.isinf(value) == bool(len(hidden))


def test_statistics_of_a_map():
    values = np.array([[1.0, 2.0], [3.0, 0.0]])
    assert statistic("mean of max", values) == 2.5
    assert statistic("max", values) == 3.0
    assert statistic("mean", values) == 1.5
    assert statistic("rms", values) == pytest.approx(np.sqrt(3.5))


IN_SINGLE_PRECISION = """
import jax
from gradcal_jax import differentiable, parse_spec, presets
of = differentiable(parse_spec(presets.text("paper-static-gradient")))
try:
    jax.eval_shape(of, of.quantities)  # traced, since compiling each operation takes longest
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
