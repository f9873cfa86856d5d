"""A virtual clock for simulated devices behind lines: it waits for the bytes that are under way, too.

Time-outs of a serial line are never virtual: they are in real seconds. A waiting driver holds the time until its line
has been silent for a moment; from then on virtual time passes at the real rate, so that a device that does not answer
stops no other party.
"""

import threading
import time
from collections.abc import Generator
from contextlib import contextmanager, nullcontext
from typing import Any

from gradcal_jax.hardware import setup
from gradcal_jax.hardware.clock import Clock, RealClock, VirtualClock
from gradcal_jax.hardware.transport import Transport

_PACE_S = 0.005
# What was sent before a look into a line lies there soon.
_LOOK_S = 0.005
_ATTENTIVE_S = 0.1


class FastClock(RealClock):
    """The computer's clock with shorter seconds, in processes whose clocks have the same speed."""

    def __init__(self, speed: float) -> None:
        self.speed = speed

    def now(self) -> float:
        return RealClock.now(self) * self.speed

    def sleep_until(self, time_s: float) -> None:
        while (left := time_s - self.now()) > 0.0:
            time.sleep(left / self.speed)


class Link:
    """Accounts for the bytes on their way over one line, so that virtual time does not overtake them. On real time
    there is nothing to account for."""

    def change(
        self, *, to_device: int = 0, to_host: int = 0, attached: bool | None = None, host_is_there: bool | None = None
    ) -> None:
        """Add to the bytes under way (negative: they arrived), or note that the host opened or left the line, that it
        waits for its bytes, or that it only looked for some."""


def link_of(clock: Clock, url: str) -> Link:
    return clock.link(url) if isinstance(clock, LineClock) else Link()


class CountedTransport(Transport):
    """A line whose bytes are counted, and that waits on silence at the real pace of virtual time."""

    def __init__(self, url: str, *, clock: Clock, **settings: Any) -> None:
        self._silent = self._written = False
        self._link = link_of(clock, url)
        Transport.__init__(self, url, clock=clock, **settings)
        self._link.change(attached=True)

    def reopen(self) -> None:
        Transport.reopen(self)
        self._link.change(attached=True)

    def write(self, data: bytes) -> None:
        self._link.change(to_device=len(data), host_is_there=True)
        self._silent, self._written = False, True
        Transport.write(self, data)

    def read_stamped(self, timeout_s: float) -> tuple[bytes, float]:
        if timeout_s <= 0.0:
            data, now = Transport.read_stamped(self, 0.0 if self._written else _LOOK_S)
            self._link.change(host_is_there=False)
            return data, now
        self._link.change(host_is_there=True)
        data, now = b"", self._clock.now()
        if not self._silent:
            data, now = Transport.read_stamped(self, min(timeout_s, _ATTENTIVE_S))
            timeout_s -= _ATTENTIVE_S
        if not data and timeout_s > 0.0:
            # From the start of this reading virtual time runs on: a late reply has to come within it.
            with self._clock.real_pace() if isinstance(self._clock, LineClock) else nullcontext():
                data, now = Transport.read_stamped(self, timeout_s)
        self._silent = not data
        if data:
            # Counted after the stamp: virtual time cannot have moved between arrival and stamp.
            self._link.change(to_host=-len(data), host_is_there=True)
        return data, now

    def close(self) -> None:
        if not self._closed:
            self._link.change(attached=False)
        Transport.close(self)


# Every line that a test opens by a rig file is counted.
setup.Transport = CountedTransport  # type: ignore[misc]


class _Account(Link):
    """Bytes written and not yet handled, each way, of one line; guarded by the clock's lock."""

    def __init__(self, clock: "LineClock") -> None:
        self._clock = clock
        self.attached = False
        self.abandoned = False
        self.to_device = 0
        self.to_host = 0
        self.unread_since: float | None = None

    def change(
        self, *, to_device: int = 0, to_host: int = 0, attached: bool | None = None, host_is_there: bool | None = None
    ) -> None:
        with self._clock.lock:
            if attached is not None:
                # Until the host writes or waits, what a device says by itself holds no time.
                self.attached, self.abandoned, self.to_device, self.to_host = attached, True, 0, 0
            elif host_is_there is False:
                self.abandoned, self.to_host = True, 0
            elif self.attached:
                # A reopened line may receive answers to bytes that are no longer counted: never below zero.
                self.to_device = max(0, self.to_device + to_device)
                # Bytes from a device to a line that is not read do not count.
                self.to_host = max(0, self.to_host + (0 if self.abandoned and not host_is_there else to_host))
                self.abandoned = self.abandoned and not host_is_there
            self.unread_since = None
            self._clock.advance_if_all_wait()


class LineClock(VirtualClock):
    """Time that advances only when every party waits on it and every line is quiet.

    A line whose bytes are not read for `patience_s` real seconds (an open port that no driver reads; on a busy computer
    any reader may be a second late) no longer holds the time until the host uses it again.
    """

    def __init__(self, start_s: float = 0.0, *, speed: float | None = None, patience_s: float = 1.5) -> None:
        super().__init__(start_s, speed=speed)
        self._patience_s = patience_s
        self._accounts: dict[str, _Account] = {}
        self._real_waiters = 0
        self._paced_from = self._origin
        self._pacer: threading.Thread | None = None

    @contextmanager
    def real_pace(self) -> Generator[None, None, None]:
        with self.lock:
            member = threading.get_ident() in self._members
            if member:
                if not self._real_waiters:
                    self._paced_from = (self._now, time.monotonic())
                self._working -= 1
                self._real_waiters += 1
                if self._pacer is None:
                    self._pacer = threading.Thread(target=self._pace, daemon=True, name="real pace")
                    self._pacer.start()
        try:
            yield
        finally:
            if member:
                with self.lock:
                    self._working += 1
                    self._real_waiters -= 1

    def _pace(self) -> None:
        """Wakes the sleepers in time, as long as a party waits on a silent line."""
        while True:
            with self.lock:
                if not self._real_waiters:
                    self._pacer = None
                    return
                self.advance_if_all_wait()
            time.sleep(_PACE_S)

    def link(self, url: str) -> Link:
        with self.lock:
            return self._accounts.setdefault(url, _Account(self))

    def _await(self, gate: threading.Lock) -> None:
        while not gate.acquire(timeout=self._patience_s / 8.0):
            with self.lock:
                self._forget_unread_bytes()
                self.advance_if_all_wait()

    def advance_if_all_wait(self) -> None:
        if self._sleepers and not self._is_held():
            VirtualClock.advance_if_all_wait(self)

    def _is_held(self) -> bool:
        """Whether something beside the parties holds the time."""
        if any(account.attached and (account.to_device or account.to_host) for account in self._accounts.values()):
            return True
        if self._real_waiters:
            virtual, real = self._paced_from
            return self._sleepers[0][0] > virtual + time.monotonic() - real
        return False

    def _forget_unread_bytes(self) -> None:
        real = time.monotonic()
        for account in self._accounts.values():
            if not (account.to_device or account.to_host):
                continue
            if account.unread_since is None:
                account.unread_since = real
            elif real - account.unread_since >= self._patience_s:
                account.to_device = account.to_host = 0
                account.abandoned = True
