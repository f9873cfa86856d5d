"""`gradcal instability` and `gradcal allan` from outside: a simulated record at rest, its numbers, wrong input."""

import json
import tomllib

import numpy as np
import pytest
import tomlkit
from scipy.signal import lfilter

from gradcal_jax import units
from gradcal_jax.cli import main
from gradcal_jax.records.log import Log
from gradcal_jax.records.log_file import write_log
from gradcal_jax.spec import presets

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
    block = told.out[told.out.index("[[sensor.gyro.drift]]") :].split("wrote")[0]
    (drift,) = tomllib.loads(block)["sensor"]["gyro"]["drift"]
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
    assert "not visible" in told.out
    assert "[[sensor.drift]]" not in told.out


def noise_log(path, seed, rows=20_000, interval=0.01, factor=1.0, jump=0.0):
    """White noise of 0.1 deg/√h."""
    rate = WALK * 10 / np.sqrt(interval) * np.random.default_rng(seed).standard_normal(rows)
    rate[rows // 2 : rows // 2 + 500] += jump
    write_log(Log(np.arange(rows) * interval, factor * rate[None, :, None], ("a",), ("x",)), path)
    return path


def test_the_deciding_drift_is_dated_and_can_be_left_out(tmp_path, capsys):
    path = noise_log(tmp_path / "jump.nc", 1, jump=300 * DEG_PER_H)
    status, told = printed(capsys, "instability", path, "--longest", "20 s", "--json")
    (channel,) = json.loads(told.out)["channels"]
    assert status == 0
    first, last = channel["deciding_span_s"]
    assert first < 105.0
    assert last > 100.0
    status, told = printed(capsys, "instability", path, "--longest", "20 s")
    assert f'--without "{first:.6g} s..{last:.6g} s"' in told.out
    assert "from the scatter between blocks" in told.out
    status, told = printed(capsys, "instability", path, "--longest", "20 s", "--without", "99.9 s..105.1 s", "--json")
    assert status == 1
    (channel,) = json.loads(told.out)["channels"]
    assert not channel["drift_shows"]
    assert "520 rows from 99.9 s to 105.1 s are left out as requested" in channel["messages"]


def test_a_part_of_a_log_is_what_all_commands_take(tmp_path, capsys):
    path = noise_log(tmp_path / "a.nc", 2)
    status, told = printed(capsys, "allan", path, "--from", "20 s", "--to", "120 s")
    assert status == 0
    assert "100 s at 100 Hz" in told.out
    assert "9999 left out" in told.out
    status, told = printed(capsys, "instability", path, "--rows", "0..5000", "--longest", "10 s")
    assert "49.99 s at 100 Hz" in told.out
    for wrong in (("--rows", "5"), ("--rows", "9..3"), ("--from", "20"), ("--from", "1 h")):
        status, told = printed(capsys, "allan", path, *wrong)
        assert status == 2
        assert wrong[0] in told.err or "fewer than two rows" in told.err
    for command in ("estimate", "validate", "apply", "allan", "instability"):
        printed(capsys, command, "--help")  # shows the options, or exits
        with_help = printed(capsys, command, "--help")[1].out
        assert all(option in with_help for option in ("--from", "--to", "--rows", "--columns"))


@pytest.mark.parametrize("factor", [3 * 57.3, 57.3, 1.7 * 1000**0.5])
def test_noise_that_no_gyro_has_is_status_1_with_a_question(tmp_path, capsys, factor):
    """Rates of 0.3 and 0.1 deg/√h in deg/s stated as rad/s; stamps of 1 kHz in ms stated as s, by their noise."""
    path = noise_log(tmp_path / "a.nc", 3, factor=factor)
    for command in ("allan", "instability"):
        status, told = printed(capsys, command, path, *(("--longest", "20 s") if command == "instability" else ()))
        assert status == 1
        assert "state rad/s for rates in deg/s" in told.out


@pytest.mark.parametrize("factor", [1 / 57.3, 1.7 / 1000**0.5])
def test_noise_of_the_quietest_gyros_alone_is_a_question(tmp_path, capsys, factor):
    """0.1 deg/√h in rad/s stated as deg/s, and 0.17 deg/√h with stamps in s stated as ms."""
    path = noise_log(tmp_path / "a.nc", 3, factor=factor)
    assert "or state deg/s for rates in rad/s, or ms for time stamps in s?" in printed(capsys, "allan", path)[1].out
    assert "?" not in printed(capsys, "allan", noise_log(tmp_path / "b.nc", 3))[1].out


def test_a_bound_on_no_random_walk_is_refused(tmp_path, capsys):
    """A pure rate random walk: its N of nought would make every σ a guess."""
    walk = np.cumsum(np.random.default_rng(5).standard_normal(20_000)) * 1e-6
    rate = (walk[1:] + walk[:-1]) / 2
    path = tmp_path / "k.nc"
    write_log(Log(np.arange(len(rate)) * 0.01, rate[None, :, None], ("a",), ("x",)), path)
    status, told = printed(capsys, "instability", path, "--longest", "20 s", "--bias-degree", "-1")
    assert status == 2
    assert "shows no angle random walk" in told.err
    assert "--random-walk" in told.err
    words = ("--random-walk", "0.001 deg/sqrt(h)")
    assert printed(capsys, "instability", path, "--longest", "20 s", *words)[0] == 0


@pytest.mark.parametrize("size", [1e-9, 1e-5, 1.0, 1e3])
def test_what_instability_writes_is_accepted_by_check(size, tmp_path, capsys):
    """Noise and drift of any size a record may have: the block, its comment taken off, in a preset."""
    rng = np.random.default_rng(7)
    keep = np.exp(-1 / TAU)
    drift = lfilter([1.0], [1.0, -keep], rng.standard_normal(20_000) * np.sqrt(1 - keep**2)) * SIGMA
    rate = size * DEG_PER_H * (drift + 0.5 * rng.standard_normal(20_000))
    path = tmp_path / "a.nc"
    write_log(Log(np.arange(20_000.0), rate[None, :, None], ("a",), ("x",)), path)
    status, told = printed(capsys, "instability", path, "--delta", "60 s")
    assert status in (0, 1)
    block = told.out[told.out.index("# angle_random_walk") :]
    walk = block.splitlines()[0].removeprefix("# ")
    spec = tomllib.loads(presets.text("paper-static-gradient"))
    (drift,) = tomllib.loads(block)["sensor"]["gyro"]["drift"]
    spec["sensor"]["gyro"] |= {**tomllib.loads(walk), "drift": [drift]}
    written = tmp_path / "spec.toml"
    written.write_text(tomlkit.dumps(spec), encoding="utf-8")
    status, told = printed(capsys, "check", written, "--files-only")
    assert status == 0, told


def test_a_recording_without_a_map_gets_a_guess(tmp_path, capsys):
    path = tmp_path / "a.csv"
    path.write_text("time_ms,gx [deg/s],gy [deg/s]\n0,1,2\n", encoding="utf-8")
    status, told = printed(capsys, "allan", path)
    assert status == 2
    assert "gradcal new column-map -o columns.toml" in told.err
    assert 'rate.x = { column = "gx [deg/s]", unit = "deg/s" }' in told.err
    assert printed(capsys, "new", "column-map", "-o", tmp_path / "map.toml")[0] == 0
    status, told = printed(capsys, "allan", path, "--columns", tmp_path / "map.toml")
    assert "no column 't'" in told.err
    assert "column-map" in printed(capsys, "new", "--list")[1].out


def test_text_named_h5_is_told_from_damage(tmp_path, capsys):
    path = tmp_path / "a.h5"
    path.write_text("t,gx\n0,1\n", encoding="utf-8")
    assert "but a text file: name it .csv" in printed(capsys, "allan", path)[1].err


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
        (("allan", "missing.csv"), "missing.csv does not exist"),
        (("allan", "LOG", "--columns", "map.toml"), "needs no --columns"),
        (("allan", "LOG", "--plot", "picture.docx"), "must end in .png, .svg or .pdf"),
    ],
)
def test_wrong_input_is_a_sentence(record, arguments, sentence, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "table.csv").write_text("t,gx\n0,1\n1,2\n", encoding="utf-8")
    status, told = printed(capsys, *(record if a == "LOG" else a for a in arguments))
    assert status == 2
    assert sentence in told.err
    assert "Traceback" not in told.err
