"""A package with drivers of its own, installed from its folder: seen wherever a rig is read."""

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hardware_bench import Rig, short_recipe
from journal_log import angles_of_rests
from simulated_devices.line_tables import SimulatedAerosmith
from simulated_devices.wire import Wire
from test_text_units import board, with_board

from gradcal_jax.cli import main
from gradcal_jax.hardware.clock import RealClock, VirtualClock
from gradcal_jax.hardware.execute import run_session
from gradcal_jax.hardware.guard import make_folder_safe
from gradcal_jax.hardware.run_folder import new_folder
from gradcal_jax.hardware.setup import configs_of, driver_names, driver_of
from gradcal_jax.hardware.simulate.plants import ChamberPlant, ChamberTruth
from gradcal_jax.records.run_log import log as log_of_run
from gradcal_jax.spec.rig import TEMPLATE, parse_rig, rig_of
from gradcal_jax.tables.problems import SpecError
from gradcal_jax.tables.writing import write_toml

HERE = Path(__file__).parents[2] / "docs" / "how-to" / "driver-package"


class SimulatedAcme:
    def __init__(self, plant, clock):
        self.plant, self._clock, self._buffer = plant, clock, b""
        self.setpoint, self.on = 23.0, False

    def receive(self, data):
        *lines, self._buffer = (self._buffer + data).split(b"\n")
        return [reply for reply in map(self._line, lines) if reply]

    def _line(self, line):
        now = self._clock.now()
        answers = {b"T?": self.plant.at(now).air_c, b"SP?": self.setpoint, b"ON?": int(self.on), b"SN?": 4711}
        if line in answers:
            return f"{answers[line]:.2f}\n".encode()
        if line.startswith(b"SP "):
            self.setpoint = float(line[3:])
            self.plant.command(now, target_c=self.setpoint)
        elif line in (b"ON", b"OFF"):
            self.on = line == b"ON"
            self.plant.at(now).conditioning = self.on
        return b""


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """Where pip has installed the package, from its folder alone."""
    source, target = tmp_path_factory.mktemp("source") / "acme", tmp_path_factory.mktemp("site")
    shutil.copytree(HERE, source)
    pip = [sys.executable, "-m", "pip", "install", "-q", "--no-index", "--no-build-isolation", "--no-deps"]
    subprocess.run([*pip, "--target", str(target), str(source)], check=True)
    return target


@pytest.fixture
def installed(site, monkeypatch):
    monkeypatch.syspath_prepend(str(site))
    yield
    for name in [name for name in sys.modules if name.startswith("gradcal_acme")]:
        del sys.modules[name]


def acme_rig(port):
    entry = {"driver": "acme", "port": port, "safe": "standby", "options": {"reply_timeout": "0.5 s"}}
    return rig_of({"format": "gradcal-rig/1", "chamber": entry | {"serial_number": "4711"}})


def test_without_the_package_the_driver_is_unknown():
    assert driver_of("acme") is None
    with pytest.raises(SpecError, match='expected "registers"'):
        configs_of(acme_rig("COM1"))


@pytest.mark.usefixtures("installed")
def test_rig_check_and_guard_know_it(tmp_path, capsys):
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


@pytest.mark.usefixtures("installed")
def test_a_run_with_it_and_with_devices_that_are_described_alone(tmp_path):
    clock = VirtualClock()
    made = short_recipe(2.0, changes={"rig.table.axis[0].max_acceleration": "300 deg/s^2"})
    with Rig(clock) as lab, board(lab, clock) as unit:
        acme = lab.ports[0].device = SimulatedAcme(lab.chamber.plant, clock)
        lab.ports[1].device = SimulatedAerosmith(lab.axis, clock)
        tables = with_board(lab.rig, unit.url).model_dump(mode="json", exclude_unset=True)
        tables["chamber"] = {"driver": "acme", "port": lab.ports[0].url, "safe": "standby"}
        tables["axis"][0]["options"] = {"protocol": "aerosmith-like"}
        rig = rig_of(tables)
        run = new_folder(tmp_path / "run", made, rig, simulated={})
        result = run_session(run, clock)
        assert (result.exit_status, result.reason, result.verified_safe) == ("success", "", True)
        assert not acme.on
        assert not lab.axis.moving(clock.now())
    log = log_of_run(run.path)
    assert log.provenance["driver"] == "text_unit"
    assert int(log.standstill.max()) == 2 * made.motion[0].repeat
    assert np.ptp(angles_of_rests(log)) == pytest.approx(2.0 * np.pi, abs=1e-3)
    assert np.diff(log.time_s) == pytest.approx(0.01, abs=1e-5)
    # Its gyro turned as the table did.
    assert np.degrees(np.sum(np.abs(log.rate_rad_per_s[0, :, 2]))) * 0.01 > 300.0
