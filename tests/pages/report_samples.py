"""A small recipe, the rehearsed run of it, and a calibration of known numbers: pages of them take no minute."""

from pathlib import Path
from typing import Any

import numpy as np

from gradcal_jax.calibration import FORMAT, ORDER, Calibration
from gradcal_jax.design.recipe_of_plan import make_recipe
from gradcal_jax.hardware import execute
from gradcal_jax.recipe.recipe import Recipe
from gradcal_jax.spec import presets
from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.spec import Spec, parse_spec
from gradcal_jax.tables.writing import write_toml

TURN = {"turn": "720 deg", "peak_rate": "200 deg/s", "shape": "cosine ramps"}
BACK = {"turn": "-720 deg", "peak_rate": "100 deg/s", "shape": "cosine ramps"}


def spec(**changes: object) -> Spec:
    """The paper's sensor with maps of degree one, for six minutes at room temperature."""
    return changed(
        parse_spec(presets.text("paper-dynamic-gradient")),
        {
            "title": "A small plan <of & for> a page",
            "sensor.gyro.scale_factor.temperature.degree": 1,
            "sensor.gyro.scale_factor.rate.degree": 1,
            "sensor.gyro.scale_factor.prior": "5000 ppm",
            "sensor.gyro.bias": {
                "temperature": {"degree": 1, "centre": "20 degC", "scale": "50 K"},
                "prior": "200 deg/h",
            },
            "rig.table.axis[0].max_acceleration": "300 deg/s^2",
            "requirement": [
                {
                    "name": "all rates",
                    "quantity": "gyro_scale_factor",
                    "temperature": ["20 degC", "26 degC"],
                    "rate": ["-200 deg/s", "200 deg/s"],
                    "target": "2000 ppm",
                    "grid": [11, 21],
                },
                {
                    "name": "slow",
                    "quantity": "gyro_scale_factor",
                    "temperature": ["21 degC", "25 degC"],
                    "rate": ["-50 deg/s", "50 deg/s"],
                    "grid": [5, 11],
                },
                {"name": "at rest", "quantity": "gyro_bias", "temperature": ["20 degC", "26 degC"], "grid": [11]},
            ],
            "plan.temperature": ["20 degC", "26 degC"],
            "plan.soak": "60 s",
            "plan.cycle": {
                "moves": [{"rest": "5 s", "read_every": "1 s"}, TURN, {"rest": "5 s", "read_every": "1 s"}, BACK]
            },
            **changes,
        },
    )


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
    assert sensor is not None
    assert sensor.bias is not None
    assert sensor.scale_factor is not None
    bias, scale = ["a0", "a1"], ["b00", "b10", "b01", "b11"]
    sizes = np.array([1e-4] * len(bias) + [1e-3] * len(scale))
    values = sizes * random.standard_normal(len(sizes))
    mixed = random.standard_normal((len(sizes), 2 * len(sizes)))
    covariance = np.outer(sizes, sizes) * 1e-3 * (mixed @ mixed.T)
    tables: dict[str, Any] = {
        "format": FORMAT,
        "title": made.title,
        "serial_number": "unit <7>",
        "simulated": True,
        "frame": "the sensor's own axes x",
        "order": ORDER,
        "channel": [
            {
                "kind": "gyro",
                "axis": "x",
                "valid_temperature": ("20 degC", "26 degC"),
                "valid_rate": ("-200 deg/s", "200 deg/s"),
                "term": [
                    {
                        "name": "bias",
                        "unit": "rad/s",
                        "temperature": sensor.bias.temperature,
                        "coefficients": dict(zip(bias, values[: len(bias)].tolist(), strict=True)),
                    },
                    {
                        "name": "scale_factor",
                        "unit": "1",
                        "signals": ["rate x"],
                        "temperature": sensor.scale_factor.temperature,
                        "rate": sensor.scale_factor.rate,
                        "coefficients": dict(zip(scale, values[len(bias) :].tolist(), strict=True)),
                    },
                ],
            }
        ],
        "covariance": {
            "names": [f"gyro_x.{name}" for name in (*bias, *scale)],
            "matrix": tuple(map(tuple, covariance.tolist())),
        },
        "noise": {"angle_random_walk": "0.1 deg/sqrt(h)"},
        "result": [
            {
                "name": "all rates",
                "axis": "x",
                "quantity": "gyro_scale_factor",
                "statistic": "mean of max, 1 sigma",
                "value": 123.456,
                "unit": "ppm",
                "target": 2000.0,
                "verdict": "met",
            }
        ],
        "provenance": {"program": "gradcal", "estimator": "least squares", "recipe": made.fingerprint},
    }
    return Calibration.model_validate(tables)
