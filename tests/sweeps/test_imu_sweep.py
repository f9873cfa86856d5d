"""Sweeps over the spec of a whole unit: the numbers are predict's, with their units; what is not swept is said."""

import numpy as np
import pytest

import gradcal_jax as gj
from gradcal_jax.spec.changes import tables_of
from gradcal_jax.sweeps.dataset import dataset_of
from gradcal_jax.sweeps.evaluate import optimise_points, predict_points
from gradcal_jax.sweeps.points import Points
from gradcal_jax.sweeps.sweep import identity_of
from gradcal_jax.sweeps.sweep_file import parse_sweep

FILE = """format = "gradcal-sweep/1"
base = "accelerometer-six-positions"
[[axis]]
key = "rig.table.tilt"
values = ["10 urad", "1 mrad", "a lot"]
"""


pytestmark = pytest.mark.usefixtures("without_prices")


def test_a_sweep_predicts_the_points_of_a_unit_and_says_which_cannot_be():
    job = parse_sweep(FILE)
    assert isinstance(job.base, gj.Spec)
    points = Points(job)
    results = predict_points(tables_of(job.base), [(i, points.changes(i)) for i in range(len(points))])
    assert "rig.table.tilt" in results[2].failure
    data = dataset_of(job, points, tuple(results), identity_of(job))
    for i, tilt in enumerate(("10 urad", "1 mrad")):
        for row in gj.predict(gj.changed(job.base, {"rig.table.tilt": tilt})).requirements:
            variable = data[f"{row.name.replace(' ', '_')}_{row.statistic}"]
            assert variable.attrs["units"] == row.unit
            assert float(variable.values[i]) == pytest.approx(row.decisive, rel=1e-12)
            assert data[f"{row.name.replace(' ', '_')}_verdict"].values[i] == row.verdict
    assert np.isnan(data["accelerometer_bias_mean"].values[2])
    assert "accelerometer_bias_mean_of_max" not in data


@pytest.mark.long
def test_plans_of_imus_are_optimised_in_sweeps(monkeypatch):
    monkeypatch.setattr("gradcal_jax.design.optimise.EVALUATIONS", 60)
    job = parse_sweep(FILE.replace("[[axis]]", 'do = "optimise"\n[[axis]]'))
    first, wrong = optimise_points(tables_of(job.base), [(i, Points(job).changes(i)) for i in (0, 2)])
    assert "rig.table.tilt" in wrong.failure
    found = gj.parse_spec(first.spec)
    rows = gj.predict(found).requirements
    assert [r.values[2] for r in first.residuals] == pytest.approx([r.mean for r in rows], rel=1e-12)
    assert found.plan != job.base.plan
    assert first.before is not None
