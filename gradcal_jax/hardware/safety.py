"""Making a rig safe: every device in its own thread, with its own deadline, retried, verified by read-back.

A device that hangs delays no other. The rig file defines the safe state; the outcome is the command and the device's
read-back, also on failure.
"""

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace

from .clock import Clock
from .errors import Disconnected, sentence_of
from .roles import AxisSafe, ChamberSafe, SafeReport
from .setup import LEFT, Bench
from .transport import Transport

_RETRY_PAUSE_S = 0.2
_GOES_ON = "an earlier command to it goes on"


@dataclass
class SafeOutcome:
    """The outcome of one device. `evidence` is the read-back, or the last problem; `took_s` real seconds.

    Its thread fills it; the waiting thread takes a copy, with the state so far of a thread that hangs.
    """

    name: str
    action: str
    verified: bool = False
    evidence: str = "has not answered yet"
    tries: int = 0
    took_s: float = 0.0


def make_safe(
    bench: Bench, clock: Clock, *, deadline_s: float = 60.0, busy: Callable[[str], bool] = lambda name: False
) -> list[SafeOutcome]:
    """Bring every device of the bench to the safe state of the rig file.

    `busy` is called in a device's thread, with its name: whether an earlier command to it goes on, for whose end it may
    wait. Such a device is made safe at once, and again: the command could undo it.

    Returns after all devices are verified, or after `deadline_s` real seconds: the others then have a reason. Raises no
    error of a device.
    """
    attempts: list[tuple[SafeOutcome, float, threading.Thread]] = []

    def begin(name: str, action: str, act: Callable[[], SafeReport]) -> None:
        attempt, began_s = SafeOutcome(name, action), time.monotonic()

        def alone() -> SafeReport:
            goes_on, report = busy(name), act()
            return replace(report, verified=False, evidence=f"{report.evidence}; {_GOES_ON}") if goes_on else report

        arguments = (attempt, alone, bench.lines.get(name), clock, began_s, deadline_s)
        thread = threading.Thread(target=_try, args=arguments, daemon=True, name=f"making {name} safe")
        attempts.append((attempt, began_s, thread))
        thread.start()

    for entry in bench.rig.axis:
        axis, wanted = bench.axes[entry.name], AxisSafe(entry.safe)
        begin(entry.name, entry.safe, lambda axis=axis, wanted=wanted: axis.safe(wanted))
    if bench.chamber is not None and bench.rig.chamber is not None:
        chamber, how = bench.chamber, bench.rig.chamber

        begin("chamber", how.safe, lambda: chamber.safe(ChamberSafe(how.safe), float(how.ambient)))
    with clock.aside():
        for _, began_s, thread in attempts:
            thread.join(max(0.0, began_s + deadline_s - time.monotonic()))
    now_s = time.monotonic()
    outcomes = [replace(attempt, took_s=attempt.took_s or now_s - began_s) for attempt, began_s, _ in attempts]
    streams = [SafeOutcome(entry.name, LEFT, True, "it cannot be unsafe") for entry in bench.rig.imu]
    return outcomes + streams


def put_back(bench: Bench) -> dict[str, str]:
    """Restore the settings that drivers have changed; by device with changed settings the problem, or an empty text."""
    problems: dict[str, str] = {}
    for name, settings in bench.settings.items():
        if settings.before:
            try:
                settings.put_back()
                problems[name] = ""
            except Exception as problem:
                problems[name] = sentence_of(problem)
    return problems


def _try(
    attempt: SafeOutcome,
    act: Callable[[], SafeReport],
    line: Transport | None,
    clock: Clock,
    began_s: float,
    deadline_s: float,
) -> None:
    with clock.party():
        while True:
            attempt.tries += 1
            try:
                report = act()
                attempt.evidence = report.evidence
                attempt.verified = report.verified
            except BaseException as problem:
                # No error of a driver, of whatever kind, prevents the next try.
                attempt.evidence = sentence_of(problem)
                if isinstance(problem, Disconnected) and line is not None:
                    # Its cable may be in again.
                    with suppress(Exception):
                        line.reopen()
            if attempt.verified or time.monotonic() >= began_s + deadline_s:
                attempt.took_s = time.monotonic() - began_s
                return
            with clock.aside():
                time.sleep(_RETRY_PAUSE_S)
