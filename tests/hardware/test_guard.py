"""The guard acts when the run could not end by itself, before it writes anything, and in no other case."""

import errno
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from hardware_bench import Rig, short_recipe

from gradcal_jax.files.writing import write_toml
from gradcal_jax.hardware import guard, runner
from gradcal_jax.hardware.clock import RealClock
from gradcal_jax.hardware.errors import PortRefused
from gradcal_jax.hardware.journal import Event, Journal, read_journal
from gradcal_jax.hardware.run_folder import RunFolder, new_folder
from gradcal_jax.hardware.runner import Progress, RunResult
from gradcal_jax.hardware.safety import SafeOutcome
from gradcal_jax.hardware.session import run_session
from gradcal_jax.hardware.setup import open_rig
from gradcal_jax.hardware.simulate.lab import SimulatedLab

SPEED = 20.0


def left_turning(rig: Rig, folder: Path, clock: RealClock) -> None:
    """A rig as a killed run leaves it, and the run's folder."""
    write_toml(rig.rig, folder / "rig.toml")
    Journal(folder / "journal").close()
    with open_rig(rig.rig, clock) as bench:
        assert bench.chamber is not None
        bench.chamber.hold(40.0)
        bench.axes["table"].spin(60.0, 300.0)


def by_guard(path: Path) -> list[Event]:
    events = read_journal(path).events
    return [event for event in events if event.name == "guard" or event.data.get("by") == "guard"]


# ------------------------------------------------------------------------------------------------- safe, then written


def test_the_rig_is_safe_before_the_journal_is_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = RealClock()
    found: list[tuple[str, float]] = []
    with Rig(clock) as rig:
        left_turning(rig, tmp_path, clock)

        def opened(path: Path) -> Journal:
            found.append((rig.chamber.mode, rig.table.axes[0].plant.state(clock.now())[1]))
            return Journal(path)

        monkeypatch.setattr(guard, "Journal", opened)
        outcomes = guard.make_folder_safe(tmp_path, deadline_s=10.0)
    assert found == [("STANDBY", 0.0)]
    assert all(outcome.verified for outcome in outcomes)
    events = by_guard(tmp_path / "journal")
    assert [event.data.get("device") for event in events] == [None, "table", "chamber", "unit1"]
    # It took time to make all of it safe, and that is when it was.
    assert events[0].time_s < events[1].time_s


def test_a_full_disk_keeps_no_device_from_being_made_safe(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    clock, write = RealClock(), os.write
    with Rig(clock) as rig:
        left_turning(rig, tmp_path, clock)
        file = (tmp_path / "journal").stat()

        def full(handle: int, data: bytes) -> int:
            if os.path.samestat(os.fstat(handle), file):
                raise OSError(errno.ENOSPC, "No space left on device")
            return write(handle, data)

        monkeypatch.setattr(os, "write", full)
        outcomes = guard.make_folder_safe(tmp_path, deadline_s=10.0)
        assert rig.chamber.mode == "STANDBY"
        assert rig.table.axes[0].plant.state(clock.now())[1] == 0.0
    assert [(outcome.name, outcome.verified) for outcome in outcomes] == [
        ("table", True), ("chamber", True), ("unit1", True)
    ]  # fmt: skip
    said = capsys.readouterr().err
    assert "the disk is full" in said
    assert "made safe: {'by': 'guard', 'device': 'table'" in said


def test_a_port_that_is_gone_keeps_no_other_device_from_being_made_safe(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(guard, "_TO_OPEN_S", 0.3)
    clock = RealClock()
    with Rig(clock) as rig:
        left_turning(rig, tmp_path, clock)
        rig.ports[2].unplug()
        outcomes = {outcome.name: outcome for outcome in guard.make_folder_safe(tmp_path, deadline_s=10.0)}
        assert rig.chamber.mode == "STANDBY"
        assert rig.table.axes[0].plant.state(clock.now())[1] == 0.0
    assert {name: outcome.verified for name, outcome in outcomes.items()} == {
        "table": True, "chamber": True, "unit1": False
    }  # fmt: skip
    assert "cannot be opened" in outcomes["unit1"].evidence
    devices = [event.data.get("device") for event in by_guard(tmp_path / "journal")]
    assert devices == [None, "unit1", "table", "chamber"]


# ------------------------------------------------------------------------------------------------------- when it acts


@pytest.mark.parametrize(
    ("said", "acts"),
    [(b"", False), (b"begun\n", True), (b"begun\ndone\n", False), (b"begun\ndo", True)],
)
def test_it_acts_on_a_run_that_had_begun_and_was_not_done(said: bytes, acts: bool, tmp_path: Path) -> None:
    # A folder without a rig: whoever wants to open it stumbles.
    words = [sys.executable, "-m", "gradcal_jax.hardware.guard", str(tmp_path)]
    done = subprocess.run(words, input=said, capture_output=True)
    assert (done.returncode != 0) == acts
    assert (b"rig.toml" in done.stderr) == acts


def run_of(lab: SimulatedLab, folder: RunFolder, clock: RealClock, **more: Any) -> RunResult:
    return run_session(folder, lab.rig, clock, guard=True, wait_when_paused=False, **more)


@pytest.mark.parametrize("how", ["broken off", "not verified"])
def test_what_the_run_leaves_unsafe_is_made_safe(how: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C, and once more while everything is made safe; or a device that did not confirm."""

    def interrupt(progress: Progress) -> None:
        if lab.chamber.mode != "STANDBY":
            raise KeyboardInterrupt

    def hindered(*_: object, **__: object) -> list[SafeOutcome]:
        if how == "broken off":
            raise KeyboardInterrupt
        return [SafeOutcome("chamber", "standby", False, "has not answered yet", 1, 60.0)]

    monkeypatch.setattr(runner, "make_safe", hindered)
    clock, made = RealClock(speed=SPEED), short_recipe(1.0)
    with SimulatedLab(made.spec, clock) as lab:
        folder = new_folder(tmp_path / "run", made, lab.rig, simulated={})
        if how == "broken off":
            with pytest.raises(KeyboardInterrupt):
                run_of(lab, folder, clock, on_progress=interrupt)
        else:
            assert not run_of(lab, folder, clock, on_progress=interrupt).verified_safe
        assert lab.chamber.mode != "STANDBY"
        end = time.monotonic() + 60.0
        while time.monotonic() < end and len(by_guard(folder.journal_path)) < 4:
            time.sleep(0.1)
        assert lab.chamber.mode == "STANDBY"
    assert [event.data.get("verified") for event in by_guard(folder.journal_path)] == [None, True, True, True]


def test_a_run_that_ends_safe_or_does_not_begin_leaves_nothing_to_the_guard(tmp_path: Path) -> None:
    clock, made = RealClock(speed=SPEED), short_recipe(1.0)
    with SimulatedLab(made.spec, clock) as lab:
        folder = new_folder(tmp_path / "run", made, lab.rig, simulated={})
        result = run_of(lab, folder, clock, with_runner=lambda runner: runner.request("abort", "now"))
        assert result.verified_safe
        refused = new_folder(tmp_path / "refused", made, lab.rig, simulated={})
        with open_rig(lab.rig, clock), pytest.raises(PortRefused, match="in use"):
            run_of(lab, refused, clock)
        # Both guards are gone: nobody holds the ports.
        open_rig(lab.rig, clock).close()
    assert by_guard(folder.journal_path) == []
    assert by_guard(refused.journal_path) == []
