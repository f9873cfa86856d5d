"""Golden vectors both ways, and what damage does to them: no protocol with a check accepts a damaged message."""

import itertools
from collections.abc import Callable
from contextlib import suppress
from functools import partial

import hardware_golden as golden
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gradcal_jax.hardware.drivers import lines
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
from gradcal_jax.hardware.line_protocol import formatted, reply_pattern

# --- checksums -------------------------------------------------------------------------------------------------------


# --- ESPEC ------------------------------------------------------------------------------------------------------------

ESPEC = lines.LinesConfig(protocol="espec").described
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
    on_a_bus = lines.LinesConfig(protocol="espec", changes={"line": {"prefix": "1,"}}).described
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


CHECKED: list[tuple[Callable[[], object], Callable[..., object], bytes]] = [
    *((partial(ModbusReplyFramer, 1), words_in, frame) for frame in (golden.MODBUS_25, golden.MODBUS_MINUS_40)),
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


def test_flipped_espec_replies_keep_their_form_or_are_refused() -> None:
    """There is no checksum: what a flip can do is counted here, and plausibility and read-back must catch it."""
    frame = golden.ESPEC["TEMP?"][1]
    taken = [x for bad in flips(frame) for x in accepted_text(LineFramer(b"\r\n"), espec_temperatures, bad)]
    assert 0 < len(taken) < 0.35 * 8 * len(frame)
    for temperatures in taken:
        assert all(abs(value) < 2000.0 for value in temperatures.values())


# --- streams: splits, garbage, truncation -----------------------------------------------------------------------------


def pieces(stream: bytes, cuts: list[int]) -> list[bytes]:
    ends = [0, *sorted(cut % (len(stream) + 1) for cut in cuts), len(stream)]
    return [stream[a:b] for a, b in itertools.pairwise(ends)]


cuts = st.lists(st.integers(0, 10_000), max_size=12)
garbage = st.binary(max_size=50)


@settings(max_examples=60, deadline=None)
@given(cuts)
def test_lines_do_not_depend_on_how_the_stream_was_cut(where: list[int]) -> None:
    replies = [reply.removesuffix(b"\r\n") for _, reply in golden.ESPEC.values()]
    stream = b"".join(frame + b"\r\n" for frame in replies)
    framer = LineFramer(b"\r\n")
    assert [frame for piece in pieces(stream, where) for frame in framer.push(piece)] == replies


@settings(max_examples=60, deadline=None)
@given(cuts, st.lists(st.sampled_from([b"\x00", b"\xff\x02", b"\x55\x03\x02"]), max_size=3).map(b"".join))
def test_modbus_frames_do_not_depend_on_cuts(where: list[int], noise: bytes) -> None:
    framer = ModbusReplyFramer(1)
    frames = [frame for piece in pieces(noise + golden.MODBUS_25, where) for frame in framer.push(piece)]
    assert frames == [golden.MODBUS_25]


def test_truncated_messages_stay_pending() -> None:
    for length in range(len(golden.MODBUS_25)):
        assert ModbusReplyFramer(1).push(golden.MODBUS_25[:length]) == []


def test_overlong_line_is_dropped_up_to_its_end() -> None:
    framer = LineFramer(b"\r\n")
    assert framer.push(b"x" * 4090) == []
    assert framer.push(b"x" * 15 + b"\r") == []
    assert framer.push(b"\nnext\r\n") == [b"next"]


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
