"""What the last step's samples lack counts as much as in any other; a unit that sends no sample is no unit."""

import errno
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hardware_bench import Rig
from test_not_done import events, lab

from gradcal_jax.hardware import journal, supervision
from gradcal_jax.hardware.journal import Event, Journal
from gradcal_jax.hardware.runner import Runner
from gradcal_jax.hardware.supervision import RunResult, StatusFile, read_status
from gradcal_jax.hardware.track import AxisCommand
from gradcal_jax.records.sessions import sessions_of


def in_last_step(rig: Rig, runner: Runner, act: Callable[[], Any], *, every_time: bool = False) -> None:
    """Act while the table turns in the last step, in its first attempt alone or in each."""
    runner.chamber_every_s = 1.0
    acted: list[int] = []

    def look(progress: Any) -> None:
        last = progress.step_left_s is not None and progress.steps_done == progress.steps - 1
        turns = abs(rig.axis.state(runner.clock.now())[1]) > 10.0
        if last and turns and (every_time or not acted):
            acted.append(1)
            act()

    runner.on_progress = look


def freezes(rig: Rig) -> None:
    """The unit repeats the rates and forces of one sample."""
    take, held = rig.sensor.take, []

    def one(count: int) -> Any:
        samples = take(count)
        held[:] = held or [samples.rate_dps[0].copy()]
        samples.rate_dps[:] = held[0]
        return samples

    rig.sensor.take = one


def lose(rig: Rig) -> None:
    rig.ports[2].faults = lambda message: []


def spoil(rig: Rig) -> None:
    """A byte before the end of each datagram is wrong: bytes, and no usable sample."""
    rig.ports[2].faults = lambda message: [message[:-3] + bytes([message[-3] ^ 1]) + message[-2:]]


@pytest.mark.parametrize("fault", [lose, spoil])
def test_a_unit_without_samples_in_the_last_step_ends_the_run(tmp_path: Path, fault: Callable[[Rig], None]) -> None:
    with lab(tmp_path) as (rig, runner):
        in_last_step(rig, runner, lambda: fault(rig))
        result = runner.run()
    assert result.exit_status == "aborted"
    assert "no sample from unit1" in result.reason
    assert result.verified_safe


def test_a_unit_that_freezes_in_the_last_step_makes_it_again(tmp_path: Path) -> None:
    with lab(tmp_path) as (rig, runner):
        in_last_step(rig, runner, lambda: freezes(rig), every_time=True)
        result = runner.run()
        last = len(runner.track.steps) - 1
    assert result.exit_status == "aborted"
    assert "In 3 attempts" in result.reason
    assert "gyros measured" in result.reason
    assert [event.data["number"] for event in events(tmp_path, "not done")] == [last] * 3
    assert last not in [event.data["number"] for event in events(tmp_path, "step done")]


def test_samples_lost_in_the_last_step_make_it_again(tmp_path: Path) -> None:
    def lossy() -> None:
        times = [200]

        def drop(message: bytes) -> list[bytes]:
            times[0] -= 1
            return [] if times[0] > 0 else [message]

        rig.ports[2].faults = drop

    with lab(tmp_path) as (rig, runner):
        in_last_step(rig, runner, lossy)
        result = runner.run()
        last = len(runner.track.steps) - 1
    assert result.exit_status == "success", result.reason
    (amiss,) = events(tmp_path, "not done")
    assert amiss.data["number"] == last
    assert "samples" in amiss.data["why"]
    assert events(tmp_path, "step done")[-1].data["number"] == last


@pytest.mark.parametrize("call", ["write", "fsync"])
def test_a_disk_that_hangs_is_noticed_without_a_further_event(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: str
) -> None:
    hangs, real = threading.Event(), getattr(os, call)

    def stuck(*args: Any) -> Any:
        hangs.wait(20.0)
        return real(*args)

    monkeypatch.setattr(journal, "_LONGEST_WAIT_S", 0.3)
    with Journal(tmp_path / "journal") as written:
        written.event(0.0, "before")
        monkeypatch.setattr(os, call, stuck)
        written.bytes_of("unit1", 1.0, b"a", received=True)
        end = time.monotonic() + 5.0
        while not written.problem and time.monotonic() < end:
            time.sleep(0.05)
        hangs.set()
        assert "the disk has not answered" in written.problem


def test_a_full_disk_leaves_the_status_of_the_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The journal's problem ended the run: the status file is written over, which needs no space."""
    supervision.end_status(tmp_path, "x", [])
    with StatusFile(tmp_path, simulated=False) as status:
        status._status = {"state": "running", "step": "a step with a longer name than the end has" * 9}
        time.sleep(0.5)
        assert read_status(tmp_path)["state"] == "running"

        def full(*_: Any) -> None:
            raise OSError(errno.ENOSPC, "No space left on device")

        monkeypatch.setattr(supervision, "write_whole", full)
        status._status = {}
        status.end(RunResult("aborted", "the disk is full", (), 1))
    assert (read_status(tmp_path)["state"], read_status(tmp_path)["reason"]) == ("safe", "the disk is full")


def test_attempts_that_the_run_refused_are_no_data() -> None:
    """The step 1 is refused while step 2 is under way, twice; the second time the run ends with that."""

    def event(time_s: float, name: str, **data: Any) -> Event:
        return Event(time_s, name, data)

    def step(number: int, time_s: float) -> list[Event]:
        begins = event(time_s, "step begins", number=number, begins_s=time_s, data=True)
        return [event(time_s, "step", number=number), begins]

    begins = event(0.0, "session", number=0, simulated=False, wall_clock_s=0.0)
    attempt = [*step(1, 20.0), *step(2, 30.0), event(30.4, "not done", number=1, why="lost")]
    again = [*step(1, 40.0), *step(2, 50.0), event(50.4, "not done", number=1, why="lost")]
    done = [*step(1, 40.0), *step(2, 50.0), event(60.0, "ending")]
    first = [begins, *step(0, 10.0)]
    (refused,) = sessions_of([*first, *attempt, *again, event(51.0, "ending")])
    assert refused.stretches() == [(10.0, 20.0)]
    assert refused.refused() == 2
    (repeated,) = sessions_of([*first, *attempt, *done])
    assert repeated.stretches() == [(10.0, 20.0), (40.0, 60.0)]


@pytest.mark.parametrize("angle_deg", [3600.0, -10.0, 90.0])
def test_where_a_turn_is_planned_to_be_at_an_instant(angle_deg: float) -> None:
    """The integral of the trapezoid of its rate."""
    turn = AxisCommand(0.0, "table", "turn", rate_dps=150.0, acceleration_dps2=300.0, angle_deg=angle_deg)
    count = 100_000
    step_s = turn.duration_s / count
    ends_s = (np.arange(count) + 0.5) * step_s
    rates = np.minimum(np.minimum(300.0 * ends_s, 150.0), 300.0 * (turn.duration_s - ends_s))
    for share in (0.1, 0.4, 0.9, 1.0):
        integral_deg = float(np.sum(rates[: round(share * count)])) * step_s * np.sign(angle_deg)
        assert turn.turned_deg(share * turn.duration_s) == pytest.approx(integral_deg, abs=1e-4 * abs(angle_deg))
