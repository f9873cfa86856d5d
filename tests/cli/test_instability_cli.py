"""`gradcal instability` and `gradcal allan` from outside: a simulated record at rest, its numbers, wrong input."""

import json
import tomllib

import numpy as np
import pytest
from scipy.signal import lfilter

from gradcal_jax import units
from gradcal_jax.cli import main
from gradcal_jax.files.log import Log, write_log

DEG_PER_H = np.pi / 180 / 3600
WALK = 0.01 * np.pi / 180 / 60
SIGMA, TAU = 3.0, 200.0


@pytest.fixture(scope="module")
def record(tmp_path_factory):
    """Six hours at 1 Hz at rest: a drift far above the random walk, a constant bias, a slow ramp of temperature."""
    rng = np.random.default_rng(8)
    count = 6 * 3600
    keep = np.exp(-1 / TAU)
    shocks = rng.standard_normal(count) * SIGMA * DEG_PER_H * np.sqrt(1 - keep**2)
    drift = lfilter([1.0], [1.0, -keep], shocks)
    temperature = np.linspace(20.0, 60.0, count)
    rate = drift + WALK * rng.standard_normal(count) + DEG_PER_H * (100.0 + 2.0 * (temperature - 40.0))
    path = tmp_path_factory.mktemp("record") / "rest.nc"
    log = Log(
        np.arange(count) * 1.0, rate[None, :, None], ("SN-7",), ("x",), temperature_c=temperature[None], simulated=True
    )
    write_log(log, path)
    return path


def printed(capsys, *arguments):
    status = main([str(a) for a in arguments])
    return status, capsys.readouterr()


def test_the_direct_bound_is_a_block_for_the_spec(record, capsys, tmp_path):
    picture = tmp_path / "bound.png"
    status, told = printed(capsys, "instability", record, "--delta", "60s", "--plot", picture)
    assert status == 0
    assert "SIMULATED" in told.out
    assert picture.stat().st_size > 10_000
    block = told.out[told.out.index("[[sensor.drift]]") :].split("wrote")[0]
    (drift,) = tomllib.loads(block)["sensor"]["drift"]
    sigma = units.parse(drift["standard_deviation"], "angular rate") / DEG_PER_H
    tau = units.parse(drift["correlation_time"], "time")
    # The bound is of the largest of many draws against 2.5 standard deviations: above the truth, but not by much.
    assert 0.8 * SIGMA < sigma < 3.0 * SIGMA
    assert 20.0 < tau < 3000.0


def test_json_says_the_same_and_ranges_are_looked_at_one_by_one(record, capsys):
    status, told = printed(
        capsys, "instability", record, "--delta", "60 s", "--longest", "200 s", "--json", "--ranges", "2"
    )
    assert status == 0
    found = json.loads(told.out)
    (channel,) = found["channels"]
    assert found["simulated"] is True
    curve = channel["curve"]
    assert np.all(np.array(curve["largest_drift_deg_per_h"]) <= np.array(curve["limit_deg_per_h"]) * (1 + 1e-9))
    assert [row["temperature_c"] for row in channel["ranges"]] == [[20.0, 40.0], [40.0, 60.0]]
    whole = np.array(channel["curve"]["largest_drift_deg_per_h"])
    for row in channel["ranges"]:
        assert np.all(np.array(row["curve"]["largest_drift_deg_per_h"]) <= whole * (1 + 1e-9))


def test_the_allan_deviation_finds_the_random_walk(record, capsys, tmp_path):
    picture = tmp_path / "allan.svg"
    status, told = printed(capsys, "allan", record, "--json", "--plot", picture, "--terms", "N,K")
    assert status == 0
    assert picture.stat().st_size > 10_000
    (channel,) = json.loads(told.out)["channels"]
    walk = channel["coefficients"]["angle_random_walk_deg_per_sqrt_h"]
    assert abs(walk["value"] - 0.01) < 5 * walk["standard_error"] + 0.0005
    assert channel["coefficients"]["bias_instability_deg_per_h"]["value"] == 0.0
    curve = channel["curve"]
    assert np.all(np.array(curve["lower_deg_per_h"]) < np.array(curve["deviation_deg_per_h"]))


def test_where_no_drift_shows_the_status_says_so(tmp_path, capsys):
    rng = np.random.default_rng(3)
    path = tmp_path / "quiet.nc"
    write_log(Log(np.arange(4000.0), WALK * rng.standard_normal((1, 4000, 1)), ("a",), ("x",)), path)
    status, told = printed(capsys, "instability", path, "--longest", "200 s")
    assert status == 1
    assert "does not show" in told.out
    assert "[[sensor.drift]]" not in told.out


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("instability", "LOG", "--axis", "q"), "no axis 'q'"),
        (("instability", "LOG", "--delta", "10"), "--delta"),
        (("instability", "LOG", "--shortest", "2 s", "--longest", "1 s"), "--shortest"),
        (("instability", "LOG", "--delta", "9 h"), "too short"),
        (("instability", "LOG", "--temperature", "90 degC", "95 degC"), "no usable row lies between"),
        (("instability", "LOG", "--lag", "late"), "--lag"),
        (("allan", "LOG", "--terms", "Z"), "Q, N, B, K"),
        (("allan", "LOG", "--confidence", "2"), "confidence"),
        (("allan", "missing.nc"), "does not exist"),
        (("allan", "table.csv"), "--columns"),
        (("allan", "LOG", "--columns", "map.toml"), "needs no --columns"),
        (("allan", "LOG", "--plot", "picture.docx"), "ends in .png, .svg or .pdf"),
    ],
)
def test_wrong_input_is_a_sentence(record, arguments, sentence, capsys):
    status, told = printed(capsys, *(record if a == "LOG" else a for a in arguments))
    assert status == 2
    assert sentence in told.err
    assert "Traceback" not in told.err
