"""Clocks of a run.

All waiting for chambers and tables is on a `Clock`, never by `time.sleep`. `RealClock` waits really; `VirtualClock`,
for simulated devices only, skips the waiting.
"""

import heapq
import itertools
import threading
import time
from collections.abc import Callable, Generator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Protocol

# Linux's monotonic clock stops while the computer sleeps and the devices continue; this one does not stop.
_LOOKS_S = 0.01
_RUNS_ON = getattr(time, "CLOCK_BOOTTIME", None)


@contextmanager
def holding(lock: threading.RLock, clock: "Clock") -> Generator[None, None, None]:
    """Context that holds a lock, which is waited for on the clock, as by the thread that has it."""
    while not lock.acquire(blocking=False):
        clock.sleep(_LOOKS_S)
    try:
        yield
    finally:
        lock.release()


class Clock(Protocol):
    def now(self) -> float:
        """Seconds since an arbitrary origin; never goes back."""
        ...

    def sleep_until(self, time_s: float) -> None:
        """Return at `time_s` of this clock, at once if that is in the past."""

    def sleep(self, duration_s: float) -> None: ...

    def party(self) -> AbstractContextManager[None]:
        """Context in which virtual time stands still unless this thread waits on the clock."""
        ...


class RealClock:
    """The computer's monotonic clock: steps of the wall clock do not change it, and it includes the computer's
    sleep."""

    def now(self) -> float:
        return time.monotonic() if _RUNS_ON is None else time.clock_gettime(_RUNS_ON)

    def sleep_until(self, time_s: float) -> None:
        while (left := time_s - self.now()) > 0.0:
            time.sleep(left)

    def sleep(self, duration_s: float) -> None:
        self.sleep_until(self.now() + duration_s)

    def party(self) -> AbstractContextManager[None]:
        return nullcontext()


_BESIDE_S = 0.1


@contextmanager
def repeating(work: Callable[[], object], every_s: float) -> Generator[None, None, None]:
    """Context in which a thread of its own does `work` again and again, every so many real seconds and at the end."""
    over = threading.Event()

    def repeat() -> None:
        while not over.wait(every_s):
            work()
        work()

    thread = threading.Thread(target=repeat, daemon=True, name="repeating")
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join(timeout=35.0)


def in_thread(work: Callable[[], object], clock: Clock, failed: Callable[[Exception], object]) -> threading.Event:
    """Begin `work` in a thread of its own, a party of the clock; `failed` gets what it raises. Returns what is set at
    its end."""
    begun, over = threading.Event(), threading.Event()

    def attempt() -> None:
        with clock.party():
            begun.set()
            try:
                work()
            except Exception as problem:
                failed(problem)
            over.set()

    threading.Thread(target=attempt, daemon=True, name="beside the run").start()
    begun.wait()
    return over


def beside(work: Callable[[], object], clock: Clock, duties: Callable[[], None]) -> None:
    """Do `work`, which may wait for a device, in a thread of its own, and the `duties` of this thread beside it. Raises
    what either raises; where a duty does, nobody waits for the work any more."""
    problems: list[Exception] = []
    over = in_thread(work, clock, problems.append)
    while not over.is_set():
        duties()
        clock.sleep(_BESIDE_S)
    if problems:
        raise problems[0]


class VirtualClock:
    """Time that stands still while any party works and jumps to the next wake-up when all wait: a run of hours takes as
    long as its computation, with the same code and order of events.

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
        before = self._members.get(threading.get_ident(), 0)
        self._enter(before + 1)
        try:
            yield
        finally:
            self._enter(before)

    def _enter(self, depth: int) -> int:
        """Set how deep in parties this thread is; returns how deep it was. In none it holds no time."""
        with self.lock:
            before = self._members.pop(threading.get_ident(), 0)
            if depth:
                self._members[threading.get_ident()] = depth
            self._working += (depth > 0) - (before > 0)
            self.advance_if_all_wait()
            return before

    def advance_if_all_wait(self) -> None:
        """Wake the next sleepers when no party works. The caller holds `lock`."""
        if self._working or not self._sleepers:
            return
        self._now = max(self._now, self._sleepers[0][0])
        while self._sleepers and self._sleepers[0][0] <= self._now:
            _, _, gate = heapq.heappop(self._sleepers)
            self._working += 1
            gate.release()

    def _await(self, gate: threading.Lock) -> None:
        gate.acquire()
