"""Clocks of a run.

All waiting for chambers and tables is on a `Clock`, never by `time.sleep`. `RealClock` waits really;
`simulate.virtual_clock`, for simulated devices only, skips the waiting.
"""

import threading
import time
from collections.abc import Callable, Generator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Protocol

# Linux's monotonic clock stops while the computer sleeps and the devices continue; this one does not stop.
_RUNS_ON = getattr(time, "CLOCK_BOOTTIME", None)


@contextmanager
def holding(lock: threading.RLock, clock: "Clock") -> Generator[None, None, None]:
    """Context that holds a lock. Waiting for it does not hold virtual time, because the thread that has the lock may
    have to wait on the clock."""
    if not lock.acquire(blocking=False):
        with clock.aside():
            lock.acquire()
    try:
        yield
    finally:
        lock.release()


class Clock(Protocol):
    """Monotonic time in seconds, and waiting on it."""

    def now(self) -> float:
        """Seconds since an arbitrary origin; never goes back."""
        ...

    def sleep_until(self, time_s: float) -> None:
        """Return at `time_s` of this clock, at once if that is in the past."""
        ...

    def sleep(self, duration_s: float) -> None: ...

    def party(self) -> AbstractContextManager[None]:
        """Context in which virtual time stands still unless this thread waits on the clock."""
        ...

    def aside(self) -> AbstractContextManager[None]:
        """Context in which a party lets time pass: for waiting on something that is not this clock."""
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

    aside = party


_BESIDE_S = 0.1


def beside(work: Callable[[], object], clock: Clock, duties: Callable[[], None]) -> None:
    """Do `work`, which may wait for a device, in a thread of its own, and the `duties` of this thread beside it. Raises
    what either raises; where a duty does, nobody waits for the work any more."""
    problems: list[Exception] = []
    begun, over = threading.Event(), threading.Event()

    def attempt() -> None:
        with clock.party():
            begun.set()
            try:
                work()
            except Exception as problem:
                problems.append(problem)
            over.set()

    threading.Thread(target=attempt, daemon=True, name="waiting for a device").start()
    begun.wait()
    while not over.is_set():
        duties()
        clock.sleep(_BESIDE_S)
    if problems:
        raise problems[0]
