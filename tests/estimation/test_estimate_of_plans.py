"""The paper's plans, simulated for a thousand units in one batch: errors as large as said, covariance as predicted."""

import numpy as np
import pytest
from expected_errors import nees_band, normalised_errors, on_trajectory, solve, whitened

from gradcal_jax.information import contrasts, information, posterior, residual, simulate_noise, statistic
from gradcal_jax.information.imu_residual import box
from gradcal_jax.information.verdicts import UNIT_OF
from gradcal_jax.model.build import assemble
from gradcal_jax.spec import presets
from gradcal_jax.spec.spec import parse_spec

UNITS = 1000


def simulated(name, units, seed=0):
    """Spec, model, observations and the truth that made them: typical maps, noise drawn from the plan's own system."""
    spec = parse_spec(presets.text(name))
    built = assemble(spec)
    line = built.trajectory()
    rng = np.random.default_rng(seed)
    observations = on_trajectory(line, built.model, np.zeros((line.piece_count, units)))
    size = 1e-3 if built.model.bias is None else 1e-4
    truth = size * rng.standard_normal((units, built.model.size))
    readings = observations.columns @ truth.T + simulate_noise(observations.steps, units, rng)
    return built, observations._replace(readings=readings), truth


@pytest.mark.parametrize(
    "name",
    [
        "paper-static-standard",
        *(
            pytest.param(name, marks=pytest.mark.evidence)
            for name in ("paper-dynamic-gradient", "paper-dynamic-standard", "paper-static-gradient")
        ),
    ],
)
def test_a_thousand_units_err_as_predicted(name):
    built, observations, truth = simulated(name, UNITS)
    result = solve(whitened(observations, built.model))

    # The covariance is the prediction's own, to rounding.
    predicted = posterior(information(built.trajectory(), built.model))
    reported = built.model.to_reported
    ours, theirs = result.known.covariance(reported), predicted.covariance(reported)
    scale = np.sqrt(np.outer(np.diag(theirs), np.diag(theirs)))
    assert np.max(np.abs(ours - theirs) / scale) < 1e-8

    # Mean squared normalised error, and the fit's own chi-square, within their 99 % bands.
    p = truth.shape[1]
    low, high = nees_band(UNITS, p)
    assert low < np.mean(normalised_errors(result, truth)) / p < high
    low, high = nees_band(UNITS, result.degrees)
    assert low < np.mean(result.chi_squared) / result.degrees < high

    # What is left of the maps is what was promised.
    errors = result.parameters.T - truth
    for requirement in built.spec.requirement:
        temperatures, rates = box(requirement)
        grid_t, grid_w = np.meshgrid(temperatures, rates, indexing="ij")
        quantity = requirement.quantity.removeprefix("gyro_")
        promised = residual(predicted, built.model, quantity, temperatures, rates) * UNIT_OF[quantity][1]
        rows = contrasts(built.model, quantity, grid_t.ravel(), grid_w.ravel())[0]
        achieved = np.sqrt(np.mean((errors @ rows.T) ** 2, axis=0)).reshape(grid_t.shape) * UNIT_OF[quantity][1]
        want = statistic(requirement.statistic, promised)
        assert statistic(requirement.statistic, achieved) == pytest.approx(want, rel=0.05)
