"""A serial line: opened exclusively, read and written with time-outs, every byte recorded; and the operator's terminal
in place of one.

The code depends on these properties of pyserial 3.5: a vanished pty or adapter raises `SerialException` from `read` and
`write` but a bare `OSError` from `in_waiting`, `TypeError` where another thread has just closed it, and
`termios.error`, which is neither, from an open; a `socket://` line reports at most one waiting byte; without a write
time-out a stuck peer blocks for ever; an exclusive open does not exclude openers that are not exclusive, hence the
additional lock file.
"""

import contextlib
import hashlib
import os
import select
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, Literal

import serial

from gradcal_jax.hardware.clock import Clock, RealClock
from gradcal_jax.hardware.errors import Disconnected, HardwareError, PortRefused, PortTaken
from gradcal_jax.hardware.journal import Direction, Recorder
from gradcal_jax.tables.locking import take

Parity = Literal["N", "E", "O"]
_MOST = 65536  # bytes read at once
_WRITE_TIMEOUT_S = 2.0
owner = ""
"""What uses the ports of this process, for messages of other processes; empty: the process is named by its number."""


def same_port(url: str) -> str:
    """One text for all names of a port: an adapter has several. The number of a pseudo-terminal is given to another
    while a process that ends still holds the lock: it goes with the time at which it was made."""
    if not url.startswith("/"):
        return url
    path = os.path.realpath(url)
    if path.startswith("/dev/pts/"):
        with contextlib.suppress(OSError):
            return f"{path} {os.stat(path).st_ctime_ns}"
    return path


class PortLock:
    """One process, one port: a lock file that the operating system releases when its owner dies. All accounts of a
    computer share it."""

    def __init__(self, url: str) -> None:
        name = f"gradcal-port-{hashlib.sha256(same_port(url).encode()).hexdigest()[:24]}.lock"
        path = Path(tempfile.gettempdir()) / name
        try:
            self._handle = _opened(path)
        except OSError as problem:
            raise PortRefused(
                f"The port {url} cannot be locked against other runs: {path}: {problem.strerror}. Give every account "
                "that uses the rig write permission for this file, or remove it while no run is active."
            ) from None
        try:
            take(self._handle)
        except OSError:
            holds = os.pread(self._handle, 200, 1).decode("utf-8", "replace").strip() if os.name == "posix" else ""
            os.close(self._handle)
            raise PortTaken(
                f"The port {url} is in use by another run{f' ({holds})' if holds else ''}. "
                "Wait until it ends or give this run another port."
            ) from None
        # A full disk must not block a port: the name of its owner is only information.
        with contextlib.suppress(OSError):
            os.ftruncate(self._handle, 0)
            # The first byte belongs to the lock (Windows locks a byte range), the note begins behind it.
            holds = owner or f"process {os.getpid()}"
            os.write(self._handle, f"\n{holds}, since {time.strftime('%Y-%m-%d %H:%M:%S')}\n".encode())

    def release(self) -> None:
        # The file stays: unlinking it would let two processes hold locks on two files of one name.
        os.close(self._handle)


def _opened(path: Path) -> int:
    """The lock file, not by way of a link: its target would be changed."""
    flags = os.O_RDWR | getattr(os, "O_NOFOLLOW", 0)
    try:
        # Linux may forbid O_CREAT for a file of another account in a folder that is writable for all.
        return os.open(path, flags)
    except FileNotFoundError:
        handle = os.open(path, flags | os.O_CREAT, 0o666)
        if sys.platform != "win32":
            os.fchmod(handle, 0o666)
        return handle


def _refused(url: str, problem: BaseException) -> PortRefused:
    # pyserial adds its own words to the system's message, with number and name twice.
    why = str(problem).rpartition("] ")[2].removesuffix(f": {url!r}")
    return PortRefused(
        f"The port {url} cannot be opened: {why}. Check its name, the cable, the permissions of your account, and "
        "that no other program uses it."
    )


class Transport(contextlib.AbstractContextManager["Transport"]):
    """Bytes to and from one port.

    `url` is a device path, `COM3`, or any URL of `serial.serial_for_url`, such as `socket://192.168.0.7:10001`.
    `read` returns the waiting bytes, as soon as there are any. All methods raise `Disconnected` once the port is gone.
    """

    def __init__(
        self,
        url: str,
        *,
        clock: Clock,
        baudrate: int = 9600,
        bytesize: int = 8,
        parity: Parity = "N",
        stopbits: int = 1,
        recorder: Recorder | None = None,
    ) -> None:
        self.url = url
        self._clock = clock
        self._recorder = recorder
        self._lock = PortLock(url)
        try:
            port: Any = serial.serial_for_url(url, do_not_open=True)
            port.baudrate, port.bytesize, port.parity, port.stopbits = baudrate, bytesize, parity, stopbits
            port.timeout, port.write_timeout = 0.1, _WRITE_TIMEOUT_S
            if "://" not in url:
                port.exclusive = True
            port.open()
        except BaseException as problem:
            self._lock.release()
            if not isinstance(problem, Exception):
                raise
            raise _refused(url, problem) from None
        self._port, self._is_socket, self._closed = port, url.startswith("socket://"), False
        self.late = ""
        """The newest reply that came after its time-out, for the operator; empty: none."""

    def reopen(self) -> None:
        """Open the port once more, after its cable was out. Raises `PortRefused`."""
        if self._closed:
            raise Disconnected(f"The port {self.url} was closed.")
        with contextlib.suppress(Exception):
            self._port.close()
        try:
            self._port.open()
        except Exception as problem:
            raise _refused(self.url, problem) from None

    def write(self, data: bytes) -> None:
        now = self._clock.now()
        try:
            self._port.write(data)
        except serial.SerialTimeoutException:
            raise Disconnected(
                f"The port {self.url} accepts no data: {len(data)} bytes were not written in {_WRITE_TIMEOUT_S} s. "
                "Check flow control and that the device is on."
            ) from None
        except Exception as problem:
            raise self._gone(problem) from None
        finally:
            self._record(now, ">", data)

    def read(self, timeout_s: float) -> bytes:
        return self.read_stamped(timeout_s)[0]

    def read_stamped(self, timeout_s: float) -> tuple[bytes, float]:
        """Like `read`, with the clock's time of arrival."""
        try:
            self._set_timeout(timeout_s)
            data: bytes = self._port.read(1)
            if data:
                if self._is_socket:
                    self._set_timeout(0.0)
                    data += self._port.read(_MOST - 1)
                elif (waiting := min(self._port.in_waiting, _MOST - 1)) > 0:
                    data += self._port.read(waiting)
        except Exception as problem:
            raise self._gone(problem) from None
        now = self._clock.now()
        if data:
            self._record(now, "<", data)
        return data, now

    def drain(self, quiet_s: float = 0.0, *, longest_s: float = 2.0) -> bytes:
        """Read and return (and record) bytes until none came for `quiet_s`, for at most `longest_s`."""
        dropped, end = b"", time.monotonic() + longest_s
        while chunk := self.read(quiet_s):
            dropped += chunk
            if time.monotonic() > end:
                break
        return dropped

    def close(self) -> None:
        """Idempotent, and never raises, because it runs after failures."""
        if self._closed:
            return
        self._closed = True
        with contextlib.suppress(Exception):
            self._port.close()
        self._lock.release()

    def __exit__(self, *_: object) -> None:
        self.close()

    def _set_timeout(self, timeout_s: float) -> None:
        if self._port.timeout != timeout_s:
            self._port.timeout = timeout_s

    def _record(self, time_s: float, direction: Direction, data: bytes) -> None:
        """After the bytes were sent: no recorder keeps a stop off the wire, whatever it raises."""
        if self._recorder is not None:
            with contextlib.suppress(Exception):
                self._recorder(time_s, direction, data)

    def _gone(self, problem: Exception) -> Disconnected:
        return Disconnected(f"The port {self.url} is gone ({problem}). Check the cable and the device's power.")


_CLEAR = "\r\x1b[2K"


class Terminal:
    """Line `terminal`. Without a keyboard there is no operator, and a question, a line without an end, raises
    `HardwareError`. `asking`: one is shown, and no other text may be drawn on the terminal."""

    url = "terminal"

    def __init__(self, *, keyboard: int | None = None, screen: Any = None) -> None:
        self._keyboard, self._screen = keyboard, screen
        self.clock: Clock = RealClock()
        self.recorder: Recorder | None = None
        self.asking = False

    def write(self, data: bytes) -> None:
        if self._keyboard is None or self._screen is None:
            raise HardwareError("An axis is turned by hand, and there is no terminal at which to ask the operator.")
        self._record(">", data)
        text = data.decode("utf-8", "replace")
        if text.strip("\a"):
            cleared = "" if self.asking or not self._screen.isatty() else _CLEAR
            self.asking = not text.endswith("\n")
            text = cleared + text
        self._screen.write(text)
        self._screen.flush()

    def read_stamped(self, timeout_s: float) -> tuple[bytes, float]:
        """Typed text, as soon as a line is complete. Raises `Disconnected` at the end of all input (Ctrl-D)."""
        assert self._keyboard is not None
        # Windows cannot wait for a console with a time-out; the reading thread is abandoned at the end.
        if sys.platform != "win32" and not select.select([self._keyboard], [], [], timeout_s)[0]:
            return b"", self.clock.now()
        try:
            data = os.read(self._keyboard, 4096)
        except OSError as problem:
            raise Disconnected(f"The terminal is gone ({problem.strerror}).") from None
        if not data:
            raise Disconnected(
                "The terminal has no more input (Ctrl-D, or it was closed): the operator cannot be asked."
            )
        now = self.clock.now()
        self._record("<", data)
        if data.endswith(b"\n"):
            self.asking = False
        return data, now

    def close(self) -> None: ...

    def _record(self, direction: Any, data: bytes) -> None:
        if self.recorder is not None:
            self.recorder(self.clock.now(), direction, data)


TextLine = Transport | Terminal
"""What the driver of a text protocol writes to and reads from."""
