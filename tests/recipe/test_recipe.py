"""Recipes as files: rounded to the controllers' steps, of one piece with the spec inside, and nothing done by hand."""

import math
import re
import tomllib
from decimal import Decimal
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_recipe import made_of

from gradcal_jax.recipe.recipe import parse_recipe, read_recipe, recipe_of
from gradcal_jax.recipe.rounding import rounded
from gradcal_jax.recipe.tracks import ControllerSteps, steps_of, tracks_of
from gradcal_jax.spec import presets
from gradcal_jax.spec.changes import changed, tables_of
from gradcal_jax.spec.spec import parse_spec, spec_of
from gradcal_jax.tables.problems import SpecError
from gradcal_jax.tables.quantity import Quantity as Q
from gradcal_jax.tables.writing import to_toml

PAPER = parse_spec(presets.text("paper-dynamic-gradient"))
MEMS = parse_spec(presets.text("tactical-mems"))
COARSE = ControllerSteps(
    temperature=Q.read("1 K", "temperature difference"),
    slope=Q.read("0.1 K/min", "temperature slope"),
    time=Q.read("1 s", "time"),
    rate=Q.read("1 deg/s", "angular rate"),
    angle=Q.read("0.1 deg", "angle"),
)


COMMITTED = sorted((Path(__file__).parents[2] / "experiments" / "recipes").glob("headline*.toml"))


def cycles(spec):
    return sum(stretch.cycles for stretch in spec.gradient_schedule.stretches)


def moves_of(spec):
    return [step.move for step in spec.gradient_schedule.steps]


def on_grid(value, step):
    count = Decimal(repr(float(value))) / Decimal(repr(float(step)))
    return abs(count - round(count)) < Decimal("1e-6")


@pytest.mark.parametrize(("visits", "slope"), [(1, 2), (2, 1)])
@pytest.mark.parametrize("other", [30, 1400])
def test_rounding_keeps_visits_that_fill_their_ramp_to_the_last_second(visits, slope, other):
    # In steps finer than a controller's. The other axes have the longest standing, which is no help to the last visit.
    own = (6000.0 / slope - (visits - 1) * other) / visits
    turn = {"peak_rate": "180 deg/s", "shape": "cosine ramps", "turn": "36000 deg", "duration": "220.0437 s"}
    rest = {"rest": f"{0.5 * own - 220.0437!r} s", "read_every": "1 s"}
    keys = {
        "plan.gradient": f"{slope} K/min",
        "plan.cycle.other_axes.duration": f"{other} s",
        "plan.cycle.moves": [rest, turn, rest, {**turn, "turn": "-36000 deg"}],
    }
    spec = changed(PAPER, keys)
    assert cycles(spec) == visits
    result = rounded(spec)
    assert cycles(result.spec) == visits
    assert not any("has room" in note for note in result.notes)


def test_the_tracks_say_when_everything_begins_and_what_it_waits_for():
    fine = changed(MEMS, {"rig.resolution.acceleration": "0.000001 deg/s^2"})
    chamber, (block,) = tracks_of(rounded(fine).spec)
    soak, ramp = chamber
    assert (soak.begins, ramp.begins) == ("when stable", "when stable")
    assert (float(ramp.start), float(ramp.duration), ramp.slope.text) == (3600.0, 6600.0, "1 K/min")
    assert (block.begins_with, block.repeat) == ("ramp 1", 18)
    assert float(block.period) == pytest.approx(rounded(MEMS).spec.schedule.period, abs=1e-9)
    ends = [float(m.start + m.duration) for m in block.moves]
    assert [float(m.start) for m in block.moves[1:]] == pytest.approx(ends[:-1], abs=1e-9)
    assert ends[-1] == pytest.approx(float(block.period), abs=1e-9)
    assert block.moves[-1].do == "wait"
    whole = (block.repeat - 1) * float(block.period) + float(block.moves[-1].start) + float(block.standing_after)
    assert whole == pytest.approx(6600.0, abs=1e-6)
    for move in block.moves:
        if move.do == "turn":
            ramp_time = abs(float(move.rate) / float(move.acceleration))
            assert abs(float(move.rate)) * (float(move.duration) - ramp_time) == pytest.approx(abs(float(move.angle)))


def test_a_programme_waits_after_soaks_and_steps_and_a_standard_plan_at_every_temperature():
    programme = tomllib.loads("""
programme = [
  { soak = "30 min", at = "-20 degC" },
  { ramp_to = "10 degC", rate = "1 K/min" },
  { ramp_to = "40 degC", rate = "1 K/min", used = false },
  { step_to = "50 degC" },
  { soak = "20 min", used = true },
]
""")["programme"]
    keys = {"plan.temperature": None, "plan.gradient": None, "plan.soak": None, "plan.programme": programme}
    chamber, motion = tracks_of(rounded(changed(MEMS, keys)).spec)
    begins = "; ".join(f"{s.name} {s.begins}" for s in chamber)
    assert begins == (
        "soak 1 when stable; ramp 1 when stable; ramp 2 at its time; step 1 at its time; soak 2 when stable"
    )
    assert [block.begins_with for block in motion] == ["ramp 1", "soak 2"]
    standard = parse_spec(presets.text("paper-dynamic-standard"))
    chamber, motion = tracks_of(standard)
    assert len(chamber) == 2 * len(standard.plan.temperatures)
    assert all(s.begins == "when stable" for s in chamber if s.name.startswith("points"))
    assert [float(m.rate) for m in motion[0].moves if m.rate is not None] == [
        float(r) for r in standard.plan.rates if r
    ]


def test_rounding_keeps_whole_turns_repetitions_and_the_period():
    result = rounded(PAPER)
    before, after = PAPER.schedule, result.spec.schedule
    assert cycles(result.spec) == cycles(PAPER) == 17
    assert after.period <= before.period + 1e-9
    assert [m.angle for m in moves_of(result.spec)] == [m.angle for m in moves_of(PAPER)]
    assert all(m.shape in ("rest", "linear ramps") for m in moves_of(result.spec))
    assert "trapezoids" in result.notes[0]


MOVES = st.fixed_dictionaries(
    {
        "turn": st.floats(2.0, 4000.0).map(lambda v: f"{v!r} deg"),
        "peak_rate": st.floats(5.0, 300.0).map(lambda v: f"{v!r} deg/s"),
        "shape": st.sampled_from(["cosine ramps", "linear ramps"]),
    }
)


@settings(max_examples=60, deadline=None)
@given(st.lists(MOVES, min_size=1, max_size=4), st.floats(0.2, 1.5), st.floats(3.0, 60.0), st.booleans())
def test_rounded_plans_stay_within_the_rig_and_on_the_grid(moves, gradient, rest, coarse):
    steps = COARSE if coarse else ControllerSteps()
    tables = tables_of(MEMS)
    tables["plan"]["cycle"]["moves"] = [{"rest": f"{rest!r} s", "read_every": "1 s"}, *moves]
    tables["plan"]["gradient"] = f"{gradient!r} K/min"
    try:
        spec = spec_of(tables)
    except SpecError:
        return  # a move that the table cannot make
    result = rounded(spec, steps).spec
    before, after = spec.schedule, result.schedule
    assert on_grid(after.segments[1].slope, steps.slope)
    # A cycle may only be lost where a step of the slope is worth more than the room that is left.
    room = before.stretches[0].leftover + before.period
    assert cycles(result) >= cycles(spec) - 1 or room < float(steps.slope) / (gradient / 60.0) * before.duration
    planned = made = 0.0
    for old, new in zip(moves_of(spec), moves_of(result), strict=True):
        assert on_grid(new.duration, steps.time)
        planned, made = planned + old.angle, made + new.angle
        assert made == pytest.approx(planned, abs=0.51 * float(steps.angle))
        if not new.is_rest:
            assert new.peak_acceleration <= float(spec.rig.table.axis[0].max_acceleration) * (1 + 1e-6)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda t: t.update(format="gradcal-spec/1"), "gradcal optimise SPEC --steps 0 -o recipe.toml"),
        (lambda t: t.update(format="gradcal-recipe/9"), 'this version of the program reads "gradcal-recipe/1"'),
        (lambda t: t.pop("spec"), "spec: this key is missing"),
        (lambda t: t.update(statu="x"), "statu"),
        (lambda t: t["spec"]["plan"].update(gradient="9 K/min"), "spec.plan.gradient"),
        (lambda t: t["stability"].update(within="0 K"), "stability.within"),
        (lambda t: t["prediction"].pop("duration_s"), "prediction.duration_s"),
    ],
)
def test_a_broken_recipe_is_a_sentence(change, words):
    tables = tomllib.loads(to_toml(made_of(MEMS)))
    change(tables)
    with pytest.raises(SpecError, match=words):
        recipe_of(tables)


def test_the_steps_come_from_the_rig_where_it_names_them():
    spec = changed(MEMS, {"rig.resolution.rate": "0.5 deg/s", "plan.cycle.moves[1].peak_rate": "299.7 deg/s"})
    assert math.degrees(float(steps_of(spec).rate)) == pytest.approx(0.5)
    default = steps_of(PAPER)
    assert math.degrees(float(default.acceleration)) == pytest.approx(360.0 / 1152000 / 1.6384e-4)
    assert default == ControllerSteps(acceleration=default.acceleration)
    made = rounded(spec).spec.plan.cycle.moves[1]
    assert made.peak_rate == Q.read("299.5 deg/s", "angular rate")


@pytest.mark.parametrize("path", COMMITTED, ids=lambda path: path.stem)
def test_every_recipe_of_the_experiments_is_read(path):
    recipe = read_recipe(path)
    assert recipe.spec.sensor.gyro.axes == ("x",)
    assert parse_recipe(to_toml(recipe)) == recipe


def test_a_recipe_whose_spec_was_changed_by_hand_is_refused():
    text = to_toml(made_of(MEMS))
    slope = re.search(r'gradient = ".*"', text)[0]
    with pytest.raises(SpecError, match="make the recipe again") as caught:
        parse_recipe(text.replace(slope, 'gradient = "0.5 K/min"'))
    assert [problem.dotted for problem in caught.value.problems] == ["spec"]
