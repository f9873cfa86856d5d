"""Request and reply over one line, for all drivers whose device answers requests.

Queries are repeated, commands are not (their driver reads back instead). One rule for all protocols: the reply is the
first that `parse` accepts among the bytes that came; damaged ones before it are noise. A reply that comes after its
time-out, within as long again, counts, and is said (`Transport.late`); what comes later does not count, and is named in
the reason why there is no reply. After a query with a lost reply the line must be silent for the time-out before the
next query, so that no later reply counts for that one; a command waits for nothing.
"""

import threading
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import TypeVar

from gradcal_jax.hardware.clock import Clock, holding
from gradcal_jax.hardware.errors import FramingError, Rejected, ReplyTimeout, printable
from gradcal_jax.hardware.transport import Transport

Reply = TypeVar("Reply")

# The silence that ends a damaged reply.
_SETTLE_S = 0.05
# How long a device that has never answered is listened to after its last try, in time-outs.
_LATEST = 6.0
_LONGEST_REPLY = 8192  # bytes
TRIES = 3


class Exchange:
    """One conversation at a time on a port. Thread-safe; several devices of one port share one exchange.

    `pause_s` is the device's least time between the starts of two requests, `after_command_s` that after a command (0:
    the same), and `boot_s` the time from here to the first request: all on the run's clock.
    """

    def __init__(
        self,
        transport: Transport,
        clock: Clock,
        device: str,
        reply_timeout_s: float,
        pause_s: float = 0.0,
        after_command_s: float = 0.0,
        boot_s: float = 0.0,
    ) -> None:
        self.transport, self.clock, self.device = transport, clock, device
        self._reply_timeout_s = reply_timeout_s
        self._pause_s, self._after_command_s = pause_s, after_command_s or pause_s
        self._sent_s = clock.now()
        self._next_request_s = self._sent_s + boot_s
        self._silence_s = 0.0
        self._answered = False
        self._lock = threading.RLock()

    def alone(self) -> AbstractContextManager[None]:
        return holding(self._lock, self.clock)

    def query(
        self,
        request: bytes,
        parse: Callable[[bytes], Reply | None],
        *,
        repeat: bool = True,
        reply_timeout_s: float | None = None,
    ) -> Reply:
        """Send `request`, return the reply.

        `parse` finds the reply in all bytes that have come; None: it is not, or not yet, among them. With `repeat`
        (queries, not commands) the request is repeated if there is no reply. Raises `ReplyTimeout` if nothing came,
        `FramingError` if something else came, `Rejected` by `parse`.
        """
        timeout_s = reply_timeout_s or self._reply_timeout_s
        with self.alone():
            if repeat:
                self._drop(self._silence_s)
                self._silence_s = 0.0
            last = TRIES if repeat else 1
            for attempt in range(1, last + 1):
                # A reply that is only late answers the first try.
                late_s = timeout_s if attempt == 1 and reply_timeout_s is None else 0.0
                try:
                    self._send(request, self._pause_s if repeat else self._after_command_s)
                    reply = self._reply(request, parse, timeout_s, late_s)
                    self._answered = True
                    return reply
                except ReplyTimeout as problem:
                    self._silence_s = timeout_s
                    listens = attempt == last and repeat and not self._answered
                    self._drop(_LATEST * timeout_s if listens else _SETTLE_S)
                    if attempt == last:
                        raise ReplyTimeout(f"{problem} {self.transport.late}".strip()) from None
                except FramingError:
                    self._silence_s = _SETTLE_S
                    self.transport.drain(_SETTLE_S)
                    if attempt == last:
                        raise
            raise AssertionError("unreachable: the last try returns or raises")

    def write(self, request: bytes) -> None:
        """Send a command that has no reply."""
        with self.alone():
            self._send(request, self._after_command_s)

    def _drop(self, quiet_s: float) -> None:
        """Drop what comes too late to be a reply, and remember that it came."""
        unanswered = self._silence_s > _SETTLE_S
        if self.transport.drain(quiet_s) and unanswered:
            late_s = self.clock.now() - self._sent_s
            self.transport.late = f"{self.device} answered up to {late_s:.1f} s after a request: raise reply_timeout."

    def _send(self, request: bytes, pause_s: float) -> None:
        self.clock.sleep_until(self._next_request_s)
        self.transport.drain()
        self._sent_s = self.clock.now()
        self._next_request_s = self._sent_s + pause_s
        self.transport.write(request)

    def _reply(self, request: bytes, parse: Callable[[bytes], Reply | None], timeout_s: float, late_s: float) -> Reply:
        """The reply, also one that is up to `late_s` late, unless anything else came in time."""
        asked = f"{self.device} at {self.transport.url} was sent {printable(request)!r}"
        end_s, received = self.clock.now() + timeout_s, b""
        while (left_s := end_s + (0.0 if received else late_s) - self.clock.now()) > 0.0:
            received = (received + self.transport.read(left_s))[-_LONGEST_REPLY:]
            try:
                reply = parse(received)
            except Rejected as refusal:
                raise Rejected(f"{asked}. {refusal}") from None
            if reply is not None:
                over_s = self.clock.now() - end_s
                if over_s > 0.0:
                    self.transport.late = f"{asked} and answered {max(over_s, 0.1):.1f} s late: raise reply_timeout."
                return reply
        if received:
            raise FramingError(
                f"{asked} and answered {printable(received)!r}, but this is not a complete reply of the protocol. "
                "Check that the port belongs to this device, and check baud rate, terminator and shielding."
            )
        raise ReplyTimeout(
            f"{asked} and did not answer in {timeout_s:g} s. Check that it is switched on, and check cable, baud rate "
            "and address."
        )
