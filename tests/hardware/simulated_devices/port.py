"""The other end of a serial line of the system: a pseudo-terminal, or a TCP port, with a simulated device behind it.

For other processes and for the transport's own tests; within one process a line in memory is enough (`wire`), and here
its host is a thread that hands bytes on. The port keeps its own descriptor of the terminal's other side open, because
reading a terminal without one is an error. A terminal has no baud rate: a wrong one cannot be simulated.
"""

import os
import pty
import select
import socket
import tempfile
import threading
import time
import tty
from contextlib import suppress
from pathlib import Path

from simulated_devices.wire import Wire

from gradcal_jax.hardware.clock import RealClock

_LOOKS_S, _TO_FETCH_S = 0.005, 0.2


class FastClock(RealClock):
    """The computer's clock with shorter seconds, in processes whose clocks have the same speed."""

    def __init__(self, speed):
        self.speed = speed

    def now(self):
        return RealClock.now(self) * self.speed

    def sleep_until(self, time_s):
        while (left := time_s - self.now()) > 0.0:
            time.sleep(left / self.speed)


class SimulatedPort(Wire):
    """Serves a device (see `wire`) at `url`, from `open` to the end of the context, in real time. The name of a
    pseudo-terminal lasts, which allows `unplug` and `replug`. If the host does not read, bytes are dropped and counted,
    as a UART does."""

    def __init__(self, device, clock, *, on_socket=False):
        super().__init__(device, clock)
        self.by_url.pop(self.url)
        self._folder = tempfile.TemporaryDirectory(prefix="gradcal-sim-")
        self._of_port, self._stop = threading.Lock(), threading.Event()
        self._ends = ()
        self._listener = None
        self._thread = threading.Thread(target=self._serve, daemon=True)
        if on_socket:
            self._listener = socket.create_server(("127.0.0.1", 0))
            self._listener.settimeout(0.05)
            self.url = f"socket://127.0.0.1:{self._listener.getsockname()[1]}"
        else:
            self.url = str(Path(self._folder.name) / "port")
            self.replug()

    def open(self):
        if not self._thread.ident:
            self._thread.start()
        return self

    __enter__ = open

    def __exit__(self, *_):
        self._stop.set()
        if self._thread.ident:
            self._thread.join(timeout=5.0)
        self._hang_up()
        if self._listener is not None:
            self._listener.close()
        self._folder.cleanup()

    def unplug(self):
        """Pull the cable: the host's port is gone, and its name too, so that no other port answers to it."""
        Path(self.url).unlink(missing_ok=True)
        self._hang_up()

    def replug(self):
        master, slave = pty.openpty()
        # A terminal that is not raw echoes and turns CR into LF.
        tty.setraw(slave)
        Path(self.url).unlink(missing_ok=True)
        Path(self.url).symlink_to(os.ttyname(slave))
        self._keep(master, slave)

    def _keep(self, *ends):
        os.set_blocking(ends[0], False)
        with self._of_port:
            self._ends = ends

    def _hang_up(self):
        with self._of_port:
            ends, self._ends = self._ends, ()
        for end in ends:
            os.close(end)

    def _serve(self):
        while not self._stop.is_set():
            with suppress(OSError, ValueError):
                if data := self._from_host():
                    self.write(data)
                self._to_host_now(self.read(0.0))

    def _from_host(self):
        if self._listener is not None and not self._ends:
            connection, _ = self._listener.accept()
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._keep(connection.detach())
        if not self._ends or not select.select(self._ends[:1], [], [], _LOOKS_S)[0]:
            time.sleep(0.0 if self._ends else 0.02)
            return b""
        with self._of_port:
            # After unplugging, the descriptor's number may belong to another file.
            data = os.read(self._ends[0], 4096) if self._ends else b""
        if not data and self._listener is not None:
            self._hang_up()
        return data

    def _to_host_now(self, data):
        """What the terminal takes; the rest is dropped, where the host fetches nothing for a while."""
        while data:
            with self._of_port, suppress(BlockingIOError):
                data = data[os.write(self._ends[0], data) if self._ends else len(data) :]
            if data and not select.select([], self._ends[:1], [], _TO_FETCH_S)[1]:
                self.lost_bytes += len(data)
                return
