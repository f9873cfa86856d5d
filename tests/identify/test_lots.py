"""The hierarchical model of a lot, against plain formulas and simulated lots."""

import numpy as np
import pytest
from lot_scene import MEAN, SHAPES, drawn_maps, read_maps
from scipy.optimize import minimize
from scipy.stats import multivariate_normal

from gradcal_jax.identify import lots


def equal_lot(rng, count, size, noise=1.0):
    values = rng.standard_normal((count, size)) * np.arange(2.0, 2.0 + size) + noise * rng.standard_normal(
        (count, size)
    )
    return values, np.tile(noise**2 * np.eye(size), (count, 1, 1))


def test_of_equal_covariances_mean_and_spread_are_those_of_the_sample():
    values, own = equal_lot(np.random.default_rng(0), 30, 3)
    found = lots.restricted_likelihood(values, own)
    assert found.mean == pytest.approx(values.mean(axis=0), rel=1e-6)
    assert found.covariance == pytest.approx(np.cov(values.T) - np.eye(3), rel=1e-3, abs=1e-3)
    assert found.mean_covariance == pytest.approx(np.cov(values.T) / 30, rel=1e-3, abs=1e-4)


def test_of_unequal_covariances_the_spread_has_the_largest_restricted_likelihood():
    """By the density of the contrasts to the last IMU, which do not contain the mean."""
    rng = np.random.default_rng(1)
    values, own = read_maps(rng, drawn_maps(rng, 8, "no")[:, :4], noise=6.0)
    values, own = values[:, :2], own[:, :2, :2]
    found = lots.restricted_likelihood(values, own)
    contrast = np.kron(np.concatenate([np.eye(7), -np.ones((7, 1))], axis=1), np.eye(2))

    def minus_log(root):
        spread = root.reshape(2, 2) @ root.reshape(2, 2).T
        whole = np.zeros((16, 16))
        for i in range(8):
            whole[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = spread + own[i]
        return -multivariate_normal(cov=contrast @ whole @ contrast.T).logpdf(contrast @ values.ravel())

    best = minimize(minus_log, np.eye(2).ravel() * 8.0, method="Nelder-Mead", options={"fatol": 1e-9, "maxiter": 5000})
    assert minus_log(np.linalg.cholesky(found.covariance + 1e-12 * np.eye(2)).ravel()) <= best.fun + 1e-5


def test_of_equal_covariances_shapes_are_principal_components():
    values, own = equal_lot(np.random.default_rng(2), 25, 4)
    singular = np.linalg.svd(values - values.mean(axis=0), compute_uv=False)
    for count in range(4):
        fit = lots.low_rank(values, own, count)
        assert fit.chi_squared.sum() == pytest.approx(np.sum(singular[count:] ** 2), rel=1e-6)


def test_of_unequal_covariances_no_other_shapes_leave_less():
    rng = np.random.default_rng(3)
    values, own = read_maps(rng, drawn_maps(rng, 12, "one"))
    fit = lots.low_rank(values, own, 1)
    weights = np.linalg.inv(own)

    def left(parameters):
        mean, shape = parameters[:4], parameters[4:]
        rest = values - mean
        along = np.einsum("j,ijk,ik->i", shape, weights, rest) / np.einsum("j,ijk,k->i", shape, weights, shape)
        rest = rest - along[:, None] * shape
        return np.einsum("ij,ijk,ik->", rest, weights, rest)

    best = min(minimize(left, rng.standard_normal(8) * 3.0).fun for _ in range(5))
    assert fit.chi_squared.sum() <= best * (1.0 + 1e-5)
    unlike = abs(fit.shapes[:, 0] @ SHAPES[0]) / np.linalg.norm(SHAPES[0])
    assert unlike > 0.98


def test_what_shapes_leave_has_its_degrees_of_freedom():
    """Mean and variance of χ² over lots, which wrong degrees would miss by several standard errors."""
    rng = np.random.default_rng(4)
    for kind, count in (("alike", 0), ("one", 1)):
        found = [lots.low_rank(*read_maps(rng, drawn_maps(rng, 10, kind)), count) for _ in range(150)]
        left = [fit.chi_squared.sum() for fit in found]
        degrees = (10 - count - 1) * (4 - count)
        assert abs(np.mean(left) - degrees) < 4.0 * np.sqrt(2.0 * degrees / 150)


def test_intervals_of_equal_errors_are_the_textbooks():
    rng = np.random.default_rng(5)
    values = rng.standard_normal((12, 3)) * 4.0
    sample = values.var(axis=0, ddof=1)
    mean, half, between = lots.intervals(values, np.full((12, 3), 1e-9), sample)
    assert mean == pytest.approx(values.mean(axis=0))
    assert half == pytest.approx(2.2010 * np.sqrt(sample / 12), rel=1e-4)
    assert between[0] == pytest.approx(np.sqrt(sample * 11 / 21.920), rel=1e-4)
    assert between[1] == pytest.approx(np.sqrt(sample * 11 / 3.8157), rel=1e-4)


def test_a_spread_smaller_than_the_calibrations_errors_begins_at_zero():
    rng = np.random.default_rng(6)
    values = rng.standard_normal((20, 1))
    low, high = lots.intervals(values, np.full((20, 1), 1.1), np.zeros(1))[2]
    assert low[0] == 0.0
    assert 0.0 < high[0] < 1.5


@pytest.mark.parametrize("kind", ["one", "no"])
def test_a_stranger_is_found_and_no_other(kind):
    rng = np.random.default_rng(7)
    maps = drawn_maps(rng, 20, kind)
    maps[4] += np.array([60.0, 90.0, -80.0, 70.0]) * (1.0 if kind == "no" else 0.2)
    values, own = read_maps(rng, maps)
    tests, fit = lots.count_shapes(values, own)
    assert tests[-1].shapes == (2 if kind == "one" else 3)
    found = lots.strangers(values, own, fit)
    assert found is not None
    chances, _ = found
    assert chances[4] < lots.LEVEL / 20
    assert np.delete(chances, 4).min() > lots.LEVEL / 20


def test_strangers_need_more_imus_than_coefficients():
    rng = np.random.default_rng(8)
    assert lots.strangers(*read_maps(rng, drawn_maps(rng, 7, "no")), None) is None
    assert lots.strangers(*read_maps(rng, drawn_maps(rng, 8, "no")), None) is not None


def test_two_groups_are_found_and_one_is_none():
    rng = np.random.default_rng(9)
    maps = drawn_maps(rng, 24, "one")
    values, own = read_maps(rng, maps)
    assert lots.groups(values, own, lots.restricted_likelihood(values, own)) is None
    maps[15:] += np.array([10.0, -25.0, 5.0, 0.0])
    values, own = read_maps(rng, maps)
    found = lots.groups(values, own, lots.restricted_likelihood(values, own))
    assert found is not None
    assert found.chance < lots.LEVEL
    assert len(set(found.members[:15])) == len(set(found.members[15:])) == 1
    assert found.members[0] != found.members[-1]


def test_what_may_be_beyond_the_shapes_covers_what_is():
    """A rest of 0.5 deg/h in every coefficient is within the bound, which is not many times as large."""
    rng, covered = np.random.default_rng(10), 0
    for _ in range(40):
        values, own = read_maps(rng, drawn_maps(rng, 16, "one") + 0.5 * rng.standard_normal((16, 4)))
        bound = lots.rest_bound(lots.low_rank(values, own, 1), values, own)
        assert bound < 3.0
        covered += bound > 0.5
    assert covered >= 35


def test_the_next_imu_is_as_predicted():
    """Whitened by the mean square that a lot predicts, an IMU of the type has a mean square of at most 1 in every
    direction, and along the shapes' not much less."""
    rng, squares = np.random.default_rng(11), []
    for _ in range(60):
        values, own = read_maps(rng, drawn_maps(rng, 16, "one"))
        root = np.linalg.cholesky(lots.next_covariance(lots.low_rank(values, own, 1), values, own))
        drawn = np.linalg.solve(root, drawn_maps(rng, 50, "one").T)
        squares.append(drawn @ drawn.T / 50)
    largest = np.linalg.eigvalsh(np.mean(squares, axis=0))
    assert 0.8 < largest[-1] < 1.15
    assert MEAN @ MEAN > 100.0
