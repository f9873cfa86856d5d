"""What `gradcal start` writes, from its answers to a calibration, over twenty seeds of each preset: the errors of the
calibration against the hidden truth, and of each requirement against the uncertainty that is stated.

The simulated devices have what the specs state and no residual shows: dies that are late behind a thermometer that is
off, an axis that turns by less than its encoder counts, an input axis beside the table's, the Earth's rate at any
latitude. A plan of a few hours is run whole, as a user runs it.
"""

import json
import os
import shutil
import time
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chain import say
from fault_scenes import UNIT_SIZES, held, summed, term_values
from scipy.stats import binom, chi2

import gradcal_jax as gj
from gradcal_jax.spec import begin

REPORT = Path(__file__).parents[2] / "experiments" / "evidence" / "started_truths.md"
SEEDS = int(os.environ.get("GRADCAL_SEEDS", "20"))
_HEAD = """# The calibrations of what `gradcal start` writes, against the hidden truth

Made by `pytest -m evidence tests/evidence/test_started_truths.py`: spec of a preset, plan by `optimise --until-met`,
run on simulated devices, log, estimate, page. The devices have what the spec states and no residual shows: dies that
are late behind a thermometer that is off, an axis that turns by less than its encoder counts, an input axis beside the
table's.

"within U": requirements of all runs whose true error, by the requirement's own statistic, is at most U (k = 2), and
the largest over its U; a run whose tests of the fit fail states no U. "χ² of the truth" is that of the page: errors of
all coefficients, with what no residual shows and the random walk of the bias before the data; its 99 % band; and how
many pages state a chance below 1 %; likewise tests of the fit.

| preset | runs | within U | largest | χ² of the truth | of | band | each | pages < 1 % | fits < 1 % | not valid |
|---|---|---|---|---|---|---|---|---|---|---|
"""


def started(preset: str, folder: Path) -> Path:
    """The recipe of a preset of `start`."""
    status, printed = say("start", "--preset", preset, "-o", folder / "mine")
    assert status == 0, printed
    spec = folder / "mine" / "spec.toml"
    # A search is for motors.
    by_hand = tomllib.loads(spec.read_text(encoding="utf-8"))["rig"]["table"].get("drive") == "hand"
    how = ("--steps", 0) if by_hand else ("--until-met",)
    status, printed = say("optimise", spec, *how, "-o", folder / "recipe.toml")
    assert status == 0, printed
    return folder / "recipe.toml"


def page(recipe: Path, folder: Path, seed: int) -> dict[str, Any]:
    """What the page of a simulated run states; of its requirements, error over U; whether a test of the fit failed."""
    run = folder / f"run{seed}"
    path = run / "calibration.toml"
    for words in (("run", recipe, "--simulate", "--seed", seed, "--json", "-o", run), ("log", run)):
        status, printed = say(*words)
        assert status == 0, printed
    status, printed = say("estimate", *sorted(run.glob("*.nc")), "--recipe", recipe, "-o", path)
    assert status in (0, 1), printed
    status, printed = say("report", run, "--json", "-o", folder / f"page{seed}.html")
    assert status in (0, 1), printed
    stated = json.loads(printed[printed.index("{") :])
    made = tomllib.loads(path.read_text(encoding="utf-8"))
    (truth,) = json.loads((run / "hidden_truth.json").read_text(encoding="utf-8"))["units"].values()
    shutil.rmtree(run)
    rows = {row["name"]: row for row in made["result"]}
    shares = [error_over_u(requirement, rows[requirement.name], made, truth)
              for requirement in gj.read_recipe(recipe).spec.requirement]  # fmt: skip
    failed = any(str(row.get("verdict")).startswith("not valid") for row in made["result"])
    return stated | {"shares": shares, "failed": failed}


def error_over_u(requirement: Any, row: dict[str, Any], made: dict[str, Any], truth: dict[str, float]) -> float:
    """The largest error of a channel, by the requirement's own statistic, over the U (k = 2) that is stated."""
    kind, name = requirement.quantity.split("_", 1)
    grid = requirement.grid
    temperatures = np.linspace(*map(float, requirement.temperature), grid[0])
    rates = np.linspace(*map(float, requirement.rate), grid[1]) if name == "scale_factor" and kind == "gyro" else [0.0]
    t, x = (of.ravel() for of in np.meshgrid(temperatures, rates, indexing="ij"))
    errors = []
    for channel in made["channel"]:
        if channel["kind"] != kind:
            continue
        at = held(channel, t, x)
        for term in channel["term"]:
            if term["name"] == name:
                true = {n: truth[f"{kind}_{channel['axis']}.{n}"] for n in term["coefficients"]}
                apart = term_values(term, *at) - term_values(term | {"coefficients": true}, *at)
                errors.append(summed(apart, row["statistic"], (len(temperatures), len(rates))))
    return max(errors) / UNIT_SIZES[row["unit"]] / (2.0 * row.get("worst", row["value"]))


def outside(pages: list[dict[str, Any]]) -> tuple[int, int]:
    """The requirements whose error is beyond U, and all, of runs whose tests of the fit pass."""
    shares = [share for of in pages if not of["failed"] for share in of["shares"]]
    return sum(share > 1.0 for share in shares), len(shares)


def faults(pages: list[dict[str, Any]]) -> list[str]:
    """What does not hold of the pages of a preset."""
    found = [of["agreement"] for of in pages]
    chi_squared, degrees = sum(of[0] for of in found), sum(of[1] for of in found)
    low, high = chi2.ppf([0.005, 0.995], degrees)
    few, (beyond, of_all) = sum(of[2] < 0.01 for of in found), outside(pages)
    wrong = [] if low < chi_squared < high else [f"χ² {chi_squared:.1f} of {degrees} ({low:.0f} … {high:.0f})"]
    # Of twenty pages one may; more than two are beyond chance.
    wrong += [f"{few} pages below 1 %"] * (few > 2)
    # U is to cover 95 %.
    if binom.sf(beyond - 1, of_all, 0.05) < 0.01:
        wrong.append(f"{beyond} of {of_all} errors beyond U")
    return wrong


def report(preset: str, pages: list[dict[str, Any]]) -> None:
    """Write or replace the row of a preset."""
    rows: dict[str, str] = {}
    if REPORT.exists():
        for line in REPORT.read_text(encoding="utf-8").splitlines():
            if line.startswith("| `"):
                rows[line.split("`")[1]] = line
    found = [of["agreement"] for of in pages]
    degrees = sum(of[1] for of in found)
    low, high = chi2.ppf([0.005, 0.995], degrees)
    each = [of[0] for of in found]
    fits = [test["chance"] for of in pages for test in of["fit"] if test["degrees"] > 0]
    beyond, of_all = outside(pages)
    cells = (
        f"{len(pages)}", f"{of_all - beyond} of {of_all}",
        f"{max(share for of in pages if not of['failed'] for share in of['shares']):.2f}",
        f"{sum(each):.1f}", f"{degrees}", f"{low:.0f} … {high:.0f}",
        f"{min(each):.1f} … {max(each):.1f} of {found[0][1]}", f"{sum(of[2] < 0.01 for of in found)}",
        f"{sum(chance < 0.01 for chance in fits)} of {len(fits)}", f"{sum(of['failed'] for of in pages)}",
    )  # fmt: skip
    rows[preset] = f"| `{preset}` | {' | '.join(cells)} |"
    body = "\n".join(rows[name] for name in sorted(rows))
    REPORT.write_text(f"{_HEAD}{body}\n\n{time.strftime('%Y-%m-%d')}.\n", encoding="utf-8")


@pytest.mark.evidence
@pytest.mark.parametrize("preset", begin.PRESETS)
def test_the_truth_agrees_with_what_start_leads_to(preset: str, tmp_path: Path) -> None:
    recipe = started(preset, tmp_path)
    pages = [page(recipe, tmp_path, seed) for seed in range(1, SEEDS + 1)]
    report(preset, pages)
    assert not faults(pages)
