"""What the limits of a cycle are worth."""

from functools import lru_cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import gradcal_jax as gj
from gradcal_jax.design.cycle_plan import CyclePlan, RepeatedCycle
from gradcal_jax.design.prices import shadow_prices

EXPERIMENTS = Path(__file__).parents[2] / "experiments" / "imu"
QUICKLY = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}


@lru_cache
def one_gyro(*, chamber: bool = False) -> gj.Spec:
    """A gyro on a table of two axes, one of limited travel."""
    spec = gj.read_spec(EXPERIMENTS / "hand2.toml")
    line = {"degree": 1, "centre": "20 degC", "scale": "50 K"}
    turns = [("spin", 1000), ("tilt", 90), ("spin", -640), ("tilt", -90)]
    moves = [
        m for axis, t in turns for m in ({"turn": f"{t} deg", "axis": axis, "peak_rate": "200 deg/s"}, {"rest": "8 s"})
    ]
    changes = {
        "sensor.accelerometer": None,
        "sensor.gyro.axes": ["z"],
        "sensor.gyro.g_sensitivity": None,
        "sensor.gyro.misalignment": None,
        "sensor.gyro.bias.temperature": line,
        "sensor.gyro.scale_factor.temperature": line,
        "sensor.gyro.scale_factor.rate": {"degree": 1, "scale": "300 deg/s"},
        "rig.table.axis[0].travel": "200 deg",
        "plan.cycle.moves": moves,
        "design": {"minimise": "gyro scale factor"},
        "requirement": [
            r.model_dump(mode="json", exclude_unset=True) | {"grid": [21] * len(r.grid)}
            for r in spec.requirement
            if r.name in ("gyro scale factor", "gyro bias")
        ],
    }
    if chamber:
        changes["design"]["free"] = ["cycle", "programme"]
    return gj.changed(spec, changes)


def point_of(plan: CyclePlan, cycle: RepeatedCycle):
    of = plan.structure(cycle)
    return plan.point(cycle, of), jax.tree.map(jnp.asarray, of), plan.course(cycle.cycles).ramps


def logarithm(plan: CyclePlan, cycle: RepeatedCycle, z: np.ndarray | None = None) -> float:
    own, of, ramps = point_of(plan, cycle)
    z = own if z is None else z
    ramps = plan.free_course.ramps(jnp.asarray(z[3 * plan.slots :]), of.period) if ramps is None else ramps
    value = jax.jit(plan.objective.value, compiler_options=QUICKLY)
    return float(value(z[: 3 * plan.slots].reshape(3, -1), of, ramps, 100.0))


EASED = {
    "time (every cycle longer in proportion)": {"plan.gradient": f"{100.0 / 101.0:.12g} K/min"},
    "largest rate of spin": {"rig.table.axis[1].max_rate": "301 deg/s"},
    "largest acceleration of tilt": {"rig.table.axis[0].max_acceleration": "401 deg/s^2"},
    "travel of tilt, at each end": {"rig.table.axis[0].travel": "201 deg"},
    "shortest rest": {"design.shortest_rest": "1 s"},
}


@pytest.mark.long
def test_a_price_is_the_difference_of_the_objective_on_an_eased_rig():
    """The same shares of a limit that is wider by one of its units, in a plan that is built anew."""
    spec = one_gyro()
    plan = CyclePlan(spec)
    z, *_ = point_of(plan, plan.start)
    start = logarithm(plan, plan.start)
    prices = {p.limit: p for p in shadow_prices(plan, plan.start, 7.0)}
    assert set(EASED) | {"largest rate of tilt", "largest acceleration of spin"} == set(prices)
    for name, changes in EASED.items():
        eased = CyclePlan(gj.changed(spec, changes))
        difference = logarithm(eased, plan.start, z) - start
        assert prices[name].change == pytest.approx(7.0 * min(difference, 0.0), rel=0.1, abs=1e-7), name
    assert prices["time (every cycle longer in proportion)"].change < 0.0
    assert prices["largest rate of spin"].change < 0.0
    assert prices["largest rate of spin"].restricts


@pytest.mark.long
def test_a_chamber_that_is_searched_has_a_price():
    spec = one_gyro(chamber=True)
    plan = CyclePlan(spec)
    cycle = plan.starts()[1]
    z, *_ = point_of(plan, cycle)
    price = next(p for p in shadow_prices(plan, cycle, 1.0) if p.limit == "chamber slope")
    wider = {f"rig.chamber.max_{way}": "2.001 K/min" for way in ("heating", "cooling")}
    eased = CyclePlan(gj.changed(spec, wider))
    difference = (logarithm(eased, cycle, z) - logarithm(plan, cycle, z)) / 1e-3
    assert price.change == pytest.approx(min(difference, 0.0), rel=0.01, abs=1e-6)
