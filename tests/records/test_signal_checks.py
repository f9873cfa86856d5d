"""What the samples of a channel show by themselves."""

from dataclasses import replace

import numpy as np
import pytest

from gradcal_jax.records.log import Log, Reason
from gradcal_jax.records.signal_checks import (
    at_a_limit,
    coarse_steps,
    standing_still,
    without_faults,
)

DEG = np.pi / 180.0
NOISE = 0.05 * DEG


def turning(rows: int = 6000, peak: float = 200.0, seed: int = 1) -> np.ndarray:
    """A gyro that turns to and fro, with rests, rad/s."""
    cycle = np.concatenate([np.zeros(400), np.linspace(0, 1, 50), np.ones(300), np.linspace(1, 0, 50), np.zeros(400)])
    course = np.concatenate([cycle, -cycle])
    count = -(-rows // len(course))
    return np.tile(course, count)[:rows] * peak * DEG + NOISE * np.random.default_rng(seed).standard_normal(rows)


def log_of(rate: np.ndarray, temperature: np.ndarray | None = None) -> Log:
    still = np.abs(np.convolve(rate, np.ones(5) / 5, "same")) < 1.0 * DEG
    number = np.where(still, np.cumsum(np.diff(still, prepend=False) & still) - 1, -1)
    return Log(
        np.arange(len(rate)) * 0.02,
        rate[None, :, None],
        ("A",),
        ("x",),
        None if temperature is None else temperature[None],
        standstill=number,
    )


@pytest.mark.parametrize("step", [0.0, 0.3 * NOISE, 1.0 * NOISE, 1.4 * NOISE])
def test_a_sound_channel_shows_nothing(step):
    rate = turning()
    values = rate if step == 0.0 else np.rint(rate / step) * step
    assert not at_a_limit(values).any()
    assert not standing_still(values).any()
    assert coarse_steps(values).off == 0.0


def test_whole_moves_with_saturated_rows_are_masked():
    rate, limit = turning(), 200.0 * DEG + 0.5 * NOISE
    assert np.array_equal(at_a_limit(np.minimum(rate, limit)), rate >= limit)
    log = log_of(np.minimum(rate, limit))
    cleaned, found = without_faults(log)
    assert log.standstill is not None
    forwards = (log.standstill < 0) & (log.rate_rad_per_s[0, :, 0] > 10.0 * DEG)
    assert np.all(cleaned.usable()[log.standstill >= 0])
    assert not cleaned.usable()[forwards].any()
    assert cleaned.counts()["saturated"] > np.count_nonzero(at_a_limit(log.rate_rad_per_s[0, :, 0]))
    assert "gyro x is saturated" in found["A"].sentences[0]
    assert "200" in found["A"].sentences[0]


def test_values_that_stand_still_are_masked_and_named():
    rate = turning()
    rate[1000:1200] = rate[1000]
    cleaned, found = without_faults(log_of(rate))
    assert np.array_equal(np.flatnonzero(~cleaned.usable()), np.arange(1000, 1200))
    assert cleaned.status is not None
    assert cleaned.status[0, 1100] == Reason.FROZEN_VALUES
    (sentence,) = found["A"].sentences
    assert sentence.startswith("frozen: gyro x")
    assert sentence.endswith("200 rows are left out, the first from 20 to 23.98 s")


def test_a_sample_that_is_read_several_times_is_neither_frozen_nor_coarse():
    rate = np.repeat(turning(3000), 8)
    assert not standing_still(rate).any()
    assert coarse_steps(rate).off == 0.0


@pytest.mark.parametrize(("ratio", "off"), [(20.0, 0.5), (3.0, None)])
def test_coarse_steps_are_the_fault_and_nothing_else(ratio, off):
    step = ratio * NOISE
    values = np.rint(turning() / step) * step
    seen = coarse_steps(values)
    assert seen.step == pytest.approx(step)
    assert seen.off > 0.02 * step
    assert off is None or seen.off == pytest.approx(off * step)
    faults = without_faults(log_of(values))[1]["A"]
    assert not faults.status.any()
    assert list(faults.coarse) == ["coarse steps of gyro x"]


def test_a_frozen_thermometer_is_forgotten():
    rate = turning(60_000)
    time = np.arange(len(rate)) * 0.02
    smooth = 20.0 + time / 60.0 + 0.01 * np.random.default_rng(3).standard_normal(len(rate))
    smooth[20_000:40_000] = smooth[20_000]
    cleaned, found = without_faults(log_of(rate, smooth))
    assert cleaned.temperature_c is not None
    assert np.flatnonzero(np.isnan(cleaned.temperature_c[0])).tolist() == list(range(20_000, 40_000))
    assert np.count_nonzero(~cleaned.usable()) == 20_000
    assert "frozen: the thermometer" in found["A"].sentences[0]


def test_gaps_begin_new_stretches_and_single_lost_rows_do_not():
    log = log_of(turning())
    kept = np.ones(len(log.time_s), bool)
    kept[[1000, 1500, 3000]] = False
    kept[2000:2100] = False
    assert log.standstill is not None
    rates = log.rate_rad_per_s[:, kept]
    thin = replace(log, time_s=log.time_s[kept], rate_rad_per_s=rates, standstill=log.standstill[kept], rows_read=-1)
    cleaned, found = without_faults(thin)
    assert cleaned.stretch_starts.tolist() == [0, 1998]
    (said,) = found["A"].sentences
    assert "with about 100 samples lost, the longest 2.02 s, the first at 39.98 s" in said
    assert without_faults(cleaned)[0].stretch_starts.tolist() == [0, 1998]
