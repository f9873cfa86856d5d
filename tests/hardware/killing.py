"""Killing runs (SIGKILL) wherever they are, and going on with them, for the tests of what that does to a run's data.

When to kill is drawn by what the journal shows: while a run starts, while it waits for its temperature, in any part of
a step with data, while it makes the rig safe. In which of these a kill fell is read from the journal afterwards.
"""

import collections
import signal
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from hardware_bench import parse_journal
from hardware_processes import start_run

from gradcal_jax.hardware.journal import Event, JournalContents
from gradcal_jax.hardware.run_folder import exit_status
from gradcal_jax.hardware.track import Track

STARTING, WAITING, TURNING, STANDING, SAFE = "starting", "waiting for its temperature", "turning", "standing", "safe"
AIMS = (STARTING, WAITING, STANDING, TURNING, SAFE)
SHARES = (0.08, 0.08, 0.38, 0.38, 0.08)


class Watched:
    """A run as a process, and the part of the journal that it has written so far."""

    def __init__(self, folder: Path, run: Path, speed: float, *, guard: bool = False) -> None:
        self.journal = run / "journal"
        self._from = self.journal.stat().st_size if self.journal.exists() else 0
        self.process = start_run(folder, run, speed, guard=guard)

    def written(self) -> bytes:
        if not self.journal.exists():
            return b""
        with self.journal.open("rb") as file:
            file.seek(self._from)
            return file.read()

    def await_word(self, word: bytes) -> bool:
        """False when the run ended before."""
        end = time.monotonic() + 120.0
        while word not in self.written():
            if self.process.poll() is not None:
                return False
            assert time.monotonic() < end, f"never came: {word!r}"
            time.sleep(0.01)
        return True

    def lasts(self, real_s: float) -> bool:
        """Wait so long; False when the run ended before."""
        try:
            self.process.wait(timeout=real_s)
        except subprocess.TimeoutExpired:
            return True
        return False

    def end(self) -> str:
        """Wait for the process, and for its guard where that had to act, and close their pipe; what they said."""
        assert self.process.stdout is not None
        said = self.process.stdout.read()
        self.process.wait()
        self.process.stdout.close()
        return said


@dataclass
class Killer:
    """Kills runs of a track on the laboratory in a folder, until there are `most` kills, counted by where they fell."""

    folder: Path
    track: Track
    speed: float
    random: np.random.Generator
    most: int
    guard: bool = False
    kills: collections.Counter[str] = field(default_factory=collections.Counter)

    def run_to_its_end(self, path: Path, after_a_kill: Callable[[list[Event]], None] = lambda fresh: None) -> None:
        """Begin a run, kill it and go on with it until it is complete. `after_a_kill` is handed the events of the part
        that was killed, and what its guard added."""
        torn, records = b"", []
        while True:
            done = [int(event.data["number"]) for event in parse_journal(torn).events if event.name == "step done"]
            first = max(done, default=-1) + 1
            run = Watched(self.folder, path, self.speed, guard=self.guard)
            aim = AIMS[int(self.random.choice(len(AIMS), p=SHARES))]
            killed = self.kills.total() < self.most and self._strike(run, aim, first)
            said = run.end()
            journal = (path / "journal").read_bytes() if (path / "journal").exists() else b""
            # Nothing that was on the disk is ever lost or changed, and it reads as it did.
            assert journal.startswith(torn)
            contents = parse_journal(journal)
            assert contents.records[: len(records)] == records
            if killed:
                fresh = [entry for entry in contents.records[len(records) :] if isinstance(entry, Event)]
                self.kills[fell_in(fresh)] += 1
                after_a_kill(fresh)
            torn, records = journal, contents.records
            # A kill may come between the run's last word and the end of its process.
            if run.process.returncode == 0 or exit_status(contents) == "success":
                return
            assert run.process.returncode == -signal.SIGKILL or "SIGTERM" in said, said
            if not (path / "run.json").exists():
                for entry in path.glob("*"):
                    entry.unlink()

    def _strike(self, run: Watched, aim: str, first: int) -> bool:
        """Let the run come to where it is to be killed, and kill it there. False when it ended before."""
        random, steps = self.random, self.track.steps
        if aim == STARTING:
            alive = run.lasts(float(random.uniform(0.0, 1.2)))
        elif aim == WAITING:
            alive = run.await_word(b'"state":"running"') and run.lasts(float(random.uniform(0.0, 0.8)))
        else:
            # A step with data, of those that come next, and an instant in it; beyond the last there is only the end.
            coming = [number for number in range(first, len(steps)) if steps[number].read_at_s]
            ahead = int(random.choice(3, p=(0.3, 0.4, 0.3)))
            if coming and aim != SAFE:
                ahead = min(ahead, len(coming) - 1)
            if ahead < len(coming):
                step = steps[coming[ahead]]
                begins = b'"event":"step begins","step":"%s"' % step.name.encode()
                turns = [(move.start_s, move.start_s + move.duration_s) for move in step.moves]
                span = turns[int(random.choice(len(turns)))] if aim == TURNING else (0.0, step.duration_s)
                alive = run.await_word(begins) and run.lasts(float(random.uniform(*span)) / self.speed)
            else:
                alive = aim == SAFE
            if alive and aim == SAFE:
                if ahead < len(coming):
                    run.process.send_signal(signal.SIGTERM)
                run.await_word(b'"event":"ending"')
                alive = run.lasts(float(random.uniform(0.0, 0.1)))
        if alive:
            run.process.send_signal(signal.SIGKILL)
        return alive


def fell_in(events: list[Event]) -> str:
    """What a session did when it was killed, by the events that it left."""
    state = STARTING
    turning: set[str] = set()
    for event in events:
        if event.name == "ending":
            state = SAFE
        elif event.name == "step":
            state = WAITING
        elif event.name == "step begins":
            state = STANDING if event.data["data"] else WAITING
        elif event.name == "move" and event.data["kind"] == "turn":
            turning.add(event.data["axis"])
        elif event.name == "angle" and not event.data["moving"]:
            turning.discard(event.data["axis"])
    return TURNING if state == STANDING and turning else state


def require_seams(contents: JournalContents, track: Track) -> int:
    """Every session that goes on in the middle of the track marks a seam, at the step with which it goes on, before it
    does anything of it; beside those there are only those of steps that a busy computer did not execute as written, and
    made again. How many there are."""
    sessions: list[list[Event]] = []
    for event in contents.events:
        if event.name == "session":
            sessions.append([])
        if sessions:
            sessions[-1].append(event)
    seams = 0
    for number, events in enumerate(sessions):
        first = int(events[0].data["first_step"])
        names = [event.name for event in events]
        if "step" not in names:
            continue
        marked = [event for event in events if event.name == "seam"]
        resumed = number > 0 and first > 0
        assert resumed <= len(marked) <= resumed + names.count("not done")
        if resumed:
            assert marked[0].data["step"] == track.steps[first].name
            assert names.index("seam") < names.index("step")
        seams += len(marked)
    return seams
