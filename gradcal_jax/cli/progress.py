"""Progress of long work: a moving line on a terminal, plain lines elsewhere."""

import math
import time
from typing import Any, Final

from gradcal_jax.cli.output import is_plain
from gradcal_jax.units import time_text

# Before this, the remaining time is not shown.
_SOON_S: Final = 3.0
# Away from a terminal: time between lines that say the same.
_EVERY_S: Final = 30.0


class MovingLine:
    """One line that is overwritten on a terminal; elsewhere a line whenever the number changes, or after 30 s."""

    def __init__(self, stream: Any) -> None:
        self.plain = is_plain(stream)
        self._stream = stream
        self._open = False
        self._begun = time.monotonic()
        self._printed_s, self._number = -math.inf, object()

    def __enter__(self) -> "MovingLine":
        return self

    def show(self, line: str, share: float | None = None, number: object = None) -> None:
        """Replace the line; with the `share` of the work that is done, also show the remaining time. `number`: what the
        line is about."""
        now = time.monotonic()
        spent = now - self._begun
        if self.plain and number == self._number and now - self._printed_s < _EVERY_S:
            return
        self._printed_s, self._number = now, number
        if share is not None and 0.0 < share < 1.0 and spent > _SOON_S:
            line += f"  {time_text(float(round(spent * (1.0 - share) / share)))} left"
        if self.plain:
            print(line, file=self._stream, flush=True)
        else:
            print(f"\r\x1b[2K{line}", end="", file=self._stream, flush=True)
            self._open = True

    def end(self) -> None:
        """Begin a new line for any further output."""
        if self._open:
            print(file=self._stream)
            self._open = False

    def __exit__(self, *_: object) -> None:
        self.end()
