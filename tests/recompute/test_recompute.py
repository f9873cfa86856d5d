"""What `predict` leaves against dense generalised least squares from the core's arrays alone: no filter, no factor.

`tests/imu/reference_imu.py` computes columns and noise anew from the motion.
"""

import numpy as np
import pytest

from gradcal_jax.information import imu_system
from gradcal_jax.information.gears import rows_of_gears
from gradcal_jax.information.noise_steps import NoiseSteps
from gradcal_jax.information.prediction import predict
from gradcal_jax.model.build import build_imu
from gradcal_jax.spec import presets
from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.spec import parse_spec

PLANS = (
    "accelerometer-24-positions",
    "accelerometer-six-positions-toured",
    "ferraris",
    "ferraris, geared",
    "nineteen-positions",
    "paper-dynamic-standard",
    "paper-static-standard",
)


def covariance_of(steps: NoiseSteps) -> np.ndarray:
    """Covariance `(N, N)` of all readings, forward through the steps."""
    count, n = steps.observation.shape
    # `seen[:k]`: covariance of the readings so far with the present state.
    seen, state, whole = np.zeros((count, n)), np.asarray(steps.initial), np.zeros((count, count))
    for k in range(count):
        f, h = steps.transition[k], steps.observation[k]
        seen, state = seen @ f.T, f @ state @ f.T + steps.covariance[k]
        whole[k, :k] = whole[:k, k] = seen[:k] @ h
        whole[k, k] = h @ state @ h + steps.reading_variance[k]
        seen[k] = state @ h
    return whole


def deviations(spec) -> dict[str, float]:
    """Standard deviations of a spec's parameters (SI)."""
    built = build_imu(spec)
    nodes, model = built.body_nodes(), built.model
    errors, common = rows_of_gears(built.motion, model, nodes, built.gears)
    steps, columns = imu_system(built.motion, model, nodes, common=common)
    used, beside = np.asarray(steps.used), len(errors)
    dense, columns = covariance_of(steps)[np.ix_(used, used)], np.asarray(columns)[used]
    prior = model.prior_rows()
    information = columns.T @ np.linalg.solve(dense, columns)
    information[:beside, :beside] += np.eye(beside)
    information[beside:, beside:] += prior.T @ prior
    scale = np.sqrt(np.diagonal(information))
    covariance = np.linalg.inv(information / np.outer(scale, scale)) / np.outer(scale, scale)
    reported = np.asarray(model.to_reported)
    variance = np.diagonal(reported @ covariance[beside:, beside:] @ reported.T)
    return dict(zip(model.names(), np.sqrt(variance), strict=True))


@pytest.mark.parametrize("name", PLANS)
def test_a_prediction_is_dense_least_squares(name):
    preset, _, geared = name.partition(", ")
    spec = parse_spec(presets.text(preset))
    if geared:
        sizes = {"scale_error": "200 ppm", "backlash": "0.02 deg"}
        spec = changed(spec, {f"rig.table.axis[0].angle.{of}": size for of, size in sizes.items()})
    expected = deviations(spec)
    said = {parameter.name: parameter.std for parameter in predict(spec).parameters}
    assert said.keys() <= expected.keys()
    for key, value in said.items():
        assert value == pytest.approx(expected[key], rel=1e-10), key
