"""Progress of long work: a moving line or bars on a terminal, plain lines elsewhere."""

import math
import sys
import time
from typing import TYPE_CHECKING, Any, Final

from gradcal_jax.cli.output import is_plain
from gradcal_jax.units import time_text

if TYPE_CHECKING:
    from gradcal_jax.sweeps.pool import JobProgress

# Before this, the remaining time is not shown.
_SOON_S: Final = 3.0
# Away from a terminal: time between lines that say the same.
_EVERY_S: Final = 30.0
_STAGES: Final = {"reading": "reading points", "predict": "predicting", "optimise": "optimising"}


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


class Bars:
    """On stderr, a bar for each stage, with a line for each result above; away from a terminal lines."""

    def __init__(self) -> None:
        self._bars: Any = None
        self._line = MovingLine(sys.stderr)
        self._tasks: dict[str, Any] = {}

    def __enter__(self) -> "Bars":
        if not is_plain(sys.stderr):
            from rich.console import Console
            from rich.progress import (
                BarColumn,
                MofNCompleteColumn,
                Progress,
                TextColumn,
                TimeElapsedColumn,
                TimeRemainingColumn,
            )

            parts = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
            self._bars = Progress(*parts, TextColumn("left"), TimeRemainingColumn(), console=Console(stderr=True))
            self._bars.start()
        return self

    def show(self, now: "JobProgress") -> None:
        """Show a report of progress."""
        if self._bars is None:
            begun = "" if now.begun is None else f", {now.begun} begun"
            line = f"{_STAGES[now.stage]}: {now.done} of {now.total} done{begun}"
            self._line.show(f"{line}; {now.newest}" if now.newest else line, now.done / now.total, number=now.newest)
            return
        if now.stage not in self._tasks:
            self._tasks[now.stage] = self._bars.add_task(_STAGES[now.stage], total=now.total)
        begun = "" if now.begun is None else f", {now.begun} begun"
        self._bars.update(self._tasks[now.stage], completed=now.done, description=_STAGES[now.stage] + begun)
        if now.newest:
            self._bars.console.print(now.newest, highlight=False, markup=False)

    def __exit__(self, *_: object) -> None:
        if self._bars is not None:
            self._bars.stop()
