"""A real recording: a MEMS gyro triad at rest through one thermal cycle.

Its source gives no units: read as µs and rad/s.

(The source labels the rates deg/s; their white noise fits rad/s better. Nothing here depends on it but the deg/h.)
"""

import dataclasses
import os
from pathlib import Path

import numpy as np
import pytest
from plain_drifts import drifts

from gradcal_jax.identify.allan import MISFIT, fit_allan, overlapping_allan
from gradcal_jax.identify.direct_bound import fit_direct_bound
from gradcal_jax.identify.instability import allan_notes, at_rest, instability
from gradcal_jax.identify.largest_drift import integration_times, largest_drift
from gradcal_jax.identify.thermal import fit_thermal_bias
from gradcal_jax.records.importers import import_log, parse_column_map

FOLDER = Path(os.environ.get("GRADCAL_DATA", Path(__file__).parents[3] / "shared" / "data"))
RECORD = FOLDER / "tofupilot_imu_thermal_cycle.npz"
pytestmark = pytest.mark.skipif(not RECORD.exists(), reason="the recorded data are not here: set GRADCAL_DATA")

COLUMNS = """
format      = "gradcal-columns/1"
time        = { column = "timestamp_raw", unit = "us" }
temperature = { column = "temperature_C", unit = "degC" }
rate.x      = { column = "gyro", index = 0, unit = "rad/s" }
rate.y      = { column = "gyro", index = 1, unit = "rad/s" }
rate.z      = { column = "gyro", index = 2, unit = "rad/s" }
"""


@pytest.fixture(scope="module")
def log():
    return import_log(RECORD, parse_column_map(COLUMNS), rows=(1, None))  # the first is an outlier


def test_every_row_is_accounted_for_and_the_oscillators_wander_is_named(log):
    assert log.counts() == {"used": 8399, "left out": 1}
    assert [finding.kind for finding in log.findings] == ["clock drift"]
    assert "varies by" in log.findings[0].message
    assert 1 / log.sample_interval_s == pytest.approx(1.98, abs=0.005)
    assert log.duration_s / 60 == pytest.approx(71, abs=0.5)


def describe(log, axis, lag_time_s):
    """(Allan fit, Direct Bound) of an axis with B(T) removed, by a lag or without."""
    even = log.even(axis)
    interval = even.sample_interval_s
    thermal = fit_thermal_bias(
        even.rate_rad_per_s, even.temperature_c, interval, lag_time_s=lag_time_s, valid=even.valid
    )
    known = np.flatnonzero(np.isfinite(even.temperature_c))
    temperature = np.interp(np.arange(len(even.valid)), known, even.temperature_c[known])
    rate = even.rate_rad_per_s - thermal.bias(temperature, interval)
    allan = fit_allan(overlapping_allan(rate, interval, valid=even.valid))
    times = integration_times(1.0, 600.0, interval, count=60)
    observed = largest_drift(rate, interval, times, 60.0, valid=even.valid)
    for row, time in enumerate(times):
        values = drifts(rate, interval, float(time), 60.0, valid=even.valid)
        assert observed.largest_drift[row] == pytest.approx(np.abs(values).max(), rel=1e-9)
    bound = fit_direct_bound(observed, allan.angle_random_walk.value)
    assert np.all(bound.largest_drift <= bound.limit * (1 + 1e-9))
    return thermal, allan, bound


@pytest.mark.parametrize(("axis", "pays"), [("x", True), ("y", False), ("z", False)])
def test_allan_and_direct_bound_side_by_side(log, axis, pays):
    _, allan_at_once, at_once = describe(log, axis, 0.0)
    thermal, allan_lagging, lagging = describe(log, axis, None)
    for lags, allan in enumerate((allan_at_once, allan_lagging)):
        # 0.1 to 1 deg/√h, as consumer MEMS gyros have: what speaks for rad/s.
        assert 4e-5 < allan.angle_random_walk.value < 3e-4
        # Of x with its lag no band follows the model, which the standard error says (0.34 of N); of the rest 0.12.
        if lags and axis == "x":
            assert allan.chance < MISFIT
            assert 0.2 < allan.angle_random_walk.standard_error / allan.angle_random_walk.value < 0.5
        else:
            assert allan.angle_random_walk.standard_error < 0.15 * allan.angle_random_walk.value
    assert at_once.drift_shows
    assert lagging.drift_shows
    # Both look at one record: the drift over ten minutes is of the Allan model's size times a maximum's few sigmas.
    for allan, bound in ((allan_at_once, at_once), (allan_lagging, lagging)):
        slow = np.sqrt(allan.rate_random_walk.value**2 * 600.0 / 3 * 2)
        # (6.7 of x at once, whose loop in temperature is no rate random walk; of the others 2.3 to 5.7.)
        assert 0.3 < bound.largest_drift[-1] / slow < (8.0 if axis == "x" and allan is allan_at_once else 6.0)
    if pays:
        assert thermal.lag_time_s > 60.0
        assert lagging.limit[-1] < 0.8 * at_once.limit[-1]
    else:
        assert lagging.limit[-1] > 0.8 * at_once.limit[-1]


@pytest.mark.parametrize(("axis", "share"), [("x", 0.453), ("y", 0.643), ("z", 0.412)])
def test_the_second_half_stays_within_what_bounds_the_first(log, axis, share):
    """The share of the limit that it comes to; B(T), a cubic, is taken off the whole record."""
    rest = at_rest(log, axis, lag="none")
    first = np.arange(len(rest.rate)) < len(rest.rate) // 2
    half = dataclasses.replace(rest, valid=rest.valid & first)
    bound = instability(half, averaging_time_s=60.0, longest_s=600.0, count=60).bound
    interval, times = rest.sample_interval_s, bound.integration_time_s
    other = largest_drift(rest.rate, interval, times, 60.0, valid=rest.valid & ~first)
    assert np.max(other.largest_drift / bound.limit) == pytest.approx(share, abs=0.002)


def test_what_the_coefficients_do_not_describe_is_said(log):
    """A loop in temperature is none of Q, N, B, K; white noise beside it is described well, and nothing is said."""
    rest = at_rest(log, "x", lag="none")
    allan = overlapping_allan(rest.rate, rest.sample_interval_s, valid=rest.valid)
    assert any("do not follow the curve" in note for note in allan_notes(fit_allan(allan)))
    noise = overlapping_allan(1e-3 * np.random.default_rng(0).standard_normal(20_000), 0.5)
    assert allan_notes(fit_allan(noise)) == ()
