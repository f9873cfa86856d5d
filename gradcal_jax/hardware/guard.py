"""Making a rig safe, and the guard: a process beside the run that does so when the run no longer can.

Every device is made safe in its own thread, with its own deadline, retried, verified by read-back: one that hangs
delays no other.

The guard reads the rig file and the drivers before anything moves, and sends "ready". The run sends "begun" before its
first command, "before" with every setting of a device before the first change, "alive" every second, and "done" when it
has ended with everything verified safe, or before it commanded anything. The guard replies "alive"; one that does not
is replaced, which is an event of the run's journal.

When the pipe closes after "begun" or "before" and without "done", the run was killed, broken off, or could not reach a
device. When the pipe stays open and silent, the run hangs: the guard ends it. Then it opens the ports, makes every
device safe, restores the settings, and appends the outcome to the run's journal and its status. A device that does not
answer is tried again for an hour, unless another run takes its port.
"""

import json
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import IO, Any

from gradcal_jax.hardware import transport
from gradcal_jax.hardware.clock import Clock, RealClock, in_thread
from gradcal_jax.hardware.errors import Disconnected, HardwareError, PortRefused, PortTaken, sentence_of
from gradcal_jax.hardware.journal import Journal
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
_LOOKS_S = 0.02
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
    acts: dict[str, Callable[[], SafeReport]] = {}
    outcomes: list[SafeOutcome] = []
    for entry in bench.rig.axis:
        acts[entry.name] = partial(bench.axes[entry.name].safe, entry.safe)
        outcomes.append(SafeOutcome(entry.name, entry.safe))
    if bench.chamber is not None and (how := bench.rig.chamber) is not None:
        acts["chamber"] = partial(bench.chamber.safe, how.safe, float(how.ambient))
        outcomes.append(SafeOutcome("chamber", how.safe))
    began_s = clock.now()

    def attempt(outcome: SafeOutcome) -> None:
        while True:
            outcome.tries += 1
            try:
                goes_on, report = busy(outcome.name), acts[outcome.name]()
                outcome.evidence = f"{report.evidence}; {_GOES_ON}" if goes_on else report.evidence
                outcome.verified = report.verified and not goes_on
            except BaseException as problem:
                # No error of a driver, of whatever kind, prevents the next try.
                outcome.evidence = sentence_of(problem)
                if isinstance(problem, Disconnected) and outcome.name in bench.lines:
                    # Its cable may be in again.
                    with suppress(Exception):
                        bench.lines[outcome.name].reopen()
            now_s = clock.now()
            if outcome.verified or now_s >= began_s + deadline_s:
                outcome.took_s = now_s - began_s
                outcome.at_s = now_s if outcome.verified else None
                return
            clock.sleep(_RETRY_PAUSE_S)

    with clock.party():
        ends = [in_thread(partial(attempt, outcome), clock, str) for outcome in outcomes]
        while clock.now() < began_s + deadline_s and not all(end.is_set() for end in ends):
            clock.sleep(_LOOKS_S)
    outcomes = [
        replace(outcome, took_s=outcome.took_s if end.is_set() else deadline_s)
        for outcome, end in zip(outcomes, ends, strict=True)
    ]
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
        self._lock = threading.Lock()
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
        """Send "alive". Returns a sentence where the guard did not reply and was replaced."""
        code, now = self.process.poll(), time.monotonic()
        if code is None and (self._unanswered_s is None or now - self._unanswered_s < _SILENT_S):
            self._unanswered_s = self._unanswered_s or now
            self._say("alive")
            return ""
        if now < self._next_start_s:
            return ""
        self._next_start_s = now + _LONGEST_PAUSE_S
        self._replace()
        why = "had died" if code is not None else f"had not answered for {_SILENT_S:g} s"
        return f"the guard {why}; another guard has replaced it"

    def close(self) -> None:
        """The run ends here; the guard begins now if it has to act. One that died since the last beat is replaced."""
        if self._said and self.process.poll() is not None:
            with suppress(HardwareError):
                self._replace()
        with self._lock, suppress(OSError):
            self._input.close()
        if self._said:
            # This has no time limit; the run's exit status is reported at once.
            threading.Thread(target=self.process.wait, daemon=True, name="leaving it to the guard").start()
            return
        try:
            self.process.wait(timeout=10.0)
        except subprocess.TimeoutExpired:
            self._end()

    def _start(self) -> None:
        """Start a guard. Raises `HardwareError` where it cannot work."""
        process = subprocess.Popen(
            # Isolated: a queue.py in the folder where the run was started is not the guard's.
            [sys.executable, "-I", "-m", "gradcal_jax.hardware.guard", str(self._folder), str(_SILENT_S)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
            bufsize=0,
        )
        assert process.stdin is not None
        assert process.stdout is not None
        self.process, self._input = process, process.stdin
        self._unanswered_s: float | None = None
        heard, ready = threading.Event(), deque[bytes](maxlen=1)

        def listen(output: IO[bytes]) -> None:
            with output:
                while line := output.read(64):
                    ready.append(line)
                    heard.set()
                    self._unanswered_s = None
            heard.set()

        threading.Thread(target=listen, args=(process.stdout,), daemon=True, name="hearing the guard").start()
        heard.wait(_TO_START_S)
        if not ready:
            self._end()
            raise HardwareError(
                f"The guard, which makes the rig safe if this run is killed, cannot work with {self._folder}: see "
                "the guard's message above."
            )

    def _replace(self) -> None:
        """Start another guard, which hears all that this one had heard. Raises `HardwareError` where it cannot work."""
        self._end()
        self._start()
        for line in self._said:
            self._say(line)

    def _end(self) -> None:
        self.process.kill()
        self.process.wait()
        with self._lock, suppress(OSError):
            self._input.close()

    def _say(self, line: str) -> None:
        with self._lock, suppress(OSError, ValueError):
            self._input.write(line.encode() + b"\n")


def watch(folder: Path, silent_s: float = _SILENT_S, keep_trying_s: float = _KEEP_TRYING_S) -> list[SafeOutcome]:
    """Wait for the run's end on standard input; make safe if it began and then ended or hangs without "done"."""
    # Its working folder keeps the guard with a run's folder that is moved.
    os.chdir(folder)
    transport.owner = f"the guard of the run {folder.absolute()}"
    rig = read_rig("rig.toml")
    configs_of(rig)
    run = os.getppid()
    print("ready", flush=True)
    lines: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()

    def listen() -> None:
        buffer = b""
        while chunk := os.read(0, 4096):
            *whole, buffer = (buffer + chunk).split(b"\n")
            for line in whole:
                lines.put(line)
        lines.put(None)

    threading.Thread(target=listen, daemon=True, name="hearing the run").start()
    begun, why = False, _LOST
    before: Settings = {}
    while True:
        try:
            line = lines.get(timeout=silent_s)
        except queue.Empty:
            if begun and why == _LOST:
                why = "the run no longer responded and was ended"
                with suppress(OSError):
                    os.kill(run, getattr(signal, "SIGKILL", signal.SIGTERM))
            continue
        if line is None:
            break
        if line == b"begun":
            begun = True
        elif line == b"done":
            begun, before = False, {}
        elif line == b"alive":
            with suppress(OSError):
                print("alive", flush=True)
        elif line.startswith(b"before "):
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

    A device that is not verified safe is tried again for `keep_trying_s`.
    """
    clock, rig = RealClock(), rig or read_rig(folder / "rig.toml")
    happened: list[tuple[float, str, dict[str, Any]]] = []

    def note(name: str, **data: Any) -> None:
        happened.append((clock.now(), name, data))

    note("guard", what=f"{why}; making the rig safe")
    end, pause_s, outcomes = time.monotonic() + keep_trying_s, 1.0, dict[str, SafeOutcome]()
    at_work: dict[str, threading.Thread] = {}
    left = list(lines_of(rig))
    while True:
        for outcome in _try_once(only_of(rig, left), clock, before or {}, deadline_s, note, at_work):
            outcomes[outcome.name] = outcome
            details = {"action": outcome.action, "verified": outcome.verified, "evidence": outcome.evidence}
            note("made safe", by="guard", device=outcome.name, **details)
        left = [name for name, outcome in outcomes.items() if not outcome.verified]
        again = bool(left) and time.monotonic() < end
        if left and keep_trying_s:
            # Every try is printed; the journal has the first and the last.
            what = "is not safe; the guard tries again" if again else "could not be made safe"
            for name in left:
                _say(f"{name} {what}: {outcomes[name].evidence}")
            note("guard", what=f"{', '.join(left)} {what}")
        if not again or pause_s == 1.0:
            _write(folder / "journal", happened)
        happened.clear()
        if not again:
            end_status(folder, why, list(outcomes.values()))
            safe = "NOT VERIFIED SAFE: " + ", ".join(left) if left else "everything is verified safe"
            _say(f"{transport.owner or 'the guard'}: {why}; {safe}")
            return list(outcomes.values())
        time.sleep(pause_s)
        pause_s = min(2.0 * pause_s, _LONGEST_PAUSE_S)


def _try_once(
    rig: RigFile,
    clock: Clock,
    before: Settings,
    deadline_s: float,
    note: Callable[..., None],
    at_work: dict[str, threading.Thread],
) -> list[SafeOutcome]:
    """Try the devices of each port in a thread of their own: whatever one port or device raises concerns no other.
    `at_work`: the threads of earlier tries, by port; one that hangs keeps its port."""
    lines = lines_of(rig)
    outcomes = {name: SafeOutcome(name, action) for name, (_, action) in lines.items()}

    def attempt(names: list[str]) -> None:
        try:
            with _open_soon(only_of(rig, names).model_copy(update={"operator": None}), clock) as bench:
                for name, settings in bench.settings.items():
                    settings.keep(before.get(name, {}))
                outcomes.update((outcome.name, outcome) for outcome in make_safe(bench, clock, deadline_s=deadline_s))
                for name, problem in put_back(bench).items():
                    note("settings put back", device=name, problem=problem)
        except BaseException as problem:
            # The other run is responsible for a port that it has taken.
            taken = isinstance(problem, PortTaken)
            for name in names:
                action = "left to another run" if taken else lines[name][1]
                outcomes[name] = SafeOutcome(name, action, taken, sentence_of(problem))

    ports = list(dict.fromkeys(port for port, _ in lines.values()))
    for port in ports:
        if port not in at_work or not at_work[port].is_alive():
            names = [name for name in lines if lines[name][0] == port]
            at_work[port] = threading.Thread(target=attempt, args=(names,), daemon=True, name=f"making {port} safe")
            at_work[port].start()
    end = time.monotonic() + _TO_OPEN_S + 2.0 * deadline_s
    for port in ports:
        at_work[port].join(max(0.0, end - time.monotonic()))
    return list(outcomes.values())


def _say(sentence: str) -> None:
    """To the terminal of the run, which may be gone."""
    with suppress(OSError, ValueError):
        print(sentence, file=sys.stderr, flush=True)


def _write(path: Path, happened: list[tuple[float, str, dict[str, Any]]]) -> None:
    """Written at the end: opening a journal of hours takes seconds, and a full disk may have ended the run."""
    try:
        with Journal(path) as journal:
            for time_s, name, data in happened:
                journal.event(time_s, name, **data)
        problem = journal.problem
    except Exception as error:
        problem = str(error)
    if problem:
        _say("\n".join([problem, *(f"{name}: {data}" for _, name, data in happened)]))


def _open_soon(rig: RigFile, clock: Clock) -> Bench:
    """Open a port of the killed run, which becomes free in a moment."""
    end = time.monotonic() + _TO_OPEN_S
    while True:
        try:
            return open_rig(rig, clock)
        except PortRefused:
            if time.monotonic() > end:
                raise
            time.sleep(0.1)


if __name__ == "__main__":
    watch(Path(sys.argv[1]), *map(float, sys.argv[2:]))
