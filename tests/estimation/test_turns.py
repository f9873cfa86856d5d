"""Turns by hand: found in the rates by what was said, and the scale factor from them; nonsense is refused."""

import json
from dataclasses import replace

import numpy as np
import pytest
from logs_zoo import GRADIENT, estimated

from gradcal_jax.cli import main
from gradcal_jax.estimation.log_flow import with_turns
from gradcal_jax.records.log import Log, LogError
from gradcal_jax.records.log_file import read_log
from gradcal_jax.spec.spec import parse_spec

SAID = np.radians([360.0, 360.0, -720.0, 90.0])
SPEC = GRADIENT.replace("degree = 1, centre", "degree = 0, centre").replace("degree = 1, scale", "degree = 0, scale")
SCALE, BIAS = 1.004, 0.01


def by_hand(seed=0):
    """Rests of 8 s and uneven turns of 6 s about x of a gyro with 4000 ppm and a bias, at 50 Hz."""
    rng, dt = np.random.default_rng(seed), 0.02
    parts = [np.zeros(400)]
    for angle in SAID:
        shape = np.sin(np.pi * np.arange(300) / 300) ** 2 * (1 + 0.3 * np.sin(np.arange(300) / 20))
        parts += [angle * shape / (shape.sum() * dt), np.zeros(400)]
    true = np.concatenate(parts)
    rate = (
        np.stack([SCALE * true, 0 * true, 0 * true], axis=1) + [BIAS, 0, 0] + 1e-3 * rng.standard_normal((len(true), 3))
    )
    return Log(dt * np.arange(len(true)), rate[None], ("hand",), ("x", "y", "z"), np.full((1, len(true)), 24.0))


def test_turns_are_found_and_give_the_scale_factor():
    log, result = with_turns(by_hand(), list(SAID), axis="x")
    np.testing.assert_allclose([t.sensed_rad for t in result], SCALE * SAID, rtol=2e-3)
    assert log.table_axes == ("x",)
    assert np.isnan(log.table_angle_rad[:, 0]).sum() >= 4 * 200
    (channel,) = estimated(parse_spec(SPEC), log, axis="x")
    names, known = channel.built.model.names(), channel.solution.known
    b00 = channel.built.model.to_reported @ channel.solution.parameters
    std = known.deviations(channel.built.model.to_reported)
    k = names.index("gyro_x.b00")
    assert abs(b00[k] - 0.004) < 4 * std[k]
    assert std[k] < 5e-4
    rate = log.rate_rad_per_s[0, :, 0]
    assert channel.calibration.valid_rate == pytest.approx((rate.min(), rate.max()), abs=0.1)


def test_what_was_recorded_but_not_integrated_is_not_covered():
    """One row of the fastest turn is masked: that turn has no reference, and its rate is not covered."""
    log, result = with_turns(by_hand(), list(SAID), axis="x")
    fastest = result[2]
    status = np.zeros((1, len(log.time_s)), np.uint16)
    status[0, np.searchsorted(log.time_s, fastest.begin_s + 1.0)] = 4
    (channel,) = estimated(parse_spec(SPEC), replace(log, status=status), axis="x")
    rate = log.rate_rad_per_s[0, :, 0]
    assert channel.calibration.valid_rate == pytest.approx((0.0, rate.max()), abs=0.1)


@pytest.mark.parametrize(
    ("said", "words"),
    [
        ([360.0, 360.0, -720.0], "3 turns are listed, but the turns that the sensor measured about x are: 361 deg at"),
        ([360.0, -360.0, -720.0, 90.0], "turn 2 is listed as -360 deg, but the turns"),
        ([36.0, 36.0, -72.0, 9.0], "turn 1 is listed as 36 deg"),
    ],
)
def test_other_turns_than_said_are_listed(said, words):
    with pytest.raises(LogError, match=words):
        with_turns(by_hand(), list(np.radians(said)))


def test_the_commands_from_a_recording_to_a_calibration(tmp_path, capsys):
    log = by_hand(1)
    np.savez(tmp_path / "a.npz", t=log.time_s, w=log.rate_rad_per_s[0], c=log.temperature_c[0])
    columns = 'format = "gradcal-columns/1"\ntime = { column = "t", unit = "s" }\n'
    columns += 'temperature = { column = "c", unit = "degC" }\n'
    columns += "".join(f'rate.{a} = {{ column = "w", index = {k}, unit = "rad/s" }}\n' for k, a in enumerate("xyz"))
    (tmp_path / "a.toml").write_text(columns, encoding="utf-8")
    (tmp_path / "spec.toml").write_text(SPEC, encoding="utf-8")
    out = tmp_path / "turned.nc"
    asked = ["log", "turns", str(tmp_path / "a.npz"), "--columns", str(tmp_path / "a.toml"), "-o", str(out)]
    assert main([*asked, "--turns", "360 deg, 360 deg, -720 deg, 90 deg", "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)["turns"]) == 4
    assert read_log(out).standstill.max() == 4
    assert main(["estimate", str(out), "--spec", str(tmp_path / "spec.toml"), "--axis", "x"]) in (0, 1)
    assert "b00" in capsys.readouterr().out
    assert main([*asked, "--turns", "360", "--force"]) == 2
    assert "--turns" in capsys.readouterr().err


def test_a_scale_factor_that_no_gyro_has_is_refused():
    """The naive attempt: an angle that is not of these turns; 0.67 of a scale factor was written once."""
    log, _ = with_turns(by_hand(), list(SAID))
    wrong = Log(
        log.time_s, log.rate_rad_per_s, log.units, log.axes, log.temperature_c, ("x",), 0.6 * log.table_angle_rad,
        standstill=log.standstill,
    )  # fmt: skip
    with pytest.raises(
        LogError, match=r"hand, gyro x: the output is 1\.67 times the input along its axis: does the column have"
    ):
        estimated(parse_spec(SPEC), wrong, axis="x")
