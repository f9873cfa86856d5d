"""Writing and changing specs: nothing is lost, nothing is left half written, and new numbers get their key's unit."""

import os
import pickle
import tomllib

import pytest

from gradcal_jax.spec import presets
from gradcal_jax.spec import spec as spec_file
from gradcal_jax.spec.changes import changed, tables_of
from gradcal_jax.tables import writing
from gradcal_jax.tables.problems import SpecError
from gradcal_jax.tables.quantity import Quantity
from gradcal_jax.tables.writing import write_whole

PAPER = spec_file.parse_spec(presets.text("paper-dynamic-gradient"))


@pytest.mark.parametrize("name", presets.names())
def test_a_spec_written_back_is_the_same_spec_with_the_same_texts(name, tmp_path):
    document = tomllib.loads(presets.text(name))
    spec = spec_file.spec_of(document)
    assert tables_of(spec) == document
    writing.write_toml(spec, tmp_path / "copy.toml", header="written back")
    text = (tmp_path / "copy.toml").read_text(encoding="utf-8")
    assert text.startswith("# written back\n")
    assert tomllib.loads(text) == document
    assert spec_file.read_spec(tmp_path / "copy.toml") == spec


def test_a_text_is_on_the_disk_before_it_takes_the_place_of_another(tmp_path, monkeypatch):
    """Else a computer that stops at once has an empty file where there was a good one."""
    path, done = tmp_path / "a.toml", []
    path.write_text("old", encoding="utf-8")
    own = os.fsync
    monkeypatch.setattr(os, "fsync", lambda number: (own(number), done.append(path.read_text(encoding="utf-8"))))
    write_whole(path, "new")
    assert done == ["old"]
    assert path.read_text(encoding="utf-8") == "new"


def test_a_failed_write_leaves_the_old_file_and_no_litter(tmp_path):
    goal = tmp_path / "spec.toml"
    goal.write_text("old")
    with pytest.raises(UnicodeEncodeError):
        write_whole(goal, "\ud800")
    assert goal.read_text() == "old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["spec.toml"]
    write_whole(goal, "new\n")
    assert goal.read_bytes() == b"new\n"


@pytest.mark.parametrize(
    "key",
    [
        "plan.gradient",
        "plan.cycle.moves[1].duration",
        "rig.table.axis[0].angle.standstill_offset",
        "requirement[0].temperature[1]",
    ],
)
@pytest.mark.parametrize("number", [0.02, 0, 1])
def test_a_number_without_a_unit_is_refused_as_in_a_file(key, number):
    """0.02 for an angle was 0.02 rad, silently."""
    with pytest.raises(SpecError, match="as text with a unit") as caught:
        changed(PAPER, {key: number})
    assert {problem.dotted for problem in caught.value.problems} == {key}


def test_changes_reach_into_lists_and_new_tables_and_remove():
    spec = changed(
        PAPER,
        {
            "plan.cycle.moves[1].turn": "720 deg",
            "plan.cycle.moves[1].duration": "81.45 s",
            "rig.resolution.time": "0.1 s",
            "plan.soak": None,
            "sensor.gyro.scale_factor.rate.degree": 2,
            "requirement[0].temperature[1]": "60 degC",
        },
    )
    assert spec.schedule.steps[1].move.ramp == pytest.approx(9.45)
    assert spec.plan.cycle.moves[1].duration.text == "81.45 s"
    assert spec.rig.resolution.time == 0.1
    assert spec.schedule.soak == 0.0
    assert spec.sensor.gyro.scale_factor.size == 12
    assert spec.requirement[0].temperature[1].text == "60 degC"


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"plan.gradient": "9 K/min"}, "plan.gradient"),
        ({"plan.gradint": "1 K/min"}, "plan.gradint"),
        ({"plan.cycle.moves[99].rest": 1.0}, "plan.cycle.moves[99]"),
        ({"plan.gradient[0]": 1.0}, "plan.gradient[0]"),
        ({"plan.gradient.x": 1.0}, "plan.gradient.x"),
        ({"plan..x": 1.0}, "plan..x"),
        ({"[0]": 1.0}, "[0]"),
        ({"plan.gradient": float("nan")}, "plan.gradient"),
        ({"rig.table.axis[0].max_rate": True}, "rig.table.axis[0].max_rate"),
    ],
)
def test_impossible_changes_are_refused_by_key(changes, key):
    with pytest.raises(SpecError) as caught:
        changed(PAPER, changes)
    assert key in {problem.dotted for problem in caught.value.problems}


def test_quantities_pickle_and_print_as_their_text():
    quantity = Quantity.read("30 arcsec", "angle")
    again = pickle.loads(pickle.dumps(quantity))
    assert (again, again.text, again.dimension, str(again)) == (quantity, "30 arcsec", "angle", "30 arcsec")
    assert Quantity.of(2.0, "min").text == "0.033333333333333333 min"
    assert Quantity.of(120.0, "min").dimension == "time"
