"""A bench that was recorded by `record_bench` is replayed as its devices: the drivers say and find the same.

Recordings of real benches belong into `recordings/`; each is replayed here.
"""

from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from hardware_bench import Rig
from simulated_devices.line_clock import LineClock
from simulated_devices.port import SimulatedPort
from simulated_devices.replay import ReplayedDevice
from simulated_devices.transcripts import read, rig_in

from gradcal_jax.cli import main
from gradcal_jax.hardware.clock import RealClock
from gradcal_jax.hardware.setup import open_rig
from gradcal_jax.hardware.transcript import conversation, record_bench
from gradcal_jax.spec.rig import rig_of
from gradcal_jax.tables.writing import write_toml

RECORDINGS = sorted((Path(__file__).parent / "recordings").glob("*.txt"))


def with_ports(tables: Any, ports: dict[str, str]) -> Any:
    """The rig's tables, its ports renamed."""
    if isinstance(tables, dict):
        return {k: ports[v] if k == "port" and v in ports else with_ports(v, ports) for k, v in tables.items()}
    return [with_ports(entry, ports) for entry in tables] if isinstance(tables, list) else tables


def replayed(path: Path) -> tuple[list[str], list[str], list[bytes]]:
    """What the drivers found then, what they find now, and what they said that they did not say then."""
    entries, tables, clock = read(path), rig_in(path), LineClock()
    then = [e.data.decode() for e in entries if e.direction == "#" and not e.data.startswith(b"settings")]
    urls = list(dict.fromkeys(e.line for e in entries if e.direction != "#"))
    devices = {url: ReplayedDevice([e for e in entries if e.line == url]) for url in urls}
    with ExitStack() as stack:
        ports = {url: stack.enter_context(SimulatedPort(device, clock)).url for url, device in devices.items()}
        rig = rig_of(with_ports(tables, ports))
        bench = stack.enter_context(open_rig(rig, clock))
        stack.enter_context(clock.party())
        move = any(" hold: " in f" {text}" or text.startswith("home") for text in then)
        now = [f"{call}: {text}" for _, call, text in conversation(bench, clock, move=move)]
    for url, port in ports.items():
        now = [text.replace(port, url) for text in now]
    return then, now, [data for device in devices.values() for data in device.unexpected]


def same(path: Path) -> None:
    then, now, unexpected = replayed(path)
    # The settings that a driver asks for again at the start of a unit's stream come with the stream.
    assert [text for text in now if not text.startswith("start")] == [
        text for text in then if not text.startswith("start")
    ]
    assert unexpected == []


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path, clock = tmp_path_factory.mktemp("bench") / "bench.txt", LineClock()
    with Rig(clock, stage=True) as rig:
        rig.rig.axis[0].options["max_acceleration"] = "2000 deg/s^2"
        record_bench(rig.rig, path, clock, move=True)
    return path


@pytest.mark.long
def test_a_bench_is_recorded_with_what_the_drivers_made_of_it(recorded: Path) -> None:
    text = recorded.read_text(encoding="ascii")
    assert " > TEMP?\\r\\n\n" in text
    assert "chamber # limits: ChamberLimits(" in text
    assert "table # move_to 10: None" in text
    assert "table # safe: SafeReport(action='hold', verified=True" in text
    assert rig_in(recorded)["chamber"]["driver"] == "espec"


@pytest.mark.long
def test_a_recorded_bench_is_replayed_as_its_devices(recorded: Path) -> None:
    same(recorded)


@pytest.mark.long
def test_a_driver_that_differs_is_noticed(recorded: Path, tmp_path: Path) -> None:
    """One digit of what the chamber answered then."""
    path = tmp_path / "bench.txt"
    path.write_text(recorded.read_text(encoding="ascii").replace("24.8,", "25.8,"), encoding="ascii")
    with pytest.raises(AssertionError):
        same(path)


@pytest.mark.parametrize("path", RECORDINGS, ids=lambda path: path.stem)
def test_recordings_of_real_benches_are_replayed(path: Path) -> None:
    same(path)


@pytest.mark.long
def test_the_command_says_who_answers(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with Rig(RealClock(), stage=True) as rig:
        write_toml(rig.rig, tmp_path / "rig.toml")
        words = ["rig", "record", str(tmp_path / "rig.toml"), "-o", str(tmp_path / "bench.txt")]
        assert main(words) == 0
        assert "chamber  identify   answered" in capsys.readouterr().out
        assert "move_to" not in (tmp_path / "bench.txt").read_text(encoding="ascii")
        rig.ports[0].faults = lambda message: []
        assert main([*words, "--force"]) == 3
        assert "ReplyTimeout" in capsys.readouterr().out
