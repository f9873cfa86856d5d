"""Gravity as the only reference of a table's angles: what a spec may say, what is predicted, counted and estimated."""

import numpy as np
import pytest
import unguided
from estimate_scenes import draw_truth, scene
from imu_twin import record

import gradcal_jax as gj
from gradcal_jax.estimation.estimate import estimate_sensors
from gradcal_jax.estimation.gravity_angles import angles_by_gravity
from gradcal_jax.estimation.imu_executed import ImuRows
from gradcal_jax.estimation.imu_solve import absorbed
from gradcal_jax.information import imu_system, whiten
from gradcal_jax.information.plan_information import imu_posterior
from gradcal_jax.model.build import build_imu
from gradcal_jax.motion import Geometry, frames
from gradcal_jax.records.log import LogError
from gradcal_jax.spec import presets
from gradcal_jax.tables.problems import SpecError

GRAVITY = {"reference": "gravity"}
PRESET = gj.parse_spec(presets.text("no-encoder"))


def without_encoder(spec):
    return gj.changed(spec, {f"rig.table.axis[{k}].angle": GRAVITY for k in range(len(spec.rig.table.axis))})


# --- files ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"rig.table.axis[0].angle.reading_noise": "1 deg"}, "is only for an encoder"),
        ({"rig.table.standing": "read"}, "is only for an encoder"),
        ({"sensor.accelerometer.axes": ["x", "y"]}, "accelerometers along x, y and z"),
        ({"plan.cycle.moves": [{"turn": "360 deg", "duration": "5 s", "shape": "hand", "axis": "axle"},
                               {"turn": "-360 deg", "duration": "5 s", "shape": "hand", "axis": "axle"},
                               {"rest": "2 s"}]},
         "there is no rest between"),
    ],
)  # fmt: skip
def test_what_needs_an_encoder_is_refused(change, said):
    with pytest.raises(SpecError, match=said):
        gj.changed(PRESET, change)


# --- prediction -------------------------------------------------------------------------------------------------------


def test_wide_noise_of_the_angles_is_as_free_parameters():
    """One reading for each standstill is absorbed, and the covariance is that of angles without a prior."""
    built = build_imu(PRESET)
    motion, model, nodes = built.motion, built.model, built.body_nodes()
    steps, columns = imu_system(motion, model, nodes)
    n = len(model.channels) + sum(c.processes.count for c in model.channels)
    lost = absorbed(steps, slice(n, n + 1))
    # Dense: the noise without the angles' own, and a column for every angle.
    still = steps._replace(covariance=np.array(steps.covariance), initial=np.array(steps.initial))
    count = len(steps.used)
    draws = np.flatnonzero(steps.covariance[:, n, n] > 0.0)
    # The first standstill has an angle, too.
    assert np.sum(lost) == pytest.approx(len(draws) + 1, abs=1.0)
    effect = np.zeros((count, len(draws) + 1))
    state = np.zeros((len(draws) + 1, steps.observation.shape[1]))
    state[-1, n] = 1.0
    stays = np.zeros(count, bool) if steps.stays is None else steps.stays
    for k in range(count):
        if not stays[k]:
            state = state @ np.asarray(steps.transition[k]).T
            state[np.flatnonzero(draws == k), n] += 1.0
        effect[k] = state @ np.asarray(steps.observation[k])
    still.covariance[:, n, n], still.initial[n, n] = 0.0, 0.0
    used = np.asarray(steps.used)
    white = np.asarray(whiten(still, np.concatenate([columns, effect], axis=1)))[used]
    angles, own = white[:, columns.shape[1] :], white[:, : columns.shape[1]]
    basis = np.linalg.qr(angles)[0]
    rest = np.concatenate([own - basis @ (basis.T @ own), model.prior_rows()])
    dense = np.sqrt(np.diag(np.linalg.inv(rest.T @ rest)))
    wide = imu_posterior(built).deviations(np.eye(model.size))
    assert wide[: model.calibrated] == pytest.approx(dense[: model.calibrated], rel=1e-3)


# --- counting ---------------------------------------------------------------------------------------------------------


def turning(turns_deg, scale=0.0, tilt=0.0):
    """Rows of one axis, level but for `tilt` (rad), with rests of 2 s between turns of 4 s, and the true angles."""
    geometry = Geometry(
        np.array([[np.cos(tilt), 0.0, np.sin(tilt)]]), np.eye(3), np.eye(3)[None], np.asarray(0.8), np.asarray(9.81)
    )
    angle, standing = [np.zeros(100)], [np.ones(100, bool)]
    for turn in np.radians(turns_deg):
        way = np.linspace(0.0, 1.0, 201)[1:]
        angle += [angle[-1][-1] + turn * (way - np.sin(2 * np.pi * way) / (2 * np.pi))]
        angle += [np.full(100, angle[-1][-1])]
        standing += [np.zeros(200, bool), np.ones(100, bool)]
    whole, stands = np.concatenate(angle), np.concatenate(standing)
    stages = frames(geometry, whole[:, None], np.zeros(len(whole), int))
    rate = np.diff(whole, prepend=0.0) * 50.0 * (1.0 + scale)
    count = len(whole)
    rows = ImuRows(
        np.arange(count) / 50.0, rate[:, None] * stages.axes[:, 0], 9.81 * stages.attitude[:, 2], np.zeros(count),
        np.full((count, 1), np.nan), stands, np.ones(count, bool), np.zeros(count, int), np.zeros(count, bool),
    )  # fmt: skip
    return rows, geometry, whole


@pytest.mark.parametrize("scale", [0.0, 0.07, -0.13])
def test_whole_turns_are_counted_whatever_the_scale(scale):
    rows, geometry, true = turning([90.0, 1080.0, -360.0, 170.0, -720.0, 45.0], scale)
    angles, _ = angles_by_gravity(rows, geometry, np.zeros(1))
    stands = rows.standing
    assert angles[stands, 0] == pytest.approx(true[stands], abs=1e-3)


def test_turns_that_cannot_be_counted_are_refused():
    """Ten turns each: a scale factor 10 % off would be a turn more or less."""
    rows, geometry, _ = turning([3600.0, -3600.0, 3600.0], 0.02)
    with pytest.raises(ValueError, match="whole turns cannot be counted"):
        angles_by_gravity(rows, geometry, np.zeros(1))


def test_about_a_vertical_axis_the_gyros_integral_is_kept():
    rows, geometry, true = turning([90.0, 360.0, -200.0], 0.01, tilt=np.pi / 2)
    angles, _ = angles_by_gravity(rows, geometry, np.zeros(1))
    assert angles[rows.standing, 0] == pytest.approx(1.01 * true[rows.standing], abs=1e-3)


# --- estimates --------------------------------------------------------------------------------------------------------


def test_angles_that_do_not_stand_still_are_no_estimate(monkeypatch):
    """Fewer linearisations than the angles need: nothing is reported as if they stood."""
    monkeypatch.setattr("gradcal_jax.estimation.fit_of_log._LINEARISED", 0)
    spec = without_encoder(scene("two axes", 0.1))
    rng = np.random.default_rng(5)
    truth = draw_truth(spec, rng)
    with pytest.raises(LogError, match="do not converge"):
        estimate_sensors(spec, record(spec, truth, rng, offset=0.05))


@pytest.mark.long
@pytest.mark.parametrize(
    ("plan", "spoilt"), [("two axes", 5.0), pytest.param("by hand", 20.0, marks=pytest.mark.evidence)]
)
def test_angles_that_nobody_knows_are_estimated(plan, spoilt):
    """The table stands degrees beside the plan, by a twin of quaternions, and the log's angles are the plan's."""
    spec = without_encoder(scene(plan, 0.1))
    rng = np.random.default_rng(5)
    truth = draw_truth(spec, rng)
    (report,) = estimate_sensors(spec, record(spec, truth, rng, offset=np.radians(spoilt)))
    model, solution = report.built.model, report.solution
    own = slice(model.calibrated)
    error = (model.to_reported @ solution.parameters - np.array([truth[name] for name in model.names()]))[own]
    spread = (model.to_reported @ solution.known.spread)[own]
    sigma = np.sqrt(np.sum(spread**2, axis=1))
    white = np.linalg.solve(np.linalg.cholesky(spread @ spread.T / np.outer(sigma, sigma)), error / sigma)
    assert np.sum(white**2) < model.calibrated + 4.5 * np.sqrt(2.0 * model.calibrated)
    assert 1e-3 < report.solution.test.probability < 1.0 - 1e-3
    assert not report.calibration.contradicted


@pytest.mark.long
def test_an_azimuth_that_is_hardly_seen_does_not_run_away():
    """Of a unit whose first linearisations go past the least χ² in the azimuth, then away from it: to 4.8 rad."""
    spec = gj.changed(PRESET, {"sensor.thermal_lag": None, "sensor.gyro.bias_temperature_gradient": None})
    log, truth = unguided.recorded(spec, 57, 1.0)
    (report,) = estimate_sensors(spec, [log])
    assert report.solution.noise_scale < 1.1
    for error in report.calibration.table:
        assert abs(error.value - truth[error.name]) < 4.0 * error.standard_deviation, error.name
