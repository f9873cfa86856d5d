"""Channels of an IMU are read together, without noise of reading: the filter in blocks takes them as reading by
reading does, wherever a block begins."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gradcal_jax.information import gram, imu_system, whiten
from gradcal_jax.information.by_reading import filter_readings
from gradcal_jax.model.imu_build import build_imu
from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.spec import read_spec

HAND2 = Path(__file__).parents[2] / "experiments" / "imu" / "hand2.toml"


@pytest.fixture(scope="module")
def system():
    """Steps and columns of a short ramp of a whole IMU."""
    spec = changed(read_spec(HAND2), {"plan.gradient": "20 K/min", "rig.chamber.max_heating": "20 K/min"})
    built = build_imu(spec)
    return jax.tree.map(np.asarray, imu_system(built.motion, built.model, built.body_nodes()))


def apart(rows, of) -> float:
    """The largest difference of two products of rows, in the scale of the second's diagonal."""
    a, b = (np.asarray(x).T @ np.asarray(x) for x in (rows, of))
    scale = np.sqrt(np.where(np.diag(b) > 0.0, np.diag(b), 1.0))
    return float(np.max(np.abs(a - b) / np.outer(scale, scale)))


@pytest.fixture(scope="module")
def one_by_one(system):
    """Its whitened rows, reading by reading."""
    steps, columns = system
    zeros = np.zeros((steps.observation.shape[1], columns.shape[1]))
    return filter_readings(zeros, steps.initial, steps, columns).rows


@pytest.mark.long
@pytest.mark.parametrize("block", [2, 5, 17])
def test_rows_do_not_depend_on_where_a_block_begins(system, one_by_one, block):
    steps, columns = system
    assert np.sum(steps.used & (steps.reading_variance == 0.0)) > 100
    assert apart(whiten(jax.tree.map(jnp.asarray, steps), jnp.asarray(columns), block=block), one_by_one) < 1e-12


@pytest.mark.long
def test_information_and_gradient_are_the_same_without_machine_code(system, monkeypatch):
    steps, columns = jax.tree.map(jnp.asarray, system)
    direction = np.random.default_rng(0).standard_normal(columns.shape[1])
    direction /= np.sqrt(np.maximum(np.diag(np.asarray(gram(steps, columns))), 1e-30))

    def of(columns, scale):
        noise = steps._replace(covariance=scale * steps.covariance)
        return direction @ gram(noise, columns) @ direction

    quick = jax.value_and_grad(of, argnums=(0, 1))(columns, 1.0)
    monkeypatch.setenv("GRADCAL_NATIVE", "0")
    plain = jax.value_and_grad(of, argnums=(0, 1))(columns, 1.0)
    for a, b in zip(jax.tree.leaves(quick), jax.tree.leaves(plain), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-11 * float(np.max(np.abs(a))))
