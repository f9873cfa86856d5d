"""`validate` judges the targets of a calibration by what was measured: simple acceptance, or with a guard band."""

import numpy as np
import pytest
from report_samples import calibration, recipe
from scipy.stats import norm

from gradcal_jax.estimation.validation import AxisValidation, Cell, acceptances


@pytest.fixture(scope="module")
def made():
    return calibration(recipe())


def judged(made, cells, **changes):
    """The verdict on a target of 100 ppm, for cells of (mean error, scatter, how many)."""
    result = made.result[0].model_copy(update={"target": 100.0, **changes})
    rows = tuple(Cell((20.0, 26.0), (-1.0, 1.0), n, 0.0, error, scatter, "ppm") for error, scatter, n in cells)
    found = AxisValidation("x", 10, 0, None, None, rows, {}, ())
    return acceptances(made.model_copy(update={"result": (result,)}), [found])


@pytest.mark.parametrize(
    ("error", "scatter", "n"), [(40.0, 60.0, 10), (-90.0, 30.0, 5), (99.0, 0.5, 50), (0.0, 80.0, 2)]
)
def test_risk_and_acceptance_limit_are_those_of_normal_errors(made, error, scatter, n):
    """Against SciPy's normal distribution: the risk at the acceptance limit is the one that was asked for."""
    (row,) = judged(made, [(error, scatter, n)], risk=0.05)
    # The scatter is a population's about its own mean: its mean's standard error is that over √(n − 1).
    std = scatter / np.sqrt(n - 1)
    assert row.std == pytest.approx(std)
    beyond = norm.sf((100.0 - error) / std) + norm.cdf((-100.0 - error) / std)
    assert row.specific_risk == pytest.approx(beyond, rel=1e-9, abs=1e-15)
    assert (row.verdict == "met") == (beyond <= 0.05)
    if row.acceptance is not None:
        at_limit = norm.sf((100.0 - row.acceptance) / std) + norm.cdf((-100.0 - row.acceptance) / std)
        assert at_limit == pytest.approx(0.05, rel=1e-6)
    else:
        assert 2.0 * norm.sf(100.0 / std) > 0.05


def test_without_a_risk_the_error_alone_counts(made):
    (row,) = judged(made, [(99.0, 500.0, 4)])
    assert (row.verdict, row.acceptance) == ("met", 100.0)
    (row,) = judged(made, [(101.0, 0.1, 400)])
    assert row.verdict == "missed"
    assert "simple acceptance" in row.rule


def test_the_cell_in_doubt_decides_and_single_moves_do_not(made):
    (row,) = judged(made, [(10.0, 5.0, 10), (98.0, 20.0, 10), (500.0, 0.0, 1)], risk=0.05)
    assert (row.error, row.verdict) == (98.0, "missed")
    assert judged(made, [(500.0, 0.0, 1)], risk=0.05) == []
    assert judged(made, [(10.0, 5.0, 10)], target=None) == []


def test_no_more_than_the_stated_risk_of_what_is_accepted_is_beyond_the_target(made):
    """Errors of many units, flat about the target, each measured with noise: of those accepted, the share beyond it."""
    rng = np.random.default_rng(5)
    true = rng.uniform(50.0, 150.0, 20_000)
    std = 10.0
    measured = true + std * rng.standard_normal(true.shape)
    (row,) = judged(made, [(0.0, std * np.sqrt(9.0), 10)], risk=0.05)
    assert row.std == pytest.approx(std)
    near = np.abs(measured - row.acceptance) < 1.0
    # At the limit itself the share is the risk; well within it is less.
    share = np.mean(true[near] > 100.0)
    assert share == pytest.approx(0.05, abs=3.0 * np.sqrt(0.05 * 0.95 / near.sum()) + 0.01)
    assert np.mean(true[measured <= row.acceptance] > 100.0) < 0.05
