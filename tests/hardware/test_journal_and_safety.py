"""The journal opens after anything; a rig is made safe whatever one device does; clocks are compared."""

import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from hardware_bench import Rig, chunks_of, fit_clock, parse_journal
from simulated_devices.faults import Faults

from gradcal_jax.hardware import journal as journal_module
from gradcal_jax.hardware.axis_control import AxisControl
from gradcal_jax.hardware.chamber_control import ChamberControl
from gradcal_jax.hardware.clock import RealClock, VirtualClock
from gradcal_jax.hardware.errors import HardwareError
from gradcal_jax.hardware.guard import make_safe
from gradcal_jax.hardware.journal import (
    Chunk,
    Event,
    Journal,
    read_journal,
)
from gradcal_jax.hardware.roles import AxisLimits
from gradcal_jax.hardware.setup import Bench, open_rig
from gradcal_jax.hardware.simulate.lab import SimulatedAxis, SimulatedChamber
from gradcal_jax.hardware.simulate.plants import AxisPlant, ChamberPlant, ChamberTruth
from gradcal_jax.spec.rig import rig_of

# --- journal ----------------------------------------------------------------------------------------------------------


def write_some(path: Path) -> list[Event | Chunk]:
    with Journal(path) as journal:
        journal.event(0.0, "start", recipe="abc", note="ünïcode")
        for index in range(6):
            journal.bytes_of("unit1", index + 0.25, bytes([0xA7, 0x4A, index]) * 9, received=True)
            journal.recorder("chamber")(index + 0.5, ">", b"TEMP?\r\n")
        journal.event(9.0, "step", number=3, temperature_c=-30.0)
    return read_journal(path).records


def test_journal_cut_at_every_byte_opens_with_every_whole_record(tmp_path: Path) -> None:
    records = write_some(tmp_path / "j")
    data = (tmp_path / "j").read_bytes()
    seen = 0
    for length in range(len(data) + 1):
        contents = parse_journal(data[:length])
        assert contents.records == records[: len(contents.records)]
        assert len(contents.records) >= seen
        seen = len(contents.records)
    assert seen == len(records)


def test_journal_goes_on_behind_a_torn_record_and_loses_only_that(tmp_path: Path) -> None:
    path = tmp_path / "j"
    records = write_some(path)
    data = path.read_bytes()
    for cut in range(len(data) - 40, len(data)):
        path.write_bytes(data[:cut])
        whole = len(parse_journal(data[:cut]).records)
        with Journal(path) as journal:
            journal.event(20.0, "resume")
            journal.bytes_of("unit1", 21.0, b"more", received=True)
        contents = read_journal(path)
        assert contents.records[:whole] == records[:whole]
        assert contents.events[-2].name == "resume"
        assert [chunk.data for chunk in chunks_of(contents, "unit1")][-1] == b"more"
        assert path.read_bytes()[:cut] == data[:cut]


def test_journal_with_any_flipped_bit_loses_one_record_at_most(tmp_path: Path) -> None:
    records = write_some(tmp_path / "j")
    data = (tmp_path / "j").read_bytes()
    generator = np.random.default_rng(0)
    for place in generator.integers(0, len(data), 300):
        bad = bytearray(data)
        bad[place] ^= 1 << int(generator.integers(8))
        contents = parse_journal(bytes(bad))
        # A lost note of a line's name renames its chunks; their bytes and times stay.
        kept = [(type(r), r.time_s, getattr(r, "data", None)) for r in contents.records]
        whole = [(type(r), r.time_s, getattr(r, "data", None)) for r in records]
        assert len(kept) == len(whole) - 1
        assert all(entry in whole for entry in kept)
        assert contents.damaged_bytes > 0


def test_journal_of_a_killed_process_has_every_acknowledged_event(tmp_path: Path) -> None:
    path = tmp_path / "j"
    program = (
        "import sys, pathlib; from gradcal_jax.hardware.journal import Journal\n"
        "journal = Journal(pathlib.Path(sys.argv[1]))\n"
        "for i in range(10**9):\n"
        "    journal.bytes_of('unit', float(i), b'x' * 500, received=True)\n"
        "    if i % 20 == 0:\n"
        "        journal.event(float(i), 'step', number=i); print(i, flush=True)\n"
    )
    for attempt in range(3):
        with subprocess.Popen([sys.executable, "-c", program, str(path)], stdout=subprocess.PIPE) as child:
            assert child.stdout is not None
            acknowledged = [int(child.stdout.readline()) for _ in range(5 + attempt)][-1]
            child.send_signal(signal.SIGKILL)
            child.wait()
        contents = read_journal(path)
        assert acknowledged in [event.data.get("number") for event in contents.events if event.name == "step"]
        chunks = list(chunks_of(contents, "unit"))
        assert (
            sum(chunk.time_s == float(i) for i in range(acknowledged + 1) for chunk in chunks[-10_000:]) > acknowledged
        )
        path.unlink()


@pytest.mark.parametrize("block", [1, 7, 64, 1000])
def test_a_journal_reads_the_same_in_blocks_of_any_size(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, block: int
) -> None:
    write_some(tmp_path / "j")
    generator = np.random.default_rng(3)
    data = bytearray((tmp_path / "j").read_bytes() * 3)
    for place in generator.integers(0, len(data), 12):
        data[place] ^= 0x40
    data += b"\xa7\x4a\x02"
    whole = parse_journal(bytes(data))
    assert whole.damaged_bytes > 100
    (tmp_path / "j").write_bytes(data)
    monkeypatch.setattr(journal_module, "_BLOCK", block)
    found = read_journal(tmp_path / "j")
    assert (found.records, found.damaged_bytes) == (whole.records, whole.damaged_bytes)
    events = read_journal(tmp_path / "j", chunks=False)
    assert (events.records, events.latest_s) == (whole.events, whole.latest_s)


def test_the_events_of_a_long_journal_take_little_memory(tmp_path: Path) -> None:
    """Bytes of an hour of two units at full rate: a resumed run, and its status, read nothing but events."""
    with Journal(tmp_path / "j") as journal:
        for k in range(400_000):
            journal.bytes_of(f"unit{k % 2}", 0.009 * k, bytes(150), received=True)
            if k % 1000 == 0:
                journal.event(0.009 * k, "chamber", at_once=False, air_c=20.0)
    assert (tmp_path / "j").stat().st_size > 60e6
    program = (
        "import resource, sys, pathlib; from gradcal_jax.hardware.journal import Journal, read_journal\n"
        "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "contents = read_journal(pathlib.Path(sys.argv[1]), chunks=False); Journal(pathlib.Path(sys.argv[1])).close()\n"
        "print(len(contents.events), (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024)\n"
    )
    words = [sys.executable, "-c", program, str(tmp_path / "j")]
    count, megabytes = subprocess.run(words, capture_output=True, text=True, check=True).stdout.split()
    assert int(count) == 402
    assert float(megabytes) < 30.0


def test_full_disk_is_a_sentence_and_what_was_written_stays(tmp_path: Path) -> None:
    program = (
        "import resource, sys, pathlib; from gradcal_jax.hardware.journal import Journal\n"
        "import signal; signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))\n"
        "journal = Journal(pathlib.Path(sys.argv[1])); journal.event(0.0, 'start')\n"
        "while not journal.problem: journal.bytes_of('unit', 1.0, b'x' * 5000, received=True)\n"
        "print(journal.problem)\n"
        "journal.event(2.0, 'late'); journal.bytes_of('unit', 2.0, b'late', received=True); print('again')\n"
        "journal.close()\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, str(tmp_path / "j")], capture_output=True, text=True, check=True
    )
    assert "the disk is full" in done.stdout
    assert "resumed" in done.stdout
    assert done.stdout.endswith("again\n")
    contents = read_journal(tmp_path / "j")
    assert contents.events[0].name == "start"
    assert len(list(chunks_of(contents, "unit"))) == 19


def test_many_threads_write_whole_records(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(journal_module, "_SYNC_EVERY_S", 0.01)
    with Journal(tmp_path / "j") as journal:

        def write(line: str) -> None:
            for index in range(300):
                journal.bytes_of(line, float(index), f"{line}{index}".encode() * 20, received=True)

        threads = [threading.Thread(target=write, args=(f"unit{k}",)) for k in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    contents = read_journal(tmp_path / "j")
    assert contents.damaged_bytes == 0
    for k in range(4):
        assert [c.data for c in chunks_of(contents, f"unit{k}")] == [f"unit{k}{i}".encode() * 20 for i in range(300)]
    with pytest.raises(HardwareError, match="cannot be read"):
        read_journal(tmp_path / "missing")
    closed = Journal(tmp_path / "closed")
    closed.close()
    closed.event(0.0, "late")
    assert read_journal(tmp_path / "closed").records == []


def test_a_line_too_many_is_a_problem_and_what_was_written_stays(tmp_path: Path) -> None:
    with Journal(tmp_path / "j") as journal:
        for number in range(256):
            journal.bytes_of(f"unit{number}", 0.0, b"x", received=True)
        assert journal.problem == ""
        journal.bytes_of("one more", 1.0, b"x", received=True)
        assert "at most 256 lines" in journal.problem
    contents = read_journal(tmp_path / "j")
    assert contents.damaged_bytes == 0
    assert [chunk.data for chunk in chunks_of(contents, "unit255")] == [b"x"]
    assert "one more" not in {event.data["name"] for event in contents.events}


# --- safety -----------------------------------------------------------------------------------------------------------


def test_a_device_that_never_answers_keeps_nobody_else_waiting() -> None:
    clock = RealClock()
    with Rig(clock) as rig, open_rig(rig.rig, clock) as bench:
        bench.axes["table"].home()
        bench.axes["table"].spin(30.0, 300.0)
        rig.ports[0].faults = Faults(mute=True)
        began = time.monotonic()
        outcomes = {outcome.name: outcome for outcome in make_safe(bench, clock, deadline_s=4.0)}
        assert time.monotonic() - began < 6.0
        assert outcomes["table"].verified
        assert outcomes["table"].took_s < 3.0
        assert not outcomes["chamber"].verified
        assert rig.axis.state(clock.now())[1] == 0.0


def test_a_bad_line_is_tried_again_until_the_device_is_safe() -> None:
    clock = VirtualClock()
    with Rig(clock) as rig, open_rig(rig.rig, clock) as bench, clock.party():
        assert bench.chamber is not None
        bench.chamber.hold(40.0)
        bench.axes["table"].home()
        bench.axes["table"].spin(100.0, 300.0)
        rig.ports[1].faults = faults = Faults()
        faults.once(*["drop"] * 8)
        outcomes = {outcome.name: outcome for outcome in make_safe(bench, clock, deadline_s=20.0)}
        assert outcomes["table"].verified
        assert outcomes["table"].tries > 1
        assert rig.axis.state(clock.now())[1] == 0.0


# --- clocks -----------------------------------------------------------------------------------------------------------


def test_a_clock_map_knows_what_delays_that_last_for_minutes_can_do_to_its_rate() -> None:
    """A busy computer delays even the quickest arrivals, now and for a while: no number of them averages that out."""
    generator, squares = np.random.default_rng(7), list[float]()
    device = np.arange(0.0, 100.0, 0.5)
    for _ in range(50):
        busy = 0.005 * generator.random(10)[(device // 10.0).astype(int)]
        fitted = fit_clock(device, device + busy + generator.exponential(0.002, device.size))
        squares.append((fitted.rate_error / fitted.rate_std) ** 2)
    assert 0.3 < np.mean(squares) < 2.0


def test_clock_map_uses_the_last_sample_of_a_chunk_and_needs_three() -> None:
    device = np.arange(160) * 0.008
    host = 5.0 + np.repeat(device[15::16], 16)
    fitted = fit_clock(device, host)
    assert fitted.rate == pytest.approx(1.0, abs=1e-12)
    assert fitted.offset_s == pytest.approx(5.0, abs=1e-12)
    with pytest.raises(ValueError, match="at least three samples"):
        fit_clock(device[:32], host[:32])


def test_a_command_that_goes_on_does_not_undo_what_was_made_safe() -> None:
    """A chamber that is slow to take a set point is in standby at the end, and verified only then."""

    class Slow(SimulatedChamber):
        def hold(self, temperature_c: float) -> None:
            goes_on.set()
            time.sleep(1.0)
            SimulatedChamber.hold(self, temperature_c)

    clock, goes_on = RealClock(), threading.Event()
    chamber = Slow(ChamberPlant(ChamberTruth(), clock.now()), clock, -40.0, 90.0)
    rig = rig_of({"format": "gradcal-rig/1", "chamber": {"driver": "simulated", "port": "COM1", "safe": "standby"}})
    control = ChamberControl(chamber, clock, lambda *_, **__: None)
    told = threading.Thread(target=control.hold, args=(60.0,))
    told.start()
    goes_on.wait()
    (outcome,) = make_safe(Bench(rig, chamber), clock, deadline_s=5.0, busy=lambda _: not control.end(0.2))
    told.join()
    assert (outcome.verified, chamber.read().conditioning) == (True, False)
    assert outcome.tries > 1


def test_a_search_for_the_reference_that_goes_on_does_not_undo_a_stop() -> None:
    class Slow(SimulatedAxis):
        def home(self) -> None:
            searching.set()
            time.sleep(1.0)
            self.plant.spin(clock.now(), 30.0, 100.0)

    clock, searching = RealClock(), threading.Event()
    axis = Slow(AxisPlant(None, clock.now()), clock, AxisLimits(100.0, 100.0, None, None, 0.001))
    table = {"name": "a", "driver": "simulated", "port": "COM1", "safe": "hold", "gravity_loaded": False}
    rig = rig_of({"format": "gradcal-rig/1", "axis": [table]})
    control = AxisControl({"a": axis}, clock, lambda *_, **__: None)

    def ends() -> None:
        searching.wait()
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        control.home(["a"], ends)
    (outcome,) = make_safe(Bench(rig, axes={"a": axis}), clock, deadline_s=5.0, busy=control.is_homing)
    assert (outcome.verified, axis.read().moving) == (True, False)
    assert outcome.tries > 1
