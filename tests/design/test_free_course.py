"""The chamber's course among the free numbers of a search: legs, turning points and slopes, by their exact gradient."""

import json
from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from loop_scene import spec_of

import gradcal_jax as gj
from gradcal_jax.cli import main
from gradcal_jax.design.cycle_plan import CyclePlan
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.tables import writing

# Legs of a course, and where its coordinates are: logits of the legs' times, of their slopes, of the first temperature.
LEGS = 4


@lru_cache
def turning(*, back: bool = False) -> Spec:
    """One gyro with plays of bias and scale factor, whose table turns to and fro on one axis."""
    line = {"degree": 1, "centre": "20 degC", "scale": "40 K"}
    moves = [
        move
        for turn in ("720 deg", "-720 deg")
        for move in ({"turn": turn, "axis": "turn", "peak_rate": "80 deg/s"}, {"rest": "60 s"})
    ]
    return gj.changed(
        spec_of(ways=2 if back else 1),
        {
            "sensor.gyro.axes": ["z"],
            "sensor.gyro.scale_factor": {
                "temperature": line, "rate": {"degree": 0, "scale": "100 deg/s"},
                "prior": "1000 ppm",
            },
            "sensor.gyro.hysteresis": [{"width": "10 K", "prior": "1 deg/h/K"}],
            "sensor.gyro.scale_factor_hysteresis": [{"width": "10 K", "prior": "5 ppm/K"}],
            "sensor.gyro.bias.temperature": line,
            "sensor.gyro.bias.discrepancy": None,
            "sensor.gyro.scale_factor_instability": [],
            "rig.table.axis[0].angle.scale_error": "0 ppm",
            "rig.table.mounting": [{"accuracy": "0 deg"}],
            "plan.cycle": {"moves": moves},
        },
    )  # fmt: skip


def standing() -> Spec:
    keys = {
        "sensor.gyro.axes": ["z"], "sensor.gyro.bias.discrepancy": None,
        "sensor.gyro.hysteresis": [{"width": "10 K", "prior": "1 deg/h/K"}],
    }  # fmt: skip
    return gj.changed(spec_of(ways=1), keys)


def objective(plan: CyclePlan, sharpness: float):
    of = jax.tree.map(jnp.asarray, plan.coordinates.structure(plan.start.turns))
    return lambda z: plan.value(z, (of, sharpness))


@pytest.mark.long
def test_the_gradient_goes_through_turning_points_and_slopes():
    """The course has reversals within the width of the play."""
    plan = CyclePlan(turning())
    value = objective(plan, 30.0)
    course = np.array([0.3, -0.2, 0.4, -0.5, 0.5, -0.15, 0.4, -0.6, -0.6])
    z = plan.point(plan.starts()[1])
    z = z + 0.05 * np.random.default_rng(3).standard_normal(len(z))
    z[-len(course) :] = course
    slope, of_z = np.asarray(jax.jit(jax.grad(value))(z)), jax.jit(value)
    free = np.arange(len(z) - len(course), len(z))
    scale = np.max(np.abs(slope[free]))
    assert np.all(np.abs(slope[free]) > 1e-6 * scale)
    for there in 1e-5 * np.eye(len(z))[free]:
        along = (float(of_z(z + there)) - float(of_z(z - there))) / 2e-5
        assert along == pytest.approx(np.sum(slope * there) * 1e5, abs=1e-5 * scale)


@pytest.mark.long
@pytest.mark.parametrize("both", [False, True])
def test_the_objective_of_a_free_course_is_about_that_of_its_plan(both):
    plan = CyclePlan(turning(back=both))
    left = float(np.exp(jax.jit(objective(plan, np.inf))(plan.point(plan.start))))
    found = plan.spec_of(plan.start)
    assert found.gradient_schedule.stretches[0].cycles == plan.cycles
    assert left == pytest.approx(np.exp(plan.exact.value_of(plan.exact.left(found))), rel=0.02)


def test_the_plan_of_the_file_is_a_start_and_others_keep_its_time():
    spec = turning()
    plan = CyclePlan(spec)
    own, *others = (plan.spec_of(start) for start in plan.starts())
    (ramp,) = [s for s in own.gradient_schedule.segments if s.kind == "ramp"]
    (written,) = [s for s in spec.gradient_schedule.segments if s.kind == "ramp"]
    assert (ramp.temperature_start, ramp.temperature_end) == (written.temperature_start, written.temperature_end)
    assert len(others) == 3
    for one in others:
        first, second = [s for s in one.gradient_schedule.segments if s.kind == "ramp"]
        assert first.slope * second.slope < 0.0
        assert one.gradient_schedule.duration == pytest.approx(spec.gradient_schedule.duration, abs=0.2)
        assert max(abs(s.slope) for s in one.gradient_schedule.segments) <= 3.0 / 60.0 + 1e-12
    assert plan.in_words(plan.starts()[1]).endswith("the chamber goes -20 → 20 → 60 → 20 → -20 degC")


@pytest.mark.long
def test_the_command_finds_a_plan_of_two_ways_from_one_way(tmp_path, capsys):
    """And it is better than any one-way plan of the same time that the file's own stands for."""
    spec, path, made = standing(), tmp_path / "one-way.toml", tmp_path / "recipe.toml"
    path.write_text(writing.to_toml(spec), encoding="utf-8")
    assert main(["optimise", str(path), "-o", str(made), "--steps", "40", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    best = gj.read_recipe(made).spec
    slopes = [s.slope for s in best.gradient_schedule.segments if s.kind == "ramp"]
    assert min(slopes) < 0.0 < max(slopes)
    assert best.gradient_schedule.duration <= spec.gradient_schedule.duration + 0.2
    assert "the chamber goes" in result["structure"]
    for row, old in zip(gj.predict(best).requirements, gj.predict(spec).requirements, strict=True):
        assert row.decisive is not None
        assert old.decisive is not None
        assert row.decisive < 0.5 * old.decisive


def test_a_course_is_free_with_a_hysteresis_or_by_name():
    plain = {"sensor.gyro.hysteresis": [], "sensor.gyro.scale_factor_hysteresis": []}
    named = {"design": {"free": ["cycle", "programme"]}}
    held = {"rig.table.standing": "held"}
    for changes, free in (
        ({"design": {"free": ["cycle"]}}, False),
        (plain | held, False),
        (plain | held | named, True),
    ):
        assert len(CyclePlan(gj.changed(turning(), changes)).start.course) == (2 * LEGS + 1 if free else 0)


@pytest.mark.parametrize(
    ("spec", "changes", "says"),
    [
        (turning, {"design": {"free": ["programme"]}, "plan.programme[0].used": True}, "ramps whose data are used"),
        (standing, {"design": {"free": ["cycle"]}}, "optimise can change no part of this plan: the table is at rest"),
    ],
)
def test_what_cannot_be_free_is_refused(spec, changes, says):
    with pytest.raises(ValueError, match=says):
        CyclePlan(gj.changed(spec(), changes))
