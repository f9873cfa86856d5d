"""Catalogues: which cases they make, and that finished recipes are kept."""

import json

import pytest
from jobs_small import SPEC, compiled_programs

from gradcal_jax.cli import main
from gradcal_jax.files import SpecError, changed, parse_spec, schema, tables_of
from gradcal_jax.files.catalogue import parse_catalogue, read_catalogue, slug
from gradcal_jax.files.recipe import read_recipe
from gradcal_jax.jobs.catalogue import as_markdown, recipes
from gradcal_jax.jobs.pool import LocalPool

CATALOGUE = """
format = "gradcal-catalogue/1"
title  = "two tables"
[design]
free   = ["duration", "peak_rate"]
cycles = "alike"
starts = 1
[[sensor]]
name = "gyro"
base = "small.toml"
[[rig]]
name   = "slow table"
base   = "small.toml"
change = { table = { max_rate = "40 deg/s", max_acceleration = "200 deg/s^2", travel = "unlimited", angle = { reading_noise = "0.02 deg" } } }
[[rig]]
name   = "30″ table"
base   = "small.toml"
change = { "table.angle.reading_noise" = "30 arcsec" }
[[requirement]]
name     = "scale"
minimise = "scale"
base     = "small.toml"
[[plan]]
name = "10 min"
base = "small.toml"
"""  # noqa: E501


def catalogue(tmp_path, text=CATALOGUE):
    (tmp_path / "small.toml").write_text(SPEC, encoding="utf-8")
    path = tmp_path / "catalogue.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_every_combination_is_a_case_and_what_is_no_spec_says_why(tmp_path):
    job = read_catalogue(catalogue(tmp_path))
    slow, fine = job.cases
    assert slow.spec is None
    assert "exceeds max_rate of axis" in slow.failure
    assert fine.slug == "gyro__30-arcsec-table__scale__10-min"
    assert fine.spec is not None
    expected = changed(parse_spec(SPEC), {"rig.table.angle.reading_noise": "30 arcsec"})
    found = tables_of(fine.spec)
    for section in ("sensor", "rig", "requirement", "plan"):
        assert found[section] == tables_of(expected)[section]
    assert found["design"]["minimise"] == "scale"


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('minimise = "scale"', 'minimise = "skale"', "is none of its requirements: scale, bias"),
        ('name = "gyro"\nbase = "small.toml"', 'name = "gyro"\nbase = "smal.toml"', 'nearest: "small.toml"'),
        ('name   = "slow table"', 'name   = "30″ Table"', "another one is called this"),
        ('"table.angle.reading_noise"', '"table.angle.reading_nose"', 'nearest: "reading_noise"'),
        ("[[sensor]]", "[[sensors]]", 'nearest: "sensor"'),
        ('base     = "small.toml"\n[[plan]]', "[[plan]]", 'give either "base" or "of"'),
    ],
)
def test_a_wrong_catalogue_is_told_what_to_do(tmp_path, old, new, said):
    assert old in CATALOGUE
    with pytest.raises(SpecError) as caught:
        read_catalogue(catalogue(tmp_path, CATALOGUE.replace(old, new)))
    assert said in str(caught.value)


def test_names_make_files():
    assert slug("30″ encoder, 0.05°") == "30-arcsec-encoder-0.05-deg"
    assert schema("catalogue")["$id"] == "gradcal-catalogue/1"
    with pytest.raises(SpecError, match='expected "gradcal-catalogue/1"'):
        parse_catalogue('format = "gradcal-sweep/1"')


def test_recipes_are_written_kept_and_summed_up(tmp_path, capsys):
    path, output = catalogue(tmp_path), tmp_path / "recipes"
    job = read_catalogue(path)
    with LocalPool(1, compiled_programs()) as pool:
        table = recipes(job, output, runner=pool)
    assert (len(table.rows), table.failed, table.kept) == (2, 1, 1)
    best, none = table.rows
    made = read_recipe(output / best["recipe"])
    decisive = made.prediction.requirements[0]
    assert decisive.mean_of_max == pytest.approx(best["now"], rel=1e-6)
    assert best["now"] < best["before"]
    assert none["recipe"] == ""
    csv = (output / "summary.csv").read_text(encoding="utf-8").splitlines()
    assert csv[0].startswith("sensor,rig,requirement,plan,objective")
    assert len(csv) == 3
    assert as_markdown(table, "two tables") == (output / "summary.md").read_text(encoding="utf-8")
    assert f"({best['recipe']})" in as_markdown(table, None)
    # Again, by the command: nothing is done twice, and the case without a recipe is status 1.
    before = (output / best["recipe"]).stat().st_mtime_ns
    capsys.readouterr()
    assert main(["recipes", str(path), "-o", str(output), "--json", "--workers", "1"]) == 1
    found = json.loads(capsys.readouterr().out)
    assert [row["now"] for row in found["rows"]] == [best["now"], None]
    assert (output / best["recipe"]).stat().st_mtime_ns == before
    assert main(["recipes", str(path), "-o", str(path)]) == 2
    assert "is a file; name a folder" in capsys.readouterr().err
