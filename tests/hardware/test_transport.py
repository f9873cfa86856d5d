"""The serial line: exclusive, timed, recorded; what happens when it vanishes."""

import errno
import os
import stat
import subprocess
import sys
import tempfile
import threading
import time

import pytest
from simulated_devices.port import SimulatedPort

from gradcal_jax.hardware.clock import RealClock
from gradcal_jax.hardware.errors import Disconnected, PortRefused
from gradcal_jax.hardware.transport import PortLock, Transport


class Echo:
    def receive(self, data):
        return [data]


def test_another_process_is_refused_and_a_killed_owner_leaves_no_lock():
    hold = (
        "import sys, time; from gradcal_jax.hardware.transport import Transport; "
        "from gradcal_jax.hardware.clock import RealClock; Transport(sys.argv[1], clock=RealClock()); "
        "print('open', flush=True); time.sleep(60)"
    )
    with SimulatedPort(Echo(), RealClock()) as port:
        with subprocess.Popen([sys.executable, "-c", hold, port.url], stdout=subprocess.PIPE) as owner:
            assert owner.stdout.readline() == b"open\n"
            with pytest.raises(PortRefused, match=f"process {owner.pid}"):
                Transport(port.url, clock=RealClock())
            owner.kill()
            owner.wait()
        Transport(port.url, clock=RealClock()).close()


def only_lock(folder):
    (lock,) = folder.glob("gradcal-port-*.lock")
    return lock


@pytest.mark.skipif(os.name != "posix", reason="accounts and their rights are those of POSIX")
def test_locks_are_shared_by_the_accounts_of_a_computer(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    before = os.umask(0o077)
    try:
        PortLock("/dev/some-port").release()
    finally:
        os.umask(before)
    assert stat.S_IMODE(only_lock(tmp_path).stat().st_mode) == 0o666

    def not_mine(handle, mode):
        raise PermissionError(errno.EPERM, "Operation not permitted")

    # Another account cannot change what it does not own, and needs not.
    monkeypatch.setattr(os, "fchmod", not_mine)
    PortLock("/dev/some-port").release()


@pytest.mark.parametrize("in_the_way", ["a folder", "a link"])
def test_a_lock_that_cannot_be_had_is_a_sentence(tmp_path, monkeypatch, in_the_way):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    PortLock("/dev/some-port").release()
    lock, precious = only_lock(tmp_path), tmp_path / "precious"
    precious.write_text("not a lock")
    precious.chmod(0o600)
    lock.unlink()
    lock.mkdir() if in_the_way == "a folder" else lock.symlink_to(precious)
    with pytest.raises(PortRefused, match=r"/dev/some-port cannot be locked against other runs: .*gradcal-port"):
        PortLock("/dev/some-port")
    assert precious.read_text() == "not a lock"
    assert stat.S_IMODE(precious.stat().st_mode) == 0o600


def test_a_full_disk_keeps_nobody_from_a_port(tmp_path, monkeypatch):
    """Least of all the guard of a run that ended because its disk was full."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))

    def full(handle, data):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(os, "write", full)
        lock = PortLock("/dev/some-port")
    with pytest.raises(PortRefused, match="in use by another run"):
        PortLock("/dev/some-port")
    lock.release()


def test_missing_port_is_refused_in_a_sentence():
    with pytest.raises(PortRefused, match="cannot be opened"):
        Transport("/dev/no-such-port", clock=RealClock())


@pytest.mark.parametrize("on_socket", [False, True])
def test_bytes_go_round_and_are_recorded(on_socket):
    message = bytes(range(256))
    entries = []

    def record(_, direction, data):
        entries.append((direction, data))

    with (
        SimulatedPort(Echo(), RealClock(), on_socket=on_socket) as port,
        Transport(port.url, clock=RealClock(), recorder=record) as line,
    ):
        line.write(message)
        heard = b""
        while len(heard) < len(message) and (chunk := line.read(1.0)):
            heard += chunk
        assert heard == message
        started = time.monotonic()
        assert line.read(0.2) == b""
        assert 0.15 < time.monotonic() - started < 1.0
    assert entries[0] == (">", message)
    assert b"".join(data for _, data in entries[1:]) == message


def test_unplugged_line_raises_disconnected_everywhere():
    with SimulatedPort(Echo(), RealClock()) as port:
        line = Transport(port.url, clock=RealClock())
        threading.Timer(0.1, port.unplug).start()
        with pytest.raises(Disconnected, match="gone"):
            line.read(2.0)
        with pytest.raises(Disconnected):
            line.write(b"x" * 100)
        line.close()
        port.replug()
        with Transport(port.url, clock=RealClock()) as again:
            again.write(b"back")
            assert again.read(1.0).startswith(b"b")
