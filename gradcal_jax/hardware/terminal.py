"""The terminal of this process in place of a serial line, for the operator.

Text that is written is shown; typed text arrives line by line, with the terminal's own editing and echo. A question is
a line without an end: while it is shown, no other text may be drawn on the terminal (`asking`). `heard` is whether the
keyboard is being read here: two readers would get every other line each.
"""

import os
import select
import sys
from collections.abc import Callable
from typing import Any

from .clock import Clock, RealClock
from .errors import Disconnected, HardwareError
from .journal import Recorder
from .transport import Transport

_CLEAR = "\r\x1b[2K"


class Terminal:
    """Line `terminal`. Without a keyboard there is no operator, and a question raises `HardwareError`."""

    url = "terminal"

    def __init__(self, *, keyboard: int | None = None, screen: Any = None) -> None:
        self._keyboard, self._screen = keyboard, screen
        self.clock: Clock = RealClock()
        self.recorder: Recorder | None = None
        self.asking = False
        self.heard = False
        self._question = ""
        self._diverted: Callable[[], None] | None = None

    def next_line_goes_to(self, whom: Callable[[], None]) -> None:
        """Take the next typed line away from the driver's question: it answers another one (a pause)."""
        self._diverted = whom

    def write(self, data: bytes) -> None:
        if self._keyboard is None or self._screen is None:
            raise HardwareError("An axis is turned by hand, and there is no terminal at which to ask the operator.")
        self._record(">", data)
        text = data.decode("utf-8", "replace")
        words = text.strip("\a")
        if words:
            cleared = "" if self.asking or not self._screen.isatty() else _CLEAR
            self.asking, self._question = not text.endswith("\n"), words
            text = cleared + text
        self._screen.write(text)
        self._screen.flush()

    def remark(self, text: str) -> None:
        """Show a text above a question that is waiting for its answer."""
        self._screen.write(f"\r\n{text}\r\n{self._question}")
        self._screen.flush()

    def read_stamped(self, timeout_s: float) -> tuple[bytes, float]:
        """Typed text, as soon as a line is complete. Raises `Disconnected` at the end of all input (Ctrl-D)."""
        assert self._keyboard is not None
        self.heard = True
        # Windows cannot wait for a console with a time-out; the reading thread is abandoned at the end.
        if sys.platform != "win32" and not select.select([self._keyboard], [], [], timeout_s)[0]:
            return b"", self.clock.now()
        try:
            data = os.read(self._keyboard, 4096)
        except OSError as problem:
            raise Disconnected(f"The terminal is gone ({problem.strerror}).") from None
        if not data:
            raise Disconnected(
                "The terminal gives no more input (Ctrl-D, or it is gone): the operator cannot be asked."
            )
        now = self.clock.now()
        if (whom := self._diverted) is not None:
            self._diverted = None
            whom()
            return b"", now
        self._record("<", data)
        if data.endswith(b"\n"):
            self.asking = False
        return data, now

    def close(self) -> None:
        """The terminal has no line settings to change."""

    def _record(self, direction: Any, data: bytes) -> None:
        if self.recorder is not None:
            self.recorder(self.clock.now(), direction, data)


TextLine = Transport | Terminal
"""Where a driver of text writes and hears."""
