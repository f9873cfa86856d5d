"""Random scenes of whole units, and what the program makes of a scene."""

import numpy as np
from imu_helpers import ARCSEC, AXES, DEG, DEG_PER_H, POINTS, G, Step, accelerometer, gyro, motion_of
from reference_imu import Scene, rotated

from gradcal_jax import model
from gradcal_jax import motion as trajectory
from gradcal_jax.information.imu_rows import imu_system
from gradcal_jax.information.noise_steps import NoiseSteps
from gradcal_jax.model import BodyNodes, EncoderNoise, ImuModel, Polynomial
from gradcal_jax.motion import Geometry, TableMotion

PRIORS = {
    "gyro a": 500 * DEG_PER_H,
    "gyro b": 5e-3,
    "gyro m": 1e-2,
    "gyro g_": 50 * DEG_PER_H / G,
    "force b": 20e-3 * G,
    "force s": 5e-3,
    "force m": 1e-2,
    "force k2": 1e-3 / G,
    "tilt": 1e-4,
    "azimuth": 5e-3,
    "orthogonality": 1e-4,
    "angle": 5 * ARCSEC,
    "mounting": 2e-4,
    "gravity": 1e-5 * G,
    "sample_clock": 2e-5,
}


def random_direction(rng: np.random.Generator) -> np.ndarray:
    vector = rng.normal(size=3)
    return vector / np.linalg.norm(vector)


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    return rotated(random_direction(rng), rng.uniform(0.0, np.pi))


def random_scene(seed: int, axes: int, mountings: int = 1, length: int = 30) -> Scene:
    """Skew axes on a skew base, skew mountings, rests and turns of every axis, all nuisances and noises."""
    rng = np.random.default_rng(seed)
    some = lambda: float(np.exp(rng.uniform(-0.7, 0.7)))  # noqa: E731
    steps: list[Step] = []
    for k in range(length):
        mounting = k * mountings // length
        if rng.uniform() < 0.45 or k == 0:
            steps.append(Step(-1, float(rng.uniform(2.0, 12.0)), mounting=mounting))
        else:
            angle = float(rng.choice([-1, 1]) * rng.uniform(0.3, 12.0))
            peak = float(rng.uniform(20.0, 300.0)) * DEG
            steps.append(Step(int(rng.integers(axes)), 0.0, angle, peak, float(rng.uniform(200, 500)) * DEG, mounting))
    return Scene(
        axes=tuple(random_direction(rng) for _ in range(axes)),
        base=random_rotation(rng),
        mountings=tuple(random_rotation(rng) for _ in range(mountings)),
        latitude=float(rng.uniform(-1.4, 1.4)),
        gravity=float(rng.uniform(9.78, 9.83)),
        steps=tuple(steps),
        start=tuple(float(v) for v in rng.uniform(-3.0, 3.0, axes)),
        temperature=(float(rng.uniform(-30.0, 20.0)), float(rng.uniform(0.05, 0.2))),
        gyros=(0, 1, 2),
        accelerometers=(0, 1, 2),
        gyro_white=0.15 * DEG / 60.0 * some(),
        force_white=0.05 / 60.0 * some(),
        drift=((DEG_PER_H * some(), 120.0 * some()), (5.0 * DEG_PER_H * some(), 4.0 * some())),
        instability=((20e-6 * some(), 60.0 * some()),),
        force_drift=((50e-6 * G * some(), 200.0 * some()),),
        offset=tuple(5.0 * ARCSEC * some() for _ in range(axes)),
        reading=tuple(5.0 * ARCSEC * some() for _ in range(axes)),
        every=tuple(float(rng.uniform(0.3, 2.0)) for _ in range(axes)),
        orders=tuple(tuple(sorted(rng.choice([1, 2, 3, 5], 2, replace=False).tolist())) for _ in range(axes)),
        priors=PRIORS,
    )


def motion(scene: Scene) -> TableMotion:
    """The program's."""
    geometry = Geometry(
        np.array(scene.axes),
        scene.base,
        np.array(scene.mountings),
        np.asarray(scene.latitude),
        np.asarray(scene.gravity),
    )
    return motion_of(geometry, scene.steps, start=np.array(scene.start) / DEG, temperature=scene.temperature)


def unit_of(scene: Scene) -> ImuModel:
    """The program's model."""
    centre, scale, rate_scale = scene.centre_and_scale
    basis = Polynomial(scene.powers[0], centre, scale)
    prior = scene.priors
    gyros = [
        gyro(
            i,
            white=scene.gyro_white,
            drift=scene.drift,
            instability=scene.instability,
            std={"b": prior["gyro a"], "s": prior["gyro b"], "m": prior["gyro m"], "g": prior["gyro g_"]},
            basis=basis,
            rate_basis=Polynomial(scene.powers[1], 0.0, rate_scale),
        )
        for i in scene.gyros
    ]
    forces = [
        accelerometer(
            i,
            "b s m k2",
            white=scene.force_white,
            drift=scene.force_drift,
            std={k: prior[f"force {k}"] for k in ("b", "s", "m", "k2")},
            basis=basis,
        )
        for i in scene.accelerometers
    ]
    names = tuple(f"axis{l}" for l in range(len(scene.axes)))
    tilt = np.array([prior["tilt"], prior["tilt"], prior["azimuth"]])
    installation: list[model.InstallationTerm] = [model.BaseTilt(tilt)]
    if len(names) > 1:
        installation.append(model.NonOrthogonality(np.full(len(names) - 1, prior["orthogonality"]), names))
    installation += [
        model.AxisHarmonics(np.full(2 * len(orders), prior["angle"]), orders, l, names[l])
        for l, orders in enumerate(scene.orders)
        if orders
    ]
    installation += [
        model.MountingError(np.full(3 * len(scene.mountings), prior["mounting"])),
        model.CommonScale(np.array([prior["gravity"]]), "gravity"),
        model.CommonScale(np.array([prior["sample_clock"]]), "sample_clock"),
    ]
    noise = EncoderNoise(np.array(scene.offset), np.array(scene.reading), np.array(scene.every), scene.held)
    return ImuModel(tuple(gyros + forces), tuple(installation), noise)


def nodes_of(scene: Scene, moving: TableMotion) -> BodyNodes:
    return trajectory.body_nodes(moving, POINTS)


def system_of(scene: Scene) -> tuple[NoiseSteps, np.ndarray, ImuModel]:
    """The program's noise steps and regressors of a scene, and its model."""
    moving, of = motion(scene), unit_of(scene)
    return *imu_system(moving, of, nodes_of(scene, moving)), of


assert AXES == "xyz"
