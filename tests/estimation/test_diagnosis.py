"""What residuals that are too large look like."""

import numpy as np

from gradcal_jax.estimation import diagnosis
from gradcal_jax.estimation.contradictions import diagnosis_sentences

TIME = np.arange(2000.0)
MOVED = np.arange(2000) % 5 == 0


def residuals(seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(len(TIME))


def test_sound_residuals_look_like_nothing():
    for seed in range(50):
        assert not diagnosis_sentences(residuals(seed), TIME, MOVED)
    assert not diagnosis_sentences(4.0 * residuals(), TIME, MOVED)  # the noise alone, everywhere


def test_single_events_are_found_with_their_times():
    r = residuals()
    r[700:703] += 40.0
    r[1500] -= 25.0
    seen = diagnosis(r, TIME, MOVED)
    assert seen.readings == 4
    assert seen.events.tolist() == [[700.0, 702.0], [1500.0, 1500.0]]
    (sentence,) = diagnosis_sentences(r, TIME, MOVED)
    words = "4 of 2000 readings do not agree with the others, at 700 … 702 s, 1500 s: did the encoder slip"
    assert sentence.startswith(words)


def test_motion_is_told_from_noise():
    r = residuals() * np.where(MOVED, 5.0, 1.0)
    seen = diagnosis(r, TIME, MOVED)
    assert not len(seen.events)
    assert seen.motion_tells
    assert 4.5 < seen.moving < 5.5
    assert 0.9 < seen.resting < 1.1
    (sentence,) = diagnosis_sentences(r, TIME, MOVED)
    assert "vibration" in sentence


def test_too_few_residuals_say_nothing():
    assert not diagnosis_sentences(np.array([1.0, 50.0, 1.0]), np.arange(3.0), np.array([True, False, True]))
    assert not diagnosis_sentences(np.zeros(0), np.zeros(0), np.zeros(0, bool))
