"""Presets: each is read, written back, predicted; what one cannot see is said in a sentence."""

import tomllib

import jsonschema
import pytest

import gradcal_jax as gj
from gradcal_jax.spec import presets
from gradcal_jax.spec.changes import tables_of
from gradcal_jax.tables.schemas import schema

IMUS = (
    "accelerometer-six-positions", "accelerometer-six-positions-toured", "accelerometer-24-positions", "ferraris",
    "nineteen-positions", "heat-and-cool", "gradient-three-axes", "two-axis-table", "one-axis-table",
    "standard-three-axes", "gimbal-by-hand",
)  # fmt: skip
BLIND = "gradient-three-axes"


@pytest.mark.parametrize("name", presets.names())
def test_a_preset_is_commented_and_written_back_it_is_the_same(name, tmp_path):
    text = presets.text(name)
    document, spec = tomllib.loads(text), gj.parse_spec(text, name)
    assert text.startswith("# ")
    assert text.count("#") >= 5
    assert presets.title(name) == spec.title
    assert name.startswith("paper") or all(requirement.target is not None for requirement in spec.requirement)
    assert tables_of(spec) == document
    gj.write_toml(spec, tmp_path / "copy.toml", header="written back")
    assert tomllib.loads((tmp_path / "copy.toml").read_text(encoding="utf-8")) == document
    assert gj.read_spec(tmp_path / "copy.toml") == spec
    jsonschema.Draft202012Validator(schema("spec")).validate(document)


@pytest.mark.parametrize("name", IMUS)
def test_a_preset_meets_its_targets_or_says_why(name):
    """What it leaves is recorded in `tests/numbers`."""
    found = gj.predict(gj.parse_spec(presets.text(name)))
    # By the terms that the file names: what it leaves out counts in the verdict, and is no part of the kind of plan.
    missed = {row.quantity for row in found.requirements if row.decisive is None or row.decisive > row.target}
    said = " ".join(found.warnings)
    if name == BLIND:
        assert {"accelerometer_bias", "accelerometer_scale_factor", "second_order", "gyro_misalignment"} <= missed
        for axis in "xyz":
            assert f"accelerometer_{axis}." in said
        assert "up, down and horizontal" in said
        assert "rotated by 180 deg" in said
    else:
        assert not missed
        assert "cannot observe" not in said


def test_what_no_plan_at_one_temperature_tells_is_said_once_for_all_requirements():
    spec = gj.parse_spec(presets.text("accelerometer-six-positions"))
    (note,) = gj.check(spec)
    assert note.startswith("'accelerometer bias', 'accelerometer scale factor', ")
    assert "only 20 … 20 °C" in note
    one = gj.changed(spec, {"requirement[0].temperature": ["19 degC", "22 degC"]})
    first, second = gj.check(one)
    assert first.startswith("'accelerometer bias': required for 19 … 22 °C")
    assert second.startswith("'accelerometer scale factor', 'accelerometer misalignment', ")
