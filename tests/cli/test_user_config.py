"""The user's configuration: laboratory, rig and options of commands, and what is wrong with it in a sentence."""

import json

import pytest
from report_samples import calibration, recipe

import gradcal_jax as gj
from gradcal_jax.cli import main
from gradcal_jax.cli.user_config import config_path
from gradcal_jax.spec.rig import TEMPLATE

LABORATORY = '[laboratory]\nname = "House of rates"\ncountry = "DE"\noperator = "A. Person"\n'


@pytest.fixture
def config(tmp_path, monkeypatch):
    """Writes the configuration."""

    def write(text, first='format = "gradcal-config/1"\n'):
        path = tmp_path / "home" / "gradcal" / "config.toml"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(first + text, encoding="utf-8")
        return path

    monkeypatch.delenv("GRADCAL_CONFIG")
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path)
    return write


@pytest.fixture
def certified(tmp_path, capsys):
    """Makes a certificate with a DCC: its numbers as JSON."""
    gj.write_toml(recipe(), tmp_path / "recipe.toml")
    gj.write_calibration(calibration(recipe()), tmp_path / "cal.toml")

    def make(*options):
        words = ["report", "recipe.toml", "cal.toml", "--certificate", "-o", "c.html", "--force", "--json", *options]
        assert main(words) == 0
        return json.loads(capsys.readouterr().out)

    return make


def test_the_laboratory_signs_unless_the_rig_file_names_one(config, certified, tmp_path):
    assert certified()["heading"]["laboratory"] == "not stated"
    config(LABORATORY)
    options = ("--number", "K-1", "--performed", "2026-11-22", "--dcc", "c.xml")
    assert certified(*options)["heading"]["laboratory"] == "House of rates"
    assert "House of rates" in (tmp_path / "c.xml").read_text(encoding="utf-8")
    rig = TEMPLATE + '\n[laboratory]\nname = "Another house"\ncountry = "FR"\n'
    (tmp_path / "rig.toml").write_text(rig, encoding="utf-8")
    told = certified(*options, "--rig", "rig.toml")["heading"]
    assert (told["laboratory"], told["operator"]) == ("Another house", "not stated")
    assert "House of rates" not in (tmp_path / "c.xml").read_text(encoding="utf-8")


def test_an_option_has_the_users_default_unless_it_is_given(config, certified):
    config('[defaults.report]\nnumber = "K-7"\n')
    assert certified()["heading"]["certificate number"] == "K-7"
    assert certified("--number", "K-8")["heading"]["certificate number"] == "K-8"


def test_the_rig_is_the_users_if_none_is_given(config, tmp_path, capsys):
    config("")
    assert main(["rig", "check"]) == 2
    assert "name the rig file" in capsys.readouterr().err
    path = config('rig = "bench.toml"\n')
    assert main(["rig", "check"]) == 2
    assert str(path.parent / "bench.toml") in capsys.readouterr().err
    assert main(["rig", "check", "mine.toml"]) == 2
    assert "gradcal: mine.toml: does not exist" in capsys.readouterr().err
    gj.write_toml(recipe(), tmp_path / "recipe.toml")
    assert main(["run", "recipe.toml", "-o", "run"]) == 2
    assert str(path.parent / "bench.toml") in capsys.readouterr().err
    # A rehearsal takes no rig.
    assert main(["run", "recipe.toml", "-o", "run", "--simulate", "--rig", "mine.toml"]) == 2
    assert "use --simulate (not both)" in capsys.readouterr().err
    assert main(["run", "recipe.toml", "-o", "run", "--simulate", "--json"]) == 0


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('[labratory]\nname = "L"\n', 'labratory = {…}: this key is unknown; nearest: "laboratory" (line 2)'),
        ('[laboratory]\nnam = "L"\n', 'laboratory.nam = "L": this key is unknown; nearest: "name" (line 3)'),
        ("[defaults.reprot]\nnumber = 1\n", 'defaults.reprot: there is no such command; nearest: "report"'),
        ("[defaults.schema]\nlsit = true\n", "lsit"),
        ("[defaults]\nschema = 3\n", "must be a mapping"),
        ("= 3\n", "is not valid TOML"),
    ],
)
def test_what_is_wrong_is_a_sentence_with_the_file(config, text, said, capsys):
    path = config(text)
    assert main(["schema", "--list"]) == 2
    told = capsys.readouterr()
    assert told.err.startswith("gradcal: ")
    assert (said in told.err, str(path) in told.err, told.out) == (True, True, ""), told.err


def test_the_environment_names_another_file_or_none(config, monkeypatch, capsys):
    path = config("wrong = 1\n")
    assert config_path() == path
    monkeypatch.setenv("GRADCAL_CONFIG", "")
    assert main(["schema", "--list"]) == 0
    monkeypatch.setenv("GRADCAL_CONFIG", "elsewhere.toml")
    assert main(["schema", "--list"]) == 2
    assert "elsewhere.toml: does not exist" in capsys.readouterr().err
