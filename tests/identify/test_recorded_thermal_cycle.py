"""A real recording: a MEMS gyro triad at rest through one thermal cycle.

Its source gives no units: read as µs and rad/s.

(The source labels the rates deg/s; their white noise fits rad/s better. Nothing here depends on it but the deg/h.)
"""

import dataclasses
import os
from pathlib import Path

import numpy as np
import pytest

from gradcal_jax.identify.allan import fit_allan, overlapping_allan
from gradcal_jax.identify.instability import allan_notes, at_rest, instability
from gradcal_jax.identify.largest_drift import largest_drift
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


def test_every_row_is_accounted_for(log):
    assert log.counts() == {"used": 8399, "left out": 1}
    assert log.findings == ()
    assert 1 / log.sample_interval_s == pytest.approx(1.98, abs=0.005)
    assert log.duration_s / 60 == pytest.approx(71, abs=0.5)


@pytest.mark.parametrize(("axis", "share"), [("x", 0.453), ("y", 0.643), ("z", 0.412)])
def test_the_second_half_stays_within_what_bounds_the_first(log, axis, share):
    """The share of the limit that it comes to; B(T), a cubic, is taken off the whole record."""
    rest = at_rest(log, axis, lag=False)
    first = np.arange(len(rest.rate)) < len(rest.rate) // 2
    half = dataclasses.replace(rest, valid=rest.valid & first)
    bound = instability(half, averaging_time_s=60.0, longest_s=600.0, count=60).bound
    interval, times = rest.sample_interval_s, bound.integration_time_s
    other = largest_drift(rest.rate, interval, times, 60.0, valid=rest.valid & ~first)
    assert np.max(other.largest_drift / bound.limit) == pytest.approx(share, abs=0.002)


def test_what_the_coefficients_do_not_describe_is_said(log):
    """A loop in temperature is none of Q, N, B, K; white noise beside it is described well, and nothing is said."""
    rest = at_rest(log, "x", lag=False)
    allan = overlapping_allan(rest.rate, rest.sample_interval_s, valid=rest.valid)
    assert any("do not follow the curve" in note for note in allan_notes(fit_allan(allan)))
    noise = overlapping_allan(1e-3 * np.random.default_rng(0).standard_normal(20_000), 0.5)
    assert allan_notes(fit_allan(noise)) == ()
