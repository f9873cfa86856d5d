"""Messages of described devices: golden bytes both ways, damage, streams that are cut, what a description must have.

The messages of the ESPEC are its maker's; of the Thermotron those of PyMeasure's thermotron3800; of the CTS and the
Julabo those that the public packages cts-chamber 0.3 and julabo 2.3 make; of GRBL those of its own documents
(interface.md, jogging.md); of Modbus those of its standard, with checksums that others reckoned.
"""

import itertools
import re
import time
import tomllib
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from simulated_devices.port import SimulatedPort

from gradcal_jax.hardware.clock import RealClock
from gradcal_jax.hardware.drivers.lines import Codec, LinesChamber, LinesConfig
from gradcal_jax.hardware.drivers.listening import TextUnitConfig
from gradcal_jax.hardware.errors import ChecksumError, FramingError, HardwareError, Rejected
from gradcal_jax.hardware.framing import (
    LineFramer,
    ModbusReplyFramer,
    ModbusTcpFramer,
    NotThisReply,
    Rtu,
    Tcp,
    parse_words,
    parse_written,
    read_body,
    write_body,
)
from gradcal_jax.hardware.line_protocol import (
    LineProtocol,
    described,
    formatted,
    protocol_text,
    reply_pattern,
    shipped,
    shows,
)
from gradcal_jax.hardware.setup import DRIVERS, configs_of, driver_of, open_rig
from gradcal_jax.hardware.text_unit import TextUnitDecoder
from gradcal_jax.spec.rig import rig_of
from gradcal_jax.tables.problems import SpecError

# Question or command -> its bytes, and the bytes of a reply with the values in it.
ASKED: dict[str, dict[str, tuple[bytes, bytes, dict[str, str]]]] = {
    "espec": {
        "temperature": (
            bytes.fromhex("54 45 4D 50 3F 0D 0A"),
            bytes.fromhex("32 36 2E 34 2C 30 2E 30 2C 31 34 30 2E 30 2C 2D 35 30 2E 30 0D 0A"),
            {"air": "26.4", "setpoint": "0.0", "highest": "140.0", "lowest": "-50.0"},
        ),
    },
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
    },
    "watlow-f4t-scpi": {
        "identity": (
            b"*IDN?\n",
            b"Watlow Electric,F4T1L1EAA2C1AAA,12345,4.07\n",
            {"model": "F4T1L1EAA2C1AAA", "serial": "12345", "firmware": "4.07"},
        ),
        "air": (b":SOURCE:CLOOP1:PVALUE?\n", b"-12.3456\n", {"air": "-12.3456"}),
        "event": (b":OUTPUT1:STATE?\n", b"ON\n", {"event": "ON"}),
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
    "espec": {"setpoint": ({"setpoint": 25.0}, [b"TEMP, S25.0\r\n"])},
    "thermotron-3800": {
        "setpoint": ({"setpoint": 22.5}, [b"SETP1,22.5\r", b"RUNM\r"]),
        "off": ({}, [b"STOP\r"]),
    },
    "cts": {
        "setpoint": ({"setpoint": -12.3}, [bytes.fromhex("02 81 e1 b0 a0 ad b1 b2 ae b3 c3 03")]),
        "on": ({}, [bytes.fromhex("02 81 f3 b1 a0 b1 d2 03")]),
    },
    "julabo": {"setpoint": ({"setpoint": 34.56}, [b"OUT_SP_00 34.56\r"]), "on": ({}, [b"OUT_MODE_05 1\r"])},
    "watlow-f4t-scpi": {
        "setpoint": (
            {"setpoint": -40.0},
            [b":OUTPUT1:STATE ON\n", b":SOURCE:CLOOP1:RACTION OFF\n", b":SOURCE:CLOOP1:SPOINT -40.00\n"],
        ),
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
        assert [codec.message(formatted(send, values_)[0], bare=command.bare) for send in command.send] == sent_


def test_an_espec_refuses_and_writes_numbers_as_numbers() -> None:
    codec = Codec(LinesConfig(protocol="espec", changes={"line": {"prefix": "1,"}}).described)
    assert codec.message("MON?") == b"1,MON?\r\n"
    for refused in (b"NA:DATA OUT OF RANGE", b"NA:CMD ERR"):
        with pytest.raises(Rejected, match=refused[3:].decode()):
            codec.text(refused)
    (form,) = described(LineProtocol, "espec").ask["temperature"].reply
    pattern = reply_pattern(form)
    for frame in (b"26.4,0.0,140.0", b"26.4,,140.0,-50.0", b"nan,0.0,140.0,-50.0", b"2\xb6.4,0,1,2", b"2\x016.4,0,1,2"):
        with suppress(FramingError):
            assert pattern.fullmatch(codec.text(frame)) is None


RTU, TCP = Rtu(1), Tcp(1)
READ_PV = bytes.fromhex("01 03 00 64 00 01 C5 D5")
MODBUS_25 = bytes.fromhex("01 03 02 00 FA 38 07")
WRITE_25 = bytes.fromhex("01 06 01 2C 00 FA C9 BC")
WRITE_MINUS_40 = bytes.fromhex("01 06 01 2C FE 70 08 7B")
EXCEPTION = bytes.fromhex("01 83 02 C0 F1")


def words_in(frame: bytes) -> tuple[int, ...]:
    return parse_words(RTU, frame, READ_PV, 1)


def test_golden_modbus() -> None:
    assert RTU.message(read_body(100)) == READ_PV
    assert RTU.message(write_body(300, (250,))) == WRITE_25
    assert RTU.message(write_body(300, (-400,))) == WRITE_MINUS_40
    assert words_in(MODBUS_25) == (250,)
    assert words_in(bytes.fromhex("01 03 02 FE 70 F9 C0")) == (65536 - 400,)
    parse_written(RTU, WRITE_25, WRITE_25)
    with pytest.raises(FramingError):
        parse_written(RTU, WRITE_MINUS_40, WRITE_25)
    with pytest.raises(Rejected, match="register address"):
        words_in(EXCEPTION)
    with pytest.raises(NotThisReply):
        words_in(WRITE_25)


def test_golden_modbus_on_tcp() -> None:
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


# ------------------------------------------------------------------------------------------------------------- damage


def taken(framer: Any, parse: Callable[[bytes], object], stream: bytes) -> list[object]:
    """What a driver would take from a stream: the messages that its framer and parser let through."""
    found: list[object] = []
    for frame in framer.push(stream):
        with suppress(HardwareError, NotThisReply):
            found.append(parse(frame))
    return found


CTS = Codec(described(LineProtocol, "cts"))
CHECKED: dict[str, tuple[Callable[[], Any], Callable[[bytes], object], bytes, int]] = {
    "reply": (partial(ModbusReplyFramer, 1), words_in, MODBUS_25, 8),
    "echo": (partial(ModbusReplyFramer, 1), lambda frame: parse_written(RTU, frame, WRITE_25), WRITE_25, 8),
    # The eighth bits are not in its check, and carry nothing.
    "cts": (CTS.framer, CTS.text, ASKED["cts"]["temperature"][1], 7),
}


@pytest.mark.parametrize("name", CHECKED)
def test_no_bit_of_a_checked_message_may_be_wrong(name: str) -> None:
    framer, parse, frame, bits = CHECKED[name]
    assert len(taken(framer(), parse, frame)) == 1
    for place, bit in itertools.product(range(len(frame)), range(bits)):
        bad = frame[:place] + bytes([frame[place] ^ 1 << bit]) + frame[place + 1 :]
        assert taken(framer(), parse, bad) == []
    for bit in range(8 * len(EXCEPTION)):
        bad = bytearray(EXCEPTION)
        bad[bit // 8] ^= 1 << bit % 8
        for reply in ModbusReplyFramer(1).push(bytes(bad)):
            with pytest.raises((ChecksumError, NotThisReply)):
                words_in(reply)


def streams() -> Iterator[tuple[Any, list[bytes], bytes]]:
    """Framers, messages, and noise that may come before the first."""
    lines = [f"{number}.5,0.0".encode() for number in range(5)]
    yield LineFramer(b"\r\n"), [line + b"\r\n" for line in lines], b"\x00\xff\r\n"
    yield ModbusReplyFramer(1), [MODBUS_25] * 3, b"\xff\x02\x55\x03\x02"
    yield ModbusTcpFramer(), [Tcp(1).message(bytes(range(length))) for length in (2, 9, 30)], b""


@settings(max_examples=60, deadline=None)
@given(st.lists(st.integers(0, 10_000), max_size=12), st.binary(max_size=40))
def test_messages_do_not_depend_on_how_the_stream_was_cut(cuts: list[int], anything: bytes) -> None:
    for framer, messages, noise in streams():
        stream = noise + b"".join(messages)
        ends = [0, *sorted(cut % (len(stream) + 1) for cut in cuts), len(stream)]
        found = [frame for a, b in itertools.pairwise(ends) for frame in framer.push(stream[a:b])]
        assert [frame.removesuffix(b"\r\n") for frame in found][-len(messages) :] == [
            message.removesuffix(b"\r\n") for message in messages
        ]
    # Of anything at all nothing is raised but what says so, and what is kept is bounded.
    framer = ModbusTcpFramer()
    framer.push(anything)
    assert len(framer._buffer) < 300
    sent = TCP.message(read_body(2820, 2))
    for frame in ModbusTcpFramer().push(sent[:2] + bytes(2) + anything):
        with suppress(FramingError, NotThisReply, Rejected):
            parse_words(TCP, frame, sent, 2)


def test_truncated_messages_stay_pending_and_overlong_ones_are_dropped_up_to_their_end() -> None:
    for length in range(len(MODBUS_25)):
        assert ModbusReplyFramer(1).push(MODBUS_25[:length]) == []
    framer = LineFramer(b"\r\n")
    assert framer.push(b"x" * 4090) == []
    assert framer.push(b"x" * 15 + b"\r") == []
    assert framer.push(b"\nnext\r\n") == [b"next"]


NAMES = ["gyro_x", "gyro_y", "gyro_z", "acceleration_x", "acceleration_y", "acceleration_z"]
SENSORS = {
    "blanks": " ".join(f"{{{name}}}" for name in NAMES),
    "padded": "    ".join(f"{{{name}}}" for name in NAMES),
    "commas": ", ".join(f"{{{name}}}" for name in NAMES),
    "texts": "$X, {:text}, {:text}, {:text}, {:text}, {gyro_x}, {:text}, {gyro_y}",
}
MOST_S = 5.0


def sensor(line: str) -> TextUnitDecoder:
    tables: dict[str, Any] = {"format": "gradcal-text/1", "line": line, "rate": "200 Hz"}
    return TextUnitDecoder(TextUnitConfig(protocol=tables).described)


def damaged(template: str) -> list[bytes]:
    """10 000 lines with columns of up to 50 blanks, of which each has a character that the template has not."""
    lines: list[bytes] = []
    for number in range(10_000):
        wide = " " * (number % 50)
        line = re.sub(r"\{[^}]*\}", f"{wide}-1.25{wide}", template).replace(" ", f"{wide} ")[:4000]
        place = len(line) - number % 3
        lines.append((line[:place] + "#!" + line[place:]).encode("latin-1"))
    return lines


@pytest.mark.parametrize("line", SENSORS.values(), ids=SENSORS)
def test_damaged_lines_of_a_printing_sensor_take_linear_time(line: str) -> None:
    decoder, lines = sensor(line), damaged(line)
    begun = time.process_time()
    for number in range(0, len(lines), 100):
        decoder.push(b"\r\n".join(lines[number : number + 100]) + b"\r\n", 0.0)
    assert time.process_time() - begun < MOST_S
    assert decoder.bad_bytes > 0


@pytest.mark.parametrize("name", shipped())
def test_damaged_replies_of_every_description_take_linear_time(name: str) -> None:
    protocol = described(LineProtocol, name)
    replies = [reply for of in (*protocol.ask.values(), *protocol.tell.values()) for reply in of.reply]
    patterns = [reply_pattern(reply) for reply in dict.fromkeys(replies)]
    texts = [line.decode("latin-1") for line in damaged(max(replies, key=len))]
    begun = time.process_time()
    for text, pattern in itertools.product(texts, patterns):
        pattern.fullmatch(text)
    assert time.process_time() - begun < MOST_S


@settings(deadline=None)
@given(st.text(max_size=60), st.text(max_size=4000))
def test_no_template_makes_a_reply_cost_more_than_its_length(template: str, reply: str) -> None:
    began = time.thread_time()
    reply_pattern(template).fullmatch(reply)
    assert time.thread_time() - began < 1.0


def test_columns_that_are_padded_are_read() -> None:
    for line in (SENSORS["blanks"], SENSORS["padded"]):
        printed = "".join(f"{value:10.3f}" for value in range(1, 7))
        batch = sensor(line).push(f"{printed}\r\n".encode() * 2, 0.0)
        assert batch.gyro_dps.tolist() == [[1.0, 2.0, 3.0]] * 2
    batch = sensor(SENSORS["commas"]).push(b"1,  -2 ,\t3.5 , 4e0, .5,\t6.\n", 0.0)
    assert batch.gyro_dps.tolist() == [[1.0, -2.0, 3.5]]


@given(st.floats(-999.0, 999.0), st.sampled_from(["05.1f", ".2f", ".0f", "g", "07.3f"]))
def test_a_value_that_was_written_is_shown_by_itself_alone(value: float, spec: str) -> None:
    text, written = formatted(f"a {{setpoint:{spec}}} b", {"setpoint": value})
    assert text == f"a {written['setpoint']} b"
    assert shows(written["setpoint"], written["setpoint"])
    step = 10.0 ** -len(written["setpoint"].partition(".")[2])
    assert not shows(written["setpoint"], f"{float(written['setpoint']) + 2.0 * max(step, 1e-3):.6f}")


# -------------------------------------------------------------------------------------------------------- descriptions


@pytest.mark.parametrize("name", shipped())
def test_a_protocol_of_at_most_sixty_lines_and_its_rig(name: str) -> None:
    assert len(protocol_text(name).splitlines()) <= 60
    config = LinesConfig(protocol=tomllib.loads(protocol_text(name)))
    device: dict[str, Any] = {"driver": "lines", "port": "COM1", "safe": "hold", "options": {"protocol": name}}
    axis = {"axis": [{**device, "name": "a", "gravity_loaded": False}]}
    own, other = ({"chamber": device}, axis) if config.described.role == "chamber" else (axis, {"chamber": device})
    configs_of(rig_of({"format": "gradcal-rig/1", **own}))
    with pytest.raises(SpecError, match=f"describes an? {config.described.role}; expected"):
        configs_of(rig_of({"format": "gradcal-rig/1", **other}))


@pytest.mark.parametrize(
    ("name", "change", "expected"),
    [
        ("thermotron-3800", lambda t: t["tell"]["ramp"].pop("shown_by"), "must be read back"),
        ("thermotron-3800", lambda t: t["ask"].pop("setpoint"), "{setpoint}"),
        ("thermotron-3800", lambda t: t["ask"].pop("mode"), "no reply has the field {mode}"),
        ("thermotron-3800", lambda t: t["limits"].pop("free_ramp"), "limits.free_ramp: this key is missing"),
        ("cts", lambda t: t["tell"]["ramp"].update(shown_by=["up", "side"]), "{side}"),
        ("cts", lambda t: t["ask"]["temperature"].update(reply="{air}.{setpoint}"), "a number ends at a character"),
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
    tables = tomllib.loads(protocol_text(name))
    change(tables)
    with pytest.raises(SpecError) as caught:
        described(LineProtocol, tables)
    assert expected in str(caught.value)


def rig_with(driver: str, options: dict[str, Any], port: str = "COM1") -> Any:
    # Lines are as a protocol has them: of a bath, here.
    text = {"format": "gradcal-text/1", "line": "{gyro_x}", "rate": "100 Hz"}
    protocols = {"lines": "julabo", "registers": "watlow-f4", "text_unit": text, "frames": "stim300"}
    entry: dict[str, Any] = {"driver": driver, "port": port, "options": {"protocol": protocols[driver]} | options}
    if driver_of(driver).role == "imu":
        return rig_of({"format": "gradcal-rig/1", "imu": [{**entry, "name": "a"}]})
    return rig_of({"format": "gradcal-rig/1", "chamber": {**entry, "safe": "hold"}})


@pytest.mark.parametrize("driver", [name for name in DRIVERS if name != "operator"])
def test_every_serial_device_has_the_settings_of_its_line(driver: str) -> None:
    configs_of(rig_with(driver, {"bytesize": 7, "parity": "E", "stopbits": 2}))
    for name, wrong in (("parity", "X"), ("stopbits", 3), ("bytesize", "8")):
        with pytest.raises(SpecError, match=name):
            configs_of(rig_with(driver, {name: wrong}))


class Silent:
    def receive(self, data: bytes) -> list[bytes]:
        return []


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({}, (7, 1, "E", 4800)),
        ({"parity": "N", "baudrate": 19200}, (7, 1, "N", 19200)),
        ({"protocol": "espec", "stopbits": 2}, (8, 2, "N", 9600)),
    ],
)
def test_a_line_is_as_the_protocol_has_it_unless_the_rig_file_says_otherwise(options: Any, expected: Any) -> None:
    clock = RealClock()
    with SimulatedPort(Silent(), clock) as port, open_rig(rig_with("lines", options, port.url), clock) as bench:
        assert isinstance(bench.chamber, LinesChamber)
        line = bench.chamber._exchange.transport._port
        assert (line.bytesize, line.stopbits, line.parity, line.baudrate) == expected
