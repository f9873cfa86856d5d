import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from plain_drifts import drifts

from gradcal_jax.identify.largest_drift import integration_times, largest_drift, longest_integration_time


def plain_largest(rate, before, length, valid):
    """Two nested means at every start, straight from the definition."""
    best, count = -1.0, 0
    for start in range(before, len(rate) - length + 1):
        if valid[start - before : start + length].all():
            count += 1
            value = abs(rate[start : start + length].mean() - rate[start - before : start].mean())
            best = max(best, value)
    return best, count


@given(
    seed=st.integers(0, 2**32 - 1),
    samples=st.integers(3, 900),
    before=st.integers(1, 200),
    lengths=st.lists(st.integers(1, 300), min_size=1, max_size=5),
    kind=st.sampled_from(["white", "walk", "counts", "offset", "ramp"]),
    holes=st.integers(0, 4),
)
@settings(max_examples=150, deadline=None)
def test_equals_the_definition_over_all_starts(seed, samples, before, lengths, kind, holes):
    rng = np.random.default_rng(seed)
    rate = rng.standard_normal(samples)
    rate = {
        "white": rate,
        "walk": np.cumsum(rate),
        "counts": np.rint(rate),
        "offset": 1e6 + rate,
        "ramp": np.linspace(0.0, 3.0, samples),
    }[kind]
    valid = np.ones(samples, bool)
    valid[rng.integers(0, samples, holes)] = False
    interval = 0.25
    expected = [plain_largest(rate, before, length, valid) for length in sorted(set(lengths))]
    run = lambda: largest_drift(rate, interval, np.array(lengths) * interval, before * interval, valid=valid)  # noqa: E731
    if expected[-1][1] == 0:
        with pytest.raises(ValueError, match="is longer than every unbroken part of the record"):
            run()
        return
    result = run()
    scale = np.abs(rate).max()
    np.testing.assert_allclose(result.largest_drift, [value for value, _ in expected], rtol=1e-9, atol=1e-12 * scale)
    assert result.start_count.tolist() == [count for _, count in expected]
    for row, length in enumerate(sorted(set(lengths))):
        start = int(result.start_index[row])
        assert valid[start - before : start + length].all()
        there = rate[start : start + length].mean() - rate[start - before : start].mean()
        assert abs(there) == pytest.approx(result.largest_drift[row], rel=1e-9, abs=1e-12 * scale)


def test_long_record_equals_the_plain_formula():
    rate = np.cumsum(np.random.default_rng(8).standard_normal(200_000)) * 1e-3
    result = largest_drift(rate, 0.01, integration_times(0.5, 500.0, 0.01, count=12), 10.0)
    for row, time in enumerate(result.integration_time_s):
        values = np.abs(drifts(rate, 0.01, float(time), 10.0))
        assert result.largest_drift[row] == pytest.approx(values.max(), rel=1e-10)
        assert result.start_index[row] == 1000 + values.argmax()


def test_the_longest_integration_time_lies_between_masked_rows():
    assert longest_integration_time(np.arange(400) != 150, 1.0, 20.0) == 229.0


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"integration_times_s": np.array([90.0])}, "choose integration times of at most 80 s"),
        ({"averaging_time_s": 200.0}, "use a shorter averaging time"),
        ({"sample_interval_s": 0.0}, "must be positive"),
        ({"integration_times_s": np.array([-3.0])}, "must be positive"),
        ({"averaging_time_s": 0.3}, "shorter than half a sample"),
        ({"integration_times_s": np.zeros(0)}, "at least one integration time"),
        ({"valid": np.ones(7, bool)}, "mask"),
        ({"rate": np.where(np.arange(100) == 61, np.nan, 1.0)}, "is not finite"),
    ],
)
def test_what_cannot_be_done_is_said(arguments, sentence):
    sound = {
        "rate": np.arange(100.0),
        "sample_interval_s": 1.0,
        "integration_times_s": np.array([5.0]),
        "averaging_time_s": 20.0,
    }
    with pytest.raises(ValueError, match=sentence):
        largest_drift(**{**sound, **arguments})


def test_integration_times_are_distinct_whole_samples():
    times = integration_times(1.0, 1200.0, 0.5, count=200)
    assert times[0] == 1.0
    assert times[-1] == 1200.0
    assert np.all(np.diff(times) >= 0.5)
    assert np.all(times / 0.5 == np.rint(times / 0.5))
    with pytest.raises(ValueError, match="positive and increasing"):
        integration_times(5.0, 1.0, 0.5)
