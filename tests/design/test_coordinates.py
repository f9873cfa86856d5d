"""Any real vector is a plan that the rig executes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from gradcal_jax.design import Coordinates, CycleNumbers, Element, Frame, Limits, make_coordinates
from gradcal_jax.formulas import RAMPED_SHAPES

DEG = np.pi / 180.0
LIMITS = Limits(300 * DEG, 300 * DEG, np.inf, 2.0 / 60.0)
ELEMENTS = (
    Element("cosine ramps", 2.0),
    Element("rest", 1.0),
    Element("linear ramps", 2.0),
    Element("linear ramps", 2.0, 1),
    Element("rest", 1.0, 1),
    Element("cosine ramps", 2.0, 1),
)
FREE = frozenset({"duration", "peak_rate", "ramp", "gradient"})


FRAME = Frame(60.0, 120.0, 3600.0, -30.0, 70.0, 1.0)


def coordinates(limits: Limits = LIMITS, **frame) -> Coordinates:
    return make_coordinates(ELEMENTS, limits, FRAME._replace(**frame), cycles=10, others_read=True, free=FREE)


UNLIMITED, LIMITED = coordinates(), coordinates(LIMITS._replace(travel=400 * DEG))
STEEPNESS = {"cosine ramps": np.pi / 2, "linear ramps": 1.0}


@pytest.mark.parametrize("limited", [False, True])
def test_any_vector_is_executed_by_the_rig(limited):
    coordinates_ = LIMITED if limited else UNLIMITED

    @settings(max_examples=100, deadline=None)
    @given(z=arrays(float, UNLIMITED.size, elements=st.floats(-1e6, 1e6)))
    @example(z=np.where(np.arange(UNLIMITED.size) == 6, 2.3e-308, -38.0))
    def executed(z):
        check(coordinates_.cycle(z), limited)

    executed()


def check(cycle: CycleNumbers, limited: bool) -> None:
    durations, peaks, ramps, steps = (np.asarray(f) for f in cycle)
    assert all(np.isfinite(f).all() for f in (durations, peaks, ramps, steps))
    for group in (0, 1):
        own = [d for d, e in zip(durations, ELEMENTS, strict=True) if e.group == group]
        assert sum(own) == pytest.approx(60.0, rel=1e-12)
    for d, a, r, e in zip(durations, peaks, ramps, ELEMENTS, strict=True):
        assert d >= e.least * (1 - 1e-12)
        if e.shape == "rest":
            continue
        assert abs(a) <= LIMITS.max_rate * (1 + 1e-12)
        time = r if e.shape in RAMPED_SHAPES else d
        assert STEEPNESS[e.shape] * abs(a) <= LIMITS.max_acceleration * time * (1 + 1e-9)
        assert 2 * r <= d * (1 + 1e-12) or e.shape not in RAMPED_SHAPES
    assert np.sum(steps) == pytest.approx(100.0, rel=1e-9)
    lasting = np.asarray(UNLIMITED.lasting())
    assert sum(lasting) == pytest.approx(3600.0)
    assert np.all(np.abs(steps) <= LIMITS.max_slope * lasting * (1 + 1e-9))
    if limited:
        line = LIMITED.plan(cycle).trajectory()
        of_cycle = line.start < 2 * 60.0 + 120.0
        turned = np.cumsum(line.turned()[of_cycle])
        assert np.max(np.abs(turned)) <= 400 * DEG * (1 + 1e-9)
        assert abs(turned[-1]) <= 1e-9 * max(1.0, np.max(np.abs(turned)))


@pytest.mark.parametrize("travel", [400 * DEG, 4000 * DEG])
def test_turns_of_limited_travel_are_found_again_and_use_it(travel):
    """From a cycle back to its vector; and where there is room, a turn wanted whole goes to the cable's end."""
    once = make_coordinates(
        tuple(Element("rest" if i % 2 else "cosine ramps", 1.0) for i in range(9)),
        LIMITS._replace(travel=travel),
        FRAME._replace(motion_time=60.0, own_time=60.0, other_time=0.0, temperature_end=-29.0),
        cycles=1,
        others_read=True,
        free=FREE - {"gradient"},
    )
    for seed in range(5):
        cycle = once.cycle(np.random.default_rng(seed).standard_normal(once.size))
        again = once.cycle(once.vector(cycle))
        angles, same = (once.angles(c)[::2] for c in (cycle, again))
        np.testing.assert_allclose(same, angles, atol=1e-3 * np.max(np.abs(angles)))
        assert np.max(np.abs(np.cumsum(same))) <= travel * (1 + 1e-9)
    forth = once.cycle(np.where(np.arange(once.size) < 9, 0.0, 3.0))
    reached = np.cumsum(once.angles(forth)[::2])
    assert np.max(reached) > 0.99 * min(travel, 0.9 * reached[-1])
    assert np.all(reached <= travel * (1 + 1e-9))


def test_a_decoded_plan_fills_the_motion_time_exactly():
    z = np.random.default_rng(1).standard_normal(UNLIMITED.size)
    line = UNLIMITED.decode(z).trajectory()
    assert float(line.start[-1] + line.duration[-1]) == pytest.approx(3600.0, rel=1e-12)
    begin, end = line.ends()
    assert (float(begin[0]), float(end[-1])) == pytest.approx((-30.0, 70.0), abs=1e-9)


@pytest.mark.parametrize("plain", [UNLIMITED, LIMITED], ids=["unlimited", "limited"])
def test_padded_coordinates_decode_to_the_same_plan(plain):
    """By JAX and padded, against NumPy and as they are: every piece that lasts, whatever stands in the padding."""
    padded = plain.padded()
    places = plain.places_in(padded)
    assert padded.size > plain.size
    rng = np.random.default_rng(2)
    z, whole = rng.standard_normal(plain.size), rng.standard_normal(padded.size)
    whole[places] = z
    ours = plain.decode(z).trajectory()
    theirs = jax.jit(lambda c, z: c.decode(z).trajectory())(jax.tree.map(jnp.asarray, padded), jnp.asarray(whole))
    lasts = np.asarray(theirs.duration) > 0.0
    for name in ("start", "duration", "terms", "share", "level", "slope", "read", "moving"):
        mine = getattr(ours, name)[ours.duration > 0.0]
        size = max(1.0, float(np.max(np.abs(mine))))
        np.testing.assert_allclose(np.asarray(getattr(theirs, name))[lasts], mine, atol=1e-12 * size, err_msg=name)


def test_what_excludes_each_other_is_said():
    with pytest.raises(ValueError, match="the moves need at least 5 s, but the axis may turn for only 4 s"):
        coordinates(own_time=4.0)
    with pytest.raises(
        ValueError, match=r"the ramp needs a slope of 1\.667 K/min, but the chamber reaches only 1 K/min"
    ):
        coordinates(LIMITS._replace(max_slope=1.0 / 60.0))
