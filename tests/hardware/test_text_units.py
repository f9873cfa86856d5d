"""Units that print text, described in the rig file in some ten lines: from `rig check` to a log."""

import itertools
import re

import numpy as np
import pytest
from hardware_bench import Rig, sensor_on_table
from simulated_devices.text_unit import SimulatedTextUnit
from simulated_devices.wire import Wire

from gradcal_jax.hardware.checksums import xor8
from gradcal_jax.hardware.clock import RealClock
from gradcal_jax.hardware.description import described
from gradcal_jax.hardware.roles import join
from gradcal_jax.hardware.setup import check_each
from gradcal_jax.hardware.text_unit import TextSensor
from gradcal_jax.spec.rig import rig_of
from gradcal_jax.tables.problems import SpecError

BOARD = {
    "format": "gradcal-text/1",
    "title": "the board",
    "line": "$IMU,{gyro_x},{gyro_y},{gyro_z},{acceleration_x},{acceleration_y},{acceleration_z},{temperature},{time}",
    "rate": "100 Hz",
    "time": {"unit": "us", "modulus": 2**32},
    "checksum": "xor8",
    "timeout": "2 s",
}
COUNTED = {"format": "gradcal-text/1", "line": "{gyro_z} {count}", "rate": "100 Hz", "counter": 256}
PLAIN = {"format": "gradcal-text/1", "line": "{:text};{gyro_z}", "rate": "100 Hz", "gyro": "rad/s"}


def decoder(protocol):
    return described(TextSensor, protocol).decoder()


def printed(number, gyro=1.5):
    body = f"IMU,{gyro:.3f},-0.25,3,0,0,9.80665,25.5,{10_000 * number % 2**32}".encode()
    return b"$" + body + b"*%02X\r\n" % xor8(body)


# ------------------------------------------------------------------------------------------------------------ lines


def test_numbers_come_out_in_the_units_of_this_program():
    batch = decoder(BOARD).push(b"ready\r\n" + printed(7) + printed(8), 0.0)
    assert batch.gyro_dps[1].tolist() == [1.5, -0.25, 3.0]
    assert batch.acceleration_g[1] == pytest.approx([0.0, 0.0, 1.0])
    assert batch.temperature_c[1].tolist() == [25.5] * 3
    assert np.diff(batch.device_time_s) == pytest.approx([0.01])
    rad = decoder(PLAIN).push(b"any; 1.0\n", 0.0)
    assert rad.gyro_dps[0, 2] == pytest.approx(57.29578)
    assert np.isnan(rad.gyro_dps[0, :2]).all()


def test_lost_and_doubled_lines_are_counted_by_time_and_by_counter():
    kept = [k for k in range(1000) if k not in (400, 401, 402)]
    timed = decoder(BOARD).push(b"".join(2 * printed(k) for k in kept), 0.0)
    assert (len(timed), timed.gap_before.sum(), timed.gap_before[400]) == (997, 3, 3)
    counted = decoder(COUNTED)
    batch = join([counted.push(f"0.5 {k % 256}\n".encode(), 0.0) for k in kept for _ in range(2)])
    assert (len(batch), batch.gap_before.sum(), batch.gap_before[400]) == (997, 3, 3)
    assert counted.round_samples == 256


def test_a_time_that_wraps_goes_on_and_one_that_goes_back_is_a_restart():
    wraps = 2**32 // 10_000
    unit = decoder(BOARD)
    times = unit.push(b"".join(printed(k) for k in range(wraps - 3, wraps + 4)), 0.0)
    assert not times.restarted.any()
    assert np.diff(times.device_time_s) == pytest.approx(0.01, abs=2e-6)
    again = unit.push(printed(0) + printed(1), 0.0)
    assert again.restarted.tolist() == [True, False]
    assert again.gap_before.tolist() == [0, 0]


def test_no_bit_of_a_line_may_be_wrong_where_it_has_a_check_sum():
    line = printed(7)
    for place, bit in itertools.product(range(len(line) - 2), range(8)):
        bad = line[:place] + bytes([line[place] ^ 1 << bit]) + line[place + 1 :]
        # Case of the check's letters alone is no error.
        assert len(decoder(BOARD).push(bad, 0.0)) == 0 or bad.upper() == line.upper()


def test_a_line_without_an_end_is_noise():
    unit = decoder(COUNTED)
    for _ in range(100):
        assert len(unit.push(b"0.5 1 " * 1000, 0.0)) == 0
    assert len(unit.push(b"\n0.5 2\n", 0.0)) == 1
    assert unit.bad_bytes > 590_000


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"line": "$IMU,{gx},{gyro_y}"}, "{gx} is not the name of a field"),
        ({"line": "{gyro_x}{gyro_y}"}, "with a character between two fields"),
        ({"line": "{gyro_x},{gyro_x}"}, "a field appears twice"),
        ({"line": "{temperature}"}, "expected at least one field of a rate or an acceleration"),
        ({"line": "{gyro_x},{count}"}, "the value at which the count restarts at 0"),
        ({"line": "{gyro_x},{count},{time}", "counter": 256}, "not both"),
        ({"gyro": "deg"}, "gyro"),
        ({"rate": "100"}, "rate"),
        ({"lines": "x"}, 'nearest: "line"'),
    ],
)
def test_a_description_that_cannot_be_right_is_refused(change, words):
    with pytest.raises(SpecError, match=re.escape(words)):
        described(TextSensor, BOARD | change)


# -------------------------------------------------------------------------------------------------------- on a rig


def with_board(rig, url, **change):
    tables = rig.model_dump(mode="json", exclude_unset=True)
    tables["imu"] = [{"name": "unit1", "driver": "text_unit", "port": url, "options": {"protocol": BOARD | change}}]
    return rig_of(tables)


def board(rig, clock, **options):
    sensor = sensor_on_table(clock, sample_rate_hz=100.0, axis=rig.axis, chamber=rig.chamber.plant)
    return Wire(SimulatedTextUnit(sensor, clock, **options), clock)


def test_a_board_that_restarts_when_its_port_is_opened_is_waited_for_and_what_it_prints_is_shown():
    clock = RealClock()
    with Rig(clock) as rig, board(rig, clock, boot_s=3.0) as port:
        for change, said in (
            ({"boot": "0 s"}, "sent nothing in 1 s"),
            ({"boot": "3 s"}, ""),
            ({"boot": "3 s", "checksum": "none"}, "Compare them character by character"),
        ):
            rig_file = with_board(rig.rig, port.url, timeout="1 s", **change)
            (report,) = (one for one in check_each(rig_file, clock) if one.name == "unit1")
            assert said in report.problem
            assert bool(report.problem) is bool(said)
