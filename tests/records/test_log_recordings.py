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


def triad(column, unit, **more):
    """`rate.x`, `.y` and `.z` from three neighbouring columns of an array."""
    extra = "".join(f", {key} = {value}" for key, value in more.items())
    return "".join(
        f'rate.{axis} = {{ column = "{column}", index = {number}, unit = "{unit}"{extra} }}\n'
        for number, axis in enumerate("xyz")
    )


XSENS = HEAD + 'time = { column = "t_s", unit = "s" }\n' + triad("gyro_counts", "rad/s", scale=1 / 6258, zero=32768)


@pytest.mark.parametrize("sensor", [("bno", 2000), ("imu", 1000)])
@pytest.mark.parametrize("run", ["rate_nofilt1", "rate_filt2", "steps_yaw"])
def test_two_sensors_on_a_jig(run, sensor):
    (name, full), rows = sensor, 12_000 if run.startswith("rate") else 20_000
    text = f'{HEAD}time = {{ column = "{run}_t", unit = "s" }}\n'
    text += triad(f"{run}_giro_{name}_raw", "deg/s", scale=full / 32768)
    log = import_log(FOLDER / "rimu_jig_rate_and_steps.npz", parse_column_map(text))
    assert log.findings == ()
    assert log.counts() == {"used": rows}
    with np.load(FOLDER / "rimu_jig_rate_and_steps.npz") as source:
        counts = source[f"{run}_giro_{name}_raw"].astype(float)
    np.testing.assert_allclose(log.rate_rad_per_s[0], np.radians(counts * full / 32768), rtol=1e-12)


def test_raw_counts_about_a_middle_and_back_through_netcdf(tmp_path):
    log = import_log(FOLDER / "imu_tk_xsens_mti_multiposition.npz", parse_column_map(XSENS))
    assert log.counts() == {"used": 51_175}
    at_rest = log.rate_rad_per_s[0, :5000]
    assert np.all(np.abs(at_rest.mean(axis=0)) < np.radians(4))
    write_log(log, tmp_path / "log.nc")
    np.testing.assert_array_equal(read_log(tmp_path / "log.nc").rate_rad_per_s, log.rate_rad_per_s)
