"""The objective of a search at infinite sharpness is that of the plan, as `predict` evaluates it."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from search_problem import IMU, coarse, one_gyro, turning

import gradcal_jax as gj
from gradcal_jax.design import cycle_plan
from gradcal_jax.design.cycle_plan import CyclePlan
from gradcal_jax.spec.changes import tables_of

QUICKLY = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}
HIDDEN = {"standard_deviation": "20 ppm", "temperature_degree": 2, "rate_degree": 2}


def preset(name: str, **changes) -> gj.Spec:
    """A preset on coarser grids."""
    spec = gj.changed(gj.parse_spec(gj.presets.text(name)), changes)
    return gj.changed(spec, {"requirement": coarse(spec)})


def six(**design) -> gj.Spec:
    return preset("accelerometer-six-positions-toured", **{f"design.{key}": value for key, value in design.items()})


def limited() -> gj.Spec:
    """One requirement is minimised; the target of another, which the plan misses, limits the search."""
    spec = six()
    rows = [row | {"target": "1 ug"} for row in tables_of(spec)["requirement"]]
    rows = [rows[0], *(row for row in rows[1:] if row["quantity"] == "accelerometer_bias")]
    return gj.changed(spec, {"requirement": rows, "design.minimise": rows[0]["name"]})


def read_at_rest(every: str) -> gj.Spec:
    """One gyro on a table whose angle is read at rest."""
    spec = gj.read_spec(IMU.parent / "designs" / "headline.toml")
    requirement = tables_of(spec)["requirement"][0]
    moves = []
    for angle, rate in ((5400, 300), (-5400, 300), (3600, 150), (-3600, 150)):
        turn = {"turn": f"{angle} deg", "axis": "x", "peak_rate": f"{rate} deg/s", "shape": "linear ramps"}
        moves += [turn, {"rest": "7.3 s"}]
    return gj.changed(spec, {
        "plan.temperature": ["-30 degC", "-20 degC"], "sensor.gyro.scale_factor.temperature.degree": 1,
        "plan.cycle": {"moves": moves}, "requirement": [requirement | {"grid": [31, 31]}],
        "rig.table.axis[0].angle.read_every": every, "design": {"minimise": "full range", "free": ["cycle"]},
    })  # fmt: skip


SPECS = {
    "six positions": six,
    "worst ratio": lambda: six(minimise="worst ratio"),
    "a target that limits": limited,
    "rests read every second": lambda: read_at_rest("1 s"),
    "rests read every 3 s": lambda: read_at_rest("3 s"),
    "rests read at their end": lambda: read_at_rest("1000 s"),
    "135 cycles": one_gyro,
}
BINS = {"degree": 0, "knots": ["-30 degC", "0 degC", "30 degC", "70 degC"]}
# All but for the microseconds that are left behind the last cycle; a move in which a bin ends is not divided there.
MORE = {
    "an IMU": ({}, 1e-7),
    "a discrepancy": ({"sensor.gyro.scale_factor.discrepancy": HIDDEN}, 1e-7),
    "limited travel": ({"rig.table.axis[0].travel": "520 deg"}, 1e-7),
    "a lag": ({"sensor.thermal_lag": "2 min"}, 1e-7),
    "bins": ({"sensor.gyro.bias.temperature": BINS}, 1e-2),
}


def written(plan: CyclePlan, z: np.ndarray, of) -> gj.Spec:
    """The plan of a point, with all digits."""
    moves = []
    for t in plan.at(z, of).turns:
        if t.axis >= 0:
            turn = {
                "turn": f"{math.degrees(t.angle)!r} deg",
                "axis": plan.rounding.axes[t.axis],
                "shape": "linear ramps",
            }
            duration = abs(t.angle) / t.rate + t.rate / float(plan.limits.accelerations[t.axis])
            moves.append(turn | {"peak_rate": f"{math.degrees(t.rate)!r} deg/s", "duration": f"{duration!r} s"})
        if t.rest:
            moves.append({"rest": f"{t.rest!r} s"})
    return gj.changed(plan.spec, {"plan.cycle.moves": moves})


def check(spec: gj.Spec, monkeypatch, within: float, *, derivative: bool = False) -> None:
    """At the file's plan and at a random point, without the time that is left for rounding. `derivative`: against
    differences, of all coordinates at once and of some alone."""
    monkeypatch.setattr(cycle_plan, "_LEFT", 0.0)
    plan = CyclePlan(spec)
    of = plan.coordinates.structure(plan.start.turns)

    def value(z, of):
        decoded = plan.coordinates.decode(jnp.reshape(z, (3, -1)), of)
        return plan.value(z, (of, math.inf)) - plan.coordinates.penalty(decoded)

    program = jax.jit(value, compiler_options=QUICKLY)
    start, of = plan.point(plan.start), jax.tree.map(jnp.asarray, of)
    for random in (0.0, 0.02):
        z = start + random * np.random.default_rng(0).standard_normal(start.shape)
        found, made = float(program(z, of)), written(plan, z, of)
        assert made.gradient_schedule.stretches[0].cycles == plan.cycles
        assert found == pytest.approx(plan.exact.value_of(plan.exact.left(made)), abs=within)
    if derivative:
        slope = np.asarray(jax.jit(jax.grad(value), compiler_options=QUICKLY)(z, of))
        assert np.all(np.isfinite(slope))
        rng, size = np.random.default_rng(1), np.max(np.abs(slope))
        for way in (rng.standard_normal(z.shape), *np.eye(z.size)[rng.choice(np.flatnonzero(slope), 6)]):
            there, back = (float(program(z + step * way, of)) for step in (1e-5, -1e-5))
            assert (there - back) / 2e-5 == pytest.approx(np.sum(slope * way), abs=1e-5 * size)


@pytest.mark.long
@pytest.mark.parametrize("name", SPECS)
def test_the_objective_of_a_plan_is_its_prediction(name, monkeypatch):
    check(SPECS[name](), monkeypatch, 1e-9, derivative=name == "135 cycles")


@pytest.mark.evidence
@pytest.mark.parametrize("name", MORE)
def test_the_objective_of_many_cycles_of_an_imu_is_its_prediction(name, monkeypatch):
    changes, within = MORE[name]
    check(gj.changed(turning(), changes), monkeypatch, within, derivative=within < 1e-3)


@pytest.mark.evidence
@pytest.mark.parametrize("name", gj.presets.names())
def test_the_objective_of_every_preset_is_its_prediction(name, monkeypatch):
    spec = preset(name)
    if spec.turns_one_gyro or spec.rig.table.drive == "hand":
        pytest.skip("searched in visits (test_visits.py), or not at all")
    free = spec.design.free if spec.design and spec.design.free else ["cycle"]
    check(gj.changed(spec, {"design.free": free}), monkeypatch, 1e-7, derivative=name == "gradient-three-axes")
