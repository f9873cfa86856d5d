"""Closest neighbours: moves between rests, by hand and on a simulated log beside the fitted map."""

from dataclasses import replace

import numpy as np
import pytest
from logs_zoo import estimated, spec_of
from simulated_log import simulate_log

from gradcal_jax.estimation import closest_neighbours, moves_between_rests
from gradcal_jax.estimation.log_rows import Options


def test_the_drift_of_the_rests_beside_a_move_is_taken_off_it():
    """Rest, move in two parts, rest, move, gap, rest: a bias that grows evenly, and 1000 ppm of the first move."""
    duration = np.array([10.0, 4.0, 6.0, 10.0, 10.0, 0.0, 10.0])
    moving = np.array([False, True, True, False, True, False, False])
    broken = np.array([False, False, False, False, False, True, False])
    turned = np.array([0.0, 3.0, 5.0, 0.0, -8.0, 0.0, 0.0])
    ends = np.cumsum(duration)
    bias = 1e-4 * ends + 0.5e-6 * ends**2
    error = np.diff(bias, prepend=0.0) + 1e-3 * turned
    moves = moves_between_rests(error, 2e-3 * turned, turned, duration, np.full(7, 25.0), moving, broken)
    assert len(moves.scale_factor) == 1  # after the second the integral is broken, so it has one neighbour only
    assert moves.scale_factor[0] == pytest.approx(1e-3, rel=1e-9)
    assert moves.of_map[0] == pytest.approx(2e-3, rel=1e-12)
    assert moves.rate_rad_per_s[0] == pytest.approx(0.8)
    (group,) = closest_neighbours(moves, 5.0)
    assert group.moves == 1
    assert group.standard_error is None
    with pytest.raises(ValueError, match="must be positive"):
        closest_neighbours(moves, 0.0)


def test_groups_agree_with_the_map_within_what_they_scatter():
    spec = spec_of()
    made = simulate_log(spec, sample_rate_hz=20.0, seed=31)
    (channel,) = estimated(spec, made.log, options=Options(neighbours_k=14.0))
    groups = [g for g in channel.neighbours["gyro_x"] if g.moves > 3]
    assert len(groups) >= 4
    assert len({round(np.degrees(g.rate_rad_per_s)) for g in groups}) >= 2
    off = np.array([(g.scale_factor - g.of_map) / g.standard_error for g in groups])
    assert np.sqrt(np.mean(off**2)) < 2.0
    assert max(g.standard_error for g in groups) < 100e-6
    assert np.ptp([g.of_map for g in groups]) > 300e-6  # the map is not flat, and they follow it
    (silent,) = estimated(spec, made.log)
    assert not silent.neighbours
    (alone,) = estimated(
        spec, replace(made.log, table_axes=(), table_angle_rad=None), options=Options(neighbours_k=14.0)
    )
    assert any("no moves can be averaged" in message for message in alone.messages)
