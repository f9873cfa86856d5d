"""Whole runs on the simulated lab (chamber, table, unit on three pseudo-terminals, virtual clock)."""

import dataclasses
import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from hardware_bench import EARTH_RATE_DPS, Rig, chunks_of, fit_clock, once, perfect
from simulated_devices.faults import Faults
from simulated_devices.line_clock import LineClock

from gradcal_jax.hardware.dry_run import dry_run_of
from gradcal_jax.hardware.execute import signals_to
from gradcal_jax.hardware.interlocks import InterlockLimits, InterlockRule, Interlocks, Situation
from gradcal_jax.hardware.journal import Event, Journal, JournalContents, read_journal
from gradcal_jax.hardware.roles import ChamberLimits, join
from gradcal_jax.hardware.runner import Runner, RunProgress, RunState
from gradcal_jax.hardware.setup import open_rig
from gradcal_jax.hardware.simulate.imu import ImuTruth
from gradcal_jax.hardware.track import AxisCommand, Course, Stable, Track, TrackStep

WAYS = {
    RunState.IDLE: frozenset({RunState.RUNNING, RunState.STOPPING, RunState.ABORTING}),
    RunState.RUNNING: frozenset({RunState.PAUSING, RunState.STOPPING, RunState.ABORTING}),
    RunState.PAUSING: frozenset({RunState.RUNNING, RunState.PAUSED, RunState.STOPPING, RunState.ABORTING}),
    RunState.PAUSED: frozenset({RunState.RUNNING, RunState.STOPPING, RunState.ABORTING}),
    RunState.STOPPING: frozenset({RunState.SAFE, RunState.FAILED}),
    RunState.ABORTING: frozenset({RunState.SAFE, RunState.FAILED}),
    RunState.SAFE: frozenset(),
    RunState.FAILED: frozenset(),
}
"""The states of a run, and those that may follow each."""


@pytest.fixture(autouse=True)
def only_these_ways(monkeypatch: pytest.MonkeyPatch):
    """Every change of state in these tests is one of the table."""
    enter, others = Runner._enter, []

    def checked(runner: Runner, state: RunState, **more) -> None:
        if state not in WAYS[runner.state]:
            others.append((runner.state, state))
        enter(runner, state, **more)

    monkeypatch.setattr(Runner, "_enter", checked)
    yield
    assert others == []


TURN = AxisCommand(2.0, "table", "turn", 360.0, rate_dps=120.0, acceleration_dps2=240.0)
BACK = AxisCommand(12.0, "table", "turn", -360.0, rate_dps=60.0, acceleration_dps2=240.0)
SPIN = AxisCommand(20.0, "table", "spin", rate_dps=-90.0, acceleration_dps2=180.0)
STOP = AxisCommand(26.0, "table", "stop")
TRACK = Track(
    (
        TrackStep("soak", 5.0, 25.0, Stable(0.3, 20.0, 3600.0)),
        TrackStep("ramp", 35.0, courses=(Course(0.0, 26.0, 1.0),), moves=(TURN, BACK, SPIN, STOP)),
    )
)


@contextmanager
def lab(folder: Path, truth: ImuTruth | None = None) -> Iterator[tuple[Rig, Runner]]:
    clock = LineClock()
    with Rig(clock, truth) as rig, open_rig(rig.rig, clock) as bench, Journal(folder / "journal") as journal:
        yield rig, Runner(TRACK, bench, journal, clock, safe_deadline_s=10.0)


def names(contents: JournalContents) -> list[str]:
    return [event.name for event in contents.events]


def states(contents: JournalContents) -> list[str]:
    return [event.data["state"] for event in contents.events if event.name == "state"]


def when_step_begins(runner: Runner, number: int, act) -> None:
    """Call `act` from within the run once a step has begun (on the progress call, which the run makes itself)."""
    once(runner, lambda now: now.steps_done == number and now.step_left_s is not None, act, runner.chamber_every_s)


def test_a_run_does_what_the_track_says_and_its_journal_tells_the_truth(tmp_path: Path) -> None:
    began = time.monotonic()
    with lab(tmp_path, perfect(clock_error=80e-6, scale_factor=1e-3)) as (rig, runner):
        shown: list[RunProgress] = []
        runner.on_progress = shown.append
        result = runner.run()
        assert (result.exit_status, result.reason, result.steps_done) == ("success", "", 2)
        assert result.verified_safe
        assert rig.chamber.mode == "STANDBY"
        assert rig.axis.state(runner.clock.now())[1] == 0.0
        assert shown[-1].step == "ramp"
        decoder = runner.bench.imus["unit1"].decoder()
    assert time.monotonic() - began < 60.0
    contents = read_journal(tmp_path / "journal")
    assert contents.damaged_bytes == 0
    assert states(contents) == ["running", "stopping", "safe"]
    assert contents.events[-1].data["exit_status"] == "success"
    by_name: dict[str, list[Event]] = {}
    for event in contents.events:
        by_name.setdefault(event.name, []).append(event)
    assert [event.data["device"] for event in by_name["identity"]] == ["table", "chamber", "unit1"]
    # The moves began when the track says, after the temperature had become stable.
    ramp = next(event for event in by_name["step begins"] if event.data["step"] == "ramp")
    # A step counts as done only when a burst that was being fetched as it ended is in the journal, too.
    assert [event.data["number"] for event in by_name["step done"]] == [0, 1]
    assert by_name["step done"][0].time_s >= by_name["step"][1].time_s + 0.1 + 0.2
    assert [event.time_s - ramp.time_s for event in by_name["move"]] == pytest.approx([2.0, 12.0, 20.0, 26.0], abs=0.6)
    assert by_name["stable"][0].data["waited_s"] > 15.0
    air = [event.data["air_c"] for event in by_name["chamber"]]
    assert 25.1 < max(air) < 26.0
    # What the unit measured between two standstills is the angle between the encoder's readings, but for its error.
    samples = join([decoder.push(chunk.data, chunk.time_s) for chunk in chunks_of(contents, "unit1")])
    assert np.all(samples.gap_before[1:] == 0)
    clock_map = fit_clock(samples.device_time_s, samples.host_time_s)
    assert clock_map.rate_error == pytest.approx(-80e-6, abs=3e-5)
    host = clock_map.host_time_s(samples.device_time_s)
    standing = [e for e in by_name["angle"] if not e.data["moving"]]
    start = [e for e in standing if e.time_s < ramp.time_s + 2.0][-1]
    end = next(e for e in standing if e.data["position_deg"] > 359.0)
    # The sample in which the axis comes to stand ends up to a period later.
    inside = (host > start.time_s) & (host <= end.time_s + 1.0 / 125.0)
    rate = samples.gyro_dps[inside, 2] - EARTH_RATE_DPS * np.sin(np.radians(45.0))
    turned = float(rate.sum()) / 125.0
    # 1000 ppm of scale factor on top of 360 degrees; the unit's own second is 80 ppm short.
    assert turned == pytest.approx(360.0 * (1.0 + 1e-3) * (1.0 + 80e-6), abs=0.005)


def test_a_track_beyond_the_devices_limits_does_not_start(tmp_path: Path) -> None:
    wrong = AxisCommand(1.0, "table", "spin", rate_dps=1000.0, acceleration_dps2=100.0)
    track = Track(
        (
            TrackStep("hot", 10.0, courses=(Course(0.0, 190.0),)),
            TrackStep("fast", 10.0, moves=(wrong, AxisCommand(2.0, "tilt", "stop"))),
        )
    )
    with lab(tmp_path) as (rig, runner):
        runner.track = track
        result = runner.run()
        assert result.exit_status == "aborted"
        for words in ("'hot' sets 190 degC", "turns at 1000 deg/s", "'tilt', but the rig has no such axis"):
            assert words in result.reason
        assert result.verified_safe
        assert rig.axis.state(0.0)[1] == 0.0
        assert rig.chamber.commands.count("MODE,CONSTANT") == 0
    assert "move" not in names(read_journal(tmp_path / "journal"))


def test_limits_of_travel_and_ramps_are_part_of_the_dry_run() -> None:
    from gradcal_jax.hardware.roles import AxisLimits

    axis = AxisLimits(100.0, 100.0, -180.0, 180.0, 0.001)
    chamber = ChamberLimits(-40.0, 85.0, 0.1, True, 0.1, 3.0)
    good = AxisCommand(0.0, "a", "turn", 170.0, 50.0, 50.0)
    track = Track((TrackStep("one", 5.0, courses=(Course(0.0, 20.0, 1.0),), moves=(good,)),))
    assert dry_run_of(track, chamber, {"a": axis}).problems == ()
    far = dataclasses.replace(good, angle_deg=200.0)
    spin = dataclasses.replace(good, kind="spin")
    steep = Track((TrackStep("one", 5.0, courses=(Course(0.0, 20.0, 5.0),), moves=(far, spin)),))
    found = " ".join(dry_run_of(steep, chamber, {"a": axis}).problems)
    assert "ramps at 5 K/min" in found
    assert "its travel is -180 to 180" in found
    assert "turns continuously, but its travel is limited" in found


@pytest.mark.parametrize(
    ("step", "words"),
    [
        (TrackStep("a", 1.0, moves=(AxisCommand(2.0, "x", "stop"),)), "within 1 s"),
        (TrackStep("a", -1.0), "in order of time"),
        (TrackStep("a", 1.0, stable=Stable(1.0, 1.0, 1.0)), "sets none"),
        (TrackStep("a", 1.0, courses=(Course(0.0, 1.0, -1.0),)), "above zero"),
    ],
)
def test_impossible_tracks_are_refused(step: TrackStep, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Track((step,))


@pytest.mark.evidence
def test_soft_pause_waits_for_the_end_of_the_step_and_goes_on(tmp_path: Path) -> None:
    with lab(tmp_path) as (_, runner):

        def pause() -> None:
            runner.request("soft pause")
            threading.Thread(target=resume_later, daemon=True).start()

        def resume_later() -> None:
            while runner.state is not RunState.PAUSED:
                runner.clock.sleep(1.0)
            runner.request("resume")

        when_step_begins(runner, 0, pause)
        result = runner.run()
        assert (result.exit_status, result.steps_done) == ("success", 2)
    contents = read_journal(tmp_path / "journal")
    assert names(contents).count("seam") == 1
    assert states(contents) == ["running", "pausing", "paused", "running", "stopping", "safe"]
    assert [e.data["step"] for e in contents.events if e.name == "step"] == ["soak", "ramp"]


def test_pause_now_stops_the_table_and_does_the_step_again(tmp_path: Path) -> None:
    with lab(tmp_path) as (rig, runner):
        rates: list[float] = []

        def pause() -> None:
            runner.request("pause")
            threading.Thread(target=resume_later, daemon=True).start()

        def resume_later() -> None:
            runner.clock.sleep(10.0)
            rates.append(rig.axis.state(runner.clock.now())[1])
            assert runner.state is RunState.PAUSED
            runner.request("resume")

        when_step_begins(runner, 1, pause)
        result = runner.run()
        assert (result.exit_status, result.steps_done) == ("success", 2)
        assert rates == [0.0]
    contents = read_journal(tmp_path / "journal")
    assert states(contents) == ["running", "pausing", "paused", "running", "stopping", "safe"]
    assert [e.data["step"] for e in contents.events if e.name == "step"] == ["soak", "ramp", "ramp"]
    assert names(contents).count("seam") == 1


@pytest.mark.parametrize("what", ["stop", "abort"])
def test_stop_and_abort_end_safe(tmp_path: Path, what) -> None:
    with lab(tmp_path) as (rig, runner):
        when_step_begins(runner, 1, lambda: runner.request(what, "the operator said so"))
        result = runner.run()
        assert result.exit_status == {"stop": "stopped", "abort": "aborted"}[what]
        assert result.reason == "the operator said so"
        assert result.verified_safe
        assert rig.axis.state(runner.clock.now())[1] == 0.0
        assert rig.chamber.mode == "STANDBY"
    assert read_journal(tmp_path / "journal").events[-1].data["verified_safe"] is True


@pytest.mark.evidence
def test_chamber_alarm_fault_and_pulled_cables_abort_and_the_rest_is_made_safe(tmp_path: Path) -> None:
    cases = {
        "alarm": (lambda rig: rig.chamber.raise_alarm(18), "chamber reports alarm 18"),
        "fault": (lambda rig: rig.table.hard_limit(), "Alarm"),
        "unit": (lambda rig: rig.ports[2].unplug(), "unit1: The port"),
        "chamber": (lambda rig: rig.ports[0].unplug(), "The chamber cannot be read"),
    }
    for name, (harm, words) in cases.items():
        folder = tmp_path / name
        folder.mkdir()
        with lab(folder) as (rig, runner):
            runner.safe_deadline_s = 3.0
            # Before the first turn: a motor that was powered and is stopped by its emergency stop cannot be held.
            runner.chamber_every_s = 0.5
            when_step_begins(runner, 1, lambda harm=harm, rig=rig: harm(rig))
            result = runner.run()
            assert result.exit_status == "aborted", name
            assert words in result.reason, name
            assert {o.name for o in result.outcomes if not o.verified} == ({"chamber"} if name == "chamber" else set())
            assert rig.axis.state(runner.clock.now())[1] == 0.0
        assert read_journal(folder / "journal").events[-1].name == "end"


@pytest.mark.evidence
def test_silent_unit_pauses_the_run_until_it_is_resumed(tmp_path: Path) -> None:
    with lab(tmp_path) as (rig, runner):

        def silence() -> None:
            rig.ports[2].faults = Faults(mute=True)
            threading.Thread(target=mend, daemon=True).start()

        def mend() -> None:
            while runner.state is not RunState.PAUSED:
                runner.clock.sleep(1.0)
            rig.ports[2].faults = None
            runner.clock.sleep(5.0)
            runner.request("resume")

        when_step_begins(runner, 1, silence)
        result = runner.run()
        assert (result.exit_status, result.steps_done) == ("success", 2)
    tripped = [e.data for e in read_journal(tmp_path / "journal").events if e.name == "interlock"]
    assert [t["rule"] for t in tripped] == ["stale unit"]
    assert "unit1" in tripped[0]["text"]


@pytest.mark.evidence
def test_temperature_that_never_settles_ends_the_run_with_a_sentence(tmp_path: Path) -> None:
    with lab(tmp_path) as (_, runner):
        runner.track = Track((TrackStep("soak", 10.0, 120.0, Stable(0.2, 60.0, 300.0)),))
        result = runner.run()
        assert result.exit_status == "aborted"
        assert "not stable within 0.2 K of 120 degC after 300 s" in result.reason
        assert result.verified_safe


def test_full_disk_pauses_before_it_is_full(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with lab(tmp_path) as (_, runner):
        runner.interlocks = Interlocks(InterlockLimits(free_bytes=1 << 60))
        runner.wait_when_paused = False
        result = runner.run()
        assert result.exit_status == "aborted"
        assert "MB are free" in result.reason


@pytest.mark.evidence
def test_signals_pause_first_and_abort_second(tmp_path: Path) -> None:
    with lab(tmp_path) as (_, runner), signals_to(runner):

        def interrupt_twice() -> None:
            os.kill(os.getpid(), signal.SIGINT)
            os.kill(os.getpid(), signal.SIGINT)

        when_step_begins(runner, 0, interrupt_twice)
        result = runner.run()
        assert (result.exit_status, result.reason) == ("aborted", "Ctrl-C")
        assert result.verified_safe
    requests = [e.data["what"] for e in read_journal(tmp_path / "journal").events if e.name == "request"]
    assert requests == ["soft pause", "abort"]
    with lab(tmp_path) as (_, runner), signals_to(runner):
        when_step_begins(runner, 1, lambda: os.kill(os.getpid(), signal.SIGTERM))
        assert runner.run().reason == "SIGTERM"


def test_every_state_can_end_safe() -> None:
    for state in RunState:
        reachable = {state}
        for _ in RunState:
            reachable |= {after for before in reachable for after in WAYS[before]}
        assert RunState.SAFE in reachable or state in (RunState.SAFE, RunState.FAILED)


# --- what a pause, an end and a step that follows must do -------------------------------------------------------------


def once_paused(runner: Runner, act) -> None:
    """Call `act` from another thread when the run has been paused for a second."""

    def wait() -> None:
        while runner.state is not RunState.PAUSED:
            runner.clock.sleep(0.5)
        runner.clock.sleep(1.0)
        act()

    threading.Thread(target=wait, daemon=True).start()


def test_a_step_that_follows_tells_the_chamber_its_course(tmp_path: Path) -> None:
    with lab(tmp_path) as (rig, runner):
        warm = TrackStep("warmer", 5.0, courses=(Course(0.0, 30.0),))
        runner.track = Track((TrackStep("soak", 5.0, 25.0, Stable(0.5, 5.0, 3600.0)), warm))
        assert runner.run().exit_status == "success"
        assert rig.chamber.constant_c == 30.0
    told = [e for e in read_journal(tmp_path / "journal").events if e.name == "chamber told"]
    begins = [e for e in read_journal(tmp_path / "journal").events if e.name == "step begins"]
    assert [e.data["hold_c"] for e in told] == [25.0, 30.0]
    assert told[1].time_s - begins[1].data["begins_s"] < 10.0


def test_an_axis_that_a_run_does_not_move_may_keep_its_alarm_and_get_no_new_one(tmp_path: Path) -> None:
    for begins, ends in (("Alarm", "success"), ("Idle", "aborted")):
        (folder := tmp_path / begins).mkdir()
        with lab(folder) as (rig, runner):
            runner.track = Track((TrackStep("stand", 60.0),))
            rig.table._state = begins
            once(runner, lambda now: now.step_left_s is not None, lambda rig=rig: setattr(rig.table, "_state", "Alarm"))
            result = runner.run()
        assert result.exit_status == ends, result.reason
        assert ("Interlock 'axis fault': axis table: Alarm" in result.reason) == (ends == "aborted")
        assert "$H" not in rig.table.lines


def test_nothing_turns_while_a_run_is_paused_between_two_rates(tmp_path: Path) -> None:
    with lab(tmp_path) as (rig, runner):
        rates: list[float] = []

        def resume() -> None:
            rates.append(rig.axis.state(runner.clock.now())[1])
            runner.request("resume")

        there, back = (
            (AxisCommand(0.0, "table", "spin", rate_dps=rate, acceleration_dps2=180.0),) for rate in (90.0, -90.0)
        )
        runner.track = Track((TrackStep("rate 1", 8.0, moves=there), TrackStep("rate 2", 8.0, moves=back)))
        when_step_begins(runner, 0, lambda: runner.request("soft pause"))
        once_paused(runner, resume)
        assert runner.run().exit_status == "success"
        assert rates == [0.0]
    assert names(read_journal(tmp_path / "journal")).count("seam") == 1


def test_an_interlock_pauses_a_run_that_was_to_pause_anyway(tmp_path: Path) -> None:
    with lab(tmp_path) as (_, runner):
        runner.track = Track((TrackStep("stand", 20.0),))
        begun: list[float] = []

        def wrong(bounds: InterlockLimits, now: Situation) -> str:
            return "something is amiss" if begun and begun[0] < now.time_s < begun[0] + 5.0 else ""

        def pause() -> None:
            begun.append(runner.clock.now())
            runner.request("soft pause")

        runner.interlocks = Interlocks(rules=(InterlockRule("amiss", "pause", 2.0, wrong),))
        when_step_begins(runner, 0, pause)
        once_paused(runner, lambda: runner.request("resume"))
        assert runner.run().exit_status == "success"
    events = [e.data["rule"] for e in read_journal(tmp_path / "journal").events if e.name == "interlock"]
    assert events == ["amiss"]


def test_an_alarm_ends_a_paused_run(tmp_path: Path) -> None:
    with lab(tmp_path) as (rig, runner):
        when_step_begins(runner, 1, lambda: runner.request("pause"))
        once_paused(runner, lambda: rig.chamber.raise_alarm(18))
        result = runner.run()
        assert result.exit_status == "aborted"
        assert "alarm 18" in result.reason


def test_a_pause_asked_for_while_the_references_are_found_comes_before_the_first_step(tmp_path: Path) -> None:
    with lab(tmp_path) as (_, runner):
        runner.track = Track((TrackStep("stand", 2.0, moves=(AxisCommand(0.0, "table", "turn", 0.0, 60.0, 60.0),)),))
        runner.request("soft pause")
        runner.request("pause")
        once_paused(runner, lambda: runner.request("resume"))
        assert runner.run().exit_status == "success"
    events = read_journal(tmp_path / "journal").events
    first = next(e for e in events if e.name == "step begins")
    assert any(e.name == "state" and e.data["state"] == "paused" and e.time_s < first.time_s for e in events)


def test_a_chamber_that_was_made_safe_is_told_nothing_more(tmp_path: Path) -> None:
    """The end comes while the chamber is being told its ramp, which takes it seconds."""
    for seconds in (0.1, 0.2, 0.3):
        folder = tmp_path / f"{seconds:g}"
        folder.mkdir()
        with lab(folder) as (rig, runner):
            ramp = Course(10.0, 40.0, 1.0)
            runner.track = Track((TrackStep("ramp", 60.0, courses=(Course(0.0, 25.0), ramp)),))
            runner.chamber_every_s = 0.1

            def look(progress: RunProgress, runner=runner, seconds=seconds) -> None:
                if progress.step_left_s is not None and progress.step_left_s <= 50.0 - seconds:
                    runner.request("abort")

            runner.on_progress = look
            result = runner.run()
            assert result.verified_safe
            runner.clock.sleep(30.0)
            assert rig.chamber.mode == "STANDBY"
            assert "RUN PRGM" not in rig.chamber.commands[-1]
