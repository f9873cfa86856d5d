"""Simulated IMUs that a hand turns without an encoder (`unguided`), each estimated: one share of many.

`PYTHONPATH=.:tests python tests/evidence/gravity_units.py --spoilt 1 --first 0 --count 25 FOLDER` writes one file;
`pytest -m evidence tests/evidence/test_gravity_as_encoder.py` judges those of `experiments/evidence/gravity` and writes
the report.
"""

import argparse
import json
from functools import cache
from pathlib import Path
from typing import Any

import jax
import numpy as np
from matrix_errors import along_after_correction, by_data
from unguided import recorded

import gradcal_jax as gj
from gradcal_jax.estimation.estimate import with_options
from gradcal_jax.estimation.fit_of_log import fit_readings
from gradcal_jax.estimation.log_rows import Options, imu_rows
from gradcal_jax.model.imu_build import build_imu, imu_posterior
from gradcal_jax.spec import presets
from gradcal_jax.spec.spec_sections import Spec

# How far off the plan's angle each turn ends, deg (standard deviation).
SPOILT = (1.0, 5.0, 45.0)
# Of the plan's temperature.
ENDS_C = np.array([10.0, 40.0])


@cache
def scene() -> Spec:
    # The slope of the temperature where it turns is a matter of its own.
    without = {"sensor.thermal_lag": None, "sensor.gyro.bias_temperature_gradient": None}
    way, back = ({"ramp_to": f"{end} degC", "rate": "5.5 K/min"} for end in (40, 10))
    programme = [{"soak": "2 min", "at": "10 degC"}, way, {"soak": "1 min"}, back, {"soak": "1 min"}, way]
    return gj.changed(gj.parse_spec(presets.text("no-encoder")), without | {"plan.programme": programme})


def outcome(spec: Spec, seed: int, spoilt: float) -> dict[str, Any]:
    """One IMU's estimate against its truth: NEES of its own coefficients by the data; of what a
    correction leaves of a rate along the gyros, at both ends of the temperature: NEES, errors in σ, σ over the
    predicted; and χ² of the fit over its degrees of freedom."""
    built = build_imu(spec)
    log, truth = recorded(spec, seed, spoilt)
    _, options, _ = with_options(spec, [log], Options())
    rows, _ = imu_rows(built, [log], log.units[0], options)
    fit = fit_readings(built, log.units[0], rows, rows.temperature_c)
    model, found = built.model, fit.solution.parameters
    reported, own = model.to_reported, slice(model.calibrated)
    true = np.array([truth[name] for name in model.names()])
    covariance = fit.solution.known.covariance(reported)
    by = by_data(fit, truth, model.names()[own], covariance[own, own])
    errors, slopes = along_after_correction(model, found, np.linalg.solve(reported, true), ENDS_C)
    known = slopes @ fit.solution.known.covariance(np.eye(model.size)) @ slopes.T
    sigma = np.sqrt(np.diag(known))
    ideal = np.zeros(model.size)
    predicted = imu_posterior(built).deviations(along_after_correction(model, ideal, ideal, ENDS_C)[1])
    of = fit.solution.estimate
    return {
        "seed": seed, "nees": by.nees, "squares": by.squares,
        "nees_scale": float(errors / sigma @ np.linalg.solve(known / np.outer(sigma, sigma), errors / sigma)),
        "scale": (errors / sigma).tolist(), "sigma": (sigma / predicted).tolist(),
        "residual": float(of.chi_squared / of.degrees), "coefficients": model.calibrated,
    }  # fmt: skip


def main() -> None:
    """One share."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--spoilt", type=float, choices=SPOILT, required=True)
    parser.add_argument("--first", type=int, required=True)
    parser.add_argument("--count", type=int, required=True)
    chosen = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    seeds = [1000 * SPOILT.index(chosen.spoilt) + k for k in range(chosen.first, chosen.first + chosen.count)]
    chosen.folder.mkdir(parents=True, exist_ok=True)
    rows = [outcome(scene(), seed, chosen.spoilt) for seed in seeds]
    name = f"{chosen.spoilt:g}deg_{chosen.first:03d}.jsonl"
    (chosen.folder / name).write_text("".join(json.dumps(row) + "\n" for row in rows), encoding="utf-8")


if __name__ == "__main__":
    main()
