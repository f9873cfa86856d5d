"""Heading and north through the program: predicted, weighed, designed for, bounded, swept, drawn and reported."""

import json
from pathlib import Path

import numpy as np
import pytest

import gradcal_jax as gj
from gradcal_jax.design.plan_objective import ExactObjective
from gradcal_jax.information import prediction
from gradcal_jax.information.error_budget import ErrorBudget
from gradcal_jax.information.sensitivity import sensitivity
from gradcal_jax.model.build import build_imu, imu_posterior
from gradcal_jax.recipe.recipe import parse_recipe
from gradcal_jax.spec.changes import changed, tables_of
from gradcal_jax.spec.spec import read_spec, spec_of
from gradcal_jax.tables.writing import to_toml

FOLDER = Path(__file__).parents[2] / "experiments/missions"
HOVER = "time (s), rate (deg/s), temperature (degC)\n0, 0, 20\n100, 30, 25\n200, -20, 26\n600, 0, 30\n"
SPIN = "time (s), rate (deg/s), temperature (degC)\n0, 100, 30\n300, 100, 35\n"
BIAS = {"name": "n", "quantity": "gyro_bias", "temperature": ["0 degC", "40 degC"]}


def with_requirements(*rows, design=None):
    tables = tables_of(read_spec(FOLDER / "ppm.toml"))
    tables["requirement"] = [*tables["requirement"], *rows]
    tables["design"] = {**tables["design"], **(design or {})}
    return spec_of(tables)


def heading(*missions, **more):
    return {"name": "h", "quantity": "mission_heading", "mission": list(missions), **more}


def hover(**more):
    return {"file": "hover.csv", "table": HOVER, **more}


def spin(**more):
    return {"file": "spin.csv", "table": SPIN, **more}


def row_of(spec, name="h"):
    return next(row for row in gj.predict(spec).requirements if row.name == name)


def test_several_missions_are_weighed():
    one, two = (row_of(with_requirements(heading(m))) for m in (hover(), spin()))
    both = row_of(with_requirements(heading(hover(weight=3.0), spin())))
    assert both.rms == pytest.approx(np.sqrt((3.0 * one.rms**2 + two.rms**2) / 4.0))
    assert both.own == pytest.approx(np.sqrt((3.0 * one.own**2 + two.own**2) / 4.0))
    assert both.max == pytest.approx(max(one.rms, two.rms))
    assert [m.left for m in both.missions] == pytest.approx([one.rms, two.rms])
    worst = row_of(with_requirements(heading(hover(), spin(), statistic="max")))
    assert worst.decisive == pytest.approx(max(one.rms, two.rms))
    assert worst.own == pytest.approx(max(m.own for m in worst.missions))
    # The search sees what the prediction says.
    spec = with_requirements(heading(hover(weight=3.0), spin()), design={"minimise": "h"})
    of = ExactObjective(spec)
    assert of.shown(of.residuals(spec)) == pytest.approx(both.rms, rel=1e-9)


def test_shares_and_elasticities_add_up():
    spec = with_requirements(heading(hover(weight=2.0), spin()), BIAS)
    built = build_imu(spec)
    sources = ErrorBudget(built, imu_posterior(built))
    for requirement in built.spec.requirement:
        shares = sources.shares(requirement)
        assert sum(shares.values()) == pytest.approx(1.0, abs=0.01)
    # Twice the drift alone, by differences.
    found = {r.figure: r.percent for r in sensitivity(spec).rows if r.requirement == "h"}
    more = changed(spec, {"sensor.gyro.drift[0].standard_deviation": "0.5005 deg/h"})
    assert np.log(row_of(more).rms / row_of(spec).rms) / np.log(1.001) == pytest.approx(
        found["bias instability"], abs=2e-3
    )


def test_simulated_calibrations_count_missions():
    spec = with_requirements(heading(hover(), spin(weight=2.0), target="1 deg", coverage=2.0), BIAS)
    rows = prediction.monte_carlo(spec, 400, 0)
    for row in rows:
        assert row.simulated == pytest.approx(row.predicted, rel=0.12)


def test_a_recipe_and_a_sweep_stand_alone(tmp_path, monkeypatch):
    (tmp_path / "hover.csv").write_text(HOVER, encoding="utf-8")
    text = to_toml(with_requirements()).replace(
        "[plan]\n", '[[requirement]]\nname = "h"\nquantity = "mission_heading"\nmission = "hover.csv"\n\n[plan]\n', 1
    )
    (tmp_path / "spec.toml").write_text(text, encoding="utf-8")
    made = gj.make_recipe(read_spec(tmp_path / "spec.toml"))
    (tmp_path / "hover.csv").unlink()
    monkeypatch.chdir(tmp_path)
    again = parse_recipe(to_toml(made))
    assert again == made
    assert again.fingerprint == made.fingerprint
    (row,) = (r for r in again.prediction.requirements if r.name == "h")
    assert row_of(again.spec).rms == pytest.approx(row.rms)
    (tmp_path / "recipe.toml").write_text(to_toml(made), encoding="utf-8")
    (tmp_path / "sweep.toml").write_text(
        'format = "gradcal-sweep/1"\nbase = "recipe.toml"\n[[axis]]\nkey = "sensor.gyro.drift[0].standard_deviation"\n'
        'values = ["0.5 deg/h", "1 deg/h"]\n',
        encoding="utf-8",
    )
    from gradcal_jax.sweeps.sweep import changes_of, evaluate, points_of
    from gradcal_jax.sweeps.sweep_file import read_sweep

    job = read_sweep(tmp_path / "sweep.toml")
    base = json.dumps(tables_of(job.base))
    first, second = (evaluate("predict", base, changes_of(job, point)) for point in points_of(job)[1])
    (at,) = (k for k, r in enumerate(job.base.requirement) if r.name == "h")
    assert first[f"{at} rms"] == pytest.approx(row.rms)
    assert second[f"{at} rms"] > first[f"{at} rms"]


def test_a_mission_alone_in_a_design_says_what_it_lacks():
    flat = changed(
        read_spec(FOLDER / "ppm.toml"), {"sensor.gyro.bias.prior": None, "sensor.gyro.scale_factor.prior": None}
    )
    tables = tables_of(flat)
    tables["requirement"] = [heading(spin())]
    tables["design"] |= {"minimise": "h"}
    assert np.isfinite(row_of(spec_of(tables)).rms)
    hidden = {"standard_deviation": "20 ppm", "temperature_degree": 5, "rate_degree": 5}
    more = changed(spec_of(tables), {"sensor.gyro.scale_factor.discrepancy": hidden})
    assert row_of(more).rms > row_of(spec_of(tables)).rms
    assert json.loads(gj.predict(more).model_dump_json())["requirements"][0]["missions"][0]["file"] == "spin.csv"
