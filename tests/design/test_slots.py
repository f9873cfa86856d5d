"""Cycles as coordinates: within the limits whatever the numbers."""

import math

import jax.numpy as jnp
import numpy as np
import pytest

from gradcal_jax.design.cycle_moves import Neighbourhood
from gradcal_jax.design.plan_objective import largest_log
from gradcal_jax.design.plan_value import inverse_root
from gradcal_jax.design.slots import CycleCoordinates, SlotTurn, TableLimits, Visits

LIMITS = TableLimits(
    rates=np.array([3.0, 5.0]),
    accelerations=np.array([4.0, 7.0]),
    reach=np.array([[-1.5, 2.0], [-np.inf, np.inf]]),
    start=np.array([0.3, 0.0]),
    largest=20.0,
    shortest=2.0,
    longest=100.0,
)
CYCLE = (
    SlotTurn(1, 7.0, 2.5, 4.0),
    SlotTurn(0, 0.9, 1.0, 0.0),
    SlotTurn(1, -3.0, 0.8, 6.0),
    SlotTurn(0, -0.9, 0.7, 3.0),
    SlotTurn(1, 2.0 * math.pi - 4.0, 1.5, 2.5),
)


def coordinates(own: float = 60.0) -> CycleCoordinates:
    """Of eight slots and so much time, s."""
    return CycleCoordinates(LIMITS, Visits(np.zeros(8, int), own))


def test_a_cycle_is_what_its_coordinates_are_decoded_to():
    plan = coordinates(sum(LIMITS.time_of(t) + t.rest for t in CYCLE))
    of = plan.structure(CYCLE)
    again = plan.cycle(plan.decode(jnp.asarray(plan.encode(CYCLE)), of), of)
    assert [t.axis for t in again] == [t.axis for t in CYCLE]
    for new, old in zip(again, CYCLE, strict=True):
        assert new.angle == pytest.approx(old.angle, rel=1e-6)
        assert new.rate == pytest.approx(old.rate, rel=1e-5)
        assert new.rest == pytest.approx(old.rest, abs=0.06)
    assert np.asarray(of.whole) == pytest.approx([0.0, 2.0 * math.pi])


@pytest.mark.parametrize("size", [0.3, 30.0])
def test_whatever_the_coordinates_the_cycle_keeps_the_limits_and_closes(size):
    """The time excepted, which a penalty keeps."""
    plan, rng = coordinates(), np.random.default_rng(round(10 * size))
    of = plan.structure(CYCLE)
    for _ in range(50):
        decoded = plan.decode(jnp.asarray(size * rng.standard_normal((3, 8))), of)
        cycle = plan.cycle(decoded, of)
        for axis in (0, 1):
            poses = LIMITS.start[axis] + np.cumsum([t.angle for t in cycle if t.axis == axis])
            assert np.all(poses >= LIMITS.reach[axis, 0] - 1e-12)
            assert np.all(poses <= LIMITS.reach[axis, 1] + 1e-12)
            turned = (poses[-1] - LIMITS.start[axis]) / (2.0 * math.pi)
            assert turned == pytest.approx(round(turned), abs=1e-12)
        assert all(t.rate <= LIMITS.rates[t.axis] for t in cycle)
        # The ramps alone do not turn further than the move does.
        ramps = [t.rate**2 / LIMITS.accelerations[t.axis] for t in cycle]
        assert all(r <= math.hypot(t.angle, 1e-3) for r, t in zip(ramps, cycle, strict=True))
        assert cycle[1].rest == 0.0
        assert all(t.rest >= LIMITS.shortest for k, t in enumerate(cycle) if k != 1)
        whole = float(jnp.sum(decoded.turning) + jnp.sum(decoded.rest))
        if decoded.left > 5.0:
            assert whole == pytest.approx(60.0, abs=1e-3)
            assert float(plan.penalty(decoded)) >= 0.0
        elif decoded.left < 0.0:
            assert float(plan.penalty(decoded)) > 0.0


def test_the_soft_largest_logarithm_is_above_the_largest_and_near_it():
    logs = jnp.asarray(np.random.default_rng(0).uniform(-0.5, 2.0, (7, 5)))
    peak = np.max(np.asarray(logs), axis=0)
    for sharpness in (8.0, 100.0):
        soft = np.asarray(largest_log(logs, sharpness, axis=0))
        assert np.all(soft >= peak)
        assert np.all(soft <= peak + math.log(7) / sharpness)
    assert np.array_equal(largest_log(logs, np.inf, axis=0), peak)


def test_the_inverse_of_badly_scaled_information():
    rng = np.random.default_rng(1)
    rows = rng.standard_normal((40, 6)) * 10.0 ** np.arange(-9, 9, 3)
    size = np.linalg.norm(rows, axis=0)
    root = np.asarray(inverse_root(jnp.asarray(rows.T @ rows)))
    covariance = root @ root.T * np.outer(size, size)
    assert covariance == pytest.approx(np.linalg.inv((rows / size).T @ (rows / size)), rel=1e-9)
    singular = np.asarray(inverse_root(jnp.asarray(np.diag([1.0, 1.0, -1.0]))))
    assert np.all(np.isnan(singular @ singular.T))


def test_changed_cycles_keep_the_reach_and_the_number_of_turns():
    around, rng = Neighbourhood(LIMITS, 9), np.random.default_rng(0)
    cycle, kinds = CYCLE, set()
    for _ in range(300):
        cycle = around.neighbour(cycle, rng)
        kinds.add(len(cycle))
        assert 2 <= len(cycle) <= 9
        assert all(abs(t.angle) <= LIMITS.largest * (1.0 + 1e-12) for t in cycle)
        poses = LIMITS.start[0] + np.cumsum([t.angle for t in cycle if t.axis == 0])
        assert np.all((poses >= -1.5 - 1e-12) & (poses <= 2.0 + 1e-12))
    assert len(kinds) >= 6
    # A turn beyond one end goes the other way, as far as the axis does; at its end nothing is left of a turn.
    far = SlotTurn(0, 9.0, 1.0, 3.0)
    assert [t.angle for t in around.within([CYCLE[0], far, far])] == pytest.approx([7.0, -1.8])
    drawn = around.random(30, rng)
    assert 7 < len(drawn) <= 30
    assert {t.axis for t in drawn} == {0, 1}
