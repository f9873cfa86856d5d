"""Units that print text, described in the rig file in some ten lines: from `rig check` to a log."""

import itertools
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hardware_bench import Rig, sensor_on_table, short_recipe
from hypothesis import given, settings
from hypothesis import strategies as st
from journal_log import angles_of_rests
from simulated_devices.line_chambers import SimulatedCts, SimulatedThermotron
from simulated_devices.line_tables import SimulatedAerosmith, SimulatedGrbl
from simulated_devices.text_unit import SimulatedTextUnit, TextUnitOptions
from simulated_devices.wire import Wire

from gradcal_jax.hardware.checksums import xor8
from gradcal_jax.hardware.clock import RealClock, VirtualClock
from gradcal_jax.hardware.drivers.listening import TextUnitConfig
from gradcal_jax.hardware.execute import run_session
from gradcal_jax.hardware.roles import ImuBatch, join
from gradcal_jax.hardware.run_folder import new_folder
from gradcal_jax.hardware.setup import check_each, configs_of
from gradcal_jax.hardware.text_unit import TextUnitDecoder
from gradcal_jax.records.run_log import log as log_of_run
from gradcal_jax.spec.rig import RigFile, rig_of
from gradcal_jax.tables.problems import SpecError

BOARD: dict[str, Any] = {
    "format": "gradcal-text/1",
    "title": "the board",
    "line": "$IMU,{gyro_x},{gyro_y},{gyro_z},{acceleration_x},{acceleration_y},{acceleration_z},{temperature},{time}",
    "rate": "100 Hz",
    "time": {"unit": "us", "modulus": 2**32},
    "checksum": "xor8",
    "timeout": "2 s",
}
COUNTED = BOARD | {"line": "{gyro_z} {count}", "checksum": "none", "counter": 256}
COUNTED.pop("time")
PLAIN = {key: value for key, value in COUNTED.items() if key != "counter"} | {
    "line": "{:text};{gyro_z}",
    "gyro": "rad/s",
}


def decoder(protocol: dict[str, Any]) -> TextUnitDecoder:
    return TextUnitConfig(protocol=protocol).decoder()


def printed(number: int, gyro: float = 1.5) -> bytes:
    body = f"IMU,{gyro:.3f},-0.25,3,0,0,9.80665,25.5,{10_000 * number % 2**32}".encode()
    return b"$" + body + b"*%02X\r\n" % xor8(body)


def pushed(unit: TextUnitDecoder, data: bytes, at_s: float = 0.0) -> ImuBatch:
    return unit.push(data, at_s)


# ------------------------------------------------------------------------------------------------------------ lines


def test_numbers_come_out_in_the_units_of_this_program() -> None:
    batch = pushed(decoder(BOARD), b"ready\r\n" + printed(7) + printed(8))
    assert batch.gyro_dps[1].tolist() == [1.5, -0.25, 3.0]
    assert batch.acceleration_g[1] == pytest.approx([0.0, 0.0, 1.0])
    assert batch.temperature_c[1].tolist() == [25.5] * 3
    assert np.diff(batch.device_time_s) == pytest.approx([0.01])
    rad = pushed(decoder(PLAIN), b"any; 1.0\n")
    assert rad.gyro_dps[0, 2] == pytest.approx(57.29578)
    assert np.isnan(rad.gyro_dps[0, :2]).all()


def test_lost_lines_are_counted_by_time_and_by_counter() -> None:
    timed = pushed(decoder(BOARD), b"".join(printed(k) for k in range(1000) if k not in (400, 401, 402)))
    assert timed.gap_before.sum() == 3
    assert timed.gap_before[400] == 3
    lines = [f"0.5 {k % 256}\n".encode() for k in range(1000) if k not in (400, 401, 402)]
    counted = pushed(decoder(COUNTED), b"".join(lines))
    assert (counted.gap_before.sum(), counted.gap_before[400]) == (3, 3)
    assert decoder(COUNTED).round_samples == 256


def test_a_time_that_wraps_goes_on_and_one_that_goes_back_is_a_restart() -> None:
    wraps = 2**32 // 10_000
    unit = decoder(BOARD)
    times = pushed(unit, b"".join(printed(k) for k in range(wraps - 3, wraps + 4)))
    assert not times.restarted.any()
    assert np.diff(times.device_time_s) == pytest.approx(0.01, abs=2e-6)
    again = pushed(unit, printed(0) + printed(1))
    assert again.restarted.tolist() == [True, False]
    assert again.gap_before.tolist() == [0, 0]


@given(st.binary(max_size=30), st.lists(st.integers(0, 400), max_size=6))
@settings(max_examples=50, deadline=None)
def test_samples_do_not_depend_on_how_the_stream_was_cut(noise: bytes, cuts: list[int]) -> None:
    data = noise.replace(b"$", b"?") + b"\n" + b"".join(printed(k) for k in range(6))
    whole, unit = pushed(decoder(BOARD), data), decoder(BOARD)
    places = sorted({0, len(data), *(min(cut, len(data)) for cut in cuts)})
    parts = join([unit.push(data[begin:end], 0.0) for begin, end in itertools.pairwise(places)])
    assert len(whole) == len(parts) == 6
    np.testing.assert_array_equal(whole.device_time_s, parts.device_time_s)


def test_no_bit_of_a_line_may_be_wrong_where_it_has_a_check_sum() -> None:
    line = printed(7)
    for place, bit in itertools.product(range(len(line) - 2), range(8)):
        bad = line[:place] + bytes([line[place] ^ 1 << bit]) + line[place + 1 :]
        # Case of the check's letters alone is no error.
        assert len(pushed(decoder(BOARD), bad)) == 0 or bad.upper() == line.upper()


def test_a_doubled_line_counts_once() -> None:
    unit = decoder(COUNTED)
    batch = pushed(unit, b"0.5 7\n0.5 7\n0.5 8\n")
    assert (len(batch), batch.gap_before.sum(), unit.repeated_datagrams) == (2, 0, 1)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"line": "$IMU,{gx},{gyro_y}"}, "{gx} is not the name of a field"),
        ({"line": "{gyro_x}{gyro_y}"}, "with a character between two fields"),
        ({"line": "{temperature}"}, "expected at least one field of a rate or an acceleration"),
        ({"line": "{gyro_x},{count}"}, "the value at which the count restarts at 0"),
        ({"gyro": "deg"}, "gyro"),
        ({"rate": "100"}, "rate"),
        ({"lines": "x"}, 'nearest: "line"'),
    ],
)
def test_a_description_that_cannot_be_right_is_refused(change: dict[str, Any], words: str) -> None:
    imu = {"name": "a", "driver": "text_unit", "port": "COM1", "options": {"protocol": BOARD | change}}
    with pytest.raises(SpecError, match=re.escape(words)):
        configs_of(rig_of({"format": "gradcal-rig/1", "imu": [imu]}))


# -------------------------------------------------------------------------------------------------------- on a rig


def with_board(rig: RigFile, url: str, **change: Any) -> RigFile:
    tables = rig.model_dump(mode="json", exclude_unset=True)
    tables["imu"] = [{"name": "unit1", "driver": "text_unit", "port": url, "options": {"protocol": BOARD | change}}]
    tables["axis"][0]["options"]["max_acceleration"] = "2000 deg/s^2"
    return rig_of(tables)


def board(rig: Rig, clock: Any, **options: Any) -> Wire:
    sensor = sensor_on_table(clock, sample_rate_hz=100.0, axis=rig.axis, chamber=rig.chamber.plant)
    return Wire(SimulatedTextUnit(sensor, clock, TextUnitOptions(**options)), clock)


@pytest.mark.parametrize(
    ("chamber", "table"),
    [
        (("thermotron-3800", SimulatedThermotron), ("grbl", SimulatedGrbl)),
        (("cts", SimulatedCts), ("aerosmith-like", SimulatedAerosmith)),
    ],
)
def test_a_run_on_devices_that_are_described_alone(tmp_path: Path, chamber: Any, table: Any) -> None:
    clock = VirtualClock()
    with Rig(clock) as lab, board(lab, clock) as unit:
        air, axis = chamber[1](lab.chamber.plant, clock), table[1](lab.axis, clock)
        with Wire(air, clock) as at_chamber, Wire(axis, clock) as at_table:
            entries = with_board(lab.rig, unit.url).model_dump(mode="json", exclude_unset=True)
            entries["chamber"] |= {"port": at_chamber.url, "options": {"protocol": chamber[0]}}
            entries["axis"][0] |= {"port": at_table.url, "options": {"protocol": table[0]}}
            rig = rig_of(entries)
            made = short_recipe(2.0, changes={"rig.table.axis[0].max_acceleration": "300 deg/s^2"})
            run = new_folder(tmp_path / "run", made, rig, simulated={})
            result = run_session(run, rig, clock, simulated=True)
            assert (result.exit_status, result.reason, result.verified_safe) == ("success", "", True)
            assert not lab.chamber.plant.conditioning
            assert not lab.axis.moving(clock.now())
    log = log_of_run(run.path)
    assert log.provenance["driver"] == "text_unit"
    assert log.standstill is not None
    assert int(log.standstill.max()) == 2 * made.motion[0].repeat
    assert np.ptp(angles_of_rests(log)) == pytest.approx(2.0 * np.pi, abs=1e-3)
    assert np.diff(log.time_s) == pytest.approx(0.01, abs=1e-5)
    # Its gyro turned as the table did.
    assert np.degrees(np.sum(np.abs(log.rate_rad_per_s[0, :, 2]))) * 0.01 > 300.0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"line": "$IMU,{gyro_x},{gyro_y},{gyro_z},{time}"}, "but the description expects"),
        ({"checksum": "none"}, "but the description expects"),
    ],
)
def test_a_check_shows_what_is_printed_and_what_was_expected(change: dict[str, Any], words: str) -> None:
    clock = RealClock()
    with Rig(clock) as rig, board(rig, clock) as port:
        (report,) = (one for one in check_each(with_board(rig.rig, port.url, **change), clock) if one.name == "unit1")
    assert words in report.problem
    assert "Compare them character by character" in report.problem


def test_a_board_that_restarts_when_its_port_is_opened_is_waited_for() -> None:
    clock = RealClock()
    with Rig(clock) as rig, board(rig, clock, boot_s=3.0) as port:
        for boot, good in (("0 s", False), ("3 s", True)):
            rig_file = with_board(rig.rig, port.url, boot=boot, timeout="1 s")
            (report,) = (one for one in check_each(rig_file, clock) if one.name == "unit1")
            assert report.good is good, report.problem
            assert good or "sent nothing in 1 s" in report.problem
