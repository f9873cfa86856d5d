"""Heading after a mission: its functional against brute force, several missions, and files that stand alone."""

from pathlib import Path

import numpy as np
import pytest
from helpers import gyro_x, scale_map

import gradcal_jax as gj
from gradcal_jax import model
from gradcal_jax.information.missions import mission_row
from gradcal_jax.model import Bins, BSpline, Polynomial
from gradcal_jax.recipe.recipe import parse_recipe
from gradcal_jax.spec.changes import changed, tables_of
from gradcal_jax.spec.spec import read_spec, spec_of
from gradcal_jax.tables.writing import to_toml

PPM = read_spec(Path(__file__).parents[2] / "experiments/missions/ppm.toml")
FLIGHT = np.array([0.0, 40.0, 41.0, 90.0]), np.array([0.0, 2.0, -1.0, 0.5]), np.array([20.0, 20.0, 24.0, -5.0])
HOVER = {
    "file": "hover.csv",
    "table": "time (s), rate (deg/s), temperature (degC)\n0, 0, 20\n100, 30, 25\n200, -20, 26\n600, 0, 30\n",
}
SPIN = {"file": "spin.csv", "table": "time (s), rate (deg/s), temperature (degC)\n0, 100, 30\n300, 100, 35\n"}


def brute(of, steps: int = 200_001) -> np.ndarray:
    time, rate, temperature = FLIGHT
    t = np.linspace(0.0, time[-1], steps)
    values = of(np.interp(t, time, temperature), np.interp(t, time, rate))
    return np.sum(np.diff(t)[:, None] * (values[1:] + values[:-1]) / 2.0, axis=0)


@pytest.mark.parametrize(
    ("of_temperature", "of_rate", "tolerance"),
    [
        (Polynomial(3, 20.0, 50.0), Polynomial(3, 0.0, 5.0), 1e-8),
        (BSpline((-40.0, 0.0, 40.0), 3), BSpline((-5.0, 0.0, 5.0), 2), 1e-4),
        (Bins((-40.0, 0.0, 40.0)), Bins((-5.0, 0.0, 5.0)), 2e-3),
    ],
)
def test_the_row_is_an_integral_along_the_mission(of_temperature, of_rate, tolerance):
    hidden = (1e-5, 5, 5) if isinstance(of_rate, Polynomial) else None
    bias, scale = model.make_map(of_temperature), scale_map(of_temperature, of_rate, discrepancy=hidden)
    channel = gyro_x((bias, scale, model.GradientOfBias(std=np.ones(()), has_prior=True)))
    row = mission_row(channel, *FLIGHT)
    wanted = {
        "bias": brute(lambda t, w: bias.values(t, w)),
        "scale_factor": brute(lambda t, w: scale.values(t, w) * w[:, None]),
        "bias_temperature_gradient": np.array([-25.0]),
    }
    for name, values in wanted.items():
        np.testing.assert_allclose(row[channel.where(name)], values, rtol=tolerance, atol=tolerance * 90.0)


def with_missions(*missions, **more):
    tables = tables_of(PPM)
    tables["requirement"].append({"name": "h", "quantity": "mission_heading", "mission": list(missions), **more})
    return spec_of(tables)


def row_of(spec):
    return next(row for row in gj.predict(spec).requirements if row.name == "h")


def test_several_missions_count_by_their_root_mean_square_or_their_maximum():
    one, two = (row_of(with_missions(m)).rms for m in (HOVER, SPIN))
    both = row_of(with_missions(HOVER, SPIN))
    assert both.decisive == pytest.approx(np.hypot(one, two) / 2**0.5)
    assert row_of(with_missions(HOVER, SPIN, statistic="max")).decisive == pytest.approx(max(one, two))
    hidden = {"standard_deviation": "20 ppm", "temperature_degree": 5, "rate_degree": 5}
    more = changed(with_missions(SPIN), {"sensor.gyro.scale_factor.discrepancy": hidden})
    assert row_of(more).rms > two


def test_a_recipe_stands_alone(tmp_path, monkeypatch):
    (tmp_path / "hover.csv").write_text(HOVER["table"], encoding="utf-8")
    text = to_toml(PPM).replace(
        "[plan]\n", '[[requirement]]\nname = "h"\nquantity = "mission_heading"\nmission = "hover.csv"\n\n[plan]\n', 1
    )
    (tmp_path / "spec.toml").write_text(text, encoding="utf-8")
    made = gj.make_recipe(read_spec(tmp_path / "spec.toml"))
    (tmp_path / "hover.csv").unlink()
    monkeypatch.chdir(tmp_path)
    again = parse_recipe(to_toml(made))
    assert (again, again.fingerprint) == (made, made.fingerprint)
    (row,) = (r for r in again.prediction.requirements if r.name == "h")
    assert row_of(again.spec).rms == pytest.approx(row.rms)
