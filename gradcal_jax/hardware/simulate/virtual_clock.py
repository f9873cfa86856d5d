"""A virtual clock that skips the waiting, for runs on simulated devices.

The time stands still while any party works and jumps to the next wake-up when all parties wait and no byte is under way
between a driver and a simulated device. A run of hours then takes as long as its computation, with the same code, the
same bytes and the same order of events. Time-outs of a serial line are never virtual: they are in real seconds. A
waiting driver holds the time until its line has been silent for a moment; from then on virtual time passes at the real
rate, so that a device that does not answer stops no other party.
"""

import heapq
import itertools
import threading
import time
from collections.abc import Generator
from contextlib import contextmanager

from ..clock import Link

_PACE_S = 0.005


class _Account(Link):
    """Bytes written and not yet handled, each way, of one line; guarded by the clock's lock."""

    def __init__(self, clock: "VirtualClock") -> None:
        self._clock = clock
        self.attached = False
        self.abandoned = False
        self.to_device = 0
        self.to_host = 0
        self.unread_since: float | None = None

    def change(
        self, *, to_device: int = 0, to_host: int = 0, attached: bool | None = None, host_is_there: bool = False
    ) -> None:
        with self._clock.lock:
            if attached is not None:
                self.attached, self.abandoned, self.to_device, self.to_host = attached, False, 0, 0
            elif self.attached:
                # A reopened line may receive answers to bytes that are no longer counted: never below zero.
                self.to_device = max(0, self.to_device + to_device)
                # Bytes from a device to a line that is not read do not count.
                self.to_host = max(0, self.to_host + (0 if self.abandoned and not host_is_there else to_host))
                self.abandoned = self.abandoned and not host_is_there
            self.unread_since = None
            self._clock.advance_if_all_wait()


class VirtualClock:
    """Time that advances only when every party waits on it and every line is quiet.

    A thread that must hold the time while it works uses `party()`. A line whose bytes are not read for `patience_s`
    real seconds (an open port that no driver reads; on a busy computer any reader may be a second late) no longer holds
    the time until the host uses it again.

    `speed` limits the rate to that many virtual seconds per real second; without it time runs as fast as possible.
    """

    def __init__(self, start_s: float = 0.0, *, speed: float | None = None, patience_s: float = 1.5) -> None:
        if speed is not None and not speed > 0.0:
            raise ValueError(f"The speed of the virtual clock is {speed}; give a number above zero.")
        self.lock = threading.Lock()
        self._now = start_s
        self._speed = speed
        self._origin = (start_s, time.monotonic())
        self._patience_s = patience_s
        self._order = itertools.count()
        self._sleepers: list[tuple[float, int, threading.Lock]] = []
        self._working = 0
        self._members: dict[int, int] = {}
        self._accounts: dict[str, _Account] = {}
        self._real_waiters = 0
        self._paced_from = self._origin
        self._pacer: threading.Thread | None = None

    def now(self) -> float:
        return self._now

    def sleep(self, duration_s: float) -> None:
        self.sleep_until(self._now + duration_s)

    def sleep_until(self, time_s: float) -> None:
        gate = threading.Lock()
        gate.acquire()
        with self.lock:
            if time_s <= self._now:
                return
            member = threading.get_ident() in self._members
            heapq.heappush(self._sleepers, (time_s, next(self._order), gate))
            self._working -= member
            self.advance_if_all_wait()
        while not gate.acquire(timeout=self._patience_s):
            with self.lock:
                self._forget_unread_bytes()
                self.advance_if_all_wait()
        # A woken thread counts as working from the time of waking, before it has run.
        if not member:
            with self.lock:
                self._working -= 1
                self.advance_if_all_wait()
        if self._speed is not None:
            virtual_origin, real_origin = self._origin
            due = real_origin + (self._now - virtual_origin) / self._speed
            time.sleep(max(due - time.monotonic(), 0.0))

    @contextmanager
    def party(self) -> Generator[None, None, None]:
        thread = threading.get_ident()
        with self.lock:
            self._members[thread] = self._members.get(thread, 0) + 1
            self._working += self._members[thread] == 1
        try:
            yield
        finally:
            with self.lock:
                self._members[thread] -= 1
                if not self._members[thread]:
                    del self._members[thread]
                    self._working -= 1
                self.advance_if_all_wait()

    @contextmanager
    def aside(self) -> Generator[None, None, None]:
        thread = threading.get_ident()
        with self.lock:
            depth = self._members.pop(thread, 0)
            self._working -= depth > 0
            self.advance_if_all_wait()
        try:
            yield
        finally:
            with self.lock:
                if depth:
                    self._members[thread] = depth
                    self._working += 1

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

    def advance_if_all_wait(self) -> None:
        """Wake the next sleepers when no party works and no byte is under way. The caller holds `lock`."""
        if self._working or not self._sleepers:
            return
        if any(account.attached and (account.to_device or account.to_host) for account in self._accounts.values()):
            return
        if self._real_waiters:
            virtual, real = self._paced_from
            if self._sleepers[0][0] > virtual + time.monotonic() - real:
                return
        self._now = max(self._now, self._sleepers[0][0])
        while self._sleepers and self._sleepers[0][0] <= self._now:
            _, _, gate = heapq.heappop(self._sleepers)
            self._working += 1
            gate.release()

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
