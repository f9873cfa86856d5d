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
from hardware_bench import acting, at, chunks_of, ends_aborted, events, in_step, running, short_recipe, short_track
from hardware_evidence import record
from simulated_devices.faults import Faults

from gradcal_jax.cli import main
from gradcal_jax.hardware import journal, supervision
from gradcal_jax.hardware.chamber_control import ChamberControl
from gradcal_jax.hardware.clock import RealClock
from gradcal_jax.hardware.drivers.listening import TextUnitConfig
from gradcal_jax.hardware.execute import limits_of
from gradcal_jax.hardware.interlocks import InterlockLimits
from gradcal_jax.hardware.journal import Event, Journal, read_journal
from gradcal_jax.hardware.roles import ChamberReading
from gradcal_jax.hardware.supervision import read_status
from gradcal_jax.hardware.track import AxisCommand, Course, Stable, Track, TrackStep
from gradcal_jax.hardware.unit_control import ExecutedStep, SampleLosses
from gradcal_jax.records.sessions import sessions_of
from gradcal_jax.spec.rig import rig_of
from gradcal_jax.tables.problems import SpecError
from gradcal_jax.tables.writing import write_toml

READY = Stable(0.5, 20.0, 7200.0)
HOT = Track((TrackStep("hot", 300.0, 40.0, READY),))
WARMS = Track((TrackStep("ramp", 500.0, 26.0, READY, (Course(0.0, 36.0, 1.5),)),))
STANDS = Track((TrackStep("stand", 600.0),))
TURNS = AxisCommand(0.0, "table", "turn", 3600.0, 150.0, 300.0)


def nothing_ended_it(runner, after_s=3600.0):
    return at(runner, after_s), lambda: runner.abort("nothing ended it")


def air_when_safe_c(folder, rig):
    """Temperature of the air when the run had made the chamber safe: the clock, and a welded heater, run on after."""
    (safe,) = [event for event in events(folder, "made safe") if event.data["device"] == "chamber"]
    assert safe.time_s >= events(folder, "ending")[-1].time_s > 0.0
    return float(rig.chamber.plant.load_at(np.array([safe.time_s]))[0])


def weld_on(rig, k_per_min=6.0):
    """The heater's contactor is welded: the air warms whatever the controller says."""
    plant = rig.chamber.plant

    def heats(step_s):
        plant._air_c += k_per_min / 60.0 * step_s
        plant._load_c = plant._air_c

    plant._step = heats


def left(progress, seconds):
    return progress.step_left_s is not None and progress.step_left_s < seconds


# -------------------------------------------------------------------------------------------------------- temperatures


TURN = TrackStep("turn", 10.0, moves=(AxisCommand(0.0, "table", "turn", 10.0, 60.0, 60.0),))
# Track, when the heater is welded on, the limit of the rig file, and the highest air.
BEYOND = {
    "homing": (Track((TURN,)), lambda progress: True, 60.0, 70.0),
    "stabilising": (HOT, lambda progress: progress.step_left_s is None, 60.0, 63.0),
    "running": (STANDS, in_step(0), 60.0, 63.0),
    "by the chamber's own limits": (STANDS, in_step(0), math.inf, 76.0),
}


@pytest.mark.parametrize("state", BEYOND)
def test_air_that_leaves_its_limits_ends_a_run_in_every_state(tmp_path, state):
    track, when, limit_c, highest_c = BEYOND[state]
    # The other rules of temperature are off: this one holds alone.
    limits = InterlockLimits(temperature_band_k=math.inf, never_above_c=limit_c)
    with running(tmp_path, track, limits=limits, with_unit=False) as (rig, runner):
        rig.chamber.options.high_c = 70.0
        rig.table.homing_s = 100.0
        acting(runner, (when, lambda: weld_on(rig, 60.0 if state == "homing" else 6.0)), nothing_ended_it(runner))
        ends_aborted(runner, "Interlock 'temperature limit'")
        assert air_when_safe_c(tmp_path, rig) < highest_c


def test_the_load_has_limits_too():
    chamber = ChamberControl(Mock(), RealClock(), lambda *_, **__: None)
    chamber.heard(ChamberReading(0.0, -30.0, -41.0, -30.0, "RUN", True, ()))
    said = chamber.violated(InterlockLimits(never_below_c=-40.0))["temperature limit"]
    assert "the load is at -41.0 degC" in said


@pytest.mark.parametrize("when", ["while it waits", "in the last seconds"])
def test_a_heater_welded_on_is_no_success(tmp_path, when):
    with running(tmp_path, HOT, with_unit=False) as (rig, runner):
        warm = lambda progress: progress.chamber is not None and progress.chamber.air_c > 35.0  # noqa: E731
        last = lambda progress: left(progress, 25.0)  # noqa: E731
        is_so, rate = (warm, 6.0) if when == "while it waits" else (last, 30.0)
        acting(runner, (is_so, lambda: weld_on(rig, rate)), nothing_ended_it(runner))
        ends_aborted(runner, "Interlock 'temperature course': the air is at")
        # Ten per cent of the way and the band above the goal, and half a minute.
        assert when != "while it waits" or air_when_safe_c(tmp_path, rig) < 40.0 + 1.6 + 3.0 + 3.0 + 1.0


@pytest.mark.parametrize("fate", ["no power, stabilising", "STANDBY at the panel, running"])
def test_a_chamber_that_was_switched_off_ends_the_run_and_is_not_started_again(tmp_path, fate):
    waits = fate.endswith("stabilising")
    # A wide band: the temperature says nothing for long.
    limits = InterlockLimits(temperature_band_k=30.0)
    with running(tmp_path, HOT if waits else WARMS, limits=limits, with_unit=False) as (rig, runner):

        def fail():
            rig.chamber.commands.clear()
            rig.chamber.reboot() if waits else rig.chamber._enter("STANDBY")

        def is_so(progress):
            warm = progress.chamber is not None and progress.chamber.air_c > 30.0
            return warm and (progress.step_left_s is None) == waits

        acting(runner, (is_so, fail))
        ends_aborted(runner, "Interlock 'idle chamber': the chamber is off, and this run did not switch it off: mode")
        assert not [command for command in rig.chamber.commands if "CONSTANT" in command]


def test_limits_of_the_rig_file_reach_the_run():
    chamber = {"driver": "lines", "options": {"protocol": "espec"}, "port": "COM1", "safe": "standby"}
    chamber |= {"never_above": "80 degC", "never_below": "-45 degC"}
    rig = rig_of({"format": "gradcal-rig/1", "chamber": chamber})
    found = limits_of(rig)
    assert (found.never_above_c, found.never_below_c) == pytest.approx((80.0, -45.0))
    with pytest.raises(SpecError, match="never_above"):
        rig_of({"format": "gradcal-rig/1", "chamber": chamber | {"never_above": "10 degC"}})


WITHOUT = {
    "no [tell] on and off": (
        '[chamber]\ndriver = "registers"\nport = "COM1"\nsafe = "standby"\n'
        'options = { protocol = "watlow-f4", changes = { tell = { on = false, off = false } } }\n'
    ),
    "lacks [tell.off]": (
        '[[axis]]\nname = "a"\ndriver = "lines"\nport = "COM1"\nsafe = "unpower"\ngravity_loaded = false\n'
        'options = { protocol = "grbl" }\n'
    ),
}


@pytest.mark.parametrize("words", WITHOUT)
def test_a_safe_state_that_a_device_cannot_take_is_refused_before_anything(words, tmp_path, capsys):
    rig, recipe = tmp_path / "rig.toml", tmp_path / "recipe.toml"
    rig.write_text('format = "gradcal-rig/1"\n' + WITHOUT[words])
    write_toml(short_recipe(), recipe)
    # Not that nobody answers: nobody is asked.
    assert main(["run", str(recipe), "--rig", str(rig), "-o", str(tmp_path / "run"), "--yes"]) == 2
    said = capsys.readouterr().err
    assert "this device does not support this safe state" in said
    assert words in said
    assert not (tmp_path / "run").exists()


# ---------------------------------------------------------------------------------------------------------------- axes


def test_a_jammed_axis_is_said_to_stand_and_is_not_pushed_for_long(tmp_path):
    """The table is held at 81.9 deg in mid-turn: the controller goes on pushing, its loop of position not closed."""
    with running(tmp_path, Track((TrackStep("turn", 60.0, moves=(TURNS,)),)), with_unit=False) as (rig, runner):
        jammed = []

        def jam():
            jammed.append(runner.clock.now())
            rig.axis.set_zero(runner.clock.now(), 81.9)
            rig.axis.move_to = lambda *_: None
            # It pushes until it is stopped.
            rig.axis.moving = lambda _: True
            rig.axis.spin = lambda *_: setattr(rig.axis, "moving", lambda _: False)

        turning = lambda now: in_step(0)(now) and abs(rig.axis.state(runner.clock.now())[1]) > 100.0  # noqa: E731
        acting(runner, (turning, jam))
        ends_aborted(runner, "axis table has been at 81.9 deg", "deg now: it is blocked")
    (ended,) = events(tmp_path, "ending")
    # Long before the planned end of the turn.
    assert 4.0 <= ended.time_s - jammed[0] < 7.0


def test_a_spin_at_another_rate_is_made_again_from_the_nearest_equal_angle(tmp_path):
    """Rates of the standard method turn an axis many times round; a repeated step unwinds nothing."""
    spin = AxisCommand(0.0, "table", "spin", rate_dps=150.0, acceleration_dps2=300.0)
    track = Track((TrackStep("rate 1", 300.0, moves=(spin,), start_deg={"table": 0.0}),))
    with running(tmp_path, track, with_unit=False) as (rig, runner):
        turned = []

        def slow_down():
            turned.append(rig.axis.state(runner.clock.now())[0])
            rig.axis.spin(runner.clock.now(), 100.0, 1e3)

        acting(runner, (at(runner, 250.0), slow_down))
        result = runner.run()
        assert result.exit_status == "success", result.reason
    (amiss,) = events(tmp_path, "not done")
    assert "axis table spins at 100.00 deg/s instead of 150" in amiss.data["why"]
    (goes,) = (event.data for event in events(tmp_path, "move") if event.data["kind"] == "go")
    assert turned[0] > 30000.0
    # It goes on for some seconds.
    assert 0.0 < goes["position_deg"] - turned[0] < 720.0
    assert goes["position_deg"] % 360.0 == pytest.approx(0.0, abs=1e-9)


def test_an_axis_that_turns_faster_than_it_was_told_is_stopped_and_safe(tmp_path):
    with running(tmp_path, short_track()) as (rig, runner):
        ran = []

        def run_away():
            ran.append(runner.clock.now())
            rig.axis.spin(runner.clock.now(), 700.0, 1e5)

        acting(runner, (once_turning(rig, runner), run_away))
        ends_aborted(runner, "Interlock 'over-speed': axis table turns at", "the rig allows 300")
        assert rig.axis.state(runner.clock.now())[1] == 0.0
    (tripped,) = events(tmp_path, "interlock")
    assert tripped.time_s - ran[0] < 6.0


@pytest.mark.parametrize("heeds", [True, False], ids=["heeds a stop", "heeds nothing"])
@pytest.mark.parametrize("rate_dps", [2.0, 500.0, math.inf])
def test_an_axis_that_leaves_its_place_while_its_board_reports_idle(tmp_path, rate_dps, heeds):
    """In a step whose samples are not used, and whose end no command follows; an infinite rate is a jump."""
    track = Track((TURN, TrackStep("stand", 120.0, read_every_s=10.0)))
    with running(tmp_path, track, with_unit=False) as (rig, runner):
        clock, ran = runner.clock, []

        def leave():
            assert rig.table._state == "Idle"
            ran.append(clock.now())
            if math.isinf(rate_dps):
                rig.axis.set_zero(clock.now(), 100.0)
            else:
                rig.axis.spin(clock.now(), rate_dps, 1e5)

        if heeds:
            rig.table._cancel_jog = lambda: rig.axis.spin(clock.now(), 0.0, 1e5)
        acting(runner, (lambda progress: in_step(1)(progress) and left(progress, 100.0), leave))
        result = runner.run()
    assert result.exit_status == "aborted", result
    assert "Interlock 'stray axis': axis table stood at 10.0 deg and was not told to move" in result.reason
    assert result.verified_safe == (heeds or math.isinf(rate_dps))
    assert (rig.axis.state(clock.now())[1] == 0.0) is result.verified_safe
    (tripped,) = events(tmp_path, "interlock")
    assert tripped.time_s - ran[0] < 6.0


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


def once_turning(rig, runner, *, last=False):
    """In a step with data, or in the last, while the table turns."""

    def turns(progress):
        under_way = progress.step_left_s is not None and progress.steps_done >= (progress.steps - 1 if last else 1)
        return under_way and abs(rig.axis.state(runner.clock.now())[1]) > 10.0

    return turns


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


def lossy(rig):
    rig.ports[2].faults = faults = Faults()
    faults.once(*["drop"] * 200)


@pytest.mark.parametrize(
    ("mishap", "why", "last"),
    [
        (lambda rig, clock: clock.sleep(25.0), "late", False),
        (lambda rig, clock: lossy(rig), "samples", True),
        (lambda rig, clock: rig.imu.reboot(), "unit1", False),
    ],
    ids=["a host that slept", "lost samples", "a unit that restarted"],
)
def test_a_step_that_was_not_executed_as_written_is_made_again(tmp_path, mishap, why, last):
    with running(tmp_path, short_track()) as (rig, runner):
        acting(runner, (once_turning(rig, runner, last=last), lambda: mishap(rig, runner.clock)))
        result = runner.run()
        assert result.exit_status == "success", result.reason
        steps = len(runner.track.steps)
    amiss, *more = events(tmp_path, "not done")
    assert why in amiss.data["why"]
    assert (amiss.data["number"] == steps - 1) == last
    assert amiss.data["step"] in [event.data["step"] for event in events(tmp_path, "seam")]
    assert why == "unit1" or not more
    was_executed(tmp_path)


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


def spoils(way):
    return lambda rig, clock: setattr(rig.ports[2], "faults", way)


@pytest.mark.parametrize(
    ("mishap", "last", "attempts", "words"),
    [
        (lambda rig, clock: clock.sleep(8.0), False, 3, "late"),
        (lambda rig, clock: freezes(rig), True, 3, "the IMU's gyros measured"),
        (spoils(lambda message: []), True, 0, "no sample from unit1"),
        (spoils(damaged), True, 0, "no sample from unit1"),
    ],
    ids=["a slow host", "a frozen unit", "no bytes", "bytes and no usable sample"],
)
def test_what_is_never_executed_ends_the_run_with_a_sentence(tmp_path, mishap, last, attempts, words):
    with running(tmp_path, short_track()) as (rig, runner):
        turning = once_turning(rig, runner, last=last)
        runner.chamber_every_s = 1.0
        runner.on_progress = lambda now: mishap(rig, runner.clock) if turning(now) else None
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
    losses, random = (
        SampleLosses(TextUnitConfig(protocol=described).decoder(), 50.0, None, 0.0),
        np.random.default_rng(1),
    )
    for k in range(50 * 40):
        if random.random() >= share:
            losses.push(b"0.001 0.002 0.003\r\n", k / 50.0)
    said = losses.between(ExecutedStep(0, 1.0, 40.0), InterlockLimits())
    assert bool(said) is (share > 0.0)
    assert not said or re.search(r"45\.\d* samples/s, but its setting is 50", said)


def test_a_turn_that_a_stage_swallowed_is_not_done(tmp_path):
    with running(tmp_path, short_track()) as (rig, runner):
        jog, looks, swallowed = rig.table._jog, rig.table._now, []

        def once_lame(at_s, goal, rate_dps):
            if not swallowed and len(events(tmp_path, "step begins")) > 1:
                # The board says that it moves, and soon that it does not.
                swallowed.append(at_s)
                rig.table._state = "Jog"
                return
            jog(at_s, goal, rate_dps)

        def says_that_it_moves():
            now = runner.clock.now()
            return now if swallowed and now < swallowed[0] + 0.3 else looks()

        rig.table._jog, rig.table._now = once_lame, says_that_it_moves
        result = runner.run()
        assert (result.exit_status, len(swallowed)) == ("success", 1), result.reason
    (amiss,) = events(tmp_path, "not done")
    assert "and its target is" in amiss.data["why"]
    was_executed(tmp_path)


def test_attempts_that_the_run_refused_are_no_data():
    """The step 1 is refused while step 2 is under way, twice; the second time the run ends with that."""

    def step(number, time_s):
        begins = {"number": number, "begins_s": time_s, "data": True}
        return [Event(time_s, "step", {"number": number}), Event(time_s, "step begins", begins)]

    def refused(time_s):
        return [*step(1, time_s), *step(2, time_s + 10.0), Event(time_s + 10.4, "not done", {"number": 1, "why": ""})]

    first = [Event(0.0, "session", {"number": 0, "simulated": False, "wall_clock_s": 0.0}), *step(0, 10.0)]
    (ended,) = sessions_of([*first, *refused(20.0), *refused(40.0), Event(51.0, "ending", {})])
    assert ended.stretches() == [(10.0, 20.0)]
    assert ended.count("not done") == 2
    done = [*step(1, 40.0), *step(2, 50.0), Event(60.0, "ending", {})]
    (repeated,) = sessions_of([*first, *refused(20.0), *done])
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
        written.bytes_of("unit1", 1.0, b"a", received=True)
        assert began.wait(5.0)
        written.bytes_of("unit1", 2.0, b"b", received=True)
        end = time.monotonic() + 5.0
        while not written.problem and time.monotonic() < end:
            time.sleep(0.05)
        hangs.set()
        assert "the disk has not answered" in written.problem
    # What came before that was noticed is not lost if the disk answers again.
    assert [chunk.data for chunk in chunks_of(read_journal(tmp_path / "journal"), "unit1")] == [b"a", b"b"]


def test_a_disk_that_fills_ends_the_run_and_leaves_the_status_of_the_end(tmp_path, monkeypatch):
    with running(tmp_path, STANDS, limits=InterlockLimits(free_bytes=1 << 60)) as (_, runner):
        result = runner.run()
        assert result.exit_status == "aborted"
        assert "MB are free" in result.reason
    # The status file is written over, which needs no space.
    supervision.end_status(tmp_path, "x", [])
    with supervision.status_file(tmp_path, simulated=False) as change:
        change({"state": "running", "step": "a step with a longer name than the end has" * 9})
        time.sleep(0.5)
        assert read_status(tmp_path)["state"] == "running"

        def full(*_):
            raise OSError(errno.ENOSPC, "No space left on device")

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
                away = lambda rig=rig, runner=runner: rig.axis.spin(runner.clock.now(), 700.0, 1e5)  # noqa: E731
                mishap = partial(runner.clock.sleep, size) if what == "host" else away
                acting(runner, (once_turning(rig, runner), mishap))
            result = runner.run()
            assert result.verified_safe, (what, size, result)
            assert rig.axis.state(runner.clock.now())[1] == 0.0
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
