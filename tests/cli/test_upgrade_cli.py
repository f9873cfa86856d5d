"""`gradcal check --upgrade`: files of earlier versions in today's form, with the same contents, nothing lost unsaid."""

import json
import tomllib
from pathlib import Path

import pytest
import tomlkit

from gradcal_jax.calibration.file import read_calibration
from gradcal_jax.cli import main
from gradcal_jax.recipe.recipe import read_recipe
from gradcal_jax.spec import presets
from gradcal_jax.spec.spec import read_spec

ROOT = Path(__file__).parents[2]
RECIPES = sorted((ROOT / "experiments" / "recipes").glob("*/*.toml"))


@pytest.fixture
def old(tmp_path):
    """A spec of one axis with comments."""
    text = (ROOT / "tests" / "files" / "spec" / "broken" / "rig_max_rate_misspelt.toml").read_text(encoding="utf-8")
    path = tmp_path / "old.toml"
    path.write_text(
        text.replace("max_rte", "max_rate").replace("[rig.chamber]", '[rig]\nearth_rate = "0 deg/h"\n[rig.chamber]')
    )
    return path


def test_a_spec_is_written_anew_and_reads_the_same(old, capsys):
    before, text = read_spec(old), old.read_text()
    new = old.with_name("new.toml")
    assert main(["check", "--upgrade", str(old), "-o", str(new)]) == 0
    out = capsys.readouterr().out
    assert "[sensor] -> [sensor], and [sensor.gyro]" in out
    assert "rig.earth_rate -> rig.site.latitude" in out
    assert f"the comments in {old} were not copied to {new}" in out
    assert old.read_text() == text
    tables = tomllib.loads(new.read_text())
    assert tables["sensor"]["gyro"]["axes"] == ["x"]
    assert "earth_rate" not in tables["rig"]
    assert read_spec(new) == before
    assert main(["check", "--upgrade", str(old), "-o", str(new)]) == 2
    assert "--force" in capsys.readouterr().err


def test_without_an_output_the_file_is_replaced_and_kept(old, capsys):
    before, text = read_spec(old), old.read_text()
    assert main(["check", "--upgrade", str(old)]) == 0
    assert f"the original file is now {old}.old" in capsys.readouterr().out
    assert Path(f"{old}.old").read_text() == text
    assert read_spec(old) == before
    upgraded = old.read_text()
    assert main(["check", "--upgrade", str(old)]) == 0
    assert "already has the current format; nothing was written" in capsys.readouterr().out
    assert old.read_text() == upgraded


def test_a_recipe_is_the_same_recipe(tmp_path, capsys):
    source = next(path for path in RECIPES if "gyro" not in tomllib.loads(path.read_text())["spec"]["sensor"])
    new = tmp_path / "new.toml"
    assert main(["check", "--upgrade", str(source), "-o", str(new)]) == 0
    assert "[spec.sensor]" in capsys.readouterr().out
    assert read_recipe(new).fingerprint == read_recipe(source).fingerprint
    assert main(["check", "--upgrade", str(new)]) == 0
    assert "already" in capsys.readouterr().out


def test_a_calibration_is_the_same_calibration(tmp_path, capsys):
    recorded = json.loads((ROOT / "tests" / "numbers" / "calibrations.json").read_text(encoding="utf-8"))
    tables = next(t for t in walked(recorded) if t.get("format") == "gradcal-calibration/1")
    source, new = tmp_path / "old.toml", tmp_path / "new.toml"
    source.write_text(tomlkit.dumps(tables), encoding="utf-8")
    assert main(["check", "--upgrade", str(source), "-o", str(new)]) == 0
    assert "gradcal-calibration/1 -> gradcal-calibration/3" in capsys.readouterr().out
    assert read_calibration(new) == read_calibration(source)


def walked(value):
    """Every table in recorded data, texts of TOML included."""
    if isinstance(value, dict):
        yield value
    if isinstance(value, str) and 'format = "gradcal-' in value:
        yield tomllib.loads(value)
    for inner in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        yield from walked(inner)


@pytest.mark.parametrize("name", ["tactical-mems", "two-axis-table"])
def test_todays_files_are_left_alone(name, tmp_path, capsys):
    path = tmp_path / "spec.toml"
    path.write_text(presets.text(name), encoding="utf-8")
    assert main(["check", "--upgrade", str(path), "-o", str(tmp_path / "new.toml")]) == 0
    assert "nothing was written" in capsys.readouterr().out
    assert not (tmp_path / "new.toml").exists()
    assert path.read_text(encoding="utf-8") == presets.text(name)


def test_what_is_wrong_or_of_another_kind_is_said_and_nothing_is_written(old, capsys):
    old.write_text(old.read_text().replace('"1 K/min"', '"9 K/min"'))
    text = old.read_text()
    assert main(["check", "--upgrade", str(old)]) == 2
    assert "plan.gradient" in capsys.readouterr().err
    old.with_name("rig.toml").write_text('format = "gradcal-rig/1"\n')
    assert main(["check", "--upgrade", str(old.with_name("rig.toml"))]) == 2
    assert "expected a spec, a recipe or a calibration" in capsys.readouterr().err
    assert old.read_text() == text
    assert sorted(path.name for path in old.parent.iterdir()) == ["old.toml", "rig.toml"]
