"""Specs: the paper's plans come out as the paper's numbers; limits and references are checked across sections."""

import math
import tomllib

import pytest

from gradcal_jax.spec import presets
from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.schedule import row_count
from gradcal_jax.spec.spec import parse_spec, read_spec
from gradcal_jax.tables.problems import SpecError

DEG = math.pi / 180.0
TEXT = presets.text("paper-dynamic-gradient")
PAPER = parse_spec(TEXT)


def preset(name):
    return parse_spec(presets.text(name))


def readings(spec):
    return row_count(spec.gradient_schedule, spec.rig.table)


def test_the_papers_dynamic_gradient_plan_is_seventeen_cycles_of_six_minutes():
    schedule = PAPER.schedule
    soak, ramp = schedule.segments
    assert (soak.duration, soak.used, ramp.duration, ramp.used) == (3600.0, False, 6000.0, True)
    assert (ramp.temperature_start, ramp.temperature_end, ramp.slope) == (-30.0, 70.0, pytest.approx(1 / 60))
    assert schedule.period == pytest.approx(360.0, abs=1e-9)
    assert math.fsum(step.move.duration for step in schedule.steps) == pytest.approx(120.0, abs=1e-9)
    (stretch,) = schedule.stretches
    assert (stretch.start, stretch.cycles) == (3600.0, 17)
    assert stretch.leftover == pytest.approx(120.0, abs=1e-6)
    # 26 readings of its own a cycle, 240 while the others turn, 120 in what is left after the last moves
    assert readings(PAPER) == 17 * 26 + 16 * 240 + 120
    assert [round(step.move.peak_rate / DEG) for step in schedule.steps] == [0, 10, 150, 300, 0, -10, -150, -300]


def test_the_papers_other_plans_take_the_papers_hours():
    hours = {"paper-static-standard": 9.0, "paper-dynamic-standard": 9.0, "paper-static-gradient": 8 / 3}
    for name, expected in hours.items():
        assert preset(name).schedule.duration / 3600 == pytest.approx(expected)
    static = preset("paper-static-gradient")
    assert (static.plan.cycle, readings(static), static.gradient_schedule.soak) == (None, 6000, 3600.0)
    dynamic = preset("paper-dynamic-standard").schedule
    assert dynamic.readings == 36
    with pytest.raises(ValueError, match="gradient"):
        _ = preset("paper-dynamic-standard").gradient_schedule


def test_messages_carry_value_expectation_and_nearest_spelling():
    with pytest.raises(SpecError) as caught:
        parse_spec(TEXT.replace("max_rate  ", "max_rte  "), "mine.toml")
    said = 'mine.toml: rig.table.axis[0].max_rte = "300 deg/s": this key is unknown; nearest: "max_rate"'
    assert str(caught.value) == said


@pytest.mark.parametrize(
    ("ends", "slope", "sign"),
    [(["-30 degC", "70 degC"], "1.8 K/min", 1.0), (["70 degC", "-30 degC"], "1.5 K/min", -1.0)],
)
def test_ramps_go_both_ways_and_answer_to_their_own_limit(ends, slope, sign):
    schedule = changed(PAPER, {"plan.temperature": ends, "plan.gradient": slope}).schedule
    assert math.copysign(1.0, schedule.segments[1].slope) == sign
    if sign < 0.0:
        with pytest.raises(SpecError) as caught:
            changed(PAPER, {"plan.temperature": ends, "plan.gradient": "1.8 K/min"})
        assert [problem.dotted for problem in caught.value.problems] == ["plan.gradient"]


PROGRAMME = """
programme = [
  { soak = "1 h", at = "-30 degC" },
  { ramp_to = "70 degC", rate = "1 K/min" },
  { soak = "10 min", used = true },
  { step_to = "20 degC" },
  { soak = "10 min", at = "20 degC", used = true },
]
"""


def test_a_programme_is_walked_segment_by_segment():
    changes = dict.fromkeys(("plan.temperature", "plan.gradient", "plan.soak"))
    changes |= {f"plan.{key}": value for key, value in tomllib.loads(PROGRAMME).items()}
    spec = changed(preset("paper-static-gradient"), changes)
    schedule = spec.gradient_schedule
    assert [segment.kind for segment in schedule.segments] == ["soak", "ramp", "soak", "step", "soak"]
    step = schedule.segments[3]
    assert step.duration == pytest.approx(50 / 1.5 * 60)  # as fast as the chamber cools
    assert [stretch.duration for stretch in schedule.stretches] == [pytest.approx(6600.0), pytest.approx(600.0)]
    assert readings(spec) == 7200
    assert schedule.duration == pytest.approx(3600 + 6000 + 600 + 2000 + 600)


def test_limits_that_are_just_met_are_accepted():
    changed(PAPER, {"rig.table.axis[0].travel": "1080 deg", "sensor.gyro.full_scale": "316 deg/s"})


def test_other_axes_are_read_as_they_say():
    own = changed(PAPER, {"plan.cycle.other_axes.read_every": "2 s"})
    assert own.schedule.after[0].move.read_every == 2.0
    # Two minutes of the ramp that no cycle fills are read as the table is.
    assert readings(changed(PAPER, {"plan.cycle.other_axes": {"duration": "4 min"}})) == 17 * 26 + 120


def test_missing_files_name_a_neighbour(tmp_path):
    (tmp_path / "tactical.toml").write_text(TEXT)
    with pytest.raises(SpecError, match=r'nearest: "tactical\.toml"'):
        read_spec(tmp_path / "tacticl.toml")
    with pytest.raises(SpecError, match="directory"):
        read_spec(tmp_path)
    with pytest.raises(SpecError, match="not a possible path"):
        read_spec("a\0b")
