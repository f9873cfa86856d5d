"""Every geometric column against finite differences of the finite, nonlinear geometry, and derivatives by JAX."""

import numpy as np
import pytest
from random_imus import motion, nodes_of, random_scene, unit_of
from reference_imu import Simulator

from gradcal_jax.information.imu_rows import imu_system, segments_of

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
            finite = simulator.by(simulator.encoder(k, now=now))[segment, channel]
            np.testing.assert_allclose(rows[:, part], finite, rtol=0, atol=1e-7 * max(1.0, np.max(np.abs(finite))))
    # The encoder of an inner axis while the outer one turns: 31 rad of turning times its error.
    if axes > 1:
        outer = np.array([scene.steps[k].axis == 0 for k in segment]) & (channel < 3)
        assert np.max(np.abs(rows[outer][:, axes - 1])) > 1.0
