"""A package with drivers of its own, installed from its folder: seen wherever a rig is read."""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from hardware_bench import Rig, short_recipe
from journal_log import log_of
from simulated_devices.wire import Wire

from gradcal_jax.cli import main
from gradcal_jax.hardware.clock import RealClock, VirtualClock
from gradcal_jax.hardware.execute import run_session
from gradcal_jax.hardware.guard import make_folder_safe
from gradcal_jax.hardware.run_folder import new_folder
from gradcal_jax.hardware.setup import configs_of, driver_names, driver_of
from gradcal_jax.hardware.simulate.plants import ChamberPlant, ChamberTruth
from gradcal_jax.spec.rig import TEMPLATE, RigFile, parse_rig, rig_of
from gradcal_jax.tables.problems import SpecError
from gradcal_jax.tables.writing import write_toml

HERE = Path(__file__).parents[2] / "docs" / "how-to" / "driver-package"


class SimulatedAcme:
    def __init__(self, plant: ChamberPlant, clock) -> None:
        self.plant, self._clock, self._buffer = plant, clock, b""
        self.setpoint, self.on = 23.0, False

    def receive(self, data: bytes) -> list[bytes]:
        *lines, self._buffer = (self._buffer + data).split(b"\n")
        return [reply for reply in map(self._line, lines) if reply]

    def _line(self, line: bytes) -> bytes:
        now = self._clock.now()
        answers = {b"T?": self.plant.air_c(now), b"SP?": self.setpoint, b"ON?": int(self.on), b"SN?": 4711}
        if line in answers:
            return f"{answers[line]:.2f}\n".encode()
        if line.startswith(b"SP "):
            self.setpoint = float(line[3:])
            self.plant.command(now, target_c=self.setpoint)
        elif line in (b"ON", b"OFF"):
            self.on = line == b"ON"
            self.plant.switch(now, self.on)
        return b""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where pip has installed the package, from its folder alone."""
    source, target = tmp_path_factory.mktemp("source") / "acme", tmp_path_factory.mktemp("site")
    shutil.copytree(HERE, source)
    pip = [sys.executable, "-m", "pip", "install", "-q", "--no-index", "--no-build-isolation", "--no-deps"]
    subprocess.run([*pip, "--target", str(target), str(source)], check=True)
    return target


@pytest.fixture
def installed(site: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.syspath_prepend(str(site))
    yield
    for name in [name for name in sys.modules if name.startswith("gradcal_acme")]:
        del sys.modules[name]


def acme_rig(port: str) -> RigFile:
    entry = {"driver": "acme", "port": port, "safe": "standby", "options": {"reply_timeout": "0.5 s"}}
    return rig_of({"format": "gradcal-rig/1", "chamber": entry | {"serial_number": "4711"}})


def test_without_the_package_the_driver_is_unknown() -> None:
    assert driver_of("acme") is None
    with pytest.raises(SpecError, match='expected "registers"'):
        configs_of(acme_rig("COM1"))


@pytest.mark.usefixtures("installed")
def test_rig_check_and_guard_know_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    clock = RealClock()
    assert "acme" in driver_names("chamber")
    assert "acme_unit" in driver_names("imu")
    assert "acme" not in driver_names("axis")
    text = TEMPLATE.replace('"lines" ', '"acme" ', 1).replace('protocol = "espec"', 'lowes = "3 degC"')
    with pytest.raises(SpecError, match=r'nearest: "lowest"'):
        configs_of(parse_rig(text))
    device = SimulatedAcme(ChamberPlant(ChamberTruth(), clock.now()), clock)
    with Wire(device, clock) as port:
        rig = acme_rig(port.url)
        write_toml(rig, tmp_path / "rig.toml")
        assert main(["rig", "check", str(tmp_path / "rig.toml")]) == 0
        assert "ACME 1 4711" in capsys.readouterr().out
        device.on = True
        (outcome,) = make_folder_safe(tmp_path)
        assert (outcome.verified, outcome.action, device.on) == (True, "standby", False)


def test_the_guards_own_process_knows_it(site: Path, tmp_path: Path) -> None:
    """As it is started: it reads all that it needs before it says that it is ready."""
    write_toml(acme_rig("COM1"), tmp_path / "rig.toml")
    command = [sys.executable, "-m", "gradcal_jax.hardware.guard", str(tmp_path)]
    here = str(Path(__file__).parents[2])
    for path, ready in ((f"{here}{os.pathsep}{site}", b"ready\n"), (here, b"")):
        heard = subprocess.run(
            command, input=b"", capture_output=True, env={**os.environ, "PYTHONPATH": path}, check=False
        )
        assert heard.stdout.replace(b"\r", b"") == ready


@pytest.mark.usefixtures("installed")
def test_run_and_log_know_it(tmp_path: Path) -> None:
    clock = VirtualClock()
    made = short_recipe(2.0, changes={"rig.table.axis[0].max_acceleration": "300 deg/s^2"})
    with Rig(clock) as lab:
        acme = SimulatedAcme(lab.chamber.plant, clock)
        lab.ports[0].device = acme
        chamber = {"driver": "acme", "port": lab.ports[0].url, "safe": "standby"}
        tables = lab.rig.model_dump(mode="json", exclude_unset=True)
        tables["imu"][0]["driver"] = "acme_unit"
        rig = rig_of({**tables, "chamber": chamber})
        run = new_folder(tmp_path / "run", made, rig, simulated={})
        result = run_session(run, rig, clock, simulated=True)
        assert (result.exit_status, result.reason, result.verified_safe) == ("success", "", True)
        assert not acme.on
    log = log_of(run.contents(), run.recipe(), run.rig())
    assert log.provenance["driver"] == "acme_unit"
    assert log.standstill is not None
    assert int(log.standstill.max()) == 2 * made.motion[0].repeat
