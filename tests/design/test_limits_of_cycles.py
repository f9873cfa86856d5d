"""Hidden maps that a cycle must notice, and what its limits are worth."""

import json
import math
from functools import lru_cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import gradcal_jax as gj
from gradcal_jax.cli import main
from gradcal_jax.design.cycle_plan import CyclePlan, RepeatedCycle
from gradcal_jax.design.plan_objective import hidden_test, imu_with_hidden
from gradcal_jax.design.pose_search import active_limits, shadow_prices
from gradcal_jax.information import imu_information
from gradcal_jax.model.imu_build import build_imu
from gradcal_jax.tables.problems import SpecError

EXPERIMENTS = Path(__file__).parents[2] / "experiments" / "imu"
QUICKLY = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}


@lru_cache
def one_gyro(*, notice: str = "", chamber: bool = False) -> gj.Spec:
    """A gyro on a table of two axes, one of limited travel."""
    spec = gj.read_spec(EXPERIMENTS / "hand2.toml")
    line = {"basis": "polynomial", "degree": 1, "centre": "20 degC", "scale": "50 K"}
    turns = [("spin", 1000), ("tilt", 90), ("spin", -640), ("tilt", -90)]
    moves = [
        m for axis, t in turns for m in ({"turn": f"{t} deg", "axis": axis, "peak_rate": "200 deg/s"}, {"rest": "8 s"})
    ]
    design = {"notice": {"standard_deviation": notice, "temperature_degree": 2, "rate_degree": 2}} if notice else {}
    changes = {
        "sensor.accelerometer": None,
        "sensor.gyro.axes": ["z"],
        "sensor.gyro.g_sensitivity": None,
        "sensor.gyro.misalignment": None,
        "sensor.gyro.bias.temperature": line,
        "sensor.gyro.scale_factor.temperature": line,
        "sensor.gyro.scale_factor.rate": {"basis": "polynomial", "degree": 1, "scale": "300 deg/s"},
        "rig.table.axis[0].travel": "200 deg",
        "plan.cycle.moves": moves,
        "design": {"minimise": "gyro scale factor"} | design,
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
    ramps = plan.free_ramps(jnp.asarray(z[3 * plan.slots :]), of) if ramps is None else ramps
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
    assert prices["largest rate of spin"].linear == 10.0


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


def test_limits_that_bind_are_named():
    plan = CyclePlan(one_gyro())
    spin, tilt = (next(k for k, t in enumerate(plan.start.turns) if t.axis == axis) for axis in (1, 0))
    turns = list(plan.start.turns)
    turns[spin] = turns[spin]._replace(rate=math.radians(300.0), rest=2.0)
    assert active_limits(plan, plan.start) == ("the time of the cycle",)
    assert active_limits(plan, plan.start._replace(turns=tuple(turns))) == (
        "the time of the cycle",
        "the maximum rate of spin, in 1 of 2 turns",
        "the shortest rest, in 1 of 4",
    )
    turns[tilt] = turns[tilt]._replace(angle=math.radians(200.0))
    assert "the travel of tilt" in active_limits(plan, plan.start._replace(turns=tuple(turns)))


@pytest.mark.long
def test_the_objective_has_the_chance_that_predict_has():
    """Though it filters two cycles of each slope; what is minimised counts no hidden map."""
    spec = one_gyro(notice="5 ppm")
    plan = CyclePlan(spec)
    z, of, ramps = point_of(plan, plan.start)
    decoded = plan.coordinates.decode(z.reshape(3, -1), of)
    found = plan.spec_of(plan.start._replace(turns=plan.coordinates.cycle(z.reshape(3, -1), of)))
    logs = jax.jit(lambda d: plan.objective.logs(d, of, ramps, np.inf), compiler_options=QUICKLY)(decoded)
    predicted = gj.predict(found, notices=True)
    power = next(row.power for row in predicted.notices if row.quantity == "scale_factor")
    assert 0.2 < power < 0.8
    built = build_imu(found)
    model = imu_with_hidden(found, built.model)
    info = imu_information([(built.motion, built.body_nodes())], model)
    missed = hidden_test(model.channels[0].model, found.design.notice, 0)(info)
    assert np.exp(logs[0]) == pytest.approx([predicted.requirements[0].decisive, missed / 0.1], rel=0.02)
    # The test that is reported leaves out what the plan does not show.
    assert 0.5 * missed < 1.0 - power <= missed
    left = plan.exact.residuals(found)
    assert plan.exact.exceeded(left) == {
        "the probability of missing a hidden map": pytest.approx(math.log((1.0 - power) / 0.1))
    }
    assert plan.exact.value_of(left) > plan.exact.without_limits(left) + 1.0


def test_the_columns_of_a_hidden_map_at_another_temperature_are_a_matrix_of_themselves():
    model = CyclePlan(one_gyro(notice="5 ppm")).objective.models[0]
    (gyro,) = model.channels
    t, w = (x.ravel() for x in np.meshgrid(np.linspace(-60.0, 90.0, 9), np.linspace(-5.0, 5.0, 7)))
    values = lambda t: np.concatenate([term.values(t, w) for term in gyro.model.terms], axis=-1)  # noqa: E731
    for by, matrix in zip((-30.0, 0.0, 45.0), model.shifts(np.array([-30.0, 0.0, 45.0])), strict=True):
        own = matrix[: gyro.model.size, : gyro.model.size]
        assert values(t) @ own == pytest.approx(values(t + by), abs=1e-10)


@pytest.mark.long
def test_the_command_finds_a_plan_that_notices_and_says_what_limits_are_worth(tmp_path, capsys):
    must, goal = tmp_path / "must.toml", tmp_path / "better.toml"
    gj.write_toml(one_gyro(notice="5 ppm"), must)
    assert main(["optimise", str(must), "-o", str(goal), "--steps", "40", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    plans = one_gyro(notice="5 ppm"), gj.read_recipe(goal).spec
    own, power = (r.power for p in plans for r in gj.predict(p, notices=True).notices if r.quantity == "scale_factor")
    assert own < 0.9 <= power
    prices = {p["limit"]: p["change"] for p in found["shadow_prices"]}
    assert prices["time (every cycle longer in proportion)"] < 0.0
    assert all(change <= 0.0 for change in prices.values())
    assert found["active_limits"][0] == "the time of the cycle"


def test_what_must_be_noticed_needs_a_gyro_with_polynomials():
    spec = gj.parse_spec(gj.presets.text("accelerometer-six-positions-toured"))
    with pytest.raises(SpecError, match="a scale factor that is a polynomial in temperature; this sensor has none"):
        gj.changed(spec, {"design.notice": {"standard_deviation": "20 ppm"}})
