"""`gradcal start`: ten answers give files that are sound, predict, and know their error budget."""

import io
import itertools
import tomllib

import pytest

import gradcal_jax as gj
from gradcal_jax.api.measure import design_block, design_of, measure
from gradcal_jax.cli import main
from gradcal_jax.files.absent import absent_terms
from gradcal_jax.files.begin import PRESETS, QUESTIONS, files_of
from gradcal_jax.files.importers import parse_column_map
from gradcal_jax.files.rig import parse_rig

USUAL = PRESETS["drone-imu"]


def sound(texts):
    spec = gj.parse_spec(texts["spec.toml"])
    assert absent_terms(spec) == []
    assert spec.design is not None
    assert parse_rig(texts["rig.toml"]).axis
    assert parse_column_map(texts["columns.toml"]).name
    return spec


@pytest.mark.parametrize("preset", [name for name in PRESETS if name != "no-encoder"])
def test_a_preset_asks_nothing_and_its_files_are_sound_and_met(preset, tmp_path, capsys):
    out = tmp_path / "mine"
    assert main(["start", "--preset", preset, "-o", str(out)]) == 0
    assert f"gradcal predict {out / 'spec.toml'}" in capsys.readouterr().out
    texts = {path.name: path.read_text(encoding="utf-8") for path in out.iterdir()}
    spec = sound(texts)
    prediction = gj.predict(spec)
    assert [row.verdict for row in prediction.requirements] == ["met", "met"]
    assert prediction.omitted == ()
    assert not any("distinct rates" in s or "beyond" in s for s in prediction.warnings), prediction.warnings
    assert measure(spec).name == "scale factor (mean of max)"
    # Nothing is overwritten unasked.
    assert main(["start", "--preset", preset, "-o", str(out)]) == 2
    assert "exists" in capsys.readouterr().err


def test_without_an_encoder_a_person_and_gravity_do(tmp_path, monkeypatch, capsys):
    """By the preset, and by the answer "none" with a slower hand."""
    asked = "box\n\n\n\n200 deg/s\n400 deg/s^2\nnone\n\n0 degC, 50 degC, 4 K/min\n200 ppm, 60 deg/h\n"
    monkeypatch.setattr("sys.stdin", io.StringIO(asked))
    assert main(["start", "--preset", "no-encoder", "-o", str(tmp_path / "a")]) == 0
    assert main(["start", "-o", str(tmp_path / "b")]) == 0
    assert f"gradcal optimise {tmp_path / 'b' / 'spec.toml'} --steps 0" in capsys.readouterr().out
    for name, warm in (("a", 40.0), ("b", 50.0)):
        spec = gj.read_spec(tmp_path / name / "spec.toml")
        assert spec.rig.table.by_gravity
        assert float(spec.plan.programme[1].ramp_to) == warm
        assert [row.verdict for row in gj.predict(spec).requirements] == ["met"] * 4
        (axis,) = parse_rig((tmp_path / name / "rig.toml").read_text(encoding="utf-8")).axis
        assert axis.options["angle"] == "none"


def test_ten_questions_are_asked_and_enter_takes_what_is_usual(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("sys.stdin", io.StringIO("my gyro\n" + "\n" * 8 + "500 ppm, 50 deg/h\n"))
    assert main(["start", "-o", str(tmp_path / "mine")]) == 0
    asked = capsys.readouterr().out
    assert all(f"{n}. " in asked for n in range(1, 11))
    assert len(QUESTIONS) == 10
    spec = gj.read_spec(tmp_path / "mine" / "spec.toml")
    assert (spec.sensor.name, str(spec.requirement[0].target)) == ("my gyro", "500 ppm")
    assert str(spec.rig.table.axis[0].max_rate) == USUAL["rate"]


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("", "the answers ended at question 1 of 10"),
        ("x\nconsummer\n", "nearest: 'consumer'"),
        ("x\n\nfast\n", "angle random walk"),
        ("x\n\n\n\n\n\n\n\n-25 degC, 70 degC\n", "expected 3 answers"),
        ("x\n\n\n-5 deg/s\n", "more than zero"),
        ('a"b\n', "without quotes"),
        ("x\n\n\n\n\n\n\n\n20 degC, 25 degC, 1 K/min\n\n", "at least 10 K"),
    ],
)
def test_answers_that_are_not_understood_are_sentences_and_nothing_is_written(
    given, said, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr("sys.stdin", io.StringIO(given))
    assert main(["start", "-o", str(tmp_path / "mine")]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "mine").exists()


RATES, TRAVELS = (
    ("30 deg/s", "360 deg/s", "2000 deg/s"),
    ("unlimited", "90 deg", "360 deg", "5 turns".replace("5 turns", "1800 deg")),
)
CHAMBERS = ("-25 degC, 70 degC, 1 K/min", "-40 degC, 85 degC, 5 K/min", "10 degC, 40 degC, 0.2 K/min")


@pytest.mark.parametrize(
    "changes",
    [
        dict(zip(("rate", "travel", "chamber", "grade"), values, strict=True))
        for values in itertools.product(RATES, TRAVELS, CHAMBERS, ("consumer", "navigation"))
    ],
    ids=lambda changes: ", ".join(changes.values()),
)
def test_files_are_sound_for_any_bench(changes):
    """The file's own checks hold travel, acceleration, rates and the chamber against the plan."""
    spec = sound(files_of(USUAL | changes))
    assert spec.gradient_schedule.steps


@pytest.mark.parametrize("name", [n for n in gj.presets.names() if "# [design]" in gj.presets.text(n)])
def test_presets_carry_a_design_to_uncomment(name):
    text = gj.presets.text(name)
    head, block = text.split("# [design]", 1)
    lines = ["[design]" + block.splitlines()[0], *(line.removeprefix("# ") for line in block.splitlines()[1:])]
    spec = gj.parse_spec(head + "\n".join(lines))
    assert design_of(spec).minimise == spec.requirement[0].name
    assert measure(spec).unit in ("ppm", "deg/h")


def test_a_missing_design_is_said_with_one_to_paste():
    spec = gj.parse_spec(gj.presets.text("tactical-mems"))
    with pytest.raises(ValueError, match="To paste") as caught:
        design_of(spec)
    pasted = str(caught.value).split("\n\n", 1)[1]
    assert tomllib.loads(pasted)["design"]["minimise"] == "scale factor"
    assert design_block(spec) == pasted
    assert design_of(gj.parse_spec(gj.presets.text("tactical-mems") + pasted)).starts == 8
