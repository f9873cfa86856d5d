"""`gradcal estimate`, `apply` and `export` of a whole unit, as a user calls them."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from estimate_scenes import draw_truth, record, scene

from gradcal_jax.calibration import read_calibration
from gradcal_jax.calibration.correction import term_values
from gradcal_jax.cli import main
from gradcal_jax.records.log_file import read_log, write_log
from gradcal_jax.spec.changes import tables_of
from gradcal_jax.spec.rig import TEMPLATE
from gradcal_jax.spec.spec import read_spec, spec_of
from gradcal_jax.tables.writing import write_toml

LABORATORY = """
[laboratory]
name = "Laboratory"
country = "DE"
"""


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
    assert "µg rms after the correction" in said
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
    kept = read_calibration(found)
    assert [row["achieved"] for row in tables["requirements"]] == [row.value for row in kept.result]
    assert all(row["predicted"] > 0.0 for row in tables["requirements"])
    row = next(row for row in tables["parameters"] if (row["kind"], row["name"], row["axis"]) == ("gyro", "a0", "y"))
    value = kept.channel_of("gyro", "y").term_of("bias").coefficients["a0"]
    assert row["value"] == pytest.approx(value * 3600.0 * 180.0 / np.pi)
    assert row["std"] > 0.0
    assert row["truth"] is None
    assert len(tables["fit"]) == len(kept.fit)
    for words in (
        "SIMULATED",
        "error of the table",
        "orthogonality tilt spin",
        "Gyro x",
        "--format matrices",
    ):
        assert words in html
    # Of every gyro's scale factor three maps and their curves, of all else a picture as predicted and one as achieved;
    # poses, scale factors of three gyros over rate, and three terms over temperature.
    assert html.count("<svg") == 3 * 4 + 2 * (len(kept.result) - 1) + 1 + 3 + 3
    assert "gradcal validate" in html
    assert main(["report", found, "-o", page, "--force"]) == 0
    alone = (folder / "page.html").read_text(encoding="utf-8")
    # Standard deviations of three gyros over temperature and rate, and of three terms over temperature; and the terms.
    assert alone.count("<svg") == 3 * 2 + 3 + 3 + 3
    assert 'id="plan"' not in alone
    capsys.readouterr()
    assert main(["report", found, found, "-o", page, "--force"]) == 2
    assert "second calibration" in capsys.readouterr().err


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
        (["--axis", "x"], "a single gyro, along the only axis of the table"),
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


def test_another_log_validates_gyros_and_accelerometers_together(folder, capsys):
    assert main(["validate", str(folder / "unit.toml"), str(folder / "log.nc")]) == 2
    assert "was estimated from this log" in capsys.readouterr().err
    spec, rng = read_spec(folder / "spec.toml"), np.random.default_rng(4)
    again = record(spec, draw_truth(spec, rng), np.random.default_rng(5))[0]
    write_log(again, folder / "again.nc")
    command = ["validate", str(folder / "unit.toml"), str(folder / "again.nc"), "--gravity", "9.80665 m/s^2"]
    status = main([*command, "--json"])
    gyros, forces = json.loads(capsys.readouterr().out)["axes"]
    assert (gyros["axis"], forces["axis"]) == ("gyros", "accelerometers")
    for before, after in (gyros["scale_factor_ppm"], gyros["bias_deg_per_h"], forces["gravity_ug"]):
        assert after < 0.2 * before, (gyros, forces)
    assert gyros["moves"] > 20
    assert status == main(command) == 0
    assert "norm of gravity at rest" in capsys.readouterr().out


def test_a_certificate_and_a_dcc_of_an_imu(folder, capsys):
    (folder / "rig.toml").write_text(TEMPLATE + LABORATORY, encoding="utf-8")
    page, xml = folder / "certificate.html", folder / "dcc.xml"
    command = ["report", str(folder / "unit.toml"), "--certificate", "--rig", str(folder / "rig.toml"), "--json"]
    command += ["--number", "K-1", "--performed", "2026-11-22", "-o", str(page), "--dcc", str(xml)]
    assert main(command) == 0
    tables, kept = json.loads(capsys.readouterr().out), read_calibration(folder / "unit.toml")
    rows = {(row["channel"], row["term"]): row for row in tables["corrections"]}
    assert {channel for channel, _ in rows} == {channel.label for channel in kept.channel}
    force = rows["accelerometer z", "bias"]
    term = kept.channel_of("accelerometer", "z").term_of("bias")
    expected = term_values(term, np.array(force["temperature_c"])) / 9.80665e-6
    assert force["unit"] == "ug"
    np.testing.assert_allclose(force["value"], expected, rtol=1e-9)
    assert min(force["expanded"]) > 0.0
    assert len(tables["fit"]) == len(kept.fit)
    text = xml.read_text(encoding="utf-8")
    assert "Corrections of accelerometer z over temperature" in text
    assert r"\metre\second\tothe{-2}" in text
    assert "accelerometer z" in page.read_text(encoding="utf-8")


def test_coefficients_that_did_not_pass_are_left_out_of_an_export(folder, capsys):
    kept, table = read_calibration(folder / "unit.toml"), folder / "unit.csv"
    for given, gone in (
        ("a3", {channel.name for channel in kept.channel}),
        ("x.a3", {"gyro_x", "accelerometer_x"}),
        ("gyro_y.a3", {"gyro_y"}),
    ):
        command = ["export", str(folder / "unit.toml"), "--format", "csv", "--zero", given, "-o", str(table), "--force"]
        assert main(command) == 0
        (said,) = [line for line in capsys.readouterr().out.splitlines() if "set to zero" in line]
        assert set(said.split(": ")[-1].split(", ")) == {f"{name}.a3" for name in gone}
        zeroed = table.read_text(encoding="utf-8")
        assert main(["export", str(folder / "unit.toml"), "--format", "csv", "-o", str(table), "--force"]) == 0
        assert table.read_text(encoding="utf-8") != zeroed
        capsys.readouterr()
    assert main(["export", str(folder / "unit.toml"), "--format", "csv", "--zero", "q9"]) == 2
    assert "no coefficient q9" in capsys.readouterr().err


def chi_squared_of(said: str) -> tuple[float, float]:
    """χ² of an estimate that was printed, and its degrees of freedom."""
    ((chi_squared, degrees),) = re.findall(r"chi-squared of the fit +([0-9.]+) +([0-9]+)", said)
    return float(chi_squared), float(degrees)


@pytest.mark.long
def test_the_lag_of_a_whole_imu_is_fitted(tmp_path, capsys):
    document, lag_s, rng = tables_of(scene("two axes", 0.1)), 40.0, np.random.default_rng(4)
    for key in ("temperature", "gradient"):
        del document["plan"][key]
    document["plan"]["programme"] = [
        {"soak": "1 min", "at": "-30 degC"},
        *({"ramp_to": f"{end} degC", "rate": "12.5 K/min"} for end in (70, -30)),
    ]
    spec = spec_of(document)
    (log,) = record(spec, draw_truth(spec, rng), rng)
    # The thermometer leads: the maps followed the log's temperature, and were at the thermometer's when it began.
    true = log.temperature_c[0]
    ahead = true + lag_s * np.gradient(true, log.time_s)
    ahead[0] = true[0]
    write_toml(spec, tmp_path / "spec.toml", header="made by a test")
    write_log(replace(log, temperature_c=ahead[None]), tmp_path / "log.nc")
    out = tmp_path / "unit.toml"
    command = ["estimate", str(tmp_path / "log.nc"), "--spec", str(tmp_path / "spec.toml"), "-o", str(out)]
    assert main([*command, "--lag", "fit"]) in (0, 1)
    said = capsys.readouterr().out
    assert "the maps lag behind the measured temperature" in said
    # (Nothing smooths a thermometer that leads, but the estimate: the temperature jumps where the ramp begins and where
    # it turns. The fit does not hold there, and the lag is as uncertain as that.)
    ((lag, std_s),) = [map(float, found) for found in re.findall(r"by ([0-9.]+) s \(1σ ([0-9.]+) s\)", said)]
    chi_squared, degrees = chi_squared_of(said)
    assert chi_squared > 3.0 * degrees
    around = []
    for given in (lag - 0.5, lag + 0.5):
        assert main([*command, "--lag", f"{given} s", "--force"]) in (0, 1)
        around.append(chi_squared_of(capsys.readouterr().out)[0])
    bend = (sum(around) - 2.0 * chi_squared) / (2.0 * 0.5**2)
    assert std_s == pytest.approx((chi_squared / degrees / bend) ** 0.5, rel=0.1)
    assert main([*command, "--lag", "fit", "--force"]) in (0, 1)
    lags = [float(channel.thermal_lag) for channel in read_calibration(out).channel]
    assert len(lags) == 6
    assert lags == pytest.approx([lag_s] * 6, abs=2.0 * std_s)
