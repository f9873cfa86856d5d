"""Thinned streams and noise files for other programs, against simulated records of white noise."""

import re
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

from gradcal_jax.cli import main
from gradcal_jax.identify.instability import allan_of, at_rest, instability, noise_file, noise_of_imu, of_sensor
from gradcal_jax.records.flight_logs import read_vehicle_log
from gradcal_jax.records.log import Log, LogError
from gradcal_jax.records.log_file import write_log
from gradcal_jax.units import DEG_PER_SQRT_H

sys.path.insert(0, str(Path(__file__).parents[1] / "records"))
from vehicle_samples import sensor_gyro, ulog


def thinned(folder: Path, *, hz: float | None) -> Path:
    """Every 400th sample of 0.17 deg/sqrt(h) at 400 Hz, while the unit warms up."""
    rng, t = np.random.default_rng(5), np.arange(3600.0)
    temperature = 25.0 + 20.0 * (1.0 - np.exp(-t / 900.0))
    rate = np.radians(0.3 + 0.01 * (temperature - 35.0)[:, None] + rng.normal(size=(len(t), 3)) * 0.17 / 60.0 * 20.0)
    stamps = ((t + 1.0) * 1e6).astype(np.int64)
    topics = [("sensor_gyro", 0, sensor_gyro(stamps, rate, temperature, 1310988))]
    if hz is not None:
        kinds = [("timestamp", "<u8"), ("accel_device_id", "<u4"), ("gyro_device_id", "<u4"), ("gyro_rate_hz", "<f4")]
        rows = np.zeros(60, kinds)
        rows["timestamp"], rows["gyro_device_id"], rows["gyro_rate_hz"] = stamps[::60], 1310988, hz
        topics.append(("vehicle_imu_status", 0, rows))
    return ulog(folder / "thinned.ulg", *topics)


def test_every_400th_sample_of_a_raw_channel_is_asked_about(tmp_path, capsys):
    path = thinned(tmp_path, hz=None)
    rest = at_rest(read_vehicle_log(path))
    fit = allan_of(rest)[1]
    assert fit.angle_random_walk.value * DEG_PER_SQRT_H > 3.0
    with pytest.raises(LogError, match=r"means of these samples, or every n-th sample"):
        of_sensor(rest, fit)
    assert main(["noise", str(path)]) == 2
    assert "every n-th sample" in capsys.readouterr().err
    assert main(["noise", str(path), "--axis", "x", "--sensor-rate", "400 Hz"]) in (0, 1)
    assert re.search(r"N angle random walk +0\.1[67]", capsys.readouterr().out)
    assert main(["noise", str(path), "--axis", "x", "--sensor-rate", "means"]) in (0, 1)
    assert re.search(r"N angle random walk +3\.", capsys.readouterr().out)


def test_the_rate_of_the_status_scales_the_angle_random_walk(tmp_path):
    rest = at_rest(read_vehicle_log(thinned(tmp_path, hz=400.0)))
    walk = of_sensor(rest, allan_of(rest)[1]).angle_random_walk
    assert walk.value * DEG_PER_SQRT_H == pytest.approx(0.17, abs=4.0 * walk.standard_error * DEG_PER_SQRT_H)
    assert 'angle_random_walk = "0.1' in instability(rest).drift_block()
    assert any("every 400th sample" in words for words in rest.messages)


@pytest.mark.long
def test_a_calibration_of_rows_far_apart_states_no_noise_but_that_of_the_sensor(tmp_path, capsys):
    for hz, words in ((None, "states no noise"), (400.0, "")):
        folder = tmp_path / str(hz)
        folder.mkdir()
        assert main(["estimate", str(thinned(folder, hz=hz)), "--axis", "x", "-o", str(folder / "c.toml")]) in (0, 1)
        assert words in capsys.readouterr().out
        text = (folder / "c.toml").read_text(encoding="utf-8")
        assert ("[noise]" in text) == (hz is not None)


def imu_at_rest(rows: int = 60_000, hz: float = 100.0) -> Log:
    rng = np.random.default_rng(3)
    rate = np.radians(rng.standard_normal((1, rows, 3)) * 0.005 * np.sqrt(hz))
    force = rng.standard_normal((1, rows, 3)) * 1e-3 * np.sqrt(hz) + np.array([0.0, 0.0, 9.8])
    steps = rng.standard_normal(rows) * 1e-3 / np.sqrt(hz)
    force[0, :, 1] += np.cumsum(steps)  # K = 1e-3 m/s^3/sqrt(Hz)
    return Log(np.arange(rows) / hz, rate, ("A",), tuple("xyz"), specific_force_m_per_s2=force, force_axes=tuple("xyz"))


def test_the_noise_of_an_imu_for_kalibr():
    log = imu_at_rest()
    alone = Log(log.time_s, log.rate_rad_per_s, log.units, log.axes)
    assert "# accelerometer: not in the record" in noise_file(noise_of_imu(alone), 100.0, "a")
    text = noise_file(noise_of_imu(log), 100.0, "imu.csv")
    held = yaml.safe_load(text)
    assert held["gyroscope_noise_density"] == pytest.approx(np.radians(0.005), rel=0.02)
    assert held["accelerometer_noise_density"] == pytest.approx(1e-3, rel=0.02)
    assert held["accelerometer_random_walk"] == pytest.approx(1e-3, rel=0.2)
    assert 0.0 < held["gyroscope_random_walk"] < 1e-5
    assert "an upper limit" in text
    assert "rostopic" in held
    assert " ± " in text


def test_the_noise_file_on_the_command_line(tmp_path):
    write_log(imu_at_rest(20_000), tmp_path / "rest.nc")
    assert main(["noise", str(tmp_path / "rest.nc"), "--output", str(tmp_path / "imu.yaml")]) in (0, 1)
    assert "gyroscope_noise_density" in yaml.safe_load((tmp_path / "imu.yaml").read_text(encoding="utf-8"))
