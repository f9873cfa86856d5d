"""Data, stop and parity bits and the end of a line are settings of every serial device, in the rig file."""

from typing import Any

import pytest
from simulated_devices.port import SimulatedPort

from gradcal_jax.hardware.clock import RealClock
from gradcal_jax.hardware.drivers.lines import LinesChamber
from gradcal_jax.hardware.errors import ReplyTimeout
from gradcal_jax.hardware.setup import DRIVERS, configs_of, driver_of, open_rig
from gradcal_jax.spec.rig import rig_of
from gradcal_jax.tables.problems import SpecError


def rig_with(driver: str, options: dict[str, Any], port: str = "COM1") -> Any:
    # Lines are as a protocol has them: of a bath, here.
    text = {"format": "gradcal-text/1", "line": "{gyro_x}", "rate": "100 Hz"}
    protocols = {"lines": "julabo", "registers": "watlow-f4", "text_unit": text, "frames": "stim300"}
    own: dict[str, Any] = {"protocol": protocols[driver]} if driver in protocols else {}
    entry: dict[str, Any] = {"driver": driver, "port": port, "options": own | options}
    role = driver_of(driver).role or "chamber"
    if role == "chamber":
        return rig_of({"format": "gradcal-rig/1", "chamber": {**entry, "safe": "hold"}})
    axis = {"safe": "hold", "gravity_loaded": False} if role == "axis" else {}
    return rig_of({"format": "gradcal-rig/1", role: [{**entry, "name": "a", **axis}]})


@pytest.mark.parametrize("driver", [name for name in DRIVERS if name != "operator"])
def test_every_serial_device_has_the_settings_of_its_line(driver: str) -> None:
    line = {"bytesize": 7, "parity": "E", "stopbits": 2}
    configs_of(rig_with(driver, line))
    for name, wrong in (("parity", "X"), ("stopbits", 3), ("bytesize", "8")):
        with pytest.raises(SpecError, match=name):
            configs_of(rig_with(driver, {name: wrong}))


def test_they_reach_the_port() -> None:
    heard: list[bytes] = []

    class Listener:
        def receive(self, data: bytes) -> list[bytes]:
            heard.append(data)
            return []

    options = {"stopbits": 2, "reply_timeout": "0.1 s"}
    with (
        SimulatedPort(Listener(), RealClock()) as port,
        open_rig(rig_with("lines", {"protocol": "espec"} | options, port.url), RealClock()) as bench,
    ):
        assert isinstance(bench.chamber, LinesChamber)
        line = bench.chamber._exchange.transport._port
        assert (line.bytesize, line.stopbits, line.parity) == (8, 2, "N")
        with pytest.raises(ReplyTimeout):
            bench.chamber.read()
    assert heard[0] == b"TEMP?\r\n"


def test_the_line_is_as_the_protocol_has_it_unless_the_rig_file_says_otherwise() -> None:
    class Silent:
        def receive(self, data: bytes) -> list[bytes]:
            return []

    with SimulatedPort(Silent(), RealClock()) as port:
        for options, parity in (({}, "E"), ({"parity": "N", "baudrate": 19200}, "N")):
            with open_rig(rig_with("lines", options, port.url), RealClock()) as bench:
                assert isinstance(bench.chamber, LinesChamber)
                line = bench.chamber._exchange.transport._port
                assert (line.bytesize, line.parity) == (7, parity)
                assert line.baudrate == options.get("baudrate", 4800)
