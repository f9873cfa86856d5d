"""Devices described in lines: golden messages, what a description must have, and the state behind the syntax.

The messages of the Thermotron are those of PyMeasure's thermotron3800; of the CTS and the Julabo those that the public
packages cts-chamber 0.3 and julabo 2.3 make; of GRBL those of its own documents (interface.md, jogging.md).
"""

import time
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hardware_bench import (
    Rig,
    aerosmith_bench,
    cts_bench,
    grbl_bench,
    short_recipe,
    thermotron_bench,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from journal_log import angles_of_rests, log_of
from simulated_devices.line_chambers import SimulatedCts, SimulatedThermotron
from simulated_devices.line_clock import LineClock
from simulated_devices.line_tables import SimulatedAerosmith, SimulatedGrbl
from simulated_devices.port import SimulatedPort

from gradcal_jax.hardware.drivers.lines import Codec, LinesConfig
from gradcal_jax.hardware.errors import (
    ChecksumError,
    DeviceFault,
    FramingError,
    NotVerified,
    Rejected,
    ReplyTimeout,
)
from gradcal_jax.hardware.execute import run_session
from gradcal_jax.hardware.line_protocol import (
    LineProtocol,
    described,
    formatted,
    protocol_text,
    reply_pattern,
    shipped,
    shows,
)
from gradcal_jax.hardware.run_folder import new_folder
from gradcal_jax.hardware.setup import configs_of
from gradcal_jax.spec.rig import rig_of
from gradcal_jax.tables.problems import SpecError

# Question or command -> its bytes, and the bytes of a reply with the values in it.
ASKED: dict[str, dict[str, tuple[bytes, bytes, dict[str, str]]]] = {
    "thermotron-3800": {
        "identity": (b"IDEN?\r", b"3800\r\n", {"model": "3800"}),
        "air": (b"PVAR1?\r", b"22.000\r", {"air": "22.000"}),
        "setpoint": (b"SETP1?\r", b"-40.5\r\n", {"setpoint": "-40.5"}),
        "mode": (b"MODE?\r", b"16\r\n", {"mode": "16"}),
    },
    "cts": {
        "temperature": (
            bytes.fromhex("02 81 c1 b0 f0 03"),
            bytes.fromhex("02 81 c1 b0 a0 b0 b2 b4 ae b5 a0 b0 b2 b5 ae b0 f4 03"),
            {"air": "024.5", "setpoint": "025.0"},
        ),
    },
    "julabo": {
        "bath": (b"IN_PV_00\r", b"\x1129.45\r\n", {"air": "29.45"}),
        "status": (b"STATUS\r", b"-01 LOW LEVEL ALARM\r\n", {"status": "-01", "message": "LOW LEVEL ALARM"}),
        "identity": (
            b"VERSION\r",
            b"JULABO CRYOCOMPACT CF31 VERSION 5.0\r\n",
            {"model": "CRYOCOMPACT CF31 VERSION 5.0"},
        ),
    },
    "watlow-f4t-scpi": {
        "identity": (
            b"*IDN?\n",
            b"Watlow Electric,F4T1L1EAA2C1AAA,12345,4.07\n",
            {"model": "F4T1L1EAA2C1AAA", "serial": "12345", "firmware": "4.07"},
        ),
        "air": (b":SOURCE:CLOOP1:PVALUE?\n", b"-12.3456\n", {"air": "-12.3456"}),
        "setpoint": (b":SOURCE:CLOOP1:SPOINT?\n", b"25.0000\n", {"setpoint": "25.0000"}),
        "event": (b":OUTPUT1:STATE?\n", b"ON\n", {"event": "ON"}),
        "unit": (b":UNIT:TEMPERATURE?\n", b"F\n", {"unit": "F"}),
    },
    "grbl": {
        "status": (
            b"?",
            b"<Jog|MPos:12.345,-10.000,5.000|Bf:15,128|FS:500,8000|WCO:0.000,1.551,5.664>\r\n",
            {"state": "Jog", "position": "12.345"},
        ),
    },
}
TOLD: dict[str, dict[str, tuple[dict[str, float], list[bytes]]]] = {
    "thermotron-3800": {
        "setpoint": ({"setpoint": 22.5}, [b"SETP1,22.5\r", b"RUNM\r"]),
        "on": ({}, [b"RUNM\r"]),
        "off": ({}, [b"STOP\r"]),
    },
    "cts": {
        "setpoint": ({"setpoint": -12.3}, [bytes.fromhex("02 81 e1 b0 a0 ad b1 b2 ae b3 c3 03")]),
        "on": ({}, [bytes.fromhex("02 81 f3 b1 a0 b1 d2 03")]),
    },
    "julabo": {
        "setpoint": ({"setpoint": 34.56}, [b"OUT_SP_00 34.56\r"]),
        "on": ({}, [b"OUT_MODE_05 1\r"]),
    },
    "watlow-f4t-scpi": {
        "setpoint": (
            {"setpoint": -40.0},
            [b":OUTPUT1:STATE ON\n", b":SOURCE:CLOOP1:RACTION OFF\n", b":SOURCE:CLOOP1:SPOINT -40.00\n"],
        ),
        "off": ({}, [b":OUTPUT1:STATE OFF\n"]),
    },
    "grbl": {"home": ({}, [b"$H\n"]), "stop": ({}, [b"\x85"])},
}


@pytest.mark.parametrize("name", ASKED)
def test_golden_messages(name: str) -> None:
    said = described(LineProtocol, name)
    codec = Codec(said)
    for question, (sent, received, values) in ASKED[name].items():
        asked = said.ask[question]
        assert codec.message(asked.send, bare=asked.bare) == sent
        (frame,) = codec.framer().push(received)
        found = reply_pattern(asked.reply[0]).fullmatch(codec.text(frame))
        assert found is not None
        assert {key: found[key] for key in values} == values
    for name_, (values_, sent_) in TOLD[name].items():
        command = said.tell[name_]
        lines = [codec.message(formatted(send, values_)[0], bare=command.bare) for send in command.send]
        assert lines == sent_


def test_every_bit_of_a_checked_frame_counts() -> None:
    codec = Codec(described(LineProtocol, "cts"))
    (frame,) = codec.framer().push(ASKED["cts"]["temperature"][1])
    for bit in range(8 * len(frame)):
        # The eighth bits are not in the check, and carry nothing.
        if bit % 8 == 7:
            continue
        damaged = frame[: bit // 8] + bytes([frame[bit // 8] ^ 1 << bit % 8]) + frame[bit // 8 + 1 :]
        with pytest.raises((ChecksumError, FramingError)):
            codec.text(damaged)


@pytest.mark.parametrize("name", shipped())
def test_a_protocol_of_at_most_sixty_lines_and_its_rig(name: str) -> None:
    assert len(protocol_text(name).splitlines()) <= 60
    config = LinesConfig(protocol=tomllib.loads(protocol_text(name)))
    device: dict[str, Any] = {"driver": "lines", "port": "COM1", "safe": "hold", "options": {"protocol": name}}
    other = "axis" if config.described.role == "chamber" else "chamber"
    rigs = {
        "chamber": {"chamber": device},
        "axis": {"axis": [{**device, "name": "a", "gravity_loaded": False}]},
    }
    assert [config] != list(configs_of(rig_of({"format": "gradcal-rig/1", **rigs[config.described.role]})).values())
    with pytest.raises(SpecError, match=f"describes an? {config.described.role}; expected"):
        configs_of(rig_of({"format": "gradcal-rig/1", **rigs[other]}))


def changed(name: str, change: Any) -> dict[str, Any]:
    tables = tomllib.loads(protocol_text(name))
    change(tables)
    return tables


@pytest.mark.parametrize(
    ("name", "change", "expected"),
    [
        ("thermotron-3800", lambda t: t["tell"]["ramp"].pop("shown_by"), "must be read back"),
        ("thermotron-3800", lambda t: t["ask"].pop("setpoint"), "{setpoint}"),
        ("thermotron-3800", lambda t: t["ask"].pop("mode"), "no reply has the field {mode}"),
        ("thermotron-3800", lambda t: t["limits"].pop("free_ramp"), "limits.free_ramp: this key is missing"),
        ("cts", lambda t: t["tell"]["ramp"].update(shown_by=["up", "side"]), "{side}"),
        ("aerosmith-like", lambda t: t["tell"]["acceleration"].pop("shown_by"), "must be read back"),
        ("aerosmith-like", lambda t: t["state"].pop("powered"), "no reply shows the effect of tell.on"),
        ("grbl", lambda t: t["tell"]["move"].update(send="$J=X{place:.3f}"), "placeholder {place} cannot be used"),
        ("grbl", lambda t: t["tell"]["move"].update(send="$J=X{position!r}"), "expected values in braces, such as"),
        ("grbl", lambda t: t["ask"]["status"].update(reply="<{a:text}{position}>"), "a text field ends at"),
        ("grbl", lambda t: t["ask"]["settings"].pop("last"), "the lines of one reply"),
        ("grbl", lambda t: t["units"].update(rate="K/min"), "angular rate"),
        ("julabo", lambda t: t["tell"].update(colour={"send": "RED"}), "tell.colour: is not a command of a chamber"),
    ],
)
def test_what_cannot_be_trusted_is_refused(name: str, change: Any, expected: str) -> None:
    with pytest.raises(SpecError) as caught:
        described(LineProtocol, changed(name, change))
    assert expected in str(caught.value)


@settings(deadline=None)
@given(st.text(max_size=60), st.text(max_size=4000))
def test_no_template_makes_a_reply_cost_more_than_its_length(template: str, reply: str) -> None:
    began = time.thread_time()
    reply_pattern(template).fullmatch(reply)
    assert time.thread_time() - began < 1.0


@given(st.floats(-999.0, 999.0), st.sampled_from(["05.1f", ".2f", ".0f", "g", "07.3f"]))
def test_a_value_that_was_written_is_shown_by_itself_alone(value: float, spec: str) -> None:
    text, written = formatted(f"a {{setpoint:{spec}}} b", {"setpoint": value})
    assert text == f"a {written['setpoint']} b"
    assert shows(written["setpoint"], written["setpoint"])
    step = 10.0 ** -len(written["setpoint"].partition(".")[2])
    assert not shows(written["setpoint"], f"{float(written['setpoint']) + 2.0 * max(step, 1e-3):.6f}")


# --- a whole run ------------------------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize(
    ("chamber", "table"),
    [("thermotron-3800", "grbl"), ("cts", "aerosmith-like")],
)
def test_a_run_on_devices_that_are_described_alone(chamber: str, table: str, tmp_path: Path) -> None:
    clock = LineClock()
    simulated = {"thermotron-3800": SimulatedThermotron, "cts": SimulatedCts}
    tables = {"grbl": SimulatedGrbl, "aerosmith-like": SimulatedAerosmith}
    with Rig(clock) as lab:
        air, axis = simulated[chamber](lab.chamber.plant, clock), tables[table](lab.axis, clock)
        with SimulatedPort(air, clock) as at_chamber, SimulatedPort(axis, clock) as at_table:
            # A pseudo-terminal has no parity, and refuses one now and then.
            plain = {"parity": "N", "bytesize": 8}
            entries = lab.rig.model_dump(mode="json", exclude_unset=True)
            entries["chamber"] |= {"driver": "lines", "port": at_chamber.url, "options": {"protocol": chamber, **plain}}
            entries["axis"][0] |= {"driver": "lines", "port": at_table.url, "options": {"protocol": table}}
            rig = rig_of(entries)
            made = short_recipe(2.0, changes={"rig.table.axis[0].max_acceleration": "300 deg/s^2"})
            run = new_folder(tmp_path / "run", made, rig, simulated={})
            result = run_session(run, rig, clock, simulated=True)
            assert (result.exit_status, result.reason, result.verified_safe) == ("success", "", True)
            assert not lab.chamber.plant.conditioning
            assert not lab.axis.moving(clock.now())
    log = log_of(run.contents(), run.recipe(), run.rig())
    assert log.standstill is not None
    assert int(log.standstill.max()) == 2 * made.motion[0].repeat
    assert np.ptp(angles_of_rests(log)) == pytest.approx(2.0 * np.pi, abs=1e-3)


# --- the state behind the syntax --------------------------------------------------------------------------------------


def test_a_set_point_counts_only_once_the_thermotron_was_told_to_run() -> None:
    clock = LineClock()
    with thermotron_bench(clock) as (chamber, device, _):
        chamber.hold(40.0)
        device._obeys, obeys = (lambda text, now: text != "RUNM" and obeys(text, now)), device._obeys
        with pytest.raises(NotVerified, match="setpoint 60"):
            chamber.hold(60.0)
        assert device.plant.set_point_c(clock.now()) == 40.0


def test_a_ramp_is_shown_before_the_target_is_told_and_taken_off_at_the_end() -> None:
    clock = LineClock()
    for bench in (thermotron_bench, cts_bench):
        with bench(clock) as (chamber, device, _):
            chamber.hold(20.0)
            clock.sleep(3600.0)
            chamber.ramp(60.0, 1.0)
            assert chamber.safe("standby").verified
            assert getattr(device, "ramp_k_per_min", 0.0) == 0.0
            assert getattr(device, "up", 999.9) == getattr(device, "down", 999.9) == 999.9
    with cts_bench(clock) as (chamber, device, _):
        chamber.hold(20.0)
        clock.sleep(3600.0)
        answer = device._answer
        device._answer = lambda text: (
            text[0] if text[:2] in ("u1", "d1") else answer(text)
        )  # it says yes, and keeps its own
        with pytest.raises(NotVerified, match="ramp"):
            chamber.ramp(60.0, 1.0)
        assert device.target_c == 20.0


@pytest.mark.parametrize("bench", [thermotron_bench, cts_bench])
def test_an_alarm_is_in_the_reading(bench: Any) -> None:
    with bench(LineClock()) as (chamber, device, _):
        chamber.hold(30.0)
        assert chamber.read().alarms == ()
        device.raise_alarm()
        reading = chamber.read()
        assert (len(reading.alarms), reading.conditioning) == (1, False)


def test_grbl_that_restarted_has_no_reference_and_does_not_move() -> None:
    clock = LineClock()
    with grbl_bench(clock) as (axis, device, _):
        with pytest.raises(DeviceFault, match="Alarm"):
            axis.move_to(10.0, 50.0, 100.0)
        axis.home()
        axis.move_to(10.0, 50.0, 100.0)
        clock.sleep(5.0)
        device.reboot()
        assert axis.read().faults == ("Alarm",)
        # Unlocked at the board it counts from nought again: it is not referenced for that.
        device.receive(b"$X\n")
        with pytest.raises(DeviceFault, match="no reference"):
            axis.move_to(20.0, 50.0, 100.0)
        device.settings[22] = 0.0
        with pytest.raises(Rejected, match="lost its reference"):
            axis.identify()


def test_grbl_that_finds_no_switch_or_hits_a_limit() -> None:
    clock = LineClock()
    with grbl_bench(clock) as (axis, device, port):
        device.finds_switch = False
        with pytest.raises((DeviceFault, FramingError)):
            axis.home()
        device.finds_switch = True
        axis.home()
        axis.spin(30.0, 100.0)
        clock.sleep(3.0)
        for message in device.hard_limit():
            port.say(message)
        with pytest.raises(ReplyTimeout):
            axis.read()


def test_grbl_stops_where_it_stands_and_can_go_on() -> None:
    """A feed hold where nothing moves would lock the board; a cancelled jog does not."""
    clock = LineClock()
    with grbl_bench(clock) as (axis, device, _):
        axis.home()
        assert axis.safe("hold").verified
        assert axis.read().faults == ()
        before = dict(device.settings)
        axis.spin(60.0, 120.0)
        assert device.settings[120] == 120.0
        clock.sleep(2.0)
        axis.stop()
        axis.settings.put_back()
        assert device.settings == before
        axis.move_to(-30.0, 60.0, 300.0)
        clock.sleep(10.0)
        assert device.plant.state(clock.now())[0] == pytest.approx(-30.0, abs=0.004)


@pytest.mark.parametrize("bench", [grbl_bench, aerosmith_bench])
def test_an_axis_that_moves_takes_another_command(bench: Any) -> None:
    """GRBL shows its settings only while it stands."""
    clock = LineClock()
    with bench(clock) as (axis, device, _):
        axis.home()
        axis.spin(20.0, 200.0)
        clock.sleep(2.0)
        axis.spin(-30.0, 200.0)
        clock.sleep(2.0)
        assert device.plant.state(clock.now())[1] == pytest.approx(-30.0)
        axis.move_to(45.0, 60.0, 200.0)
        clock.sleep(10.0)
        assert axis.read().position_deg == pytest.approx(45.0, abs=0.01)


@pytest.mark.parametrize("bench", [grbl_bench, aerosmith_bench])
def test_a_reply_that_the_host_reads_late_makes_no_rate_too_large(bench: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a device whose position comes with its state, and of one that is asked for it."""
    clock, late = LineClock(), [0.3]
    with bench(clock) as (drive, _, _):
        drive.home()
        drive.spin(100.0, 200.0)
        clock.sleep(2.0)
        ask = drive._ask

        def read_late(question: Any) -> Any:
            reply = ask(question)
            clock.sleep(late[0])
            return reply

        monkeypatch.setattr(drive, "_ask", read_late)
        drive.read()
        late[0] = 0.0
        clock.sleep(0.5)
        assert 50.0 < drive.read().rate_dps < 101.0


def test_a_rate_that_was_lost_lets_no_table_go() -> None:
    clock = LineClock()
    with aerosmith_bench(clock) as (axis, device, _):
        axis.home()
        receive = device.receive
        device.receive = lambda data: (
            [b"\r\n>"] if data.startswith(b"VEL0") or data.startswith(b"VEL5") else receive(data)
        )
        with pytest.raises(NotVerified, match="rate 50"):
            axis.move_to(90.0, 50.0, 100.0)
        assert not device.plant.moving(clock.now())
        device.receive = receive
        axis.move_to(90.0, 50.0, 100.0)
        assert axis.safe("unpower").verified
        assert not device.servo
