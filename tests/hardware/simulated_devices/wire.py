"""A serial line in memory: the host's end has the methods of `Transport`, the other end is a simulated device.

No thread and no descriptor: a message is handled when it is written, and a reading waits on the run's clock. What a
time-out, a late reply or a boot takes passes on that clock. A device is a class with `receive(data) -> replies`; one
that sends by itself has `next_emission_s()` and `emit(now_s)`, too, and is asked whenever the line is used.
"""

import itertools
import threading
from contextlib import suppress
from typing import ClassVar

from simulated_devices.faults import arrivals

from gradcal_jax.hardware import setup
from gradcal_jax.hardware.clock import holding
from gradcal_jax.hardware.errors import Disconnected, PortRefused
from gradcal_jax.hardware.transport import Transport

_LOOKS_S = 0.05
# Of a device that nobody reads: what a port holds.
_HOLDS_BYTES = 1 << 16


class Wire:
    """`faults` and `commands` spoil the bytes from and to the device; None: they arrive unchanged."""

    by_url: ClassVar[dict[str, "Wire"]] = {}
    _numbers = itertools.count()

    def __init__(self, device, clock, *, faults=None, commands=None):
        self.device, self.faults, self.commands = device, faults, commands
        self.url = f"/simulated/wire{next(self._numbers)}"
        self.lost_bytes, self.late, self.recorder = 0, "", None
        self._clock, self._lock = clock, threading.RLock()
        self._is_open = self._plugged = True
        self._to_device = []
        self._to_host = []
        self._held = 0
        self.by_url[self.url] = self

    # The device's end.

    def open(self):
        return self

    __enter__ = open

    def __exit__(self, *_):
        self.close()
        self.by_url.pop(self.url, None)

    def unplug(self):
        """Pull the cable: the port is gone."""
        self._plugged = False

    def replug(self):
        self._plugged = True

    def say(self, message):
        """Send unsolicited bytes: an alert, line noise."""
        with self._lock:
            self._send(self._to_host, message, None)

    # The host's end.

    def opened(self, recorder):
        if not self._plugged:
            raise PortRefused(f"The port {self.url} cannot be opened: it is unplugged.")
        self.recorder, self._is_open = recorder, True
        return self

    def reopen(self):
        self.opened(self.recorder)

    def write(self, data):
        self._require_plugged()
        self._record(self._clock.now(), ">", data)
        with holding(self._lock, self._clock):
            self._send(self._to_device, data, self.commands)
            self._tick()

    def read(self, timeout_s):
        return self.read_stamped(timeout_s)[0]

    def read_stamped(self, timeout_s):
        with self._clock.party():
            end_s = self._clock.now() + timeout_s
            while True:
                self._require_plugged()
                with holding(self._lock, self._clock):
                    self._tick()
                    data, now_s = self._arrived(), self._clock.now()
                    dues_s = [due_s for due_s, _ in self._to_device[:1] + self._to_host[:1]]
                    dues_s += [] if (speaks_s := self._speaks_s()) is None else [speaks_s]
                if data or now_s >= end_s:
                    break
                self._clock.sleep_until(min(end_s, now_s + _LOOKS_S, *dues_s))
        if data:
            self._record(now_s, "<", data)
        return data, now_s

    def drain(self, quiet_s=0.0, *, longest_s=2.0):
        dropped, end_s = b"", self._clock.now() + longest_s
        while (chunk := self.read(quiet_s)) and self._clock.now() <= end_s:
            dropped += chunk
        return dropped

    def close(self):
        self._is_open = False

    def _speaks_s(self):
        return self.device.next_emission_s() if hasattr(self.device, "next_emission_s") else None

    def _tick(self):
        """What is under way arrives, and the device says what is due."""
        now_s = self._clock.now()
        while self._to_device and self._to_device[0][0] <= now_s:
            for reply in self.device.receive(self._to_device.pop(0)[1]):
                self._send(self._to_host, reply, self.faults)
        while (due_s := self._speaks_s()) is not None and due_s <= now_s:
            for message in self.device.emit(now_s):
                self._send(self._to_host, message, self.faults)

    def _send(self, way, message, spoils):
        if way is self._to_host and self._held > _HOLDS_BYTES:
            self.lost_bytes += len(message)
            return
        for after_s, chunk in arrivals(spoils, message):
            way.append((self._clock.now() + after_s, chunk))
            self._held += len(chunk) * (way is self._to_host)
        way.sort(key=lambda due: due[0])

    def _arrived(self):
        count, now_s = 0, self._clock.now()
        while count < len(self._to_host) and self._to_host[count][0] <= now_s:
            count += 1
        data = b"".join(chunk for _, chunk in self._to_host[:count])
        del self._to_host[:count]
        self._held -= len(data)
        return data

    def _record(self, time_s, direction, data):
        if self.recorder is not None:
            with suppress(Exception):
                self.recorder(time_s, direction, data)

    def _require_plugged(self):
        if not (self._plugged and self._is_open):
            raise Disconnected(f"The port {self.url} is gone. Check the cable and the device's power.")


def line_to(url, *, clock, recorder=None, **settings):
    """What a rig's port is opened by in the tests: a line in memory where it is one."""
    if url in Wire.by_url:
        return Wire.by_url[url].opened(recorder)
    return Transport(url, clock=clock, recorder=recorder, **settings)


setup.Transport = line_to  # type: ignore[misc]
