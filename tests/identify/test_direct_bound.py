from dataclasses import replace

import numpy as np
import pytest
from plain_drifts import drifts
from scipy.signal import lfilter

from gradcal_jax.identify.direct_bound import (
    fit_direct_bound,
    largest_of_random_walk,
    smallest_bounding_variance,
)
from gradcal_jax.identify.largest_drift import integration_times, largest_drift
from gradcal_jax.identify.limiting_function import limiting_function_of_mean

DEG_PER_H = np.pi / 180 / 3600
WALK = 0.1 * np.pi / 180 / 60
HOUR = 3600


def at_rest(seed, hours, drift_std, correlation_time_s, walk=WALK, interval=1.0):
    """Rates of a simulated gyro at rest, rad/s: a Gauss-Markov drift and angle random walk."""
    rng = np.random.default_rng(seed)
    count = round(hours * HOUR / interval)
    keep = np.exp(-interval / correlation_time_s)
    shocks = rng.standard_normal(count) * drift_std * np.sqrt(1 - keep**2)
    shocks[0] = drift_std * rng.standard_normal()
    return lfilter([1.0], [1.0, -keep], shocks) + walk / np.sqrt(interval) * rng.standard_normal(count)


def observe(rate, averaging_time_s, longest_s=1200.0):
    return largest_drift(rate, 1.0, integration_times(1.0, longest_s, 1.0), averaging_time_s)


def fitted(limit, walk):
    """The bound of data that are exactly k times this function of the integration time."""
    observed = observe(at_rest(0, 4, 0.0, 1.0), 60.0, 3600.0)
    exact = 2.5 * np.asarray(limit(observed.integration_time_s))
    return fit_direct_bound(replace(observed, largest_drift=exact), walk, raise_margin=False)


def test_the_boundary_is_closed_and_the_smallest():
    """With the paper's margin: each pair of the boundary touches the data, and any smaller σ leaves them."""
    t = np.geomspace(1.0, 1000.0, 60)
    tau = np.geomspace(5.0, 5000.0, 9)
    data = 2.5 * limiting_function_of_mean(t, 1.3, 200.0, 4.0, 30.0) * (1.0 + 0.1 * np.sin(7.0 * np.log(t)))
    variance = smallest_bounding_variance(t, data, 30.0, 4.0, tau, margin=2.5)
    for time, square in zip(tau, variance, strict=True):
        limit = 2.5 * limiting_function_of_mean(t, np.sqrt(square), time, 4.0, 30.0)
        assert float(np.max(data / limit)) == pytest.approx(1.0, rel=1e-9)
        smaller = 2.5 * limiting_function_of_mean(t, 0.999 * np.sqrt(square), time, 4.0, 30.0)
        assert float(np.max(data / smaller)) > 1.0


def test_the_model_itself_comes_back():
    """Data that are exactly k D_L lead to its σ and τ, and to no excess."""
    bound = fitted(lambda t: limiting_function_of_mean(t, DEG_PER_H, 120.0, WALK, 60.0), WALK)
    assert bound.drift_std / DEG_PER_H == pytest.approx(1.0, rel=1e-3)
    assert bound.correlation_time_s == pytest.approx(120.0, rel=1e-3)
    assert bound.boundary_excess.min() < 3e-3
    assert bound.messages == ()


def test_the_process_found_bounds_fresh_records_of_the_same_kind():
    """Five records of 40 h, each bounding another: with k = 2.5 a Gaussian leaves 1.24 % of all starts beyond."""
    drift_std, correlation_time_s = 3.0, 120.0
    shares, ratios = [], []
    for seed in range(5):
        rate = at_rest(seed, 40, drift_std * DEG_PER_H, correlation_time_s)
        bound = fit_direct_bound(observe(rate, 120.0), WALK)
        assert bound.drift_shows
        assert np.all(bound.largest_drift <= bound.limit * (1 + 1e-9))
        fresh = at_rest(100 + seed, 40, drift_std * DEG_PER_H, correlation_time_s)
        limits = bound.margin * bound.limiting_function
        result = [np.abs(drifts(fresh, 1.0, float(t), 120.0)) for t in bound.integration_time_s]
        shares.append([np.mean(one > limit) for one, limit in zip(result, limits, strict=True)])
        ratios.append(np.max(observe(fresh, 120.0).largest_drift / bound.limit))
    # 40 h hold few independent windows of 20 minutes: the allowance is for their scatter.
    assert np.mean(shares) < 0.0124
    assert np.max(np.mean(shares, axis=0)) < 0.016
    assert np.median(ratios) < 1.2
    assert np.max(ratios) < 1.5
    at_true = smallest_bounding_variance(
        bound.integration_time_s, bound.largest_drift, 120.0, WALK, np.array([correlation_time_s])
    )
    assert float(np.sqrt(at_true[0])) / DEG_PER_H > drift_std


def test_an_average_too_short_is_said_and_the_advised_one_shows_the_drift():
    """The paper's numbers with Δ = 10 s: N/√Δ = 1.9 deg/h hides 1 deg/h."""
    rate = at_rest(11, 40, DEG_PER_H, 120.0)
    hidden = fit_direct_bound(observe(rate, 10.0), WALK)
    assert not hidden.drift_shows
    assert hidden.drift_std == 0.0
    assert 0.5 < hidden.hidden_drift_std / DEG_PER_H < 2.5
    assert hidden.advised_averaging_time_s is not None
    assert 15.0 < hidden.advised_averaging_time_s < 100.0
    assert f"averaging over {hidden.advised_averaging_time_s:.3g} s or more" in hidden.messages[0]
    assert f"{WALK / np.sqrt(10.0):.3g}" in hidden.messages[0]
    in_deg_per_h = fit_direct_bound(
        observe(rate, 10.0), WALK, rate_in_words=lambda rate: f"{rate / DEG_PER_H:.1f} deg/h"
    )
    assert "N/√Δ = 1.9 deg/h" in in_deg_per_h.messages[0]
    shown = fit_direct_bound(observe(rate, 120.0), WALK)
    assert shown.drift_shows
    assert 0.8 < shown.drift_std / DEG_PER_H < 3.0


def test_levels_of_random_walk_are_exceeded_as_often_as_said():
    rng = np.random.default_rng(5)
    times = np.array([1.0, 8.0, 60.0, 500.0])
    beyond = []
    for _ in range(200):
        observed = largest_drift(rng.standard_normal(20_000), 1.0, times, 30.0)
        draws = observed.largest_drift / np.sqrt(1 / observed.integration_time_s + 1 / 30.0)
        levels = largest_of_random_walk(times, 30.0, observed.start_count, 1.0, exceeded_with_probability=0.2)
        beyond.append(draws > levels)
    # Asymptotic, and a shade too high where the windows are few samples long: 200 draws have a deviation of 0.028.
    assert np.all(np.mean(beyond, axis=0) < 0.2 + 3 * 0.028)
    assert np.mean(beyond) > 0.08


def test_a_drift_beyond_the_record_is_told_by_its_slope():
    """A rate random walk of slope q is the limit σ²/τ → q²/2 of ever longer correlation times."""
    bound = fitted(lambda t: limiting_function_of_mean(t, 1.0, 1e8, 1e-3, 60.0), 1e-3)
    assert "σ²/τ" in bound.messages[0]
    assert bound.correlation_time_s > 10_000.0
    assert bound.drift_std**2 / bound.correlation_time_s == pytest.approx(1e-8, rel=0.1)


def test_the_drift_that_decides_is_placed():
    rate = at_rest(4, 10, 3 * DEG_PER_H, 120.0)
    rate[20_000:20_100] += 50 * DEG_PER_H
    bound = fit_direct_bound(observe(rate, 60.0), WALK)
    assert 19_000 < bound.deciding_start_index < 20_200
    without = np.ones(len(rate), bool)
    without[19_900:20_200] = False
    observed = largest_drift(rate, 1.0, integration_times(1.0, 1200.0, 1.0), 60.0, valid=without)
    assert fit_direct_bound(observed, WALK).drift_std < 0.5 * bound.drift_std


def test_wrong_arguments_get_a_sentence():
    observed = observe(at_rest(1, 1, 0.0, 1.0), 10.0)
    with pytest.raises(ValueError, match="margin"):
        fit_direct_bound(observed, WALK, margin=0.0)
    with pytest.raises(ValueError, match="angle random walk"):
        fit_direct_bound(observed, -1.0)
    still = largest_drift(np.ones(2000), 1.0, np.array([10.0]), 10.0)
    with pytest.raises(ValueError, match="is constant"):
        fit_direct_bound(still, WALK)
