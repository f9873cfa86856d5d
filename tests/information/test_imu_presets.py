"""Presets: each is read, written back, predicted; what one cannot see is said in a sentence."""

import tomllib

import jsonschema
import pytest

import gradcal_jax as gj
from gradcal_jax.spec import presets
from gradcal_jax.spec.changes import tables_of
from gradcal_jax.tables.schemas import schema

# What each leaves, roughly: gyro scale factor ppm, bias deg/h, misalignment urad; accelerometer bias ug, scale factor
# ppm, misalignment urad. From the known answers of the same kind of plan and noise, where there are any (six faces once
# 77.8 ug, 19.6 ppm, 77.7 urad; 24 positions 33.2, 13.9, 18.0; the paper's cycle 16.1, 0.463, 58.8 and 4646, 4616,
# 4647; a mounting's 100 urad over the root of three), else of their order.
LEFT = {
    "accelerometer-six-positions": (None, None, None, 80.0, 25.0, 80.0),
    "accelerometer-six-positions-toured": (None, None, None, 80.0, 9.0, 76.0),
    "accelerometer-24-positions": (None, None, None, 35.0, 16.0, 19.0),
    "ferraris": (17.0, 0.6, 23.0, 33.0, 25.0, 35.0),
    "nineteen-positions": (0.6, 0.003, 1.3, 4.0, 1.2, 1.3),
    "heat-and-cool": (4.7, 0.28, 1.7, 16.0, 4.4, 4.3),
    "gradient-three-axes": (16.1, 0.463, 58.8, 4646.0, 4616.0, 4647.0),
    "two-axis-table": (6.1, 0.41, 3.0, 23.0, 7.5, 6.0),
    "one-axis-table": (5.8, 0.35, 57.7, 18.0, 5.5, 57.7),
    "standard-three-axes": (3.0, 0.41, 3.0, 23.0, 8.0, 7.4),
    "gimbal-by-hand": (51.4, 0.454, 41.0, 32.5, 17.6, 41.3),
}
QUANTITIES = (
    "gyro_scale_factor", "gyro_bias", "gyro_misalignment", "accelerometer_bias", "accelerometer_scale_factor",
    "accelerometer_misalignment",
)  # fmt: skip
BLIND = "gradient-three-axes"


def test_the_presets_of_imus_are_among_all():
    assert len(presets.names()) == 22
    assert set(presets.names()) > set(LEFT)


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


@pytest.mark.parametrize("name", LEFT)
def test_a_preset_leaves_what_its_kind_of_plan_leaves_and_meets_its_targets_or_says_why(name):
    found = gj.predict(gj.parse_spec(presets.text(name)))
    rows = {row.quantity: row for row in reversed(found.requirements)}
    for quantity, expected in zip(QUANTITIES, LEFT[name], strict=True):
        if expected is not None:
            assert rows[quantity].decisive == pytest.approx(expected, rel=0.1), quantity
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
