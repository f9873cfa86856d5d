"""Records by hand with rows lost, spikes and rows of zeros: filled, said, and no error beyond the covariance."""

from dataclasses import replace

import numpy as np
import pytest
from test_hand_estimate import AT, G, drawn, held, squared

from gradcal_jax.estimation.hand_estimate import HandReport, estimate_by_hand
from gradcal_jax.records.log import Log


@pytest.fixture(scope="module")
def sound() -> tuple[dict[str, float], Log, HandReport]:
    rng = np.random.default_rng(5)
    truth = drawn(rng)
    log = held(truth, rng)
    (report,) = estimate_by_hand(log, G, **AT)
    return truth, log, report


def lost(log: Log, rng: np.random.Generator, count: int) -> Log:
    """Single rows and pairs are missing anywhere."""
    kept = np.ones(len(log.time_s), bool)
    begins = rng.choice(len(kept) - 20, count, replace=False) + 10
    kept[begins] = False
    kept[begins[::2] + 1] = False
    after = np.flatnonzero(np.diff(np.flatnonzero(kept)) > 1) + 1
    assert log.specific_force_m_per_s2 is not None
    assert log.standstill is not None
    return replace(
        log,
        time_s=log.time_s[kept],
        rate_rad_per_s=log.rate_rad_per_s[:, kept],
        specific_force_m_per_s2=log.specific_force_m_per_s2[:, kept],
        standstill=log.standstill[kept],
        stretch_starts=np.concatenate([[0], after]),
        rows_read=-1,
    )


def test_lost_rows_in_turns_are_filled(sound):
    truth, log, before = sound
    thin = lost(log, np.random.default_rng(2), 150)
    (report,) = estimate_by_hand(thin, G, **AT)
    assert report.solution.turns >= before.solution.turns - 2
    assert any("gaps of one or two rows are bridged" in words for words in report.messages)
    distance, count = squared(report, truth)
    assert distance < 2.0 * count


@pytest.mark.parametrize("kind", ["spikes", "zeros"])
def test_rare_wrong_rows_are_left_out(sound, kind: str):
    truth, log, _ = sound
    rng = np.random.default_rng(3)
    rate, force = log.rate_rad_per_s.copy(), log.specific_force_m_per_s2.copy()
    rows = rng.choice(len(log.time_s) - 20, 40, replace=False) + 10
    if kind == "spikes":
        rate[0, rows, 1] += 5.0
        force[0, rows[:20], 2] -= 40.0
    else:
        rate[0, rows], force[0, rows] = 0.0, 0.0
    (report,) = estimate_by_hand(
        replace(log, rate_rad_per_s=rate, specific_force_m_per_s2=force, standstill=None), G, **AT
    )
    (alone,) = estimate_by_hand(replace(log, standstill=None), G, **AT)
    assert report.solution.turns >= 0.6 * alone.solution.turns
    assert any("differ from their neighbours by more than" in words for words in report.messages)
    distance, count = squared(report, truth)
    assert distance < 2.0 * count


def test_a_sound_record_is_left_as_it_is(sound):
    assert not any("bridged" in words or "neighbours" in words for words in sound[2].messages)
