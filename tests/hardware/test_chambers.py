"""The chamber drivers against their simulated peers: behaviour, refusals, faults of the line, and identity.

minimalmodbus and pymodbus, which share nothing with this package, check the simulated F4 and the driver of the F4T.
"""

import asyncio
import socket
import struct
import threading
from typing import Any

import minimalmodbus
import pytest
import serial
from hardware_bench import (
    cts_bench,
    espec_bench,
    espec_config,
    f4_bench,
    f4_config,
    f4t_bench,
    f4t_config,
    thermotron_bench,
)
from simulated_devices.espec import EspecOptions, SimulatedEspec
from simulated_devices.faults import Faults
from simulated_devices.line_clock import LineClock
from simulated_devices.port import SimulatedPort
from simulated_devices.watlow_f4 import SimulatedWatlowF4, WatlowF4Options
from simulated_devices.watlow_f4t import WatlowF4TOptions

from gradcal_jax.hardware.clock import RealClock
from gradcal_jax.hardware.errors import (
    Disconnected,
    FramingError,
    HardwareError,
    LimitExceeded,
    NotVerified,
    Rejected,
    ReplyTimeout,
)
from gradcal_jax.hardware.framing import NotThisReply, Tcp, parse_words, parse_written, read_body, write_body
from gradcal_jax.hardware.roles import TemperatureChamber
from gradcal_jax.hardware.setup import DRIVERS, configs_of
from gradcal_jax.hardware.simulate.plants import ChamberPlant, ChamberTruth
from gradcal_jax.hardware.transport import Transport
from gradcal_jax.spec.rig import rig_of
from gradcal_jax.tables.problems import SpecError

BENCHES = {
    "espec": espec_bench,
    "watlow_f4": f4_bench,
    "watlow_f4t": f4t_bench,
    "thermotron": thermotron_bench,
    "cts": cts_bench,
}


@pytest.fixture(params=BENCHES)
def bench(request: pytest.FixtureRequest):
    return BENCHES[request.param]


def test_every_chamber_holds_settles_and_goes_safe(bench) -> None:
    clock = LineClock()
    with bench(clock) as (chamber, _, port):
        assert isinstance(chamber, TemperatureChamber)
        assert chamber.identify().driver in DRIVERS
        limits = chamber.limits()
        assert limits.lowest_c <= -40.0
        assert not chamber.read().conditioning
        chamber.hold(-30.0)
        moving = chamber.read()
        assert (moving.setpoint_c, moving.conditioning) == (-30.0, True)
        assert moving.air_c > 20.0
        clock.sleep(5400.0)
        settled = chamber.read()
        assert settled.air_c == pytest.approx(-30.0, abs=0.05)
        assert settled.alarms == ()
        for policy, air in (("hold", -30.0), ("ambient", 23.0)):
            assert chamber.safe(policy, 23.0).verified
            clock.sleep(7200.0)
            assert chamber.read().air_c == pytest.approx(air, abs=0.1)
        # Of a room that the chamber's limits leave out, as near as they allow.
        assert chamber.safe("ambient", 500.0).verified
        assert chamber.read().setpoint_c == limits.highest_c
        assert chamber.safe("standby").verified
        assert not chamber.read().conditioning
        assert port.lost_bytes == 0


@pytest.mark.parametrize("make", [thermotron_bench, cts_bench, f4t_bench])
def test_ramps_in_the_controller_have_the_rate_that_was_asked_for(make) -> None:
    clock = LineClock()
    with make(clock) as (chamber, device, _):
        chamber.hold(-20.0)
        clock.sleep(5400.0)
        assert chamber.ramp(40.0, 1.0) == pytest.approx(1.0, abs=0.01)
        clock.sleep(600.0)
        first, first_c = chamber.read(), device.plant.set_point_c(clock.now())
        clock.sleep(1200.0)
        second, second_c = chamber.read(), device.plant.set_point_c(clock.now())
        rate = (second_c - first_c) / (second.time_s - first.time_s) * 60.0
        assert rate == pytest.approx(1.0, abs=0.02)
        assert (second.air_c - first.air_c) / (second.time_s - first.time_s) * 60.0 == pytest.approx(1.0, abs=0.02)
        # A new ramp from within the old one, downwards; then a hold must not inherit the gradient.
        assert chamber.ramp(-10.0, 0.5) == pytest.approx(0.5, abs=0.01)
        clock.sleep(900.0)
        assert chamber.read().setpoint_c < second.setpoint_c
        chamber.hold(-40.0)
        assert chamber.read().setpoint_c == -40.0


def test_every_chamber_refuses_what_lies_outside_its_own_limits(bench) -> None:
    with bench(LineClock()) as (chamber, _, _):
        before = chamber.read().setpoint_c
        for wrong in (chamber.limits().highest_c + 1.0, chamber.limits().lowest_c - 1.0):
            with pytest.raises(LimitExceeded, match="accepts"):
                chamber.hold(wrong)
        assert chamber.read().setpoint_c == before


@pytest.mark.long
@pytest.mark.parametrize("way", ["faults", "commands"])
def test_no_chamber_is_put_off_by_a_bad_line(bench, way: str) -> None:
    """Drops, noise, duplicates, truncated and split replies or commands: what takes effect is verified."""
    clock = LineClock()
    share, said = 0.06, (ReplyTimeout, FramingError) if way == "faults" else (HardwareError,)
    faults = Faults(
        seed=4, probability={"drop": share, "truncate": share, "duplicate": share, "split": share, "noise": share}
    )
    with bench(clock, **{way: faults}) as (chamber, device, _):
        done = 0
        for index in range(12):
            target = 10.0 + index
            try:
                chamber.hold(target)
            except said:
                continue  # three questions in a row were lost: reported, never a wrong value
            done += 1
            assert device.plant.set_point_c(clock.now()) == target
        assert done >= (8 if way == "faults" else 5)
        assert sum(faults.count.values()) > 8


@pytest.mark.parametrize("fault", ["drop", "duplicate", "flip", "delay"])
def test_every_command_lost_doubled_damaged_or_late_once_is_noticed(bench, fault) -> None:
    """Each line of a session in its turn: what returns without an exception has taken effect."""
    clock = LineClock()
    faults = Faults(seed=5, delay_s=0.15)
    with bench(clock, commands=faults) as (chamber, device, _):
        ramps = chamber.limits().hardware_ramp
        refused = 0
        for number in range(12):
            target = 20.0 + number
            # The other lines of the session pass: a line that is split is whole again.
            faults._next.clear()
            faults.once(*["split"] * number, fault)
            try:
                chamber.hold(target)
                assert device.plant.set_point_c(clock.now()) == pytest.approx(target, abs=1e-3)
                assert device.plant.conditioning
                if ramps:
                    clock.sleep(1800.0)
                    chamber.ramp(target + 20.0, 1.0)
                    began = clock.now(), device.plant.set_point_c(clock.now())
                    clock.sleep(300.0)
                    rate = (device.plant.set_point_c(clock.now()) - began[1]) / (clock.now() - began[0]) * 60.0
                    assert rate == pytest.approx(1.0, abs=0.25)
                chamber.standby()
                assert not device.plant.conditioning
            except HardwareError:
                refused += 1  # said to whoever asked, and the run ends
        assert refused <= (12 if fault == "flip" else 4)  # a damaged line is refused by the chamber itself


def test_silent_chamber_and_pulled_cable_are_told_apart(bench) -> None:
    with bench(LineClock()) as (chamber, _, port):
        chamber.identify()
        port.faults = Faults(mute=True)
        with pytest.raises(ReplyTimeout, match="did not answer"):
            chamber.read()
        port.faults = None
        chamber.read()
        port.unplug()
        with pytest.raises(Disconnected, match="cable"):
            chamber.read()


def test_reboot_in_a_run_shows_in_the_reading(bench) -> None:
    with bench(LineClock()) as (chamber, device, _):
        chamber.hold(50.0)
        assert chamber.read().conditioning
        device.reboot()
        assert not chamber.read().conditioning


@pytest.mark.parametrize("decimals", [0, 1, 2])
@pytest.mark.parametrize("blanks", [True, False])
def test_espec_replies_with_any_number_of_decimals_and_with_blanks(decimals: int, blanks: bool) -> None:
    clock = LineClock()
    with espec_bench(clock, EspecOptions(decimals=decimals, blanks=blanks)) as (chamber, device, _):
        assert chamber.identify().model == "ESPEC P300"
        chamber.hold(30.0)
        clock.sleep(3600.0)
        assert chamber.read().air_c == pytest.approx(30.0, abs=0.6 * 10.0**-decimals)
        device.raise_alarm(18)
        assert chamber.read().alarms == ("18",)


# --- ESPEC ------------------------------------------------------------------------------------------------------------


def test_espec_simulator_speaks_the_golden_vectors() -> None:
    device = SimulatedEspec(
        ChamberPlant(ChamberTruth(start_c=26.4)), LineClock(), EspecOptions(high_c=140.0, low_c=-50.0)
    )
    assert device.receive(b"TEMP?") == []
    assert device.receive(b"\r\n") == [b"26.4,23.0,140.0,-50.0\r\n"]
    assert device.receive(b"TEMP, S25.0\r\n") == [b"OK:TEMP, S25.0\r\n"]
    assert device.receive(b"TEMP, S200.0\r\nXYZ\r\n") == [b"NA:DATA OUT OF RANGE\r\n", b"NA:CMD ERR\r\n"]
    assert device.receive(b"PRGM,PAUSE\r\n") == [b"NA:CONT NOT READY-2\r\n"]
    assert device.receive(b"HUMI?\r\n") == [b"NA:CONT NOT READY-1\r\n"]
    assert device.receive(b"MON?\r\n") == [b"26.4,,STANDBY,0\r\n"]


def test_espec_alarm_address_and_old_controller() -> None:
    clock = LineClock()
    config = espec_config(line={"prefix": "3,"}, ask={"mode": {"send": "MODE?"}})
    with espec_bench(clock, EspecOptions(address=3, knows_detail=False), config) as (chamber, device, _):
        chamber.hold(30.0)
        clock.sleep(3600.0)
        # Somebody starts a program at the panel: a set point ends it.
        assert device._command("RUN PRGM, TEMP30.0 TIME1:00 GOTEMP60.0") == ""
        assert (chamber.read().mode, chamber.read().conditioning) == ("RUN", True)
        chamber.hold(40.0)
        assert (chamber.read().mode, device.plant.set_point_c(clock.now())) == ("CONSTANT", 40.0)
        with pytest.raises(Rejected, match="steps of the set point"):
            chamber.ramp(50.0, 1.0)
        device.raise_alarm(18)
        reading = chamber.read()
        assert (reading.alarms, reading.conditioning) == (("18",), False)


def test_espec_with_its_echo_off_names_the_setting() -> None:
    bench = espec_bench(LineClock(), EspecOptions(echo_off=True))
    with bench as (chamber, _, _), pytest.raises(ReplyTimeout, match="echo back"):
        chamber.identify()


def test_espec_lost_acknowledgement_repeats_nothing() -> None:
    faults = Faults()
    with espec_bench(LineClock(), faults=faults) as (chamber, device, _):
        chamber.hold(20.0)
        device.commands.clear()
        # Questions before the command: limits, mode; the third message is the acknowledgement.
        faults.once("split", "split", "drop")
        chamber.hold(31.0)
        assert [text for text in device.commands if text.startswith("TEMP, S")] == ["TEMP, S31.0"]


def test_chamber_that_acknowledges_and_does_nothing_is_noticed() -> None:
    with espec_bench(LineClock()) as (chamber, device, _):
        device._enter = lambda mode: None  # local mode at the panel: it says OK and stays as it is
        with pytest.raises(NotVerified, match="read-back"):
            chamber.hold(30.0)


# --- Weiss ------------------------------------------------------------------------------------------------------------


# --- Watlow F4 --------------------------------------------------------------------------------------------------------


def test_simulated_f4_satisfies_an_independent_modbus_client() -> None:
    clock = RealClock()
    plant = ChamberPlant(ChamberTruth(start_c=25.0, ambient_c=25.0), clock.now())
    device = SimulatedWatlowF4(plant, clock)
    with SimulatedPort(device, clock) as port:
        client = minimalmodbus.Instrument(serial.Serial(port.url, 9600, timeout=0.5), 1)
        assert client.read_register(100, 1, signed=True) == 25.0
        client.write_register(300, -40.0, 1, functioncode=6, signed=True)
        assert device.words[300] == -400
        assert client.read_registers(602, 2) == [65536 - 700, 1800]
        client.write_registers(300, [123])
        assert client.read_register(300, 1) == 12.3
        with pytest.raises(minimalmodbus.IllegalRequestError):
            client.read_register(9999)
        with pytest.raises(minimalmodbus.IllegalRequestError):
            client.write_register(300, 200.0, 1, functioncode=6, signed=True)
        client.serial.close()


def test_f4_in_fahrenheit_without_standby_and_with_a_tripped_limit() -> None:
    wrong_unit = f4_bench(LineClock(), WatlowF4Options(fahrenheit=True))
    with wrong_unit as (chamber, _, _), pytest.raises(Rejected, match="Fahrenheit"):
        chamber.identify()
    changes = {"tell": {"on": False, "off": False}, "state": {"conditioning": False}}
    unswitched = f4_bench(LineClock(), WatlowF4Options(conditioning_event=0), f4_config(changes=changes))
    with unswitched as (chamber, _, _):
        with pytest.raises(Rejected, match="no \\[tell\\] off"):
            chamber.safe("standby")
        with pytest.raises(Rejected, match="steps"):
            chamber.ramp(50.0, 1.0)
    with f4_bench(LineClock()) as (chamber, device, _):
        chamber.hold(60.0)
        device.trip_limit()
        assert chamber.read().alarms == ("limit input 1",)


@pytest.mark.parametrize("decimals", [0, 1, 2])
def test_f4_scales_by_its_own_decimals(decimals: int) -> None:
    clock = LineClock()
    with f4_bench(clock, WatlowF4Options(decimals=decimals)) as (chamber, _, _):
        chamber.hold(-40.0)
        clock.sleep(7200.0)
        assert chamber.read().setpoint_c == -40.0
        assert chamber.read().air_c == pytest.approx(-40.0, abs=0.6 * 10.0**-decimals)


# --- Watlow F4T -------------------------------------------------------------------------------------------------------


def float_words(value: float) -> tuple[int, int]:
    """A float as two registers, the low word first."""
    high, low = struct.unpack(">HH", struct.pack(">f", value))
    return low, high


def test_f4t_messages_byte_for_byte() -> None:
    """By hand from the protocol's definition: 25.0 is 41C80000, and its low word goes first."""
    tcp = Tcp(1)
    asked = [tcp.message(read_body(2820, 2)) for _ in range(7)][-1]
    assert asked == bytes.fromhex("0007 0000 0006 01 03 0B04 0002")
    told = tcp.message(write_body(2782, (0x0000, 0x41C8)))
    assert told == bytes.fromhex("0008 0000 000B 01 10 0ADE 0002 04 0000 41C8")
    assert parse_words(tcp, bytes.fromhex("0007 0000 0007 01 03 04 0000 41C8"), asked, 2) == (0, 0x41C8)
    parse_written(tcp, bytes.fromhex("0008 0000 0006 01 10 0ADE 0002"), told)
    with pytest.raises(NotThisReply):
        parse_written(tcp, bytes.fromhex("0007 0000 0006 01 10 0ADE 0002"), told)
    with pytest.raises(Rejected, match="register address"):
        parse_words(tcp, bytes.fromhex("0007 0000 0003 01 83 02"), asked, 2)


def test_f4t_driver_speaks_with_an_independent_server() -> None:
    server_room = pytest.importorskip("pymodbus.server")
    simulator = pytest.importorskip("pymodbus.simulator")
    registers = {2730: [10], 2774: [*float_words(-70.0), *float_words(180.0)]}
    registers |= {2782: [0, 0], 2794: [62], 2810: [*float_words(-12.5)], 2814: [10], 6730: [15]}
    registers |= {2820: [*float_words(21.25)], 16568: [251]}
    registers |= {12: [0xE240, 1], 4: [4], 16: [ord(letter) for letter in "F4T1L1EAA1D1AAA"]}
    data = [
        simulator.SimData(place, values=values, datatype=simulator.DataType.REGISTERS)
        for place, values in sorted(registers.items())
    ]
    loop = asyncio.new_event_loop()
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        number = probe.getsockname()[1]

    async def serve() -> Any:
        server = server_room.ModbusTcpServer(simulator.SimDevice(1, simdata=data), address=("127.0.0.1", number))
        await server.serve_forever(background=True)
        return server

    server = loop.run_until_complete(serve())
    thread = threading.Thread(target=loop.run_forever)
    thread.start()
    clock = RealClock()
    transport = Transport(f"socket://127.0.0.1:{number}", clock=clock)
    try:
        config = f4t_config(changes={"alarm": False})
        chamber = config.device(config.link(transport, clock), clock)
        identity = chamber.identify()
        assert (identity.model, identity.serial_number) == ("Watlow F4T F4T1L1EAA1D1AAA", "123456")
        assert (chamber.limits().lowest_c, chamber.limits().highest_c) == (-70.0, 180.0)
        reading = chamber.read()
        assert (reading.air_c, reading.setpoint_c, reading.mode, reading.conditioning) == (21.25, -12.5, "AUTO", True)
        chamber.hold(-12.5)
        assert chamber._number("target") == -12.5
        # This server keeps what it is told and does nothing: what is in force stays, and that is noticed.
        with pytest.raises(NotVerified, match=r"setpoint \(target = 40\)"):
            chamber.hold(40.0)
        with pytest.raises(Rejected, match="exception 2"):
            chamber._words("alarm1", 1)
    finally:
        transport.close()
        asyncio.run_coroutine_threadsafe(server.shutdown(), loop).result(5.0)
        loop.call_soon_threadsafe(loop.stop)
        thread.join()
        loop.close()


def test_f4t_whose_loop_stays_off_is_noticed_and_one_that_was_off_is_switched_on_first() -> None:
    clock = LineClock()
    with f4t_bench(clock) as (chamber, device, _):
        # Somebody wrote a set point beforehand, to a loop that is off.
        device.memory.put(2782, -30.0)
        assert (chamber.read().conditioning, chamber.read().setpoint_c) == (False, 23.0)
        chamber.hold(-30.0)
        assert device.plant.set_point_c(clock.now()) == -30.0
        device.memory.words[16568] = 149
        assert chamber.read().mode == "PROFILE"
        chamber.hold(-20.0)
        assert chamber.read().mode == "AUTO"
        device.memory.words[1556] = 12
        device.memory.words[1456] = 10
        assert chamber.read().alarms == ("alarm 2",)
    with f4t_bench(clock, WatlowF4TOptions(locked=True)) as (chamber, device, _):
        with pytest.raises(NotVerified, match=r"Watlow F4T: on \(loop = 10\)"):
            chamber.hold(30.0)
        assert not device.plant.conditioning
    with (
        f4t_bench(clock, WatlowF4TOptions(fahrenheit=True)) as (chamber, _, _),
        pytest.raises(Rejected, match="Celsius"),
    ):
        chamber.identify()
    plant = {"equals": False, "field": "plant", "begins": "63"}
    event = f4t_config(
        changes={
            "registers": {"event": {"address": 16598}, "plant": {"address": 16598}},
            "tell": {"on": {"event": 63}, "off": {"event": 62}},
            "state": {"conditioning": plant},
        }
    )
    with f4t_bench(clock, WatlowF4TOptions(conditioning_event=3), event) as (chamber, device, _):
        chamber.hold(30.0)
        assert device.plant.conditioning
        device.memory.words[16598] = 62
        assert not chamber.read().conditioning
    table = {"driver": "registers", "port": "COM1", "safe": "hold"}
    table["options"] = {"protocol": "watlow-f4t", "address": 256}
    with pytest.raises(SpecError, match=r"chamber.options.address = 256: must be at most 255"):
        configs_of(rig_of({"format": "gradcal-rig/1", "chamber": table}))
