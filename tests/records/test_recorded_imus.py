"""The rate about the table's axis by which an IMU's own recording is laid on a run, whatever the mounting."""

import numpy as np
import pytest

import gradcal_jax as gj
from gradcal_jax.records.run_log import _about_innermost

TURNING = np.concatenate([np.zeros(200), np.full(60, 90.0), np.zeros(100), np.full(60, -90.0), np.zeros(200)])


@pytest.mark.parametrize(("mounting", "axis", "sign"), [(0, 0, 1), (1, 1, 1), (2, 2, 1)])
def test_of_a_table_of_one_axis_each_mounting_shows_the_same_turns(mounting, axis, sign):
    table = gj.parse_spec(gj.presets.text("one-axis-table")).rig.table
    rates = np.tile([0.5, -0.3, 0.2], (len(TURNING), 1))
    rates[:, axis] += sign * TURNING
    found = _about_innermost(table, dict(zip("xyz", rates.T, strict=True)))
    np.testing.assert_allclose(found, TURNING, atol=1e-9)
    assert float(np.dot(table.mounting[mounting].columns[axis], table.axis[-1].unit_vector)) == sign


def test_of_two_axes_the_inner_one_is_seen_by_the_gyro_along_it():
    table = gj.parse_spec(gj.presets.text("two-axis-table")).rig.table
    rates = np.zeros((len(TURNING), 3))
    rates[:, 2] = TURNING
    rates[:, 0] = np.roll(TURNING, 300)  # the outer one turns at another time
    np.testing.assert_allclose(_about_innermost(table, dict(zip("xyz", rates.T, strict=True))), TURNING, atol=1e-9)
