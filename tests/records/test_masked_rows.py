"""Masked values steer nothing, damaged stamps cost their own rows, and rows that are counted are a clock."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gradcal_jax.records.examination import Columns, examine
from gradcal_jax.records.importers import import_log
from gradcal_jax.records.log import Log, LogError, Reason
from gradcal_jax.records.signal_checks import without_faults

ROWS, HZ = 6000, 10.0
HEAD = 'format = "gradcal-columns/1"\n'
TIME = 'time = { column = "t", unit = "s" }\n'
NOISE = 0.3 / 60.0
"""deg/sqrt(s)"""


def rates(rows: int = ROWS, hz: float = HZ, seed: int = 0) -> np.ndarray:
    return NOISE * np.sqrt(hz) * np.random.default_rng(seed).standard_normal(rows)


def require_walk(log: Log, rel: float) -> None:
    """White noise of `NOISE`, by the differences of the rates."""
    rate = np.degrees(log.rate_rad_per_s[0, :, 0])
    assert np.sqrt(0.5 * np.mean(np.diff(rate) ** 2) * log.sample_interval_s) == pytest.approx(NOISE, rel=rel)


def warm_up(masked: np.ndarray, rate: float, temperature: float) -> Columns:
    """A warm-up from 20 to 40 degC, with these values in rows that the device marks as bad."""
    course = np.linspace(20.0, 40.0, ROWS)
    values = np.radians(0.01 * (course - 20.0) + rates())
    return Columns(
        "a",
        {
            "gyro x": np.where(masked, rate, values),
            "time": np.arange(ROWS) / HZ,
            "temperature": np.where(masked, temperature, np.round(course, 3)),
            "marked": masked.astype(float),
        },
    )


@given(
    seed=st.integers(0, 2**16),
    rate=st.floats(-1.0, 1.0) | st.sampled_from([np.nan, 1e300]),
    temperature=st.floats(-300.0, 1000.0) | st.sampled_from([85.0, np.nan]),
)
@settings(max_examples=20, deadline=None)
def test_masked_values_change_nothing(seed, rate, temperature):
    masked = np.random.default_rng(seed).random(ROWS) < 0.01
    logs = [examine(warm_up(masked, *values)) for values in ((0.0, 30.0), (rate, temperature))]
    for name in ("time_s", "rate_rad_per_s", "temperature_c", "status", "stretch_starts"):
        np.testing.assert_array_equal(getattr(logs[0], name), getattr(logs[1], name))
    cleaned = [without_faults(log, at_rest=True)[0] for log in logs]
    np.testing.assert_array_equal(cleaned[0].rate_rad_per_s, cleaned[1].rate_rad_per_s)
    assert cleaned[0].bridged_temperature() == pytest.approx(cleaned[1].bridged_temperature(), abs=0.0)


def test_false_readings_of_a_thermometer_leave_no_trace():
    columns = warm_up(np.zeros(ROWS, bool), 0.0, 0.0)
    for first in range(300, 5800, 250):
        columns.values["temperature"][first : first + 10] = 85.0
    log = examine(columns)
    assert log.counts() == {"used": ROWS - 220, Reason.MISSING_TEMPERATURE.words: 220}
    assert np.nanmax(log.temperature_c) <= 40.0
    assert np.isnan(log.rate_rad_per_s[0, log.status[0] != 0]).all()


def imported(folder: Path, time: np.ndarray, values: np.ndarray, text: str, name: str = "gx"):
    path = folder / "a.csv"
    np.savetxt(path, np.column_stack([time, values]), delimiter=",", header=f"t,{name}", comments="", fmt="%.7f")
    return import_log(path, HEAD + text)


GX = 'rate.x = { column = "gx", unit = "deg/s" }\n'


@pytest.mark.parametrize(
    ("ahead_s", "kind", "firsts"),
    [
        (4294.967296, "damaged", (500, 2000, 2100, 5000)),
        (31.0, "damaged", (500, 2000, 2100, 5000)),
        (-30.0, "unordered", (1000, 2000)),
        # Here the damaged rows are more than the sound ones beyond them.
        (-30.0, None, (3, 2000)),
        (30.0, None, (2000, ROWS - 22)),
    ],
)
def test_damaged_stamps_cost_their_own_rows(tmp_path, ahead_s, kind, firsts):
    damaged = np.arange(ROWS) / 100.0
    for first in firsts:
        damaged[first : first + 20] += ahead_s
    read = lambda: imported(tmp_path, damaged, rates(hz=100.0), TIME + GX)  # noqa: E731
    if kind is None:
        with pytest.raises(LogError, match="far from those about them"):
            read()
        return
    log = read()
    assert log.rows_removed == {f"{kind} stamp": 20 * len(firsts)}
    (finding,) = (one for one in log.findings if one.kind == f"{kind} stamp")
    assert f"first row {firsts[0]}" in finding.message
    assert log.duration_s == pytest.approx((ROWS - 1) / 100.0)
    assert 1.0 / log.sample_interval_s == pytest.approx(100.0)


def test_increments_are_divided_by_the_interval_of_a_sample(tmp_path):
    values, time = rates(hz=100.0), np.arange(ROWS) / 100.0
    with pytest.raises(LogError, match='per = "row"'):
        imported(
            tmp_path, time, 10.0 * values, TIME + 'rate.x = { column = "dtheta_x", unit = "mdeg/s" }\n', "dtheta_x"
        )
    column = 'rate.x = { column = "dtheta_x", unit = "mdeg", per = "row" }\n'
    kept = np.arange(ROWS) % 1000 > 20
    log = imported(tmp_path, time[kept], 10.0 * values[kept], TIME + column, "dtheta_x")
    np.testing.assert_allclose(np.degrees(log.rate_rad_per_s[0, :, 0]), values[kept], atol=1e-7)


def test_a_counter_of_samples_is_a_clock(tmp_path):
    values, count = rates(hz=100.0), np.arange(ROWS)
    kept = (count < 2000) | (count >= 2100)
    text = 'clock = { column = "t", rate = "100 Hz" }\n'
    log = imported(tmp_path, count[kept], values[kept], text + GX)
    assert log.duration_s == pytest.approx((ROWS - 1) / 100.0)
    assert log.stretch_starts.tolist() == [0, 2000]


@given(
    seed=st.integers(0, 2**16),
    hz=st.sampled_from([50.0, 100.0, 200.0]),
    event_s=st.sampled_from([0.015, 0.03, 0.045]),
    missed=st.sampled_from([0.0, 0.01, 0.05, 0.2]),
    within_s=st.sampled_from([0.0, 2e-4, 4e-4]),
)
@settings(max_examples=40, deadline=None)
def test_rows_that_come_with_events_of_a_radio_are_right_or_asked(
    tmp_path_factory, seed, hz, event_s, missed, within_s
):
    """No row is lost: each comes with the first event, of those that are not missed, after its sample."""
    rng, values = np.random.default_rng(seed), rates(2 * ROWS, hz, seed)
    made = np.arange(len(values)) / hz
    events = np.arange(0.0, made[-1] + 100 * event_s, event_s)
    events = events[rng.random(len(events)) >= missed]
    at = np.searchsorted(events, made)
    first = np.concatenate([[0], np.flatnonzero(np.diff(at)) + 1])
    place = np.arange(len(at)) - np.repeat(first, np.diff(first, append=len(at)))
    stamps = events[at] + within_s * place + 1e-6 * np.arange(len(at)) * (within_s == 0.0)
    right_or_asked(lambda: imported(tmp_path_factory.mktemp("radio"), stamps, values, TIME + GX), rel=0.1)


def right_or_asked(read, *, rel: float) -> None:
    """The log has the white noise of its rates, or the question names the sample rate."""
    asked, log = "sample_rate", None
    try:
        log = read()
    except LogError as error:
        asked = str(error)
    assert "sample_rate" in asked
    if log is not None:
        require_walk(log, rel)


def kept_rows(pattern: str, rows: int, share: float, burst: int, rng: np.random.Generator) -> np.ndarray:
    """Which rows of a record are left by losses of this pattern."""
    count = np.arange(rows)
    if pattern == "at random":
        return rng.random(rows) >= share
    if pattern == "every so many":
        return count % (burst + 1) != burst
    if pattern == "every second burst":
        return (count // burst) % 2 == 0
    if pattern == "long pauses":
        return (rng.random(rows) >= share) & ((count // (50 * burst)) % 2 == 0)
    kept = np.ones(rows, bool)
    for first in rng.choice(rows, max(int(rows * share / burst), 1)).tolist():
        kept[first : first + int(rng.integers(1, 2 * burst))] = False
    return kept


@given(
    pattern=st.sampled_from(["at random", "every so many", "every second burst", "long pauses", "runs"]),
    seed=st.integers(0, 2**16),
    hz=st.sampled_from([25.0, 50.0, 100.0, 400.0]),
    share=st.sampled_from([0.001, 0.01, 0.05, 0.2, 0.5]),
    burst=st.sampled_from([2, 3, 4, 7, 16]),
    jitter=st.sampled_from(["none", "white", "uniform", "late", "milliseconds"]),
)
@settings(max_examples=60, deadline=None)
def test_losses_of_any_pattern_are_right_or_asked(pattern, seed, hz, share, burst, jitter):
    """Rows are lost in patterns, with stamps that are even, jitter, come late, or are in whole milliseconds."""
    rng, values = np.random.default_rng(seed), rates(2 * ROWS, hz, seed)
    made = np.arange(len(values)) / hz
    late = np.maximum.accumulate(made + rng.exponential(0.3 / hz, len(made))) + 1e-7 * np.arange(len(made))
    stamps = {
        "none": made,
        "white": made + 0.1 / hz * rng.standard_normal(len(made)),
        "uniform": made + rng.uniform(0.0, 0.9, len(made)) / hz,
        "late": late,
        "milliseconds": np.floor(1e3 * made + 1e-6) / 1e3,
    }[jitter]
    kept = kept_rows(pattern, len(values), share, burst, rng)
    columns = Columns("a", {"gyro x": np.radians(values[kept]), "time": stamps[kept]})
    right_or_asked(lambda: examine(columns), rel=0.05)


@given(
    kind=st.sampled_from(["ahead", "behind", "anything", "zero", "one bit"]),
    seed=st.integers(0, 2**16),
    runs=st.sampled_from([1, 3, 10, 40]),
    lasting=st.sampled_from([1, 2, 5, 20, 50, 300]),
    by_s=st.sampled_from([0.5, 5.0, 30.0, 3600.0, 4294.967296, 1e9]),
)
@settings(max_examples=40, deadline=None)
def test_damaged_stamps_are_masked_or_asked_about(kind, seed, runs, lasting, by_s):
    rng, values = np.random.default_rng(seed), rates(2 * ROWS, 100.0, seed)
    stamps = np.arange(len(values)) / 100.0
    # (Damage from the first row on is a gap after sound rows.)
    for first in rng.choice(np.arange(1, len(values) - lasting), runs, replace=False).tolist():
        rows = slice(first, first + lasting)
        stamps[rows] = {
            "ahead": stamps[rows] + by_s,
            "behind": stamps[rows] - by_s,
            "anything": rng.uniform(0.0, by_s, lasting),
            "zero": np.zeros(lasting),
            "one bit": stamps[rows] + 2.0 ** rng.integers(-6, 20),
        }[kind]
    try:
        log = examine(Columns("a", {"gyro x": np.radians(values), "time": stamps}))
    except LogError:
        return
    require_walk(log, 0.05)
    assert log.duration_s < 1.1 * len(values) / 100.0
    assert log.findings or np.array_equal(stamps, np.arange(len(values)) / 100.0)
