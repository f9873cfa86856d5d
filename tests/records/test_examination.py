"""From columns to a log: what is removed, masked, split and asked, and that every row is counted."""

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gradcal_jax.records.examination import Columns, examine
from gradcal_jax.records.log import LogError
from gradcal_jax.records.stamps import Policy


def columns(rate, time=None, *, sample_rate_hz=None, full_scale_rad_per_s=None, **more):
    """One unit, one axis; `more`: columns by name."""
    rate = np.asarray(rate, float)
    time = np.arange(len(rate)) * 0.01 if time is None else np.asarray(time, float)
    named = {name.replace("_", " "): np.asarray(one, float) for name, one in more.items()}
    return Columns("s", {"gyro x": rate, "time": time} | named, sample_rate_hz, full_scale_rad_per_s)


def kinds(log):
    return {finding.kind: finding for finding in log.findings}


def quiet(count, seed=0):
    return 1e-3 * np.random.default_rng(seed).standard_normal(count)


def test_stamps_that_repeat_or_step_back_or_are_none_are_removed_and_counted():
    time = np.arange(100) * 0.01
    time[10], time[50], time[70] = time[9], time[20], np.nan
    log = examine(columns(quiet(100), time))
    assert log.counts() == {"used": 97, "unreadable row": 1, "duplicate stamp": 1, "unordered stamp": 1}
    assert kinds(log)["duplicate stamp"].message == "1 row with the time stamp of an earlier row, first row 10"
    time = np.arange(400) * 0.01
    time[200:230] -= 0.5  # a packet that came late: what follows is on time
    assert examine(columns(quiet(400), time)).counts()["unordered stamp"] == 30


def test_gaps_split_and_jitter_does_not():
    rng = np.random.default_rng(5)
    time = np.arange(2000) * 0.01 + 0.004 * rng.random(2000)
    time[500] += 0.0095  # late by a whole sample, but the next ones are on time
    assert "gap" not in kinds(examine(columns(quiet(2000), np.sort(time))))
    time = np.arange(2000) * 0.01
    time[300:] += 0.02
    time[1200:] += 3.0
    log = examine(columns(quiet(2000), time))
    assert log.stretch_starts.tolist() == [0, 300, 1200]
    assert "2 gaps with about 302 samples dropped" in kinds(log)["gap"].message
    assert log.sample_interval_s == pytest.approx(0.01, rel=1e-9)


@pytest.mark.parametrize("size", [2, 10])
@pytest.mark.parametrize("rows_lost", [False, True])
def test_bursts_with_losses_are_a_question(size, rows_lost):
    k = np.arange(20_000)
    kept = np.random.default_rng(3).random(len(k)) > 0.03 if rows_lost else (k < 8000) | (k >= 9000)
    with pytest.raises(LogError, match="sample_rate"):
        examine(columns(quiet(len(k))[kept], (((k // size) * size + (k % size) * 0.02) / 200.0)[kept]))


def test_sound_stamps_are_kept_to_the_last_digit():
    for hz in (1.0, 50.0, 100.0, 1000.0):
        time = np.arange(5000) / hz + 1e-5 * np.random.default_rng(2).standard_normal(5000)
        log = examine(columns(quiet(5000), time))
        assert not {"gap", "uneven stamps"} & set(kinds(log))
        assert np.array_equal(log.time_s, time)


def test_missing_saturated_and_marked_rows_are_masked_by_unit():
    rate = quiet(1000)
    rate[[5, 6]] = np.nan
    rate[100:110] = 4.37
    marked = np.zeros(1000, bool)
    marked[[5, 700]] = True
    log = examine(columns(rate, marked=marked, full_scale_rad_per_s=4.36))
    # What a marked row holds, or that it lacks it, is of no matter.
    assert log.counts() == {"used": 987, "missing rate": 1, "saturated": 10, "marked": 2}


def test_a_frozen_temperature_is_found_and_a_coarse_one_is_not():
    time = np.arange(6000) * 0.1
    smooth = 20 + time / 60 + 0.01 * np.random.default_rng(3).standard_normal(6000)
    frozen, missing = smooth.copy(), smooth.copy()
    frozen[2000:3000], missing[10:20] = frozen[2000], np.nan
    for shown, counts in (
        (frozen, {"used": 5000, "frozen temperature": 1000}),
        (missing, {"used": 5990, "missing temperature": 10}),
        (np.rint(smooth / 0.25) * 0.25, {"used": 6000}),
        (np.rint(20.0 + 25.0 * (1.0 - np.exp(-time / 60.0))), {"used": 6000}),  # and a plateau is no fault
        (np.full(6000, 21.5), {"used": 6000}),
    ):
        log = examine(columns(quiet(6000), time, temperature=shown))
        assert log.counts() == counts
    assert "never changes" in kinds(log)["constant temperature"].message


@pytest.mark.parametrize(
    ("raw", "sentence"),
    [
        (columns(300 * np.sin(np.arange(3000) * 0.01)), "column map state a unit that is too large"),
        (columns(quiet(2_000_000), np.arange(2_000_000)), "another unit"),  # ms as s at 1 kHz: 23 days
    ],
)
def test_wrong_units_are_found_by_size(raw, sentence):
    with pytest.raises(LogError, match=sentence):
        examine(raw)
    said = [finding.message for finding in examine(raw, Policy(values="keep")).findings]
    assert any(re.search(sentence, one) for one in said)


def test_a_clock_that_differs_from_the_stated_rate_is_said():
    time = np.arange(20_000) * 0.01
    (finding,) = examine(columns(quiet(20_000), time * 1.0003, sample_rate_hz=100.0)).findings
    assert finding.kind == "clock drift"
    assert "+300 ppm longer" in finding.message
    assert examine(columns(quiet(20_000), time, sample_rate_hz=100.0)).findings == ()


@pytest.mark.parametrize(
    ("flags", "numbers"),
    [([1, 1, 0, 0, 1, 0], [0, 0, -1, -1, 1, -1]), ([4, 4, -1, np.nan, 5, -7], [4, 4, -1, -1, 5, -1])],
)
def test_standstills_are_numbered_from_truth_values_or_as_given(flags, numbers):
    assert examine(columns(quiet(6), standstill=flags)).standstill.tolist() == numbers


numbers = st.one_of(st.floats(width=64), st.floats(-10, 10), st.sampled_from([0.0, 1.0, 1e308, -1e308, np.nan, np.inf]))


@given(data=st.data(), rows=st.integers(2, 40))
@settings(max_examples=200, deadline=None)
def test_whatever_the_numbers_nothing_is_dropped_silently(data, rows):
    array = lambda: np.array(data.draw(st.lists(numbers, min_size=rows, max_size=rows)))  # noqa: E731
    raw = columns(
        array(),
        array() if data.draw(st.booleans()) else np.cumsum(np.abs(np.nan_to_num(array(), posinf=1.0, neginf=1.0)) % 7),
        temperature=array(),
        host_time=array(),
        standstill=array(),
        table_angle_t=array(),
        sample_rate_hz=data.draw(st.one_of(st.none(), st.floats(1e-6, 1e6))),
    )
    try:
        log = examine(raw, Policy(values="keep"))
    except LogError:
        return
    assert sum(log.counts().values()) == rows == log.rows_read
    assert np.isfinite(log.rate_rad_per_s[0][log.usable()]).all()
    assert np.count_nonzero(log.even("gyro x").valid) == log.counts()["used"]
