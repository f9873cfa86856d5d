"""A process beside the run that makes the rig safe when the run cannot do it any more.

It holds one end of a pipe and nothing else. The run says "begun" through it before it moves anything, and "done" when
it has ended by itself with everything verified safe. When the pipe closes after the one word and without the other, the
run was killed, broken off, or could not reach a device; its ports are free again, and the guard opens them, makes every
device safe, and then appends what became of them to the run's journal.
"""

import os
import subprocess
import sys
import threading
import time
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

from ..files.rig import RigFile, read_rig
from .clock import Clock, RealClock
from .errors import HardwareError, PortRefused
from .journal import Journal
from .safety import SafeOutcome, make_safe
from .setup import Bench, open_rig

_BEGUN = b"begun\n"
_DONE = b"done\n"
_TO_OPEN_S = 10.0


class Guard:
    """The run's end of the pipe. A guard that has died is told nothing, and the run goes on without it."""

    def __init__(self, pipe: IO[bytes]) -> None:
        self._pipe = pipe
        self.must_act = False

    def begun(self) -> None:
        """From now on the rig may be anything but safe."""
        self.must_act = True
        with suppress(OSError):
            self._pipe.write(_BEGUN)

    def done(self) -> None:
        """Everything was verified safe: nothing is left to do."""
        self.must_act = False
        with suppress(OSError):
            self._pipe.write(_DONE)


@contextmanager
def guarded(folder: Path) -> Generator[Guard, None, None]:
    """While inside, a guard watches this process. It ignores Ctrl-C, which is the run's to handle.

    The ports are to be opened inside and closed again before the end: then the guard takes over, if it has to.
    """
    process = subprocess.Popen(
        [sys.executable, "-m", "gradcal_jax.hardware.guard", str(folder)],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        start_new_session=True,
        bufsize=0,
    )
    assert process.stdin is not None
    guard = Guard(process.stdin)
    try:
        yield guard
    finally:
        process.stdin.close()
        if guard.must_act:
            # It takes as long as it takes; whoever waits for the run's end is to hear of it now.
            threading.Thread(target=process.wait, daemon=True, name="leaving it to the guard").start()
        else:
            try:
                process.wait(timeout=10.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def watch(folder: Path) -> list[SafeOutcome]:
    """Wait for the run's end on standard input; make safe if it had begun and ended without its last word."""
    said = b""
    while chunk := os.read(0, 64):
        said += chunk
    if _BEGUN not in said or said.endswith(_DONE):
        return []
    return make_folder_safe(folder)


def make_folder_safe(folder: Path, *, deadline_s: float = 60.0) -> list[SafeOutcome]:
    """Open the rig of a run's folder and make every device safe; the journal says afterwards what became of them."""
    clock = RealClock()
    rig = read_rig(folder / "rig.toml")
    outcomes: list[SafeOutcome] = []
    happened: list[tuple[float, str, dict[str, Any]]] = []

    def note(name: str, **data: Any) -> None:
        happened.append((clock.now(), name, data))

    note("guard", what="the run is gone, or left something unsafe; making the rig safe")
    try:
        with _open_soon(rig, clock, outcomes) as bench:
            outcomes += make_safe(bench, clock, deadline_s=deadline_s)
    except HardwareError as problem:
        note("guard", what=f"the rig could not be made safe: {problem}")
    for outcome in outcomes:
        note(
            "made safe",
            by="guard",
            device=outcome.name,
            action=outcome.action,
            verified=outcome.verified,
            evidence=outcome.evidence,
        )
    _write(folder / "journal", happened)
    return outcomes


def _write(path: Path, happened: list[tuple[float, str, dict[str, Any]]]) -> None:
    """Only now: to open a journal of hours takes seconds, and it may be its full disk that has ended the run."""
    try:
        with Journal(path) as journal:
            for time_s, name, data in happened:
                journal.event(time_s, name, **data)
    except Exception as problem:
        # What became of the devices is said to whoever is there.
        print(problem, *(f"{name}: {data}" for _, name, data in happened), sep="\n", file=sys.stderr)


def _open_soon(rig: RigFile, clock: Clock, missing: list[SafeOutcome]) -> Bench:
    """The killed run's ports are free in a moment. A port that is not, as of a cable that was pulled, keeps no other
    device from being made safe: its device is among the `missing`.
    """
    end = time.monotonic() + _TO_OPEN_S
    while True:
        try:
            return open_rig(rig, clock)
        except PortRefused:
            if time.monotonic() > end:
                break
            time.sleep(0.1)

    def opens(name: str, action: str, **alone: Any) -> bool:
        try:
            open_rig(nothing.model_copy(update=alone), clock).close()
        except HardwareError as problem:
            missing.append(SafeOutcome(name, action, False, str(problem), 0, 0.0))
            return False
        return True

    nothing = rig.model_copy(update={"chamber": None, "axis": (), "imu": ()})
    axes = [entry for entry in rig.axis if opens(entry.name, entry.safe, axis=(entry,))]
    chamber = rig.chamber if rig.chamber and opens("chamber", rig.chamber.safe, chamber=rig.chamber) else None
    units = [entry for entry in rig.imu if opens(entry.name, "left streaming", imu=(entry,))]
    return open_rig(rig.model_copy(update={"chamber": chamber, "axis": tuple(axes), "imu": tuple(units)}), clock)


if __name__ == "__main__":
    watch(Path(sys.argv[1]))
