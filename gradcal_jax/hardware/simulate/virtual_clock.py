"""A virtual clock that skips the waiting, for runs on simulated devices.

The time stands still while any party works and jumps to the next wake-up when all parties wait. A run of hours then
takes as long as its computation, with the same code and the same order of events.
"""

import heapq
import itertools
import threading
import time
from collections.abc import Generator
from contextlib import contextmanager


class VirtualClock:
    """Time that advances only when every party waits on it. A thread that must hold the time while it works uses
    `party()`.

    `speed` limits the rate to that many virtual seconds per real second; without it time runs as fast as possible.
    """

    def __init__(self, start_s: float = 0.0, *, speed: float | None = None) -> None:
        if speed is not None and not speed > 0.0:
            raise ValueError(f"The speed of the virtual clock is {speed}; give a number above zero.")
        self.lock = threading.Lock()
        self._now = start_s
        self._speed = speed
        self._origin = (start_s, time.monotonic())
        self._order = itertools.count()
        self._sleepers: list[tuple[float, int, threading.Lock]] = []
        self._working = 0
        self._members: dict[int, int] = {}

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
        self._await(gate)
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

    def advance_if_all_wait(self) -> None:
        """Wake the next sleepers when no party works. The caller holds `lock`."""
        if self._working or not self._sleepers or self._is_held():
            return
        self._now = max(self._now, self._sleepers[0][0])
        while self._sleepers and self._sleepers[0][0] <= self._now:
            _, _, gate = heapq.heappop(self._sleepers)
            self._working += 1
            gate.release()

    def _await(self, gate: threading.Lock) -> None:
        gate.acquire()

    def _is_held(self) -> bool:
        """Whether something beside the parties holds the time."""
        return False
