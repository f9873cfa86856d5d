"""`gradcal sweep` as a user calls it."""

import numpy as np
import pytest

from gradcal_jax.cli import main
from gradcal_jax.plots.sweep import draw_sweep
from gradcal_jax.spec import presets
from gradcal_jax.sweeps.sweep import read_dataset

SWEEP = """
format = "gradcal-sweep/1"
title  = "how fast, how long"
base   = "base.toml"
[[axis]]
key    = "plan.gradient"
values = ["1 K/min", "5 K/min"]
[[axis]]
name   = "walk"
key    = "sensor.gyro.angle_random_walk"
start  = "0.05 deg/sqrt(h)"
stop   = "0.2 deg/sqrt(h)"
count  = 3
spacing = "logarithmic"
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    found = tmp_path_factory.mktemp("sweep")
    (found / "base.toml").write_text(presets.text("paper-static-gradient"), encoding="utf-8")
    (found / "sweep.toml").write_text(SWEEP, encoding="utf-8")
    return found


def test_the_answer_says_what_is_least_and_what_failed_and_the_picture_shows_every_curve(folder, capfd, monkeypatch):
    monkeypatch.chdir(folder)
    assert main(["sweep", "sweep.toml", "-o", "results.nc", "--plot", "results.png", "--workers", "1"]) == 1
    printed = capfd.readouterr().out
    assert "6 points; 3 of them failed: " in printed
    assert "exceeds rig.chamber.max_heating" in printed
    # Of a requirement without a target no point counts as met or missed.
    assert "deg/h – gradient 1 K/min, walk 0.05 deg/sqrt(h)" in " ".join(printed.split())
    assert (folder / "results.png").read_bytes().startswith(b"\x89PNG")
    results = read_dataset(folder / "results.nc")
    (axes,) = draw_sweep(results).axes
    assert axes.get_xlabel() == "walk, deg/sqrt(h)"
    assert axes.get_ylabel() == "full range: mean (1σ), deg/h"
    assert axes.get_xscale() == "log"
    assert {"0.05", "0.1", "0.2"} <= {label.get_text() for label in axes.get_xticklabels()}
    slow, fast = axes.get_lines()
    np.testing.assert_allclose(slow.get_ydata(), results["full_range_residual"].sel(gradient=1.0).values)
    assert np.isnan(fast.get_ydata()).all()
    with pytest.raises(ValueError, match="have no variable"):
        draw_sweep(results, "nothing")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["sweep.toml"], "--output"),
        (["none.toml", "-o", "r.nc"], 'does not exist; nearest: "base.toml"'),
        (["sweep.toml", "-o", "nowhere/r.nc"], "there is no directory"),
        (["sweep.toml", "-o", "r.nc", "--workers", "0"], "from 1 to 1024"),
        (["sweep.toml", "-o", "r.nc", "--plot", "r.doc"], "must end in .png, .svg or .pdf"),
    ],
)
def test_wrong_input_is_a_sentence_and_status_2(arguments, said, folder, capsys, monkeypatch):
    monkeypatch.chdir(folder)
    assert main(["sweep", *arguments]) == 2
    assert said in capsys.readouterr().err
    assert not (folder / "r.nc").exists()
