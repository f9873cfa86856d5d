"""`gradcal estimate`, `apply` and `export` of a whole unit, as a user calls them."""

import json

import numpy as np
import pytest
from estimate_scenes import draw_truth, record, scene

from gradcal_jax.cli import main
from gradcal_jax.files.log import read_log, write_log
from gradcal_jax.files.unit_calibration import read_any_calibration
from gradcal_jax.files.writing import write_toml


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A spec, a log of a simulated unit, and the calibration that the command writes."""
    path, spec, rng = tmp_path_factory.mktemp("unit"), scene("two axes", 0.1), np.random.default_rng(4)
    write_toml(spec, path / "spec.toml", header="made by a test")
    write_log(record(spec, draw_truth(spec, rng), rng)[0], path / "log.nc")
    return path


def test_from_a_log_to_a_corrected_log_and_a_header(folder, capsys):
    spec, log, out = (str(folder / name) for name in ("spec.toml", "log.nc", "unit.toml"))
    # What little time leaves of some coefficients is what was known before: said, and status 1.
    status = main(["estimate", log, "--spec", spec, "-o", out, "--plot", str(folder / "fit.png")])
    said = capsys.readouterr().out
    assert status in (0, 1)
    assert "SIMULATED" in said
    assert "gyro scale factor" in said
    assert "error of the table" in said
    assert "µg corrected" in said
    assert (folder / "fit.png").stat().st_size > 20_000
    assert main(["apply", out, log, "-o", str(folder / "true.nc")]) == 0
    capsys.readouterr()
    raw, true = read_log(log), read_log(folder / "true.nc")
    rests = raw.standstill >= 0

    def off(kept):
        mean = [kept.specific_force_m_per_s2[0][raw.standstill == k].mean(axis=0) for k in range(raw.standstill.max())]
        return np.std([np.linalg.norm(f) for f in mean])

    assert rests.any()
    assert off(true) < 0.02 * off(raw)
    assert main(["export", out, "--format", "c-header", "-o", str(folder / "unit.h")]) == 0
    assert "gradcal_correct" in (folder / "unit.h").read_text(encoding="utf-8")


def test_the_page_of_a_calibration(folder, capsys):
    spec, found, page = (str(folder / name) for name in ("spec.toml", "unit.toml", "page.html"))
    assert main(["report", spec, found, "-o", page, "--json"]) == 0
    tables, html = json.loads(capsys.readouterr().out), (folder / "page.html").read_text(encoding="utf-8")
    kept = read_any_calibration(found)
    assert [row["achieved"] for row in tables["requirements"]] == [row.value for row in kept.result]
    assert all(row["predicted"] > 0.0 for row in tables["requirements"])
    row = next(
        row for row in tables["parameters"] if (row["multiplies"], row["name"], row["axis"]) == ("gyro", "a0", "y")
    )
    value = kept.channel_of("gyro", "y").term_of("bias").coefficients["a0"]
    assert row["value"] == pytest.approx(value * 3600.0 * 180.0 / np.pi)
    assert row["std"] > 0.0
    assert row["truth"] is None
    assert len(tables["axes"][0]["fit"]) == len(kept.fit)
    for words in (
        "SIMULATED",
        "error of the table",
        "orthogonality tilt spin",
        "Unit ",
        "--format matrices",
    ):
        assert words in html
    # Residuals, poses, and what was found of four terms.
    assert html.count("<svg") == len(kept.result) + 1 + 4
    assert "gradcal validate" not in html
    assert main(["report", found, "-o", page, "--force"]) == 0
    alone = (folder / "page.html").read_text(encoding="utf-8")
    assert alone.count("<svg") == 4
    assert "Plan of the unit" not in alone
    capsys.readouterr()
    assert main(["report", found, found, "-o", page, "--force"]) == 2
    assert "second unit calibration" in capsys.readouterr().err


def test_all_numbers_as_json(folder, capsys):
    main(["estimate", str(folder / "log.nc"), "--spec", str(folder / "spec.toml"), "--json"])
    (unit,) = json.loads(capsys.readouterr().out)["units"]
    assert len(unit["parameters"]) == 120
    assert {row["name"] for row in unit["table"]} >= {"tilt_east", "orthogonality_tilt_spin", "angle_spin_cos1"}
    assert unit["simulated"]
    assert len(unit["requirements"]) == 8


@pytest.mark.parametrize(
    ("extra", "said"),
    [
        (["--axis", "x"], "--axis: for one gyro axis alone"),
        (["--lag", "fit"], "the lag of a whole unit is not fitted"),
        (["--unit", "nobody"], "no unit 'nobody'"),
    ],
)
def test_what_is_not_for_a_unit_is_a_sentence(folder, capsys, extra, said):
    assert main(["estimate", str(folder / "log.nc"), "--spec", str(folder / "spec.toml"), *extra]) == 2
    assert said in capsys.readouterr().err


def test_a_second_log_is_for_a_second_mounting(folder, capsys):
    log = str(folder / "log.nc")
    assert main(["estimate", log, log, "--spec", str(folder / "spec.toml")]) == 2
    assert "one log for each" in capsys.readouterr().err


def test_validate_says_what_it_takes(folder, capsys):
    assert main(["validate", str(folder / "unit.toml"), str(folder / "log.nc")]) == 2
    assert "of a gyro's axes" in capsys.readouterr().err
