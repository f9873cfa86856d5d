"""Logs of vehicles: what is known of each source; refusals."""

import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from vehicle_samples import at_rest, dataflash, imu_rows, sensor_gyro, ulog

from gradcal_jax.records.flight_logs import read_vehicle_log
from gradcal_jax.records.log import LogError

ROWS = 500
RNG = np.random.default_rng(3)
# Few binary digits: what a library prints with eight decimal ones is exact.
RATE = (np.rint(RNG.standard_normal((ROWS, 3)) * 10 + 20) * 2.0**-7).astype(np.float32)
STAMPS_US = 5_000_000 + 1000 * np.arange(ROWS, dtype=np.int64)
TEMPERATURE = (30 + np.arange(ROWS) // 16 / 4).astype(np.float32)


def test_gyros_of_one_ulog_are_named_by_device_id(tmp_path):
    path = ulog(
        tmp_path / "a.ulg",
        ("sensor_gyro", 0, sensor_gyro(STAMPS_US, RATE, TEMPERATURE, 11)),
        ("sensor_gyro", 1, sensor_gyro(STAMPS_US[::2] + 37, 3 * RATE[::2], np.full(ROWS // 2, np.nan), 13)),
    )
    log = read_vehicle_log(path)
    assert log.units == ("11",)
    assert any("13" in finding.message and "--unit" in finding.message for finding in log.findings)
    other = read_vehicle_log(path, unit="13")
    assert other.units == ("13",)
    assert other.temperature_c is None
    np.testing.assert_array_equal(other.rate_rad_per_s[0], 3 * RATE[::2])
    with pytest.raises(LogError, match="no IMU '14' in this log; it has 11, 13"):
        read_vehicle_log(path, unit="14")


def test_sensor_combined_is_refused(tmp_path):
    rows = sensor_gyro(STAMPS_US, RATE, TEMPERATURE, 1)
    with pytest.raises(
        LogError, match="from which calibration and bias are already subtracted: make PX4 log sensor_gyro"
    ):
        read_vehicle_log(ulog(tmp_path / "a.ulg", ("sensor_combined", 0, rows)))


def test_what_ardupilot_took_off_is_put_back(tmp_path):
    """In its own order: offset, scale of accelerometers; then the board, yaw 90 (2), from the sensor's axes. The offset
    of the gyro changes half-way; IMU1 has its own."""
    half = int(STAMPS_US[ROWS // 2])
    parameters = [(0, "AHRS_ORIENTATION", 2.0), (0, "INS_GYROFFS_X", 0.25), (half, "INS_GYROFFS_X", 0.125)]
    offsets, scales = [0.2, -0.1, 0.05], [1.02, 0.99, 1.0]
    for letter, offset, scale in zip("XYZ", offsets, scales, strict=True):
        parameters += [(0, f"INS_ACCOFFS_{letter}", offset), (0, f"INS_ACCSCAL_{letter}", scale)]
    parameters += [(0, "INS_GYR2OFFS_X", 0.5), (0, "INS_TCAL2_ENABLE", 2.0)]

    def on_board(vectors):
        return np.stack([-vectors[:, 1], vectors[:, 0], vectors[:, 2]], axis=1)

    raw, force = RATE.astype(float), at_rest(ROWS)
    offset = np.where(half > STAMPS_US, 0.25, 0.125)
    logged = on_board(raw - np.stack([offset, 0 * offset, 0 * offset], axis=1))
    rows = imu_rows(STAMPS_US, 0, logged, TEMPERATURE, on_board((force - offsets) * scales))
    other = imu_rows(STAMPS_US, 1, on_board(raw - [0.5, 0, 0]), TEMPERATURE)
    path = dataflash(tmp_path / "a.bin", np.concatenate([rows, other]), parameters)
    log = read_vehicle_log(path)
    assert (log.units, log.force_axes) == (("IMU0",), ("x", "y", "z"))
    np.testing.assert_allclose(log.rate_rad_per_s[0], raw, atol=5e-7)  # float32 in the log
    np.testing.assert_allclose(log.specific_force_m_per_s2[0], force, atol=3e-6)
    np.testing.assert_allclose(read_vehicle_log(path, unit="IMU1").rate_rad_per_s[0], raw, atol=5e-7)


LEARNT = [(0, "INS_TCAL1_ENABLE", 2.0), (int(STAMPS_US[ROWS // 2]), "INS_TCAL1_ENABLE", 1.0)]


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({}, "no parameters"),
        ({"INS_TCAL1_ENABLE": 1.0}, "set it to 0 .* and log again"),
        (LEARNT, "set it to 0 .* and log again"),
    ],
)
def test_what_cannot_be_put_back_is_refused(tmp_path, parameters, words):
    path = dataflash(tmp_path / "a.bin", imu_rows(STAMPS_US, 0, RATE, TEMPERATURE), parameters)
    with pytest.raises(LogError, match=words):
        read_vehicle_log(path)


@pytest.mark.parametrize("later_us", [0, 130])
def test_accelerometers_of_a_ulog_are_beside_the_gyro_of_their_device(tmp_path, later_us):
    """At the gyro's stamps, or interpolated to them; an accelerometer of another chip is left out."""
    slope = np.arange(ROWS)[:, None] * np.array([1e-4, -2e-4, 1e-4]) + [0.0, 0.0, 9.8]
    topics = [("sensor_gyro", 0, sensor_gyro(STAMPS_US, RATE, TEMPERATURE, 11))]
    topics += [("sensor_accel", 0, sensor_gyro(STAMPS_US + later_us, slope, TEMPERATURE, 11))]
    log = read_vehicle_log(ulog(tmp_path / "a.ulg", *topics))
    step = float(np.median(np.diff(STAMPS_US)))
    expected = slope - later_us / step * np.array([1e-4, -2e-4, 1e-4])
    np.testing.assert_allclose(log.specific_force_m_per_s2[0][1:], expected[1:], atol=2e-5)
    other = [topics[0], ("sensor_accel", 0, sensor_gyro(STAMPS_US, slope, TEMPERATURE, 12))]
    assert read_vehicle_log(ulog(tmp_path / "b.ulg", *other)).force_axes == ()


@pytest.mark.parametrize(
    ("ending", "missing", "key"),
    [
        ("tlog", "", "HIGHRES_IMU"),
        ("bag", "", "rosbags"),
        ("mcap", "", "rosbags"),
        ("ulg", "pyulog", r'package pyulog, of the extra "logs": pip install "gradcal_jax\[logs\]"'),
        ("bin", "pymavlink", r'package pymavlink, of the extra "logs": pip install "gradcal_jax\[logs\]"'),
    ],
)
def test_files_without_raw_samples_or_reader_are_refused_with_the_remedy(ending, missing, key, tmp_path, monkeypatch):
    for loaded in [name for name in sys.modules if missing and name.split(".")[0] == missing] + [missing]:
        monkeypatch.setitem(sys.modules, loaded, None)
    path = tmp_path / f"a.{ending}"
    path.write_bytes(b"\xfd" * 100)
    with pytest.raises(LogError, match=key):
        read_vehicle_log(path)


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sound")
    ulog(folder / "a.ulg", ("sensor_gyro", 0, sensor_gyro(STAMPS_US[:40], RATE[:40], TEMPERATURE[:40], 3)))
    dataflash(folder / "a.bin", imu_rows(STAMPS_US[:40], 0, RATE[:40], TEMPERATURE[:40]), {"INS_GYROFFS_X": 0.1})
    return {ending: (folder / f"a.{ending}").read_bytes() for ending in ("ulg", "bin")}


@given(
    ending=st.sampled_from(["ulg", "bin"]),
    at=st.integers(0, 10**6),
    value=st.integers(0, 255),
    cut=st.booleans(),
)
@settings(max_examples=150, deadline=None)
def test_damaged_logs_give_a_log_or_a_sentence(tmp_path_factory, sound, ending, at, value, cut):
    content = bytearray(sound[ending])
    at %= len(content)
    content[at] = value
    path = tmp_path_factory.mktemp("damaged") / f"a.{ending}"
    path.write_bytes(bytes(content[:at] if cut else content))
    try:
        log = read_vehicle_log(path)
    except LogError:
        return
    assert sum(log.counts().values()) == log.rows_read
