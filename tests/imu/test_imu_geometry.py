"""Every geometric column against finite differences of the finite, nonlinear geometry, and derivatives by JAX."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from imu_helpers import ARCSEC, DEG, EAST, POINTS, UP, accelerometer, gyro, motion_of, rest, table, turn, unit
from random_imus import motion, nodes_of, random_scene, unit_of
from reference_imu import Simulator

from gradcal_jax import model
from gradcal_jax import motion as trajectory
from gradcal_jax.information import SquareRootInformation, whitened_factor
from gradcal_jax.information.imu_rows import imu_information, imu_system, segments_of
from gradcal_jax.motion import Geometry

SCENES = [(1, 1, 1), (2, 2, 1), (3, 3, 1), (4, 2, 3)]


@pytest.mark.parametrize(("seed", "axes", "mountings"), SCENES)
def test_installation_columns_are_derivatives_of_the_finite_geometry(seed, axes, mountings):
    """Tilt, azimuth, non-orthogonality, harmonics, mountings and gravity, all channels, all segments: 1e-7."""
    scene = random_scene(50 + seed, axes, mountings, length=14)
    simulator, moving, of = Simulator(scene), motion(scene), unit_of(scene)
    nodes, at = nodes_of(scene, moving), segments_of(moving, of)
    ours = {}
    for term in of.installation:
        columns = at.sums(term.columns(nodes)[nodes.kind])
        ours |= {name: columns[:, :, j] for j, name in enumerate(term.names())}
    errors = simulator.installation()
    assert set(ours) == {*errors, "sample_clock"}
    size = scene.gravity * np.diff(simulator.times)[:, None]
    for name, error_of in errors.items():
        finite = simulator.by_differences(error_of, 1e-3 if name.startswith("angle") else 4e-3)
        np.testing.assert_allclose(ours[name], finite, rtol=0, atol=1e-7 * np.max(np.abs(finite)), err_msg=name)
        # As exactly as float64 carries the readings themselves, by the complex step.
        exact = simulator.by(error_of)
        assert np.all(np.abs(ours[name] - exact) < 1e-11 * np.max(np.abs(exact)) + 1e-14 * size), name


@pytest.mark.parametrize(("seed", "axes", "mountings"), SCENES)
def test_the_encoders_part_in_every_row_is_a_derivative_too(seed, axes, mountings):
    """Errors of the standstill now and of the one before, of the axis that turns and of those outside and inside it."""
    scene = random_scene(60 + seed, axes, mountings, length=14)
    simulator, moving, of = Simulator(scene), motion(scene), unit_of(scene)
    steps, _ = imu_system(moving, of, nodes_of(scene, moving))
    rows = np.asarray(steps.observation)[np.asarray(steps.used)][:, -2 * axes :]
    segment, channel = (np.array(v) for v in zip(*simulator.rows(), strict=True))
    assert len(rows) == len(segment)
    for k in range(axes):
        for part, now in ((k, True), (axes + k, False)):
            finite = simulator.by_differences(simulator.encoder(k, now=now))[segment, channel]
            np.testing.assert_allclose(rows[:, part], finite, rtol=0, atol=1e-7 * max(1.0, np.max(np.abs(finite))))
    # The encoder of an inner axis while the outer one turns: 31 rad of turning times its error.
    if axes > 1:
        outer = np.array([scene.steps[k].axis == 0 for k in segment]) & (channel < 3)
        assert np.max(np.abs(rows[outer][:, axes - 1])) > 1.0


def test_the_attitude_is_a_rotation_and_the_rate_its_derivative():
    """Of the program's own nodes: RᵀR = 1, and R' = R ω× along a turn."""
    geometry = table(EAST, np.array([0.6, 0.0, 0.8]), UP)
    for axis in range(3):
        moving = motion_of(geometry, [turn(axis, 200.0)], start=(20.0, -50.0, 70.0))
        group = trajectory.body_nodes(moving, POINTS).groups[-1]
        attitude = np.concatenate(group.attitude)
        np.testing.assert_allclose(np.swapaxes(attitude, 1, 2) @ attitude - np.eye(3), 0.0, atol=1e-14)
        h = 1e-6
        here, there, back = (
            trajectory.frames(geometry, group.angle[1, :1] + s * h * np.eye(3)[axis], np.zeros(1, int)).attitude[0]
            for s in (0, 1, -1)
        )
        slope = here.T @ (there - back) / (2.0 * h) * group.joint[1, 0, axis]
        relative = group.rate[1, 0] - group.earth[1, 0]
        x, y, z = relative
        np.testing.assert_allclose(slope, [[0, -z, y], [z, 0, -x], [-y, x, 0]], atol=1e-7)


# --- derivatives ------------------------------------------------------------------------------------------------------

_STEPS = [rest(6.0), turn(1, 300.0), rest(5.0), turn(1, -250.0), turn(0, 80.0), rest(7.0), turn(0, 180.0), rest(4.0)]
_STEPS += [turn(1, 100.0), rest(6.0), turn(0, -120.0), rest(8.0)]
_START = motion_of(table(EAST, UP), _STEPS, start=(10.0, 20.0))
_COURSE = trajectory.programme(20.0, [(sum(s.move.duration for s in _STEPS), 0.05)])
_PLAN = trajectory.gradient_plan(_COURSE, tuple(s.move for s in _STEPS), read_every=None)
_COUNT = len(_STEPS)
# Of every number: its size.
_NUMBERS = {
    "rests": np.ones(_COUNT) * 6.0,
    "peak rates": np.ones(_COUNT),
    "start": np.array([10.0, 20.0]) * DEG,
    "latitude": np.array([0.57]),
    "axes": np.array([0.01, -0.02, 0.03]),
    "white": np.array([4e-5, 8e-4]),
    "drift": np.array([5e-6, 5e-4]),
    "offset": np.array([5.0, 7.0]) * ARCSEC,
    "reading": np.array([5.0, 4.0]) * ARCSEC,
    "tilt": np.array([1e-4, 2e-4, 5e-3]),
}


def of_jax(tree):
    """Its numbers as JAX's; what is whole stays what it is."""
    return jax.tree.map(lambda x: jnp.asarray(x) if np.asarray(x).dtype == float else x, tree)


def value(numbers: dict, which: np.ndarray) -> jax.Array:
    """Sum of the squared standard deviations of some parameters, everything through JAX."""
    resting = np.array([s.axis < 0 for s in _STEPS])
    duration = jnp.where(resting, numbers["rests"], jnp.asarray(_PLAN.duration))
    # A turn's peak rate scales its angle; its time stays.
    plan = eqx.tree_at(
        lambda s: (s.duration, s.peak_rate),
        of_jax(_PLAN),
        (duration, jnp.asarray(_PLAN.peak_rate) * numbers["peak rates"]),
    )
    tilted = jnp.array([0.0, 0.0, 1.0]) + numbers["axes"]
    axes = jnp.stack([jnp.array(EAST), tilted / jnp.sqrt(jnp.sum(tilted**2))])
    geometry = Geometry(axes, np.eye(3), np.eye(3)[None], numbers["latitude"][0], np.asarray(9.8))
    moving = replace(_START, line=plan.trajectory(), geometry=geometry, start_angles=numbers["start"])
    channels = [gyro(i, drift=((1e-6, 100.0),), std=_FLAT) for i in range(3)]
    channels += [accelerometer(i, drift=((1e-4, 100.0),), std=_FLAT) for i in range(3)]

    def noisy(channel, i):
        at = int(channel.kind == "accelerometer")
        p = channel.model.processes
        std = numbers["drift"][at] * jnp.ones(1)
        return eqx.tree_at(
            lambda c: (c.model.angle_random_walk, c.model.processes.initial_std, c.model.processes.diffusion),
            channel,
            (numbers["white"][at], std, std * jnp.sqrt(2.0 * jnp.asarray(p.decay))),
        )

    of = unit(
        [noisy(c, i) for i, c in enumerate(channels)],
        [
            model.BaseTilt(numbers["tilt"]),
            model.NonOrthogonality(np.array([1e-4]), ("tilt", "spin")),
            model.AxisHarmonics(np.full(4, 5.0 * ARCSEC), (1, 2), 1, "spin"),
        ],
        model.EncoderNoise(numbers["offset"], numbers["reading"], np.full(2, 1.7)),
    )
    nodes = trajectory.body_nodes(moving, POINTS)
    steps, columns = imu_system(moving, of, nodes)
    info = SquareRootInformation(*whitened_factor(steps, columns, jnp.asarray(of.prior_rows())))
    found = info.deviations(jnp.eye(of.size)[which])
    return jnp.sum((found * 1e6) ** 2)


_FLAT = {"b": 1e-2, "s": 1e-2, "m": 1e-2, "g": 1e-3}
# The bias of gyro y, misalignments of gyro z, all of accelerometer x.
_WHICH = np.array([8, 18, 19, 24, 25, 26, 27])


@pytest.mark.long
def test_gradients_in_every_kind_of_number_against_central_differences():
    which = _WHICH
    numbers = {k: jnp.asarray(v) for k, v in _NUMBERS.items()}
    compiled = jax.jit(jax.value_and_grad(lambda n: value(n, which)))
    found = compiled(numbers)[1]
    rng = np.random.default_rng(3)
    for name, start in _NUMBERS.items():
        direction = rng.normal(size=start.shape) * np.maximum(np.abs(start), 0.01)
        if name == "rests":
            direction *= [s.axis < 0 for s in _STEPS]
        h = 1e-4
        at = lambda x: float(compiled(numbers | {name: jnp.asarray(start + x * direction)})[0])  # noqa: E731, B023
        finite = (8.0 * (at(h) - at(-h)) - (at(2.0 * h) - at(-2.0 * h))) / (12.0 * h)
        ours = float(jnp.sum(found[name] * direction))
        assert np.isfinite(ours)
        assert ours == pytest.approx(finite, rel=2e-6, abs=1e-7 * at(0.0)), name


@pytest.mark.evidence
def test_both_array_libraries_compute_the_same_unit():
    """The rows that JAX traces are those that NumPy computes."""
    scene = random_scene(71, 2, length=6)
    moving, of = motion(scene), unit_of(scene)
    nodes = nodes_of(scene, moving)
    steps, columns = imu_system(moving, of, nodes)
    traced = of_jax((moving, of))
    again = trajectory.body_nodes(traced[0], POINTS)
    their_steps, their_columns = imu_system(*traced, again)
    assert isinstance(their_columns, jax.Array)
    # An integral of gravity over a segment carries rounding of 1e-13, whatever is left of it in a column.
    size = np.max(np.abs(columns), axis=0)
    assert np.all(np.abs(np.asarray(their_columns) - columns) < 1e-12 * size + 4e-13)
    for name, ours, theirs in zip(steps._fields, steps, their_steps, strict=True):
        ours, theirs = np.asarray(ours, float), np.asarray(theirs, float)
        np.testing.assert_allclose(theirs, ours, rtol=1e-11, atol=1e-12 * np.max(np.abs(ours)), err_msg=name)
    info = imu_information([(moving, nodes)], of)
    factor = SquareRootInformation(*whitened_factor(their_steps, their_columns, jnp.asarray(of.prior_rows())))
    wanted = info.deviations(of.to_reported)
    np.testing.assert_allclose(factor.deviations(jnp.asarray(of.to_reported)), wanted, rtol=1e-9)
