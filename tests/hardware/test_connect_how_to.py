"""What the how-to "connect my device" says is a green `rig check`, on peers not written from it; and its errors."""

import re
from contextlib import ExitStack
from pathlib import Path

import pytest
from hardware_bench import sensor_on_table
from simulated_devices.line_chambers import SimulatedCts
from simulated_devices.line_tables import SimulatedGrbl
from simulated_devices.modbus import ModbusSlave
from simulated_devices.port import SimulatedPort
from simulated_devices.text_unit import SimulatedTextUnit
from simulated_devices.wire import Wire

from gradcal_jax.cli import main
from gradcal_jax.hardware.clock import RealClock
from gradcal_jax.hardware.simulate.plants import AxisPlant, ChamberPlant, ChamberTruth

TEXT = (Path(__file__).parents[2] / "docs" / "how-to" / "connect.md").read_text(encoding="utf-8")
BLOCKS = dict(re.findall(r"```toml\n# (\w+)\.toml\n(.+?)```", TEXT, flags=re.S)) | {
    "cts": """format = "gradcal-rig/1"
[chamber]
driver  = "lines"
port    = "/dev/ttyUSB0"
safe    = "standby"
options = { protocol = "cts" }
""",
    "grbl": """format = "gradcal-rig/1"
[[axis]]
name           = "table"
driver         = "lines"
port           = "/dev/ttyUSB1"
safe           = "hold"
gravity_loaded = false
options        = { protocol = "grbl", changes = { limits = { max_rate = "200 deg/s" } } }
""",
}


def peer(name, clock):
    if name == "cts":
        return SimulatedCts(ChamberPlant(ChamberTruth(), clock.now()), clock)
    if name == "modbus":
        return ModbusSlave({1: 265, 2: 230, 23: 0})
    if name == "grbl":
        return SimulatedGrbl(AxisPlant(None, clock.now()), clock)
    return SimulatedTextUnit(sensor_on_table(clock, sample_rate_hz=100.0), clock, boot_s=1.5)


def checked(text, name, folder, capsys, device=None):
    clock = RealClock()
    with ExitStack() as stack:
        end = device or peer(name, clock)
        port = stack.enter_context(SimulatedPort(end, clock, on_socket=True) if name == "cts" else Wire(end, clock))
        text = re.sub(r'port( +)= "[^"]+"', rf'port\1= "{port.url}"', text)
        (folder / "rig.toml").write_text(text, encoding="utf-8")
        status = main(["rig", "check", str(folder / "rig.toml")])
    said = capsys.readouterr()
    return status, " ".join((said.out + said.err).split())


@pytest.mark.parametrize("name", ["cts", "modbus", "grbl", "board"])
def test_what_the_how_to_writes_is_a_green_check(name, tmp_path, capsys):
    status, said = checked(BLOCKS[name], name, tmp_path, capsys)
    assert status == 0, said
    assert "every device answers as the rig file states" in said


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("modbus", ("address = 2,", "address = 40003,"), "exception 2 (register address)"),
        ("modbus", ("air      = { address = 1, decimals = 1 }", 'air      = { address = 1, type = "uint16" }'), ""),
        ("modbus", ("address = 1, decimals = 1", "address = 1, decimals = 0"), "is not plausible"),
        ("modbus", ('[chamber.options.protocol.state]\nconditioning = { field = "run", equals = "RUN" }', ""),
         "no reply shows the effect of tell.on"),
        ("modbus", ('title  = "my oven"\n', 'title  = "my oven"\nline   = { timeout = "0.2 s" }\n'), ""),
        ("grbl", ('protocol = "grbl"', 'protocol = "grb"'), "nearest: 'grbl'"),
        ("board", ("{temperature},{time}", "{time}"), "but the description expects"),
        ("board", ("{gyro_x}", "{gx}"), "{gx} is not the name of a field"),
        ("board", ('boot     = "2 s"', 'boot     = "0 s"\ntimeout  = "0.5 s"'), "sent nothing in 0.5 s"),
    ],
)  # fmt: skip
def test_errors_that_one_makes_are_said(name, change, words, tmp_path, capsys):
    assert change[0] in BLOCKS[name]
    status, said = checked(BLOCKS[name].replace(*change), name, tmp_path, capsys)
    assert words in said
    assert status != 0 or not words
    if words and name == "modbus" and "tell" not in words:
        assert words in TEXT
