"""Request and reply over one line, for all drivers whose device answers requests.

The rules of retrying: the input is drained before every request, so that a late reply to an earlier query does not
count as the reply to this one; after a time-out or a damaged reply the line is given time to become silent; queries are
repeated, commands are not (their driver reads back instead).
"""

import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import TypeVar

from .clock import Clock, holding
from .errors import ChecksumError, FramingError, NotVerified, Rejected, ReplyTimeout, printable
from .framing import Framer
from .transport import Transport

Reply = TypeVar("Reply")

# The silence (real time) that ends a disturbed conversation.
_SETTLE_S = 0.05
_TRIES = 3
_BETWEEN_LOOKS_S = 0.2


class NotThisReply(Exception):
    """Raised by a reply parser for a sound frame that answers another request: the exchange continues to wait."""


class Exchange:
    """One conversation at a time on a port. Thread-safe; several devices of one port share one exchange.

    `min_interval_s` is the device's least time between the starts of two requests, `boot_s` the time from here to the
    first, on the run's clock;
    `reply_timeout_s` is real time.
    """

    def __init__(
        self,
        transport: Transport,
        framer: Framer,
        clock: Clock,
        device: str,
        reply_timeout_s: float,
        min_interval_s: float = 0.0,
        *,
        boot_s: float = 0.0,
    ) -> None:
        self.transport = transport
        self.clock = clock
        self.device = device
        self._framer = framer
        self._reply_timeout_s = reply_timeout_s
        self._min_interval_s = min_interval_s
        self._next_request_s = clock.now() + boot_s
        self._lock = threading.RLock()

    def alone(self) -> AbstractContextManager[None]:
        """Context with exclusive use of this line."""
        return holding(self._lock, self.clock)

    def query(
        self,
        request: bytes,
        parse: Callable[[bytes], Reply],
        *,
        repeat: bool = True,
        reply_timeout_s: float | None = None,
        pause_after_s: float | None = None,
    ) -> Reply:
        """Send `request`, return the reply parsed by `parse`.

        `parse` raises `NotThisReply` for a frame to ignore, `FramingError` or `ChecksumError` for a damaged one. With
        `repeat` (queries only) the request is repeated after those and after a time-out. `pause_after_s` replaces the
        usual interval to the next request.
        """
        with self.alone():
            tries = _TRIES if repeat else 1
            for attempt in range(1, tries + 1):
                try:
                    reply = self._once(request, parse, reply_timeout_s or self._reply_timeout_s, pause_after_s)
                    if attempt > 1:
                        # The reply was a late one to an earlier try, and the one to this try is still to come.
                        self.transport.drain(_SETTLE_S)
                    return reply
                except (ReplyTimeout, FramingError):
                    self.transport.drain(_SETTLE_S)
                    if attempt == tries:
                        raise
            raise AssertionError("unreachable: the last try returns or raises")

    def write(self, request: bytes, *, pause_after_s: float | None = None) -> None:
        """Send a message that has no reply."""
        with self.alone():
            self._send(request, pause_after_s)

    def _send(self, request: bytes, pause_after_s: float | None) -> None:
        self.clock.sleep_until(self._next_request_s)
        self.transport.drain()
        self._framer.reset()
        self._next_request_s = self.clock.now() + (self._min_interval_s if pause_after_s is None else pause_after_s)
        self.transport.write(request)

    def _once(
        self, request: bytes, parse: Callable[[bytes], Reply], reply_timeout_s: float, pause_after_s: float | None
    ) -> Reply:
        self._send(request, pause_after_s)
        end = time.monotonic() + reply_timeout_s
        received = b""
        problem: FramingError | None = None
        spoke = True
        while (left := end - time.monotonic()) > 0.0:
            # On a silent line virtual time runs on from the start of this reading: a late reply has to come within it.
            data = self.transport.read(min(left, 0.1) if spoke else left)
            spoke = bool(data)
            received += data
            for frame in self._framer.push(data):
                try:
                    return parse(frame)
                except NotThisReply:
                    continue
                except Rejected as refusal:
                    what = f"{self.device} at {self.transport.url} was sent {printable(request)!r}. {refusal}"
                    raise Rejected(what, code=refusal.code, text=refusal.text) from None
                except ChecksumError:
                    # The reply to this request is damaged: no other will come.
                    raise
                except FramingError as damage:
                    # This may be noise before the reply, which may still come in time.
                    problem = damage
        if problem is not None:
            raise problem
        if received:
            raise FramingError(
                f"{self.device} at {self.transport.url} was sent {printable(request)!r} and answered "
                f"{printable(received)!r}, which is no complete reply of its protocol. Check that the port leads to "
                "this device, its baud rate and its terminator."
            )
        raise ReplyTimeout(
            f"{self.device} at {self.transport.url} was sent {printable(request)!r} and did not answer in "
            f"{reply_timeout_s:g} s. Check that it is on, the cable, the baud rate and its address."
        )


def command_and_verify(
    send: Callable[[], object],
    read: Callable[[], Reply],
    shows: Callable[[Reply], bool],
    *,
    what: str,
    clock: Clock,
    looks: int = 3,
) -> Reply:
    """Command, then read back until the read-back shows it; no other function repeats a command.

    `send` is repeated only after `looks` read-backs, some time of the run's clock apart, have shown that it did not
    take effect: a lost acknowledgement alone repeats nothing. A refusal by the device is raised at once.

    Raises:
        NotVerified: after three commands the read-back still differs; `what` names the command for the message.
    """
    seen: Reply | None = None
    unanswered = ""
    for _ in range(_TRIES):
        try:
            send()
        except (ReplyTimeout, FramingError) as problem:
            unanswered = f" ({problem})"
        for look in range(looks):
            if look:
                clock.sleep(_BETWEEN_LOOKS_S)
            seen = read()
            if shows(seen):
                return seen
    raise NotVerified(
        f"{what} was sent {_TRIES} times and the read-back still says {seen!r}{unanswered}. "
        "Look at the device's own display: it may be in local mode, locked, or limited."
    )
