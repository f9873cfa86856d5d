"""IMUs on one table estimated together, against the estimate of one alone and against a twin of quaternions."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from estimate_scenes import aligned, draw_truth, record, scene
from scipy import stats

from gradcal_jax.estimation import posteriors_together, solve_imu, solve_together
from gradcal_jax.estimation.estimate import SensorEstimate, estimate_sensors
from gradcal_jax.estimation.fit_of_log import Fit, fitted_twice
from gradcal_jax.estimation.log_rows import Options, imu_rows
from gradcal_jax.information import Posterior
from gradcal_jax.information.prediction import predict
from gradcal_jax.model.imu_build import build_imu, imu_posterior
from gradcal_jax.records.log import Log, LogError
from gradcal_jax.spec.bench import Place
from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.places import specs_at_places
from gradcal_jax.spec.spec_sections import Spec

NAMES = ("a", "b", "c", "d")
PLACES = (
    Place(name="a"),
    Place(name="b", x="+x", y="-y", z="-z"),
    Place(name="c", x="+y", y="+z", z="+x"),
    Place(name="d", x="-z", y="+y", z="+x"),
)
TABLE = ("tilt", "azimuth", "orthogonality", "gravity", "angle")


def with_places(spec: Spec) -> Spec:
    table = spec.rig.table.model_copy(update={"place": PLACES})
    return spec.model_copy(update={"rig": spec.rig.model_copy(update={"table": table})})


def fixture_log(
    spec: Spec, seed: int, shifted: dict[str, float] | None = None, *, ideal: bool = False
) -> tuple[Log, dict[str, dict[str, float]]]:
    """A log of four IMUs on one table, and their truths; `shifted`: the table that the last IMU has is another;
    `ideal`: they are hardly misaligned."""
    rng = np.random.default_rng(seed)
    common = {k: v for k, v in draw_truth(spec, rng).items() if k.startswith(TABLE)}
    logs, truths = [], {}
    for name, at in specs_at_places(with_places(spec)).items():
        truths[name] = (aligned(draw_truth(at, rng)) if ideal else draw_truth(at, rng)) | common
        if name == "d":
            truths[name] |= {k: common[k] + by for k, by in (shifted or {}).items()}
        table = np.random.default_rng(seed + 1000)
        (log,) = record(at, truths[name], rng, name=name, table_rng=table)
        logs.append(log)
    first = logs[0]
    assert all(np.array_equal(first.table_angle_rad, log.table_angle_rad) for log in logs)
    stack = lambda of: np.concatenate([getattr(log, of) for log in logs])  # noqa: E731
    several = Log(
        first.time_s, stack("rate_rad_per_s"), NAMES, first.axes, stack("temperature_c"), first.table_axes,
        first.table_angle_rad, None, first.standstill,
        specific_force_m_per_s2=stack("specific_force_m_per_s2"), force_axes=first.force_axes, simulated=True,
    )  # fmt: skip
    return several, truths


@lru_cache
def alone(plan: str, gears: bool = False) -> Fit:
    spec = scene(plan, 1.0)
    if gears:
        sizes = {"scale_error": "20 ppm", "backlash": "0.002 deg"}
        axes = range(len(spec.rig.table.axis))
        spec = changed(spec, {f"rig.table.axis[{k}].angle.{key}": size for k in axes for key, size in sizes.items()})
    rng = np.random.default_rng(3)
    logs = record(spec, draw_truth(spec, rng), rng)
    built = build_imu(spec)
    rows, _ = imu_rows(built, logs, "SN7", Options())[:2]
    return fitted_twice(built, "SN7", rows, rows.temperature_c)


@pytest.mark.parametrize(("plan", "gears"), [("two axes", False), ("two axes", True), ("by hand", False)])
def test_one_imu_alone_has_its_own_estimate(plan, gears):
    """The encoder's errors as parameters are the states of the filter, and those of gears are in its rows."""
    fit = alone(plan, gears)
    assert (fit.readings.common is not None) == gears
    # Estimates together are linearised about those of one.
    own = solve_imu(fit.readings, fit.solution.parameters)
    (joint,) = solve_together([fit.readings], [own]).solutions
    every = np.eye(len(own.parameters))
    deviation = own.known.deviations(every)
    assert np.max(np.abs(joint.parameters - own.parameters) / deviation) < 1e-3
    assert joint.known.deviations(every) == pytest.approx(deviation, rel=1e-3)


def test_the_same_recording_twice_is_one_table_with_half_the_noise_of_the_imus():
    """What is known of the table without an error of the encoder would be √½ of one's; with it, between that and 1."""
    fit = alone("two axes")
    joint = solve_together([fit.readings] * 2, [fit.solution] * 2)
    model = fit.readings.model
    table = np.eye(model.size)[model.calibrated :]
    ratio = joint.solutions[0].known.deviations(table) / fit.solution.known.deviations(table)
    assert np.all((ratio > 0.5**0.5 - 1e-6) & (ratio < 1.0 + 1e-6))
    assert ratio.min() < 0.95
    assert all(test is not None and test.passed for test in joint.agreement)


@lru_cache
def together(
    seed: int, ideal: bool = False
) -> tuple[list[SensorEstimate], list[SensorEstimate], dict[str, dict[str, float]]]:
    """Four IMUs estimated together, and each alone."""
    spec = scene("two axes", 1.0)
    log, truths = fixture_log(spec, seed, ideal=ideal)
    own = [estimate_sensors(at, [log], units=[name])[0] for name, at in specs_at_places(with_places(spec)).items()]
    return estimate_sensors(with_places(spec), [log]), own, truths


def squared(report: SensorEstimate, truth: dict[str, float]) -> float:
    true = np.linalg.solve(report.built.model.to_reported, np.array(list(truth.values())))
    white = np.linalg.solve(report.solution.known.spread, report.solution.parameters - true)
    return float(white @ white)


@pytest.mark.long
def test_four_imus_are_within_their_joint_covariances():
    """Each has the truth within its covariance, which is smaller than alone, most of all that of the table."""
    reports, own, truths = together(5)
    for report, one in zip(reports, own, strict=True):
        model = report.built.model
        assert list(truths[report.unit]) == model.names()
        assert 1e-4 < stats.chi2.sf(squared(report, truths[report.unit]), model.size) < 1.0 - 1e-4
        every = np.eye(model.size)
        ratio = report.solution.known.deviations(every) / one.solution.known.deviations(every)
        assert np.all(ratio < 1.001)
        assert ratio[model.calibrated :].min() < 0.8
        assert any("estimated together with 3 other IMUs" in message for message in report.messages)
        assert not any("contradicts the other IMUs" in message for message in report.messages)
    tables = [report.solution.parameters[report.built.model.calibrated :] for report in reports]
    assert all(table == pytest.approx(tables[0]) for table in tables)


def predicted(counts: tuple[int, ...], names: str = "abcd") -> list[Posterior]:
    """The joint posteriors of so many IMUs at each of the places."""
    built = [build_imu(specs_at_places(with_places(scene("two axes", 1.0)))[name]) for name in names]
    plans = [(b.model, b.motion, b.body_nodes(), imu_posterior(b)) for b in built]
    return posteriors_together(plans, counts)


@pytest.mark.long
def test_what_is_predicted_together_is_what_is_estimated_together():
    """Of every parameter's standard deviation by four IMUs, over that by one: the estimate of a simulated log, which is
    linear about its own values, against the plan's prediction, which has no log."""
    reports, own, _ = together(5, ideal=True)
    for name, report, one, joint in zip(NAMES, reports, own, predicted((1, 1, 1, 1)), strict=True):
        model, every = report.built.model, np.eye(report.built.model.size)
        alone = imu_posterior(build_imu(specs_at_places(with_places(scene("two axes", 1.0)))[name]))
        before = joint.deviations(every) / alone.deviations(every)
        after = report.solution.known.deviations(every) / one.solution.known.deviations(every)
        assert after == pytest.approx(before, rel=0.05)
        assert before[model.calibrated :].min() < 0.8


def test_one_imu_together_with_none_is_predicted_alone_and_copies_count():
    (alone,), four = predicted((1,), "a"), predicted((1, 1, 1, 1), "aaaa")
    built = build_imu(specs_at_places(with_places(scene("two axes", 1.0)))["a"])
    every = np.eye(built.model.size)
    assert alone.deviations(every) == pytest.approx(imu_posterior(built).deviations(every), rel=1e-6)
    (copies,) = predicted((4,), "a")
    assert copies.deviations(every) == pytest.approx(four[0].deviations(every), rel=1e-9)
    assert np.min(copies.deviations(every) / alone.deviations(every)) < 0.8


def test_the_prediction_of_a_fixture_is_of_the_joint_estimate():
    places = predict(with_places(scene("two axes", 1.0))).places
    ratios = [of.values[name] / of.alone[name] for of in places for name in of.values]
    assert max(ratios) < 1.0 + 1e-6
    assert min(ratios) < 0.95


@pytest.mark.long
def test_the_covariance_in_the_calibration_is_the_joint_one():
    (report, *_), (one, *_), _ = together(5)
    pair = [np.sqrt(np.diag(np.array(r.calibration.covariance.matrix))) for r in (report, one)]
    assert np.all(pair[0] < 1.001 * pair[1])
    assert np.min(pair[0] / pair[1]) < 0.95


@pytest.mark.long
def test_an_imu_that_sees_another_table_is_named():
    spec = scene("two axes", 1.0)
    log, _ = fixture_log(spec, 6, {"tilt_east": 0.004})
    found = {r.unit: r for r in estimate_sensors(with_places(spec), [log])}
    named = [n for n, r in found.items() if any("contradicts the other IMUs" in m for m in r.messages)]
    assert "d" in named


def test_imus_are_told_by_the_names_of_their_places_or_by_their_order():
    spec = with_places(scene("two axes", 1.0))
    log, _ = fixture_log(scene("two axes", 1.0), 5)
    reports, *_ = together(5)
    renamed = replace(log, units=("s1", "s2", "s3", "s4"))
    again = estimate_sensors(spec, [renamed], units=renamed.units[:1])
    assert again[0].built.spec.rig.table.mounting == reports[0].built.spec.rig.table.mounting


def test_more_imus_than_places_are_refused():
    spec = scene("two axes", 1.0)
    log, _ = fixture_log(spec, 5)
    table = spec.rig.table.model_copy(update={"place": (Place(name="left"), Place(name="right"))})
    two = spec.model_copy(update={"rig": spec.rig.model_copy(update={"table": table})})
    with pytest.raises((ValueError, LogError), match=r"the log has 4 IMUs, and the spec has 2 places"):
        estimate_sensors(two, [log])
