"""Golden vectors both ways, and what damage does to them: no protocol with a check accepts a damaged message."""

import itertools
from collections.abc import Callable
from contextlib import suppress
from functools import partial

import hardware_golden as golden
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gradcal_jax.hardware import checksums
from gradcal_jax.hardware.drivers import lines, odrive, stim300, text_unit, vectornav, weiss, zaber
from gradcal_jax.hardware.drivers.stim300 import LAYOUTS, Stim300Decoder
from gradcal_jax.hardware.errors import ChecksumError, FramingError, HardwareError, LimitExceeded, Rejected
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
from gradcal_jax.hardware.line_protocol import formatted, reply_pattern
from gradcal_jax.hardware.roles import ImuBatch

# --- checksums -------------------------------------------------------------------------------------------------------


def test_published_check_values() -> None:
    assert checksums.crc32_mpeg2(b"123456789") == 0x0376E6E7
    assert checksums.crc16_modbus(b"123456789") == (0x4B37).to_bytes(2, "little")
    assert checksums.crc32_mpeg2(b"\xaf" + bytes(59)) == 0xFDFEE62C


@given(st.binary(max_size=80))
def test_crc32_equals_its_definition_bit_by_bit(data: bytes) -> None:
    register = 0xFFFFFFFF
    for byte in data:
        register ^= byte << 24
        for _ in range(8):
            register = (register << 1 ^ 0x04C11DB7 if register & 1 << 31 else register << 1) & 0xFFFFFFFF
    assert checksums.crc32_mpeg2(data) == register


@settings(deadline=None)  # a table of each length is made once
@given(st.integers(0, 9), st.sampled_from([1, 11, 38, 60]), st.randoms())
def test_crc32_of_rows_is_that_of_each(count: int, length: int, random) -> None:
    rows = np.frombuffer(random.randbytes(count * length), np.uint8).reshape(count, length)
    assert checksums.crc32_mpeg2_of_rows(rows).tolist() == [checksums.crc32_mpeg2(row.tobytes()) for row in rows]


# --- ESPEC ------------------------------------------------------------------------------------------------------------

ESPEC = lines.EspecConfig().described
ESPEC_LINES = lines.Codec(ESPEC)


def espec_temperatures(frame: bytes) -> dict[str, float]:
    (form,) = ESPEC.ask["temperature"].reply
    match = reply_pattern(form).fullmatch(ESPEC_LINES.text(frame))
    if match is None:
        raise FramingError("no four temperatures")
    return {name: float(text) for name, text in match.groupdict().items()}


def test_espec_golden_vectors() -> None:
    for command, (sent, _) in golden.ESPEC.items():
        assert ESPEC_LINES.message(command) == sent
    assert ESPEC_LINES.message(ESPEC.ask["temperature"].send) == golden.ESPEC_HEX[0]
    on_a_bus = lines.EspecConfig(changes={"line": {"prefix": "1,"}}).described
    assert lines.Codec(on_a_bus).message("MON?") == b"1,MON?\r\n"
    reply = {command: LineFramer(b"\r\n").push(received)[0] for command, (_, received) in golden.ESPEC.items()}
    assert golden.ESPEC_HEX[1] == reply["TEMP?"] + b"\r\n"
    expected = {"air": 26.4, "setpoint": 0.0, "highest": 140.0, "lowest": -50.0}
    assert espec_temperatures(reply["TEMP?"]) == expected
    forms = [reply_pattern(form).fullmatch(ESPEC_LINES.text(reply["TYPE?"])) for form in ESPEC.ask["identity"].reply]
    assert [match["model"] for match in forms if match] == ["S2"]
    (acknowledged,) = (reply_pattern(form) for form in ESPEC.tell["setpoint"].reply)
    for text in (ESPEC_LINES.text(reply["TEMP, S25.0"]), "OK : 1, TEMP, S25.0"):
        assert acknowledged.fullmatch(text)
    assert formatted(ESPEC.tell["setpoint"].send[0], {"setpoint": 25.0})[0] == "TEMP, S25.0"
    for refused, code in (("TEMP, S200.0", "DATA OUT OF RANGE"), ("XYZ", "CMD ERR")):
        with pytest.raises(Rejected) as caught:
            ESPEC_LINES.text(reply[refused])
        assert code in str(caught.value)


@pytest.mark.parametrize(
    "frame", [b"26.4,0.0,140.0", b"26.4,,140.0,-50.0", b"nan,0.0,140.0,-50.0", b"2\xb6.4,0,1,2", b"2\x016.4,0,1,2"]
)
def test_espec_reads_no_temperature_that_is_not_written_as_one(frame: bytes) -> None:
    with pytest.raises(FramingError):
        espec_temperatures(frame)


# --- Weiss ------------------------------------------------------------------------------------------------------------

PAIRS_14 = weiss.Layout(
    ("CV01", "CV01", "CV02", "CV02", "SV01", "SV01", *("MV01", "MV01", "MV02", "MV02", "MV03", "MV03", "MV04", "MV04")),
    ("CV01", "CV02", "SV01", "MV01", "MV02", "MV03", "MV04"),
    "CV01",
    -72.0,
    182.0,
    {},
)


def test_weiss_golden_vectors() -> None:
    for value, text in golden.WEISS_NUMBERS.items():
        assert weiss.value_text(value) == text
    with pytest.raises(LimitExceeded):
        weiss.value_text(123456.0)
    assert weiss.request(0, "I") == golden.WEISS_READ[0]
    assert weiss.request(1, "I") == golden.WEISS_READ_HELP[0]
    assert weiss.request(1, "U", "0001.1 0000.0 0000.0 0000.0") == golden.WEISS_GRADIENT
    record = weiss.parse_record(LineFramer(b"\r").push(golden.WEISS_READ[1])[0], PAIRS_14)
    assert record.numbers[PAIRS_14.nominal("CV01")] == 23.0
    assert record.numbers[PAIRS_14.actual("CV01")] == 20.5
    assert record.numbers[PAIRS_14.actual("MV03")] == 20.3
    # The manual's write differs from the manual's read in temperature only: everything else is written back.
    body = weiss.write_body(record, temperature_c=-40.0, start=True, start_channel=1)
    assert weiss.request(0, "E", body) == golden.WEISS_WRITE
    stopped = weiss.write_body(record, temperature_c=-40.0, start=False, start_channel=1)
    assert stopped.split()[:-1] == body.split()[:-1]
    assert stopped.split()[-1] == "0" + "0" + body.split()[-1][2:]


NEW_FIRMWARE = """ASCII-2 PROTOCOL CONFIGURATION\r
Configuration type: DYNAMIC\r
E-String:\r
$01E CV01 CV02 SV01 SV02 SV03 DO00DO01DO02DO03DO04DO05DO06DO07DO08DO09DO10DO11DO\r
12DO13DO14DO15DO16DO17DO18DO19DO20DO21DO22DO23DO24DO25DO26DO27DO28DO29DO30DO31\r
I-String:\r
CV01 CV01 CV02 CV02 SV01 SV02 SV03 MV01 MV02 MV03 MV04 DO00DO01DO02DO03DO04DO05DO\r
06DO07DO08DO09DO10DO11DO12DO13DO14DO15DO16DO17DO18DO19DO20DO21DO22DO23DO24DO25DO26DO27DO28DO29DO30DO31\r
CV01  value min: -72.0 value max: 182.0 Temperature\r
CV02  value min: 0.0 value max: 98.0 Humidity\r
SV01  value min: 25 value max: 100 Option\r
DO00 unused\r
DO01 Start\r
DO06 Cond.protect\r
"""


def test_weiss_description_with_names_broken_over_lines() -> None:
    layout = weiss.parse_description(NEW_FIRMWARE)
    assert layout.read == ("CV01", "CV01", "CV02", "CV02", "SV01", "SV02", "SV03", "MV01", "MV02", "MV03", "MV04")
    assert layout.write == ("CV01", "CV02", "SV01", "SV02", "SV03")
    assert (layout.temperature, layout.lowest_c, layout.highest_c) == ("CV01", -72.0, 182.0)
    assert layout.names["DO01"] == "Start"
    assert (layout.nominal("CV01"), layout.actual("CV01"), layout.nominal("SV02")) == (0, 1, 5)


def test_weiss_description_with_humidity_first_and_spaced_names() -> None:
    spaced = " ".join(f"DO{i:02d}" for i in range(32))
    text = (
        f"E-String\rCV01 CV02 MV01 {spaced}\rI-String\rCV01 CV01 CV02 CV02 MV01 MV01 {spaced}\r"
        "CV01 value min: 10.0 value max: 98.0 Humidity\r"
        "CV02 value min: -40.0 value max: 180.0 Temperature\rDO01 Start\r"
    )
    layout = weiss.parse_description(text)
    assert (layout.temperature, layout.nominal("CV02"), layout.actual("CV02")) == ("CV02", 2, 3)


@pytest.mark.parametrize("text", ["", "Hello", "E-String\rCV01\rI-String\rCV01 CV01\rCV01 Humidity\r"])
def test_weiss_description_that_says_too_little_is_refused_with_the_remedy(text: str) -> None:
    with pytest.raises(FramingError, match="rig file"):
        weiss.parse_description(text)


def test_weiss_record_of_another_layout_is_refused() -> None:
    frame = golden.WEISS_READ[1].rstrip(b"\r")
    for damaged in (frame[:-1], frame.replace(b" 0020.4", b""), frame.replace(b"0020.5", b"0O20.5"), b"0"):
        with pytest.raises(FramingError):
            weiss.parse_record(damaged, PAIRS_14)


# --- Watlow F4 --------------------------------------------------------------------------------------------------------


RTU = Rtu(1)


def words_in(frame: bytes) -> tuple[int, ...]:
    return parse_words(RTU, frame, golden.MODBUS_READ_PV, 1)


def test_modbus_golden_vectors() -> None:
    assert RTU.message(read_body(100)) == golden.MODBUS_READ_PV
    assert RTU.message(read_body(200)) == golden.MODBUS_STATUS
    assert RTU.message(write_body(300, (250,))) == golden.MODBUS_WRITE_25
    assert RTU.message(write_body(300, (-400,))) == golden.MODBUS_WRITE_MINUS_40
    assert RTU.message(write_body(1217, (1,))) == golden.MODBUS_TERMINATE
    assert words_in(golden.MODBUS_25) == (250,)
    assert words_in(golden.MODBUS_MINUS_40) == (65536 - 400,)
    parse_written(RTU, golden.MODBUS_WRITE_25, golden.MODBUS_WRITE_25)
    with pytest.raises(FramingError):
        parse_written(RTU, golden.MODBUS_WRITE_MINUS_40, golden.MODBUS_WRITE_25)
    with pytest.raises(Rejected, match="register address"):
        words_in(golden.MODBUS_EXCEPTION)
    with pytest.raises(NotThisReply):
        words_in(golden.MODBUS_WRITE_25)


# --- Zaber ------------------------------------------------------------------------------------------------------------


def test_zaber_golden_vectors() -> None:
    for parts, sent in golden.ZABER_COMMANDS.items():
        assert zaber.command(*parts) == sent
    first, numbered, _, refused = (zaber.parse_reply(text, demand_checksum=True) for text in golden.ZABER_REPLIES)
    assert (first.device, first.axis, first.message_id, first.accepted, first.data) == (1, 0, None, True, "0")
    assert (numbered.axis, numbered.message_id, numbered.data) == (3, 9, "0")
    assert (refused.accepted, refused.warning, refused.data) == (False, "WR", "BADCOMMAND")
    for text in golden.ZABER_UNASKED:
        with pytest.raises(NotThisReply):
            zaber.parse_reply(text, demand_checksum=False)
    assert zaber.parse_reply(b"@01 0 12 OK IDLE -- 0", demand_checksum=False).message_id == 12
    with pytest.raises(ChecksumError):
        zaber.parse_reply(b"@01 0 12 OK IDLE -- 0", demand_checksum=True)


# --- ODrive -----------------------------------------------------------------------------------------------------------


def test_odrive_golden_vectors() -> None:
    for words, sent in golden.ODRIVE_REQUESTS.items():
        assert odrive.request(words) == sent + b"\n"
    assert odrive.parse_numbers(golden.ODRIVE_REPLIES[0], 2) == [0.0, 0.0]
    assert odrive.parse_numbers(golden.ODRIVE_REPLIES[1], 2) == [0.25, 0.0]
    assert odrive.parse_numbers(golden.ODRIVE_REPLIES[2]) == [24.087744]
    assert odrive.request(f"v 0 {odrive.decimal(10 / 360)}") == golden.ODRIVE_REQUESTS["v 0 0.0277778"] + b"\n"
    with pytest.raises(ChecksumError):
        odrive.parse_numbers(b"0.250000 0.000000", 2)
    with pytest.raises(Rejected):
        odrive.parse_line(b"unknown command*%d" % checksums.xor8(b"unknown command"))


# --- STIM300 ----------------------------------------------------------------------------------------------------------


def test_stim300_real_frame() -> None:
    batch = Stim300Decoder(sample_rate_hz=1000.0).push(golden.STIM300_REAL, 3.0)
    assert len(batch) == 1
    assert batch.gyro_dps[0].tolist() == [0.017822265625, -0.0806884765625, 0.05242919921875]
    np.testing.assert_allclose(batch.acceleration_g[0], [-0.011890411, -0.016986847, 1.013828278], atol=5e-10)
    assert batch.temperature_c[0].tolist() == [35.625, 35.75, 35.625]
    assert (batch.host_time_s[0], batch.status[0]) == (3.0, 0)


def test_stim300_computed_frames_and_lengths() -> None:
    for frame in golden.STIM300_FRAMES:
        assert LAYOUTS[frame[0]].length == len(frame)
    batch = Stim300Decoder().push(golden.STIM300_A5, 0.0)
    assert batch.gyro_dps[0].tolist() == [1.0, -0.5, 0.25]
    assert batch.acceleration_g[0].tolist() == [0.0, 0.0, 1.0]
    assert batch.temperature_c[0].tolist() == [25.5, 25.5, 25.5]
    assert [LAYOUTS[i].length for i in (0x90, 0xF0, 0x94, 0xF4, 0xA6, 0xF6, 0xA7, 0xF7, 0x97 + 1)] == [
        *(18, 22, 25, 29, 42, 46, 59, 63, 22)
    ]


def test_stim300_utility_golden_vectors() -> None:
    for words, sent in golden.STIM300_UTILITY_REQUESTS.items():
        if sent is not None:
            assert stim300.utility_request(*words) == sent.encode() + b"\r"
    for text in golden.STIM300_UTILITY_REPLIES:
        name, fields = stim300.parse_utility(text.encode())
        assert [name, "0", *fields] == text[1:].split(",")[:-1]
    for text in golden.STIM300_UTILITY_REFUSALS:
        with pytest.raises(Rejected):
            stim300.parse_utility(text.encode())


def test_stim300_line_that_is_too_slow_is_refused_before_anything_is_lost() -> None:
    stim300.Stim300Config(baudrate=921600, sample_rate_hz=1000.0)
    with pytest.raises(ValueError, match="lose datagrams without notice"):
        stim300.Stim300Config(baudrate=460800, sample_rate_hz=2000.0)


# --- VectorNav --------------------------------------------------------------------------------------------------------


def test_vectornav_golden_vectors() -> None:
    for words, sent in golden.VECTORNAV_REQUESTS.items():
        assert vectornav.request(words) == sent.encode() + b"\r\n"
    for line in golden.VECTORNAV_LINES:
        assert ",".join(vectornav.parse_line(line.encode())) == line[1:].rpartition("*")[0]
    with pytest.raises(Rejected, match="baud rate too low"):
        vectornav.parse_line(golden.VECTORNAV_ERROR.encode())
    for packet in golden.VECTORNAV_PACKETS:
        assert checksums.crc16_vectornav(packet[1:]) == 0
        # Packets of outputs that the driver has not asked for are noise.
        own = packet == golden.VECTORNAV_IMU
        assert vectornav.VectorNavFramer().push(packet) == ([packet] if own else [])
    batch = vectornav.VectorNavDecoder(sample_rate_hz=200.0).push(golden.VECTORNAV_IMU, 0.0)
    assert batch.device_time_s.tolist() == [1.0]
    np.testing.assert_allclose(batch.gyro_dps[0], np.degrees([0.01, -0.02, 0.03]), rtol=1e-6)
    np.testing.assert_allclose(batch.acceleration_g[0] * 9.80665, [0.1, -0.2, -9.80665], rtol=1e-6)
    assert batch.temperature_c[0].tolist() == [25.5] * 3


def test_vectornav_lines_are_a_unit_of_text() -> None:
    fields = ["{}"] * 3 + [f"{{acceleration_{a}}}" for a in "xyz"] + [f"{{gyro_{a}}}" for a in "xyz"]
    line = ",".join(["$VNIMU", *fields, "{temperature}", "{}"])
    described = {"format": "gradcal-text/1", "line": line, "rate": "100 Hz", "gyro": "rad/s", "checksum": "xor8"}
    decoder = text_unit.decoder_of(text_unit.TextUnitConfig(described), {})
    batch = decoder.push(golden.VECTORNAV_LINES[5].encode() + b"\r\n", 0.0)
    np.testing.assert_allclose(batch.gyro_dps[0], np.degrees([-0.000018, 0.001122, -0.000551]))
    np.testing.assert_allclose(batch.acceleration_g[0] * 9.80665, [-1.258, -0.1, -9.701])


# --- damage: every single bit of every golden message -----------------------------------------------------------------


def flips(frame: bytes) -> list[bytes]:
    return [frame[:i] + bytes([frame[i] ^ 1 << bit]) + frame[i + 1 :] for i in range(len(frame)) for bit in range(8)]


def accepted_text(framer: object, parse: object, stream: bytes) -> list[object]:
    """What a driver would take from a stream: the messages that its framer and parser let through."""
    taken = []
    for frame in framer.push(stream):  # type: ignore[attr-defined]
        try:
            taken.append(parse(frame))  # type: ignore[operator]
        except (HardwareError, NotThisReply):
            continue
    return taken


LINES = partial(LineFramer, b"\r\n")
CHECKED: list[tuple[Callable[[], object], Callable[..., object], bytes]] = [
    *((LINES, partial(zaber.parse_reply, demand_checksum=True), text + b"\r\n") for text in golden.ZABER_REPLIES),
    *((LINES, odrive.parse_line, text + b"\r\n") for text in golden.ODRIVE_REPLIES),
    *((partial(ModbusReplyFramer, 1), words_in, frame) for frame in (golden.MODBUS_25, golden.MODBUS_MINUS_40)),
    *(
        (partial(LineFramer, b"\r"), stim300.parse_utility, text.encode() + b"\r")
        for text in golden.STIM300_UTILITY_REPLIES
    ),
    *((vectornav.VectorNavFramer, vectornav.parse_line, text.encode() + b"\r\n") for text in golden.VECTORNAV_LINES),
]


@pytest.mark.parametrize(("framer", "parse", "frame"), CHECKED)
def test_no_flipped_reply_is_accepted(framer: Callable[[], object], parse: Callable[..., object], frame: bytes) -> None:
    assert len(accepted_text(framer(), parse, frame)) == 1
    assert [bad for bad in flips(frame) if accepted_text(framer(), parse, bad)] == []


def test_no_flipped_modbus_echo_or_exception_is_accepted() -> None:
    sent = golden.MODBUS_WRITE_25
    for bad in flips(sent):
        assert accepted_text(ModbusReplyFramer(1), lambda reply: parse_written(RTU, reply, sent), bad) == []
    for bad in flips(golden.MODBUS_EXCEPTION):
        for frame in ModbusReplyFramer(1).push(bad):
            with pytest.raises((ChecksumError, NotThisReply)):
                words_in(frame)


@pytest.mark.parametrize("frame", golden.STIM300_FRAMES)
def test_no_flipped_stim300_datagram_is_accepted(frame: bytes) -> None:
    for bad in flips(frame):
        assert len(Stim300Decoder().push(bad + bytes(80), 0.0)) == 0


@pytest.mark.parametrize("frame", golden.VECTORNAV_PACKETS)
def test_no_flipped_vectornav_packet_is_accepted(frame: bytes) -> None:
    for bad in flips(frame):
        assert vectornav.VectorNavFramer().push(bad + bytes(600)) == []


def test_flipped_espec_replies_keep_their_form_or_are_refused() -> None:
    """There is no checksum: what a flip can do is counted here, and plausibility and read-back must catch it."""
    frame = golden.ESPEC["TEMP?"][1]
    taken = [x for bad in flips(frame) for x in accepted_text(LineFramer(b"\r\n"), espec_temperatures, bad)]
    assert 0 < len(taken) < 0.35 * 8 * len(frame)
    for temperatures in taken:
        assert all(abs(value) < 2000.0 for value in temperatures.values())


# --- streams: splits, garbage, truncation -----------------------------------------------------------------------------


def stim300_stream(count: int) -> bytes:
    """Datagrams A5 whose counter steps by 16 (125 samples/s)."""
    frames = []
    for index in range(count):
        body = golden.STIM300_A5[:35] + bytes([16 * index % 256]) + golden.STIM300_A5[36:38]
        frames.append(body + checksums.crc32_mpeg2(body + bytes(2)).to_bytes(4, "big"))
    return b"".join(frames)


def pieces(stream: bytes, cuts: list[int]) -> list[bytes]:
    ends = [0, *sorted(cut % (len(stream) + 1) for cut in cuts), len(stream)]
    return [stream[a:b] for a, b in itertools.pairwise(ends)]


cuts = st.lists(st.integers(0, 10_000), max_size=12)
garbage = st.binary(max_size=50)


@settings(max_examples=60, deadline=None)
@given(cuts)
def test_lines_do_not_depend_on_how_the_stream_was_cut(where: list[int]) -> None:
    stream = b"".join(frame + b"\r\n" for frame in golden.ZABER_REPLIES)
    framer = LineFramer(b"\r\n")
    assert [frame for piece in pieces(stream, where) for frame in framer.push(piece)] == list(golden.ZABER_REPLIES)


@settings(max_examples=60, deadline=None)
@given(cuts, garbage)
def test_stim300_samples_do_not_depend_on_cuts_and_survive_garbage(where: list[int], noise: bytes) -> None:
    stream = noise + stim300_stream(12)
    decoder = Stim300Decoder()
    batches = [decoder.push(piece, 0.0) for piece in pieces(stream, where)]
    assert sum(map(len, batches)) == 12
    assert decoder.bad_bytes == len(noise)
    times = np.concatenate([batch.device_time_s for batch in batches])
    np.testing.assert_allclose(np.diff(times), 0.008)


@settings(max_examples=60, deadline=None)
@given(cuts, garbage)
def test_vectornav_frames_do_not_depend_on_cuts_and_survive_garbage(where: list[int], noise: bytes) -> None:
    # Sync bytes in the noise may hide a first message until enough bytes have come: they are left out here and tested
    # with a whole stream below.
    noise = noise.replace(b"\xfa", b"").replace(b"$", b"")
    messages = [golden.VECTORNAV_IMU, golden.VECTORNAV_LINES[2].encode() + b"\r\n", golden.VECTORNAV_IMU]
    framer = vectornav.VectorNavFramer()
    frames = [frame for piece in pieces(noise + b"".join(messages), where) for frame in framer.push(piece)]
    assert frames == [message.removesuffix(b"\r\n") for message in messages]
    assert framer.bad_bytes == len(noise)


def test_vectornav_recovers_from_a_false_start() -> None:
    stream = b"\xfa\x05\xff\x7f\x1c\x00" + golden.VECTORNAV_IMU * 30
    frames = vectornav.VectorNavFramer().push(stream)
    assert len(frames) >= 29
    assert set(frames) == {golden.VECTORNAV_IMU}


@settings(max_examples=60, deadline=None)
@given(cuts, st.lists(st.sampled_from([b"\x00", b"\xff\x02", b"\x55\x03\x02"]), max_size=3).map(b"".join))
def test_modbus_frames_do_not_depend_on_cuts(where: list[int], noise: bytes) -> None:
    framer = ModbusReplyFramer(1)
    frames = [frame for piece in pieces(noise + golden.MODBUS_25, where) for frame in framer.push(piece)]
    assert frames == [golden.MODBUS_25]


def test_truncated_messages_stay_pending() -> None:
    for frame in (*golden.STIM300_FRAMES,):
        for length in range(len(frame)):
            assert len(Stim300Decoder().push(frame[:length], 0.0)) == 0
    for packet in golden.VECTORNAV_PACKETS:
        for length in range(len(packet)):
            assert vectornav.VectorNavFramer().push(packet[:length]) == []
    for length in range(len(golden.MODBUS_25)):
        assert ModbusReplyFramer(1).push(golden.MODBUS_25[:length]) == []


def test_overlong_line_is_dropped_up_to_its_end() -> None:
    framer = LineFramer(b"\r\n")
    assert framer.push(b"x" * 4090) == []
    assert framer.push(b"x" * 15 + b"\r") == []
    assert framer.push(b"\nnext\r\n") == [b"next"]


def test_stim300_counts_what_is_missing() -> None:
    stream = [stim300_stream(40)[i : i + 42] for i in range(0, 40 * 42, 42)]
    decoder = Stim300Decoder()
    kept = [index for index in range(40) if index not in (5, 6, 20)]
    batch = decoder.push(b"".join(stream[index] for index in kept), 0.0)
    assert {kept[i]: int(gap) for i, gap in enumerate(batch.gap_before) if gap} == {7: 2, 21: 1}
    np.testing.assert_allclose(batch.device_time_s - batch.device_time_s[0], 0.008 * np.array(kept))


def test_stim300_datagrams_that_come_twice_count_once() -> None:
    # Rates that differ, as a unit's do: only what was sent once and came twice is alike.
    frames: list[bytes] = []
    for index in range(40):
        body = golden.STIM300_A5[:3] + bytes([index]) + golden.STIM300_A5[4:35] + bytes([16 * index % 256])
        body += golden.STIM300_A5[36:38]
        frames.append(body + checksums.crc32_mpeg2(body + bytes(2)).to_bytes(4, "big"))
    # At once, late by one, late by several after a loss, and at the seam between two chunks.
    came = [0, 1, 1, 2, 3, 2, 4, 5, 8, 9, 4, 10, 11]
    decoder = Stim300Decoder()
    batches = [decoder.push(b"".join(frames[index] for index in came), 0.0)]
    batches.append(decoder.push(frames[11] + b"".join(frames[12:]), 0.1))
    kept = [0, 1, 2, 3, 4, 5, 8, 9, 10, *range(11, 40)]
    gaps = np.concatenate([batch.gap_before for batch in batches])
    assert {kept[i]: int(gap) for i, gap in enumerate(gaps) if gap} == {8: 2}
    times = np.concatenate([batch.device_time_s for batch in batches])
    np.testing.assert_allclose(times - times[0], 0.008 * np.array(kept))
    assert (decoder.repeated_datagrams, decoder.bad_bytes) == (4, 0)
    # A whole round of the counter that was lost is still no repetition.
    lost = Stim300Decoder()
    lost.push(b"".join(frames[:3]), 0.0)
    assert lost.push(frames[18], 0.1).gap_before.tolist() == [15]


def test_a_vectornav_packet_that_comes_twice_counts_once() -> None:
    decoder = vectornav.VectorNavDecoder(sample_rate_hz=200.0)
    assert len(decoder.push(golden.VECTORNAV_IMU + golden.VECTORNAV_IMU, 0.0)) == 1
    assert decoder.repeated_datagrams == 1


def test_stim300_whole_wraps_lost_in_a_disturbance_are_reckoned_with_the_hosts_clock() -> None:
    stream = stim300_stream(3)
    decoder = Stim300Decoder()
    decoder.push(stream, 10.0)
    # 32 samples (two wraps of the counter) and half a datagram are lost; the next one comes 33 periods later.
    following = stim300_stream(4)[3 * 42 :]
    batch = decoder.push(following[20:] + following, 10.0 + 33 * 0.008)
    assert batch.gap_before.tolist() == [32]


def test_stim300_lost_rounds_are_counted_right_in_bursts_and_after_the_computer_was_busy() -> None:
    frames = [stim300_stream(512)[i : i + 42] for i in range(0, 512 * 42, 42)]

    def burst(decoder: Stim300Decoder, first: int, last: int, host_s: float, cut: int = 0) -> ImuBatch:
        return decoder.push(b"".join(frames[first:last])[cut:], host_s)

    # Half a second of samples at a time; one damaged datagram at a burst's beginning is one sample and no round.
    decoder = Stim300Decoder()
    burst(decoder, 0, 64, 10.512)
    assert burst(decoder, 64, 128, 11.024, cut=3).gap_before.tolist() == [1] + [0] * 62
    # Nobody read for two seconds: what was kept is stamped late, 100 samples and a half were lost behind it.
    kept = burst(decoder, 128, 192, 13.1)
    assert kept.gap_before.tolist() == [0] * 64
    after = burst(decoder, 292, 356, 10.0 + 356 * 0.008, cut=20)
    assert after.gap_before.tolist() == [101] + [0] * 62


def test_stim300_special_datagram_in_the_stream_costs_its_own_bytes_alone() -> None:
    normal = stim300_stream(6)
    special = b"\xbc" + bytes(range(25))
    decoder = Stim300Decoder()
    batch = decoder.push(normal[: 3 * 42] + special + normal[4 * 42 :], 0.0)
    assert (len(batch), decoder.bad_bytes) == (5, len(special))
    assert batch.gap_before.tolist() == [0, 0, 0, 1, 0]


def test_stim300_with_line_ends() -> None:
    frames = [stim300_stream(8)[i : i + 42] + b"\r\n" for i in range(0, 8 * 42, 42)]
    # Whether they are there shows in the stream, in whatever pieces it comes.
    for size in (1, 41, 44, 1000):
        decoder, data = Stim300Decoder(), b"".join(frames)
        assert sum(len(decoder.push(data[i : i + size], 0.0)) for i in range(0, len(data), size)) == 8
        assert decoder.bad_bytes == 0


@settings(max_examples=60, deadline=None)
@given(
    st.binary(max_size=40),
    st.data(),
    st.lists(st.tuples(st.integers(0, 65535), st.binary(min_size=2, max_size=30)), max_size=6),
)
def test_modbus_tcp_messages_come_out_whole_however_they_are_cut(noise: bytes, data: st.DataObject, told: list) -> None:
    messages = [Tcp(1).message(body) for _, body in told]
    stream = b"".join(messages)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=8)))
    framer, found = ModbusTcpFramer(), list[bytes]()
    for begin, end in itertools.pairwise([0, *cuts, len(stream)]):
        found += framer.push(stream[begin:end])
    assert found == messages
    assert framer._buffer == b""
    # Of anything at all nothing is raised but what says so, and what is kept is bounded.
    framer.push(noise)
    assert len(framer._buffer) < 300
    sent = Tcp(1).message(read_body(2820, 2))
    for frame in ModbusTcpFramer().push(sent[:2] + bytes(2) + noise):
        with suppress(FramingError, NotThisReply, Rejected):
            parse_words(Tcp(1), frame, sent, 2)


@pytest.mark.parametrize("rate_hz", [125.0, 2000.0])
def test_rehearsed_units_send_what_the_data_sheet_says(rate_hz: float) -> None:
    """The simulator's one kind of datagram is that of the peer which has all kinds."""
    from simulated_devices.datagrams import datagrams

    from gradcal_jax.hardware.simulate.imu import SensorSamples
    from gradcal_jax.hardware.simulate.lab import datagrams as rehearsed

    random, count = np.random.default_rng(5), 300
    rates, forces = 600.0 * random.standard_normal((count, 3)), 9.0 * random.standard_normal((count, 3))
    forces[7] = np.nan
    samples = SensorSamples(np.arange(count) / rate_hz, rates, forces, 60.0 * random.standard_normal(count))
    expected = datagrams(samples, 41, np.zeros(count, np.bool_), rate_hz=rate_hz)
    assert np.array_equal(rehearsed(samples, 41, rate_hz), expected)
    assert set(expected[:, 10]) > {0}  # some rates are beyond the range
