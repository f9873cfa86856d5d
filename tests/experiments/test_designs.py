"""The committed designs keep what they promise: recipes predict what their files say, and no limit is beaten."""

import csv
import json
from pathlib import Path

import pytest

from gradcal_jax.design.plan_limit import limit
from gradcal_jax.information.prediction import predict
from gradcal_jax.recipe.recipe import read_recipe

EXPERIMENTS = Path(__file__).parents[2] / "experiments"
RESULTS = json.loads((EXPERIMENTS / "designs" / "results.json").read_text(encoding="utf-8"))
AGAIN = json.loads((EXPERIMENTS / "designs" / "again.json").read_text(encoding="utf-8"))
with (EXPERIMENTS / "recipes" / "mems" / "summary.csv").open(encoding="utf-8", newline="") as _stream:
    CATALOGUE = list(csv.DictReader(_stream))


def recipe_of(variant: str) -> Path:
    folder = EXPERIMENTS / "recipes" if variant == "headline" else EXPERIMENTS / "recipes" / "headline"
    return folder / f"{variant}.toml"


def test_the_headline_keeps_its_promise():
    headline, free = RESULTS["headline"], RESULTS["cycle-length-free"]
    assert headline["residual"] <= 3.5
    assert headline["residual"] <= 1.5 * headline["limit"]
    assert free["residual"] <= 2.8


@pytest.mark.parametrize("variant", [name for name, row in RESULTS.items() if row["limit"] is not None])
def test_no_variant_beats_its_limit(variant):
    assert RESULTS[variant]["limit"] <= RESULTS[variant]["residual"]


@pytest.mark.parametrize("row", CATALOGUE, ids=lambda row: f"{row['sensor']}, {row['rig']}")
def test_no_recipe_of_the_catalogue_beats_its_limit_or_is_worse_than_the_plan_as_it_was(row):
    assert 0.0 < float(row["limit"]) <= float(row["now"]) <= float(row["before"])


@pytest.mark.parametrize("variant", AGAIN)
def test_nothing_near_an_optimum_is_better_and_prices_are_differences(variant):
    found = AGAIN[variant]
    assert found["count"] >= 200
    assert found["better"] == 0
    assert found["gradient"] < 1e-4
    for price in found["prices"]:
        assert price["price"] == pytest.approx(price["difference"], rel=0.05, abs=1e-3 * found["optimum"]), price


def test_a_recipe_predicts_what_its_file_says():
    """As `gradcal predict` would, from the file alone; for every recipe it is a long proof."""
    said = read_recipe(recipe_of("2h40"))
    found = predict(said.spec).requirements[0]
    assert found.mean == pytest.approx(said.prediction.requirements[0].mean, rel=1e-9)
    assert found.mean == pytest.approx(RESULTS["2h40"]["residual"], rel=1e-9)


EVERY = sorted([*(EXPERIMENTS / "recipes").glob("headline*/*.toml"), *(EXPERIMENTS / "recipes").glob("mems/*.toml")])


@pytest.mark.evidence
@pytest.mark.parametrize("path", [recipe_of("headline"), *EVERY], ids=lambda path: path.stem)
def test_every_recipe_predicts_what_its_file_says_and_lies_above_its_limit(path):
    said = read_recipe(path)
    found, kept = predict(said.spec).requirements[0], said.prediction.requirements[0]
    for name in ("mean_of_max", "max", "mean", "rms"):
        value = getattr(kept, name)
        assert value is None or getattr(found, name) == pytest.approx(value, rel=1e-9)
    if found.quantity == "scale_factor":
        assert all(row.value is not None and row.certified <= row.value for row in limit(said.spec))
