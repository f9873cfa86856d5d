"""What `gradcal start` writes, for six rigs, from plan to calibration: how often a test of the fit fires on data that
were drawn from the spec. At a level of 1 % it may in 3 % of the runs.

The plans are thinned to a quarter of an hour of the same moves; a fit has some hundred readings.
"""

import os
import shutil
import time
from collections import defaultdict
from pathlib import Path

import pytest
from chain import estimated, recipe_of
from evidence_report import ReportTable, Rows
from test_every_preset import thinned

import gradcal_jax as gj
from gradcal_jax.spec import begin

SEEDS = int(os.environ.get("GRADCAL_SEEDS", "20"))
LEVEL, MOST = 0.01, 0.03
# Answers that differ from those of a preset.
RIGS: dict[str, tuple[str, dict[str, str]]] = {
    "drone IMU": ("drone-gyro", {}),
    "drone IMU, slow table": ("drone-gyro", {"rate": "120 deg/s", "acceleration": "60 deg/s^2", "angle": "0.2 deg"}),
    "drone IMU, quick chamber": ("drone-gyro", {"chamber": "-10 degC, 60 degC, 3 K/min", "travel": "unlimited"}),
    "tactical IMU": ("tactical-gyro", {}),
    "tactical IMU, fine encoder": ("tactical-gyro", {"angle": "3 arcsec", "walk": "0.05 deg/sqrt(h)"}),
    "navigation gyro": ("tactical-gyro", {"grade": "navigation", "walk": "0.005 deg/sqrt(h)", "angle": "1 arcsec"}),
}

_HEAD = """# How often tests of the fit fire on sound data

Made by `pytest -m evidence tests/evidence/test_started_rigs.py`: specs of `gradcal start`, thinned to a quarter of an
hour, run on simulated devices, their logs estimated. A test fires where its chance is below 1 %. Seeds 1 to 20 of each
rig.
"""


def totals(rows: Rows) -> dict[str, tuple[int, int]]:
    """Of each test over all rigs: how often it fired, and in how many runs."""
    found: dict[str, list[int]] = defaultdict(lambda: [0, 0])
    for name, _, fired, runs in rows:
        found[name][0] += int(fired)
        found[name][1] += int(runs)
    return {name: (fired, runs) for name, (fired, runs) in sorted(found.items())}


def _foot(rows: Rows) -> str:
    lines = [f"* {name}: {fired} of {runs}" for name, (fired, runs) in totals(rows).items()]
    return "\n".join([f"Over all rigs ({time.strftime('%Y-%m-%d')}):", "", *lines])


REPORT = ReportTable("tests_of_the_fit", _HEAD, ("test", "rig", "fired", "runs"), 2, _foot)


def recipe_of_rig(rig: str, folder: Path) -> Path:
    """Of the spec that `start` writes for a rig, thinned."""
    preset, answers = RIGS[rig]
    spec = gj.parse_spec(begin.files_of(begin.preset(preset) | answers)["spec.toml"])
    slope = 60.0 * float(spec.plan.gradient)
    shorter = {
        "plan.temperature": ["10 degC", f"{10.0 + 15.0 * slope:g} degC"],
        "plan.soak": "60 s",
        "box": ["12 degC", f"{8.0 + 15.0 * slope:g} degC"],
    }
    gj.write_toml(thinned(spec, shorter), folder / "spec.toml")
    return recipe_of(folder / "spec.toml", folder)


def chances(recipe: Path, folder: Path, seed: int) -> dict[str, float]:
    """The chance of each test of the fit to a run's log, by name."""
    made, _, _ = estimated(recipe, folder / f"run{seed}", seed)
    shutil.rmtree(folder / f"run{seed}")
    return {test["name"].split(": ")[-1]: float(test["chance"]) for test in made["fit"] if test["degrees"] > 0}


@pytest.mark.evidence
@pytest.mark.parametrize("rig", RIGS)
def test_tests_of_the_fit_fire_as_often_as_they_say(rig: str, tmp_path: Path) -> None:
    """Of twenty runs of a rig more than two is beyond chance; over all rigs no test in more than 3 %, or once."""
    recipe = recipe_of_rig(rig, tmp_path)
    fired: dict[str, list[bool]] = defaultdict(list)
    for seed in range(1, SEEDS + 1):
        for name, chance in chances(recipe, tmp_path, seed).items():
            fired[name].append(chance < LEVEL)
    REPORT.put(*([name, rig, str(sum(of)), str(len(of))] for name, of in fired.items()))
    assert max(sum(of) for of in fired.values()) <= 2, fired
    if len({row[1] for row in REPORT.rows()}) == len(RIGS):
        assert all(fired <= max(1, MOST * runs) for fired, runs in totals(REPORT.rows()).values())


@pytest.mark.long
def test_one_run_of_what_start_writes(tmp_path: Path) -> None:
    found = chances(recipe_of_rig("drone IMU", tmp_path), tmp_path, 1)
    assert found.keys() >= {"chi-squared of the fit"}
    assert min(found.values()) > 1e-3, found
