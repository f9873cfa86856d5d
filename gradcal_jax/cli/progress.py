"""How far long work is: a line or bars that move on a terminal, plain lines away from it."""

import sys
import time
from typing import TYPE_CHECKING, Any, Final

from gradcal_jax.cli.console import is_plain
from gradcal_jax.units import time_text

if TYPE_CHECKING:
    from gradcal_jax.jobs.pool import JobProgress

# Before that, what is left is anybody's guess.
_SOON_S: Final = 3.0
_STAGES: Final = {"reading": "reading points", "predict": "predicting", "optimise": "optimising"}


class MovingLine:
    """One line that is written over on a terminal; away from it a line each."""

    def __init__(self, stream: Any) -> None:
        self.plain = is_plain(stream)
        self._stream = stream
        self._open = False
        self._begun = time.monotonic()

    def __enter__(self) -> "MovingLine":
        return self

    def show(self, line: str, share: float | None = None) -> None:
        """Say this in the place of what was said before; with the share that is done, how long the rest will take."""
        spent = time.monotonic() - self._begun
        if share is not None and 0.0 < share < 1.0 and spent > _SOON_S:
            line += f"  {time_text(float(round(spent * (1.0 - share) / share)))} left"
        if self.plain:
            print(line, file=self._stream, flush=True)
        else:
            print(f"\r\x1b[2K{line}", end="", file=self._stream, flush=True)
            self._open = True

    def end(self) -> None:
        """What is said next begins a line."""
        if self._open:
            print(file=self._stream)
            self._open = False

    def __exit__(self, *_: object) -> None:
        self.end()


class Bars:
    """On stderr, a bar for each stage and what its pieces gave above them; away from a terminal the pieces alone."""

    def __init__(self) -> None:
        self._bars: Any = None
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
        """For whoever reports progress."""
        if self._bars is None:
            if now.newest:
                print(f"{now.done}/{now.total} {now.newest}", file=sys.stderr, flush=True)
            return
        if now.stage not in self._tasks:
            self._tasks[now.stage] = self._bars.add_task(_STAGES[now.stage], total=now.total)
        self._bars.update(self._tasks[now.stage], completed=now.done)
        if now.newest:
            self._bars.console.print(now.newest, highlight=False, markup=False)

    def __exit__(self, *_: object) -> None:
        if self._bars is not None:
            self._bars.stop()
