"""Moves: every way of writing one gives the motion that the formulas integrate to, and contradictions are named."""

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from gradcal_jax import formulas
from gradcal_jax.formulas import reading_count
from gradcal_jax.spec.moves import SHAPES, Rest
from gradcal_jax.tables.problems import SpecError

DEG = math.pi / 180.0
LIMIT = 1500 * DEG


def move(**keys):
    table = {name: value for name, value in keys.items() if value is not None}
    return SHAPES[table["shape"]].model_validate(table)


def resolve(**keys):
    return move(**keys).resolve(LIMIT)


def profile(found, points=20_001):
    """Rate on a fine time grid, by the formulas that the core integrates."""
    relative = formulas.shape_pieces(found.shape, unevenness=found.unevenness)
    times, rates, clock = [], [], 0.0
    for what, share, coefficients in relative:
        length = {"ramp": found.ramp, "flat": found.duration - 2 * found.ramp, "share": share * found.duration}[what]
        u = np.linspace(0.0, 1.0, points)
        times.append(clock + u * length)
        rates.append(found.peak_rate * (formulas.motion_rate(u) @ np.array(coefficients)))
        clock += length
    return np.concatenate(times), np.concatenate(rates)


EXAMPLES = [
    {"shape": "cosine ramps", "turn": "360 deg", "peak_rate": "300 deg/s"},
    {"shape": "cosine ramps", "turn": "-360 deg", "duration": "3 s"},
    {"shape": "linear ramps", "turns": -2.5, "peak_rate": "100 deg/s", "ramp": "1.5 s"},
    {"shape": "linear ramps", "peak_rate": "-100 deg/s", "duration": "20 s"},
    {"shape": "hand", "turns": 1, "duration": "12 s", "unevenness": 0.6},
    {"shape": "hand", "turn": "-180 deg", "duration": "12 s"},
]


@pytest.mark.parametrize("keys", EXAMPLES, ids=lambda k: f"{k['shape']}-{len(k)}")
def test_angle_rate_acceleration_and_reach_are_those_of_the_profile(keys):
    found = resolve(**keys)
    t, rate = profile(found)
    angle = np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(t))])
    assert t[-1] == pytest.approx(found.duration, rel=1e-12)
    assert angle[-1] == pytest.approx(found.angle, rel=1e-6, abs=1e-7)
    assert np.abs(rate).max() == pytest.approx(found.fastest, rel=1e-5)
    moving = np.diff(t) > 0
    slope = np.abs(np.diff(rate)[moving] / np.diff(t)[moving])
    assert slope.max() == pytest.approx(found.peak_acceleration, rel=1e-3)
    assert angle.min() == pytest.approx(found.low, rel=1e-3, abs=1e-3)
    assert angle.max() == pytest.approx(found.high, rel=1e-3, abs=1e-3)


@pytest.mark.parametrize(("rate", "duration"), [(10, 45.45), (150, 3.03), (300, 1.52)])
@pytest.mark.parametrize("sign", [1, -1])
def test_the_papers_rounded_turns_are_accepted_with_the_angle_exact(rate, duration, sign):
    found = resolve(shape="cosine ramps", turn=f"{sign * 360} deg", peak_rate=f"{rate} deg/s", duration=f"{duration} s")
    assert found.angle == sign * 2 * math.pi
    assert found.duration == duration
    assert found.peak_rate == pytest.approx(sign * rate * DEG, rel=1e-15)
    assert found.ramp == pytest.approx(duration - 360 / rate, rel=1e-12)
    assert found.angle / found.duration / found.peak_rate == pytest.approx(0.792, abs=0.003)


ramped = st.sampled_from(["cosine ramps", "linear ramps"])


@settings(deadline=None)
@given(ramped, st.floats(5, 5000), st.floats(1, 300), st.floats(0.05, 0.98))
def test_any_three_keys_of_a_ramped_turn_give_the_fourth(shape, angle, peak, share):
    ramp = share * angle / peak  # at most the angle over the peak rate: then the ramps meet
    duration = angle / peak + ramp
    texts = {
        "turn": f"{angle!r} deg",
        "peak_rate": f"{peak!r} deg/s",
        "duration": f"{duration!r} s",
        "ramp": f"{ramp!r} s",
    }
    for left_out in texts:
        found = resolve(shape=shape, **{k: v for k, v in texts.items() if k != left_out})
        assert found.angle == pytest.approx(angle * DEG, rel=1e-6)
        assert found.peak_rate == pytest.approx(peak * DEG, rel=1e-6)
        assert found.duration == pytest.approx(duration, rel=1e-6)
        assert found.ramp == pytest.approx(ramp, rel=1e-6, abs=1e-6 * duration)
    assert resolve(shape=shape, **texts).angle == pytest.approx(angle * DEG, rel=1e-12)


@settings(deadline=None)
@given(ramped, st.floats(5, 5000), st.floats(1, 300))
def test_with_two_keys_the_ramps_use_the_tables_acceleration_in_full(shape, angle, peak):
    steepness = {"cosine ramps": math.pi / 2, "linear ramps": 1.0}[shape]
    assume(steepness * peak**2 / 1500 < 0.99 * angle)
    first = resolve(shape=shape, turn=f"{angle!r} deg", peak_rate=f"{peak!r} deg/s")
    assert first.peak_acceleration == pytest.approx(LIMIT, rel=1e-9)
    assert first.peak_rate * (first.duration - first.ramp) == pytest.approx(angle * DEG, rel=1e-9)
    by_time = resolve(shape=shape, turn=f"{angle!r} deg", duration=f"{first.duration!r} s")
    assert by_time.peak_acceleration == pytest.approx(LIMIT, rel=1e-9)
    # Near the shortest time two rates meet the angle almost equally well: compare where they are apart.
    if steepness * peak**2 / 1500 < 0.8 * angle:
        assert by_time.peak_rate == pytest.approx(first.peak_rate, rel=1e-6)
    by_rate = resolve(shape=shape, peak_rate=f"{-peak!r} deg/s", duration=f"{first.duration!r} s")
    assert by_rate.angle == pytest.approx(-angle * DEG, rel=1e-9)


REFUSED = [
    ({"shape": "cosine ramps", "turn": "360 deg"}, "", "do not determine the motion"),
    ({"shape": "cosine ramps", "turn": "360 deg", "ramp": "1 s"}, "", "do not determine the motion"),
    ({"shape": "cosine ramps", "turn": "360 deg", "peak_rate": "10 deg/s", "duration": "30 s"}, "duration", "36 s"),
    ({"shape": "cosine ramps", "turn": "360 deg", "peak_rate": "10 deg/s", "duration": "80 s"}, "duration", "72 s"),
    (
        {"shape": "cosine ramps", "turn": "360 deg", "peak_rate": "10 deg/s", "duration": "40 s", "ramp": "9 s"},
        "turn",
        "310 deg",
    ),
    ({"shape": "cosine ramps", "turn": "1 deg", "peak_rate": "300 deg/s"}, "peak_rate", "30.9 deg/s"),
    ({"shape": "cosine ramps", "turn": "9 deg", "peak_rate": "3 deg/s", "ramp": "4 s"}, "ramp", "at most 3 s"),
    ({"shape": "linear ramps", "turn": "360 deg", "duration": "0.5 s"}, "duration", "at least 0.9798 s"),
    ({"shape": "linear ramps", "peak_rate": "300 deg/s", "duration": "0.1 s"}, "duration", "at least 0.4 s"),
    ({"shape": "linear ramps", "turn": "9 deg", "duration": "4 s", "ramp": "3 s"}, "duration", "at least 6 s"),
    ({"shape": "hand", "turn": "90 deg"}, "duration", "missing"),
    ({"shape": "hand", "duration": "9 s"}, "turn", "missing"),
]


@pytest.mark.parametrize(("keys", "key", "reason"), REFUSED)
def test_what_does_not_determine_or_contradicts_is_named(keys, key, reason):
    with pytest.raises(SpecError) as caught:
        resolve(**keys)
    (problem,) = caught.value.problems
    assert problem.dotted == key
    assert reason in problem.message


def test_rests_count_their_readings_without_losing_one_to_rounding():
    rest = Rest.model_validate({"rest": "10 s", "read_every": "1 s"}).resolve(LIMIT)
    assert (rest.is_rest, rest.readings, rest.angle) == (True, 10, 0.0)
    assert Rest.model_validate({"rest": "10 s"}).resolve(LIMIT).readings == 1
    assert Rest.model_validate({"rest": "10 s", "read": "none"}).resolve(LIMIT).readings == 0
    assert reading_count(0.3, 0.1) == 3
    assert reading_count(6000.0, 1.0) == 6000
    assert reading_count(0.99, 1.0) == 0


@settings(deadline=None)
@given(st.integers(1, 100_000), st.floats(1e-3, 1e3))
def test_a_whole_number_of_spacings_counts_whole(count, spacing):
    assert reading_count(count * spacing, spacing) == count
