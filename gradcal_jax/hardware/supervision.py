"""The states of a run and how it ended; its status file, replaced every few seconds, and the rig file's alarm command.

File and alarm have their own threads: neither the disk nor the command delays the run.
"""

import json
import subprocess
import threading
import time
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any, Final, Literal

from gradcal_jax.hardware.clock import repeating
from gradcal_jax.hardware.journal import json_of
from gradcal_jax.hardware.roles import AxisReading, ChamberReading
from gradcal_jax.spec.rig import RigFile
from gradcal_jax.tables.display import printable, summary
from gradcal_jax.tables.writing import write_whole

STATUS: Final = "status.json"
FORMAT: Final = "gradcal-status/1"
_ALARM_S: Final = 60.0
_LONGEST_STATUS: Final = 1_000_000
# No more often, because a rehearsal goes through hours in a minute.
_WRITE_S: Final = 0.2


@dataclass(eq=False)
class SafeOutcome:
    """The outcome of one device. `evidence` is the read-back, or the last problem; `took_s`, until the newest
    read-back, is of the run's clock.

    Its thread fills it; the waiting thread takes a copy, with the state so far of a thread that hangs.
    """

    name: str
    action: str
    verified: bool = False
    evidence: str = "has not answered yet"
    tries: int = 0
    took_s: float = 0.0


class RunState(StrEnum):
    IDLE = "idle"
    RUNNING = "running"
    STOPPING = "stopping"
    ABORTING = "aborting"
    SAFE = "safe"
    FAILED = "failed"


@dataclass(frozen=True)
class RunResult:
    """How a run ended: "success" or "aborted", why, and the final state of every device."""

    exit_status: Literal["success", "aborted"]
    reason: str
    outcomes: tuple[SafeOutcome, ...]
    steps_done: int
    begun: bool = True
    """Whether anything was commanded to a device."""

    __repr__ = summary

    @property
    def verified_safe(self) -> bool:
        return all(outcome.verified for outcome in self.outcomes)


@dataclass(frozen=True)
class RunProgress:
    """The argument of `on_progress`, called once for each chamber reading in the run's own thread: the run waits until
    it returns."""

    state: RunState
    step: str
    steps_done: int
    steps: int
    step_left_s: float | None
    track_left_s: float
    chamber: ChamberReading | None
    axes: Mapping[str, AxisReading]
    course_c: tuple[float, float] | None = None
    """The lowest and the highest air temperature that the recipe allows now, without the band."""
    samples: Mapping[str, tuple[int, int]] = field(default_factory=dict[str, tuple[int, int]])
    """Samples of each IMU: received, and missing between them."""
    remarks: tuple[str, ...] = ()
    """What the operator should correct after the run, such as devices that answer late."""

    def as_status(self) -> dict[str, Any]:
        """As the status file has it."""
        return json_of({"at_s": time.time(), **asdict(self)})


@contextmanager
def status_file(folder: Path, *, simulated: bool) -> Generator[Callable[[Mapping[str, Any]], None]]:
    """A function that changes the status in the file, which a thread of its own writes."""
    status: dict[str, Any] = {"format": FORMAT, "simulated": simulated}
    changed = threading.Event()

    def change(changes: Mapping[str, Any]) -> None:
        status.update(changes)
        changed.set()

    def write() -> None:
        if changed.is_set():
            changed.clear()
            _write_status(folder / STATUS, dict(status))

    with repeating(write, _WRITE_S):
        yield change


def ended(exit_status: str, reason: str, safe: bool) -> dict[str, Any]:
    """What the status says of an end."""
    end = {"exit_status": exit_status, "reason": reason, "verified_safe": safe}
    return {**end, "state": "safe" if safe else "failed", "at_s": time.time()}


def _write_status(path: Path, status: Mapping[str, Any]) -> None:
    """Replace the file; on a full disk write over it, which needs no space. The journal reports what fails."""
    text = json.dumps(status, indent=1) + "\n"
    try:
        write_whole(path, text)
    except OSError:
        with suppress(OSError), path.open("r+b") as file:
            file.write(text.encode())
            file.truncate()


def end_status(folder: Path, why: str, outcomes: list[SafeOutcome]) -> None:
    """How a run ended whose guard made it safe, in its status file; nothing where there is none."""
    with suppress(OSError, ValueError):
        end = ended("lost", why, all(outcome.verified for outcome in outcomes))
        _write_status(folder / STATUS, read_status(folder) | end)


def read_status(folder: Path) -> dict[str, Any]:
    """The newest status of a run. Raises `ValueError` where there is none."""
    try:
        with (folder / STATUS).open(encoding="utf-8") as file:
            status = json.loads(printable(file.read(_LONGEST_STATUS)))
    except (OSError, ValueError, RecursionError):
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
