"""A process beside the run that makes the rig safe when the run is killed.

It holds one end of a pipe and nothing else. The run says "done" through it when it has ended by itself; when the pipe
closes without that word the run is gone, its ports are free again, and the guard opens them, makes every device safe,
and appends what became of them to the run's journal.
"""

import os
import subprocess
import sys
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path

from ..files.rig import read_rig
from .clock import RealClock
from .errors import HardwareError, PortRefused
from .journal import Journal
from .safety import SafeOutcome, make_safe
from .setup import Bench, open_rig

_DONE = b"done\n"
_TO_OPEN_S = 10.0


@contextmanager
def guarded(folder: Path) -> Generator[None, None, None]:
    """While inside, a guard watches this process. It ignores Ctrl-C, which is the run's to handle."""
    process = subprocess.Popen(
        [sys.executable, "-m", "gradcal_jax.hardware.guard", str(folder)],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    assert process.stdin is not None
    try:
        yield
    finally:
        try:
            process.stdin.write(_DONE)
            process.stdin.close()
        except OSError:
            pass  # the guard has died before: nothing to tell
        try:
            process.wait(timeout=10.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def watch(folder: Path) -> list[SafeOutcome]:
    """Wait for the run's end on standard input; make safe if it ended without its word."""
    said = b""
    while chunk := os.read(0, 64):
        said += chunk
    if said.endswith(_DONE):
        return []
    return make_folder_safe(folder)


def make_folder_safe(folder: Path, *, deadline_s: float = 60.0) -> list[SafeOutcome]:
    """Open the rig of a run's folder and make every device safe; the journal says what became of them."""
    clock = RealClock()
    rig = read_rig(folder / "rig.toml")
    with Journal(folder / "journal") as journal:
        journal.event(clock.now(), "guard", what="the run is gone; making the rig safe")
        try:
            bench = _open_soon(lambda: open_rig(rig, clock))
        except HardwareError as problem:
            journal.event(clock.now(), "guard", what=f"the rig could not be made safe: {problem}")
            return []
        with bench:
            outcomes = make_safe(bench, clock, deadline_s=deadline_s)
        for outcome in outcomes:
            journal.event(
                clock.now(),
                "made safe",
                by="guard",
                device=outcome.name,
                action=outcome.action,
                verified=outcome.verified,
                evidence=outcome.evidence,
            )
    return outcomes


def _open_soon(make: Callable[[], Bench]) -> Bench:
    """The killed run's ports are free in a moment."""
    end = time.monotonic() + _TO_OPEN_S
    while True:
        try:
            return make()
        except PortRefused:
            if time.monotonic() > end:
                raise
            time.sleep(0.1)


if __name__ == "__main__":
    watch(Path(sys.argv[1]))
