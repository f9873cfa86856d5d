"""The other end of a serial line: a pseudo-terminal (Linux, macOS) or a TCP port, with a simulated device behind it.

A device is a class with `receive(data) -> replies`; a device that sends by itself also has `next_emission_s()` and
`emit()`. The port keeps its own descriptor of the terminal's other side open, because reading a terminal without one is
an error. If the host does not read, the port drops bytes and counts them, as a UART does. A terminal holds some twenty
kilobytes, so a larger burst (of a device that was delayed) waits a moment for the host.

A terminal has no baud rate: a wrong one cannot be simulated.
"""

import os
import select
import socket
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Protocol, runtime_checkable

from simulated_devices.line_clock import link_of

from gradcal_jax.hardware.clock import Clock

if sys.platform != "win32":
    import pty
    import tty


_TO_FETCH_S = 0.2

Spoils = Callable[[bytes], list[bytes]]
"""The bytes that arrive in place of a message."""


class SimulatedDevice(Protocol):
    """A device that answers. `receive` takes bytes in pieces of any size, and returns whole messages."""

    def receive(self, data: bytes) -> list[bytes]: ...


@runtime_checkable
class StreamingDevice(SimulatedDevice, Protocol):
    """A device that also sends by itself."""

    def next_emission_s(self) -> float | None:
        """The time of its next message, on the run's clock; None while it is silent."""
        ...

    def emit(self, now_s: float) -> list[bytes]:
        """The messages due by `now_s`."""
        ...


class SimulatedPort:
    """Serves a device at `url` from `open` to `close`. Also a context manager.

    `on_socket` serves TCP on this computer (the only way on Windows); else a pseudo-terminal under a lasting name,
    which allows `unplug` and `replug`.
    """

    def __init__(
        self,
        device: SimulatedDevice | StreamingDevice,
        clock: Clock,
        *,
        faults: Spoils | None = None,
        commands: Spoils | None = None,
        on_socket: bool = False,
    ) -> None:
        self.device = device
        self.faults, self.commands = faults, commands
        """Changes to the bytes from and to the device; None: they arrive unchanged."""
        self.lost_bytes = 0
        self._clock = clock
        self._on_socket = on_socket or sys.platform == "win32"
        self._folder = tempfile.TemporaryDirectory(prefix="gradcal-sim-")
        self._device_lock = threading.Lock()
        self._send_lock = threading.Lock()
        self._nobody_reads = False
        self._stop = threading.Event()
        self._speaks, self._heeded = threading.Event(), threading.Event()
        self._is_silent = True
        self._master = self._slave = -1
        self._listener: socket.socket | None = None
        self._connection: socket.socket | None = None
        self._threads: list[threading.Thread] = []
        if self._on_socket:
            self._listener = socket.create_server(("127.0.0.1", 0))
            self._listener.settimeout(0.05)
            self.url = f"socket://127.0.0.1:{self._listener.getsockname()[1]}"
        else:
            self.url = str(Path(self._folder.name) / "port")
            self._plug_in()
        self._link = link_of(clock, self.url)

    def open(self) -> "SimulatedPort":
        loops = [self._serve] + ([self._speak] if isinstance(self.device, StreamingDevice) else [])
        for loop in loops:
            thread = threading.Thread(target=loop, daemon=True, name=f"simulated {type(self.device).__name__}")
            thread.start()
            self._threads.append(thread)
        return self

    def close(self) -> None:
        self._stop.set()
        self._speaks.set()
        self._link.change(attached=False)
        for thread in self._threads:
            thread.join(timeout=5.0)
        self._hang_up()
        if self._listener is not None:
            self._listener.close()
        self._folder.cleanup()

    def __enter__(self) -> "SimulatedPort":
        return self.open()

    def __exit__(self, *_: object) -> None:
        self.close()

    def unplug(self) -> None:
        """Pull the cable: the host's port is gone, and its name too, so that no other port answers to it."""
        self._link.change(attached=False)
        if not self._on_socket:
            Path(self.url).unlink(missing_ok=True)
        self._hang_up()

    def replug(self) -> None:
        if not self._on_socket and self._master < 0:
            self._plug_in()

    def say(self, message: bytes) -> None:
        """Send unsolicited bytes: an alert, line noise."""
        self._send(message)

    def _plug_in(self) -> None:
        master, slave = pty.openpty()
        # A terminal that is not raw echoes and turns CR into LF.
        tty.setraw(slave)
        os.set_blocking(master, False)
        name = Path(self.url)
        name.unlink(missing_ok=True)
        name.symlink_to(os.ttyname(slave))
        self._master, self._slave = master, slave

    def _hang_up(self) -> None:
        with self._send_lock:
            if self._master >= 0:
                master, slave, self._master, self._slave = self._master, self._slave, -1, -1
                os.close(master)
                os.close(slave)
            if self._connection is not None:
                connection, self._connection = self._connection, None
                connection.close()

    def _serve(self) -> None:
        while not self._stop.is_set():
            try:
                data = self._receive()
            except OSError:
                data = b""
                time.sleep(0.01)
            if not data:
                continue
            for message in self.commands(data) if self.commands is not None else [data]:
                with self._device_lock:
                    replies = self.device.receive(message)
                for reply in replies:
                    self._deliver(reply)
            if isinstance(self.device, StreamingDevice):
                self._speak_up(self.device)
            # Only now is the message counted as handled: virtual time waits for its effect and reply.
            self._link.change(to_device=-len(data))

    def _speak_up(self, device: StreamingDevice) -> None:
        """Hold virtual time until a device that was silent waits for its next message."""
        self._heeded.clear()
        self._speaks.set()
        while not self._stop.is_set():
            with self._device_lock:
                if not self._is_silent or device.next_emission_s() is None:
                    return
            self._heeded.wait(0.5)

    def _receive(self) -> bytes:
        if self._listener is not None and self._connection is None:
            try:
                connection, _ = self._listener.accept()
            except TimeoutError:
                return b""
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            with self._send_lock:
                self._connection = connection
        if self._connection is not None:
            ready, _, _ = select.select([self._connection], [], [], 0.05)
            if not ready:
                return b""
            data = self._connection.recv(4096)
            if not data:
                self._hang_up()
            return data
        master = self._master
        if master < 0:
            time.sleep(0.02)
            return b""
        ready, _, _ = select.select([master], [], [], 0.05)
        with self._send_lock:
            # After unplugging, the descriptor's number may belong to another file.
            return os.read(master, 4096) if ready and self._master == master else b""

    def _speak(self) -> None:
        device = self.device
        assert isinstance(device, StreamingDevice)
        with self._clock.party():
            while not self._stop.is_set():
                with self._device_lock:
                    due_s = device.next_emission_s()
                    self._is_silent = due_s is None
                    if due_s is not None:
                        self._heeded.set()
                if due_s is None:
                    with self._clock.aside():
                        self._speaks.wait(0.5)
                        self._speaks.clear()
                    continue
                self._clock.sleep_until(due_s)
                with self._device_lock:
                    messages = device.emit(self._clock.now())
                for message in messages if self.faults is not None else [b"".join(messages)]:
                    self._deliver(message)

    def _deliver(self, message: bytes) -> None:
        for index, chunk in enumerate([message] if (spoils := self.faults) is None else spoils(message)):
            if index:
                time.sleep(0.01)
            self._send(chunk)

    def _send(self, data: bytes) -> None:
        with self._send_lock:
            self._link.change(to_host=len(data))
            unsent = data
            try:
                while unsent and self._master >= 0:
                    unsent = unsent[self._write(unsent) :]
                if unsent and self._connection is not None:
                    self._connection.sendall(unsent)
                    unsent = b""
            except OSError:
                pass  # full (the host does not read) or gone: the bytes are lost, as on a line
            if unsent:
                self.lost_bytes += len(unsent)
                self._link.change(to_host=-len(unsent))

    def _write(self, data: bytes) -> int:
        """The number of bytes written. Raises `BlockingIOError` where the terminal is full and is not read."""
        try:
            count = os.write(self._master, data)
        except BlockingIOError:
            if self._nobody_reads or not select.select([], [self._master], [], _TO_FETCH_S)[1]:
                self._nobody_reads = True
                raise
            return 0
        self._nobody_reads = False
        return count
