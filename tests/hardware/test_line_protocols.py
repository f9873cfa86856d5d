"""Messages of described devices: golden bytes both ways, damage, what a description must have, and linear time.

The messages of the ESPEC are its maker's; of the Thermotron those of PyMeasure's thermotron3800; of the CTS and the
Julabo those that the public packages cts-chamber 0.3 and julabo 2.3 make; of GRBL those of its own documents
(interface.md, jogging.md); of Modbus those of its standard, with checksums that others reckoned.
"""

import itertools
import re
import time
import tomllib
from contextlib import suppress
from unittest.mock import Mock

import pytest
from hardware_bench import chamber_alone
from hypothesis import given
from hypothesis import strategies as st
from simulated_devices.port import SimulatedPort

from gradcal_jax.hardware.clock import RealClock
from gradcal_jax.hardware.description import described, protocol_text, shipped
from gradcal_jax.hardware.drivers.lines import LinesConfig
from gradcal_jax.hardware.drivers.listening import TextUnitConfig
from gradcal_jax.hardware.drivers.registers import Modbus, write_body
from gradcal_jax.hardware.errors import Rejected
from gradcal_jax.hardware.line_protocol import LINES, LineProtocol
from gradcal_jax.hardware.setup import configs_of, open_rig
from gradcal_jax.hardware.templates import formatted, reply_pattern, shows
from gradcal_jax.tables.problems import SpecError

# Question -> its bytes, and the bytes of a reply with the values in it.
ASKED = {
    "espec": {
        "temperature": (
            bytes.fromhex("54 45 4D 50 3F 0D 0A"),
            bytes.fromhex("32 36 2E 34 2C 30 2E 30 2C 31 34 30 2E 30 2C 2D 35 30 2E 30 0D 0A"),
            {"air": "26.4", "setpoint": "0.0", "highest": "140.0", "lowest": "-50.0"},
        ),
    },
    "thermotron-3800": {
        "air": (b"PVAR1?\r", b"22.000\r", {"air": "22.000"}),
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
    },
    "watlow-f4t-scpi": {
        "identity": (
            b"*IDN?\n",
            b"Watlow Electric,F4T1L1EAA2C1AAA,12345,4.07\n",
            {"model": "F4T1L1EAA2C1AAA", "serial": "12345", "firmware": "4.07"},
        ),
        "air": (b":SOURCE:CLOOP1:PVALUE?\n", b"-12.3456\n", {"air": "-12.3456"}),
    },
    "grbl": {
        "status": (
            b"?",
            b"<Jog|MPos:12.345,-10.000,5.000|Bf:15,128|FS:500,8000|WCO:0.000,1.551,5.664>\r\n",
            {"state": "Jog", "position": "12.345"},
        ),
    },
}
TOLD = {
    "espec": {"setpoint": ({"setpoint": 25.0}, [b"TEMP, S25.0\r\n"])},
    "thermotron-3800": {"setpoint": ({"setpoint": 22.5}, [b"SETP1,22.5\r"]), "off": ({}, [b"STOP\r"])},
    "cts": {
        "setpoint": ({"setpoint": -12.3}, [bytes.fromhex("02 81 e1 b0 a0 ad b1 b2 ae b3 c3 03")]),
        "on": ({}, [bytes.fromhex("02 81 f3 b1 a0 b1 d2 03")]),
    },
    "julabo": {"setpoint": ({"setpoint": 34.56}, [b"OUT_SP_00 34.56\r"]), "on": ({}, [b"OUT_MODE_05 1\r"])},
    "watlow-f4t-scpi": {
        "setpoint": (
            {"setpoint": -40.0},
            [b":SOURCE:CLOOP1:RACTION OFF\n", b":SOURCE:CLOOP1:SPOINT -40.00\n"],
        ),
    },
    "grbl": {"home": ({}, [b"$H\n"]), "stop": ({}, [b"\x85"])},
}


@pytest.mark.parametrize("name", ASKED)
def test_golden_messages(name):
    said = described(LineProtocol, name)
    codec = said.line
    for question, (sent, received, values) in ASKED[name].items():
        asked = said.ask[question]
        assert codec.message(asked.send, bare=asked.bare) == sent
        (text,) = codec.texts(received)
        found = reply_pattern(asked.reply[0]).fullmatch(text)
        assert {key: found[key] for key in values} == values
        assert codec.texts(received[:-2]) == []
    for command_name, (given_values, expected) in TOLD[name].items():
        command = said.tell[command_name]
        sends = [formatted(send, given_values)[0] for send in command.send]
        assert [codec.message(send, bare=command.bare) for send in sends] == expected


def test_what_is_a_reply_of_an_espec_and_what_is_not():
    codec = LinesConfig(protocol="espec", changes={"line": {"prefix": "1,"}}).described.line
    assert codec.message("MON?") == b"1,MON?\r\n"
    pattern = reply_pattern(described(LineProtocol, "espec").ask["temperature"].reply[0])
    # Of an old controller: whole degrees, and blanks after commas.
    assert any(map(pattern.fullmatch, codec.texts(b"26, 0, 140, -50\r\n")))
    for frame in (b"26.4,0.0,140.0", b"26.4,,140.0,-50.0", b"nan,0.0,140.0,-50.0", b"2\xb6.4,0,1,2", b"2\x016.4,0,1,2"):
        assert not any(map(pattern.fullmatch, codec.texts(frame + b"\r\n")))


RTU, READ = Modbus(1), bytes.fromhex("03 0064 0001")
READ_PV = bytes.fromhex("01 03 00 64 00 01 C5 D5")
MODBUS_25 = bytes.fromhex("01 03 02 00 FA 38 07")
SETS_25, SETS_MINUS_40 = (write_body(300, bytes.fromhex(data)) for data in ("00FA", "FE70"))
WRITE_25 = bytes.fromhex("01 06 01 2C 00 FA C9 BC")
WRITE_MINUS_40 = bytes.fromhex("01 06 01 2C FE 70 08 7B")
EXCEPTION = bytes.fromhex("01 83 02 C0 F1")


def test_golden_modbus():
    assert RTU.message(READ) == READ_PV
    assert RTU.message(SETS_25) == WRITE_25
    assert RTU.message(SETS_MINUS_40) == WRITE_MINUS_40
    noise = b"\xff\x01\x03\x55\x03\x02"
    for reply in (MODBUS_25, bytes.fromhex("01 03 02 FE 70 F9 C0")):
        assert RTU.reply(noise + reply, READ) == reply[1:-2]
    assert RTU.reply(WRITE_25, SETS_25) is not None
    assert RTU.reply(WRITE_MINUS_40, SETS_25) is None
    assert RTU.reply(WRITE_25, READ) is None
    with pytest.raises(Rejected, match="register address"):
        RTU.reply(EXCEPTION, READ)


def test_golden_modbus_on_tcp():
    """By hand from the protocol's definition: 25.0 is 41C80000, and its low word goes first."""
    tcp, read, write = Modbus(1, tcp=True), bytes.fromhex("03 0B04 0002"), write_body(2782, bytes.fromhex("0000 41C8"))
    assert [tcp.message(read) for _ in range(7)][-1] == bytes.fromhex("0007 0000 0006 01 03 0B04 0002")
    reply = bytes.fromhex("0007 0000 0007 01 03 04 0000 41C8")
    assert tcp.reply(reply, read) == reply[7:]
    with pytest.raises(Rejected, match="register address"):
        tcp.reply(bytes.fromhex("0007 0000 0003 01 83 02"), read)
    assert tcp.message(write) == bytes.fromhex("0008 0000 000B 01 10 0ADE 0002 04 0000 41C8")
    assert tcp.reply(bytes.fromhex("0008 0000 0006 01 10 0ADE 0002"), write) is not None
    assert tcp.reply(bytes.fromhex("0007 0000 0006 01 10 0ADE 0002"), write) is None


@given(st.binary(max_size=300))
def test_no_bytes_make_a_message_of_modbus_raise(anything):
    tcp = Modbus(1, tcp=True)
    tcp.message(READ)
    for modbus, head in ((RTU, b"\x01"), (RTU, b"\x01\x83"), (tcp, b"\0\1\0\0"), (tcp, b"\0\1\0\0\0\2\1")):
        with suppress(Rejected):
            modbus.reply(head + anything, READ)


def test_no_bit_of_a_checked_message_may_be_wrong():
    codec, framed = described(LineProtocol, "cts").line, ASKED["cts"]["temperature"][1]
    frames = [
        (MODBUS_25, 8, lambda frame: RTU.reply(frame, READ)),
        (WRITE_25, 8, lambda frame: RTU.reply(frame, SETS_25)),
        (EXCEPTION, 8, lambda frame: RTU.reply(frame, READ)),
        # The eighth bits are not in its check, and carry nothing.
        (framed, 7, codec.texts),
    ]
    for frame, bits, taken in frames:
        for place, bit in itertools.product(range(len(frame)), range(bits)):
            bad = frame[:place] + bytes([frame[place] ^ 1 << bit]) + frame[place + 1 :]
            assert not taken(bad)


# --------------------------------------------------------------------------------------------------------------- time

NAMES = ["gyro_x", "gyro_y", "gyro_z", "acceleration_x", "acceleration_y", "acceleration_z"]
SENSORS = {
    "padded": "    ".join(f"{{{name}}}" for name in NAMES),
    "commas": ", ".join(f"{{{name}}}" for name in NAMES),
    "texts": "$X, {:text}, {:text}, {:text}, {:text}, {gyro_x}, {:text}, {gyro_y}",
}
MOST_S = 5.0


def sensor(line):
    tables = {"format": "gradcal-text/1", "line": line, "rate": "200 Hz"}
    return TextUnitConfig(protocol=tables).described.decoder()


def damaged(template):
    """10 000 lines with columns of up to 50 blanks, of which each has a character that the template has not."""
    lines = []
    for number in range(10_000):
        wide = " " * (number % 50)
        line = re.sub(r"\{[^}]*\}", f"{wide}-1.25{wide}", template).replace(" ", f"{wide} ")[:4000]
        place = len(line) - number % 3
        lines.append((line[:place] + "#!" + line[place:]).encode("latin-1"))
    return lines


@pytest.mark.parametrize("line", SENSORS.values(), ids=SENSORS)
def test_damaged_lines_of_a_printing_sensor_take_linear_time(line):
    decoder, lines = sensor(line), damaged(line)
    begun = time.process_time()
    for number in range(0, len(lines), 100):
        decoder.push(b"\r\n".join(lines[number : number + 100]) + b"\r\n", 0.0)
    assert time.process_time() - begun < MOST_S
    assert decoder.bad_bytes > 0


@pytest.mark.parametrize("name", shipped(LINES))
def test_damaged_replies_of_every_description_take_linear_time(name):
    protocol = described(LineProtocol, name)
    replies = [reply for of in (*protocol.ask.values(), *protocol.tell.values()) for reply in of.reply]
    patterns = [reply_pattern(reply) for reply in dict.fromkeys(replies)]
    texts = [line.decode("latin-1") for line in damaged(max(replies, key=len))]
    begun = time.process_time()
    for text, pattern in itertools.product(texts, patterns):
        pattern.fullmatch(text)
    assert time.process_time() - begun < MOST_S


def test_columns_that_are_padded_are_read():
    printed = "".join(f"{value:10.3f}" for value in range(1, 7))
    batch = sensor(SENSORS["padded"]).push(f"{printed}\r\n".encode() * 2, 0.0)
    assert batch.gyro_dps.tolist() == [[1.0, 2.0, 3.0]] * 2
    batch = sensor(SENSORS["commas"]).push(b"1,  -2 ,\t3.5 , 4e0, .5,\t6.\n", 0.0)
    assert batch.gyro_dps.tolist() == [[1.0, -2.0, 3.5]]


@given(st.floats(-999.0, 999.0), st.sampled_from(["05.1f", ".2f", ".0f", "g", "07.3f"]))
def test_a_value_that_was_written_is_shown_by_itself_alone(value, spec):
    text, written = formatted(f"a {{setpoint:{spec}}} b", {"setpoint": value})
    assert text == f"a {written['setpoint']} b"
    assert shows(written["setpoint"], written["setpoint"])
    step = 10.0 ** -len(written["setpoint"].partition(".")[2])
    assert not shows(written["setpoint"], f"{float(written['setpoint']) + 2.0 * max(step, 1e-3):.6f}")


# -------------------------------------------------------------------------------------------------------- descriptions


@pytest.mark.parametrize(
    ("name", "change", "expected"),
    [
        ("cts", lambda t: t["tell"].pop("off"), "tell.off: this key is missing; a chamber needs it"),
        ("cts", lambda t: t["ask"].pop("temperature"), "ask.air: this key is missing"),
        ("cts", lambda t: t["limits"].pop("free_ramp"), "limits.free_ramp: this key is missing"),
        ("cts", lambda t: t["tell"]["ramp"].update(shown_by=["up", "side"]), "{side}"),
        ("aerosmith-like", lambda t: t["tell"]["acceleration"].pop("shown_by"), "must be read back"),
        ("aerosmith-like", lambda t: t["state"].pop("powered"), "no reply shows the effect of tell.on"),
        ("grbl", lambda t: t["tell"]["move"].update(send="$J=X{place:.3f}"), "placeholder {place} cannot be used"),
        ("grbl", lambda t: t["tell"]["move"].update(send="$J=X{position!r}"), "expected values in braces, such as"),
        ("grbl", lambda t: t["tell"]["stop"].update(send="\u2126"), "tell.stop.send"),
        ("grbl", lambda t: t["tell"]["move"].update(reply=["ok", "ok"]), "expected one reply"),
        ("grbl", lambda t: t["ask"]["settings"].pop("last"), "the lines of one reply"),
        ("grbl", lambda t: t["units"].update(rate="K/min"), "angular rate"),
        ("julabo", lambda t: t["tell"].update(colour={"send": "RED"}), "tell.colour: is not a command of a chamber"),
        ("julabo", lambda t: t["state"]["conditioning"].update(bit=1), "use exactly one of"),
    ],
)
def test_what_cannot_be_trusted_is_refused(name, change, expected):
    tables = tomllib.loads(protocol_text(name))
    change(tables)
    with pytest.raises(SpecError) as caught:
        described(LineProtocol, tables)
    assert expected in str(caught.value)


def test_a_description_of_the_other_role_is_refused():
    with pytest.raises(SpecError, match="describes an axis"):
        configs_of(chamber_alone("grbl"))


def test_a_line_is_as_the_description_has_it():
    options = {"changes": {"line": {"baudrate": 19200}}}
    with SimulatedPort(Mock(spec=["receive"]), RealClock()) as port:
        rig = chamber_alone("julabo", port=port.url, options=options)
        with open_rig(rig, RealClock()) as bench:
            line = bench.lines["chamber"]._port
            assert (line.bytesize, line.stopbits, line.parity, line.baudrate) == (7, 1, "E", 19200)


@pytest.mark.parametrize("name", shipped(LINES))
def test_a_set_point_starts_no_chamber(name):
    """Somebody who switched a chamber off at its panel finds it off."""
    tell = described(LineProtocol, name).tell
    lines = {what: tell[what].send if what in tell else () for what in ("on", "setpoint")}
    assert not {*lines["on"]} & {*lines["setpoint"]}
