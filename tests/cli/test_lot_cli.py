"""`gradcal lot` at the command line."""

import json
import tomllib

import numpy as np
import pytest
from lot_scene import calibrations, drawn_maps, read_maps

from gradcal_jax.calibration import write_calibration
from gradcal_jax.cli import main


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    made = {}
    for kind in ("one", "no"):
        folder = made[kind] = tmp_path_factory.mktemp(kind)
        rng = np.random.default_rng(0)
        for k, one in enumerate(calibrations(*read_maps(rng, drawn_maps(rng, 12, kind)))):
            write_calibration(one, folder / f"{k:02d}.toml")
    return made


def words(folder):
    return ["lot", *map(str, sorted(folder.glob("[0-9]*.toml")))]


def test_text_priors_and_figure(folders, tmp_path, capsys):
    priors, plot = tmp_path / "priors.toml", tmp_path / "lot.svg"
    assert main([*words(folders["one"]), "-o", str(priors), "--plot", str(plot)]) == 0
    text = capsys.readouterr().out
    assert text.startswith("lot of 12 IMUs, SIMULATED\n")
    assert "gyro_x bias: one shape repeats and explains 9" in text
    assert text.endswith(f"wrote {plot}\nwrote {priors}\n")
    assert len(tomllib.loads(priors.read_text())["sensor"]["gyro"]["bias"]["shape"]) == 4
    assert "<svg" in plot.read_text()
    assert main([*words(folders["one"]), "-o", str(priors)]) == 2
    assert "overwrite it with --force" in capsys.readouterr().err


def test_json_has_every_number(folders, capsys):
    assert main([*words(folders["one"]), "--json"]) == 0
    tables = json.loads(capsys.readouterr().out)
    (one,) = tables["maps"]
    assert tables["simulated"] is True
    assert one["shapes"] == 1
    assert [test["shapes"] for test in one["tests"]] == [0, 1]
    assert one["prior"] is True
    assert np.shape(one["spread_95"]) == (2, len(one["temperature_c"]))


def test_no_prior_is_written_where_the_shapes_do_not_repeat(folders, tmp_path, capsys):
    priors = tmp_path / "priors.toml"
    assert main([*words(folders["no"]), "-o", str(priors)]) == 1
    printed = capsys.readouterr()
    assert "the shapes do not repeat" in printed.out
    assert f"no priors were written to {priors}: no map has a shape that repeats" in printed.err
    assert not priors.exists()


def test_one_calibration_is_no_lot(folders, capsys):
    assert main(words(folders["one"])[:2]) == 2
    assert "three or more calibrations, not 1" in capsys.readouterr().err
