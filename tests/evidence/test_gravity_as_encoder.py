"""IMUs without an encoder: a box that a hand turns, simulated by physics (`unguided`), against what the plan predicts.

`NEES` is the squared error of all of an IMU's coefficients in units of their covariance, χ² with as many degrees of
freedom where the covariance is true: the errors that the difference of what the model expects of truth and estimate
amounts to (`matrix_errors.by_data`). Without an encoder a plan hardly tells how all sensors are turned together, which
times misalignments changes the coefficients of scale factors; a correction by the whole matrix is right all the same.
So scale factors are judged by what a correction leaves of a rate along each axis.
"""

import time
from dataclasses import dataclass

import numpy as np
import pytest
from evidence_report import ReportTable
from matrix_errors import along_after_correction, by_data
from scipy.stats import chi2
from unguided import recorded

import gradcal_jax as gj
from gradcal_jax.estimation.estimate import with_options
from gradcal_jax.estimation.fit_of_log import fit_readings
from gradcal_jax.estimation.log_rows import Options, imu_rows
from gradcal_jax.information.plan_information import imu_posterior
from gradcal_jax.model.build import build_imu

# How far off the plan's angle each turn ends, deg (standard deviation).
SPOILT = (1.0, 5.0, 45.0)
# Enough for a band of the mean NEES of 7 %.
IMUS = 30
# Of the plan's temperature.
ENDS_C = np.array([10.0, 40.0])


def scene() -> gj.Spec:
    # The slope of the temperature where it turns is a matter of its own.
    without = {"sensor.thermal_lag": None, "sensor.gyro.bias_temperature_gradient": None}
    way, back = ({"ramp_to": f"{end} degC", "rate": "5.5 K/min"} for end in (40, 10))
    programme = [{"soak": "2 min", "at": "10 degC"}, way, {"soak": "1 min"}, back, {"soak": "1 min"}, way]
    return gj.changed(gj.parse_spec(gj.presets.text("no-encoder")), without | {"plan.programme": programme})


@dataclass(frozen=True)
class Judged:
    """One IMU's estimate against its truth: χ² of its own coefficients and degrees of freedom, by three ways; `sigma`
    of what a correction leaves over the predicted; and χ² of the fit over its degrees of freedom."""

    chi_squared: dict[str, tuple[float, int]]
    sigma: np.ndarray
    fit: float


def judged(spec: gj.Spec, seed: int, spoilt: float) -> Judged:
    built = build_imu(spec)
    log, truth = recorded(spec, seed, spoilt)
    _, options, _ = with_options(spec, [log], Options())
    rows, _ = imu_rows(built, [log], log.units[0], options)
    fit = fit_readings(built, log.units[0], rows, rows.temperature_c)
    model, solution = built.model, fit.solution
    own = slice(model.calibrated)
    covariance = solution.known.covariance(model.to_reported)[own, own]
    by = by_data(fit, truth, model.names()[own], covariance)
    true = np.linalg.solve(model.to_reported, np.array([truth[name] for name in model.names()]))
    errors, slopes = along_after_correction(model, solution.parameters, true, ENDS_C)
    known = slopes @ solution.known.covariance(np.eye(model.size)) @ slopes.T
    sigma = np.sqrt(np.diag(known))
    along = float(errors / sigma @ np.linalg.solve(known / np.outer(sigma, sigma), errors / sigma))
    ideal = np.zeros(model.size)
    predicted = imu_posterior(built).deviations(along_after_correction(model, ideal, ideal, ENDS_C)[1])
    count = model.calibrated
    ways = {"NEES": (by.nees, count), "by data": (by.squares, count), "NEES, scale factors": (along, len(errors))}
    return Judged(ways, sigma / predicted, float(solution.chi_squared / solution.degrees))


_HEAD = """# IMUs without an encoder

Made by `pytest -m evidence tests/evidence/test_gravity_as_encoder.py`: simulated IMUs of the preset `no-encoder`,
turned by hand; every turn ends off the plan's angle by a draw of the stated standard deviation. NEES: mean, with the 95
% band
of it, of all of an IMU's coefficients, by what the model expects of truth and estimate; by data: χ² of the truth by the
log alone; scale factors: of what a correction leaves of a rate along each gyro, 10 and 40 °C, which, unlike the
coefficients, does not depend on how all sensors are turned together.
"""
_COLUMNS = (
    "spoilt by, deg",
    "IMUs",
    "NEES",
    "by data",
    "NEES, scale factors",
    "σ over the predicted",
    "χ² over degrees",
)
REPORT = ReportTable("gravity", _HEAD, _COLUMNS, foot=lambda _: time.strftime("%Y-%m-%d"))


@pytest.mark.evidence
@pytest.mark.parametrize("spoilt", SPOILT)
def test_imus_turned_by_hand_are_as_well_known_as_predicted(spoilt):
    """Mean NEES, the data's χ² of the truth, and NEES of the scale factors within their 95 % bands; σ within 10 % of
    the prediction; no residual larger than the noise."""
    imus = [judged(scene(), 1000 * SPOILT.index(spoilt) + k, spoilt) for k in range(IMUS)]
    cells, beyond = [], []
    for way, (_, degrees) in imus[0].chi_squared.items():
        mean = float(np.mean([imu.chi_squared[way][0] for imu in imus]))
        low, high = chi2.ppf([0.025, 0.975], degrees * IMUS) / IMUS
        cells.append(f"{mean:.2f} ({low:.2f} … {high:.2f})")
        beyond += [] if low < mean < high else [way]
    sigma = np.mean([imu.sigma for imu in imus], axis=0)
    fit = float(np.mean([imu.fit for imu in imus]))
    REPORT.put((f"{spoilt:g}", IMUS, *cells, f"{sigma.min():.3f} … {sigma.max():.3f}", f"{fit:.4f}"))
    assert not beyond, cells
    assert np.all(np.abs(sigma - 1.0) < 0.1)
    assert abs(fit - 1.0) < 0.02
