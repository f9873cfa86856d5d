"""A table of points as an input of its own: equal to weighted least squares, by CSV, netCDF and the command."""

import json

import numpy as np
import pytest
import xarray
from logs_zoo import GRADIENT, STANDARD

from gradcal_jax.cli import main
from gradcal_jax.estimation.log_flow import estimate_points
from gradcal_jax.records.log import LogError
from gradcal_jax.records.points import parse_point_map, read_points
from gradcal_jax.spec.spec import parse_spec
from gradcal_jax.tables.problems import SpecError

MAP = """format = "gradcal-points/1"
name = "SN-7"
temperature    = { column = "T", unit = "degF" }
reference_rate = { column = "table", unit = "deg/s" }
output         = { column = "counts", unit = "deg/s", scale = 0.02, zero = 5 }
sigma          = { column = "s", unit = "deg/s", scale = 0.02 }
"""
SPEC = parse_spec(STANDARD)


def table(count=60, seed=0):
    """(°C, reference, output, σ in deg/s) of points in no order, and the truth (a0, a1, b00, b10, b01, b11)."""
    rng = np.random.default_rng(seed)
    warm, rate = rng.uniform(0, 40, count), rng.choice([-300.0, -120.0, -40.0, 40.0, 120.0, 300.0], count)
    truth = np.array([0.2, -0.05, 3e-3, 1e-3, -2e-3, 5e-4])
    sigma = rng.uniform(0.002, 0.02, count)
    error = design(warm, rate) @ truth + sigma * rng.standard_normal(count)
    return warm, rate, rate + error, sigma, truth


def design(warm, rate):
    t, w = (warm - 20.0) / 20.0, rate / 300.0
    return np.stack([np.ones_like(t), t, rate, w * rate, t * rate, t * w * rate], axis=1)


def written(folder, warm, rate, output, sigma):
    rows = "\n".join(
        f"{float(t) * 1.8 + 32!r},{float(r)!r},{float(o) / 0.02 + 5!r},{float(s) / 0.02!r}"
        for t, r, o, s in zip(warm, rate, output, sigma, strict=True)
    )
    (folder / "points.csv").write_text("T,table,counts,s\n" + rows, encoding="utf-8")
    (folder / "points.toml").write_text(MAP, encoding="utf-8")
    return folder / "points.csv", folder / "points.toml"


def test_points_with_their_sigma_are_weighted_least_squares(tmp_path):
    warm, rate, output, sigma, truth = table()
    points = read_points(*written(tmp_path, warm, rate, output, sigma))
    np.testing.assert_allclose(points.temperature_c, warm, atol=1e-9)
    np.testing.assert_allclose(np.degrees(points.sigma_rad_per_s), sigma, rtol=1e-9)
    report = estimate_points(SPEC, points)
    # The reference's own 50 ppm stand beside the points' σ.
    variance = sigma**2 + (50e-6 * rate) ** 2
    x = design(warm, rate)
    covariance = np.linalg.inv(x.T @ (x / variance[:, None]))
    expected = covariance @ (x.T @ ((output - rate) / variance))
    calibration = report.calibration
    result = np.array([*calibration.values().values()])
    result[:2] = np.degrees(result[:2])
    np.testing.assert_allclose(result, expected, rtol=1e-7, atol=1e-12)
    stds = np.sqrt(np.diag(calibration.covariance.matrix))
    stds[:2] = np.degrees(stds[:2])
    np.testing.assert_allclose(stds, np.sqrt(np.diag(covariance)), rtol=1e-7)
    assert np.all(np.abs(result - truth) < 4 * stds)
    assert report.consistency.fit.passed
    assert calibration.valid_rate[1] == pytest.approx(np.radians(300.0))
    assert report.counts == {"used": 60}


def test_the_command_takes_csv_and_netcdf_alike(tmp_path, capsys):
    warm, rate, output, sigma, _ = table()
    csv, columns = written(tmp_path, warm, rate, output, sigma)
    (tmp_path / "spec.toml").write_text(STANDARD, encoding="utf-8")
    variables = {"T": (warm * 1.8 + 32, "degF"), "table": (rate, "deg/s"), "counts": (output / 0.02 + 5, None)}
    variables["s"] = (sigma / 0.02, None)
    dataset = xarray.Dataset({n: ("point", v, {} if u is None else {"units": u}) for n, (v, u) in variables.items()})
    dataset.to_netcdf(tmp_path / "points.nc", engine="h5netcdf")
    result = []
    for path in (csv, tmp_path / "points.nc"):
        asked = ["estimate", str(path), "--points", str(columns), "--spec", str(tmp_path / "spec.toml")]
        assert main([*asked, "--json", "-o", str(tmp_path / f"{path.suffix[1:]}.toml")]) in (0, 1)
        (channel,) = json.loads(capsys.readouterr().out)["units"]
        result.append([p["value"] for p in channel["parameters"]])
    np.testing.assert_allclose(result[0], result[1], rtol=1e-9)
    assert 'serial_number = "SN-7"' in (tmp_path / "csv.toml").read_text(encoding="utf-8")
    dataset["table"].attrs["units"] = "rad/s"
    dataset.to_netcdf(tmp_path / "wrong.nc", engine="h5netcdf")
    wrong = ["estimate", str(tmp_path / "wrong.nc"), "--points", str(columns), "--spec", str(tmp_path / "spec.toml")]
    assert main(wrong) == 2
    assert "has the unit 'rad/s' by its attribute, and 'deg/s' by the column map" in capsys.readouterr().err
    assert main(["estimate", str(csv), "--points", str(columns)]) == 2
    assert "--points needs the spec" in capsys.readouterr().err


def test_without_sigma_the_specs_noise_counts(tmp_path):
    warm, rate, output, sigma, _ = table()
    csv, _ = written(tmp_path, warm, rate, output, sigma)
    points = read_points(csv, parse_point_map("\n".join(MAP.splitlines()[:-1])))
    channel = estimate_points(SPEC, points)
    assert any("each has independent noise from the spec" in m for m in channel.messages)
    drift = 2 * 5.0**2 * (60 / 60 - 1 + np.exp(-1.0))  # of 5 deg/h with 60 s, averaged over 60 s
    at_rest = np.sqrt(0.5**2 * 3600 / 60 + drift) / 3600
    std = np.sqrt(np.diag(channel.solution.known.covariance(channel.built.model.to_reported)))[0]
    x = design(warm, rate)
    variance = at_rest**2 + (50e-6 * rate) ** 2
    expected = np.sqrt(np.linalg.inv(x.T @ (x / variance[:, None]))[0, 0])
    assert np.degrees(std) == pytest.approx(expected, rel=1e-6)


def test_wrong_points_are_sentences(tmp_path):
    warm, rate, output, sigma, _ = table()
    csv, columns = written(tmp_path, warm, rate, output, sigma)
    text = MAP.replace('"table", unit = "deg/s"', '"table", unit = "rad/s"')
    points = read_points(csv, columns)
    with pytest.raises(LogError, match="have another unit or scale"):
        read_points(csv, parse_point_map(text))
    with pytest.raises(LogError, match=r"no column 'tabel'; .*table"):
        read_points(csv, parse_point_map(MAP.replace('"table"', '"tabel"')))
    with pytest.raises(SpecError, match="unit"):
        parse_point_map(MAP.replace(', unit = "degF"', ""))
    csv.write_text(csv.read_text(encoding="utf-8") + "\n20.0,40.0,nan,0.1", encoding="utf-8")
    with pytest.raises(LogError, match="the output of row 60 is not a number"):
        read_points(csv, columns)
    with pytest.raises(LogError, match="standard method"):
        estimate_points(parse_spec(GRADIENT), points)
