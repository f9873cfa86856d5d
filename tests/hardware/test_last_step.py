"""What the last step's samples lack counts as much as in any other; a unit that sends no sample is no unit."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hardware_bench import Rig
from test_not_done import events, lab

from gradcal_jax.hardware.runner import Runner


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
