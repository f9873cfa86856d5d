"""Faults of the line as figures: what a damaged message, a disturbed stream and a bad line can do to a reading.

The tests beside this one ask each question once, in every run of the tests; here they are asked many times and counted.
"""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import hardware_golden as golden
import numpy as np
import pytest
from hardware_bench import (
    espec_bench,
    espec_config,
    f4_bench,
    f4_config,
    odrive_bench,
    stim300_bench,
    vectornav_bench,
    weiss_bench,
    zaber_bench,
)
from hardware_evidence import record
from simulated_devices.faults import FAULTS, Faults
from simulated_devices.line_clock import LineClock
from test_codecs import espec_temperatures

from gradcal_jax.hardware import checksums
from gradcal_jax.hardware.drivers import odrive, stim300, vectornav, weiss, zaber
from gradcal_jax.hardware.drivers.stim300 import Stim300Decoder
from gradcal_jax.hardware.errors import Disconnected, HardwareError, NotVerified
from gradcal_jax.hardware.framing import LineFramer, ModbusReplyFramer, NotThisReply, Rtu, parse_words, read_body
from gradcal_jax.hardware.roles import join

HERE = "tests/hardware/test_faults_in_figures.py"


def flips(frame: bytes) -> Iterator[bytes]:
    for place in range(len(frame)):
        for bit in range(8):
            yield frame[:place] + bytes([frame[place] ^ 1 << bit]) + frame[place + 1 :]


def taken(framer: Any, parse: Callable[[bytes], object], stream: bytes) -> list[object]:
    """What a driver would believe of a stream."""
    found: list[object] = []
    for frame in framer.push(stream):
        try:
            found.append(parse(frame))
        except (HardwareError, NotThisReply):
            continue
    return found


ASKED_F4 = Rtu(1).message(read_body(100))


def believed(protocol: str, stream: bytes) -> list[object]:
    if protocol == "STIM300":
        return [None] * len(Stim300Decoder().push(stream + bytes(80), 0.0))
    if protocol.startswith("VectorNav binary"):
        return list(vectornav.VectorNavFramer().push(stream + bytes(600)))
    ways: dict[str, tuple[Any, Callable[[bytes], object]]] = {
        "ESPEC": (LineFramer(b"\r\n"), espec_temperatures),
        "Weiss": (LineFramer(b"\r"), lambda frame: weiss.parse_record(frame, WEISS_LAYOUT)),
        "Watlow F4": (
            ModbusReplyFramer(1),
            lambda frame: parse_words(Rtu(1), frame, ASKED_F4, 1),
        ),
        "Zaber": (LineFramer(b"\r\n"), lambda frame: zaber.parse_reply(frame, demand_checksum=True)),
        "ODrive": (LineFramer(b"\r\n"), odrive.parse_line),
        "STIM300 Utility Mode": (LineFramer(b"\r"), stim300.parse_utility),
        "VectorNav ASCII": (vectornav.VectorNavFramer(), vectornav.parse_line),
    }
    framer, parse = ways[protocol]
    return taken(framer, parse, stream)


FRAMES: dict[str, list[bytes]] = {
    "ESPEC": [golden.ESPEC["TEMP?"][1]],
    "Weiss": [golden.WEISS_READ[1], golden.WEISS_READ_HELP[1]],
    "Watlow F4": [golden.MODBUS_25, golden.MODBUS_MINUS_40],
    "Zaber": [frame + b"\r\n" for frame in golden.ZABER_REPLIES],
    "ODrive": [frame + b"\r\n" for frame in golden.ODRIVE_REPLIES],
    "STIM300": list(golden.STIM300_FRAMES),
    "STIM300 Utility Mode": [text.encode() + b"\r" for text in golden.STIM300_UTILITY_REPLIES],
    "VectorNav binary": [golden.VECTORNAV_IMU],
    # Outputs that the driver does not switch on are noise to it.
    "VectorNav binary, others": [golden.VECTORNAV_YPR_TIME, golden.VECTORNAV_YPR],
    "VectorNav ASCII": [line.encode() + b"\r\n" for line in golden.VECTORNAV_LINES],
}
WITHOUT_CHECK = ("ESPEC", "Weiss")
_CHANNELS = ("CV01", "CV02", "SV01", "MV01", "MV02", "MV03", "MV04")
WEISS_LAYOUT = weiss.Layout(
    tuple(name for name in _CHANNELS for _ in range(2)), _CHANNELS, "CV01", lowest_c=-72.0, highest_c=182.0, names={}
)


@pytest.mark.evidence
def test_every_bit_of_every_golden_frame() -> None:
    said: list[str] = []
    for protocol, frames in FRAMES.items():
        flipped = wrong = 0
        for frame in frames:
            right = believed(protocol, frame)
            assert bool(right) == (not protocol.endswith("others")), (protocol, frame)
            for bad in flips(frame):
                flipped += 1
                got = believed(protocol, bad)
                wrong += got != right if got and protocol in WITHOUT_CHECK else bool(got)
        if protocol not in WITHOUT_CHECK:
            assert wrong == 0, protocol
        said.append(f"{protocol} {wrong} of {flipped}" + (" (no check in it)" if protocol in WITHOUT_CHECK else ""))
    record("every single bit of every golden frame flipped: believed wrongly", ", ".join(said), HERE)


@pytest.mark.evidence
def test_streams_cut_disturbed_and_shortened() -> None:
    """Datagrams between garbage, cut anywhere, some of them shortened: which ones come out, and with what."""
    random = np.random.default_rng(5)
    rate_dps = float(Stim300Decoder().push(golden.STIM300_A5 + bytes(80), 0.0).gyro_dps[0, 0])
    streams = lost = sound = 0
    for _ in range(2000):
        kept = 0
        stream = b""
        for index in range(20):
            body = golden.STIM300_A5[:35] + bytes([16 * index % 256]) + golden.STIM300_A5[36:38]
            frame = body + checksums.crc32_mpeg2(body + bytes(2)).to_bytes(4, "big")
            if random.random() < 0.1:
                stream += random.bytes(int(random.integers(1, 60)))
            if random.random() < 0.1:
                frame = frame[: int(random.integers(len(frame)))]
            else:
                kept += 1
            stream += frame
        cuts = sorted(int(random.integers(len(stream))) for _ in range(8))
        decoder = Stim300Decoder()
        pieces = [stream[a:b] for a, b in zip([0, *cuts], [*cuts, len(stream)], strict=True)]
        got = join([decoder.push(piece, 0.0) for piece in pieces])
        # None is invented; a shortened datagram may hide the one behind it.
        assert np.all(got.gyro_dps[:, 0] == rate_dps)
        assert len(got) <= kept
        streams, lost, sound = streams + 1, lost + kept - len(got), sound + len(got)
    assert lost < 0.01 * sound
    record(
        "STIM300 streams with garbage, shortened datagrams and random cuts",
        f"{streams} streams: {sound} sound datagrams came out, {lost} were lost beside the damage, none was invented",
        HERE,
    )


ASKED: dict[str, Any] = {
    "ESPEC": (espec_bench, espec_config(reply_timeout_s=0.05)),
    "Weiss": (
        weiss_bench,
        weiss.WeissConfig(
            reply_timeout_s=0.05, acknowledge_timeout_s=0.05, description_silence_s=0.05, product_channel="MV01"
        ),
    ),
    "Watlow F4": (f4_bench, f4_config(0.05)),
    "Zaber": (zaber_bench, zaber.ZaberConfig(reply_timeout_s=0.05)),
    "ODrive": (odrive_bench, odrive.ODriveConfig(reply_timeout_s=0.05)),
}


@contextmanager
def asked(protocol: str, faults: Faults) -> Iterator[tuple[Any, Any]]:
    make, config = ASKED[protocol]
    with make(LineClock(), config=config, faults=faults) as (device, _, port):
        shares, faults.probability = faults.probability, {}
        device.identify()
        if protocol in ("Zaber", "ODrive"):
            device.home()
        faults.probability = shares
        yield device, port


def read_for_ever(unit: Any) -> None:
    while True:
        unit.read_bytes(0.1)


@pytest.mark.evidence
def test_readings_over_a_bad_line() -> None:
    """Every tenth reply is dropped, flipped, preceded by noise, doubled, cut, late or split: what 150 readings say."""
    said: list[str] = []
    for protocol in ASKED:
        faults = Faults(seed=3, probability=dict.fromkeys(FAULTS, 0.1 / len(FAULTS)), delay_s=0.08)
        wrong = refused = good = 0
        with asked(protocol, faults) as (device, port):
            for _ in range(150):
                try:
                    reading = device.read()
                except HardwareError:
                    refused += 1
                    continue
                right = reading.air_c == 23.0 if hasattr(reading, "air_c") else abs(reading.position_deg) < 1e-3
                wrong, good = wrong + (not right), good + right
            port.unplug()
            with pytest.raises((Disconnected, NotVerified)):
                device.read()
        count = sum(faults.count.values())
        if protocol not in WITHOUT_CHECK:
            assert wrong == 0, protocol
        assert good > 100
        said.append(f"{protocol}: {good} right, {refused} refused after retries, {wrong} wrong, of {count} faults")
    for name, bench in (("STIM300", stim300_bench), ("VectorNav", vectornav_bench)):
        clock = LineClock()
        with bench(clock) as (unit, _, port):
            unit.configure()
            unit.start()
            port.faults = Faults(probability=dict.fromkeys(FAULTS, 0.02 / len(FAULTS)), delay_s=0.01)
            chunks: list[tuple[bytes, float]] = []
            # In a thread, as the runner does: bytes that nobody fetches hold virtual time.
            fetching = threading.Event()

            def fetch(unit=unit, chunks=chunks, fetching=fetching) -> None:
                while not fetching.is_set():
                    chunks.append(unit.read_bytes(0.05))

            reader = threading.Thread(target=fetch)
            reader.start()
            clock.sleep(30.0)
            fetching.set()
            with clock.aside():
                reader.join()
            decoder = unit.decoder()
            samples = join([decoder.push(*chunk) for chunk in chunks if chunk[0]])
            port.unplug()
            with pytest.raises(Disconnected):
                read_for_ever(unit)  # what had arrived before comes first
        assert len(samples) > 1000
        # The unit stands still: whatever is far from the Earth's rate was invented.
        assert np.all(np.abs(samples.gyro_dps) < 1.0)
        count = sum(port.faults.count.values())
        missing = int(np.maximum(samples.gap_before[1:], 0).sum())
        said.append(f"{name}: {len(samples)} samples right, {missing} counted as missing, of {count} faults")
    record(
        "readings over a line that spoils every tenth reply (a unit's stream: every fiftieth)", "; ".join(said), HERE
    )
