"""Logs of real flight controllers, from the tests of the libraries that read them: equal to the library's own export.

They are not in this repository. In $GRADCAL_DATA/vehicles are looked for

    sample_log_small.ulg    PX4/pyulog @ 3cf1779, test/ (BSD-3-Clause): a CubeOrange, three gyros at clocks of their own
    test.BIN                ArduPilot/pymavlink @ b4c7ca2, tests/ (LGPL-3.0): ArduPlane 3.8 on a Pixracer, upside down
"""

import csv
import os
from pathlib import Path

import numpy as np
import pytest

from gradcal_jax.records.flight_logs import read_vehicle_log
from gradcal_jax.records.importers import import_log, parse_column_map

DATA = Path(os.environ.get("GRADCAL_DATA", Path(__file__).parents[3] / "shared" / "data")) / "vehicles"
MAP = """format = "gradcal-columns/1"
time = {{ column = "{time}", unit = "us" }}
temperature = {{ column = "{temperature}", unit = "degC" }}
rate.x = {{ column = "x", unit = "rad/s" }}
rate.y = {{ column = "y", unit = "rad/s" }}
rate.z = {{ column = "z", unit = "rad/s" }}
"""


def found(name):
    if not (DATA / name).is_file():
        pytest.skip(f"{name} is not in vehicles/ of the recorded data: set GRADCAL_DATA")
    return DATA / name


@pytest.mark.parametrize(("topic", "unit"), [(0, "2424842"), (1, "3670050"), (2, "2621474")])
def test_a_cube_oranges_ulog_is_what_pyulog_exports(topic, unit, tmp_path):
    from pyulog.ulog2csv import convert_ulog2csv

    path = found("sample_log_small.ulg")
    log = read_vehicle_log(path, unit=unit)
    assert log.units == (unit,)
    assert log.counts() == {"used": 6}
    convert_ulog2csv(str(path), "sensor_gyro", str(tmp_path), ",", None, None)
    text = MAP.format(time="timestamp_sample", temperature="temperature")
    exported = import_log(tmp_path / f"{path.stem}_sensor_gyro_{topic}.csv", parse_column_map(text))
    # What pyulog prints has eight decimals at most.
    np.testing.assert_allclose(log.rate_rad_per_s, exported.rate_rad_per_s, rtol=1e-12, atol=5e-9)
    np.testing.assert_allclose(log.time_s - log.time_s[0], exported.time_s, rtol=0, atol=1e-12)
    np.testing.assert_allclose(log.temperature_c, exported.temperature_c, rtol=1e-7)


@pytest.mark.parametrize(("name", "message", "offsets"), [("IMU0", "IMU", "GYR"), ("IMU1", "IMU2", "GYR2")])
def test_a_pixracers_dataflash_log_is_what_pymavlink_exports(name, message, offsets, tmp_path):
    """Its board stands by Roll 180 (8): y and z change sign. The offsets in force are put back."""
    from pymavlink.DFReader import DFReader_binary

    path = found("test.BIN")
    log = read_vehicle_log(path, unit=name)
    reader, rows, parameters = DFReader_binary(str(path)), [], {}
    while (one := reader.recv_match(type=["PARM", message])) is not None:
        if one.get_type() == "PARM":
            parameters[one.Name] = one.Value
        else:
            rows.append([repr(one.to_dict()[column]) for column in ("TimeUS", "GyrX", "GyrY", "GyrZ", "T")])
    reader.close()
    with (tmp_path / "a.csv").open("w", newline="", encoding="utf-8") as opened:
        csv.writer(opened).writerows([["t", "x", "y", "z", "T"], *rows])
    exported = import_log(tmp_path / "a.csv", parse_column_map(MAP.format(time="t", temperature="T")))
    assert parameters["AHRS_ORIENTATION"] == 8.0
    raw = exported.rate_rad_per_s[0] * [1, -1, -1] + [parameters[f"INS_{offsets}OFFS_{axis}"] for axis in "XYZ"]
    unit = log.units.index(name)
    np.testing.assert_allclose(log.rate_rad_per_s[unit], raw, rtol=1e-12)
    np.testing.assert_allclose(log.time_s - log.time_s[0], exported.time_s, rtol=0, atol=1e-12)
    np.testing.assert_allclose(log.temperature_c[unit], exported.temperature_c[0], rtol=1e-12)
    assert np.abs(raw).max() < 0.3  # it stands on the ground
