"""Moves: every way of writing one gives the motion that the formulas integrate to, and contradictions are named."""

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from gradcal_jax import formulas
from gradcal_jax.formulas import reading_count
from gradcal_jax.spec.bench import TableAxis
from gradcal_jax.spec.moves import Rest, Turn
from gradcal_jax.tables.problems import SpecError, from_validation

DEG = math.pi / 180.0
LIMIT = 1500 * DEG
AXIS = TableAxis.model_validate({"name": "x", "max_rate": "1000 deg/s", "max_acceleration": "1500 deg/s^2"})


def resolve(**keys):
    return Turn.model_validate(keys).resolve(AXIS, 0.0)


def profile(found, points=20_001):
    """Rate on a fine time grid, by the formulas that the core integrates."""
    relative = formulas.shape_pieces(found.shape, unevenness=found.unevenness)
    times, rates, clock = [], [], 0.0
    for what, coefficients in relative:
        length = found.ramp if what == "ramp" else found.duration - 2 * found.ramp
        u = np.linspace(0.0, 1.0, points)
        times.append(clock + u * length)
        rates.append(found.peak_rate * (formulas.motion_rate(u) @ np.array(coefficients)))
        clock += length
    return np.concatenate(times), np.concatenate(rates)


EXAMPLES = [
    *({"shape": shape, "turn": "360 deg", "peak_rate": "300 deg/s"} for shape in formulas.RAMPS),
    {"shape": "linear ramps", "turn": "-900 deg", "peak_rate": "100 deg/s", "duration": "10.5 s"},
    {"turn": "-9 deg"},
    {"shape": "hand", "turn": "360 deg", "duration": "12 s", "unevenness": 0.6},
    {"shape": "hand", "turn": "-180 deg", "duration": "12 s"},
]


@pytest.mark.parametrize("keys", EXAMPLES, ids=lambda k: f"{k.get('shape')}-{len(k)}")
def test_angle_rate_and_acceleration_are_those_of_the_profile(keys):
    found = resolve(**keys)
    t, rate = profile(found)
    angle = np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(t))])
    assert t[-1] == pytest.approx(found.duration, rel=1e-12)
    assert angle[-1] == pytest.approx(found.angle, rel=1e-6, abs=1e-7)
    assert np.abs(rate).max() == pytest.approx(found.fastest, rel=1e-5)
    moving = np.diff(t) > 0
    slope = np.abs(np.diff(rate)[moving] / np.diff(t)[moving])
    assert slope.max() == pytest.approx(found.peak_acceleration, rel=1e-3)
    assert np.all(np.diff(angle) * found.angle > -1e-12)  # travel counts on the ends alone


@pytest.mark.parametrize(("rate", "duration"), [(10, 45.45), (150, 3.03), (300, 1.52)])
@pytest.mark.parametrize("sign", [1, -1])
def test_the_papers_rounded_turns_are_accepted_with_the_angle_exact(rate, duration, sign):
    found = resolve(shape="cosine ramps", turn=f"{sign * 360} deg", peak_rate=f"{rate} deg/s", duration=f"{duration} s")
    assert found.angle == sign * 2 * math.pi
    assert found.duration == duration
    assert found.peak_rate == pytest.approx(sign * rate * DEG, rel=1e-15)
    assert found.ramp == pytest.approx(duration - 360 / rate, rel=1e-12)
    assert found.angle / found.duration / found.peak_rate == pytest.approx(0.792, abs=0.003)


@settings(deadline=None)
@given(st.sampled_from(["cosine ramps", "linear ramps", None]), st.floats(5, 5000), st.floats(1, 300))
def test_without_a_duration_the_ramps_use_the_axiss_acceleration_in_full(shape, angle, peak):
    steepness = {"linear ramps": 1.0}.get(shape, math.pi / 2)
    reached = math.sqrt(angle * 1500 / steepness)
    assume(shape is None or peak < 0.99 * reached)
    keys = {"turn": f"{angle!r} deg", "peak_rate": f"{peak!r} deg/s"} | ({"shape": shape} if shape else {})
    found = resolve(**keys)
    assert found.peak_acceleration == pytest.approx(LIMIT, rel=1e-9)
    assert found.peak_rate == pytest.approx(min(peak, reached) * DEG, rel=1e-9)
    assert found.peak_rate * (found.duration - found.ramp) == pytest.approx(angle * DEG, rel=1e-9)


COSINES = {"shape": "cosine ramps", "turn": "360 deg"}
REFUSED = [
    (COSINES | {"peak_rate": "10 deg/s", "duration": "30 s"}, "duration", "36 s"),
    (COSINES | {"peak_rate": "10 deg/s", "duration": "80 s"}, "duration", "72 s"),
    (COSINES | {"duration": "30 s"}, "peak_rate", "not determine the motion"),
    (COSINES | {"turn": "1 deg", "peak_rate": "300 deg/s"}, "peak_rate", "30.9 deg/s"),
    ({"turn": "1 deg", "peak_rate": "1001 deg/s"}, "peak_rate", "max_rate"),
    ({"turn": "0 deg"}, "turn", "must not be zero"),
    ({"turn": "4e8 deg"}, "turn", "a million turns"),
    ({"shape": "hand", "turn": "90 deg"}, "duration", "missing"),
]


@pytest.mark.parametrize(("keys", "key", "reason"), REFUSED)
def test_what_does_not_determine_or_contradicts_is_named(keys, key, reason):
    try:
        resolve(**keys)
    except ValidationError as error:
        problems = from_validation(error)
    except SpecError as error:
        problems = error.problems
    (problem,) = problems
    assert problem.dotted == key
    assert reason in problem.message


def test_rests_count_their_readings_without_losing_one_to_rounding():
    rest = Rest.model_validate({"rest": "10 s", "read_every": "1 s"}).resolve()
    assert (rest.is_rest, rest.readings, rest.angle) == (True, 10, 0.0)
    assert Rest.model_validate({"rest": "10 s"}).resolve().readings == 1
    assert Rest.model_validate({"rest": "10 s", "read_every": "none"}).resolve().readings == 0
    assert reading_count(0.3, 0.1) == 3
    assert reading_count(6000.0, 1.0) == 6000
    assert reading_count(0.99, 1.0) == 0
