"""Time for everything that runs.

Nobody in this room calls `time.sleep` to let a chamber soak or a table turn: they wait on a `Clock`. With `RealClock`
that is ordinary waiting; for simulated devices alone, `simulate.virtual_clock` skips it.
"""

import time
from contextlib import AbstractContextManager, nullcontext
from typing import Protocol

# Linux's monotonic clock stands still while the computer sleeps, and the devices go on: this one does not.
_RUNS_ON = getattr(time, "CLOCK_BOOTTIME", None)


def _running_s() -> float:
    return time.monotonic() if _RUNS_ON is None else time.clock_gettime(_RUNS_ON)


class Link(Protocol):
    """Accounts for the bytes on their way over one line, so that virtual time does not overtake them."""

    def change(
        self, *, to_device: int = 0, to_host: int = 0, attached: bool | None = None, host_is_there: bool = False
    ) -> None:
        """So many bytes more are on their way (negative: fewer, they arrived), or the host opened or left the line."""
        ...


class Clock(Protocol):
    """Monotonic time in seconds, and waiting on it."""

    def now(self) -> float:
        """Seconds since an arbitrary origin; never goes back."""
        ...

    def sleep_until(self, time_s: float) -> None:
        """Return at `time_s` of this clock, at once when it has passed."""
        ...

    def sleep(self, duration_s: float) -> None: ...

    def party(self) -> AbstractContextManager[None]:
        """While inside, virtual time stands still unless this thread waits on the clock."""
        ...

    def aside(self) -> AbstractContextManager[None]:
        """While inside, a party lets time go on: for waiting on something that is not this clock."""
        ...

    def real_pace(self) -> AbstractContextManager[None]:
        """While inside, a party lets time go on as fast as the real one: for waiting on a silent line."""
        ...

    def link(self, url: str) -> Link: ...


class _NoAccount:
    """The link of real time: nothing to account for."""

    def change(self, **_: object) -> None:
        pass


class RealClock:
    """The computer's monotonic clock. Steps of the wall clock do not move it; what the computer sleeps counts.

    `speed` makes its second shorter: for rehearsals with simulated devices that live in another process and have a
    clock of the same speed. Never for devices that are real.
    """

    def __init__(self, *, speed: float = 1.0) -> None:
        self._link = _NoAccount()
        self._speed = speed

    def now(self) -> float:
        return _running_s() * self._speed

    def sleep_until(self, time_s: float) -> None:
        while (left := time_s / self._speed - _running_s()) > 0.0:
            time.sleep(left)

    def sleep(self, duration_s: float) -> None:
        self.sleep_until(self.now() + duration_s)

    def party(self) -> AbstractContextManager[None]:
        return nullcontext()

    aside = real_pace = party

    def link(self, url: str) -> Link:
        return self._link
