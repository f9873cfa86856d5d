"""Killing runs (SIGKILL) wherever they are, and going on with them, for the tests of what that does to a run's data.

A kill comes at any time of a run with the same chance. What the run did then is read from the journal afterwards.
"""

import signal
import subprocess
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from hardware_bench import parse_journal
from hardware_processes import start_run

from gradcal_jax.hardware.journal import Event
from gradcal_jax.hardware.run_folder import exit_status
from gradcal_jax.hardware.track import Track

# A run waits for the temperature for about so long, real s.
_WAITS_S = 3.0
_WHILE_IT_STARTS, _WHILE_SAFE = 0.1, 0.15


@dataclass
class Killer:
    """Kills runs of a track on the laboratory in a folder, until there are `most` kills."""

    folder: Path
    track: Track
    speed: float
    random: np.random.Generator
    most: int
    guard: bool = False
    kills: int = 0

    def run_to_its_end(self, path, after_a_kill=lambda fresh: None):
        """Begin a run, kill it and go on with it until it is complete. `after_a_kill` is handed the events of the part
        that was killed, and what its guard added."""
        torn, records = b"", []
        while True:
            run = start_run(self.folder, path, self.speed, guard=self.guard)
            killed = self.kills < self.most and self._strike(run, path / "journal")
            said, _ = run.communicate()
            journal = (path / "journal").read_bytes() if (path / "journal").exists() else b""
            # Nothing that was on the disk is ever lost or changed, and it reads as it did.
            assert journal.startswith(torn)
            contents = parse_journal(journal)
            assert contents.records[: len(records)] == records
            if killed:
                fresh = [entry for entry in contents.records[len(records) :] if isinstance(entry, Event)]
                self.kills += 1
                after_a_kill(fresh)
            torn, records = journal, contents.records
            # A kill may come between the run's last word and the end of its process.
            if run.returncode == 0 or exit_status(contents) == "success":
                return
            assert run.returncode == -signal.SIGKILL or "SIGTERM" in said, said
            if not (path / "run.json").exists():
                for entry in path.glob("*"):
                    entry.unlink()

    def _strike(self, run, journal):
        """Kill the run at an instant, some while they start or make the rig safe; False when it ended before."""
        random, begun = self.random, runs_begun(journal)
        if random.random() < _WHILE_IT_STARTS:
            alive = lasts(run, float(random.uniform(0.0, 1.2)))
        else:
            while lasts(run, 0.05) and runs_begun(journal) == begun:
                pass
            alive = lasts(run, float(random.uniform(0.0, _WAITS_S + self.track.duration_s / self.speed)))
        if alive and random.random() < _WHILE_SAFE:
            run.send_signal(signal.SIGTERM)
            alive = lasts(run, float(random.uniform(0.0, 0.15)))
        if alive:
            run.send_signal(signal.SIGKILL)
        return alive


def runs_begun(journal):
    return journal.read_bytes().count(b'"state":"running"') if journal.exists() else 0


def lasts(run, real_s):
    """Wait so long; False when the run ended before."""
    try:
        run.wait(timeout=real_s)
    except subprocess.TimeoutExpired:
        return True
    return False


def require_seams(contents, track):
    """Every session that goes on in the middle of the track marks a seam, at the step with which it goes on, before it
    does anything of it; beside those there are only those of steps that a busy computer did not execute as written, and
    made again. How many there are."""
    sessions = []
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
