"""Three roads to a unit's covariance: joint filter, dense generalised least squares, augmented Kalman filter."""

import copy
import re
from dataclasses import replace

import numpy as np
import pytest
from helpers import augmented_kalman
from imu_helpers import DEG, shipped
from random_imus import motion, nodes_of, random_scene, system_of, unit_of
from reference_imu import Scene, Simulator

from gradcal_jax.information import square_root, whiten
from gradcal_jax.information.imu_rows import imu_information, imu_system
from gradcal_jax.information.prediction import predict
from gradcal_jax.model.imu_build import build_imu
from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.spec import spec_of


def by_the_program(scene: Scene) -> dict[str, float]:
    moving, of = motion(scene), unit_of(scene)
    found = imu_information([(moving, nodes_of(scene, moving))], of).deviations(of.to_reported)
    return dict(zip(of.names(), found, strict=True))


def agree(found: dict[str, float], wanted: dict[str, float], tolerance: float = 1e-9) -> None:
    assert set(found) == set(wanted)
    for name, value in wanted.items():
        assert found[name] == pytest.approx(value, rel=tolerance), name


# One, two and three axes, skew ones and skew mountings; several mountings one after the other.
SCENES = [(1, 1, 1), (2, 2, 1), (3, 3, 1), (4, 1, 3), (5, 2, 2)]


@pytest.mark.parametrize(("seed", "axes", "mountings"), SCENES)
def test_the_joint_filter_is_dense_least_squares(seed, axes, mountings):
    scene = random_scene(seed, axes, mountings)
    agree(by_the_program(scene), Simulator(scene).dense())


@pytest.mark.parametrize("change", [{}, {"held": False}, {"slow": 180.0 * DEG}], ids=str)
@pytest.mark.parametrize(("seed", "axes", "mountings"), SCENES)
def test_every_column_and_the_covariance_of_the_rows(seed, axes, mountings, change):
    """The regressors one by one to 1e-11 (where an accelerometer sits, 1e-9: by finite differences), and the covariance
    that the filter's steps stand for."""
    scene = replace(random_scene(seed + 100, axes, mountings, length=16), **change)
    simulator = Simulator(scene)
    steps, columns, of = system_of(scene)
    used = np.asarray(steps.used)
    ours = dict(zip(of.names(), (columns @ np.linalg.inv(of.to_reported))[used].T, strict=True))
    theirs = simulator.columns()
    assert set(ours) == set(theirs)
    rounding = 1e-15 * scene.gravity * 40.0
    for name, column in theirs.items():
        tolerance = (1e-9 if ".r_" in name else 1e-11) * np.max(np.abs(column)) + rounding
        np.testing.assert_allclose(ours[name], column, rtol=0, atol=tolerance, err_msg=name)
    wanted = simulator.covariance()
    size = np.sqrt(np.diagonal(wanted))
    np.testing.assert_allclose(dense_of(steps) / np.outer(size, size), wanted / np.outer(size, size), atol=1e-11)


def dense_of(steps) -> np.ndarray:
    """Covariance of the used rows, from the steps written out."""
    n = steps.observation.shape[1]
    spread, response = [np.asarray(steps.initial)], [np.eye(n)]
    rows = []
    for f, q, h, r, used in zip(*(np.asarray(x) for x in steps[:5]), strict=True):
        response = [f @ x for x in response] + [np.eye(n)]
        spread.append(q)
        if used:
            rows.append(([h @ x for x in response], r))
    total = np.zeros((len(rows), len(rows)))
    for i, (a, r) in enumerate(rows):
        total[i, i] += r
        for j, (b, _) in enumerate(rows):
            total[i, j] += sum(x @ q @ y for x, q, y in zip(a, spread, b, strict=False))
    return total


@pytest.mark.parametrize("held", [True, False])
@pytest.mark.parametrize(("seed", "axes", "mountings"), [(11, 2, 1)])
def test_the_augmented_filter_says_the_same(seed, axes, mountings, held):
    scene = replace(random_scene(seed, axes, mountings, length=14), held=held)
    steps, columns, of = system_of(scene)
    inverse = np.linalg.inv(of.prior_rows())
    covariance = of.to_reported @ augmented_kalman(steps, columns, inverse @ inverse.T) @ of.to_reported.T
    agree(dict(zip(of.names(), np.sqrt(np.diagonal(covariance)), strict=True)), by_the_program(scene))


@pytest.mark.parametrize(
    "change",
    [
        {"gyros": (0, 2)},
        {"accelerometers": ()},
        {"gyros": ()},
        {"gyros": (1,), "accelerometers": (2,)},
        {"instability": ()},
        {"drift": (), "force_drift": (), "instability": ()},
        {"offset": (0.0, 0.0), "reading": (0.0, 0.0)},
        {"orders": ((), (1, 4))},
        {"held": False},
        {"held": False, "instability": ()},
        {"held": False, "accelerometers": (), "drift": ()},
        {"slow": 150.0 * DEG, "instability": ()},
    ],
    ids=str,
)
def test_units_of_fewer_channels_and_tables_of_fewer_faults(change):
    scene = replace(random_scene(21, 2, length=22), **change)
    agree(by_the_program(scene), Simulator(scene).dense())


def test_channels_that_share_the_encoder_are_not_independent():
    """Side by side, each with the encoder's error to itself, they would be too sure of themselves."""
    scene = random_scene(31, 2, length=26)
    together = by_the_program(scene)
    apart: dict[str, float] = {}
    for kind in ("gyros", "accelerometers"):
        for i in range(3):
            alone = replace(replace(scene, gyros=(), accelerometers=()), **{kind: (i,)})
            apart |= {k: v for k, v in by_the_program(alone).items() if "." in k}
    ratio = np.array([apart[name] / together[name] for name in apart])
    assert np.max(np.abs(ratio - 1.0)) > 0.02


@pytest.mark.evidence
@pytest.mark.parametrize("seed", range(40))
def test_random_units_by_three_roads(seed):
    rng = np.random.default_rng(seed)
    scene = random_scene(1000 + seed, int(rng.integers(1, 4)), int(rng.integers(1, 4)), int(rng.integers(20, 50)))
    found = by_the_program(scene)
    agree(found, Simulator(scene).dense())
    steps, columns, of = system_of(scene)
    inverse = np.linalg.inv(of.prior_rows())
    covariance = of.to_reported @ augmented_kalman(steps, columns, inverse @ inverse.T) @ of.to_reported.T
    agree(dict(zip(of.names(), np.sqrt(np.diagonal(covariance)), strict=True)), found)


# --- the same in other units ------------------------------------------------------------------------------------------


def in_radians(value):
    """A document whose angles are all radians, with every digit."""
    if isinstance(value, dict):
        return {k: in_radians(v) for k, v in value.items()}
    if isinstance(value, list):
        return [in_radians(v) for v in value]
    if isinstance(value, str) and (match := re.fullmatch(r"(-?[\d.]+) (deg(?!C)|arcsec)(.*)", value)):
        size = float(match[1]) * DEG / (3600.0 if match[2] == "arcsec" else 1.0)
        return f"{size!r} rad{match[3]}"
    return value


def test_a_spec_in_radians_predicts_what_it_does_in_degrees():
    document = copy.deepcopy(shipped("hand2"))
    document["plan"]["temperature"] = ["20 degC", "30 degC"]
    other = in_radians(document)
    assert "deg" not in str(other).replace("degC", "").replace("degree", "")
    degrees, radians = (predict(spec_of(d)) for d in (document, other))
    assert len(degrees.parameters) == 120
    for a, b in zip(degrees.parameters, radians.parameters, strict=True):
        assert b.std == pytest.approx(a.std, rel=1e-9), a.name
    for a, b in zip(degrees.requirements, radians.requirements, strict=True):
        assert b.max == pytest.approx(a.max, rel=1e-9), a.name


@pytest.mark.parametrize("factor", [1.0 / DEG, 3600.0 / DEG], ids=["deg", "arcsec"])
def test_rows_in_another_unit_of_angle_leave_the_posterior_as_it_is(factor):
    scene = random_scene(41, 2, length=20)
    moving, of = motion(scene), unit_of(scene)
    steps, columns = imu_system(moving, of, nodes_of(scene, moving))
    scaled = steps._replace(observation=steps.observation * factor, reading_variance=steps.reading_variance * factor**2)
    rows = np.concatenate([whiten(scaled, columns * factor), of.prior_rows()])
    found = dict(zip(of.names(), square_root(rows).deviations(of.to_reported), strict=True))
    agree(found, by_the_program(scene))


@pytest.mark.parametrize(
    ("key", "hidden"),
    [
        ("bias", {"standard_deviation": "2 deg/h", "temperature_degree": 5}),
        ("scale_factor", {"standard_deviation": "10 ppm", "temperature_degree": 5, "rate_degree": 3}),
    ],
)
def test_a_units_discrepancy_is_the_map_of_a_higher_degree(key, hidden):
    """Columns of the polynomials after the cubic; at rest and on moves alike."""
    spec = spec_of(shipped("hand2"))
    beyond = build_imu(changed(spec, {f"sensor.gyro.{key}.discrepancy": hidden}))
    higher = build_imu(changed(spec, {f"sensor.gyro.{key}.temperature.degree": 5}))
    columns = [imu_system(b.motion, b.model, b.body_nodes())[1] for b in (beyond, higher)]
    places = beyond.model.where("gyro", 0, f"{key}_discrepancy"), higher.model.where("gyro", 0, key)
    found, wanted = (c[:, place] for c, place in zip(columns, places, strict=True))
    per_degree = wanted.shape[1] // 6
    assert found.shape[1] == wanted[:, 4 * per_degree :].shape[1]
    assert np.max(abs(found)) > 0.0
    np.testing.assert_allclose(found, wanted[:, 4 * per_degree :], rtol=0.0, atol=1e-12 * np.max(abs(found)))
