"""Descriptions of chambers with registers: what is shipped, what is refused, numbers of two registers."""

import re
import struct

import pytest
from hardware_bench import served
from simulated_devices.modbus import ModbusSlave

from gradcal_jax.hardware.clock import VirtualClock
from gradcal_jax.hardware.description import described, shipped
from gradcal_jax.hardware.drivers.registers import RegistersConfig
from gradcal_jax.hardware.errors import FramingError, LimitExceeded, NotVerified, Rejected
from gradcal_jax.hardware.register_protocol import REGISTERS, RegisterProtocol
from gradcal_jax.tables.problems import SpecError

OVEN = {
    "format": REGISTERS,
    "role": "chamber",
    "title": "oven",
    "limits": {"lowest": "-40 degC", "highest": "150 degC"},
    "registers": {
        "air": {"address": 1, "decimals": 1, "input": True},
        "setpoint": {"address": 2, "decimals": 1},
        "places": {"address": 9},
        "run": {"address": 23, "codes": {"0": "OFF", "1": "RUN"}},
    },
    "tell": {"setpoint": {"setpoint": "{setpoint}"}, "on": {"run": 1}, "off": {"run": 0}},
    "state": {"conditioning": {"field": "run", "equals": "RUN"}},
    "require": [{"field": "places", "equals": "1", "why": "decimals"}],
}


class Slave(ModbusSlave):
    """An oven; what is written into `stuck` stays as it was."""

    read_only = frozenset({1})

    def __init__(self, words=None):
        super().__init__({1: 235, 2: 230, 9: 1, 23: 0} | (words or {}))
        self.stuck = set()
        self.asked = set()

    def _answer(self, body):
        self.asked.add((body[0], int.from_bytes(body[1:3], "big")))
        return super()._answer(body)

    def write(self, register, values):
        return 0 if register in self.stuck else super().write(register, values)


def changed(**tables):
    return OVEN | {name: {**OVEN.get(name, {}), **table} for name, table in tables.items()}


@pytest.mark.parametrize("name", shipped(REGISTERS))
def test_what_is_shipped_is_whole(name):
    config = RegistersConfig(protocol=name)
    assert config.line_settings["baudrate"] == 9600
    assert bool(config.lacks_for("standby")) is (name == "eurotherm-3500")
    assert config.lacks_for("hold") == ""


def test_a_chamber_from_its_description_alone():
    clock, device, config = VirtualClock(), Slave(), RegistersConfig(protocol=OVEN, reply_timeout="0.2 s")
    with served(device, clock, 9600) as (_, transport):
        chamber = config.device(config.link(transport, clock), clock)
        assert (chamber.read().air_c, chamber.read().mode, chamber.read().conditioning) == (23.5, "OFF", False)
        assert device.asked == {(4, 1), (3, 2), (3, 23)}
        chamber.hold(-12.5)
        assert (device.words[2], device.words[23]) == (65536 - 125, 1)
        assert (chamber.read().setpoint_c, chamber.read().mode) == (-12.5, "RUN")
        with pytest.raises(LimitExceeded, match="sets 151 degC; the chamber accepts -40 to 150"):
            chamber.hold(151.0)
        with pytest.raises(Rejected, match="makes them by steps"):
            chamber.ramp(30.0, 1.0)
        assert chamber.safe("standby").verified
        assert device.words[23] == 0
        # A register that takes no value: local mode.
        device.stuck.add(2)
        with pytest.raises(NotVerified, match=r"oven: setpoint 40.0 was sent 3 times"):
            chamber.hold(40.0)
        device.words[1] = 30000
        with pytest.raises(FramingError, match="not plausible"):
            chamber.read()


@pytest.mark.parametrize("low_first", [False, True])
@pytest.mark.parametrize("kind", ["float32", "int32"])
def test_numbers_of_two_registers_in_either_order(kind, low_first):
    entry = {"address": 40, "type": kind, "decimals": 0 if kind == "float32" else 2}
    # Of a chamber that its set point alone commands: neither on nor off.
    tables = changed(registers={"setpoint": entry}) | {"line": {"low_word_first": low_first}}
    tables |= {"tell": {"setpoint": {"setpoint": "{setpoint}"}}, "state": {}}
    clock, device = VirtualClock(), Slave({40: 0, 41: 0})
    config = RegistersConfig(protocol=tables, reply_timeout="0.2 s")
    with served(device, clock, 9600) as (_, transport):
        chamber = config.device(config.link(transport, clock), clock)
        chamber.hold(-12.25)
        words = struct.unpack(">HH", struct.pack(">f", -12.25) if kind == "float32" else struct.pack(">i", -1225))
        assert (device.words[40], device.words[41]) == (words[::-1] if low_first else words)
        assert chamber.read().setpoint_c == -12.25
        assert chamber.safe("hold").verified
        with pytest.raises(Rejected, match=r"no \[tell\] off"):
            chamber.safe("standby")


@pytest.mark.parametrize(
    ("tables", "words"),
    [
        (changed(registers={"air": {"address": 1, "input": True, "decimal": 1}}), 'nearest: "decimals"'),
        (changed(registers={"air": {"address": 70000}}), "address"),
        (changed(registers={"air": {"address": 1, "decimals": "digits"}}), "decimals"),
        (changed(registers={"setpoint": {"address": 2, "shown_in": "wroking"}}), "no reply has the field"),
        (changed(tell={"setpoint": {"air": "{setpoint}"}}), "this register can only be read"),
        (changed(tell={"setpoint": {"setpoint": "{ramp}"}}), "expected a number or {setpoint}"),
        (changed(tell={"setpoint": {"setpoint": 4}}), "must write {setpoint} to a register"),
        (changed(tell={"setpoints": {"setpoint": 4}}), "is not a command of a chamber"),
        (changed(tell={"ramp": {"setpoint": "{ramp}"}}), "tell.no_ramp: this key is missing"),
        (changed(alarm={"hot": {"field": "rum", "equals": "1"}}), "no reply has the field"),
        (OVEN | {"state": {}}, "no reply shows the effect of tell.on"),
        (OVEN | {"limits": {}}, "limits.lowest: this key is missing"),
        (OVEN | {"tell": {"setpoint": {"setpoint": "{setpoint}"}, "on": {"run": 1}}}, "tell.off: this key is missing"),
    ],
)
def test_a_description_that_cannot_be_right_is_refused(tables, words):
    with pytest.raises(SpecError, match=re.escape(words)):
        described(RegisterProtocol, tables)
