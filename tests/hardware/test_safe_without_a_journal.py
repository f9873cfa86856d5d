"""Making safe needs no journal: one that cannot be written, or that hangs, keeps no stop off the wire."""

import os
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest
from hardware_bench import Rig

from gradcal_jax.hardware.clock import RealClock
from gradcal_jax.hardware.journal import Journal
from gradcal_jax.hardware.runner import Runner, RunProgress, RunResult
from gradcal_jax.hardware.setup import open_rig
from gradcal_jax.hardware.track import AxisCommand, Course, Track, TrackStep

SPIN = AxisCommand(0.0, "table", "spin", rate_dps=150.0, acceleration_dps2=300.0)
SPINS = Track((TrackStep("spin", 60.0, courses=(Course(0.0, 40.0),), moves=(SPIN,)),))


@contextmanager
def spinning(folder: Path) -> Iterator[tuple[Rig, Runner]]:
    """A run that records all of its lines."""
    clock = RealClock()
    with ExitStack() as stack:
        rig, journal = stack.enter_context(Rig(clock)), stack.enter_context(Journal(folder / "journal"))
        bench = stack.enter_context(open_rig(rig.rig, clock, lambda url: journal.recorder(f"port {url}")))
        yield rig, Runner(SPINS, bench, journal, clock, safe_deadline_s=10.0, chamber_every_s=0.5)


def run_with(rig: Rig, runner: Runner, harm: Any) -> tuple[RunResult, float]:
    """Run; once the table spins, do harm. The result, and how long (s) after that everything was safe."""
    began: list[float] = []
    safe: list[float] = []

    def look(progress: RunProgress) -> None:
        if not began and rig.axis.state(runner.clock.now())[1] > 149.0:
            began.append(time.monotonic())
            harm()

    def see() -> None:
        while not safe:
            time.sleep(0.02)
            if began and rig.axis.state(runner.clock.now())[1] == 0.0 and not rig.chamber.plant.conditioning:
                safe.append(time.monotonic())

    runner.on_progress = look
    watch = threading.Thread(target=see, daemon=True)
    watch.start()
    result = runner.run()
    watch.join(timeout=1.0)
    return result, (safe or [float("inf")])[0] - began[0]


def test_a_stick_that_is_pulled_ends_a_spin_safely(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pulled, write = threading.Event(), os.write
    with spinning(tmp_path) as (rig, runner):
        file = (tmp_path / "journal").stat()

        def gone(handle: int, data: bytes) -> int:
            if pulled.is_set() and os.path.samestat(os.fstat(handle), file):
                raise OSError(5, "Input/output error")
            return write(handle, data)

        monkeypatch.setattr(os, "write", gone)
        result, took_s = run_with(rig, runner, pulled.set)
        assert (result.exit_status, result.verified_safe) == ("aborted", True)
        assert "Input/output error" in result.reason
        assert took_s < 5.0


@pytest.mark.long
def test_a_disk_that_hangs_keeps_no_stop_off_the_wire(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hangs, awake, write = threading.Event(), threading.Event(), os.write
    with spinning(tmp_path) as (rig, runner):
        file = (tmp_path / "journal").stat()

        def stuck(handle: int, data: bytes) -> int:
            if hangs.is_set() and os.path.samestat(os.fstat(handle), file):
                awake.wait(60.0)
            return write(handle, data)

        def harm() -> None:
            hangs.set()
            runner.abort("SIGTERM")
            threading.Timer(8.0, awake.set).start()

        monkeypatch.setattr(os, "write", stuck)
        result, took_s = run_with(rig, runner, harm)
        assert (result.reason, result.verified_safe) == ("SIGTERM", True)
        assert took_s < 5.0
