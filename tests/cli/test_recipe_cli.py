"""`gradcal optimise --steps 0`, `check`, and recipes in the place of specs: the same numbers as the file carries."""

import json

import pytest

from gradcal_jax.cli import main
from gradcal_jax.recipe.recipe import read_recipe
from gradcal_jax.spec import presets
from gradcal_jax.tables import contracts


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recipe")
    spec = folder / "spec.toml"
    spec.write_text(presets.text("paper-dynamic-gradient"), encoding="utf-8")
    assert (
        main(
            ["optimise", str(spec), "--steps", "0", "--output", str(folder / "recipe.toml"), "--stable-within", "0.3 K"]
        )
        == 0
    )
    return folder / "recipe.toml"


def test_predict_says_of_a_recipe_what_the_recipe_says(made, capsys):
    status = main(["predict", str(made), "--json"])
    said = contracts.Prediction.model_validate_json(capsys.readouterr().out)
    carried = read_recipe(made).prediction
    assert status == (0 if carried.requirements[0].verdict == "met" else 1)
    assert said.duration_s == carried.duration_s
    for ours, theirs in zip(carried.requirements, said.requirements, strict=True):
        assert ours.mean_of_max == pytest.approx(theirs.mean_of_max, rel=1e-9)
        assert ours.max == pytest.approx(theirs.max, rel=1e-9)
        assert ours.verdict == theirs.verdict
    for ours, theirs in zip(carried.parameters, said.parameters, strict=True):
        assert (ours.name, ours.axis) == (theirs.name, theirs.axis)
        assert ours.std == pytest.approx(theirs.std, rel=1e-9)
    assert 80.0 < carried.requirements[0].mean_of_max < 90.0


@pytest.mark.parametrize("command", [["predict"], ["check", "--timeline", "segments"]])
def test_commands_take_a_recipe_for_a_spec(made, command, capsys):
    assert main([command[0], str(made), *command[1:]]) in (0, 1)
    assert ("linear ramps" if command[0] == "check" else "limited by") in capsys.readouterr().out


def test_show_is_a_table_that_a_technician_can_follow(made, capsys):
    assert main(["check", str(made)]) == 0
    shown = capsys.readouterr().out
    for words in (
        "soak 1  when stable  0:00:00",
        "from -30 degC to 70 degC at 1 K/min",
        "motion 1: begins with ramp 1, 17 times, one every 360 s",
        "stable: within 0.3 K",
        "+360 deg",
        "full range",
        "plan.cycle.other_axes.duration: 4 min -> 248 s",
    ):
        assert words in shown
    assert shown == str(read_recipe(made)) + "\n"
    assert main(["check", str(made), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["format"] == "gradcal-recipe/1"


@pytest.mark.parametrize(
    ("options", "useless"),
    [
        (["--steps", "0", "--quick"], "--quick: no effect with --steps 0"),
        (["--steps", "0", "--plot", "a.png"], "--plot"),
        (["--pause", "1 h"], "--pause: no effect unless SPEC is the folder of a run"),
        (["--points", "3"], "--points: no effect without --motion"),
        (["--motion", "50min", "--until-met", "--timeout", "4 h"], "--timeout, --until-met: no effect with --motion"),
    ],
)
def test_options_without_effect_are_refused(made, tmp_path, options, useless, capsys):
    assert main(["optimise", str(made), "-o", str(tmp_path / "new.toml"), *options]) == 2
    assert useless in capsys.readouterr().err
    assert not (tmp_path / "new.toml").exists()


def test_of_the_folder_of_a_run_options_of_searches_are_refused(tmp_path, capsys):
    assert main(["optimise", str(tmp_path), "-o", str(tmp_path / "rest.toml"), "--steps", "40"]) == 2
    assert "--steps: no effect if SPEC is the folder of a run" in capsys.readouterr().err
    assert main(["optimise", str(tmp_path)]) == 2
    assert "-o rest.toml" in capsys.readouterr().err


def test_catalogues_are_gone_and_it_is_said_what_to_do(capsys):
    assert main(["recipes", "mems.toml", "-o", "out"]) == 2
    assert "gradcal sweep FILE -o results.nc --recipes FOLDER" in capsys.readouterr().err


def test_slips_are_sentences(made, tmp_path, capsys):
    assert main(["optimise", str(made), "--steps", "0", "--output", str(made)]) == 2
    assert "overwrite it with --force" in capsys.readouterr().err
    spec = tmp_path / "spec.toml"
    spec.write_text(presets.text("paper-static-gradient"), encoding="utf-8")
    assert main(["run", str(spec), "--simulate", "-o", str(tmp_path / "run")]) == 2
    assert "gradcal optimise SPEC --steps 0 -o recipe.toml" in capsys.readouterr().err
    assert main(["optimise", str(spec), "--steps", "0", "--output", "-", "--stable-for", "5 K"]) == 2
    assert "time" in capsys.readouterr().err
