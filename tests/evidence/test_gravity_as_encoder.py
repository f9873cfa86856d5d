"""Units without an encoder: a box that a hand turns, simulated by physics (`unguided`), against what the plan predicts.

`NEES` is the squared error of all of a unit's coefficients in units of their covariance: χ² with as many degrees of
freedom where the covariance is true.
"""

import os
from functools import cache
from typing import NamedTuple

import numpy as np
import pytest
from scipy.stats import chi2
from unguided import recorded

import gradcal_jax as gj
from gradcal_jax.api.estimate import with_options
from gradcal_jax.api.estimate_options import Options
from gradcal_jax.api.fit_of_log import fitted_twice
from gradcal_jax.api.imu_build import build_imu, imu_posterior
from gradcal_jax.api.recorded_rows import imu_rows
from gradcal_jax.files import presets
from gradcal_jax.files.spec_sections import Spec

# How far off the plan's angle each turn ends, deg (standard deviation), and the units of each.
SPOILT = (1.0, 5.0, 45.0)
UNITS = int(os.environ.get("GRADCAL_UNITS", "100"))


class Outcome(NamedTuple):
    """One unit's estimate against its truth: NEES of its own coefficients; errors of the scale factors in σ; σ over the
    predicted; χ² of the fit over its degrees of freedom."""

    nees: float
    scale: np.ndarray
    sigma: np.ndarray
    residual: float


@cache
def scene() -> Spec:
    # The slope of the temperature where it turns is a matter of its own.
    without = {"sensor.thermal_lag": None, "sensor.gyro.bias_temperature_gradient": None}
    return gj.changed(gj.parse_spec(presets.text("no-encoder")), without)


def outcome(spec: Spec, seed: int, spoilt: float) -> Outcome:
    built = build_imu(spec)
    log, truth = recorded(spec, seed, spoilt)
    _, options, _ = with_options(spec, [log], Options())
    rows, _ = imu_rows(built, [log], log.units[0], options)
    solution = fitted_twice(built, log.units[0], rows, rows.temperature_c).solution
    model = built.model
    reported, own = model.to_reported, slice(model.calibrated)
    error = reported @ solution.parameters - np.array([truth[name] for name in model.names()])
    spread = (reported @ solution.known.spread)[own]
    sigma = np.sqrt(np.sum(spread**2, axis=1))
    white = np.linalg.solve(np.linalg.cholesky(spread @ spread.T / np.outer(sigma, sigma)), error[own] / sigma)
    predicted = imu_posterior(built).deviations(reported)[own]
    scales = [k for k, name in enumerate(model.names()) if name.startswith("gyro") and ".b0" in name]
    of = solution.estimate
    share = float(of.chi_squared[0] / of.degrees[0])
    return Outcome(float(white @ white), (error[own] / sigma)[scales], (sigma / predicted)[scales], share)


@pytest.mark.evidence
@pytest.mark.parametrize("spoilt", SPOILT)
def test_units_turned_by_hand_are_as_well_known_as_predicted(spoilt):
    """Mean NEES, and that of the scale factors, within their 95 % bands; σ within 10 % of the prediction; no residual
    larger than the noise."""
    spec = scene()
    found = [outcome(spec, 1000 * SPOILT.index(spoilt) + seed, spoilt) for seed in range(UNITS)]
    size = build_imu(spec).model.calibrated
    for values, degrees in (([o.nees for o in found], size), ([o.scale @ o.scale for o in found], None)):
        degrees = len(found[0].scale) if degrees is None else degrees
        low, high = chi2.ppf([0.025, 0.975], degrees * UNITS) / UNITS
        print(f"{spoilt} deg, {UNITS} units: mean {np.mean(values):.2f} of {degrees}, band {low:.2f} … {high:.2f}")
        if degrees == size:
            assert low < np.mean(values) < high
    ratio = np.mean([o.sigma for o in found], axis=0)
    residual = float(np.mean([o.residual for o in found]))
    print(f"sigma over predicted {ratio.min():.3f} … {ratio.max():.3f}; chi-squared over its degrees {residual:.4f}")
    assert np.all(np.abs(ratio - 1.0) < 0.1)
    assert abs(residual - 1.0) < 0.05
