"""Three roads to a unit's covariance: joint filter, dense generalised least squares, augmented Kalman filter."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import augmented_kalman, dense_of
from imu_helpers import shipped
from random_imus import motion, nodes_of, random_scene, system_of, unit_of
from reference_imu import Scene, Simulator

from gradcal_jax.information.imu_rows import imu_system
from gradcal_jax.information.plan_information import imu_information
from gradcal_jax.model.build import build_imu
from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.spec import spec_of


def by_the_program(scene: Scene) -> dict[str, float]:
    moving, of = motion(scene), unit_of(scene)
    found = imu_information(moving, of, nodes_of(scene, moving))[0].deviations(of.to_reported)
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


@pytest.mark.parametrize("change", [{}, {"held": False}], ids=str)
@pytest.mark.parametrize(("seed", "axes", "mountings"), SCENES)
def test_every_column_and_the_covariance_of_the_rows(seed, axes, mountings, change):
    """The regressors one by one to 1e-11, and the covariance
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
        tolerance = 1e-11 * np.max(np.abs(column)) + rounding
        np.testing.assert_allclose(ours[name], column, rtol=0, atol=tolerance, err_msg=name)
    wanted = simulator.covariance()
    size = np.sqrt(np.diagonal(wanted))
    np.testing.assert_allclose(dense_of(steps) / np.outer(size, size), wanted / np.outer(size, size), atol=1e-11)


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
    ],
    ids=str,
)
def test_units_of_fewer_channels_and_tables_of_fewer_faults(change):
    scene = replace(random_scene(21, 2, length=22), **change)
    agree(by_the_program(scene), Simulator(scene).dense())


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
