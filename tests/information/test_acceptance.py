"""`validate` judges the targets of a calibration by what was measured: simple acceptance; and so do predictions."""

import numpy as np
import pytest
from report_samples import calibration, recipe

import gradcal_jax as gj
from gradcal_jax.estimation.validation import AxisValidation, Cell, acceptances
from gradcal_jax.information import statistic
from gradcal_jax.information.residual import residual_of
from gradcal_jax.information.verdicts import decision_rule, limit_of, verdict_of
from gradcal_jax.model.build import build_imu


@pytest.fixture(scope="module")
def made():
    return calibration(recipe())


def judged(made, cells, **changes):
    """The verdict on a target of 100 ppm, for cells of (mean error, scatter, how many)."""
    result = made.result[0].model_copy(update={"target": 100.0, **changes})
    rows = tuple(Cell((20.0, 26.0), (-1.0, 1.0), n, 0.0, error, scatter, "ppm") for error, scatter, n in cells)
    found = AxisValidation("x", 10, 0, {}, rows, {}, ())
    return acceptances(made.model_copy(update={"result": (result,)}), [found])


def test_the_error_alone_counts(made):
    (row,) = judged(made, [(99.0, 500.0, 4)])
    assert row.verdict == "met"
    # The scatter is a population's about its own mean: its mean's standard error is that over √(n − 1).
    assert row.std == pytest.approx(500.0 / np.sqrt(3.0))
    (row,) = judged(made, [(101.0, 0.1, 400)])
    assert row.verdict == "missed"


def test_the_cell_in_doubt_decides_and_single_moves_do_not(made):
    (row,) = judged(made, [(10.0, 5.0, 10), (98.0, 20.0, 10), (500.0, 0.0, 1)])
    assert (row.error, row.verdict) == (98.0, "met")
    assert judged(made, [(500.0, 0.0, 1)]) == []
    assert judged(made, [(10.0, 5.0, 10)], target=None) == []


MAP = np.array([[1.0, 2.0], [3.0, 2.0]])


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({}, "met"),
        ({"coverage": 2.0}, "missed"),
        ({"coverage": 2.0, "target": "5 ppm"}, "met"),
    ],
)
def test_a_verdict_follows_its_rule_and_says_it(keys, said):
    """The map's mean of max is 2.5 ppm."""
    spec = gj.parse_spec(gj.presets.text("paper-dynamic-gradient"))
    keys = {"target": "2.6 ppm", "coverage": None} | keys
    requirement = gj.changed(spec, {f"requirement[0].{k}": v for k, v in keys.items()}).requirement[0]
    assert verdict_of(requirement, lambda name: statistic(name, MAP)) == said
    assert "simple acceptance" in decision_rule(requirement)
    name, limit = limit_of(requirement)
    assert name == "mean of max"
    assert limit == pytest.approx(float(requirement.target) * 1e6 / requirement.coverage)


def test_a_sweep_of_requirements_does_not_keep_all_of_their_grids():
    """Megabytes each, of a model that is the same at every point."""
    spec, models = gj.parse_spec(gj.presets.text("paper-dynamic-gradient")), set()
    for k in range(100):
        built = build_imu(gj.changed(spec, {"requirement[0].target": f"{50 + k} ppm"}))
        models.add(id(built.model))
        residual_of(built, built.spec.requirement[0])
    assert len(models) == 1
    assert len(vars(built.model)["_grids"]) < 50
