"""A failed test of the fit counts: no verdict "met" and no status 0; sound data raise none."""

import json
import re
import tomllib
from dataclasses import replace

import numpy as np
import pytest
from logs_zoo import GRADIENT
from simulated_log import simulate_log

import gradcal_jax as gj
from gradcal_jax.cli import main
from gradcal_jax.spec.spec import parse_spec

# What the short plan leaves is far below these.
WIDE = GRADIENT.replace('target = "2000 ppm"', 'target = "9 %"').replace(
    'name = "bias"\nquantity = "gyro_bias"', 'name = "bias"\nquantity = "gyro_bias"\ntarget = "9000 deg/h"'
)


def drifting(log: gj.Log) -> gj.Log:
    """A jump of the scale factor by a per cent in mid-run, which χ² sees."""
    late = log.time_s > np.mean(log.time_s)
    return replace(log, rate_rad_per_s=log.rate_rad_per_s * np.where(late, 1.01, 1.0)[None, :, None])


@pytest.fixture(scope="module")
def sound():
    return simulate_log(parse_spec(WIDE), sample_rate_hz=20.0, seed=11, readings=True).log


def estimated(log: gj.Log, folder, capsys) -> tuple[int, dict, str, dict]:
    """Exit status, JSON, text and calibration of `gradcal estimate`."""
    (folder / "spec.toml").write_text(WIDE, encoding="utf-8")
    gj.write_log(log, folder / "log.nc")
    words = ["estimate", str(folder / "log.nc"), "--spec", str(folder / "spec.toml")]
    capsys.readouterr()
    status = main([*words, "--json"])
    said = json.loads(capsys.readouterr().out)
    assert main([*words, "-o", str(folder / "calibration.toml"), "--force"]) == status
    text = capsys.readouterr().out
    return status, said, text, tomllib.loads((folder / "calibration.toml").read_text(encoding="utf-8"))


def test_sound_data_are_met_and_say_nothing(sound, tmp_path, capsys):
    status, said, text, made = estimated(sound, tmp_path, capsys)
    assert {row["verdict"] for unit in said["units"] for row in unit["requirements"]} == {"met"}
    assert status == 0
    assert "not valid" not in text
    assert "contradicted" not in made


@pytest.mark.long
def test_data_that_contradict_the_model_are_not_valid_anywhere(sound, tmp_path, capsys):
    test = "chi-squared of the fit"
    status, said, text, made = estimated(drifting(sound), tmp_path, capsys)
    assert status == 1
    assert {row["verdict"] for unit in said["units"] for row in unit["requirements"]} == {"not valid"}
    assert re.search(rf"not valid: [^\n]*{test}", text)
    assert test in made["contradicted"]
    assert {row["verdict"] for row in made["result"]} == {"not valid"}
