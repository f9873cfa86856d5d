"""Channels of an IMU are read together, without noise of reading: the filter in blocks takes them as reading by
reading does."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gradcal_jax.information import imu_system, whiten
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
def test_rows_in_blocks_are_those_by_reading(system, one_by_one):
    steps, columns = system
    assert np.sum(steps.used & (steps.reading_variance == 0.0)) > 100
    assert apart(whiten(steps, columns), one_by_one) < 1e-12
    traced = whiten(jax.tree.map(jnp.asarray, steps), jnp.asarray(columns))
    assert apart(traced, one_by_one) < 1e-12
