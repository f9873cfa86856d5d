"""The relaxed problem of a scale factor's limit, on cases small enough to know."""

import equinox as eqx
import numpy as np
import pytest

from gradcal_jax.design.criteria import Criterion
from gradcal_jax.design.limit import limit
from gradcal_jax.design.noise_floor import least_noise_density, scale_factor_floor
from gradcal_jax.information import contrasts
from gradcal_jax.model import Polynomial, SensorModel, angle_reference, constant, gauss_markov, gyro_model, make_map

DEG = np.pi / 180.0
WALK = 0.1 * DEG / 60.0
MAX = 300 * DEG


def model(degree_t: int, degree_w: int, **prior) -> SensorModel:
    scale = make_map(Polynomial(degree_t, 20.0, 50.0), Polynomial(degree_w, 0.0, MAX), **prior)
    return gyro_model(None, scale, WALK, gauss_markov(DEG / 3600.0, 120.0), angle_reference(0.05 * DEG))


def criterion(
    model: SensorModel, quantity: str, temperature: np.ndarray, rate: np.ndarray, statistic: str
) -> Criterion:
    grid = (g.ravel() for g in np.meshgrid(temperature, rate, indexing="ij"))
    rows, _, beyond = contrasts(model, quantity, *grid)
    return Criterion(rows, None, beyond, (len(temperature), len(rate)), statistic)


TEMPERATURES, RATES = np.linspace(-30, 70, 11), np.linspace(-MAX, MAX, 13)
LINEAR = model(1, 1)
CRITERION = criterion(LINEAR, "scale_factor", TEMPERATURES, RATES, "mean of max")


def limit_of(criterion_, constant_in_t: SensorModel, seconds: float):
    return limit(
        criterion_,
        constant_in_t,
        motion_time=seconds,
        temperatures=np.array([20.0]),
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
        "max_rate": MAX,
        "noise_density": WALK**2,
    }
    alone = limit(CRITERION, LINEAR, **options)
    together = limit(CRITERION, LINEAR, **options, floor=np.repeat(floor, len(RATES)))
    assert together.certified <= together.reached * (1 + 1e-12)
    assert together.certified == pytest.approx(together.reached, rel=5e-3)
    assert max(alone.certified, 2e-6) < together.certified
    assert together.certified < alone.reached + 2e-6
