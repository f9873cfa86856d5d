"""What the error model's room promises by itself: bases, terms, priors' rows, processes."""

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import encoder, gyro_x, scale_map
from numpy.polynomial import legendre

from gradcal_jax import model as models
from gradcal_jax.model import BIAS, SCALE_FACTOR, TEMPERATURE_GRADIENT, BSpline, GradientOfBias, Polynomial
from gradcal_jax.model.terms import make_map

X = np.linspace(-60.0, 95.0, 9)


@pytest.mark.parametrize("degree", [0, 4])
def test_reported_coefficients_are_those_of_the_normalised_monomials(degree):
    basis = Polynomial(degree, 20.0, 50.0)
    engine = np.random.default_rng(degree).standard_normal(basis.size)
    values = np.asarray(basis(jnp.asarray(X))) @ engine
    np.testing.assert_allclose(values, legendre.legval((X - 20.0) / 50.0, engine), rtol=1e-12)
    reported = basis.to_reported @ engine
    np.testing.assert_allclose(values, np.polynomial.polynomial.polyval((X - 20.0) / 50.0, reported), rtol=1e-11)


@pytest.mark.parametrize(
    "basis", [Polynomial(3, 20.0, 50.0), BSpline((-40.0, 0.0, 85.0), 2), BSpline((-40.0, 0.0, 30.0, 85.0), 0)]
)
def test_every_basis_holds_the_constant(basis):
    inside = X[(X >= -40.0) & (X <= 85.0)]
    np.testing.assert_allclose(np.asarray(basis(jnp.asarray(inside))) @ basis.constant, 1.0, rtol=1e-13)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: Polynomial(-1, 0.0, 1.0), "degree of a polynomial must be 0 or more"),
        (lambda: Polynomial(2, 0.0, 0.0), "half the range"),
        (lambda: BSpline((0.0, 0.0, 1.0)), "knots in increasing order"),
        (lambda: BSpline((1.0,), 0), "at least two knots"),
        (lambda: make_map(BSpline((0.0, 1.0), 0), discrepancy=(1e-4, 3, 0)), "smoothness prior instead"),
        (lambda: make_map(Polynomial(3, 0.0, 1.0), discrepancy=(1e-4, 3, 0)), "exceed the model's"),
        (lambda: gyro_x(()), "a bias map, a scale-factor map, or both"),
    ],
)
def test_what_makes_no_sense_is_refused_with_the_mend(make, says):
    with pytest.raises(ValueError, match=says):
        make()


def test_terms_follow_one_another_with_rows_of_one_over_their_prior():
    bias = make_map(Polynomial(3, 20.0, 50.0), prior_std=1e-3, numbered=True)
    scale = scale_map(Polynomial(1, 20.0, 50.0), Polynomial(2, 0.0, 5.0), discrepancy=(1e-4, 2, 3))
    of = gyro_x((bias, scale, GradientOfBias(std=3e-6)))
    groups = [of.where(name) for name in (BIAS, SCALE_FACTOR, TEMPERATURE_GRADIENT, "scale_factor_discrepancy")]
    # Of the discrepancy: one more degree in T times four in ω, and one more in ω times the two in T.
    assert [s.stop - s.start for s in groups] == [4, 6, 1, 1 * 4 + 2 * 1]
    assert [s.start for s in groups] == [0, *(s.stop for s in groups[:-1])]
    assert of.size == groups[-1].stop == len(of.names())
    assert of.where("bias_discrepancy") == slice(17, 17)
    assert of.term("bias_discrepancy") is None
    rows = models.ImuModel((of,), (), encoder()).prior_rows()
    information = rows.T @ rows
    reported = bias.to_reported
    np.testing.assert_allclose(information[:4, :4], reported.T @ reported / 1e-3**2, rtol=1e-12)
    np.testing.assert_array_equal(information[groups[1]], 0.0)  # Flat.
    np.testing.assert_allclose(np.diagonal(information)[10:], [3e-6**-2.0, *[1e-4**-2.0] * 6], rtol=1e-12)


def test_smoothness_joins_neighbours():
    """Bins in rate have neighbours, powers of temperature have none: differences of reported coefficients by bin."""
    of = make_map(Polynomial(2, 20.0, 50.0), BSpline((-1.0, 0.0, 0.5, 1.0), 0), smoothness_std=0.5)
    reported = np.random.default_rng(3).standard_normal((3, 3))  # power of temperature, bin
    engine = np.linalg.solve(of.to_reported, reported.ravel())
    rows = of.prior_rows()
    assert np.sum((rows @ engine) ** 2) == pytest.approx(np.sum(np.diff(reported, axis=1) ** 2) / 0.25)


def test_processes_are_rows_of_the_table():
    both = models.gauss_markov(2e-6, 120.0) + models.rate_random_walk(3e-9) + models.constant(1e-5)
    np.testing.assert_allclose(both.decay, [1 / 120.0, 0.0, 0.0])
    # A stationary process: what decays, 2·decay·σ², is what diffusion brings.
    np.testing.assert_allclose(both.diffusion**2, [2 / 120.0 * 2e-6**2, 3e-9**2, 0.0])
    np.testing.assert_allclose(both.initial_std, [2e-6, 0.0, 1e-5])
    forever = models.gauss_markov(2e-6, np.inf)
    assert float(forever.decay[0]) == float(forever.diffusion[0]) == 0.0
