"""Thinned streams and noise files for other programs, against simulated records of white noise."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from gradcal_jax.cli import main
from gradcal_jax.identify.instability import allan_of, at_rest, instability, of_sensor
from gradcal_jax.records.flight_logs import read_vehicle_log
from gradcal_jax.records.log import LogError
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
    for means, walk in (("400 Hz", 0.17), ("means", 3.4)):
        assert main(["noise", str(path), "--axis", "x", "--sensor-rate", means, "--json"]) in (0, 1)
        (channel,) = json.loads(capsys.readouterr().out)["channels"]
        of = channel["allan"]["coefficients"]["angle_random_walk_deg_per_sqrt_h"]
        assert of["value"] == pytest.approx(walk, abs=4.0 * of["standard_error"])


def test_the_rate_of_the_status_scales_the_angle_random_walk(tmp_path):
    rest = at_rest(read_vehicle_log(thinned(tmp_path, hz=400.0)))
    walk = of_sensor(rest, allan_of(rest)[1]).angle_random_walk
    assert walk.value * DEG_PER_SQRT_H == pytest.approx(0.17, abs=4.0 * walk.standard_error * DEG_PER_SQRT_H)
    assert 'angle_random_walk = "0.1' in instability(rest).drift_block()
    assert any("every 400th sample" in words for words in rest.messages)
