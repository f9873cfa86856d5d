"""Closest neighbours: on a simulated log, beside the map that was fitted to the same log."""

import numpy as np
import pytest
from logs_zoo import estimated, spec_of
from simulated_log import simulate_log

import gradcal_jax as gj
from gradcal_jax.records.log import LogError


def test_neighbours_agree_with_the_map_within_what_they_scatter():
    spec = spec_of()
    made = simulate_log(spec, sample_rate_hz=20.0, seed=31)
    (channel,) = estimated(spec, made.log)
    calibration = channel.calibration
    (axis,) = gj.validate(calibration, made.log, neighbours_k=14.0)
    cells = [cell for cell in axis.cells if cell.unit == "ppm" and cell.how_many > 3]
    assert len(cells) >= 4
    assert len({cell.rate_dps[0] > 0.0 for cell in cells}) == 2
    # A few moves do not tell their scatter: that of all.
    count = np.array([cell.how_many for cell in cells])
    scatter = np.sqrt(np.sum([cell.scatter**2 for cell in cells] * count) / np.sum(count - 1))
    errors = scatter / np.sqrt(count)
    off = np.array([cell.after for cell in cells]) / errors
    assert np.sqrt(np.mean(off**2)) < 2.0
    assert max(errors) < 100.0
    assert np.ptp([cell.before - cell.after for cell in cells]) > 300.0  # the map is not flat, and they follow it
    with pytest.raises(LogError, match="was estimated from this log"):
        gj.validate(calibration, made.log)
    with pytest.raises(ValueError, match="must be positive"):
        gj.validate(calibration, made.log, neighbours_k=0.0)
