"""Request and reply over one line, for all drivers whose device answers requests.

The input is drained before every request, so that a late reply to an earlier query does not count as the reply to this
one; after a time-out or a damaged reply the line is given time to become silent; queries are repeated, commands are not
(their driver reads back instead). A late reply is recognised by its request's own parser, and said (`Transport.late`).
"""

import math
import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, field
from typing import TypeVar

from gradcal_jax.hardware.clock import Clock, holding
from gradcal_jax.hardware.errors import ChecksumError, FramingError, HardwareError, Rejected, ReplyTimeout, printable
from gradcal_jax.hardware.framing import Framer, NotThisReply
from gradcal_jax.hardware.transport import Transport

Reply = TypeVar("Reply")

# The silence (real time) that ends a disturbed conversation.
_SETTLE_S = 0.05
TRIES = 3
# How long a reply is awaited that did not come in all tries, in their time-outs: only to say that it is late.
_LATER = 1.0
_FORGOTTEN_S = 30.0


@dataclass
class _Unanswered:
    """A request whose reply did not come in time: when each try was sent, when the first was given up; and, once a
    reply came to a later try, how late that is if it is the first's, and when those to the others are due."""

    request: bytes
    parse: Callable[[bytes], object]
    over_s: float
    sent_s: list[float]
    late_s: float | None = None
    due_s: list[float] = field(default_factory=list[float])

    def answered(self, now_s: float) -> None:
        took_s, self.late_s = now_s - self.sent_s[0], now_s - self.over_s
        self.due_s = [sent_s + took_s for sent_s in self.sent_s[1:]]

    def is_answered_by(self, frame: bytes) -> bool:
        with suppress(NotThisReply, HardwareError):
            self.parse(frame)
            return True
        return False


class Exchange:
    """One conversation at a time on a port. Thread-safe; several devices of one port share one exchange.

    `min_interval_s` is the device's least time between the starts of two requests, `boot_s` the time from here to the
    first, on the run's clock; `reply_timeout_s` is real time.
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
        self._unanswered: _Unanswered | None = None
        self._sent_s = -math.inf
        self._lock = threading.RLock()

    def alone(self) -> AbstractContextManager[None]:
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
        timeout_s = reply_timeout_s or self._reply_timeout_s
        with self.alone():
            tries = TRIES if repeat else 1
            for attempt in range(1, tries + 1):
                try:
                    reply = self._once(request, parse, timeout_s, pause_after_s)
                    waited = self._unanswered
                    if attempt > 1:
                        # The reply was a late one to an earlier try, and the one to this try is still to come.
                        if waited is not None:
                            waited.answered(time.monotonic())
                        self._look_for_late(self.transport.drain(_SETTLE_S))
                    elif waited is not None and waited.request == request:
                        self._unanswered = None
                    return reply
                except (ReplyTimeout, FramingError) as problem:
                    silent = isinstance(problem, ReplyTimeout)
                    if silent and (attempt == 1 or self._unanswered is None):
                        self._unanswered = _Unanswered(request, parse, time.monotonic(), [self._sent_s])
                    last = attempt == tries
                    found = last and silent and repeat and self._look_for_late(self.transport.read(_LATER * timeout_s))
                    found = self._look_for_late(self.transport.drain(_SETTLE_S)) or found
                    if last:
                        raise (ReplyTimeout(self.transport.late) if silent and found else problem) from None
            raise AssertionError("unreachable: the last try returns or raises")

    def write(self, request: bytes, *, pause_after_s: float | None = None) -> None:
        with self.alone():
            self._send(request, pause_after_s)

    def text(self, request: bytes, reply_timeout_s: float, silence_s: float, *, longest_s: float = 2.0) -> bytes:
        """The reply to `request` where no mark ends it: all bytes until none came for `silence_s`."""
        with self.alone():
            self._send(request, None)
            received = self.transport.read(reply_timeout_s)
            return received + self.transport.drain(silence_s, longest_s=longest_s)

    def _send(self, request: bytes, pause_after_s: float | None) -> None:
        self.clock.sleep_until(self._next_request_s)
        self._look_for_late(self.transport.drain(), "up to ")
        self._next_request_s = self.clock.now() + (self._min_interval_s if pause_after_s is None else pause_after_s)
        self._sent_s = time.monotonic()
        waited = self._unanswered
        if waited is not None and waited.request == request and waited.late_s is None:
            waited.sent_s.append(self._sent_s)
        if waited is not None and self._sent_s - waited.over_s > _FORGOTTEN_S:
            self._unanswered = None
        self.transport.write(request)

    def _look_for_late(self, data: bytes, about: str = "") -> bool:
        """Whether a reply that came too late is among bytes that nobody waits for any more."""
        self._framer.reset()
        frames = self._framer.push(data) if data and self._unanswered else []
        self._framer.reset()
        return sum(self._note_late(frame, about) for frame in frames) > 0

    def _note_late(self, frame: bytes, about: str = "") -> bool:
        waited = self._unanswered
        if waited is None or not waited.is_answered_by(frame):
            return False
        waited.due_s = waited.due_s[1:]
        if not waited.due_s:
            self._unanswered = None
        late_s, about = (time.monotonic() - waited.over_s, about) if waited.late_s is None else (waited.late_s, "")
        self.transport.late = (
            f"{self.device} at {self.transport.url} was sent {printable(waited.request)!r} and answered "
            f"{about}{max(late_s, 0.1):.1f} s late: raise reply_timeout."
        )
        return True

    def _is_due(self, frame: bytes, request: bytes, reply_timeout_s: float) -> bool:
        """Whether a frame that could answer this request answers a try of the one before, which is due about now."""
        waited = self._unanswered
        if waited is None or waited.request == request or not waited.due_s:
            return False
        return time.monotonic() >= waited.due_s[0] - 0.3 * reply_timeout_s and self._note_late(frame)

    def _once(
        self, request: bytes, parse: Callable[[bytes], Reply], reply_timeout_s: float, pause_after_s: float | None
    ) -> Reply:
        self._send(request, pause_after_s)
        end = time.monotonic() + reply_timeout_s
        received = b""
        problem: FramingError | None = None
        while (left := end - time.monotonic()) > 0.0:
            data = self.transport.read(left)
            received += data
            for frame in self._framer.push(data):
                if self._is_due(frame, request, reply_timeout_s):
                    continue
                try:
                    return parse(frame)
                except NotThisReply:
                    self._note_late(frame)
                    continue
                except Rejected as refusal:
                    what = f"{self.device} at {self.transport.url} was sent {printable(request)!r}. {refusal}"
                    raise Rejected(what) from None
                except ChecksumError:
                    # The reply to this request is damaged: no other will come.
                    raise
                except FramingError as damage:
                    # This may be noise before the reply, which may still come in time.
                    self._note_late(frame)
                    problem = damage
        if problem is not None:
            raise problem
        if received:
            raise FramingError(
                f"{self.device} at {self.transport.url} was sent {printable(request)!r} and answered "
                f"{printable(received)!r}, but this is not a complete reply of the protocol. Check that the port "
                "belongs to this device, and check baud rate and terminator."
            )
        raise ReplyTimeout(
            f"{self.device} at {self.transport.url} was sent {printable(request)!r} and did not answer in "
            f"{reply_timeout_s:g} s. Check that it is switched on, and check cable, baud rate and address."
        )
