"""The estimate of a whole unit against a twin of quaternions, whose table is finitely off: residuals as predicted."""

import re
from dataclasses import replace

import numpy as np
import pytest
from estimate_scenes import PLANS, aligned, draw_truth, estimated, scene, squared
from imu_twin import record
from scipy import stats

from gradcal_jax.estimation.estimate import SensorEstimate, estimate_sensors
from gradcal_jax.estimation.fit_of_log import fit_readings
from gradcal_jax.estimation.imu_executed import ImuRows, across_stops, executed_imu
from gradcal_jax.estimation.log_rows import Options, imu_rows
from gradcal_jax.formulas import runs
from gradcal_jax.information import Posterior, segments_of, whiten
from gradcal_jax.information.plan_information import imu_posterior
from gradcal_jax.information.residual import residual_of
from gradcal_jax.model.build import build_imu
from gradcal_jax.motion import frames
from gradcal_jax.records.log import Log, LogError
from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.requirement import QUANTITIES

UNITS = 300


@pytest.fixture(scope="module")
def usual():
    """A spec, the truth of a unit, and the log of its plan."""
    spec, rng = scene("two axes", 0.1), np.random.default_rng(8)
    truth = draw_truth(spec, rng)
    (log,) = record(spec, truth, rng)
    return spec, truth, log


@pytest.mark.parametrize("plan", ["two axes", "one axis, three mountings", "by hand"])
def test_a_unit_on_a_table_that_is_off_is_found_within_its_covariance(plan):
    report, truth = estimated(scene(plan, 1.0), 11)
    _require_consistent(report, truth)
    assert report.solution.moved < 1e-3
    assert report.solution.rounds <= 5


def test_the_covariance_of_a_log_is_that_of_its_plan():
    spec, rng = scene("two axes", 0.1), np.random.default_rng(3)
    (report,) = estimate_sensors(spec, record(spec, aligned(draw_truth(spec, rng)), rng))
    plan = imu_posterior(build_imu(spec))
    reported = report.built.model.to_reported
    ratio = report.solution.known.deviations(reported) / plan.deviations(reported)
    # The ends of rests, a tenth of a second each, count to the moves: of 7 readings of the encoder 6 are counted.
    assert np.max(np.abs(ratio - 1.0)) < 0.09
    assert 1.0 <= np.median(ratio) < 1.02


def test_gyros_off_the_axes_are_sensitive_to_what_they_feel_there():
    """At 0.4 m a move adds a whole g to gravity, and a sensitivity of 50 deg/h/g makes minutes of arc of it."""
    spec, rng = scene("two axes", 0.1), np.random.default_rng(21)
    truth = draw_truth(spec, rng)
    (report,) = estimate_sensors(spec, record(spec, truth, rng, lever=(0.3, -0.2, 0.1)))
    _require_consistent(report, truth)


@pytest.mark.long
@pytest.mark.parametrize(("seed", "sensitivity"), [(9, "300 deg/h/g"), (1, "3000 deg/h/g")])
def test_scale_factors_do_not_tell_how_a_case_hangs(seed, sensitivity):
    """Mountings and misalignments of 20 mrad, and scale factors that change with temperature by some 0.3 %: what a
    rotation of the body's frame changes, misalignments undo, and the scale factor multiplies both. By a model that adds
    misalignments, the products seem to tell the frame, and χ² of the truth is 17 000 to 120 000 higher here.

    The estimate must be where χ² is least, so that the truth's is higher by χ² of as many degrees of freedom as there
    are parameters; their squared errors, by a covariance that is linear, are not. What a move adds to gravity is
    measured in the body, and must not hold it to the first estimate's.
    """
    keys = {"sensor.gyro.g_sensitivity.prior": sensitivity, "sensor.gyro.misalignment.prior": "20 mrad"}
    spec, rng = changed(scene("one axis, three mountings", 20.0), keys), np.random.default_rng(seed)
    truth = draw_truth(spec, rng)
    logs, built = record(spec, truth, rng, lever=(0.03, -0.02, 0.01)), build_imu(spec)
    rows, _ = imu_rows(built, logs, "SN7", Options())
    fit = fit_readings(built, "SN7", rows, rows.temperature_c)
    readings, found = fit.readings, fit.solution
    steps, _ = readings.linear(found.parameters)
    used = segments_of(readings.done.motion, built.model).used

    def squares(parameters: np.ndarray) -> float:
        apart = readings.by_steps(np.where(used, readings.observed - readings.expected(parameters), 0.0))
        white = np.asarray(whiten(steps, apart[:, None]))[readings.by_steps(np.asarray(used))]
        return float(np.sum(white**2) + np.sum((built.model.prior_rows() @ parameters) ** 2))

    of_truth = squares(np.linalg.solve(built.model.to_reported, np.array(list(truth.values()))))
    above = of_truth - squares(found.parameters)
    assert stats.chi2.ppf(1e-3, len(truth)) < above < stats.chi2.ppf(1.0 - 1e-3, len(truth))


@pytest.mark.long
def test_an_estimate_that_does_not_stand_still_from_one_linearisation_to_the_next_is_said(monkeypatch):
    """On a table of 0.1 deg with misalignments of 60 mrad, the linearisation about the first estimate is not enough."""
    axes = [of.model_dump(exclude_unset=True) for of in scene("two axes", 0.1).rig.table.axis]
    coarse = {"reading_noise": "0.02 deg", "standstill_offset": "0.1 deg"}
    keys = {
        "rig.table.axis": [of | {"angle": coarse} for of in axes],
        "sensor.accelerometer.misalignment.prior": "60 mrad",
    }
    spec, rng = changed(scene("two axes", 0.1), keys), np.random.default_rng(2)
    logs = record(spec, draw_truth(spec, rng), rng)
    words = "the estimate has not converged"
    (report,) = estimate_sensors(spec, logs)
    assert not any(words in message for message in report.messages)
    monkeypatch.setattr("gradcal_jax.estimation.imu_solve._LINEARISED", 0)
    (report,) = estimate_sensors(spec, logs)
    assert any(words in message for message in report.messages)


def test_standstills_that_no_log_marks_are_found_and_lost_rows_do_no_harm(usual):
    spec, truth, log = usual
    status = np.zeros((1, len(log.time_s)), np.uint16)
    status[0, 5000:5100] = 4
    rate = log.rate_rad_per_s.copy()
    rate[0, 5000:5100] = np.nan
    (report,) = estimate_sensors(spec, [replace(log, standstill=None, status=status, rate_rad_per_s=rate)])
    assert any("no standstills" in message for message in report.messages)
    _require_consistent(report, truth)


def test_an_axis_that_was_away_where_a_run_was_resumed_does_no_harm(usual):
    """A seam in a move of tilt, in which spin turned, too, and came back: that it stood there is not believed."""
    spec, truth, log = usual
    move = _moves_of(log, axis=0)[5]
    angle, rate = log.table_angle_rad.copy(), log.rate_rad_per_s.copy()
    angle[move, 1] += np.radians(130.0) * np.sin(np.linspace(0.0, np.pi, len(move)))
    rate[0, move] += 0.3
    starts = np.array([0, move[len(move) // 2]])
    (report,) = estimate_sensors(
        spec, [replace(log, table_angle_rad=angle, rate_rad_per_s=rate, stretch_starts=starts)]
    )
    _require_consistent(report, truth)


def test_a_standstill_ends_where_a_run_broke_off_at_rest(usual):
    """It went on at rest, too, and elsewhere, so that no row lies between the two standstills."""
    spec, truth, log = usual
    rests = runs(log.standstill >= 0)
    # A rest with tilt at 90 degrees, and the next one where tilt is elsewhere.
    at = [np.degrees(log.table_angle_rad[first]) for first, _ in rests]
    number = next(k for k, angle in enumerate(at) if k > 5 and abs(angle[0] - 90.0) < 1.0)
    later = next(k for k, angle in enumerate(at) if k > number and 10.0 < (angle[0] - 90.0) % 360.0 < 350.0)
    broke, again = rests[number][1] - 20, rests[later][0] + 20
    kept = np.r_[: int(broke), int(again) : len(log.time_s)]
    part = replace(
        log,
        time_s=log.time_s[kept],
        rate_rad_per_s=log.rate_rad_per_s[:, kept],
        specific_force_m_per_s2=log.specific_force_m_per_s2[:, kept],
        temperature_c=log.temperature_c[:, kept],
        table_angle_rad=log.table_angle_rad[kept],
        standstill=log.standstill[kept],
        stretch_starts=np.array([0, broke]),
        rows_read=len(kept),
    )
    (report,) = estimate_sensors(spec, [part])
    _require_consistent(report, truth)


@pytest.mark.parametrize("axes", [(0, 1), (1, 1)])
@pytest.mark.parametrize("late_s", [0.0, 3e-3, 9e-3])
def test_what_a_row_at_a_stop_holds_of_either_turn_is_told(axes, late_s):
    """One turn brakes to a stop within a row of 10 ms, and the next takes off at once: integrals by formula, not by
    rows. Two axes are told by what they turn about, one axis by the slopes of its rate: 0.5 deg/s of bias would move
    the stop that these tell."""
    geometry = build_imu(scene("two axes", 0.0)).motion.geometry
    by, step, bias = np.radians([30.0, 40.0]), 0.01, np.radians([0.1, -0.2, 0.5])
    half = np.sqrt(by / np.radians([100.0, 250.0]))  # Accelerating half of the angle, braking the other half.
    begins = 2.0 + late_s + np.array([0.0, 2.0 * half[0]])
    time = step * np.arange(round((begins[1] + 2.0 * half[1] + 2.0) / step))
    u = np.clip((time[:, None] - begins) / half, 0.0, 2.0)
    turned = by * np.where(u < 1.0, 0.5 * u**2, 1.0 - 0.5 * (2.0 - u) ** 2)
    frame = frames(geometry, np.zeros((1, 2)), np.zeros(1, int)).axes[0][list(axes)]
    rates = np.diff(turned, axis=0, prepend=0.0) / step @ frame + bias
    standing = (time < begins[0]) | (time > begins[1] + 2.0 * half[1] + step)
    stop, count, none = int(np.argmin(np.abs(time - begins[1]))), len(time), np.zeros(len(time))
    angles, at_a_stop = np.zeros((count, 2)), np.zeros(count, bool)
    for axis, of in zip(axes, turned.T, strict=True):
        angles[:, axis] += of
    if axes == (1, 1):
        at_a_stop = standing | (np.arange(count) == stop)
        angles[~at_a_stop], angles[stop] = np.nan, (0.0, by[0])
    log = ImuRows(
        time, rates, np.zeros((count, 3)), none + 20.0, angles, standing, none == 0.0, none.astype(int), at_a_stop
    )
    done = executed_imu(log, geometry)
    moves = np.flatnonzero(done.motion.axis >= 0)
    assert tuple(done.motion.axis[moves]) == axes
    total = np.concatenate([np.zeros((1, 3)), np.cumsum((rates - bias) * step, axis=0)])
    plain = np.diff(total[done.rows + 1], axis=0)[moves]
    np.testing.assert_allclose(plain + across_stops(done, log)[moves], by[:, None] * frame, atol=2e-9)


@pytest.mark.parametrize("quantity", ["misalignment", "scale_factor"])
@pytest.mark.parametrize("kind", ["gyro", "accelerometer"])
def test_the_residual_about_an_estimate_is_what_a_correction_leaves(kind, quantity):
    """Against the matrix (1 + M)(1 + m) itself, of which M, or m for the residual of M, is a hundred times less known
    than the rest."""
    spec, rng = scene("two axes", 0.1), np.random.default_rng(6)
    built, truth = build_imu(spec), draw_truth(spec, rng)
    model, names = built.model, built.model.names()
    values = np.array([truth[name] for name in names])
    loose = r"\.(b0\d|s\d)$" if quantity == "misalignment" else r"\.m_"
    sizes = np.array([(1e-3 if re.search(loose, name) else 1e-5) * (".b1" not in name) for name in names])
    values *= np.where([".m_" in name for name in names], 20.0, 1.0)
    sizes[model.calibrated :] = 0.0
    spread = np.linalg.solve(
        model.to_reported, np.diag(sizes) @ np.linalg.qr(rng.standard_normal((model.size,) * 2))[0]
    )
    about, known = np.linalg.solve(model.to_reported, values), Posterior(spread, np.zeros((model.size, 0)))
    (requirement,) = (r for r in spec.requirement if r.quantity == f"{kind}_{quantity}")
    left = residual_of(built._replace(about=about), requirement).map(known)
    plain = residual_of(built, requirement).map(known)

    def matrix(values: np.ndarray, temperature: float) -> np.ndarray:
        of, x = dict(zip(names, values, strict=True)), (temperature - 20.0) / 50.0

        def polynomial(head: str) -> float:
            return sum(of.get(f"{head}{k}", 0.0) * x**k for k in range(4))

        scale, across = np.zeros(3), np.eye(3)
        for i, a in enumerate("xyz"):
            scale[i] = 1.0 + polynomial(f"{kind}_{a}." + ("b0" if kind == "gyro" else "s"))
            for j, b in enumerate("xyz"):
                if i != j:
                    across[i, j] = polynomial(f"{kind}_{a}.m_{b}")
        return np.diag(scale) @ across

    for k, temperature in enumerate(left.temperatures):
        here = matrix(values, temperature)
        steps = (1e-3 * model.to_reported @ spread).T
        errors = [np.linalg.solve(here, matrix(values + step, temperature)) - np.eye(3) for step in steps]
        std = 1e3 * np.linalg.norm(errors, axis=0) * QUANTITIES[requirement.quantity].factor
        wanted = [std["xyz".index(label[0]), "xyz".index(label[-1])] for label in left.labels]
        np.testing.assert_allclose(left.values[:, k, 0], wanted, rtol=0.1)
        assert np.max(np.abs(plain.values[:, k, 0] / wanted - 1.0)) > 0.3


def _moves_of(log: Log, axis: int) -> list[np.ndarray]:
    """The rows between two standstills of those moves in which no axis but this one turns."""
    turned = [
        (np.arange(a, b), np.ptp(log.table_angle_rad[a - 1 : b + 1], axis=0)) for a, b in runs(log.standstill < 0)
    ]
    return [rows for rows, by in turned if by[axis] > 0.5 and np.sum(by) - by[axis] < 0.01]


def _require_consistent(report: SensorEstimate, truth: dict[str, float]) -> None:
    assert 1e-4 < stats.chi2.sf(squared(report, truth), len(truth)) < 1.0 - 1e-4
    assert 1e-4 < report.solution.test.probability < 1.0 - 1e-4


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda log: replace(log, table_axes=("spin", "tilt")), "of the table swapped"),
        (lambda log: replace(log, axes=("z", "x", "y")), "gyro x: .*swapped"),
        (lambda log: replace(log, axes=("a", "b", "c")), "the log has gyro a, gyro b, gyro c"),
        (lambda log: replace(log, table_axes=("tilt", "inner")), "no table axis spin"),
        (lambda log: replace(log, table_angle_rad=None, table_axes=()), "no table angles"),
        (lambda log: replace(log, temperature_c=None), "no temperature"),
        (
            lambda log: replace(log, specific_force_m_per_s2=-log.specific_force_m_per_s2),
            "accelerometer x: .*its sign is opposite to the table's",
        ),
        (
            lambda log: replace(log, specific_force_m_per_s2=log.specific_force_m_per_s2 / 9.80665),
            "accelerometer .: .*in g instead of m/s",
        ),
        (lambda log: replace(log, standstill=np.full(len(log.time_s), -1)), "fewer than two standstills"),
    ],
)
def test_a_log_of_another_table_is_a_sentence(usual, change, said):
    spec, _, log = usual
    with pytest.raises(LogError, match=said):
        estimate_sensors(spec, [change(log)])


def test_several_mountings_want_a_log_each():
    spec, rng = scene("one axis, three mountings", 0.1), np.random.default_rng(1)
    logs = record(spec, draw_truth(spec, rng), rng)
    with pytest.raises(LogError, match="one log for each"):
        estimate_sensors(spec, logs[:2])


@pytest.mark.evidence
@pytest.mark.parametrize("mrad", [0.1, 1.0])
@pytest.mark.parametrize("plan", PLANS)
def test_three_hundred_units_err_as_predicted(plan, mrad):
    """Residual over prediction within 5 % for every quantity, but for what 300 units leave in doubt: with the three
    parameters of the second order, 2.4 % (1σ). NEES and χ² of the data in their 99 % bands.
    """
    spec = scene(plan, mrad)
    built = build_imu(spec)
    quantities = [residual_of(built, r) for r in spec.requirement]
    square, expected, nees, chi, degrees = [], [], [], [], []
    for seed in range(UNITS):
        report, truth = estimated(spec, (1000 if mrad < 0.5 else 5000) + seed)
        known = report.solution.known
        error = report.solution.parameters - np.linalg.solve(built.model.to_reported, np.array(list(truth.values())))
        square.append([_power(q, error) for q in quantities])
        expected.append([_power(q, known.spread) for q in quantities])
        nees.append(squared(report, truth))
        chi.append(report.solution.test.statistic)
        degrees.append(report.solution.test.degrees)
    ratio = np.sqrt(np.mean(square, axis=0) / np.mean(expected, axis=0))
    doubt = 0.5 * np.std(square, axis=0, ddof=1) / np.mean(square, axis=0) / np.sqrt(UNITS)
    print(plan, mrad, dict(zip([r.name for r in spec.requirement], ratio.round(4).tolist(), strict=True)))
    print("in doubt by", doubt.round(4).tolist())
    low, high = stats.chi2.ppf([0.005, 0.995], UNITS * built.model.size)
    print("NEES", np.sum(nees) / low, np.sum(nees) / high, "χ²", np.sum(chi) / np.sum(degrees))
    assert low < np.sum(nees) < high
    low, high = stats.chi2.ppf([0.005, 0.995], np.sum(degrees))
    assert low < np.sum(chi) < high
    assert np.all(np.abs(ratio - 1.0) < np.maximum(0.05, 3.0 * doubt)), (ratio, doubt)


def _power(quantity, values: np.ndarray) -> float:
    """Mean square of a quantity over its elements and grid, of an error `(p,)`, or of a covariance's root `(p, k)`."""
    each = [element.rows @ values[element.where] for element in quantity.elements]
    return float(np.mean([np.sum(e**2) / len(e) for e in each]))
