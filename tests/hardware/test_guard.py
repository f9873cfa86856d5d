"""The guard acts when the run could not end by itself, before it writes anything, and in no other case."""

import errno
import json
import os
import select
import shutil
import signal
import subprocess
import sys
import termios
import threading
import time
from contextlib import closing
from unittest.mock import Mock

import pytest
import serial
from hardware_bench import Rig, short_recipe
from hardware_processes import laboratory, require_standing, start_run
from simulated_devices.faults import Faults
from simulated_devices.port import FastClock
from simulated_devices.port_lab import SimulatedLab

from gradcal_jax.cli import main
from gradcal_jax.hardware import execute, guard, runner
from gradcal_jax.hardware.clock import RealClock
from gradcal_jax.hardware.errors import HardwareError
from gradcal_jax.hardware.execute import run_session
from gradcal_jax.hardware.guard import Guard
from gradcal_jax.hardware.interlocks import InterlockLimits
from gradcal_jax.hardware.journal import Journal, read_journal
from gradcal_jax.hardware.run_folder import new_folder
from gradcal_jax.hardware.setup import only_of, open_rig
from gradcal_jax.hardware.supervision import SafeOutcome, read_status
from gradcal_jax.spec.rig import TEMPLATE
from gradcal_jax.tables.writing import write_toml

SPEED = 20.0
SAFE = {"table": True, "chamber": True, "imu1": True}


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "run").mkdir()
    return tmp_path / "run"


@pytest.fixture
def rig(folder):
    """A rig as a killed run leaves it, on pseudo-terminals, and the run's folder."""
    with Rig(RealClock(), on_terminals=True) as rig:
        write_toml(rig.rig, folder / "rig.toml")
        Journal(folder / "journal").close()
        with open_rig(rig.rig, rig.clock) as bench:
            bench.chamber.hold(40.0)
            bench.axes["table"].home()
            bench.axes["table"].spin(60.0, 300.0)
        yield rig


def by_guard(path):
    events = read_journal(path).events
    return [event for event in events if event.name == "guard" or event.data.get("by") == "guard"]


def made_safe(path):
    """Whether the guard has verified each device, at its last try."""
    return {e.data["device"]: e.data["verified"] for e in by_guard(path) if "device" in e.data}


def stands(rig):
    return rig.chamber.mode == "STANDBY" and rig.rate_dps() == 0.0


def soon(is_so, within_s=60.0):
    end = time.monotonic() + within_s
    while not is_so() and time.monotonic() < end:
        time.sleep(0.1)
    return is_so()


# ------------------------------------------------------------------------------------------------- safe, then written


def test_a_full_disk_keeps_no_device_from_being_made_safe(rig, folder, monkeypatch, capsys):
    write, file = os.write, (folder / "journal").stat()

    def full(handle, data):
        if os.path.samestat(os.fstat(handle), file):
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(handle, data)

    monkeypatch.setattr(os, "write", full)
    outcomes = guard.make_folder_safe(folder, deadline_s=10.0)
    assert stands(rig)
    assert {outcome.name: outcome.verified for outcome in outcomes} == SAFE
    said = capsys.readouterr().err
    assert "No space left on device" in said
    assert "made safe: {'by': 'guard'" in said


# ------------------------------------------------------------------------------------------------------- when it acts


def test_files_in_the_working_folder_are_not_imported(tmp_path, monkeypatch):
    (tmp_path / "rig.toml").write_text(TEMPLATE.replace("/dev/ttyUSB", "/nowhere/port"))
    for name in ("queue", "serial", "signal", "json"):
        (tmp_path / f"{name}.py").write_text(f"open('{name} was imported', 'w')\nraise SystemExit(1)\n")
    monkeypatch.chdir(tmp_path)
    with closing(guard.Guard(tmp_path)) as started:
        assert started.process.poll() is None
    assert list(tmp_path.glob("*was imported")) == []


@pytest.mark.parametrize(
    ("said", "acts"),
    [(b"", False), (b"begun\n", True), (b"begun\ndone\n", False), (b"begun\ndo", True)],
)
def test_it_acts_on_a_run_that_had_begun_and_was_not_done(said, acts, tmp_path):
    # A rig whose ports are not there: whoever wants to open them says so.
    heard = tmp_path / "heard"
    alarm = [sys.executable, "-c", "import sys; open(sys.argv[1], 'w').write(sys.argv[2])", str(heard)]
    text = TEMPLATE.replace("/dev/ttyUSB", "/nowhere/port")
    (tmp_path / "rig.toml").write_text(f"{text}\n[alarm]\ncommand = {json.dumps(alarm)}\n")
    Journal(tmp_path / "journal").close()
    words = [sys.executable, "-m", "gradcal_jax.hardware.guard", str(tmp_path), "20", "0"]
    done = subprocess.run(words, input=said, capture_output=True)
    assert (done.returncode, done.stdout) == (0, b"ready\n")
    assert made_safe(tmp_path / "journal") == (dict.fromkeys(SAFE, False) if acts else {})
    assert heard.exists() == acts
    assert not acts or "the guard makes the rig safe" in heard.read_text()


def test_a_run_that_ends_before_the_guard_is_ready_leaves_it_nothing_to_do(tmp_path):
    (tmp_path / "rig.toml").write_text(TEMPLATE, encoding="utf-8")
    reader, writer = os.pipe()
    os.close(reader)
    begun = [sys.executable, "-I", "-m", "gradcal_jax.hardware.guard", str(tmp_path)]
    done = subprocess.run(begun, stdin=subprocess.DEVNULL, stdout=writer, stderr=subprocess.PIPE, check=False)
    os.close(writer)
    assert (done.returncode, done.stderr) == (0, b"")


def test_a_guard_that_could_not_work_keeps_the_run_from_beginning(tmp_path):
    (tmp_path / "rig.toml").write_text("format = 1")
    with pytest.raises(HardwareError, match="cannot work with"), closing(guard.Guard(tmp_path)):
        pass


# ----------------------------------------------------------------------------------- what it needs, it has beforehand


@pytest.mark.long
@pytest.mark.parametrize("fate", ["moved", "removed"])
def test_the_folder_may_go_away_before_the_run_is_killed(fate, rig, folder, tmp_path):
    limit, words = rig.table.settings[120], [sys.executable, "-m", "gradcal_jax.hardware.guard", str(folder)]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert select.select([process.stdout], [], [], 20.0)[0], "it does not say that it is ready"
        with process.stdin:
            process.stdin.write(b'begun\nbefore ["table", "acceleration", "%g"]\n' % limit)
            process.stdin.flush()
            rig.table.settings[120] = 12.5
            (folder.rename(tmp_path / "elsewhere") if fate == "moved" else shutil.rmtree(folder))
        assert process.wait(timeout=60.0) == 0
    assert stands(rig)
    # What the run had changed of a device is as it was, though this process never changed it.
    assert rig.table.settings[120] == limit
    if fate == "moved":
        assert made_safe(tmp_path / "elsewhere" / "journal") == SAFE


@pytest.mark.long
def test_a_device_that_does_not_answer_is_tried_until_it_does(rig, folder, capsys, monkeypatch):
    monkeypatch.setattr(guard, "_TO_OPEN_S", 0.3)
    rig.ports[0].faults = Faults(mute=True)
    mend = threading.Timer(4.0, lambda: setattr(rig.ports[0], "faults", None))
    mend.start()
    outcomes = guard.make_folder_safe(folder, deadline_s=1.0, keep_trying_s=60.0)
    mend.join()
    assert rig.chamber.mode == "STANDBY"
    assert all(outcome.verified for outcome in outcomes)
    assert "chamber is not safe; the guard tries again" in capsys.readouterr().err
    assert made_safe(folder / "journal") == SAFE


# ------------------------------------------------------------------------------------------------- alive, both ways


def test_a_guard_that_died_since_the_last_beat_is_replaced_at_the_end(rig, folder):
    watched = guard.Guard(folder)
    watched.begun()
    watched.process.kill()
    watched.process.wait()
    watched.close()
    assert watched.process.wait(timeout=60.0) == 0
    assert stands(rig)
    assert made_safe(folder / "journal") == SAFE


def test_a_guard_that_hangs_is_replaced(rig, folder, monkeypatch):
    """It is stopped, as by a debugger, and would keep no killed run's rig safe."""
    monkeypatch.setattr(guard, "_SILENT_S", 2.0)
    watched, said = guard.Guard(folder), []
    for _ in range(30):
        said.append(watched.beat())
        time.sleep(0.1)
    first = watched.process
    assert not any(said)
    os.kill(first.pid, signal.SIGSTOP)
    assert soon(lambda: said.append(watched.beat()) or any(said))
    assert "had not replied for 2 s" in "".join(said)
    assert first.wait(timeout=10.0) == -signal.SIGKILL
    assert watched.process.poll() is None
    watched.close()
    assert watched.process.wait(timeout=60.0) == 0


def test_a_guard_that_hangs_as_it_starts_is_none(tmp_path, monkeypatch):
    """As on a disk that never answers: the run does not wait for it, and says that it has no guard."""
    hangs = tmp_path / "python"
    hangs.write_text("#!/bin/sh\nexec sleep 60\n")
    hangs.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(hangs))
    monkeypatch.setattr(guard, "_TO_START_S", 0.2)
    with pytest.raises(HardwareError, match="cannot work"):
        guard.Guard(tmp_path)


@pytest.mark.long
def test_a_run_that_hangs_is_ended_and_made_safe(tmp_path):
    """The process is stopped, as by a debugger or a disk that never answers: it holds its ports and says nothing."""
    write_toml(short_recipe(6.0), tmp_path / "recipe.toml")
    with laboratory(tmp_path, SPEED) as lab:
        run = start_run(tmp_path, tmp_path / "run", SPEED, guard=True, silent_s=2.0)
        journal = tmp_path / "run" / "journal"
        assert soon(lambda: journal.exists() and journal.read_bytes().count(b'"move"') >= 2)
        os.kill(int((tmp_path / "run" / "pid").read_text()), signal.SIGSTOP)
        assert soon(lambda: journal.read_bytes().count(b'"by":"guard"') >= 3)
        require_standing(lab)
        run.communicate(timeout=30.0)
        assert run.returncode == -signal.SIGKILL
    assert "no longer responded" in by_guard(journal)[0].data["what"]


@pytest.mark.parametrize("how", ["broken off", "not verified", "guard died"])
def test_what_the_run_leaves_unsafe_is_made_safe(how, tmp_path, monkeypatch, capsys):
    """Ctrl-C, and once more while everything is made safe; a device that did not confirm; and that after the guard was
    killed in the run: another one does what the first was there for."""
    guards, killed, left, start = [], [], [], guard.Guard.begun

    def begun(self):
        guards.append(self)
        start(self)

    def ends(progress):
        if how == "guard died":
            if not killed:
                killed.append(guards[0].process.kill())
        elif lab.chamber.mode != "STANDBY":
            raise KeyboardInterrupt

    def hindered(*_, **__):
        left.append(lab.chamber.mode)
        if how == "broken off":
            raise KeyboardInterrupt
        return [SafeOutcome("chamber", "standby", False, "has not answered yet", 1, 60.0)]

    monkeypatch.setattr(execute, "BEAT_S", 0.1)
    monkeypatch.setattr(guard.Guard, "begun", begun)
    monkeypatch.setattr(runner, "make_safe", hindered)
    clock, made = FastClock(SPEED), short_recipe(1.0)
    with SimulatedLab(made.spec, clock) as lab:
        folder = new_folder(tmp_path / "run", made, lab.rig, simulated={})
        more = {"guard": True, "on_progress": ends, "limits": InterlockLimits(latest_s=20.0)}
        if how == "broken off":
            with pytest.raises(KeyboardInterrupt):
                run_session(folder, clock, **more)
        else:
            assert not run_session(folder, clock, **more).verified_safe
        assert len(left) == 1
        # If need be at a later try: a guard whose devices vanish tries them for an hour.
        assert soon(lambda: list(made_safe(folder.journal_path).values()) == [True] * 3)
        assert lab.chamber.mode == "STANDBY"
    said = "the guard had died; another guard has replaced it"
    assert (said in capsys.readouterr().err) == (how == "guard died")
    assert (said in [event.data.get("what") for event in by_guard(folder.journal_path)]) == (how == "guard died")


# --------------------------------------------------------------------------------- whatever an opener or a line raises


# Of a line, of the system, of a program that is ended.
PROBLEMS = [
    termios.error(5, "why"), MemoryError(), serial.PortNotOpenError(), SystemExit(1), ExceptionGroup("why", [OSError()])
]  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize("where", ["open", "write", "read"])
def test_the_guard_survives_every_exception_of_one_port(where, rig, folder, monkeypatch):
    monkeypatch.setattr(guard, "_TO_OPEN_S", 0.05)
    opener, fails = serial.serial_for_url, Mock()

    def opened(url, *arguments, **options):
        port = opener(url, *arguments, **options)
        if url == rig.rig.chamber.port:
            monkeypatch.setattr(port, where, fails)
        return port

    monkeypatch.setattr(serial, "serial_for_url", opened)
    for fails.side_effect in PROBLEMS:
        with open_rig(only_of(rig.rig, {"table"}), rig.clock) as bench:
            table = bench.axes["table"]
            # It turns still the first time; a board that turns takes no other motion.
            if not table.read().moving:
                table.spin(10.0, 300.0)
        # A port that opens costs the whole time, one that does not costs none of it.
        outcomes = guard.make_folder_safe(folder, deadline_s=5.0 if where == "open" else 1.5)
        assert {outcome.name: outcome.verified for outcome in outcomes} == SAFE | {"chamber": False}, fails.side_effect
        assert rig.rate_dps() == 0.0, fails.side_effect
    # Nor does the port stay locked, so that a later try takes it for another run's.
    monkeypatch.setattr(serial, "serial_for_url", opener)
    assert all(outcome.verified for outcome in guard.make_folder_safe(folder, deadline_s=10.0))
    assert rig.chamber.mode == "STANDBY"


# --------------------------------------------------------------------------------------------------- after the guard


def test_after_the_guard_the_status_says_how_it_ended(rig, folder, capsys):
    status = {"format": "gradcal-status/1", "at_s": time.time(), "simulated": False, "state": "running", "step": "turn"}
    status |= {"steps": 2, "steps_done": 1, "axes": {}, "samples": {}, "track_left_s": 100.0}
    (folder / "status.json").write_text(json.dumps(status))
    guard.make_folder_safe(folder, deadline_s=10.0)
    found = read_status(folder)
    assert (found["exit_status"], found["state"], found["verified_safe"]) == ("lost", "safe", True)
    assert "the run has ended unexpectedly" in found["reason"]
    assert "the guard: the run has ended unexpectedly" in (said := capsys.readouterr().err)
    assert "everything is verified safe" in said
    # What cannot be made safe is said, too.
    rig.ports[0].unplug()
    guard.make_folder_safe(folder, deadline_s=1.0)
    assert read_status(folder)["state"] == "failed"
    assert "NOT VERIFIED SAFE: chamber" in capsys.readouterr().err
    assert main(["rig", "watch", str(folder)]) == 3
    assert "ended: lost, the run has ended unexpectedly" in capsys.readouterr().out


def test_a_start_that_commanded_nothing_leaves_the_ports_to_the_next_one(tmp_path, monkeypatch):
    """The chamber is off: it can neither answer nor be verified safe, and nothing was commanded."""
    told = []
    for name in ("done", "begun"):
        call = getattr(Guard, name)
        monkeypatch.setattr(Guard, name, lambda self, name=name, call=call: (told.append(name), call(self)))
    with Rig(RealClock()) as rig:
        rig.rig.chamber.options["reply_timeout"] = "0.1 s"
        run = new_folder(tmp_path / "run", short_recipe(1.0), rig.rig, simulated={})
        rig.ports[0].faults = lambda message: []
        result = run_session(run, rig.clock, guard=True, safe_deadline_s=1.0)
        assert (result.begun, result.verified_safe) == (False, False)
        assert told == ["done"]
        rig.ports[0].faults = None
        open_rig(rig.rig, rig.clock).close()
