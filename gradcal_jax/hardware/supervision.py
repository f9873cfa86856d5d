"""The status file of a run, replaced as a whole every few seconds, and the alarm command of the rig file.

Both have their own threads: neither the disk nor the alarm command delays the run.
"""

import json
import subprocess
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

from ..files.rig import RigFile
from ..files.writing import write_whole
from .journal import json_of
from .safety import SafeOutcome
from .states import RunProgress, RunResult

STATUS: Final = "status.json"
FORMAT: Final = "gradcal-status/1"
_ALARM_S: Final = 60.0
_KNOWS_S: Final = 300.0
# No more often, because a rehearsal goes through hours in a minute.
_WRITE_S: Final = 0.2

Knows = Callable[[Path], Any]
"""The knowledge from a run so far, as plain data; called every few minutes, in a separate thread."""


class StatusFile:
    """Writes the newest status; statuses in between are dropped."""

    def __init__(self, folder: Path, *, simulated: bool, knows: Knows | None = None) -> None:
        self._path = folder / STATUS
        self._knows = knows
        self._known: dict[str, Any] = {}
        self._head = {"format": FORMAT, "simulated": simulated}
        self._status: dict[str, Any] = {}
        self._over = threading.Event()
        self._writer = threading.Thread(target=self._write_on, daemon=True, name="status file")

    def __enter__(self) -> "StatusFile":
        self._writer.start()
        if self._knows is not None:
            threading.Thread(target=self._ask_on, args=(self._knows,), daemon=True, name="what is known").start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._writer.join(timeout=5.0)

    def show(self, progress: RunProgress) -> None:
        """The progress of the run."""
        self._status = {"at_s": time.time(), **asdict(progress), "state": progress.state.value}

    def end(self, result: RunResult) -> None:
        """How the run ended."""
        state = "safe" if result.verified_safe else "failed"
        ended = {"exit_status": result.exit_status, "reason": result.reason, "verified_safe": result.verified_safe}
        self._status = {**self._status, "at_s": time.time(), "state": state, "steps_done": result.steps_done, **ended}

    def _ask_on(self, knows: Knows) -> None:
        while True:
            with suppress(OSError, ValueError, subprocess.SubprocessError):
                self._known = {"known": knows(self._path.parent)}
            if self._over.wait(_KNOWS_S):
                return

    def _write_on(self) -> None:
        over, written = False, self._status
        while not over:
            over = self._over.wait(_WRITE_S)
            if self._status is not written:
                written = self._status
                # The journal reports a full disk.
                with suppress(OSError):
                    write_whole(self._path, json.dumps(json_of(self._head | written | self._known), indent=1) + "\n")


def end_status(folder: Path, why: str, outcomes: list[SafeOutcome]) -> None:
    """How a run ended whose guard made it safe, in its status file; nothing where there is none."""
    with suppress(OSError, ValueError):
        safe = all(outcome.verified for outcome in outcomes)
        ended = {"exit_status": "lost", "reason": why, "verified_safe": safe, "state": "safe" if safe else "failed"}
        status = {**read_status(folder), **ended, "at_s": time.time()}
        write_whole(folder / STATUS, json.dumps(json_of(status), indent=1) + "\n")


def read_status(folder: Path) -> dict[str, Any]:
    """The newest status of a run. Raises `ValueError` where there is none."""
    try:
        status = json.loads((folder / STATUS).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        status = None
    if not isinstance(status, dict) or status.get("format") != FORMAT:  # pyright: ignore[reportUnknownMemberType]
        raise ValueError(f"{folder} has no {STATUS}: it is not the folder of a run, or its run has not begun")
    return status  # pyright: ignore[reportUnknownVariableType]


def sound_alarm(rig: RigFile, sentence: str) -> None:
    """Run the command of the rig file, without a shell; the sentence is its last argument."""
    if rig.alarm is None:
        return
    command = [*rig.alarm.command, sentence]

    def call() -> None:
        with suppress(OSError, subprocess.SubprocessError):
            subprocess.run(command, timeout=_ALARM_S, stdin=subprocess.DEVNULL, capture_output=True, check=False)

    threading.Thread(target=call, daemon=True, name="alarm").start()
