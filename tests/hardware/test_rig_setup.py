"""The rig file: everything wrong at once; from its options to open, checked devices."""

from pathlib import Path

import pytest
from hardware_bench import sensor_on_table
from simulated_devices.espec import SimulatedEspec
from simulated_devices.frames import SimulatedFrames
from simulated_devices.line_tables import SimulatedGrbl
from simulated_devices.wire import Wire

from gradcal_jax.hardware.clock import VirtualClock
from gradcal_jax.hardware.drivers.lines import LinesConfig
from gradcal_jax.hardware.drivers.listening import FramesConfig
from gradcal_jax.hardware.journal import Direction
from gradcal_jax.hardware.setup import check_rig, configs_of, open_rig
from gradcal_jax.hardware.simulate.plants import AxisPlant, ChamberPlant, ChamberTruth
from gradcal_jax.spec.rig import TEMPLATE, parse_rig, read_rig
from gradcal_jax.tables.problems import SpecError


def test_template_is_a_rig_and_its_options_reach_the_drivers() -> None:
    rig = parse_rig(TEMPLATE)
    configs = configs_of(rig)
    assert configs["chamber",] == LinesConfig(protocol="espec")
    assert configs["axis", 0] == LinesConfig(protocol="grbl", max_rate="300 deg/s", max_acceleration="300 deg/s^2")
    assert configs["imu", 0] == FramesConfig(protocol="stim300")


def test_everything_wrong_with_a_rig_is_said_at_once() -> None:
    text = """
format = "gradcal-rig/1"
[chamber]
driver = "linez"
port = "/dev/a"
safe = "standby"
[[axis]]
name = "table"
driver = "lines"
port = "/dev/b"
safe = "hold"
gravity_loaded = false
[axis.options]
max_rat = "300 deg/s"
max_acceleration = 300
zero = "3 s"
direction = "one"
[[imu]]
name = "unit"
driver = "frames"
port = "/dev/c"
[imu.options]
protocol = "stim301"
"""
    with pytest.raises(SpecError) as caught:
        configs_of(parse_rig(text))
    message = str(caught.value)
    for fragment in (
        'chamber.driver = "linez"',
        'nearest: "lines"',
        "axis[0].options.max_rat",
        'nearest: "max_rate"',
        "axis[0].options.max_acceleration = 300: expected an angular acceleration as text with a unit",
        "axis[0].options.zero",
        'axis[0].options.direction = "one"',
        "imu[0].options: expected the name of a",
    ):
        assert fragment in message


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (('safe           = "hold"', 'safe           = "drop"'), "axis[0].safe"),
        (
            ("gravity_loaded = false       # true: gravity moves the axis if its motor has no power\n", ""),
            "axis[0].gravity_loaded",
        ),
        (("/dev/ttyUSB2", "/dev/ttyUSB0"), "two devices use this port"),
        (('name   = "unit1"', 'name   = "table"'), "two devices have this name"),
        (("gradcal-rig/1", "gradcal-spec/1"), 'expected "gradcal-rig/1"'),
        (('safe    = "standby"', 'saff    = "standby"'), 'nearest: "safe"'),
    ],
)
def test_a_wrong_rig_is_refused_with_its_key(change: tuple[str, str], expected: str) -> None:
    assert change[0] in TEMPLATE
    with pytest.raises(SpecError, match=expected.replace("[", r"\[")):
        parse_rig(TEMPLATE.replace(*change))


def test_a_gravity_loaded_axis_is_never_unpowered() -> None:
    text = TEMPLATE.replace('safe           = "hold" ', 'safe           = "unpower" ')
    parse_rig(text)
    with pytest.raises(SpecError, match="gravity turns this axis if its motor has no power"):
        parse_rig(text.replace("gravity_loaded = false", "gravity_loaded = true"))
    with pytest.raises(SpecError, match="no device"):
        parse_rig('format = "gradcal-rig/1"')


class Remember:
    def __init__(self) -> None:
        self.data = b""

    def __call__(self, time_s: float, direction: Direction, data: bytes) -> None:
        self.data += data


def test_a_rig_is_opened_checked_and_closed(tmp_path: Path) -> None:
    clock = VirtualClock()
    plants = [AxisPlant(), AxisPlant()]
    with (
        Wire(SimulatedEspec(ChamberPlant(ChamberTruth()), clock), clock) as chamber,
        Wire(SimulatedGrbl(plants[0], clock), clock) as outer,
        Wire(SimulatedGrbl(plants[1], clock), clock) as inner,
        Wire(SimulatedFrames(sensor_on_table(clock), clock), clock) as imu,
    ):
        path = tmp_path / "rig.toml"
        text = TEMPLATE.replace("/dev/ttyUSB0", chamber.url).replace("/dev/ttyUSB1", outer.url)
        text = text.replace("/dev/ttyUSB2", imu.url)
        text += f"""
[[axis]]
name = "inner"
driver = "lines"
port = "{inner.url}"
safe = "hold"
gravity_loaded = false
options = {{ protocol = "grbl" }}
"""
        path.write_text(text)
        rig = read_rig(path)
        records: dict[str, Remember] = {}
        with open_rig(rig, clock, lambda url: records.setdefault(url, Remember())) as bench, clock.party():
            reports = check_rig(bench)
            assert [report.problem for report in reports] == ["", "", "", ""]
            assert [report.name for report in reports] == ["chamber", "table", "inner", "unit1"]
            bench.axes["inner"].home()
            bench.axes["inner"].move_to(30.0, 50.0, 100.0)
            clock.sleep(5.0)
            assert plants[1].state(clock.now())[0] == pytest.approx(30.0, abs=0.01)
            assert plants[0].state(clock.now())[0] == 0.0
        assert b"TEMP?" in records[chamber.url].data
        # Another device on the cable is noticed; the rest of the rig is still reported.
        other = parse_rig(text.replace('safe    = "standby"', 'safe    = "standby"\nserial_number = "N999"'))
        with open_rig(other, clock) as bench, clock.party():
            problems = [report.problem for report in check_rig(bench)]
        assert problems[1:] == ["", "", ""]
        assert "N999" in problems[0]
