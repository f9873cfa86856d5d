"""Request and reply over one line, for all drivers whose device answers requests.

Queries are repeated, commands are not (their driver reads back instead). A reply that comes after its time-out, within
as long again, counts, and is said (`Transport.late`); what comes later does not count, and is named in the reason why
there is no reply. After a query with a lost reply the line must be silent for the time-out before the next query, so
that no later reply counts for that one; a command waits for nothing.
"""

import threading
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import TypeVar

from gradcal_jax.hardware.clock import Clock, holding
from gradcal_jax.hardware.errors import ChecksumError, FramingError, Rejected, ReplyTimeout, printable
from gradcal_jax.hardware.framing import Framer, NotThisReply
from gradcal_jax.hardware.transport import Transport

Reply = TypeVar("Reply")

# The silence that ends a damaged reply.
_SETTLE_S = 0.05
# How long a device that has never answered is listened to after its last try, in time-outs.
_LATEST = 6.0
TRIES = 3


class Exchange:
    """One conversation at a time on a port. Thread-safe; several devices of one port share one exchange.

    `min_interval_s` is the device's least time between the starts of two requests, `boot_s` the time from here to the
    first, and `reply_timeout_s` how long a reply is awaited: all on the run's clock.
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
        self._silence_s = 0.0
        self._sent_s = self.clock.now()
        self._answered = False
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
            if repeat:
                self._drop(self._silence_s)
                self._silence_s = 0.0
            tries = TRIES if repeat else 1
            for attempt in range(1, tries + 1):
                # A reply that is only late answers the first try.
                late_s = timeout_s if attempt == 1 and reply_timeout_s is None else 0.0
                try:
                    self._send(request, pause_after_s)
                    reply = self._reply(request, parse, timeout_s, late_s)
                    self._answered = True
                    return reply
                except ReplyTimeout as problem:
                    self._silence_s = timeout_s
                    last = attempt == tries
                    self._drop(_LATEST * timeout_s if last and repeat and not self._answered else _SETTLE_S)
                    if last:
                        raise ReplyTimeout(f"{problem} {self.transport.late}".strip()) from None
                except FramingError:
                    self._silence_s = _SETTLE_S
                    self.transport.drain(_SETTLE_S)
                    if attempt == tries:
                        raise
            raise AssertionError("unreachable: the last try returns or raises")

    def _drop(self, quiet_s: float) -> None:
        """Drop what comes too late to be a reply, and remember that it came."""
        unanswered = self._silence_s > _SETTLE_S
        if self.transport.drain(quiet_s) and unanswered:
            late_s = self.clock.now() - self._sent_s
            self.transport.late = f"{self.device} answered up to {late_s:.1f} s after a request: raise reply_timeout."

    def write(self, request: bytes, *, pause_after_s: float | None = None) -> None:
        with self.alone():
            self._send(request, pause_after_s)

    def _send(self, request: bytes, pause_after_s: float | None) -> None:
        self.clock.sleep_until(self._next_request_s)
        self.transport.drain()
        self._framer.reset()
        self._next_request_s = self.clock.now() + (self._min_interval_s if pause_after_s is None else pause_after_s)
        self._sent_s = self.clock.now()
        self.transport.write(request)

    def _reply(self, request: bytes, parse: Callable[[bytes], Reply], timeout_s: float, late_s: float) -> Reply:
        """The first frame that is a reply, also one that is up to `late_s` late. A damaged one may be noise before it;
        where anything came in time, nothing that is late is waited for."""
        asked = f"{self.device} at {self.transport.url} was sent {printable(request)!r}"
        end_s, received = self.clock.now() + timeout_s, b""
        damage: FramingError | None = None
        while (left_s := end_s + (0.0 if received else late_s) - self.clock.now()) > 0.0:
            data = self.transport.read(left_s)
            received += data
            for frame in self._framer.push(data):
                try:
                    reply = parse(frame)
                except NotThisReply:
                    continue
                except Rejected as refusal:
                    raise Rejected(f"{asked}. {refusal}") from None
                except ChecksumError:
                    # The reply to this request is damaged: no other will come.
                    raise
                except FramingError as problem:
                    damage = problem
                    continue
                over_s = self.clock.now() - end_s
                if over_s > 0.0:
                    self.transport.late = f"{asked} and answered {max(over_s, 0.1):.1f} s late: raise reply_timeout."
                return reply
        if damage is not None:
            raise damage
        if received:
            raise FramingError(
                f"{asked} and answered {printable(received)!r}, but this is not a complete reply of the protocol. "
                "Check that the port belongs to this device, and check baud rate and terminator."
            )
        raise ReplyTimeout(
            f"{asked} and did not answer in {timeout_s:g} s. Check that it is switched on, and check cable, baud rate "
            "and address."
        )
