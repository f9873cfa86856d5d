"""Binary frames by description: golden bytes of the makers' documents, and streams that are cut and damaged."""

import itertools
import time

import numpy as np
import pytest
from hardware_evidence import record
from hypothesis import given, settings
from hypothesis import strategies as st
from test_text_units import BOARD, printed

from gradcal_jax.hardware.checksums import CrcOfRows
from gradcal_jax.hardware.description import described, shipped
from gradcal_jax.hardware.frames import FRAMES, FramedSensor
from gradcal_jax.hardware.roles import join
from gradcal_jax.hardware.text_unit import TextSensor
from gradcal_jax.tables.problems import SpecError

# Data set of the maker's tests: reference time, its difference, acceleration, gyro, and two more fields.
MICROSTRAIN = (
    "7565804C0AD5000000055EE67CC00AD6000000014E434A000E043D9EE88D387FDB00BF7AAF030E05BB0C1E30BB572E68BBAA24AE0E07BC8AAC"
    "80BC72C50EBCC4E2C10E083EEE3D9FBD66DADDC0AFDEF59196"
)
MICROSTRAIN_CHANGES = {"sync": "7565804C0AD5", "length": 82, "check": {"at": 80}}
VECTORNAV = "FA0501001C00 00CA9A3B00000000 CDCCCC3DCDCC4CBE0AE81CC1 0AD7233C0AD7A3BC8FC2F53C 0000CC41 5ADA"
STIM300 = (
    "a5 00 40 00 ff e0 00 00 10 00 00 00 00 00 00 00 00 08 00 00 00 19 80 19 80 19 80 00 19 80 19 80 19 80 00 0a 01 fa"
    "b8 f2 2b 26"
)
# A frame of a unit with another datagram (AF): rates, accelerations, inclinations, temperatures, auxiliary.
STIM300_OF_A_UNIT = (
    "af000124fffad600035b00 ffe7a6ffdd36081c5200 ff7e70feba0c3ffa1d00 23a023c023a000 2319230a231c00 239523b6239500"
    "ffef0200 e1 01fa c64942c6"
)
STIM300_CHANGES = {
    "sync": "AF", "length": 63, "check": {"at": 59, "zeros": 1}, "counter": {"at": 56},
    "temperature": {"at": 31}, "status": False,
}  # fmt: skip
KVH = "FE81FF55BC646C1E3C3FF9813B3C1E78BC065FB7BB2FBD793F7E980077470014168D8B1D"


def decoder(name, changes=None):
    return described(FramedSensor, name, changes).decoder()


def one(name, text, changes=None):
    batch = decoder(name, changes).push(bytes.fromhex(text), 1.0)
    assert len(batch) == 1
    return batch


def test_golden_frames():
    kept = one("microstrain", MICROSTRAIN, MICROSTRAIN_CHANGES)
    assert np.radians(kept.gyro_dps[0]) == pytest.approx([-0.002138, -0.003283, -0.005192], abs=5e-7)
    assert kept.acceleration_g[0] == pytest.approx([0.077592, 0.000061, -0.979233], abs=5e-7)
    kept = one("vectornav", VECTORNAV)
    assert np.radians(kept.gyro_dps[0]) == pytest.approx([0.01, -0.02, 0.03])
    assert kept.acceleration_g[0] * 9.80665 == pytest.approx([0.1, -0.2, -9.80665])
    assert kept.temperature_c[0].tolist() == [25.5] * 3
    kept = one("stim300", STIM300)
    assert kept.gyro_dps[0].tolist() == [1.0, -0.5, 0.25]
    assert kept.acceleration_g[0] == pytest.approx([0.0, 0.0, 1.0], abs=1e-15)
    assert kept.temperature_c[0].tolist() == [25.5] * 3
    kept = one("stim300", STIM300_OF_A_UNIT, STIM300_CHANGES)
    assert kept.gyro_dps[0].tolist() == [0.017822265625, -0.0806884765625, 0.05242919921875]
    assert kept.acceleration_g[0] == pytest.approx([-0.011890411, -0.016986847, 1.013828278], abs=1e-9)
    assert kept.temperature_c[0].tolist() == [35.625, 35.75, 35.625]
    kept = one("kvh-1750", KVH)
    assert kept.acceleration_g[0, 2] == pytest.approx(0.99451, abs=1e-5)
    assert kept.temperature_c[0, 0] == 20.0


@pytest.mark.parametrize(
    ("width", "poly", "init", "xorout", "reflect", "check"),
    [
        (32, 0x04C11DB7, 0xFFFFFFFF, 0xFFFFFFFF, True, 0xCBF43926),
        (16, 0x1021, 0, 0, False, 0x31C3),
        (16, 0x8005, 0xFFFF, 0, True, 0x4B37),
        (8, 0x07, 0, 0, False, 0xF4),
    ],
)
def test_crcs_of_the_catalogue(width, poly, init, xorout, reflect, check):
    row = np.frombuffer(b"123456789", np.uint8)
    crc = CrcOfRows(width, poly, init, xorout, reflect=reflect)
    assert crc(np.array([row, row])).tolist() == [check, check]


# ---------------------------------------------------------------------------------------------------- made streams


def checked(unit, rows):
    """Rows with their checksums."""
    check, covered = unit.check, rows[:, unit.check.start : unit.check.at]
    if check.kind == "fletcher":
        sums = np.cumsum(covered, axis=1, dtype=np.uint8)
        rows[:, check.at] = sums[:, -1]
        rows[:, check.at + 1] = sums.sum(axis=1, dtype=np.uint8)
    else:
        poly, init, xorout = (int(text, 16) for text in (check.poly, check.init, check.xorout))
        crc = CrcOfRows(check.width, poly, init, xorout, zeros=check.zeros)
        rows[:, check.at :] = crc(covered).astype(f">u{check.width // 8}")[:, None].view(np.uint8)
    return [row.tobytes() for row in rows]


def stream(count, name="stim300"):
    """Frames of a description with values that differ, and with the stamps that are due."""
    unit = described(FramedSensor, name)
    end, numbers = ">" if unit.order == "big" else "<", np.arange(count)
    rows = np.random.default_rng(5).integers(0, 255, (count, unit.length), np.uint8)
    rows[:, : len(unit.sync) // 2] = np.frombuffer(bytes.fromhex(unit.sync), np.uint8)
    if unit.counter is not None:
        step = round(float(unit.counter.rate or unit.rate) / float(unit.rate))
        rows[:, unit.counter.at] = numbers * step % unit.counter.restarts_at
    if unit.time is not None:
        ticks = (numbers * 1e9 / float(unit.rate)).astype(f"{end}u8")
        rows[:, unit.time.at : unit.time.end] = ticks[:, None].view(np.uint8)
    for column in unit.columns.values():
        if column.type == "f32":
            values = np.tile(np.arange(column.values) + 0.5, (count, 1)) + numbers[:, None] % 7
            rows[:, column.at : column.end] = values.astype(f"{end}f4").view(np.uint8)
    if unit.status is not None:
        rows[:, list(unit.status.at)] = 0
    return checked(unit, rows)


def pushed(unit, frames):
    """Frames that come one by one."""
    return join([unit.push(frame, float(number)) for number, frame in enumerate(frames)])


@pytest.mark.parametrize("name", shipped(FRAMES))
def test_lost_doubled_damaged_and_late_frames(name):
    frames = stream(200, name)
    whole = pushed(decoder(name), frames)
    assert (len(whole), whole.gap_before.any()) == (200, False)
    # Lost, once and for a while; doubled, always.
    kept = [frame for number, frame in enumerate(frames) if number not in (50, 120, 121, 122)]
    lost = pushed(decoder(name), kept)
    assert (len(lost), lost.gap_before.sum(), lost.gap_before[50]) == (196, 4, 1)
    always = pushed(decoder(name), [frame for frame in frames for _ in range(2)])
    assert (len(always), always.gap_before.sum()) == (200, 0)
    # Damaged: each bit of a frame; a byte too few, and one too many.
    bits = [(bit // 8, 1 << bit % 8) for bit in range(0, 8 * len(frames[50]), 7)]
    damaged = [frames[50][:at] + bytes([frames[50][at] ^ bit]) + frames[50][at + 1 :] for at, bit in bits]
    damaged += [frames[50][:20] + frames[50][21:], frames[50][:20] + b"\x00" + frames[50][20:]]
    for frame in damaged:
        unit = decoder(name)
        batch = pushed(unit, [*frames[49:50], frame, *frames[51:53]])
        assert (len(batch), batch.gap_before.sum(), unit.bad_bytes) == (3, 1, len(frame))
    assert len(pushed(decoder(name), [bytes(len(frames[0]))] * 100)) == 0


@pytest.mark.evidence
def test_2000_damaged_streams_lose_no_sound_frame_and_invent_none():
    """Random bytes before frames, frames cut short, bursts of up to 32 wrong bits; chunks that are cut anywhere.

    Two of the checksums have 16 bits: by chance a tenth of a frame is invented in all streams together.
    """
    random, count = np.random.default_rng(60), 0
    for name in np.resize(shipped(FRAMES), 2000):
        data, ends, unit = b"", [], decoder(name)
        for frame in stream(20, name):
            harm, place = random.integers(9), random.integers(1, len(frame) - 4)
            wrong = frame[:place] + random.bytes(4) + frame[place + 4 :]
            data += [frame[:place], wrong, random.bytes(place) + frame, *[frame] * 6][harm]
            ends += [] if harm < 2 else [len(data) - 1]
        cuts = itertools.pairwise([0, *sorted(random.integers(len(data), size=9)), len(data)])
        # The time of a byte is its place, that of a sample the place of its frame's last byte.
        batch = join([unit.push(data[begin:end], np.arange(begin, end)) for begin, end in cuts])
        assert batch.host_time_s.tolist() == ends
        count += len(ends)
    record(
        "2000 damaged streams of binary frames",
        f"of 40000 frames {count} left sound: all of them come out, and no other one",
        "tests/hardware/test_frames.py",
    )


@pytest.mark.parametrize("kind", ["frames", "text"])
@given(noise=st.binary(max_size=60), cuts=st.lists(st.integers(0, 600), max_size=6))
@settings(max_examples=50, deadline=None)
def test_samples_do_not_depend_on_how_the_stream_was_cut(kind, noise, cuts):
    text = kind == "text"
    sent = [printed(k) for k in range(8)] if text else stream(8)
    noise = noise.replace(b"$", b"?") + b"\n" if text else noise
    data = noise + b"".join(sent[:4]) + noise + b"".join(sent[4:])
    whole, cut = (described(TextSensor, BOARD).decoder() if text else decoder("stim300") for _ in range(2))
    batch = whole.push(data, 0.0)
    places = sorted({0, len(data), *(min(place, len(data)) for place in cuts)})
    parts = join([cut.push(data[begin:end], 0.0) for begin, end in itertools.pairwise(places)])
    assert len(batch) == len(parts) == 8
    np.testing.assert_array_equal(batch.gyro_dps, parts.gyro_dps)
    np.testing.assert_array_equal(batch.device_time_s, parts.device_time_s)


def test_a_loss_is_counted_up_to_whole_rounds_of_the_counter():
    frames = stream(400)
    unit = decoder("stim300")
    assert unit.round_samples == 16
    batch = pushed(unit, [*frames[:200], frames[200][:20], *frames[250:]])
    assert batch.gap_before.sum() == 50 % 16
    assert batch.disturbed.sum() == 1


def test_a_unit_that_starts_again_in_a_stream_is_seen():
    rows = np.array([np.frombuffer(frame, np.uint8) for frame in stream(43)])
    rows[40:, 10] = 0x40
    batch = pushed(decoder("stim300"), checked(described(FramedSensor, "stim300"), rows))
    assert np.flatnonzero(batch.restarted).tolist() == [40]


def test_bytes_that_look_like_the_beginning_of_a_frame_take_little_time():
    unit = decoder("stim300")
    begun = time.process_time()
    for _ in range(1000):
        unit.push(b"\xa5" * 4096, 0.0)
    assert time.process_time() - begun < 20.0
    assert unit.bad_bytes > 4_000_000


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"length": 40}, "ends at byte 42"),
        ({"gyro": {"at": 40}}, "ends at byte 49"),
        ({"gyro": {"unit": "deg"}}, "gyro"),
        ({"time": {"at": 0, "type": "u8"}}, "not both"),
        ({"rate": "300 Hz"}, "multiple"),
        ({"sync": "A"}, "sync"),
        ({"gyro": False, "acceleration": False}, "gyro or acceleration"),
        ({"length": 10**6}, "length"),
        ({"rate": "2000 Hz", "baudrate": 115200}, "need 840000 bits/s"),
    ],
)
def test_a_description_that_cannot_be_right_is_refused(changes, words):
    with pytest.raises(SpecError, match=words):
        described(FramedSensor, "stim300", changes)
