"""Limits hold in every state of a run: a heater that is welded on, a chamber that stops, a pause that nobody ends, a
jammed axis. The plants do what the faults do; the devices keep the state that their firmware has."""

import math
import re
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hardware_bench import Rig, once, short_recipe
from simulated_devices.line_clock import LineClock

from gradcal_jax.cli import main
from gradcal_jax.hardware.clock import RealClock
from gradcal_jax.hardware.execute import limits_of
from gradcal_jax.hardware.interlocks import RULES, InterlockLimits, InterlockRule, Interlocks, Situation
from gradcal_jax.hardware.journal import Event, Journal, read_journal
from gradcal_jax.hardware.roles import ChamberReading
from gradcal_jax.hardware.runner import Runner, RunProgress, RunState
from gradcal_jax.hardware.setup import configs_of, only_of, open_rig
from gradcal_jax.hardware.track import AxisCommand, Course, Stable, Track, TrackStep
from gradcal_jax.spec.rig import TEMPLATE, parse_rig, rig_of
from gradcal_jax.tables.problems import SpecError
from gradcal_jax.tables.writing import write_toml

READY = Stable(0.5, 20.0, 7200.0)
HOT = Track((TrackStep("hot", 300.0, 40.0, READY),))
WARMS = Track((TrackStep("ramp", 500.0, 26.0, READY, (Course(0.0, 36.0, 1.5),)),))
STANDS = Track((TrackStep("stand", 600.0),))


@contextmanager
def lab(
    folder: Path, track: Track, limits: InterlockLimits | None = None, *, attended: bool = False
) -> Iterator[tuple[Rig, Runner]]:
    clock = LineClock()
    with Rig(clock, burst_s=1.024) as rig, Journal(folder / "journal") as journal:
        # Hours of pause go by: without the unit's stream, which has no part in any of this.
        rules = Interlocks(limits or InterlockLimits())
        with open_rig(only_of(rig.rig, {"chamber", "table"}), clock) as bench:
            more: dict[str, Any] = {"safe_deadline_s": 10.0, "wait_when_paused": attended}
            yield rig, Runner(track, bench, journal, clock, rules, **more)


def events(folder: Path, name: str) -> list[Event]:
    return [event for event in read_journal(folder / "journal").events if event.name == name]


def air_when_safe_c(folder: Path, rig: Rig) -> float:
    """Temperature of the air when the run had made the chamber safe: the clock, and a welded heater, run on after."""
    (safe,) = [event for event in events(folder, "made safe") if event.data["device"] == "chamber"]
    assert safe.time_s >= events(folder, "ending")[-1].time_s > 0.0
    return float(rig.chamber.plant.load_at(np.array([safe.time_s]))[0])


def pause_by_rule(runner: Runner, after_s: float = 30.0) -> None:
    """A further rule of the run pauses it once, in a step that lasts so long."""
    begun: list[float] = []

    def wrong(bounds: InterlockLimits, now: Situation) -> str:
        begun[:] = begun or [now.time_s]
        return "something is amiss" if now.time_s > begun[0] + after_s else ""

    runner.interlocks.rules = (*runner.interlocks.rules, InterlockRule("amiss", "pause", 0.0, wrong))


def weld_on(rig: Rig, k_per_min: float = 6.0) -> None:
    """The heater's contactor is welded: the air warms whatever the controller says."""
    plant = rig.chamber.plant

    def heats(step_s: float) -> None:
        plant._air_c += k_per_min / 60.0 * step_s
        plant._load_c = plant._air_c

    plant._step = heats


def after(runner: Runner, seconds: float, act: Callable[[], Any]) -> None:
    """Act so long after now, or after the run's start, from another thread that waits on its clock."""

    def wait() -> None:
        with runner.clock.party():
            begun.set()
            end = runner.clock.now() + seconds
            while runner.clock.now() < end:
                runner.clock.sleep(min(5.0, end - runner.clock.now()))
                if runner.state in (RunState.SAFE, RunState.FAILED):
                    return
            act()

    begun = threading.Event()
    prepare = runner._prepare

    def start(*helpers: Any) -> None:
        threading.Thread(target=wait, daemon=True).start()
        begun.wait()
        prepare(*helpers)

    if runner.state is RunState.IDLE:
        runner._prepare = start
    else:
        threading.Thread(target=wait, daemon=True).start()


# ---------------------------------------------------------------------------------------------- temperatures


@pytest.mark.parametrize("state", ["homing", "stabilising", "running", "paused by a request", "paused by a rule"])
def test_air_that_leaves_the_limits_of_the_rig_ends_a_run_in_every_state(tmp_path: Path, state: str) -> None:
    # The other rules of temperature are off: this one holds alone.
    # Homing waits for the board at the pace of the computer's clock: it has the less far to go.
    highest_c = 30.0 if state == "homing" else 60.0
    limits = InterlockLimits(temperature_band_k=math.inf, never_above_c=highest_c)
    turns = TrackStep("turn", 10.0, moves=(AxisCommand(0.0, "table", "turn", 10.0, 60.0, 60.0),))
    track = {"homing": Track((turns,)), "stabilising": HOT}.get(state, STANDS)
    with lab(tmp_path, track, limits, attended=True) as (rig, runner):
        if state == "homing":
            rig.axis.set_zero(runner.clock.now(), 100.0)
            rig.table.homing_s = 100.0
            weld_on(rig, 60.0)
        elif state == "stabilising":
            once(runner, lambda progress: progress.step_left_s is None, lambda: weld_on(rig))
        elif state == "running":
            once(runner, lambda progress: progress.step_left_s is not None, lambda: weld_on(rig))
        elif state == "paused by a request":
            after(runner, 30.0, lambda: runner.request("pause"))
            once(runner, lambda progress: progress.state is RunState.PAUSED, lambda: weld_on(rig))
        else:
            pause_by_rule(runner)
            once(runner, lambda progress: progress.state is RunState.PAUSED, lambda: weld_on(rig))
        # Without the rule it would be tested for hours: the run is ended from outside.
        after(runner, 3600.0, lambda: runner.request("abort", "nothing ended it"))
        result = runner.run()
        assert result.exit_status == "aborted"
        assert "Interlock 'temperature limit'" in result.reason
        assert result.verified_safe
        assert not rig.chamber.plant.conditioning
        assert air_when_safe_c(tmp_path, rig) < highest_c + (10.0 if state == "homing" else 3.0)


def test_without_limits_in_the_rig_file_the_chambers_own_hold(tmp_path: Path) -> None:
    limits = InterlockLimits(longest_pause_s=1e9)
    with lab(tmp_path, STANDS, limits, attended=True) as (rig, runner):
        rig.chamber.options.high_c = 70.0
        after(runner, 30.0, lambda: runner.request("pause"))
        once(runner, lambda progress: progress.state is RunState.PAUSED, lambda: weld_on(rig))
        after(runner, 7200.0, lambda: runner.request("abort", "nothing ended it"))
        result = runner.run()
        assert "its limits are -53 to 73 degC" in result.reason
        assert air_when_safe_c(tmp_path, rig) < 75.0


def test_a_load_that_leaves_the_limits_counts_too() -> None:
    rules = Interlocks(InterlockLimits(never_below_c=-40.0))
    reading = ChamberReading(0.0, -30.0, -41.0, -30.0, "RUN", True, ())
    tripped = rules.check(Situation(0.0, reading, {}, {}, 1 << 40, None, {}))
    assert tripped is not None
    assert "the load is at -41.0 degC" in tripped[1]


def test_a_heater_welded_on_while_the_run_waits_is_noticed_by_the_approach(tmp_path: Path) -> None:
    with lab(tmp_path, HOT) as (rig, runner):
        once(runner, lambda progress: progress.chamber is not None and progress.chamber.air_c > 35.0,
             lambda: weld_on(rig))  # fmt: skip
        after(runner, 3600.0, lambda: runner.request("abort", "nothing ended it"))
        result = runner.run()
        assert "Interlock 'temperature course': the air is at" in result.reason
        assert result.verified_safe
        # Ten per cent of the way and the band above the goal, and half a minute.
        assert air_when_safe_c(tmp_path, rig) < 40.0 + 1.6 + 3.0 + 3.0 + 1.0


def test_a_heater_welded_on_in_the_last_seconds_is_no_success(tmp_path: Path) -> None:
    with lab(tmp_path, HOT) as (rig, runner):
        ends = lambda progress: progress.step_left_s is not None and progress.step_left_s < 25.0  # noqa: E731
        once(runner, ends, lambda: weld_on(rig, 30.0))
        result = runner.run()
    assert result.exit_status == "aborted"
    assert "Interlock 'temperature course': the air is at" in result.reason
    assert result.verified_safe


def test_a_heater_welded_on_in_an_attended_pause_ends_the_run(tmp_path: Path) -> None:
    alarms: list[str] = []
    with lab(tmp_path, HOT, attended=True) as (rig, runner):
        runner.on_alarm = alarms.append
        once(runner, lambda progress: progress.step_left_s is not None and progress.step_left_s < 250.0,
             lambda: weld_on(rig))  # fmt: skip
        after(runner, 7200.0, lambda: runner.request("abort", "nothing ended it"))
        result = runner.run()
        assert "Interlock 'temperature in a pause': the air is at" in result.reason
        assert result.verified_safe
        assert air_when_safe_c(tmp_path, rig) < 55.0
    assert len(alarms) == 2
    assert [event.data["rule"] for event in events(tmp_path, "interlock")] == [
        "temperature course", "temperature in a pause"
    ]  # fmt: skip


@pytest.mark.long
def test_a_door_that_is_opened_in_a_pause_ends_nothing(tmp_path: Path) -> None:
    with lab(tmp_path, HOT, attended=True) as (rig, runner):

        def open_door() -> None:
            runner.request("pause", "something rattles")
            plant, step = rig.chamber.plant, rig.chamber.plant._step
            plant._step = lambda step_s: setattr(plant, "_air_c", 22.0)

            def close() -> None:
                plant._step = step
                runner.request("resume")

            after(runner, 900.0, close)

        once(runner, lambda progress: progress.step_left_s is not None and progress.step_left_s < 250.0, open_door)
        assert runner.run().exit_status == "success"
    assert events(tmp_path, "interlock") == []


@pytest.mark.parametrize("fate", ["no power", "STANDBY at the panel"])
@pytest.mark.parametrize("when", ["stabilising", "running"])
def test_a_chamber_that_was_commanded_to_condition_and_does_not_pauses_the_run(
    tmp_path: Path, fate: str, when: str
) -> None:
    # A wide band: the temperature says nothing for long.
    track = HOT if when == "stabilising" else WARMS
    with lab(tmp_path, track, InterlockLimits(temperature_band_k=30.0), attended=True) as (rig, runner):
        why: list[str] = []
        commands: list[list[str]] = []

        def fail() -> None:
            commands.append(rig.chamber.commands)
            commands[0].clear()
            rig.chamber.reboot() if fate == "no power" else rig.chamber._enter("STANDBY")

        def is_so(progress: RunProgress) -> bool:
            waits = progress.step_left_s is None
            warm = progress.chamber is not None and progress.chamber.air_c > 30.0
            return warm and (waits if when == "stabilising" else not waits)

        def paused() -> None:
            while runner.state is not RunState.PAUSED:
                runner.clock.sleep(1.0)
            why.append(runner._why)
            runner.clock.sleep(60.0)
            # Nobody but the operator has started it again.
            commands[0] = list(commands[0])
            runner.request("resume")

        once(runner, is_so, fail)
        after(runner, 1.0, paused)
        # It is commanded again when the run goes on, though its set point is the one of before.
        assert runner.run().exit_status == "success"
    (tripped,) = events(tmp_path, "interlock")
    assert tripped.data["rule"] == "idle chamber"
    assert "the chamber is off, and this run did not switch it off: mode" in why[0]
    assert not [command for command in commands[0] if "CONSTANT" in command]


def test_a_pause_that_nobody_ends_ends_the_run(tmp_path: Path) -> None:
    alarms: list[tuple[float, str]] = []
    with lab(tmp_path, STANDS, attended=True) as (_, runner):
        runner.on_alarm = lambda text: alarms.append((runner.clock.now(), text))
        pause_by_rule(runner)
        after(runner, 3 * 3600.0, lambda: runner.request("abort", "nothing ended it"))
        result = runner.run()
        assert result.exit_status == "aborted"
        assert "paused for 30 min and nobody has resumed it" in result.reason
        assert result.verified_safe
    (paused, *_) = (event for event in events(tmp_path, "state") if event.data["state"] == "paused")
    (ended,) = events(tmp_path, "ending")
    assert ended.time_s - paused.time_s == pytest.approx(1800.0, abs=2.0)
    # One when it paused, and one every five minutes; at half an hour the last of these may come before the end's own.
    assert len([at_s for at_s, _ in alarms if at_s < ended.time_s - 60.0]) == 6
    assert len(alarms) in (7, 8)
    assert "still paused. Interlock 'amiss': something is amiss" in alarms[1][1]


@pytest.mark.long
def test_a_pause_that_was_asked_for_may_last(tmp_path: Path) -> None:
    with lab(tmp_path, STANDS, attended=True) as (_, runner):
        after(runner, 60.0, lambda: runner.request("pause"))
        after(runner, 2400.0, lambda: runner.request("resume"))
        assert runner.run().exit_status == "success"


def test_limits_of_the_rig_file_reach_the_run_and_its_dry_run(tmp_path: Path, capsys) -> None:
    chamber = {
        "driver": "lines",
        "options": {"protocol": "espec"},
        "port": "COM1",
        "safe": "standby",
        "never_above": "80 degC",
        "never_below": "-45 degC",
    }
    rig = rig_of({"format": "gradcal-rig/1", "longest_pause": "10 min", "chamber": chamber | {"ambient": "21 degC"}})
    found = limits_of(rig)
    assert (found.never_above_c, found.never_below_c, found.room_c) == pytest.approx((80.0, -45.0, 21.0))
    assert found.longest_pause_s == 600.0
    with pytest.raises(SpecError, match="never_above"):
        rig_of({"format": "gradcal-rig/1", "chamber": chamber | {"never_above": "10 degC"}})
    with Rig(RealClock()) as lab_:
        tables = lab_.rig.model_dump(mode="json", exclude_unset=True)
        tables["chamber"]["never_above"] = "26 degC"
        write_toml(rig_of(tables), tmp_path / "rig.toml")
        write_toml(
            short_recipe(changes={"rig.table.axis[0].max_acceleration": "300 deg/s^2"}), tmp_path / "recipe.toml"
        )
        words = ["run", str(tmp_path / "recipe.toml"), "--rig", str(tmp_path / "rig.toml"), "--dry-run"]
        assert main(words) != 0
        assert "sets 28 degC; the chamber accepts -50 to 26" in capsys.readouterr().out


# ------------------------------------------------------------------------------------- safe states that can be taken


UNSWITCHED = 'options = { protocol = "watlow-f4", changes = { tell = { on = false, off = false } } }'
WITHOUT = {
    "an F4 whose plant is not switched": (
        f'[chamber]\ndriver = "registers"\nport = "COM1"\nsafe = "standby"\n{UNSWITCHED}\n',
                                          "no [tell] on and off"),
    "an axis in lines without off": ('[[axis]]\nname = "a"\ndriver = "lines"\nport = "COM1"\nsafe = "unpower"\n'
                                     'gravity_loaded = false\noptions = { protocol = "grbl" }\n', "lacks [tell.off]"),
}  # fmt: skip


@pytest.mark.parametrize("what", sorted(WITHOUT))
def test_a_safe_state_that_a_device_cannot_take_is_refused_before_anything(what: str, tmp_path: Path, capsys) -> None:
    text, words = WITHOUT[what]
    (tmp_path / "rig.toml").write_text('format = "gradcal-rig/1"\n' + text)
    # Not that nobody answers: nobody is asked.
    assert main(["rig", "check", str(tmp_path / "rig.toml")]) == 2
    said = capsys.readouterr().err
    assert "this device does not support this safe state" in said
    assert words in said
    write_toml(short_recipe(), tmp_path / "recipe.toml")
    run = [
        "run",
        str(tmp_path / "recipe.toml"),
        "--rig",
        str(tmp_path / "rig.toml"),
        "-o",
        str(tmp_path / "run"),
        "--yes",
    ]
    assert main(run) == 2
    assert words in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_an_f4_that_cannot_be_switched_off_may_be_held() -> None:
    text = TEMPLATE.replace('driver  = "lines"', f'driver = "registers"\n{UNSWITCHED}', 1)
    text = re.sub(r"\[chamber.options\].*\nprotocol.*", "", text)
    with pytest.raises(SpecError, match=r"no \[tell\] on and off"):
        configs_of(parse_rig(text))
    configs_of(parse_rig(text.replace('safe    = "standby"', 'safe    = "hold"   ')))
    configs_of(parse_rig(text.replace(UNSWITCHED, 'options = { protocol = "watlow-f4" }')))


# ----------------------------------------------------------------------------------------------------------- axes


def test_a_jammed_axis_is_said_to_stand_and_is_not_pushed_for_long(tmp_path: Path) -> None:
    """The table is held at 81.9 deg in mid-turn: the controller goes on pushing, its loop of position not closed."""
    moves = (AxisCommand(0.0, "table", "turn", 3600.0, 150.0, 300.0),)
    with lab(tmp_path, Track((TrackStep("turn", 60.0, moves=moves),))) as (rig, runner):
        jammed: list[float] = []

        def jam() -> None:
            jammed.append(runner.clock.now())
            rig.axis.set_zero(runner.clock.now(), 81.9)
            rig.axis.move_to = lambda *_: None
            # It pushes until it is stopped.
            rig.axis.moving = lambda _: True
            rig.axis.spin = lambda *_: setattr(rig.axis, "moving", lambda _: False)

        def in_the_turn(progress: RunProgress) -> bool:
            # Not in the search for the reference.
            return progress.step_left_s is not None and abs(rig.axis.state(runner.clock.now())[1]) > 100.0

        once(runner, in_the_turn, jam)
        result = runner.run()
        assert result.exit_status == "aborted"
        assert "axis table has been at 81.9 deg" in result.reason
        assert "deg now: it is blocked" in result.reason
        assert result.verified_safe
    (ended,) = events(tmp_path, "ending")
    # Long before the planned end of the turn.
    assert 4.0 <= ended.time_s - jammed[0] < 7.0


def test_a_pause_in_a_turn_is_no_overspeed(tmp_path: Path) -> None:
    moves = (AxisCommand(0.0, "table", "turn", rate_dps=150.0, acceleration_dps2=300.0, angle_deg=3600.0),)
    with lab(tmp_path, Track((TrackStep("turn", 60.0, moves=moves),)), attended=True) as (_, runner):
        amiss: list[float] = []

        def wrong(bounds: InterlockLimits, now: Situation) -> str:
            turns = abs(now.axes["table"].rate_dps) > 100.0 if "table" in now.axes else False
            if turns and not amiss:
                amiss.append(now.time_s)
                return "something is amiss"
            return ""

        runner.interlocks = Interlocks(rules=(*RULES, InterlockRule("amiss", "pause", 0.0, wrong)))

        def go_on() -> None:
            while runner.state is not RunState.PAUSED:
                runner.clock.sleep(1.0)
            runner.clock.sleep(30.0)
            runner.request("resume")

        after(runner, 1.0, go_on)
        result = runner.run()
        assert result.exit_status == "success", result.reason
        assert [event.data["rule"] for event in events(tmp_path, "interlock")] == ["amiss"]


def test_an_endless_axis_goes_on_at_the_nearest_equal_angle(tmp_path: Path) -> None:
    """Rates of the standard method turn an axis many times round; a pause unwinds nothing."""
    spin = AxisCommand(0.0, "table", "spin", rate_dps=150.0, acceleration_dps2=300.0)
    track = Track((TrackStep("rate 1", 300.0, moves=(spin,), start_deg={"table": 0.0}),))
    with lab(tmp_path, track, attended=True) as (rig, runner):
        turned: list[float] = []

        def pause() -> None:
            runner.request("pause")
            runner.clock.sleep(30.0)
            turned.append(rig.axis.state(runner.clock.now())[0])
            runner.request("resume")

        after(runner, 250.0, pause)
        result = runner.run()
        assert result.exit_status == "success", result.reason
    (goes,) = (event.data for event in events(tmp_path, "move") if event.data["kind"] == "go")
    assert turned[0] > 30000.0
    assert abs(goes["position_deg"] - turned[0]) <= 180.0
    assert goes["position_deg"] % 360.0 == pytest.approx(0.0, abs=1e-9)
