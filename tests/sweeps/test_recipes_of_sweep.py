"""Sweeps over sections of other specs, and the recipes of a sweep with searches."""

import csv
import json

import pytest
from jobs_small import SPEC, compiled_programs

from gradcal_jax.cli import main
from gradcal_jax.recipe.recipe import read_recipe
from gradcal_jax.spec.changes import changed, tables_of
from gradcal_jax.spec.spec import parse_spec
from gradcal_jax.sweeps.points import Points
from gradcal_jax.sweeps.pool import LocalPool
from gradcal_jax.sweeps.recipes_of_sweep import slug, write_recipes
from gradcal_jax.sweeps.sweep import identity_of, sweep
from gradcal_jax.sweeps.sweep_file import read_sweep
from gradcal_jax.tables.problems import SpecError

SWEEP = """
format = "gradcal-sweep/1"
title  = "two tables"
base   = "small.toml"
do     = "optimise"
[change]
"design" = { minimise = "scale", free = ["duration", "peak_rate"], cycles = "alike", starts = 1 }
[[axis]]
key    = "rig.table.angle.reading_noise"
values = ["30 arcsec"]
[[axis]]
section = "rig"
values  = ["slow.toml", "small.toml"]
"""
SLOW = SPEC.replace('max_rate         = "100 deg/s"', 'max_rate         = "40 deg/s"').replace("80 deg/s", "30 deg/s")
SLOW = SLOW.replace('peak_rate = "50 deg/s"', 'peak_rate = "30 deg/s"')


def written(folder, text=SWEEP):
    (folder / "small.toml").write_text(SPEC, encoding="utf-8")
    (folder / "slow.toml").write_text(SLOW, encoding="utf-8")
    path = folder / "sweep.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_section_is_taken_whole_and_single_keys_are_changed_after_it(tmp_path):
    job = read_sweep(written(tmp_path))
    points = Points(job)
    assert points.shape == (1, 2)
    expected = changed(parse_spec(SPEC), {"rig.table.angle.reading_noise": "30 arcsec"})
    assert tables_of(changed(job.base, points.changes(1)))["rig"] == tables_of(expected)["rig"]
    with pytest.raises(SpecError, match="exceeds max_rate of axis"):
        changed(job.base, points.changes(0))
    # Another table of the same name is another sweep.
    before = identity_of(job)["asked"]
    (tmp_path / "slow.toml").write_text(SLOW.replace('"200 deg/s^2"', '"100 deg/s^2"'), encoding="utf-8")
    assert identity_of(read_sweep(tmp_path / "sweep.toml"))["asked"] != before


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('"slow.toml", "small.toml"', '"slow.tml", "small.toml"', "slow.tml: does not exist"),
        ('section = "rig"', 'section = "rigg"', "rig"),
        ('section = "rig"', 'section = "rig"\nkey = "plan.gradient"', "give exactly"),
        ('["slow.toml", "small.toml"]', "[1, 2]", "names of presets"),
    ],
)
def test_a_wrong_section_is_told_what_to_do(tmp_path, old, new, said):
    assert old in SWEEP
    with pytest.raises(SpecError) as caught:
        read_sweep(written(tmp_path, SWEEP.replace(old, new)))
    assert said in str(caught.value)


def test_names_make_files():
    assert slug("30″ encoder, 0.05°") == "30-arcsec-encoder-0.05-deg"


@pytest.mark.long
def test_recipes_are_written_and_summed_up(tmp_path, capsys):
    path, output, folder = written(tmp_path), tmp_path / "results.nc", tmp_path / "recipes"
    with LocalPool(1, compiled_programs()) as pool:
        sweep(read_sweep(path), output, runner=pool)
    # The search is finished: the command reads its results.
    assert main(["sweep", str(path), "-o", str(output), "--recipes", str(folder), "--json"]) == 1
    assert json.loads(capsys.readouterr().out.partition("\n}\n")[0] + "}")["failed"] == 1
    with (folder / "summary.csv").open(encoding="utf-8", newline="") as stream:
        none, best = csv.DictReader(stream)
    assert none["rig"] == "slow.toml"
    assert none["recipe"] == ""
    assert "exceeds max_rate" in none["search"]
    assert best["recipe"] == "30__small.toml"
    made = read_recipe(folder / best["recipe"])
    assert made.prediction.requirements[0].decisive == float(best["now"])
    assert float(best["now"]) < float(best["before"])
    assert f"]({best['recipe']})" in (folder / "summary.md").read_text(encoding="utf-8")
    assert main(["sweep", str(path), "-o", str(output), "--recipes", str(path)]) == 2
    assert "is a file; name a folder" in capsys.readouterr().err


def test_recipes_are_of_searches_alone(tmp_path, capsys):
    path = written(tmp_path, SWEEP.replace('"optimise"', '"predict"'))
    assert main(["sweep", str(path), "-o", str(tmp_path / "r.nc"), "--recipes", str(tmp_path / "r")]) == 2
    assert 'set do = "optimise"' in capsys.readouterr().err
    with LocalPool(1, compiled_programs()) as pool:
        sweep(read_sweep(path), tmp_path / "r.nc", runner=pool)
    from gradcal_jax.sweeps.dataset import read_dataset

    with pytest.raises(ValueError, match="recipes are only possible for a sweep"):
        write_recipes(read_dataset(tmp_path / "r.nc"), tmp_path / "r")
