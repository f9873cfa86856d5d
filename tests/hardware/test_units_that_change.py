"""A unit that restarts with other settings, stops measuring or loses lines that it does not count: nothing is done."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hardware_bench import Rig, once, short_recipe
from simulated_devices.line_clock import LineClock

from gradcal_jax.hardware.drivers.listening import TextUnitConfig
from gradcal_jax.hardware.interlocks import ExecutedStep, SampleLosses
from gradcal_jax.hardware.journal import Event, Journal, read_journal
from gradcal_jax.hardware.runner import Runner, RunProgress
from gradcal_jax.hardware.setup import open_rig
from gradcal_jax.hardware.track import track_of


@contextmanager
def lab(folder: Path) -> Iterator[tuple[Rig, Runner]]:
    clock = LineClock()
    with Rig(clock) as rig, Journal(folder / "journal") as journal:
        track = track_of(short_recipe(2.0), ["table"])
        with open_rig(rig.rig, clock) as bench:
            yield rig, Runner(track, bench, journal, clock, safe_deadline_s=10.0, wait_when_paused=False)


def in_second_step_with_data(progress: RunProgress) -> bool:
    return progress.steps_done == 2 and progress.step_left_s is not None


def events(folder: Path, name: str) -> list[Event]:
    return [event for event in read_journal(folder / "journal").events if event.name == name]


def test_a_unit_that_restarts_is_configured_again(tmp_path: Path) -> None:
    with lab(tmp_path) as (rig, runner):

        def restart() -> None:
            rig.imu.reboot()

        once(runner, in_second_step_with_data, restart)
        result = runner.run()
        assert result.exit_status == "success", result.reason
    assert len(events(tmp_path, "configuration")) == 2
    (amiss, *_) = events(tmp_path, "not done")
    assert "unit1" in amiss.data["why"]
    last = [event for event in events(tmp_path, "step done") if event.data["number"] == amiss.data["number"]]
    assert last


def test_a_unit_that_stops_measuring_ends_the_run(tmp_path: Path) -> None:
    """Datagrams and counter go on, the values stay: a sensor that hangs behind its interface."""
    with lab(tmp_path) as (rig, runner):

        def freeze() -> None:
            take = rig.sensor.take

            def stuck(count: int) -> Any:
                samples = take(count)
                samples.rate_dps[:] = (0.01, -0.02, 0.03)
                return samples

            rig.sensor.take = stuck

        once(runner, in_second_step_with_data, freeze)
        result = runner.run()
        assert result.exit_status == "aborted"
        assert "the IMU's gyros measured" in result.reason
        assert "but the table turned 720" in result.reason
        assert result.verified_safe


@pytest.mark.parametrize("share", [0.0, 0.1])
def test_lost_lines_of_a_unit_that_does_not_count_are_noticed_by_their_rate(share: float) -> None:
    described = {"format": "gradcal-text/1", "line": "{gyro_x} {gyro_y} {gyro_z}", "rate": "50 Hz"}
    losses, random = (
        SampleLosses(TextUnitConfig(protocol=described).decoder(), 50.0, None, 0.0),
        np.random.default_rng(1),
    )
    line = b"0.001 0.002 0.003\r\n"
    for k in range(50 * 40):
        if random.random() >= share:
            losses.push(line, k / 50.0)
    said = losses.between(ExecutedStep(0, 1.0, 40.0), 0.02, 1.0, None)
    assert bool(said) is (share > 0.0)
    assert share == 0.0 or "45." in said
    assert share == 0.0 or "samples/s, but its setting is 50" in said
