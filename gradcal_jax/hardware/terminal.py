"""The terminal of this process in the place of a serial line, for an operator who sits at it.

What is written is shown, what is typed comes line by line as the terminal hands it on, with its own editing and echo.
A question is a line that was not ended: while one stands there, nobody else may draw on the terminal (`asking`).
Whether anybody reads the keyboard here is `heard`: of two readers each would get every other line.
"""

import os
import select
import sys
from collections.abc import Callable
from typing import Any, Protocol

from .clock import Clock, RealClock
from .errors import Disconnected, HardwareError
from .journal import Recorder

_CLEAR = "\r\x1b[2K"


class TextLine(Protocol):
    """What a driver of text needs of a `Transport`."""

    url: str

    def write(self, data: bytes) -> None: ...
    def read_stamped(self, timeout_s: float) -> tuple[bytes, float]: ...
    def close(self) -> None: ...


class Terminal:
    """Line `terminal`. Without a keyboard there is nobody to be asked, and asking raises `HardwareError`."""

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
        """The next line that is typed is no answer to a driver's question: somebody else has asked (a pause)."""
        self._diverted = whom

    def write(self, data: bytes) -> None:
        if self._keyboard is None or self._screen is None:
            raise HardwareError("An axis is turned by hand, and there is no terminal at which somebody could be asked.")
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
        """Show something while a question stands there, and the question again below it."""
        self._screen.write(f"\r\n{text}\r\n{self._question}")
        self._screen.flush()

    def read_stamped(self, timeout_s: float) -> tuple[bytes, float]:
        """What was typed, as soon as a line is whole. Raises `Disconnected` at the end of all input (Ctrl-D)."""
        assert self._keyboard is not None
        self.heard = True
        # Windows cannot wait for a console with a time-out; the thread that reads there is left behind at the end.
        if sys.platform != "win32" and not select.select([self._keyboard], [], [], timeout_s)[0]:
            return b"", self.clock.now()
        try:
            data = os.read(self._keyboard, 4096)
        except OSError as problem:
            raise Disconnected(f"The terminal is gone ({problem.strerror}).") from None
        if not data:
            raise Disconnected("The terminal takes no more input (Ctrl-D, or it is gone): nobody can be asked.")
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
        """The terminal stays what it is."""

    def _record(self, direction: Any, data: bytes) -> None:
        if self.recorder is not None:
            self.recorder(self.clock.now(), direction, data)
