"""Plans of an axis that has its table in visits, as numbers: whatever these are, the rig can execute the plan."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given as given_any
from hypothesis import settings
from hypothesis import strategies as st
from search_problem import SPEC, exact

from gradcal_jax.design.cycle_plan import CyclePlan
from gradcal_jax.design.visits import visit_choices
from gradcal_jax.recipe.rounding import rounded
from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.design import Design
from gradcal_jax.spec.spec import parse_spec
from gradcal_jax.spec.spec_sections import Spec

DEG = math.pi / 180.0


@pytest.fixture(scope="module")
def spec() -> Spec:
    return parse_spec(SPEC)


def plan_of(spec: Spec) -> CyclePlan:
    (times,) = visit_choices(spec, spec.design or Design())
    return CyclePlan(spec, times)


_TURN = {"turn": "360 deg", "peak_rate": "100 deg/s", "shape": "linear ramps"}
SHORT = [{"rest": "5 s"}, _TURN, {"rest": "5 s"}, _TURN | {"turn": "-360 deg"}]


def many_visits(spec: Spec) -> Spec:
    """More than one hundred short visits."""
    others = {"duration": "5 s", "read_every": "1 s"}
    keys = {"plan.cycle": {"moves": SHORT, "other_axes": others}, "rig.table.axis[0].angle.read_every": "1 s"}
    return changed(spec, keys)


_SMALL = {"turn": "20 deg", "peak_rate": "1.68 deg/s", "shape": "linear ramps"}
LIMITED = {
    "rig.table.axis[0].travel": "90 deg",
    "plan.cycle.moves": [{"rest": "5 s"}, _SMALL, {"rest": "5 s"}, _SMALL | {"turn": "-20 deg"}],
}
IN_CYCLES = {"plan.cycle.other_axes": {"duration": "60 s", "read_every": "1 s"}}


KINDS = {
    "own moves in each visit": lambda spec: spec,
    "many, in cycles": many_visits,
    "little travel": lambda spec: changed(spec, LIMITED),
    "many of little travel, in cycles": lambda spec: changed(spec, LIMITED | IN_CYCLES),
}


@pytest.mark.parametrize("kind", KINDS)
def test_any_vector_is_a_plan_within_the_limits(spec, kind):
    plan = plan_of(KINDS[kind](spec))
    limits, visits = plan.limits, plan.coordinates.visits

    @settings(max_examples=10, deadline=None)
    @given_any(seed=st.integers(0, 1000), size=st.floats(0.1, 3.0))
    def holds(seed: int, size: float) -> None:
        rng = np.random.default_rng(seed)
        drawn = plan.drawn(rng)
        of = plan.coordinates.structure(drawn.turns)
        z = plan.point(drawn) + size * rng.standard_normal(3 * plan.coordinates.slots)
        decoded = plan.coordinates.decode(jnp.asarray(z.reshape(3, -1)), jax.tree.map(jnp.asarray, of))
        angle, rate, ramp, turning, rests, left = (np.asarray(x) for x in decoded)
        assert np.all(np.abs(rate) <= limits.rates[0] * (1 + 1e-9))
        assert np.all(ramp <= 0.5 * turning * (1 + 1e-6) + 1e-9)
        assert np.all(np.abs(rate) <= limits.accelerations[0] * ramp * (1 + 1e-9))
        assert np.all(rests[of.rests] >= limits.shortest - 1e-9)
        place, (low, high) = np.cumsum(angle), limits.reach[0]
        assert low - 1e-9 <= np.min(place) <= np.max(place) <= high + 1e-9
        np.testing.assert_allclose(angle, np.sign(rate) * np.abs(rate) * (turning - ramp), rtol=1e-5, atol=1e-2)
        if left > 0.0:
            filled = np.bincount(visits.group, turning * (of.axis >= 0) + rests)
            np.testing.assert_allclose(filled, visits.own, atol=1e-6 if plan.coordinates.timed else 0.6)

    holds()


@pytest.mark.parametrize("kind", KINDS)
def test_any_plan_is_written_as_it_is_executed(spec, kind):
    """Nothing is left to round, the axis leaves the table on time, and stays within its travel."""
    given = changed(KINDS[kind](spec), {"rig.resolution.acceleration": "0.0000001 deg/s^2"})
    plan = plan_of(given)
    for seed in range(6):
        made = plan.spec_of(plan.drawn(np.random.default_rng(seed)))
        assert rounded(made).spec.plan == made.plan
        assert (plan.cycles > 1) == ("in cycles" in kind)
        assert sum(s.cycles for s in made.gradient_schedule.stretches) == plan.cycles
        assert made.gradient_schedule.motion == pytest.approx(given.gradient_schedule.motion, rel=1e-9)
        made_moves = [step.move for step in made.gradient_schedule.steps]
        places = np.cumsum([m.angle for m in made_moves]) / DEG
        assert np.max(np.abs(places)) <= float(given.rig.table.axis[0].travel) / DEG * (1 + 1e-9)
        others = [m.duration for m in made_moves if m.other_axes]
        if "in cycles" not in kind:
            assert len(others) == 3
            assert min(others) >= 780.0 - 1e-6


CHANGES = {
    "plain": {},
    "hidden structure, instability, lag, offsets": {
        "sensor.gyro.scale_factor.discrepancy": {
            "standard_deviation": "20 ppm", "temperature_degree": 3, "rate_degree": 3,
        },
        "sensor.gyro.scale_factor_instability": [{"standard_deviation": "20 ppm", "correlation_time": "20 min"}],
        "sensor.thermal_lag": "2 min",
        "rig.table.axis[0].angle.standstill_offset": "0.02 deg",
    },
    "two cycles of twelve visits": {"plan.cycle.other_axes": {"duration": "5 s", "read_every": "1 s"}},
    "two cycles of sixteen visits of little travel": LIMITED | IN_CYCLES,
    "eleven cycles of an axis that is alone": {"plan.cycle": {"moves": SHORT}},
}  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize("name", CHANGES)
def test_the_objective_of_a_search_is_that_of_its_plan(spec, name):
    """But for rounding, and for the few readings that stand for those of other axes' time; with its gradient."""
    plan = plan_of(changed(spec, CHANGES[name] | {"rig.table.axis[0].angle.read_every": "1 s"}))
    drawn = plan.drawn(np.random.default_rng(2))
    z, of = jnp.asarray(plan.point(drawn)), jax.tree.map(jnp.asarray, plan.coordinates.structure(drawn.turns))
    value, gradient = jax.jit(jax.value_and_grad(plan.value))(z, (of, 50.0))
    at = jax.jit(plan.value)
    assert math.exp(float(at(z, (of, 1e5)))) == pytest.approx(exact(plan.spec_of(drawn)), rel=0.03)
    direction = np.random.default_rng(3).standard_normal(z.shape)
    along = [float(at(z + h * direction, (of, 50.0))) for h in (1e-5, -1e-5)]
    assert float(gradient @ direction) == pytest.approx((along[0] - along[1]) / 2e-5, rel=1e-5)
    assert float(value) == pytest.approx(float(at(z, (of, 1e5))), abs=0.05)


def test_turns_that_shrink_to_nothing_are_left_out(spec):
    plan = plan_of(spec)
    drawn = plan.drawn(np.random.default_rng(1))
    brief = drawn.turns[1]._replace(angle=0.5, rate=1.0)
    assert plan.limits.time_of(brief) < 3.0
    fewer = plan.without_brief(drawn._replace(turns=(drawn.turns[0], brief, *drawn.turns[2:])))
    assert [t.axis for t in fewer.turns[:3]] == [-1, -1, 0]
    assert fewer.turns[0].rest == pytest.approx(drawn.turns[0].rest + brief.rest)


def test_visits_of_another_length_keep_the_axiss_share_of_the_time(spec):
    choices = visit_choices(spec, Design(free=("cycle",)))
    assert [c.visits for c in choices] == [3, 4, 6]
    for c in choices:
        assert c.visits * c.own == pytest.approx(3000.0 * 120.0 / 900.0)
        assert c.visits * c.own + (c.visits - 1) * c.other == pytest.approx(3000.0)


@pytest.mark.parametrize(
    ("other", "visits", "cycles"),
    [("780 s", 4, 1), ("31 s", 20, 1), ("20 s", 7, 3), ("10 s", 11, 2), ("5 s", 12, 2)],
)
def test_more_than_twenty_visits_are_cycles_of_visits_with_moves_of_their_own(spec, other, visits, cycles):
    """As many as possible of all visits have moves."""
    plan = plan_of(changed(spec, {"plan.cycle.other_axes.duration": other}))
    assert (plan.coordinates.visits.number, plan.cycles) == (visits, cycles)
    made = plan.spec_of(plan.drawn(np.random.default_rng(0))).gradient_schedule
    assert [s.cycles for s in made.stretches] == [cycles]
    assert sum(step.move.other_axes for step in made.steps) == visits - 1
