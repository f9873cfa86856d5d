"""Simulated annealing over poses: every cycle that it tries returns, stays within its travel, and the best is kept."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gradcal_jax.design.pose_search import CycleItem, PoseLimits, anneal, closed, feasible, neighbour

LIMITS = PoseLimits(8, (300.0, 100.0), ((-math.inf, math.inf), (-16.0, 16.0)), 2.0, 60.0, 12)
ITEMS = st.builds(
    CycleItem,
    st.integers(0, 1),
    st.integers(-24, 24),
    st.floats(1.0, 100.0),
    st.sampled_from([0.0, 2.0, 7.5, 60.0]),
)


@settings(max_examples=200, deadline=None)
@given(cycle=st.lists(ITEMS, min_size=2, max_size=12).map(tuple), seed=st.integers(0, 2**32 - 1))
def test_every_neighbour_returns_and_keeps_the_limits(cycle, seed):
    rng, cycle = np.random.default_rng(seed), closed(cycle, LIMITS)
    for _ in range(20 if cycle else 0):
        cycle = neighbour(cycle, LIMITS, rng) or cycle
        outer, inner = (sum(i.steps for i in cycle if i.axis == axis) for axis in (0, 1))
        assert outer % 8 == 0
        assert inner == 0
        assert len(cycle) <= LIMITS.most + 1
        for item in cycle:
            assert item.rest == 0.0 or 2.0 <= item.rest <= 60.0
            assert item.steps or item.rest


def test_travel_is_kept():
    there = (CycleItem(1, 16, 50.0, 2.0), CycleItem(1, -16, 50.0, 2.0))
    assert feasible(there, LIMITS)
    assert not feasible((there[0]._replace(steps=17), there[1]._replace(steps=-17)), LIMITS)
    assert not feasible((), LIMITS)
    one_side = LIMITS._replace(reach=((-math.inf, math.inf), (-3.0, 16.0)))
    assert feasible(there, one_side)
    assert not feasible(there[::-1], one_side)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_known_optimum_is_found(seed):
    """Rests of 10 s and turns of four steps are best; a cycle beyond that costs."""

    def value(cycle):
        rests = sum((math.log(max(i.rest, 0.1) / 10.0)) ** 2 for i in cycle)
        turns = sum((abs(i.steps) - 4) ** 2 for i in cycle)
        return 0.1 * rests + 0.05 * turns + abs(len(cycle) - 4)

    start = closed((CycleItem(0, 1, 50.0, 30.0), CycleItem(0, -1, 50.0, 30.0)), LIMITS)
    states = list(anneal(start, lambda cycles: map(value, cycles), LIMITS, evaluations=1500, seed=seed))
    values = [state.value for state in states]
    assert values == sorted(values, reverse=True)
    assert value(states[-1].best) == states[-1].value < 0.15 < value(start)
    assert states[-1].share == 1.0
    again = list(anneal(start, lambda cycles: map(value, cycles), LIMITS, evaluations=1500, seed=seed))[-1]
    assert again == states[-1]
