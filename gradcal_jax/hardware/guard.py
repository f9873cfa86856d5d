"""Making a rig safe, and the guard: a process beside the run that does so when the run no longer can.

Every device is made safe in its own thread, with its own deadline, retried, verified by read-back: one that hangs
delays no other.

The guard reads the rig file and the drivers before anything moves, and sends "ready". The run sends "begun" before its
first command, "before" with every setting of a device before the first change, "alive" every second, and "done" when it
has ended with everything verified safe, or before it commanded anything. The guard replies "alive"; one that died or no
longer replies is replaced, which is an event of the run's journal.

When the pipe closes after "begun" or "before" and without "done", the run was killed, broken off, or could not reach a
device. When the pipe stays open and silent, the run hangs: the guard ends it. Then it opens the ports, makes every
device safe, restores the settings, and appends the outcome to the run's journal and its status. A device that does not
answer is tried again for an hour, unless another run takes its port.
"""

import json
import os
import queue
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from gradcal_jax.hardware import transport
from gradcal_jax.hardware.clock import Clock, RealClock, in_thread, until
from gradcal_jax.hardware.errors import Disconnected, HardwareError, PortRefused, PortTaken, sentence_of
from gradcal_jax.hardware.journal import Event, Journal, event_fields
from gradcal_jax.hardware.roles import SafeReport
from gradcal_jax.hardware.setup import LEFT, Bench, configs_of, lines_of, only_of, open_rig
from gradcal_jax.hardware.supervision import SafeOutcome, end_status, sound_alarm
from gradcal_jax.spec.rig import RigFile, read_rig

Settings = dict[str, dict[str, str]]
"""Settings of devices before the run changed them, by device and name."""

BEAT_S = 1.0
_SILENT_S = 20.0
_TO_START_S = 30.0
_TO_OPEN_S = 3.0
_KEEP_TRYING_S = 3600.0
_LONGEST_PAUSE_S = 30.0
_RETRY_PAUSE_S = 0.2
_GOES_ON = "an earlier command to this device is still active"
_LOST = "the run has ended unexpectedly, or a device is not safe"


def make_safe(
    bench: Bench, clock: Clock, *, deadline_s: float = 60.0, busy: Callable[[str], bool] = lambda name: False
) -> list[SafeOutcome]:
    """Bring every device of the bench to the safe state of the rig file.

    `busy` is called in a device's thread, with its name: whether an earlier command to it is still active, for whose
    end it may wait. Such a device is made safe at once, and again: the command could undo it. Returns after all devices
    are verified, or after `deadline_s`; raises no error of a device.
    """
    began_s = clock.now()

    def attempt(outcome: SafeOutcome, act: Callable[[], SafeReport]) -> None:
        while not outcome.verified and clock.now() < began_s + deadline_s:
            clock.sleep(_RETRY_PAUSE_S if outcome.tries else 0.0)
            outcome.tries += 1
            try:
                goes_on, report = busy(outcome.name), act()
                outcome.evidence = f"{report.evidence}; {_GOES_ON}" if goes_on else report.evidence
                outcome.took_s = clock.now() - began_s
                outcome.verified = report.verified and not goes_on
            except BaseException as problem:
                # No error of a driver, of whatever kind, prevents the next try.
                outcome.evidence = sentence_of(problem)
                if isinstance(problem, Disconnected) and outcome.name in bench.lines:
                    # Its cable may be in again.
                    with suppress(Exception):
                        bench.lines[outcome.name].reopen()

    acts = {
        SafeOutcome(axis.name, axis.safe): partial(bench.axes[axis.name].safe, axis.safe) for axis in bench.rig.axis
    }
    if bench.chamber is not None and (how := bench.rig.chamber) is not None:
        acts[SafeOutcome("chamber", how.safe)] = partial(bench.chamber.safe, how.safe, float(how.ambient))
    ends = [in_thread(partial(attempt, *one), clock, str) for one in acts.items()]
    until(lambda: all(end.is_set() for end in ends), clock, longest_s=deadline_s)
    # Copies, of what threads that hang may still fill.
    outcomes = [replace(outcome) for outcome in acts]
    return outcomes + [SafeOutcome(entry.name, LEFT, True, "an IMU has no unsafe state") for entry in bench.rig.imu]


def put_back(bench: Bench) -> dict[str, str]:
    """Restore the settings that drivers have changed; by device with changed settings the problem, or an empty text."""
    problems = {name: "" for name, settings in bench.settings.items() if settings.before}
    for name in problems:
        try:
            bench.settings[name].put_back()
        except Exception as problem:
            problems[name] = sentence_of(problem)
    return problems


class Guard:
    """The run's end of the pipes. The guard ignores Ctrl-C, which the run handles.

    The ports must be opened after it and closed before `close`: then the guard can take over.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        # What another guard has to hear; nothing: there is nothing to make safe.
        self._said: list[str] = []
        self._next_start_s = 0.0
        self._start()

    def begun(self) -> None:
        self._said.append("begun")
        self._say("begun")

    def remember(self, device: str, name: str, value: str) -> None:
        """Send the present value of a device's setting, before it is changed."""
        self._said.append("before " + json.dumps([device, name, value]))
        self._say(self._said[-1])

    def done(self) -> None:
        self._said = []
        self._say("done")

    def beat(self) -> str:
        """Send "alive". Returns a sentence where the guard had died, or no longer replied, and was replaced."""
        now_s, why = time.monotonic(), "had died"
        if self.process.poll() is None:
            if self._replied():
                self._heard_s = now_s
            if now_s < self._heard_s + _SILENT_S:
                self._say("alive")
                return ""
            why = f"had not replied for {_SILENT_S:g} s"
        if now_s < self._next_start_s:
            return ""
        self._next_start_s = now_s + _LONGEST_PAUSE_S
        self.process.kill()
        self._release()
        self._start()
        return f"the guard {why}; another guard has replaced it"

    def close(self) -> None:
        """The run ends here; the guard begins now if it has to act. One that died since the last beat is replaced."""
        self._release()
        if self._said and self.process.poll() is not None:
            with suppress(HardwareError):
                self._start()
            self._release()
        # A guard that acts has no time limit; the run's exit status is reported at once.
        threading.Thread(target=self.process.wait, daemon=True, name="leaving it to the guard").start()

    def _start(self) -> None:
        """Start a guard, which hears all that an earlier one had heard. Raises `HardwareError` where it cannot work."""
        self.process = subprocess.Popen(
            # Isolated: a queue.py in the folder where the run was started is not the guard's.
            [sys.executable, "-I", "-m", "gradcal_jax.hardware.guard", str(self._folder), str(_SILENT_S)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
            bufsize=0,
        )
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self._input, self._output = self.process.stdin, self.process.stdout
        # (Windows has no such wait for a pipe.)
        heard = os.name == "nt" or bool(select.select([self._output], [], [], _TO_START_S)[0])
        if not (heard and self._output.read(1)):
            self.process.kill()
            self._release()
            self.process.wait()
            raise HardwareError(
                f"The guard, which makes the rig safe if this run is killed, cannot work with {self._folder}: see "
                "the guard's message above."
            )
        # A guard that hangs delays no run. Windows has this from Python 3.12 on.
        for pipe in (self._input, self._output):
            with suppress(AttributeError):
                os.set_blocking(pipe.fileno(), False)
        self._heard_s = time.monotonic()
        for line in self._said:
            self._say(line)
        self._say("alive")

    def _release(self) -> None:
        """Close the pipes: a guard that listens learns that the run ends here."""
        self._input.close()
        self._output.close()

    def _replied(self) -> bool:
        """Whether the guard has replied since the last call; always where reading would wait for a reply."""
        if not hasattr(os, "set_blocking"):
            return True
        return bool(self._output.read(4096))

    def _say(self, line: str) -> None:
        with suppress(OSError, ValueError):
            self._input.write(line.encode() + b"\n")


def watch(folder: Path, silent_s: float = _SILENT_S, keep_trying_s: float = _KEEP_TRYING_S) -> list[SafeOutcome]:
    """Wait for the run's end on standard input; make safe if it began and then ended or hangs without "done"."""
    # Its working folder keeps the guard with a run's folder that is moved.
    os.chdir(folder)
    transport.owner = f"the guard of the run {folder.absolute()}"
    rig = read_rig("rig.toml")
    configs_of(rig)
    run = os.getppid()
    # (A run that has ended already is heard below.)
    with suppress(BrokenPipeError):
        os.write(1, b"ready\n")
    lines: queue.SimpleQueue[bytes] = queue.SimpleQueue()

    def listen() -> None:
        for line in sys.stdin.buffer:
            lines.put(line)
        lines.put(b"")

    threading.Thread(target=listen, daemon=True, name="hearing the run").start()
    begun, why, line = False, _LOST, b"alive"
    before: Settings = {}
    while line:
        try:
            line = lines.get(timeout=silent_s)
        except queue.Empty:
            if begun and why == _LOST:
                why = "the run no longer responded and was ended"
                with suppress(OSError):
                    os.kill(run, getattr(signal, "SIGKILL", signal.SIGTERM))
        if line == b"begun\n":
            begun = True
        elif line == b"done\n":
            begun, before = False, {}
        elif line == b"alive\n":
            with suppress(OSError):
                os.write(1, line)
        elif line.startswith(b"before ") and line.endswith(b"\n"):
            device, name, value = json.loads(line.removeprefix(b"before "))
            before.setdefault(device, {}).setdefault(name, value)
    if not (begun or before):
        return []
    # The alarm comes first: a device that does not answer may take an hour.
    sound_alarm(rig, f"In {folder} {why}; the guard makes the rig safe")
    return make_folder_safe(Path(), before=before, why=why, keep_trying_s=keep_trying_s, rig=rig)


def make_folder_safe(
    folder: Path,
    *,
    rig: RigFile | None = None,
    before: Settings | None = None,
    why: str = _LOST,
    deadline_s: float = 60.0,
    keep_trying_s: float = 0.0,
) -> list[SafeOutcome]:
    """Make every device of a run's folder safe and restore its settings; the journal has the outcome.

    The devices of each port have a thread of their own, so that whatever one port or device raises concerns no other.
    A device that is not verified safe is tried again for `keep_trying_s`.
    """
    clock, rig = RealClock(), rig or read_rig(folder / "rig.toml")
    lines, began_s, started = lines_of(rig), clock.now(), before or {}
    outcomes = {name: SafeOutcome(name, action) for name, (_, action) in lines.items()}
    happened: list[Event] = []

    def note(name: str, **data: Any) -> None:
        happened.append(Event(clock.now(), name, data))

    def attempt(names: list[str]) -> list[SafeOutcome]:
        with open_rig(only_of(rig, names), clock) as bench:
            for name, settings in bench.settings.items():
                settings.keep(started.get(name, {}))
            found = make_safe(bench, clock, deadline_s=deadline_s)
            for name, problem in put_back(bench).items():
                note("settings put back", device=name, problem=problem)
            return found

    def attend(names: list[str]) -> None:
        pause_s = 1.0
        while True:
            try:
                found = attempt(names)
            except BaseException as problem:
                if isinstance(problem, PortRefused) and clock.now() < began_s + _TO_OPEN_S:
                    # A port of the killed run becomes free in a moment.
                    time.sleep(0.1)
                    continue
                # The other run is responsible for a port that it has taken.
                taken, said = isinstance(problem, PortTaken), sentence_of(problem)
                how = {name: "left to another run" if taken else lines[name][1] for name in names}
                found = [SafeOutcome(name, action, taken, said) for name, action in how.items()]
            for outcome in found:
                outcomes[outcome.name] = outcome
                note("made safe", by="guard", **event_fields(outcome))
            left = [outcome for outcome in found if not outcome.verified]
            if not left or clock.now() > began_s + keep_trying_s:
                return
            for outcome in left:
                _say(f"{outcome.name} is not safe; the guard tries again: {outcome.evidence}")
            time.sleep(pause_s)
            pause_s = min(2.0 * pause_s, _LONGEST_PAUSE_S)

    note("guard", what=f"{why}; making the rig safe")
    ports = {port: [name for name in lines if lines[name][0] == port] for port, _ in lines.values()}
    at_work = [threading.Thread(target=attend, args=(names,), daemon=True) for names in ports.values()]
    for thread in at_work:
        thread.start()
    # What the first tries were is written before those that follow.
    for longest_s in (_TO_OPEN_S + 2.0 * deadline_s, _TO_OPEN_S + 2.0 * deadline_s + keep_trying_s):
        for thread in at_work:
            thread.join(max(0.0, began_s + longest_s - clock.now()))
        _write(folder / "journal", happened)
    end_status(folder, why, list(outcomes.values()))
    left = ", ".join(name for name, outcome in outcomes.items() if not outcome.verified)
    safe = f"NOT VERIFIED SAFE: {left}" if left else "everything is verified safe"
    _say(f"{transport.owner or 'the guard'}: {why}; {safe}")
    return list(outcomes.values())


def _say(sentence: str) -> None:
    """To the terminal of the run, which may be gone."""
    with suppress(OSError, ValueError):
        print(sentence, file=sys.stderr, flush=True)


def _write(path: Path, happened: list[Event]) -> None:
    """Written when the devices are safe: a full disk may have ended the run."""
    events, happened[:] = happened[:], []
    if not events:
        return
    try:
        with Journal(path) as journal:
            for event in events:
                journal.event(event.time_s, event.name, **event.data)
        problem = journal.problem
    except Exception as error:
        problem = str(error)
    if problem:
        _say("\n".join([problem, *(f"{event.name}: {event.data}" for event in events)]))


if __name__ == "__main__":
    watch(Path(sys.argv[1]), *map(float, sys.argv[2:]))
