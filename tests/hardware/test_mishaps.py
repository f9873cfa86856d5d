"""What goes wrong in a run: limits hold in every state, and what was not executed as written is made again or said.

The plants do what the faults do (a heater that is welded on, a table that is jammed); the devices keep the state that
their firmware has.
"""

import collections
import errno
import math
import os
import re
import threading
import time
from functools import partial
from unittest.mock import Mock

import numpy as np
import pytest
from hardware_bench import (
    acting,
    chamber_alone,
    chunks_of,
    ends_aborted,
    events,
    gradcal_run,
    in_step,
    running,
    short_track,
    struck,
)
from hardware_evidence import record
from simulated_devices.faults import Faults

from gradcal_jax.hardware import journal, supervision
from gradcal_jax.hardware.chamber_control import ChamberControl
from gradcal_jax.hardware.clock import RealClock
from gradcal_jax.hardware.drivers.listening import TextUnitConfig
from gradcal_jax.hardware.interlocks import InterlockLimits, limits_of
from gradcal_jax.hardware.journal import Event, Journal, read_journal
from gradcal_jax.hardware.roles import ChamberReading
from gradcal_jax.hardware.supervision import read_status
from gradcal_jax.hardware.track import AxisCommand, Course, Stable, Track, TrackStep
from gradcal_jax.hardware.unit_control import ExecutedStep, SampleLosses
from gradcal_jax.records.sessions import sessions_of
from gradcal_jax.spec.rig import rig_of
from gradcal_jax.tables.problems import SpecError

READY = Stable(0.5, 20.0, 7200.0)
HOT = Track((TrackStep("hot", 300.0, 40.0, READY),))
WARMS = Track((TrackStep("ramp", 500.0, 26.0, READY, (Course(0.0, 36.0, 1.5),)),))
STANDS = Track((TrackStep("stand", 600.0),))
TURN = TrackStep("turn", 10.0, moves=(AxisCommand(0.0, "table", "turn", 10.0, 60.0, 60.0),))
LONG_TURN = AxisCommand(0.0, "table", "turn", 3600.0, 150.0, 300.0)
SPIN = AxisCommand(0.0, "table", "spin", rate_dps=150.0, acceleration_dps2=300.0)

struck_alone = partial(struck, with_unit=False)


def air_when_safe_c(folder, rig):
    """Temperature of the air when the run had made the chamber safe: the clock, and a welded heater, run on after."""
    (safe,) = [event for event in events(folder, "made safe") if event.data["device"] == "chamber"]
    assert safe.time_s >= events(folder, "ending")[-1].time_s > 0.0
    return float(rig.chamber.plant.load_at(np.array([safe.time_s]))[0])


def weld_on(rig, k_per_min=6.0):
    """The heater's contactor is welded: the air warms whatever the controller says."""
    plant = rig.chamber.plant

    def heats(step_s):
        plant.air_c += k_per_min / 60.0 * step_s
        plant._load_c = plant.air_c

    plant._step = heats


def warmer_than(air_c):
    return lambda progress, rig: progress.chamber is not None and progress.chamber.air_c > air_c


def left(seconds):
    return lambda progress, rig=None: progress.step_left_s is not None and progress.step_left_s < seconds


def turning(last=False, rate_dps=10.0):
    """In a step with data, or in the last, while the table turns."""

    def turns(progress, rig):
        under_way = progress.step_left_s is not None and progress.steps_done >= (progress.steps - 1 if last else 1)
        return under_way and abs(rig.rate_dps()) > rate_dps

    return turns


# -------------------------------------------------------------------------------------------------------- temperatures


# Track, when and how fast (K/min) the heater is welded on, the limit of the rig file, and the highest air.
BEYOND = {
    "homing": (Track((TURN,)), lambda progress, rig: True, 60.0, 60.0, 70.0),
    "stabilising": (HOT, lambda progress, rig: progress.step_left_s is None, 6.0, 60.0, 63.0),
    "running": (STANDS, in_step(0), 6.0, 60.0, 63.0),
    "by the chamber's own limits": (STANDS, in_step(0), 6.0, math.inf, 76.0),
}


@pytest.mark.parametrize("state", BEYOND)
def test_air_that_leaves_its_limits_ends_a_run_in_every_state(tmp_path, state):
    track, when, k_per_min, limit_c, highest_c = BEYOND[state]
    # The other rules of temperature are off: this one holds alone.
    limits = InterlockLimits(temperature_band_k=math.inf, never_above_c=limit_c)

    def ready(rig):
        rig.chamber.high_c, rig.table.homing_s = 70.0, 100.0

    welds, words = partial(weld_on, k_per_min=k_per_min), "Interlock 'temperature limit'"
    rig, *_ = struck_alone(tmp_path, track, when, welds, words, ready=ready, limits=limits)
    assert air_when_safe_c(tmp_path, rig) < highest_c


def test_the_load_has_limits_too():
    chamber = ChamberControl(Mock(), RealClock(), lambda *_, **__: None)
    chamber.heard(ChamberReading(0.0, -30.0, -41.0, -30.0, "RUN", True, ()))
    assert "the load is at -41.0 degC" in chamber.violated(InterlockLimits(never_below_c=-40.0))["temperature limit"]


@pytest.mark.parametrize(
    ("when", "k_per_min", "highest_c"),
    # Ten per cent of the way and the band above the goal, and half a minute.
    [(warmer_than(35.0), 6.0, 40.0 + 1.6 + 3.0 + 3.0 + 1.0), (left(25.0), 30.0, math.inf)],
    ids=["while it waits", "in the last seconds"],
)
def test_a_heater_welded_on_is_no_success(tmp_path, when, k_per_min, highest_c):
    words = "Interlock 'temperature course': the air is at"
    rig, *_ = struck_alone(tmp_path, HOT, when, partial(weld_on, k_per_min=k_per_min), words)
    assert air_when_safe_c(tmp_path, rig) < highest_c


@pytest.mark.parametrize("waits", [True, False], ids=["no power, stabilising", "STANDBY at the panel, running"])
def test_a_chamber_that_was_switched_off_ends_the_run_and_is_not_started_again(tmp_path, waits):
    def fail(rig):
        rig.chamber.commands.clear()
        rig.chamber.reboot() if waits else rig.chamber._enter("STANDBY")

    def when(progress, rig):
        return warmer_than(30.0)(progress, rig) and (progress.step_left_s is None) == waits

    # A wide band: the temperature says nothing for long.
    limits, words = InterlockLimits(temperature_band_k=30.0), "'idle chamber': the chamber is off, and this run did not"
    rig, *_ = struck_alone(tmp_path, HOT if waits else WARMS, when, fail, words, limits=limits)
    assert not any("CONSTANT" in command for command in rig.chamber.commands)


def test_limits_of_the_rig_file_reach_the_run():
    found = limits_of(chamber_alone("espec", never_above="80 degC", never_below="-45 degC"))
    assert (found.never_above_c, found.never_below_c) == pytest.approx((80.0, -45.0))
    with pytest.raises(SpecError, match="never_above"):
        chamber_alone("espec", never_above="10 degC", never_below="-45 degC")


AXIS = {"name": "a", "driver": "lines", "port": "COM1", "safe": "unpower", "gravity_loaded": False}
UNTOLD = {"changes": {"tell": {"on": False, "off": False}}}
WITHOUT = {
    "chamber.safe": chamber_alone("watlow-f4", driver="registers", options=UNTOLD),
    "axis[0].safe": rig_of({"format": "gradcal-rig/1", "axis": [AXIS | {"options": {"protocol": "grbl"}}]}),
}


@pytest.mark.parametrize("words", WITHOUT)
def test_a_safe_state_that_a_device_cannot_take_is_refused_before_anything(words, tmp_path, capsys):
    # Not that nobody answers: nobody is asked.
    assert gradcal_run(tmp_path, WITHOUT[words], "-o", str(tmp_path / "run"), "--yes") == 2
    said = capsys.readouterr().err
    assert "this device does not support this safe state: its description lacks [tell.off]" in said
    assert words in said
    assert not (tmp_path / "run").exists()


# ---------------------------------------------------------------------------------------------------------------- axes


def test_a_jammed_axis_is_said_to_stand_and_is_not_pushed_for_long(tmp_path):
    """The table is held at 81.9 deg in mid-turn: the controller goes on pushing, its loop of position not closed."""

    def jam(rig):
        rig.axis.set_zero(rig.clock.now(), 81.9)
        rig.axis.move_to = lambda *_: None
        # It pushes until it is stopped.
        rig.axis.moving = lambda _: True
        rig.axis.spin = lambda *_: setattr(rig.axis, "moving", lambda _: False)

    track = Track((TrackStep("turn", 60.0, moves=(LONG_TURN,)),))
    words = "axis table has been at 81.9 deg", "it is blocked"
    _, _, jammed_s = struck_alone(tmp_path, track, turning(last=True, rate_dps=100.0), jam, *words)
    (ended,) = events(tmp_path, "ending")
    # Long before the planned end of the turn.
    assert 4.0 <= ended.time_s - jammed_s < 7.0


def test_a_spin_at_another_rate_is_made_again_from_the_nearest_equal_angle(tmp_path):
    """Rates of the standard method turn an axis many times round; a repeated step unwinds nothing."""
    track, turned = Track((TrackStep("rate 1", 300.0, moves=(SPIN,), start_deg={"table": 0.0}),)), []

    def slow_down(rig):
        turned.append(rig.axis.state(rig.clock.now())[0])
        rig.axis.spin(rig.clock.now(), 100.0, 1e3)

    _, result, _ = struck_alone(tmp_path, track, lambda progress, rig: rig.clock.now() >= 250.0, slow_down)
    assert result.exit_status == "success", result.reason
    (amiss,) = events(tmp_path, "not done")
    assert "axis table spins at 100.00 deg/s instead of 150" in amiss.data["why"]
    (goes_deg,) = (e.data["position_deg"] for e in events(tmp_path, "move") if e.data["kind"] == "go")
    assert turned[0] > 30000.0
    # It goes on for some seconds.
    assert 0.0 < goes_deg - turned[0] < 720.0
    assert goes_deg % 360.0 == pytest.approx(0.0, abs=1e-9)


def run_away(rig, rate_dps=700.0):
    rig.axis.spin(rig.clock.now(), rate_dps, 1e5)


def test_an_axis_that_turns_faster_than_it_was_told_is_stopped_and_safe(tmp_path):
    words = "Interlock 'over-speed': axis table turns at", "the rig allows 300"
    rig, _, ran_s = struck(tmp_path, short_track(), turning(), run_away, *words)
    assert rig.rate_dps() == 0.0
    (tripped,) = events(tmp_path, "interlock")
    assert tripped.time_s - ran_s < 6.0


@pytest.mark.parametrize("heeds", [True, False], ids=["heeds a stop", "heeds nothing"])
@pytest.mark.parametrize("rate_dps", [2.0, 500.0, math.inf])
def test_an_axis_that_leaves_its_place_while_its_board_reports_idle(tmp_path, rate_dps, heeds):
    """In a step whose samples are not used, and whose end no command follows; an infinite rate is a jump."""
    jumps, track = math.isinf(rate_dps), Track((TURN, TrackStep("stand", 120.0, read_every_s=10.0)))

    def ready(rig):
        if heeds:
            rig.table._cancel_jog = lambda: run_away(rig, 0.0)

    def leave(rig):
        assert rig.table._state == "Idle"
        rig.axis.set_zero(rig.clock.now(), 100.0) if jumps else run_away(rig, rate_dps)

    def when(progress, rig):
        return in_step(1)(progress) and left(100.0)(progress)

    rig, result, ran_s = struck_alone(tmp_path, track, when, leave, ready=ready)
    assert result.exit_status == "aborted", result
    assert "Interlock 'stray axis': axis table stood at 10.0 deg and was not told to move" in result.reason
    assert result.verified_safe == (heeds or jumps) == (rig.rate_dps() == 0.0)
    (tripped,) = events(tmp_path, "interlock")
    assert tripped.time_s - ran_s < 6.0


@pytest.mark.parametrize("angle_deg", [3600.0, -10.0, 90.0])
def test_where_a_turn_is_planned_to_be_at_an_instant(angle_deg):
    """The integral of the trapezoid of its rate."""
    turn = AxisCommand(0.0, "table", "turn", rate_dps=150.0, acceleration_dps2=300.0, angle_deg=angle_deg)
    step_s = turn.duration_s / 100_000
    ends_s = (np.arange(100_000) + 0.5) * step_s
    rates = np.minimum(np.minimum(300.0 * ends_s, 150.0), 300.0 * (turn.duration_s - ends_s))
    for share in (0.1, 0.4, 0.9, 1.0):
        integral_deg = float(np.sum(rates[: round(share * 100_000)])) * step_s * np.sign(angle_deg)
        assert turn.turned_deg(share * turn.duration_s) == pytest.approx(integral_deg, abs=1e-4 * abs(angle_deg))


# --------------------------------------------------------------------------------------------- steps that are not done


def was_executed(folder):
    """The last attempt at every step has all its commands, on time."""
    found = read_journal(folder / "journal").events
    done = {event.data["number"] for event in found if event.name == "step done"}
    begins = {event.data["number"]: event for event in found if event.name == "step begins"}
    assert done == set(begins)
    for begin in begins.values():
        later = found[found.index(begin) + 1 :]
        end = next((k for k, event in enumerate(later) if event.name in ("step", "ending")), len(later))
        for move in (event.data for event in later[:end] if event.name == "move"):
            assert move["began_s"] - begin.data["begins_s"] == pytest.approx(move["start_s"], abs=1.0)


def spoils(way):
    return lambda rig: setattr(rig.ports[2], "faults", way)


def sleeps(seconds):
    return lambda rig: rig.clock.sleep(seconds)


def lossy(rig):
    rig.ports[2].faults = faults = Faults()
    faults.once(*["drop"] * 200)


@pytest.mark.parametrize(
    ("mishap", "why", "last"),
    [(sleeps(25.0), "late", False), (lossy, "samples", True), (lambda rig: rig.imu.reboot(), "imu1", False)],
    ids=["a host that slept", "lost samples", "a unit that restarted"],
)
def test_a_step_that_was_not_executed_as_written_is_made_again(tmp_path, mishap, why, last):
    track = short_track()
    _, result, _ = struck(tmp_path, track, turning(last), mishap)
    assert result.exit_status == "success", result.reason
    amiss, *more = events(tmp_path, "not done")
    assert why in amiss.data["why"]
    assert (amiss.data["number"] == len(track.steps) - 1) == last
    assert amiss.data["step"] in [event.data["step"] for event in events(tmp_path, "seam")]
    assert why == "imu1" or not more
    was_executed(tmp_path)


def test_a_late_reading_that_no_recipe_takes_repeats_no_step(tmp_path):
    """A host or a device that is late by seconds in a soak of hours: nothing of the step is missing."""
    soaks = Track((TrackStep("soak", 60.0, data=False),))
    _, result, _ = struck(tmp_path, soaks, lambda progress, rig: rig.clock.now() >= 30.0, sleeps(2.5))
    assert result.exit_status == "success"
    assert not events(tmp_path, "not done")


def freezes(rig):
    """The unit repeats the rates and forces of one sample: a sensor that hangs behind its interface."""
    take, held = rig.sensor.take, []

    def one(count):
        samples = take(count)
        held[:] = held or [samples.rate_dps[0].copy()]
        samples.rate_dps[:] = held[0]
        return samples

    rig.sensor.take = one


def damaged(message):
    return [(0.0, message[:-3] + bytes([message[-3] ^ 1]) + message[-2:])]


@pytest.mark.parametrize(
    ("mishap", "last", "attempts", "words"),
    [
        (sleeps(8.0), False, 3, "late"),
        (freezes, True, 3, "the IMU's gyros measured"),
        (spoils(lambda message: []), True, 0, "no sample from imu1"),
        (spoils(damaged), True, 0, "no sample from imu1"),
    ],
    ids=["a slow host", "a frozen unit", "no bytes", "bytes and no usable sample"],
)
def test_what_is_never_executed_ends_the_run_with_a_sentence(tmp_path, mishap, last, attempts, words):
    with running(tmp_path, short_track()) as (rig, runner):
        runner.chamber_every_s = 1.0
        runner.on_progress = lambda progress: mishap(rig) if turning(last)(progress, rig) else None
        result = ends_aborted(runner, words)
        said = re.match(r"In 3 attempts, step .* was not executed as the recipe states\.", result.reason)
        assert bool(said) == bool(attempts)
        assert last or result.steps_done < len(runner.track.steps)
    numbers = [event.data["number"] for event in events(tmp_path, "not done")]
    assert numbers == numbers[:1] * attempts
    assert not {*numbers} & {event.data["number"] for event in events(tmp_path, "step done")}


@pytest.mark.parametrize("share", [0.0, 0.1])
def test_lost_lines_of_a_unit_that_does_not_count_are_noticed_by_their_rate(share):
    described = {"format": "gradcal-text/1", "line": "{gyro_x} {gyro_y} {gyro_z}", "rate": "50 Hz"}
    losses = SampleLosses(TextUnitConfig(protocol=described).decoder(), 50.0, None, 0.0)
    for k in np.flatnonzero(np.random.default_rng(1).random(50 * 40) >= share):
        losses.push(b"0.001 0.002 0.003\r\n", k / 50.0)
    said = losses.between(ExecutedStep(0, 1.0, 40.0), InterlockLimits())
    assert re.search(r"45\.\d* samples/s, but its setting is 50", said) if share else not said


def test_a_turn_that_a_stage_swallowed_is_not_done(tmp_path):
    with running(tmp_path, short_track()) as (rig, runner):
        jog, looks, swallowed = rig.table._jog, rig.table._now, []

        def once_lame(at_s, goal, rate_dps):
            if swallowed or len(events(tmp_path, "step begins")) < 2:
                return jog(at_s, goal, rate_dps)
            # The board says that it moves, and soon that it does not.
            swallowed.append(at_s)
            rig.table._state = "Jog"

        def says_that_it_moves():
            now = rig.clock.now()
            return now if swallowed and now < swallowed[0] + 0.3 else looks()

        rig.table._jog, rig.table._now = once_lame, says_that_it_moves
        result = runner.run()
        assert (result.exit_status, len(swallowed)) == ("success", 1), result.reason
    (amiss,) = events(tmp_path, "not done")
    assert "and its target is" in amiss.data["why"]
    was_executed(tmp_path)


def test_attempts_that_the_run_refused_are_no_data():
    """The step 1 is refused while step 2 is under way, twice; the second time the run ends with that."""

    def steps(*begun):
        return [
            Event(time_s, name, {"number": number, "begins_s": time_s, "data": True})
            for number, time_s in begun
            for name in ("step", "step begins")
        ]

    def refused(time_s):
        amiss = Event(time_s + 10.4, "not done", {"number": 1, "why": ""})
        return [*steps((1, time_s), (2, time_s + 10.0)), amiss]

    session = {"number": 0, "simulated": False, "wall_clock_s": 0.0}
    first = [Event(0.0, "session", session), *steps((0, 10.0)), *refused(20.0)]
    (ended,) = sessions_of([*first, *refused(40.0), Event(51.0, "ending", {})])
    assert (ended.stretches(), ended.count("not done")) == ([(10.0, 20.0)], 2)
    (repeated,) = sessions_of([*first, *steps((1, 40.0), (2, 50.0)), Event(60.0, "ending", {})])
    assert repeated.stretches() == [(10.0, 20.0), (40.0, 60.0)]


# ---------------------------------------------------------------------------------------------------------------- disks


@pytest.mark.parametrize("call", ["write", "fsync"])
def test_a_disk_that_hangs_is_noticed_without_a_further_event(tmp_path, monkeypatch, call):
    began, hangs, real = threading.Event(), threading.Event(), getattr(os, call)

    def stuck(*args):
        began.set()
        hangs.wait(20.0)
        return real(*args)

    monkeypatch.setattr(journal, "_LONGEST_WAIT_S", 0.3)
    with Journal(tmp_path / "journal") as written:
        written.event(0.0, "before")
        monkeypatch.setattr(os, call, stuck)
        written.bytes_of("imu1", 1.0, b"a", received=True)
        assert began.wait(5.0)
        written.bytes_of("imu1", 2.0, b"b", received=True)
        end = time.monotonic() + 5.0
        while not written.problem and time.monotonic() < end:
            time.sleep(0.05)
        hangs.set()
        assert "the disk has not answered" in written.problem
    # What came before that was noticed is not lost if the disk answers again.
    assert [chunk.data for chunk in chunks_of(read_journal(tmp_path / "journal"), "imu1")] == [b"a", b"b"]


def test_a_disk_that_fills_ends_the_run_and_leaves_the_status_of_the_end(tmp_path, monkeypatch):
    with running(tmp_path, STANDS, limits=InterlockLimits(free_bytes=1 << 60)) as (_, runner):
        ends_aborted(runner, "MB are free")
    # The status file is written over, which needs no space.
    supervision.end_status(tmp_path, "x", [])
    with supervision.status_file(tmp_path, simulated=False) as change:
        change({"state": "running", "step": "a step with a longer name than the end has" * 9})
        time.sleep(0.5)
        assert read_status(tmp_path)["state"] == "running"
        full = Mock(side_effect=OSError(errno.ENOSPC, "No space left on device"))
        monkeypatch.setattr(supervision, "write_whole", full)
        change({"step": ""} | supervision.ended("aborted", "the disk is full", True))
    assert (read_status(tmp_path)["state"], read_status(tmp_path)["reason"]) == ("safe", "the disk is full")


def counted(port, lost=-1):
    """What a port's device is told from now on; of it the command of the number `lost` never arrives."""
    heard = []

    def apply(message):
        heard.append(message)
        return [] if len(heard) - 1 == lost else [(0.0, message)]

    port.commands = apply
    return heard


@pytest.mark.evidence
def test_nothing_ends_done_that_was_not_done(tmp_path):
    """Whole runs with one mishap each: commands that are lost wherever they come, hosts that sleep, axes that run away.

    A run that ends "success" was executed as written; of every other one all devices are safe, and it says why.
    """
    random = np.random.default_rng(0)
    with running(tmp_path / "whole", short_track()) as (rig, runner):
        # The unit takes no commands.
        told = [counted(port) for port in rig.ports[:2]]
        assert runner.run().exit_status == "success"
    sizes = dict(zip(("chamber", "table"), map(len, told), strict=True))
    mishaps = [(name, int(random.integers(size))) for name, size in sizes.items() for _ in range(8)]
    mishaps += [("host", seconds) for seconds in random.uniform(1.0, 90.0, 6)] + [("run-away axis", 0)] * 2
    ended = collections.Counter()
    for number, (what, size) in enumerate(mishaps):
        folder = tmp_path / f"run{number}"
        with running(folder, short_track()) as (rig, runner):
            if what in sizes:
                counted(rig.ports[list(sizes).index(what)], int(size))
            else:
                mishap = partial(sleeps(size) if what == "host" else run_away, rig)
                acting(runner, partial(turning(), rig=rig), mishap)
            result = runner.run()
            assert result.verified_safe, (what, size, result)
            assert rig.rate_dps() == 0.0
            assert not rig.chamber.plant.conditioning
        if result.exit_status == "success":
            was_executed(folder)
        else:
            assert result.reason, (what, size)
        ended[what, result.exit_status] += 1
    assert ended["run-away axis", "aborted"] == 2
    assert sum(count for (what, how), count in ended.items() if how == "success") > 0.5 * len(mishaps)
    said = [f"{what}: {ended[what, 'success']} done, {ended[what, 'aborted']} ended" for what, _ in dict(ended)]
    record(
        "whole runs with one mishap each",
        f"a command lost (of {', '.join(f'{size} to the {name}' for name, size in sizes.items())}), a host that sleeps "
        f"1 to 90 s in a turn, an axis that runs away; {len(mishaps)} runs: {'; '.join(said)}. Every run that ended "
        "done was executed as written; every other one says why, all safe, verified",
        "tests/hardware/test_mishaps.py",
    )
