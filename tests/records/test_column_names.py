"""Guesses of column maps from the headers that programs write, and what follows from them."""

import gzip
from pathlib import Path

import numpy as np
import pytest

from gradcal_jax.records.column_map import RateColumn
from gradcal_jax.records.column_names import contradiction, map_to_fill_in, question_of
from gradcal_jax.records.importers import import_log, parse_column_map
from gradcal_jax.records.log import LogError
from gradcal_jax.records.log_file import read_log, write_log

PHYPHOX = '"Time (s)","Gyroscope x (rad/s)","Gyroscope y (rad/s)","Gyroscope z (rad/s)"'
OPENIMU = "time, xAccel (m/s^2), yAccel (m/s^2), zAccel (m/s^2), xRate (deg/s), yRate (deg/s), zRate (deg/s)"
HEADERS = {
    "brackets": (PHYPHOX, {"time": ("Time (s)", "s"), "rate.z": ("Gyroscope z (rad/s)", "rad/s")}),
    "axis first": (OPENIMU, {"rate.x": ("xRate (deg/s)", "deg/s"), "force.z": ("zAccel (m/s^2)", "m/s^2")}),
    "no units": ("Time\tAcc_X\tGyr_X", {"time": ("Time", "???"), "rate.x": ("Gyr_X", "???")}),
    "joined": ("TimeUS,gyro_x_rads,temp_C", {"time": ("TimeUS", "us"), "rate.x": ("gyro_x_rads", "rad/s"),
               "temperature": ("temp_C", "degC")}),
}  # fmt: skip


def columns_of(text: str) -> dict[str, tuple[str, str]]:
    """Of a map with its ??? the names and units, by key."""
    import tomllib

    held = tomllib.loads(text)
    found = {key: (held[key]["column"], held[key]["unit"]) for key in ("time", "temperature") if key in held}
    for kind in ("rate", "force"):
        found |= {f"{kind}.{a}": (one["column"], one["unit"]) for a, one in held.get(kind, {}).items()}
    return found


@pytest.mark.parametrize("kind", HEADERS)
def test_a_map_is_made_from_a_header(kind: str, tmp_path: Path):
    header, expected = HEADERS[kind]
    (tmp_path / "a.csv").write_text(header + "\n", encoding="utf-8")
    text = map_to_fill_in(tmp_path / "a.csv")
    assert text is not None
    assert expected.items() <= columns_of(text).items()
    assert ('delimiter = "tab"' in text) == ("\t" in header)
    (tmp_path / "b.csv.gz").write_bytes(gzip.compress((header + "\n").encode()))
    assert map_to_fill_in(tmp_path / "b.csv.gz") == text


@pytest.mark.parametrize(
    ("name", "unit", "says"),
    [
        ("temp_F", "degC", "F"),
        ("tempF", "degC", "F"),
        ("temp_K", "degC", "K"),
        ("gyro_x_rads", "deg/s", "rads"),
        ("gx_deg_h", "deg/s", "deg_h"),
        ("gyroXDps", "rad/s", "Dps"),
        ("mdps_x", "deg/s", "mdps"),
        ("TimeUS", "ms", "US"),
        ("acc_x_mg", "g", "mg"),
    ],
)
def test_a_unit_joined_to_a_name_that_contradicts_the_map_is_a_question(name: str, unit: str, says: str):
    question = contradiction(name, unit)
    assert question is not None
    assert f"states the unit {says}, and the column map states {unit}" in question


@pytest.mark.parametrize(
    "name", ["g_x", "w_s", "rate_C", "gyro_s", "t_x", "acc_f", "gyroADC[0]", "x_g", "SampleTimeFine"]
)
def test_letters_that_are_no_unit_of_the_quantity_say_nothing(name: str):
    assert contradiction(name, "mdeg/s") is None


UNITS = {
    "angular rate": ["rads", "dps", "mdps", "degs", "deg/s", "rad/s", "deg/h"],
    "acceleration": ["mg", "m/s2", "ms2", "mps2"],
    "temperature": ["C", "F", "degC", "degF", "K"],
    "time": ["s", "ms", "us", "ns", "sec"],
}
NAMES = {
    "angular rate": ["gyro_x", "gx", "omega_x", "gyroX", "rate_x", "angular_velocity_x"],
    "acceleration": ["acc_x", "ax", "accel_x", "accX"],
    "temperature": ["temp", "temperature", "imu_temp"],
    "time": ["time", "t", "timestamp"],
}
STATED = {
    "angular rate": ["rad/s", "deg/s", "mdeg/s", "deg/h"],
    "acceleration": ["g", "mg", "m/s^2"],
    "temperature": ["degC", "degF"],
    "time": ["s", "ms", "us", "ns"],
}
SAME = {
    "rads": "rad/s", "dps": "deg/s", "degs": "deg/s", "mdps": "mdeg/s", "m/s2": "m/s^2", "ms2": "m/s^2",
    "mps2": "m/s^2", "C": "degC", "F": "degF", "sec": "s",
}  # fmt: skip


@pytest.mark.parametrize("dimension", UNITS)
def test_units_in_names_of_any_joint_ask_where_they_contradict_and_only_there(dimension: str):
    for name in NAMES[dimension]:
        for written in UNITS[dimension]:
            joined = [f"{name}_{written}", f"{name} ({written})", f"{name} [{written}]", f"{name}.{written}"]
            if len(written) > 1 and "/" not in written:
                joined.append(f"{written}_{name}")
            for one in joined:
                for stated in STATED[dimension]:
                    agrees = SAME.get(written, written) == stated
                    assert (contradiction(one, stated) is None) == agrees, (one, stated)


@pytest.mark.parametrize(
    "start", ["dtheta", "delta_theta", "delta angle", "dAngle", "delta_v", "dvel", "deltaVelocity"]
)
@pytest.mark.parametrize("axis", ["_x", "X", " y", "[2]", "_0"])
def test_names_of_increments_ask(start: str, axis: str):
    column = RateColumn(column="a", unit="mdeg/s")
    question = question_of(start + axis, column)
    assert question is not None
    assert 'per = "row"' in question
    assert question_of(start + axis, RateColumn(column="a", unit="mdeg", per="row")) is None


def test_a_guess_with_units_reads_the_file(tmp_path: Path):
    rate = np.random.default_rng(1).standard_normal((400, 3)) * 0.01
    rows = [f"{k / 100},{x},{y},{z}" for k, (x, y, z) in enumerate(rate.tolist())]
    path = tmp_path / "a.csv"
    path.write_text("\n".join([PHYPHOX, *rows]), encoding="utf-8")
    text = map_to_fill_in(path)
    assert text is not None
    assert import_log(path, parse_column_map(text)).rate_rad_per_s[0] == pytest.approx(rate)


def test_a_log_that_is_read_is_logged_with_its_faults(tmp_path: Path, caplog):
    path = tmp_path / "a.csv"
    path.write_text("t,x\n" + "".join(f"{k / 100},0.1\n" for k in range(400) if not 100 < k < 200), encoding="utf-8")
    columns = """
        format = "gradcal-columns/1"
        time = { column = "t", unit = "s" }
        [rate]
        x = { column = "x", unit = "deg/s" }
    """
    with caplog.at_level("INFO", "gradcal_jax"):
        log = import_log(path, parse_column_map(columns))
        write_log(log, tmp_path / "log.nc")
        read_log(tmp_path / "log.nc")
    said = [(record.levelname, record.getMessage()) for record in caplog.records]
    rows = len(log.time_s)
    assert said[0] == ("INFO", f"read {path}: {rows} rows, {log.duration_s:.6g} s")
    assert said[1:-1] == [("WARNING", f"{path}: {fault.message}") for fault in log.findings]
    assert log.findings
    assert said[-1] == ("INFO", f"read {tmp_path / 'log.nc'}: {rows} rows, {log.duration_s:.6g} s")


def test_a_header_that_says_nothing_is_not_guessed(tmp_path: Path):
    (tmp_path / "a.csv").write_text("one,two,three\n1,2,3\n", encoding="utf-8")
    assert map_to_fill_in(tmp_path / "a.csv") is None


def test_of_sensors_that_are_not_there_the_values_are_shown(tmp_path: Path):
    text = 'format = "gradcal-columns/1"\nsample_rate = "100 Hz"\nrate.x = { column = "gx", unit = "deg/s" }\n'
    (tmp_path / "a.csv").write_text("id,gx\n" + "1,0.1\n2,0.2\n" * 300, encoding="utf-8")
    np.savez(tmp_path / "a.npz", id=np.tile([1, 2], 300), gx=np.tile([0.1, 0.2], 300))
    for name in ("a.csv", "a.npz"):
        with pytest.raises(LogError, match=r"where: no row has 3 .*include 1, 2"):
            import_log(tmp_path / name, parse_column_map(text + 'where = { column = "id", equals = 3 }\n'))
        log = import_log(tmp_path / name, parse_column_map(text + 'where = { column = "id", equals = 2 }\n'))
        assert np.degrees(log.rate_rad_per_s).ravel() == pytest.approx(np.full(300, 0.2))


def test_a_gzip_that_is_cut_off_is_no_traceback(tmp_path: Path):
    text = 'format = "gradcal-columns/1"\nsample_rate = "100 Hz"\nrate.x = { column = "gx", unit = "deg/s" }\n'
    whole = gzip.compress(("gx\n" + "\n".join(f"{k * 0.37 % 1:.6f}" for k in range(5000))).encode())
    path = tmp_path / "a.csv.gz"
    for content in (whole[: len(whole) // 2], b"no gzip at all"):
        path.write_bytes(content)
        with pytest.raises(LogError, match="gzip"):
            import_log(path, parse_column_map(text))
