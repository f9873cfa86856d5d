"""`gradcal estimate`, `apply`, `validate`, `export` from outside: a simulated log to a calibration and to firmware."""

import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from simulated_log import simulate_log

from gradcal_jax.calibration import read_calibration
from gradcal_jax.cli import main
from gradcal_jax.records.log_file import read_log, write_log
from gradcal_jax.spec.spec import parse_spec

sys.path.insert(0, str(Path(__file__).parents[1] / "estimate"))
from logs_zoo import GRADIENT


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """A spec, two logs of one unit (the second of other noise), and a log of two units."""
    folder = tmp_path_factory.mktemp("bench")
    (folder / "spec.toml").write_text(GRADIENT, encoding="utf-8")
    spec = parse_spec(GRADIENT)
    first = simulate_log(spec, sample_rate_hz=20.0, seed=21)
    write_log(first.log, folder / "log.nc")
    write_log(simulate_log(spec, sample_rate_hz=20.0, seed=22, truth=first.truth).log, folder / "fresh.nc")
    write_log(simulate_log(spec, sample_rate_hz=20.0, seed=23, units=2).log, folder / "two.nc")
    return folder


def told(capsys, *arguments):
    status = main([str(a) for a in arguments])
    return status, capsys.readouterr()


@pytest.fixture(scope="module")
def calibration(bench):
    path = bench / "cal.toml"
    assert main(["estimate", str(bench / "log.nc"), "--spec", str(bench / "spec.toml"), "-o", str(path)]) in (0, 1)
    return path


def test_an_estimate_says_all_it_knows(bench, capsys, tmp_path):
    out, picture = tmp_path / "cal.toml", tmp_path / "fit.png"
    arguments = ("estimate", bench / "log.nc", "--spec", bench / "spec.toml")
    status, said = told(capsys, *arguments, "-o", out, "--plot", picture)
    assert status == 0
    for words in ("SIMULATED", "b00", "ppm", "chi-squared of the fit", "first against second half", "met", "wrote"):
        assert words in said.out
    assert picture.stat().st_size > 10_000
    found = read_calibration(out)
    assert found.simulated
    assert found.provenance["log"] == "log.nc"
    status, said = told(capsys, *arguments, "--json")
    rows = json.loads(said.out)
    assert rows["simulated"]
    assert rows["as_wished"] == (status == 0)
    (channel,) = rows["units"]
    assert sum(channel["rows"].values()) == read_log(bench / "log.nc").rows_read
    by_name = {p["name"]: p["value"] for p in channel["parameters"]}
    assert by_name["gyro_x.b00"] == pytest.approx(found.values()["gyro_x.b00"], rel=1e-12)
    np.testing.assert_allclose(
        np.sqrt(np.diag(channel["covariance"]["matrix"])), [p["std"] for p in channel["parameters"]], rtol=1e-12
    )


def test_several_units_get_a_file_each(bench, capsys, tmp_path):
    status, said = told(
        capsys, "estimate", bench / "two.nc", "--spec", bench / "spec.toml", "-o", tmp_path / "cal.toml"
    )
    assert status in (0, 1)
    names = sorted(p.name for p in tmp_path.iterdir())
    assert names == ["cal-simulated-1.toml", "cal-simulated-2.toml"]
    assert said.out.count("wrote") == 2


def test_applied_and_validated_on_data_that_were_not_used(bench, calibration, capsys, tmp_path):
    corrected = tmp_path / "corrected.nc"
    status, said = told(capsys, "apply", calibration, bench / "fresh.nc", "-o", corrected)
    assert status in (0, 1)
    assert "wrote" in said.out
    log = read_log(corrected)
    assert log.simulated
    assert log.rows_read == read_log(bench / "fresh.nc").rows_read
    status, said = told(capsys, "validate", calibration, bench / "fresh.nc", "--json")
    assert status == 0
    told_of_it = json.loads(said.out)
    (axis,) = told_of_it["axes"]
    assert {row["name"] for row in told_of_it["requirements"]} <= {r.name for r in read_calibration(calibration).result}
    assert {row["verdict"] for row in told_of_it["requirements"]} == {"met"}
    before, after = axis["scale_factor_ppm"]
    assert after < 0.5 * before
    assert axis["bias_deg_per_h"][1] < axis["bias_deg_per_h"][0]
    assert {cell["unit"] for cell in axis["cells"]} == {"ppm", "deg/h"}
    # The log that made it proves nothing, under whatever name.
    (tmp_path / "renamed.nc").write_bytes((bench / "log.nc").read_bytes())
    status, said = told(capsys, "validate", calibration, tmp_path / "renamed.nc")
    assert status == 2
    assert "the calibration was estimated from this log" in said.err
    status, said = told(capsys, "validate", calibration, bench / "fresh.nc")
    assert "simple acceptance: the mean error within" in said.out
    assert "specific risk" in said.out
    # A target that nothing keeps is missed.
    text = Path(calibration).read_text(encoding="utf-8")
    (tmp_path / "strict.toml").write_text(re.sub(r"(?m)^target = .*", "target = 1e-9", text), encoding="utf-8")
    status, said = told(capsys, "validate", tmp_path / "strict.toml", bench / "fresh.nc")
    assert status == 1
    assert "missed" in said.out
    # A log that was corrected already is worse off after a second correction.
    status, _ = told(capsys, "validate", calibration, corrected)
    assert status == 1


@pytest.mark.parametrize(
    ("target", "words", "lost"),
    [
        ("ardupilot", "INS_TCAL1_GYR1_X", "scale factor"),
        ("px4", "TC_G0_X0_0", "scale factor"),
        ("kalibr", "gyroscopes", "temperature"),
        ("c-header", "void", None),
        ("csv", "b00", None),
    ],
)
def test_every_export_says_what_is_lost(calibration, capsys, tmp_path, target, words, lost):
    out = tmp_path / "out"
    more = ("--temperature", "25 degC") if target == "kalibr" else ()
    status, said = told(capsys, "export", calibration, "--format", target, "-o", out, *more)
    assert status == 0, said.err
    assert words in out.read_text(encoding="utf-8")
    assert "SIMULATED" in said.out
    assert lost is None or lost in said.out
    status, said = told(capsys, "export", calibration, "--format", target, "--json", *more)
    assert json.loads(said.out)["text"] == out.read_text(encoding="utf-8")


def test_wrong_input_is_a_sentence(bench, calibration, capsys, tmp_path):
    spec = bench / "spec.toml"
    (tmp_path / "noise.nc").write_bytes(b"\x89HDF\r\n\x1a\nnothing")
    (tmp_path / "noise.toml").write_bytes(b"\xff\xfe\x00")
    for arguments, words in [
        (("estimate", bench / "none.nc", "--spec", spec), "does not exist"),
        (("estimate", tmp_path / "noise.nc", "--spec", spec), "noise.nc"),
        (("estimate", bench / "log.nc"), "--spec"),
        (("estimate", bench / "log.nc", "--spec", tmp_path / "noise.toml"), "noise.toml"),
        (("estimate", bench / "log.nc", "--spec", spec, "--axis", "roll"), "no axis 'roll'"),
        (("estimate", bench / "log.nc", "--spec", spec, "--unit", "SN-9"), "SN-9"),
        (("estimate", bench / "log.nc", "--spec", spec, "--lag", "5 m"), "--lag"),
        (("estimate", bench / "log.nc", "--spec", spec, "--clock", "host"), "no host time"),
        (("estimate", bench / "log.nc", "--spec", spec, "-o", calibration), "--force"),
        (("apply", tmp_path / "noise.toml", bench / "log.nc", "-o", tmp_path / "a.nc"), "noise.toml"),
        (("apply", calibration, bench / "two.nc", "-o", calibration, "--force", "--unit", "SN-9"), "SN-9"),
        (("validate", calibration, tmp_path / "noise.nc"), "noise.nc"),
        (("export", calibration, "--format", "betaflight"), "known are"),
        (("export", calibration, "--format", "kalibr"), "temperature"),
        (("export", calibration, "--format", "csv", "--zero", "a9"), "a9"),
    ]:
        status, said = told(capsys, *arguments)
        assert status == 2, arguments
        assert words in said.err
        assert "Traceback" not in said.err
