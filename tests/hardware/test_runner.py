"""Whole runs of a track on the simulated rig, in virtual time: states, limits, ends."""

import dataclasses
import os
import signal
import socket
import threading

import numpy as np
import pytest
from hardware_bench import (
    EARTH_RATE_DPS,
    Rig,
    acting,
    chamber_alone,
    chunks_of,
    ends_aborted,
    events,
    gradcal_run,
    in_step,
    perfect,
    running,
    short_track,
    struck,
)
from simulated_devices.faults import Faults

from gradcal_jax.hardware.clock import RealClock
from gradcal_jax.hardware.dry_run import dry_run_of
from gradcal_jax.hardware.errors import Disconnected
from gradcal_jax.hardware.execute import signals_to
from gradcal_jax.hardware.guard import make_safe
from gradcal_jax.hardware.journal import read_journal
from gradcal_jax.hardware.roles import AxisLimits, ChamberLimits, join
from gradcal_jax.hardware.run_folder import identities_of
from gradcal_jax.hardware.setup import check_each, open_rig
from gradcal_jax.hardware.track import AxisCommand, Course, Stable, Track, TrackStep
from gradcal_jax.records.clockmap import fit_arrivals, last_of_chunks

TURN = AxisCommand(2.0, "table", "turn", 360.0, rate_dps=120.0, acceleration_dps2=240.0)
BACK = AxisCommand(12.0, "table", "turn", -360.0, rate_dps=60.0, acceleration_dps2=240.0)
SPIN = AxisCommand(20.0, "table", "spin", rate_dps=-90.0, acceleration_dps2=180.0)
SOAK = TrackStep("soak", 5.0, 25.0, Stable(0.3, 20.0, 3600.0))
MOVES = (TURN, BACK, SPIN, AxisCommand(26.0, "table", "stop"))
TRACK = Track((SOAK, TrackStep("ramp", 35.0, courses=(Course(0.0, 26.0, 1.0),), moves=MOVES)))


def states(folder):
    return [event.data["state"] for event in events(folder, "state")]


def test_a_run_does_what_the_track_says_and_its_journal_tells_the_truth(tmp_path):
    with running(tmp_path, TRACK, perfect(clock_error=80e-6, scale_factor=1e-3)) as (rig, runner):
        shown = []
        runner.on_progress = shown.append
        result = runner.run()
        assert (result.exit_status, result.reason, result.steps_done) == ("success", "", 2)
        assert result.verified_safe
        assert rig.chamber.mode == "STANDBY"
        assert rig.rate_dps() == 0.0
        assert shown[-1].step == "ramp"
        decoder = runner.bench.imus["imu1"].decoder()
    contents = read_journal(tmp_path / "journal")
    assert contents.damaged_bytes == 0
    assert states(tmp_path) == ["running", "stopping", "safe"]
    assert contents.events[-1].data["exit_status"] == "success"
    assert [event.data["device"] for event in events(tmp_path, "identity")] == ["table", "chamber", "imu1"]
    # The moves began when the track says, after the temperature had become stable.
    _, ramp = events(tmp_path, "step begins")
    moves = [event.time_s - ramp.time_s for event in events(tmp_path, "move")]
    assert moves == pytest.approx([2.0, 12.0, 20.0, 26.0], abs=0.6)
    assert events(tmp_path, "stable")[0].data["waited_s"] > 15.0
    assert 25.1 < max(event.data["air_c"] for event in events(tmp_path, "chamber")) < 26.0
    # A step counts as done only when a burst that was being fetched as it ended is in the journal, too.
    done = events(tmp_path, "step done")
    assert [event.data["number"] for event in done] == [0, 1]
    assert done[0].time_s >= events(tmp_path, "step")[1].time_s + 0.1 + 0.2
    # What the unit measured between two standstills is the angle between the encoder's readings, but for its error.
    samples = join([decoder.push(chunk.data, chunk.time_s) for chunk in chunks_of(contents, "imu1")])
    assert np.all(samples.gap_before[1:] == 0)
    clock = fit_arrivals(*last_of_chunks(samples.device_time_s, samples.host_time_s))
    assert clock.rate - 1.0 == pytest.approx(-80e-6, abs=3e-5)
    host = clock.offset_s + clock.rate * samples.device_time_s
    standing = [event for event in events(tmp_path, "angle") if not event.data["moving"]]
    start = [event for event in standing if event.time_s < ramp.time_s + 2.0][-1]
    end = next(event for event in standing if event.data["position_deg"] > 359.0)
    # The sample in which the axis comes to stand ends up to a period later.
    inside = (host > start.time_s) & (host <= end.time_s + 1.0 / 125.0)
    rate = samples.gyro_dps[inside, 2] - EARTH_RATE_DPS * np.sin(np.radians(45.0))
    # 1000 ppm of scale factor on top of 360 degrees; the unit's own second is 80 ppm short.
    assert float(rate.sum()) / 125.0 == pytest.approx(360.0 * (1.0 + 1e-3) * (1.0 + 80e-6), abs=0.005)


# ------------------------------------------------------------------------------------------------- what does not begin


def test_a_track_beyond_the_devices_limits_does_not_start(tmp_path):
    wrong = AxisCommand(1.0, "table", "spin", rate_dps=1000.0, acceleration_dps2=100.0)
    fast = TrackStep("fast", 10.0, moves=(wrong,))
    with running(tmp_path, Track((TrackStep("hot", 10.0, courses=(Course(0.0, 190.0),)), fast))) as (rig, runner):
        ends_aborted(runner, "'hot' sets 190 degC", "turns at 1000 deg/s")
        assert rig.rate_dps() == 0.0
        assert rig.chamber.commands.count("MODE,CONSTANT") == 0
    assert events(tmp_path, "move") == []


def test_a_device_that_keeps_a_run_from_beginning_is_not_that_with_which_it_began(tmp_path):
    """The right one, when it is connected, resumes the run: what a journal names first is compared with."""
    with running(tmp_path, short_track()) as (rig, runner):
        object.__setattr__(rig.rig.axis[0], "serial_number", "SN 1")
        assert "the rig file states SN 1" in runner.run().reason
    assert "table" not in identities_of(read_journal(tmp_path / "journal"))


def test_limits_of_travel_and_ramps_are_part_of_the_dry_run():
    axis = AxisLimits(100.0, 100.0, -180.0, 180.0, 0.001)
    chamber = ChamberLimits(-40.0, 85.0, True, 0.1, 3.0)
    good = AxisCommand(0.0, "a", "turn", 170.0, 50.0, 50.0)
    track = Track((TrackStep("one", 5.0, courses=(Course(0.0, 20.0, 1.0),), moves=(good,)),))
    assert dry_run_of(track, {"chamber": chamber, "a": axis}).problems == ()
    moves = dataclasses.replace(good, angle_deg=200.0), dataclasses.replace(good, kind="spin")
    steep = Track((TrackStep("one", 5.0, courses=(Course(0.0, 20.0, 5.0),), moves=moves),))
    found = " ".join(dry_run_of(steep, {"chamber": chamber, "a": axis}).problems)
    for words in ("ramps at 5 K/min", "its travel is -180 to 180", "turns continuously, but its travel is limited"):
        assert words in found


# ---------------------------------------------------------------------------------------------------------------- ends


@pytest.mark.parametrize(
    ("harm", "words", "unsafe"),
    [
        (lambda rig: rig.chamber.raise_alarm(18), "chamber reports alarm 18", set()),
        (lambda rig: setattr(rig.table, "_state", "Alarm"), "axis table: Alarm", set()),
        (lambda rig: rig.table.hard_limit(), "did not answer", {"table"}),
        (lambda rig: rig.ports[2].unplug(), "imu1: The port", set()),
        (lambda rig: setattr(rig.ports[2], "faults", Faults(mute=True)), "no sample from imu1", set()),
        (lambda rig: rig.ports[0].unplug(), "The port", {"chamber"}),
    ],
    ids=["alarm", "fault", "mute board", "unit", "silent unit", "chamber"],
)
def test_alarms_faults_and_pulled_cables_abort_and_the_rest_is_made_safe(tmp_path, harm, words, unsafe):
    rig, result, _ = struck(tmp_path, TRACK, in_step(1), harm, every_s=0.5, safe_deadline_s=5.0)
    assert result.exit_status == "aborted"
    assert words in result.reason
    assert {outcome.name for outcome in result.outcomes if not outcome.verified} == unsafe
    # A device that never answers keeps nobody else waiting.
    assert max(outcome.took_s for outcome in result.outcomes if outcome.verified) < 5.0
    assert rig.rate_dps() == 0.0
    assert read_journal(tmp_path / "journal").events[-1].name == "end"


def test_temperature_that_never_settles_ends_the_run_with_a_sentence(tmp_path):
    track = Track((TrackStep("soak", 10.0, 120.0, Stable(0.2, 60.0, 300.0)),))
    with running(tmp_path, track, with_unit=False) as (_, runner):
        ends_aborted(runner, "not stable within 0.2 K of 120 degC after 300 s")


@pytest.mark.parametrize(("sent", "reason"), [(signal.SIGINT, "Ctrl-C"), (signal.SIGTERM, "SIGTERM")])
def test_signals_end_a_run_safely(tmp_path, sent, reason):
    with running(tmp_path, TRACK) as (_, runner), signals_to(runner):
        acting(runner, in_step(0), lambda: os.kill(os.getpid(), sent), every_s=5.0)
        assert ends_aborted(runner).reason == reason
    assert states(tmp_path) == ["running", "aborting", "safe"]
    assert read_journal(tmp_path / "journal").events[-1].data["verified_safe"] is True


@pytest.mark.parametrize(("begins", "ends"), [("Alarm", "success"), ("Idle", "aborted")])
def test_an_axis_that_a_run_does_not_move_may_keep_its_alarm_and_get_no_new_one(tmp_path, begins, ends):
    turns = lambda state: lambda rig: setattr(rig.table, "_state", state)  # noqa: E731
    stands = Track((TrackStep("stand", 60.0),))
    rig, result, _ = struck(tmp_path, stands, in_step(0), turns("Alarm"), ready=turns(begins))
    assert result.exit_status == ends, result.reason
    assert ("Interlock 'axis fault': axis table: Alarm" in result.reason) == (ends == "aborted")
    assert "$H" not in rig.table.lines


# ------------------------------------------------------------------------------------------------------------- chamber


def test_a_step_that_follows_tells_the_chamber_its_course(tmp_path):
    warm = TrackStep("warmer", 5.0, courses=(Course(0.0, 30.0),))
    soak = TrackStep("soak", 5.0, 25.0, Stable(0.5, 5.0, 3600.0))
    with running(tmp_path, Track((soak, warm))) as (rig, runner):
        assert runner.run().exit_status == "success"
        assert rig.chamber.constant_c == 30.0
    told, begins = events(tmp_path, "chamber told"), events(tmp_path, "step begins")
    assert [event.data["hold_c"] for event in told] == [25.0, 30.0]
    assert told[1].time_s - begins[1].data["begins_s"] < 10.0


def test_a_chamber_that_was_made_safe_is_told_nothing_more(tmp_path):
    """The end comes while the chamber is being told its ramp, which takes it seconds."""
    track = Track((TrackStep("ramp", 60.0, courses=(Course(0.0, 25.0), Course(10.0, 40.0, 1.0))),))
    with running(tmp_path, track) as (rig, runner):
        begun = lambda now: now.step_left_s is not None and now.step_left_s <= 49.8  # noqa: E731
        acting(runner, begun, lambda: runner.abort("now"), every_s=0.1)
        ends_aborted(runner)
        rig.clock.sleep(30.0)
        assert rig.chamber.mode == "STANDBY"


# -------------------------------------------------------------------------------------------------- what a check says


def test_a_device_that_is_asked_nothing_by_its_limits_has_to_answer_all_the_same():
    """A socket that accepts and says nothing, in the place of a chamber whose limits stand in its description."""
    with socket.create_server(("127.0.0.1", 0)) as mute:
        url = f"socket://127.0.0.1:{mute.getsockname()[1]}"
        (report,) = check_each(chamber_alone("cts", port=url, options={"reply_timeout": "0.1 s"}), RealClock())
    assert "did not answer" in report.problem


# ---------------------------------------------------------------------------------------------------------- messages


def test_a_run_that_never_began_is_not_called_sound(tmp_path, capsys):
    with Rig(RealClock()) as rig:
        another = rig.rig.axis[0].model_copy(update={"serial_number": "another one"})
        rig_file = rig.rig.model_copy(update={"axis": (another,)})
        assert gradcal_run(tmp_path, rig_file, "-o", str(tmp_path / "run"), "--yes") == 3
    said = capsys.readouterr().err
    assert "the run did not begin, and no command was sent: table at" in said
    assert "sound" not in said


def test_a_cable_that_is_in_again_is_used_to_make_safe():
    with Rig(RealClock()) as rig, open_rig(rig.rig, rig.clock) as bench:
        table = bench.axes["table"]
        table.home()
        table.spin(60.0, 300.0)
        rig.ports[1].unplug()
        with pytest.raises(Disconnected):
            table.read()
        again = threading.Timer(1.0, rig.ports[1].replug)
        again.start()
        outcomes = {outcome.name: outcome for outcome in make_safe(bench, rig.clock, deadline_s=8.0)}
        again.join()
        assert outcomes["table"].verified, outcomes["table"].evidence
        assert rig.rate_dps() == 0.0


def test_late_replies_are_said(tmp_path):
    seen = []

    def says(progress, rig):
        seen.extend(progress.remarks)
        return bool(seen)

    def late(rig):
        rig.ports[0].faults = lambda message: [(3.4, message)]

    struck(tmp_path, short_track(), says, lambda rig: None, ready=late)
    assert "ESPEC at" in seen[0]
    assert "late: raise reply_timeout" in seen[0]
