"""Bases and motion shapes against SciPy, NumPy and their own definitions; one code for NumPy and JAX."""

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import Act, textbook_rate
from hypothesis import given
from hypothesis import strategies as st
from numpy.polynomial import legendre
from scipy.integrate import quad
from scipy.interpolate import BSpline

from gradcal_jax import formulas


@pytest.mark.parametrize("xp", [np, jnp])
@pytest.mark.parametrize("degree", [0, 1, 3, 7])
def test_polynomials(xp, degree):
    x = np.linspace(-1.2, 1.1, 23)
    given = xp.asarray(x)
    np.testing.assert_allclose(formulas.monomials(given, degree), np.vander(x, degree + 1, increasing=True), rtol=1e-13)
    np.testing.assert_allclose(formulas.legendre(given, degree), legendre.legvander(x, degree), atol=1e-12)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_b_splines_are_scipys_and_hold_beyond_the_ends(degree):
    knots = (-1.0, -0.2, 0.5, 2.0)
    x = np.linspace(-1.0, 2.0, 61)
    t = np.r_[[knots[0]] * degree, knots, [knots[-1]] * degree]
    wanted = BSpline.design_matrix(x, t, degree).toarray()
    np.testing.assert_allclose(formulas.b_spline(x, knots, degree), wanted, atol=1e-14)
    beyond = formulas.b_spline(np.array([-5.0, 9.0]), knots, degree)
    np.testing.assert_allclose(beyond, wanted[[0, -1]], atol=1e-14)
    np.testing.assert_allclose(wanted.sum(1), 1.0)


def test_bins_divide_the_line():
    values = formulas.bins(np.array([-9.0, -1.0, -0.5, 0.0, 0.9, 1.0, 1.5, 9.0]), (-1.0, 0.0, 1.0, 2.0))
    np.testing.assert_array_equal(values.argmax(1), [0, 0, 0, 1, 1, 2, 2, 2])
    np.testing.assert_array_equal(values.sum(1), 1.0)


def test_terms_are_what_their_names_say_and_the_angle_is_the_integral_of_the_rate():
    u = np.linspace(0.0, 1.0, 7)
    for k, name in enumerate(formulas.MOTION_TERMS):
        kind, n = name[:-1], int(name[-1])
        wanted = {"u": u**n, "cos": np.cos(n * np.pi * u), "sin": np.sin(n * np.pi * u)}[kind]
        np.testing.assert_allclose(formulas.motion_rate(u)[:, k], wanted, atol=1e-14)
        for end in (0.3, 1.0):
            wanted = quad(lambda u, k=k: formulas.motion_rate(np.array(u))[k], 0.0, end, epsabs=1e-14)[0]
            assert formulas.motion_angle(np.array(end))[k] == pytest.approx(wanted, abs=1e-13)


ACTS = [
    Act("cosine ramps", 5.0, 2.0, ramp=0.8),
    Act("linear ramps", 5.0, -2.0, ramp=2.5),
    Act("hand", 5.0, 2.0, unevenness=0.4),
]


@pytest.mark.parametrize("act", ACTS, ids=lambda a: a.shape)
def test_pieces_are_the_shape(act):
    begin, angle = 0.0, 0.0
    pieces = formulas.shape_pieces(act.shape, unevenness=act.unevenness)
    for what, terms in pieces:
        duration = act.ramp if what == "ramp" else act.duration - 2 * act.ramp
        u = np.linspace(0.0, 1.0, 11)
        result = act.peak * formulas.motion_rate(u) @ np.array(terms)
        np.testing.assert_allclose(result, textbook_rate(act, begin + u * duration), atol=1e-12)
        angle += act.peak * duration * float(formulas.motion_angle(np.array(1.0)) @ np.array(terms))
        begin += duration
    assert begin == pytest.approx(act.duration)
    points = [*np.linspace(0.0, act.duration, 13)[1:-1], act.ramp, act.duration - act.ramp]
    wanted = quad(lambda t: float(textbook_rate(act, np.array(t))), 0, act.duration, points=points, epsabs=1e-13)[0]
    assert angle == pytest.approx(wanted, abs=1e-11)


def test_unknown_shapes_are_refused_by_name():
    with pytest.raises(ValueError, match="cosine ramps"):
        formulas.shape_pieces("cosine ramp")


def test_cycles_and_readings_survive_rounding():
    assert formulas.repetitions(6000.0, 120.0, 360.0) == (17, pytest.approx(120.0))
    assert formulas.repetitions(0.3, 0.1, 0.1)[0] == 3
    assert formulas.repetitions(5.0, 6.0, 8.0) == (0, 5.0)
    assert formulas.reading_times(0.3, 0.1) == pytest.approx([0.1, 0.2, 0.3])
    assert formulas.reading_times(10.0, None) == []


@given(st.lists(st.booleans(), max_size=40))
def test_runs_are_where_true_values_stand_together(values):
    where = np.array(values, bool)
    result = formulas.runs(where)
    again = np.zeros(len(where), int)
    for number, (first, end) in enumerate(result.tolist(), start=1):
        assert end > first
        again[first:end] = number
    np.testing.assert_array_equal(again > 0, where)
    assert np.all(result[1:, 0] > result[:-1, 1])  # something false stands between two
