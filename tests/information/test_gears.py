"""Tables whose angle is read at the motor, before a gear: an IMU on them, from the twin of quaternions."""

from dataclasses import replace

import numpy as np
import pytest
from estimate_scenes import draw_truth, scene, squared
from imu_twin import record
from scipy import stats

import gradcal_jax as gj
from gradcal_jax.estimation.estimate import estimate_sensors
from gradcal_jax.estimation.fit_of_log import fit_readings
from gradcal_jax.estimation.log_rows import Options, imu_rows
from gradcal_jax.information.error_budget import ErrorBudget
from gradcal_jax.information.gears import BACKLASH, SCALE_OF_ANGLE
from gradcal_jax.information.plan_information import imu_posterior
from gradcal_jax.information.residual import residual_map
from gradcal_jax.information.unseen import budget_of_imu
from gradcal_jax.model.build import build_imu
from gradcal_jax.records.log import Log
from gradcal_jax.spec import presets
from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.spec_sections import Spec

SIZES = {"scale_error": "300 ppm", "backlash": "0.02 deg"}


def geared(log: Log, ratios: np.ndarray, play_deg: np.ndarray, begins: float = 0.0) -> Log:
    """What motors count: more than the axes turn, by these ratios, and half of the play past them as they turn.
    `begins`: where in its play (−1 to 1) each axis stands before its first turn."""
    angle, way = log.table_angle_rad, np.zeros(log.table_angle_rad.shape)
    turned = np.diff(angle, axis=0)
    for k in range(angle.shape[1]):
        moves = np.flatnonzero(np.abs(turned[:, k]) > np.radians(0.05))
        last = np.searchsorted(moves, np.arange(len(angle)), side="left") - 1
        way[:, k] = np.where(last >= 0, np.sign(turned[moves[last], k]), begins)
    return replace(log, table_angle_rad=angle * (1.0 + ratios) + 0.5 * np.radians(play_deg) * way)


def stated(spec: Spec, sizes: dict[str, str]) -> Spec:
    axes = range(len(spec.rig.table.axis))
    return changed(spec, {f"rig.table.axis[{k}].angle.{name}": size for k in axes for name, size in sizes.items()})


def estimated(
    seed: int,
    ratios: tuple[float, float],
    play_deg: tuple[float, float],
    sizes: dict[str, str],
    crooked: float = 0.0,
    begins: float = 0.0,
):
    """`crooked`: misalignments of all accelerometers (rad). `begins`: see `geared`."""
    spec, rng = scene("two axes", 0.1), np.random.default_rng(seed)
    if crooked:
        spec = changed(spec, {"sensor.accelerometer.misalignment.prior": f"{crooked} rad"})
    truth = draw_truth(spec, rng)
    logs = [geared(log, np.array(ratios), np.array(play_deg), begins) for log in record(spec, truth, rng)]
    (report,) = estimate_sensors(stated(spec, sizes), logs)
    return report, truth


@pytest.mark.parametrize(
    ("ratios", "play_deg", "begins"),
    [
        pytest.param((-3e-4, 3e-4), (0.02, -0.01), 0.0, marks=pytest.mark.long),
        pytest.param((0.0, 0.0), (0.03, 0.02), 1.0, marks=pytest.mark.long),
    ],
)
def test_a_gear_that_is_stated_contradicts_nothing_and_counts(ratios, play_deg, begins):
    none = dict.fromkeys(SIZES, "0 deg") | {"scale_error": "0 ppm"}
    plain, truth = estimated(4, ratios, play_deg, none, begins=begins)
    assert plain.calibration.contradicted
    report, _ = estimated(4, ratios, play_deg, SIZES, begins=begins)
    assert not report.calibration.contradicted
    assert report.solution.test.probability > 1e-3
    assert squared(plain, truth) > 3.0 * len(truth)
    assert 1e-3 < stats.chi2.sf(squared(report, truth), len(truth)) < 1.0 - 1e-3


@pytest.mark.long
def test_an_angle_that_is_off_shows_what_is_crooked():
    """A milliradian of the angle, and misalignments of per cents: their product is ten times the noise of a rest."""
    report, truth = estimated(4, (4e-4, -4e-4), (0.0, 0.0), SIZES, crooked=0.05)
    assert not report.calibration.contradicted
    assert 1e-3 < stats.chi2.sf(squared(report, truth), len(truth)) < 1.0 - 1e-3


@pytest.mark.long
@pytest.mark.parametrize("sizes", [{"scale_error": "300 ppm"}, {"backlash": "0.05 deg"}, SIZES])
def test_a_plan_is_predicted_as_its_log_is_estimated(sizes):
    """Of one and the same table, errors of its angles count alike before and after the run: in scale factors hardly,
    which gravity tells from the table's, in misalignments by up to twice."""
    plain, rng = scene("two axes", 0.1), np.random.default_rng(4)
    # A prediction is of ideal sensors; and the log loses a little of each rest, whatever the table.
    logs = record(plain, dict.fromkeys(draw_truth(plain, rng), 0.0), rng)

    def deviations(spec: Spec) -> tuple[np.ndarray, np.ndarray]:
        built = build_imu(spec)
        rows, _ = imu_rows(built, logs, "SN7", Options())
        known = fit_readings(built, "SN7", rows, rows.temperature_c).solution.known
        own = np.eye(built.model.size)[: built.model.calibrated]
        return imu_posterior(built).deviations(own), known.deviations(own)

    predicted, reached = np.divide(deviations(stated(plain, sizes)), deviations(plain))
    np.testing.assert_allclose(reached, predicted, rtol=0.02)
    assert np.max(predicted) > 1.1


def test_the_budget_of_a_plan_with_gears_has_their_share():
    """By differences: what a standard deviation that is a per cent larger adds to a residual."""
    spec, most = stated(scene("two axes", 0.1), {"scale_error": "300 ppm", "backlash": "0.05 deg"}), 0.0
    for requirement in (r for r in spec.requirement if "misalignment" in r.name):
        shares = ErrorBudget(budget_of_imu(built := build_imu(spec), imu_posterior(built), built)).of_fit(requirement)
        assert sum(shares.values()) == pytest.approx(1.0, abs=1e-6)

        def left(scale: float = 1.0, lash: float = 1.0, noise: float = 1.0, requirement=requirement, built=built):
            channels = tuple(
                replace(c, angle_random_walk=np.asarray(noise * c.angle_random_walk)) if c.kind == "gyro" else c
                for c in built.model.channels
            )
            by = [(scale * s, lash * b) for s, b in built.gears]
            one = built._replace(gears=by, model=replace(built.model, channels=channels))
            return np.log(residual_map(one, imu_posterior(one), requirement).statistic())

        for error, named in (("scale", SCALE_OF_ANGLE), ("lash", BACKLASH), ("noise", "angle random walk")):
            slope = (left(**{error: 1.01}) - left(**{error: 1.0 / 1.01})) / (2.0 * np.log(1.01))
            assert shares[named] == pytest.approx(slope, rel=0.01, abs=1e-5)
            most = max(most, slope * (error != "noise"))
    assert most > 0.03


@pytest.mark.parametrize(
    ("preset", "backlash"), [("tactical-mems", "0.02 deg"), ("paper-dynamic-gradient", "0.01 deg")]
)
def test_a_differentiable_plan_counts_backlash_as_a_prediction_does(preset, backlash):
    """By two ways: errors that all readings have in common, and parameters of the channel."""
    spec = changed(gj.parse_spec(presets.text(preset)), {"rig.table.axis[0].angle.backlash": backlash})
    counted = {row.name: row.mean_of_max or row.mean for row in gj.predict(spec).requirements}
    assert gj.differentiable(spec)({}) == pytest.approx(counted, rel=1e-9)
    plain = {
        row.name: row.mean_of_max or row.mean for row in gj.predict(gj.parse_spec(presets.text(preset))).requirements
    }
    assert max(counted[name] / plain[name] for name in plain) > 1.02
