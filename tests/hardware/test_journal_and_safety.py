"""The journal opens after anything; a rig is made safe whatever one device does; clocks are compared."""

import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import ExitStack

import numpy as np
import pytest
from hardware_bench import Rig, chunks_of, parse_journal

from gradcal_jax.hardware import journal as journal_module
from gradcal_jax.hardware.axis_control import AxisControl
from gradcal_jax.hardware.chamber_control import ChamberControl
from gradcal_jax.hardware.clock import RealClock
from gradcal_jax.hardware.errors import HardwareError
from gradcal_jax.hardware.guard import make_safe
from gradcal_jax.hardware.journal import (
    Journal,
    read_journal,
)
from gradcal_jax.hardware.roles import AxisLimits
from gradcal_jax.hardware.runner import Runner
from gradcal_jax.hardware.setup import Bench, open_rig
from gradcal_jax.hardware.simulate.lab import SimulatedAxis, SimulatedChamber
from gradcal_jax.hardware.simulate.plants import AxisPlant, ChamberPlant, ChamberTruth
from gradcal_jax.hardware.track import AxisCommand, Course, Track, TrackStep
from gradcal_jax.records.clockmap import fit_arrivals
from gradcal_jax.spec.rig import rig_of

# --- journal ----------------------------------------------------------------------------------------------------------


def write_some(path):
    with Journal(path) as journal:
        journal.event(0.0, "start", recipe="abc", note="ünïcode")
        for index in range(6):
            journal.bytes_of("unit1", index + 0.25, bytes([0xA7, 0x4A, index]) * 9, received=True)
            journal.recorder("chamber")(index + 0.5, ">", b"TEMP?\r\n")
        journal.event(9.0, "step", number=3, temperature_c=-30.0)
    return read_journal(path).records


def test_journal_cut_at_every_byte_opens_with_every_whole_record(tmp_path):
    records = write_some(tmp_path / "j")
    data = (tmp_path / "j").read_bytes()
    seen = 0
    for length in range(len(data) + 1):
        contents = parse_journal(data[:length])
        assert contents.records == records[: len(contents.records)]
        assert len(contents.records) >= seen
        seen = len(contents.records)
    assert seen == len(records)


def test_journal_goes_on_behind_a_torn_record_and_loses_only_that(tmp_path):
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
        assert contents.events[-1].name == "resume"
        assert [chunk.data for chunk in chunks_of(contents, "unit1")][-1] == b"more"
        assert path.read_bytes()[:cut] == data[:cut]


def test_journal_with_any_flipped_bit_loses_one_record_at_most(tmp_path):
    records = write_some(tmp_path / "j")
    data = (tmp_path / "j").read_bytes()
    generator = np.random.default_rng(0)
    for place in generator.integers(0, len(data), 300):
        bad = bytearray(data)
        bad[place] ^= 1 << int(generator.integers(8))
        contents = parse_journal(bytes(bad))
        assert len(contents.records) == len(records) - 1
        assert all(record in records for record in contents.records)
        assert contents.damaged_bytes > 0


def test_full_disk_is_a_sentence_and_what_was_written_stays(tmp_path):
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
    assert "File too large" in done.stdout
    assert "resumed" in done.stdout
    assert done.stdout.endswith("again\n")
    contents = read_journal(tmp_path / "j")
    assert contents.events[0].name == "start"
    assert len(chunks_of(contents, "unit")) == 19


def test_many_threads_write_whole_records(tmp_path, monkeypatch):
    monkeypatch.setattr(journal_module, "_SYNC_EVERY_S", 0.01)
    with Journal(tmp_path / "j") as journal:

        def write(line):
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


# --- safety -----------------------------------------------------------------------------------------------------------


# --- clocks -----------------------------------------------------------------------------------------------------------


def test_a_clock_map_knows_what_delays_that_last_for_minutes_can_do_to_its_rate():
    """A busy computer delays even the quickest arrivals, now and for a while: no number of them averages that out."""
    generator, squares = np.random.default_rng(7), []
    device = np.arange(0.0, 100.0, 0.5)
    for _ in range(50):
        busy = 0.005 * generator.random(10)[(device // 10.0).astype(int)]
        fitted = fit_arrivals(device, device + busy + generator.exponential(0.002, device.size))
        squares.append(((fitted.rate - 1.0) / fitted.rate_std) ** 2)
    assert 0.3 < np.mean(squares) < 2.0


def test_a_command_that_goes_on_does_not_undo_what_was_made_safe():
    """A chamber that is slow to take a set point is in standby at the end, and verified only then."""

    class Slow(SimulatedChamber):
        def hold(self, temperature_c):
            goes_on.set()
            time.sleep(1.0)
            SimulatedChamber.hold(self, temperature_c)

    clock, goes_on = RealClock(), threading.Event()
    chamber = Slow(ChamberPlant(ChamberTruth(), clock.now()), clock, -40.0, 90.0)
    rig = rig_of({"format": "gradcal-rig/1", "chamber": {"driver": "simulated", "port": "COM1", "safe": "standby"}})
    control = ChamberControl(chamber, clock, lambda *_, **__: None)
    control.tell(Course(0.0, 60.0), clock.now())
    control.attend(5.0)
    goes_on.wait()
    (outcome,) = make_safe(Bench(rig, chamber), clock, deadline_s=5.0, busy=lambda _: not control.end(0.2))
    assert control.end(5.0)
    assert (outcome.verified, chamber.read().conditioning) == (True, False)
    assert outcome.tries > 1


def test_a_search_for_the_reference_that_goes_on_does_not_undo_a_stop():
    class Slow(SimulatedAxis):
        def home(self):
            searching.set()
            time.sleep(1.0)
            self.plant.spin(clock.now(), 30.0, 100.0)

    clock, searching = RealClock(), threading.Event()
    axis = Slow(AxisPlant(None, clock.now()), clock, AxisLimits(100.0, 100.0, None, None, 0.001))
    table = {"name": "a", "driver": "simulated", "port": "COM1", "safe": "hold", "gravity_loaded": False}
    rig = rig_of({"format": "gradcal-rig/1", "axis": [table]})
    control = AxisControl({"a": axis}, clock, lambda *_, **__: None)

    def ends():
        searching.wait()
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        control.home(["a"], ends)
    (outcome,) = make_safe(Bench(rig, axes={"a": axis}), clock, deadline_s=5.0, busy=control.is_homing)
    assert (outcome.verified, axis.read().moving) == (True, False)
    assert outcome.tries > 1


SPIN = AxisCommand(0.0, "table", "spin", rate_dps=150.0, acceleration_dps2=300.0)
SPINS = Track((TrackStep("spin", 60.0, courses=(Course(0.0, 40.0),), moves=(SPIN,)),))


@pytest.mark.parametrize("fate", ["pulled", pytest.param("hangs", marks=pytest.mark.long)])
def test_a_disk_that_fails_keeps_no_stop_off_the_wire(tmp_path, monkeypatch, fate):
    """Of a run that records all of its lines; the stick that holds its journal is pulled, or its disk hangs."""
    clock, began, safe = RealClock(), [], []
    fails, awake, write = threading.Event(), threading.Event(), os.write
    with ExitStack() as stack:
        rig, journal = stack.enter_context(Rig(clock)), stack.enter_context(Journal(tmp_path / "journal"))
        bench = stack.enter_context(open_rig(rig.rig, clock, lambda url: journal.recorder(f"port {url}")))
        runner = Runner(SPINS, bench, journal, clock, safe_deadline_s=10.0, chamber_every_s=0.5)
        file = (tmp_path / "journal").stat()

        def spoilt(handle, data):
            if fails.is_set() and os.path.samestat(os.fstat(handle), file):
                if fate == "pulled":
                    raise OSError(5, "Input/output error")
                awake.wait(60.0)
            return write(handle, data)

        def look(progress):
            if not began and rig.axis.state(clock.now())[1] > 149.0:
                began.append(time.monotonic())
                fails.set()
                if fate == "hangs":
                    runner.abort("SIGTERM")
                    threading.Timer(8.0, awake.set).start()

        def see():
            while not safe:
                time.sleep(0.02)
                if began and rig.axis.state(clock.now())[1] == 0.0 and not rig.chamber.plant.conditioning:
                    safe.append(time.monotonic())

        monkeypatch.setattr(os, "write", spoilt)
        runner.on_progress = look
        watch = threading.Thread(target=see, daemon=True)
        watch.start()
        result = runner.run()
        watch.join(timeout=1.0)
        assert (result.exit_status, result.verified_safe) == ("aborted", True)
        assert ("Input/output error" if fate == "pulled" else "SIGTERM") in result.reason
        assert safe[0] - began[0] < 5.0


def test_journal_of_a_killed_process_has_every_acknowledged_event(tmp_path):
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
            acknowledged = [int(child.stdout.readline()) for _ in range(5 + attempt)][-1]
            child.send_signal(signal.SIGKILL)
            child.wait()
        contents = read_journal(path)
        assert acknowledged in [event.data.get("number") for event in contents.events if event.name == "step"]
        chunks = chunks_of(contents, "unit")
        assert (
            sum(chunk.time_s == float(i) for i in range(acknowledged + 1) for chunk in chunks[-10_000:]) > acknowledged
        )
        path.unlink()


def test_a_killed_process_loses_only_what_came_just_before(tmp_path):
    path = tmp_path / "j"
    program = (
        "import os, sys, pathlib, time; from gradcal_jax.hardware.journal import Journal\n"
        "journal = Journal(pathlib.Path(sys.argv[1]))\n"
        "journal.bytes_of('unit', 0.0, b'old', received=True); time.sleep(0.5)\n"
        "journal.bytes_of('unit', 0.5, b'new', received=True); os.kill(os.getpid(), 9)\n"
    )
    subprocess.run([sys.executable, "-c", program, str(path)], check=False)
    contents = read_journal(path)
    assert chunks_of(contents, "unit")[0].data == b"old"
    assert contents.damaged_bytes == 0
