"""Guesses of column maps from the headers that programs write, and what follows from them."""

import gzip
from pathlib import Path

import numpy as np
import pytest

from gradcal_jax.records.column_guess import guess
from gradcal_jax.records.importers import import_log, parse_column_map
from gradcal_jax.records.log import LogError
from gradcal_jax.records.log_file import read_log, write_log

PHYPHOX = '"Time (s)","Gyroscope x (rad/s)","Gyroscope y (rad/s)","Gyroscope z (rad/s)"'
EUROC = "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],a_RS_S_x [m s^-2]"
OPENIMU = "time, xAccel (m/s^2), yAccel (m/s^2), zAccel (m/s^2), xRate (deg/s), yRate (deg/s), zRate (deg/s)"
BLACKBOX = "loopIteration, time (us), axisP[0], gyroADC[0], gyroADC[1], gyroADC[2], accSmooth[0]"
XSENS = "// Firmware 4\nPacketCounter\tSampleTimeFine\tAcc_X\tAcc_Y\tAcc_Z\tGyr_X\tGyr_Y\tGyr_Z"
MICROSTRAIN = "Device,6254\nDATA_START\nTime,scaledAccelX,scaledGyroX,scaledGyroY,scaledGyroZ"
HEADERS = {
    "phyphox": ("a.csv", PHYPHOX, {"time": ("Time (s)", "s"), "rate.z": ("Gyroscope z (rad/s)", "rad/s")}),
    "Sensor Logger": ("Gyroscope.csv", "time,seconds_elapsed,z,y,x", {"time": ("seconds_elapsed", "s"),
                      "rate.x": ("x", "rad/s")}),
    "EuRoC": ("data.csv", EUROC, {"time": ("timestamp [ns]", "ns"), "rate.y": ("w_RS_S_y [rad s^-1]", "rad/s"),
              "force.x": ("a_RS_S_x [m s^-2]", "m/s^2")}),
    "OpenIMU": ("a.csv", OPENIMU, {"rate.x": ("xRate (deg/s)", "deg/s"), "force.z": ("zAccel (m/s^2)", "m/s^2")}),
    "blackbox": ("a.csv", BLACKBOX, {"time": ("time (us)", "us"), "rate.y": ("gyroADC[1]", "???"),
                 "force.x": ("accSmooth[0]", "???")}),
    "Xsens": ("a.txt", XSENS, {"time": ("SampleTimeFine", "???"), "rate.z": ("Gyr_Z", "???"),
              "force.x": ("Acc_X", "???")}),
    "SensorConnect": ("a.csv", MICROSTRAIN, {"rate.x": ("scaledGyroX", "???"), "force.x": ("scaledAccelX", "???")}),
}  # fmt: skip


def columns_of(text: str) -> dict[str, tuple[str, str]]:
    """Of a map with its ??? the names and units, by key."""
    import tomllib

    held = tomllib.loads(text)
    found = {key: (held[key]["column"], held[key]["unit"]) for key in ("time", "temperature") if key in held}
    for kind in ("rate", "force"):
        found |= {f"{kind}.{a}": (one["column"], one["unit"]) for a, one in held.get(kind, {}).items()}
    return found


@pytest.mark.parametrize("program", HEADERS)
def test_headers_of_programs_are_known(program: str, tmp_path: Path):
    name, header, expected = HEADERS[program]
    (tmp_path / name).write_text(header + "\n", encoding="utf-8")
    text = guess(tmp_path / name)
    assert text is not None
    assert expected.items() <= columns_of(text).items()
    assert ('delimiter = "tab"' in text) == ("\t" in header)
    (tmp_path / "b.csv.gz").write_bytes(gzip.compress((header + "\n").encode()))
    if program != "Sensor Logger":
        assert guess(tmp_path / "b.csv.gz") == text


def test_a_guess_with_units_reads_the_file(tmp_path: Path):
    rate = np.random.default_rng(1).standard_normal((400, 3)) * 0.01
    rows = [f"{k / 100},{x},{y},{z}" for k, (x, y, z) in enumerate(rate.tolist())]
    path = tmp_path / "a.csv"
    path.write_text("\n".join([PHYPHOX, *rows]), encoding="utf-8")
    text = guess(path)
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


def test_sentences_of_receivers_are_known(tmp_path: Path):
    path = tmp_path / "vn.txt"
    rows = [f"$VNYMR,1,2,3,1,2,3,0.1,0.2,-9.8,{0.001 * k},{0.002 * k},{0.003 * k}*{k % 256:02X}" for k in range(300)]
    path.write_text("\n".join(rows), encoding="utf-8")
    text = guess(path)
    assert text is not None
    log = import_log(path, parse_column_map(text.replace("???", "100 Hz")))
    assert log.rate_rad_per_s[0, 7] == pytest.approx([0.007, 0.014, 0.021])
    assert log.specific_force_m_per_s2 is not None
    assert log.specific_force_m_per_s2[0, 7] == pytest.approx([0.1, 0.2, -9.8])
    path.write_text("%RAWIMUSA,1105,425384.180;1105,425384.1561,00,43,430312,-3033,-26732,-11184,-5181*5aa97065\n")
    text = guess(path)
    assert text is not None
    assert "rate.y = { column = 9" in text
    assert "scale = -???" in text


def test_a_header_that_says_nothing_is_not_guessed(tmp_path: Path):
    (tmp_path / "a.csv").write_text("one,two,three\n1,2,3\n", encoding="utf-8")
    assert guess(tmp_path / "a.csv") is None


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
