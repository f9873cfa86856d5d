"""What the plans' room promises by itself: moves end where they should, and timelines are on time."""

import jax.numpy as jnp
import numpy as np
import pytest

from gradcal_jax import motion as trajectory
from gradcal_jax.formulas import SHAPES
from gradcal_jax.motion.motion import divide

RATE, TIME, RAMP = -2.5, 7.0, 1.5


def a_turn(shape, **more):
    return trajectory.turn(shape, RATE, TIME, ramp=RAMP, unevenness=0.3, **more)


@pytest.mark.parametrize("shape", SHAPES)
def test_a_move_takes_its_time_turns_its_angle_and_never_jumps(shape):
    move = a_turn(shape, read_every=2.0)
    pieces = move.pieces
    duration = (pieces.u_end - pieces.u_start) * (pieces.by_duration * TIME + pieces.by_ramp * move.ramp)
    assert duration.sum() == pytest.approx(TIME, rel=1e-14)
    turned = RATE * (0.5 * TIME - RAMP if shape == "hand" else TIME - RAMP)
    line = trajectory.gradient_plan(trajectory.programme(0.0, [(TIME, 0.1)]), (move,)).trajectory()
    assert float(np.sum(np.asarray(line.turned()))) == pytest.approx(turned, abs=1e-12)
    every = np.arange(line.piece_count)
    ends = np.asarray(line.rate(jnp.tile(jnp.array([0.0, 1.0]), (len(every), 1))))
    np.testing.assert_allclose(ends[1:, 0], ends[:-1, 1], atol=1e-12)
    np.testing.assert_allclose([ends[0, 0], ends[-1, 1]], 0.0, atol=1e-12)
    # Readings every 2 s, the one at the end included only if it falls there.
    np.testing.assert_allclose(np.cumsum(duration)[np.asarray(pieces.read)], [2.0, 4.0, 6.0], rtol=1e-13)


def test_ramps_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="shorten the ramps"):
        trajectory.turn("cosine ramps", 1.0, 2.0, ramp=1.1)


@pytest.mark.parametrize(
    ("readings", "longest", "edges", "read"),
    [
        ([], np.inf, (0.0, 1.0), (False,)),
        ([4.0, 8.0], np.inf, (0.0, 0.5, 1.0), (True, True)),
        ([2.0], np.inf, (0.0, 0.25, 1.0), (True, False)),
        ([4.0], 2.0, (0.0, 0.25, 0.5, 0.75, 1.0), (False, True, False, False)),
    ],
)
def test_divisions(readings, longest, edges, read):
    assert divide(8.0, tuple(readings), longest) == (edges, read)


def test_a_cycle_repeats_and_the_chambers_knee_divides_a_piece():
    """Two cycles of 10 s with 5 s after each; what is left is standing; the slope turns at 21 s, inside a move."""
    moves = (trajectory.rest(4.0, 2.0), trajectory.turn("cosine ramps", 1.0, 6.0, ramp=3.0))
    programme = trajectory.programme(-10.0, [(21.0, 0.5), (14.0, -0.25)])
    plan = trajectory.gradient_plan(programme, moves, (trajectory.rest(5.0),), read_every=3.0)
    assert np.count_nonzero(np.diff(plan.pieces.move == 1)) // 2 == 2
    line = plan.trajectory()
    start, end = np.asarray(line.start), np.asarray(line.start + line.duration)
    np.testing.assert_allclose(start[1:], end[:-1], atol=1e-12)
    assert end[-1] == pytest.approx(float(programme.times()[-1])) == pytest.approx(35.0)
    np.testing.assert_allclose(end[np.asarray(line.read)], [2, 4, 10, 17, 19, 25, 28, 31, 34], atol=1e-12)
    assert np.any(np.isclose(start, 21.0))
    ends = np.asarray(line.temperature(jnp.tile(jnp.array([0.0, 1.0]), (line.piece_count, 1))))
    wanted = np.where(end <= 21.0 + 1e-9, -10.0 + 0.5 * end, 0.5 - 0.25 * (end - 21.0))
    np.testing.assert_allclose(ends[:, 1], wanted, atol=1e-12)
    np.testing.assert_allclose(ends[1:, 0], ends[:-1, 1], atol=1e-12)
    assert set(plan.pieces.move[line.moving].tolist()) == {1}


def test_a_stretch_that_is_not_used_is_a_gap_without_readings_and_cycles_begin_anew_behind_it():
    moves = (trajectory.rest(4.0, 2.0), trajectory.turn("cosine ramps", 1.0, 6.0, ramp=3.0))
    programme = trajectory.programme(0.0, [(5.0, 0.0), (12.0, 0.2), (6.0, 0.0), (14.0, 0.2), (2.0, 0.0)])
    line = trajectory.gradient_plan(programme, moves, used=((1, 2), (3, 4)), read_every=None).trajectory()
    end = line.start + line.duration
    assert (line.start[0], end[-1]) == (5.0, 37.0)
    np.testing.assert_allclose((line.start[line.gap], end[line.gap]), [[17.0], [23.0]], atol=1e-12)
    np.testing.assert_allclose(end[line.read], [7, 9, 15, 17, 25, 27, 33, 37], atol=1e-12)
    assert not line.moving[line.gap].any()


def test_moves_that_fit_nowhere_are_refused():
    with pytest.raises(ValueError, match="longer than every used part"):
        trajectory.gradient_plan(trajectory.programme(0.0, [(5.0, 0.1)]), (trajectory.rest(6.0),))


def test_a_lagging_sensor_follows_its_differential_equation():
    """dT/dt = (T_chamber − T)/lag, from equilibrium, over a ramp and a hold; against small steps of Heun's method."""
    lag, programme = 40.0, trajectory.programme(10.0, [(60.0, 0.5), (90.0, 0.0)])
    line = trajectory.gradient_plan(programme, read_every=10.0).trajectory(lag)
    assert float(line.lag_rate) == 1.0 / lag
    step, sensor, at = 0.01, 10.0, {}
    chamber = lambda t: 10.0 + 0.5 * min(t, 60.0)  # noqa: E731
    for k in range(15000):
        t = k * step
        slope = (chamber(t) - sensor) / lag
        ahead = (chamber(t + step) - sensor - step * slope) / lag
        sensor += step * (slope + ahead) / 2
        at[k + 1] = sensor
    ends = np.asarray(line.temperature(jnp.ones((line.piece_count, 1))))[:, 0]
    wanted = [at[round(float(t) / step)] for t in np.asarray(line.start + line.duration)]
    np.testing.assert_allclose(ends, wanted, atol=1e-6)
    # And its slope, in the middle of each piece.
    after, before = (np.asarray(line.temperature(np.full((line.piece_count, 1), v))) for v in (0.5001, 0.4999))
    lasting = np.asarray(line.duration)[:, None]
    slope = np.asarray(line.temperature_slope(0.5 * lasting))
    np.testing.assert_allclose(slope, (after - before) / (2e-4 * lasting), atol=1e-7)


def test_a_standard_plan_soaks_then_holds_each_rate():
    plan = trajectory.standard_plan([-20.0, 50.0], 100.0, 30.0, [-1.0, 0.0, 2.0])
    line = plan.trajectory()
    assert float(line.start[-1] + line.duration[-1]) == 2 * (100.0 + 3 * 30.0)
    assert line.rates
    np.testing.assert_array_equal(line.read, ~line.gap)
    np.testing.assert_allclose(line.start[line.read], [100.0, 130.0, 160.0, 290.0, 320.0, 350.0])
    np.testing.assert_allclose(line.turned()[line.read], [-30.0, 0.0, 60.0] * 2)
    np.testing.assert_allclose(line.level, [-20.0] * 4 + [50.0] * 4)
