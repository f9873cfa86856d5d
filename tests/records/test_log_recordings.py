"""The importers on real recordings: every row arrives, nothing sound is blamed, and damage done to them is found."""

import os
from pathlib import Path

import numpy as np
import pytest

from gradcal_jax.records.importers import import_log, parse_column_map
from gradcal_jax.records.log_file import read_log, write_log

FOLDER = Path(os.environ.get("GRADCAL_DATA", Path(__file__).parents[3] / "shared" / "data"))
pytestmark = pytest.mark.skipif(not FOLDER.is_dir(), reason="the recorded data are not here: set GRADCAL_DATA")

HEAD = 'format = "gradcal-columns/1"\nsample_rate = "100 Hz"\n'


def triad(column, unit, *, name="", first=0, **more):
    """`rate.x`, `.y` and `.z` from three neighbouring columns of an array, of one sensor among several if named."""
    extra = "".join(f", {key} = {value}" for key, value in more.items())
    head = f'[[sensor]]\nname = "{name}"\n' if name else ""
    return head + "".join(
        f'rate.{axis} = {{ column = "{column}", index = {first + number}, unit = "{unit}"{extra} }}\n'
        for number, axis in enumerate("xyz")
    )


XSENS = HEAD + 'time = { column = "t_s", unit = "s" }\n' + triad("gyro_counts", "rad/s", scale=1 / 6258, zero=32768)


@pytest.mark.parametrize("run", ["rate_nofilt1", "rate_filt2", "steps_yaw"])
def test_two_sensors_on_a_jig(run):
    text = (
        f'{HEAD}time = {{ column = "{run}_t", unit = "s" }}\n'
        + triad(f"{run}_giro_bno_raw", "deg/s", name="bno", scale=2000 / 32768)
        + triad(f"{run}_giro_imu_raw", "deg/s", name="imu", scale=1000 / 32768)
    )
    log = import_log(FOLDER / "rimu_jig_rate_and_steps.npz", parse_column_map(text))
    rows = 12_000 if run.startswith("rate") else 20_000
    assert log.findings == ()
    assert log.counts("bno") == log.counts("imu") == {"used": rows}
    with np.load(FOLDER / "rimu_jig_rate_and_steps.npz") as source:
        counts = source[f"{run}_giro_bno_raw"].astype(float)
    np.testing.assert_allclose(log.rate_rad_per_s[0], np.radians(counts * 2000 / 32768), rtol=1e-12)


def test_raw_counts_about_a_middle_and_back_through_netcdf(tmp_path):
    log = import_log(FOLDER / "imu_tk_xsens_mti_multiposition.npz", parse_column_map(XSENS))
    assert log.counts() == {"used": 51_175}
    at_rest = log.rate_rad_per_s[0, :5000]
    assert np.all(np.abs(at_rest.mean(axis=0)) < np.radians(4))
    write_log(log, tmp_path / "log.nc")
    np.testing.assert_array_equal(read_log(tmp_path / "log.nc").rate_rad_per_s, log.rate_rad_per_s)


def test_damage_done_to_a_recording_is_found_and_counted(tmp_path):
    with np.load(FOLDER / "imu_tk_xsens_mti_multiposition.npz") as source:
        time, counts = source["t_s"], source["gyro_counts"].astype(float)
    kept = np.ones(len(time), bool)
    kept[[*range(2000, 2100), *range(30_000, 30_003)]] = False  # two gaps
    time, counts = time[kept].copy(), counts[kept]
    counts[100:104, 1] = np.nan
    counts[8000:8010, 0] = 65535.0
    time[5000] = time[4999]
    time[6000] = time[10]
    np.savez(tmp_path / "damaged.npz", t_s=time, gyro_counts=counts)
    text = 'full_scale = "5.2 rad/s"\n' + XSENS
    log = import_log(tmp_path / "damaged.npz", parse_column_map(text))
    counted = log.counts()
    assert counted.pop("used") + sum(counted.values()) == log.rows_read == 51_175 - 103
    assert counted["missing rate"] == 4
    assert counted["saturated"] >= 10
    assert counted["duplicate stamp"] == counted["unordered stamp"] == 1
    # A row without a stamp of its own leaves a hole as well: no window may take its neighbours for neighbours.
    assert log.stretch_starts.tolist() == [0, 2000, 5000, 5999, 29_898]
