"""Specs: the paper's plans come out as the paper's numbers; limits and references are checked across sections."""

import math
import tomllib

import pytest

from gradcal_jax.spec import presets
from gradcal_jax.spec import spec as spec_file
from gradcal_jax.spec.schedule import row_count
from gradcal_jax.tables.problems import SpecError

DEG = math.pi / 180.0
PAPER = presets.text("paper-dynamic-gradient")


def keys_of(text_or_tables):
    read = spec_file.parse_spec if isinstance(text_or_tables, str) else spec_file.spec_of
    with pytest.raises(SpecError) as caught:
        read(text_or_tables)
    return {problem.dotted for problem in caught.value.problems}


def tables(name="paper-dynamic-gradient"):
    return tomllib.loads(presets.text(name))


def cycles(spec):
    return sum(stretch.cycles for stretch in spec.gradient_schedule.stretches)


def readings(spec):
    return row_count(spec.gradient_schedule, spec.rig.table)


def axis_of(document):
    """The table's only axis."""
    return document["rig"]["table"]["axis"][0]


def test_the_papers_dynamic_gradient_plan_is_seventeen_cycles_of_six_minutes():
    spec = spec_file.parse_spec(PAPER)
    schedule = spec.schedule
    soak, ramp = schedule.segments
    assert (soak.duration, soak.used, ramp.duration, ramp.used) == (3600.0, False, 6000.0, True)
    assert (ramp.temperature_start, ramp.temperature_end, ramp.slope) == (-30.0, 70.0, pytest.approx(1 / 60))
    assert schedule.period == pytest.approx(360.0, abs=1e-9)
    assert math.fsum(step.move.duration for step in schedule.steps) == pytest.approx(120.0, abs=1e-9)
    (stretch,) = schedule.stretches
    assert (stretch.start, stretch.cycles) == (3600.0, 17)
    assert stretch.leftover == pytest.approx(120.0, abs=1e-6)
    # 26 readings of its own a cycle, 240 while the others turn, 120 in what is left after the last moves
    assert readings(spec) == 17 * 26 + 16 * 240 + 120
    assert [round(step.move.peak_rate / DEG) for step in schedule.steps] == [0, 10, 150, 300, 0, -10, -150, -300]


def test_the_papers_other_plans_take_the_papers_hours():
    hours = {"paper-static-standard": 9.0, "paper-dynamic-standard": 9.0, "paper-static-gradient": 8 / 3}
    for name, expected in hours.items():
        assert spec_file.parse_spec(presets.text(name)).schedule.duration / 3600 == pytest.approx(expected)
    static = spec_file.parse_spec(presets.text("paper-static-gradient"))
    assert (static.plan.cycle, readings(static), static.gradient_schedule.soak) == (None, 6000, 3600.0)
    dynamic = spec_file.parse_spec(presets.text("paper-dynamic-standard")).schedule
    assert dynamic.readings == 36
    with pytest.raises(ValueError, match="gradient"):
        _ = spec_file.parse_spec(presets.text("paper-dynamic-standard")).gradient_schedule


def test_all_problems_come_in_one_message():
    text = (
        PAPER.replace('"0.1 deg/sqrt(h)"', '"0.1 deg/h"')
        .replace('"40', '"4O')
        .replace("max_heating", "max_heatin")
        .replace('"-40 degC"', '"-40"')
        .replace('"mean of max"             # mean', '"mean over max"  # mean')
        .replace('rest = "10 s"', "rest = 10", 1)
    )
    assert keys_of(text) == {
        "sensor.gyro.angle_random_walk",
        "rig.chamber.max_heatin",
        "rig.chamber.range[0]",
        "requirement[0].statistic",
        "plan.cycle.moves[0].rest",
    }


def test_a_misspelt_section_is_named_once_without_noise():
    assert keys_of(PAPER.replace("[rig.chamber]", "[rig.chamer]")) == {"rig.chamer"}
    misspelt = PAPER.replace("[sensor.gyro.scale_factor]", "[sensor.gyro.scalefactor]")
    assert keys_of(misspelt) == {"sensor.gyro.scalefactor"}
    assert keys_of(PAPER.replace("[sensor.gyro", "[sensor.gyr").replace("[[sensor.gyro", "[[sensor.gyr")) == {
        "sensor.gyr"
    }
    assert keys_of(PAPER.replace("[plan", "[plam")) == {"plam"}


def test_messages_carry_value_expectation_and_nearest_spelling():
    with pytest.raises(SpecError) as caught:
        spec_file.parse_spec(PAPER.replace("max_rate  ", "max_rte  "), "mine.toml")
    said = 'mine.toml: rig.table.axis[0].max_rte = "300 deg/s": this key is unknown; nearest: "max_rate"'
    assert str(caught.value) == said
    with pytest.raises(SpecError, match='expected "held" or "read"; nearest: "read"'):
        spec_file.parse_spec(PAPER.replace('= "read"', '= "raed"', 1))


@pytest.mark.parametrize("cooling", [False, True])
def test_ramps_go_both_ways_and_answer_to_their_own_limit(cooling):
    document = tables()
    if cooling:
        document["plan"]["temperature"].reverse()
    document["plan"]["gradient"] = "1.8 K/min"
    if cooling:
        assert keys_of(document) == {"plan.gradient"}
        document["plan"]["gradient"] = "1.5 K/min"
    schedule = spec_file.spec_of(document).schedule
    assert math.copysign(1.0, schedule.segments[1].slope) == (-1.0 if cooling else 1.0)


def programme():
    document = tables("paper-static-gradient")
    for key in ("temperature", "gradient", "soak"):
        del document["plan"][key]
    document["plan"]["programme"] = [
        {"soak": "1 h", "at": "-30 degC"},
        {"ramp_to": "70 degC", "rate": "1 K/min"},
        {"soak": "10 min", "used": True},
        {"step_to": "20 degC"},
        {"soak": "10 min", "at": "20 degC", "used": True},
    ]
    return document


def test_a_programme_is_walked_segment_by_segment():
    schedule = spec_file.spec_of(programme()).gradient_schedule
    assert [segment.kind for segment in schedule.segments] == ["soak", "ramp", "soak", "step", "soak"]
    step = schedule.segments[3]
    assert step.duration == pytest.approx(50 / 1.5 * 60)  # as fast as the chamber cools
    assert [stretch.duration for stretch in schedule.stretches] == [pytest.approx(6600.0), pytest.approx(600.0)]
    assert readings(spec_file.spec_of(programme())) == 7200
    assert schedule.duration == pytest.approx(3600 + 6000 + 600 + 2000 + 600)


@pytest.mark.parametrize(
    ("item", "value", "key"),
    [
        (1, {"ramp_to": "70 degC", "rate": "3 K/min"}, "plan.programme[1].rate"),
        (1, {"ramp_to": "90 degC", "rate": "1 K/min"}, "plan.programme[1].ramp_to"),
        (1, {"ramp_to": "-30 degC", "rate": "1 K/min"}, "plan.programme[1].ramp_to"),
        (3, {"step_to": "-50 degC"}, "plan.programme[3].step_to"),
        (4, {"soak": "1 h", "at": "25 degC"}, "plan.programme[4].at"),
        (0, {"soak": "1 h"}, "plan.programme[0]"),
        (1, {"ramp_to": "70 degC", "step_to": "70 degC"}, "plan.programme[1].step_to"),
        (1, {"rampto": "70 degC", "rate": "1 K/min"}, "plan.programme[1].rampto"),
        (1, {"ramp_to": "70 degC"}, "plan.programme[1].rate"),
        (1, "ramp", "plan.programme[1]"),
    ],
)
def test_faulty_programmes_are_named(item, value, key):
    document = programme()
    document["plan"]["programme"][item] = value
    assert key in keys_of(document)


def test_travel_counts_over_all_cycles():
    document = tables()
    axis_of(document)["travel"] = "1080 deg"
    spec_file.spec_of(document)
    axis_of(document)["travel"] = "1000 deg"
    assert keys_of(document) == {"plan.cycle.moves[3]"}
    axis_of(document)["travel"] = "1080 deg"
    document["plan"]["cycle"]["moves"][7]["turn"] = "-350 deg"
    document["plan"]["cycle"]["moves"][7]["duration"] = "1.49 s"
    assert keys_of(document) == {"plan.cycle.moves[3]"}  # ten degrees a cycle wind the cable up


def test_sensor_full_scale_less_margin_limits_the_motion():
    document = tables()
    document["sensor"]["gyro"]["full_scale"] = "300 deg/s"
    assert keys_of(document) == {"plan.cycle.moves[3]", "plan.cycle.moves[7]"}
    document["sensor"]["gyro"]["full_scale"] = "316 deg/s"
    spec_file.spec_of(document)
    document = tables("paper-dynamic-standard")
    document["sensor"]["gyro"]["full_scale"] = "250 deg/s"
    assert keys_of(document) == {"plan.rates[0]", "plan.rates[5]"}


def test_hand_tables_take_hand_turns_only():
    document = tables()
    document["rig"]["table"]["drive"] = "hand"
    assert keys_of(document) == {f"plan.cycle.moves[{i}].shape" for i in (1, 2, 3, 5, 6, 7)}
    document = tables("rig-hand")
    document["rig"]["table"]["drive"] = "motor"
    assert "plan.cycle.moves[1].shape" in keys_of(document)


def test_standard_plans_answer_to_chamber_and_table():
    document = tables("paper-dynamic-standard")
    document["plan"]["soak"] = "5 min"
    document["plan"]["temperatures"][0] = "-45 degC"
    document["plan"]["rates"][0] = "-301 deg/s"
    assert keys_of(document) == {"plan.soak", "plan.temperatures[0]", "plan.rates[0]"}
    document = tables("paper-dynamic-standard")
    axis_of(document)["travel"] = "50000 deg"
    assert keys_of(document) == {"plan.rates[0]", "plan.rates[5]"}


def test_requirements_must_be_estimated_unique_and_inside_the_basis():
    document = tables()
    document["requirement"][1]["name"] = "full range"
    document["requirement"].append({"name": "b", "quantity": "gyro_bias", "temperature": ["0 degC", "1 degC"]})
    assert keys_of(document) == {"requirement[1].name", "requirement[2].quantity"}
    document = tables()
    scale = document["sensor"]["gyro"]["scale_factor"]
    scale["temperature"] = {"degree": 0, "knots": ["-30 degC", "20 degC", "65 degC"]}
    scale["rate"] = {"knots": ["-200 deg/s", "300 deg/s"]}
    assert keys_of(document) == {"requirement[0].temperature[1]", "requirement[0].rate[0]", "requirement[1].rate[0]"}


def test_a_discrepancy_goes_beyond_polynomials():
    document = tables()
    scale = document["sensor"]["gyro"]["scale_factor"]
    hidden = {"standard_deviation": "5 ppm", "temperature_degree": 3, "rate_degree": 5}
    scale["discrepancy"] = hidden
    assert spec_file.spec_of(document).sensor.gyro.scale_factor.discrepancy.rate_degree == 5
    scale["discrepancy"] = hidden | {"rate_degree": 1}
    assert keys_of(document) == {"sensor.gyro.scale_factor.discrepancy"}
    scale["discrepancy"] = hidden
    scale["rate"] = {"knots": ["-300 deg/s", "0 deg/s", "300 deg/s"]}
    with pytest.raises(SpecError, match=r'scale_factor\.discrepancy.*use "smoothness" instead'):
        spec_file.spec_of(document)


def test_other_axes_are_read_as_they_say():
    document = tables()
    document["plan"]["cycle"]["other_axes"]["read_every"] = "2 s"
    assert spec_file.spec_of(document).schedule.after[0].move.read_every == 2.0
    document["plan"]["cycle"]["other_axes"] = {"duration": "4 min"}
    # Two minutes of the ramp that no cycle fills are read as the table is.
    assert readings(spec_file.spec_of(document)) == 17 * 26 + 120


def test_a_plan_has_readings_and_not_too_many():
    document = tables()
    document["plan"]["cycle"] = {"moves": [{"rest": "100 min", "read_every": "none"}]}  # the whole ramp
    assert keys_of(document) == {"plan.cycle"}
    document = tables("paper-static-gradient")
    axis_of(document)["angle"]["read_every"] = "1 us"
    assert keys_of(document) == {"rig.table.axis[0].angle.read_every"}


def test_missing_files_name_a_neighbour(tmp_path):
    (tmp_path / "tactical.toml").write_text(PAPER)
    with pytest.raises(SpecError, match=r'nearest: "tactical\.toml"'):
        spec_file.read_spec(tmp_path / "tacticl.toml")
    with pytest.raises(SpecError, match="directory"):
        spec_file.read_spec(tmp_path)
    with pytest.raises(SpecError, match="not a possible path"):
        spec_file.read_spec("a\0b")
