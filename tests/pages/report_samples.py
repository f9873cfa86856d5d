"""A small recipe, the rehearsed run of it, and a calibration of known numbers: pages of them take no minute."""

import tomllib
from pathlib import Path

import numpy as np

from gradcal_jax.calibration.file import FORMAT, ORDER, Calibration
from gradcal_jax.design.recipe_of_plan import make_recipe
from gradcal_jax.hardware import execute
from gradcal_jax.recipe.recipe import Recipe
from gradcal_jax.spec import presets
from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.spec import Spec, parse_spec
from gradcal_jax.tables.writing import write_toml

CHANGES = """
title = "A small plan <of & for> a page"
"sensor.gyro.scale_factor.temperature.degree" = 1
"sensor.gyro.scale_factor.rate.degree" = 1
"sensor.gyro.scale_factor.prior" = "5000 ppm"
"rig.table.axis[0].max_acceleration" = "300 deg/s^2"
"plan.temperature" = ["20 degC", "26 degC"]
"plan.soak" = "60 s"
["sensor.gyro.bias"]
temperature = { degree = 1, centre = "20 degC", scale = "50 K" }
prior = "200 deg/h"
["plan.cycle"]
moves = [
  { rest = "5 s", read_every = "1 s" },
  { turn = "720 deg", peak_rate = "200 deg/s", shape = "cosine ramps" },
  { rest = "5 s", read_every = "1 s" },
  { turn = "-720 deg", peak_rate = "100 deg/s", shape = "cosine ramps" },
]
[[requirement]]
name = "all rates"
quantity = "gyro_scale_factor"
temperature = ["20 degC", "26 degC"]
rate = ["-200 deg/s", "200 deg/s"]
target = "2000 ppm"
grid = [11, 21]
[[requirement]]
name = "slow"
quantity = "gyro_scale_factor"
temperature = ["21 degC", "25 degC"]
rate = ["-50 deg/s", "50 deg/s"]
grid = [5, 11]
[[requirement]]
name = "at rest"
quantity = "gyro_bias"
temperature = ["20 degC", "26 degC"]
grid = [11]
"""


def spec(**changes: object) -> Spec:
    """The paper's sensor with maps of degree one, for six minutes at room temperature."""
    return changed(parse_spec(presets.text("paper-dynamic-gradient")), tomllib.loads(CHANGES) | changes)


def recipe() -> Recipe:
    """Of `spec`, as it stands."""
    record = {"objective": "all rates (mean of max)", "unit": "ppm", "now": 3.25}
    return make_recipe(spec()).model_copy(update={"optimisation": record})


def write(folder: Path) -> None:
    """The recipe, its run on simulated devices, and the calibration in the run's folder."""
    made = recipe()
    write_toml(made, folder / "recipe.toml")
    result = execute.run(made, folder / "run", simulate=True, seed=3)
    assert result.exit_status == "success", result.reason
    write_toml(calibration(made), folder / "run/calibration.toml")


def calibration(made: Recipe, seed: int = 7) -> Calibration:
    """Coefficients and covariance of the recipe's bases, drawn; their results are those of that covariance."""
    random = np.random.default_rng(seed)
    sensor = made.spec.sensor.gyro
    bias, scale = ["a0", "a1"], ["b00", "b10", "b01", "b11"]
    sizes = np.array([1e-4] * len(bias) + [1e-3] * len(scale))
    values = sizes * random.standard_normal(len(sizes))
    mixed = random.standard_normal((len(sizes), 2 * len(sizes)))
    covariance = np.outer(sizes, sizes) * 1e-3 * (mixed @ mixed.T)
    tables = tomllib.loads(CALIBRATION)
    of_bias, of_scale = tables["channel"][0]["term"]
    of_bias |= {"temperature": sensor.bias.temperature}
    of_scale |= {"temperature": sensor.scale_factor.temperature, "rate": sensor.scale_factor.rate}
    of_bias["coefficients"] = dict(zip(bias, values[: len(bias)].tolist(), strict=True))
    of_scale["coefficients"] = dict(zip(scale, values[len(bias) :].tolist(), strict=True))
    names = [f"gyro_x.{name}" for name in (*bias, *scale)]
    tables["covariance"] = {"names": names, "matrix": tuple(map(tuple, covariance.tolist()))}
    tables["provenance"]["recipe"] = made.fingerprint
    return Calibration.model_validate(tables | {"format": FORMAT, "title": made.title, "order": ORDER})


CALIBRATION = """
serial_number = "unit <7>"
simulated = true
frame = "the sensor's own axes x"
noise = { angle_random_walk = "0.1 deg/sqrt(h)" }
provenance = { program = "gradcal", estimator = "least squares" }
[[channel]]
kind = "gyro"
axis = "x"
valid_temperature = ["20 degC", "26 degC"]
valid_rate = ["-200 deg/s", "200 deg/s"]
term = [{ name = "bias", unit = "rad/s" }, { name = "scale_factor", unit = "1", signals = ["rate x"] }]
[[result]]
name = "all rates"
axis = "x"
quantity = "gyro_scale_factor"
statistic = "mean of max, 1 sigma"
value = 123.456
unit = "ppm"
target = 2000.0
verdict = "met"
"""
