"""Clocks of a run, and work beside its thread.

All waiting for chambers and tables is on a `Clock`, never by `time.sleep`. `RealClock` waits really. On `VirtualClock`,
for simulated devices only, one thread works at a time, and time jumps to the next wake-up when all wait: a run of hours
takes as long as its computation and is the same every time.
"""

import heapq
import itertools
import math
import threading
import time
from collections.abc import Callable, Generator
from contextlib import AbstractContextManager, contextmanager, nullcontext

_LOOKS_S, _BESIDE_S = 0.01, 0.1
Work = Callable[[], object]
"""What is done in a thread of its own, or beside it."""
# Linux's monotonic clock stops while the computer sleeps and the devices continue; this one does not stop.
_RUNS_ON = getattr(time, "CLOCK_BOOTTIME", None)


class RealClock:
    """The computer's monotonic clock: steps of the wall clock do not change it, and it includes the computer's
    sleep."""

    def now(self) -> float:
        """Seconds since an arbitrary origin; never goes back."""
        return time.monotonic() if _RUNS_ON is None else time.clock_gettime(_RUNS_ON)

    def sleep_until(self, time_s: float) -> None:
        """Return at `time_s` of this clock, at once if that is in the past."""
        while (left := time_s - self.now()) > 0.0:
            time.sleep(left)

    def sleep(self, duration_s: float) -> None:
        self.sleep_until(self.now() + duration_s)

    def party(self) -> AbstractContextManager[None]:
        """Context in which virtual time stands still unless this thread waits on the clock."""
        return nullcontext()

    def begin(self, work: Work) -> None:
        """Begin `work` in a thread of its own, a party of the clock."""
        threading.Thread(target=work, daemon=True, name="beside the run").start()


class VirtualClock:
    """Time of simulated devices. Sleepers that are due at one time wake in the order in which they went to sleep, the
    next one when the one before waits again."""

    def __init__(self, start_s: float = 0.0) -> None:
        self._lock = threading.Lock()
        self._now = start_s
        self._order = itertools.count()
        self._sleepers: list[tuple[float, int, threading.Lock]] = []
        self._working = 0
        self._members: set[int] = set()

    def now(self) -> float:
        return self._now

    def sleep(self, duration_s: float) -> None:
        self.sleep_until(self._now + duration_s)

    def sleep_until(self, time_s: float) -> None:
        with self._lock:
            if time_s <= self._now:
                return
            member = threading.get_ident() in self._members
            gate = self._queue(time_s)
            self._working -= member
            self._wake_next()
        gate.acquire()
        if not member:
            with self._lock:
                self._working -= 1
                self._wake_next()

    @contextmanager
    def party(self) -> Generator[None, None, None]:
        if threading.get_ident() in self._members:
            yield
            return
        with self._lock:
            self._members.add(threading.get_ident())
            self._working += 1
        try:
            yield
        finally:
            self._leave()

    def begin(self, work: Work) -> None:
        with self._lock:
            gate = self._queue(self._now)
            self._wake_next()

        def attend() -> None:
            gate.acquire()
            self._members.add(threading.get_ident())
            try:
                work()
            finally:
                self._leave()

        threading.Thread(target=attend, daemon=True, name="beside the run").start()

    def _leave(self) -> None:
        with self._lock:
            self._members.discard(threading.get_ident())
            self._working -= 1
            self._wake_next()

    def _queue(self, time_s: float) -> threading.Lock:
        """What opens at that time for one thread. The caller holds the lock."""
        gate = threading.Lock()
        gate.acquire()
        heapq.heappush(self._sleepers, (time_s, next(self._order), gate))
        return gate

    def _wake_next(self) -> None:
        """Wake the next sleeper when nobody works; it counts as working before it has run. The caller holds the
        lock."""
        if self._working or not self._sleepers:
            return
        time_s, _, gate = heapq.heappop(self._sleepers)
        self._now = max(self._now, time_s)
        self._working += 1
        gate.release()


Clock = RealClock | VirtualClock


def until(
    is_so: Callable[[], bool],
    clock: Clock,
    duties: Work = lambda: None,
    *,
    longest_s: float = math.inf,
    every_s: float = _LOOKS_S,
) -> bool:
    """Wait, with the `duties` of this thread, until something is so. Returns whether it is, at the latest when
    `longest_s` have passed."""
    end_s = clock.now() + longest_s
    while not is_so():
        if clock.now() >= end_s:
            return False
        duties()
        clock.sleep(every_s)
    return True


@contextmanager
def holding(lock: threading.RLock, clock: Clock) -> Generator[None, None, None]:
    """Context that holds a lock, which is waited for on the clock, as by the thread that has it."""
    until(lambda: lock.acquire(blocking=False), clock)
    try:
        yield
    finally:
        lock.release()


@contextmanager
def repeating(work: Work, every_s: float) -> Generator[None, None, None]:
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


def in_thread(work: Work, clock: Clock, failed: Callable[[Exception], object]) -> threading.Event:
    """Begin `work` in a thread of its own; `failed` gets what it raises. Returns what is set at its end."""
    over = threading.Event()

    def attempt() -> None:
        try:
            work()
        except Exception as problem:
            failed(problem)
        over.set()

    clock.begin(attempt)
    return over


def beside(work: Work, clock: Clock, duties: Work) -> None:
    """Do `work`, which may wait for a device, in a thread of its own, and the `duties` of this thread beside it. Raises
    what either raises; where a duty does, nobody waits for the work any more."""
    problems: list[Exception] = []
    until(in_thread(work, clock, problems.append).is_set, clock, duties, every_s=_BESIDE_S)
    if problems:
        raise problems[0]
