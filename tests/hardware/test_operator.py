"""An axis that somebody turns by hand: questions and answers, angles typed or read from an encoder, whole runs."""

import math
import os
import re
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
from hardware_bench import grbl_bench, served, unpredicted
from journal_log import angles_of_rests
from pexpect.fdpexpect import fdspawn
from simulated_devices.port_lab import SimulatedLab

from gradcal_jax.hardware.clock import RealClock, VirtualClock
from gradcal_jax.hardware.drivers import operator
from gradcal_jax.hardware.dry_run import dry_run_of
from gradcal_jax.hardware.errors import Disconnected, HardwareError, LimitExceeded
from gradcal_jax.hardware.execute import run
from gradcal_jax.hardware.journal import read_journal
from gradcal_jax.hardware.roles import AxisLimits, ChamberLimits
from gradcal_jax.hardware.setup import open_rig
from gradcal_jax.hardware.simulate.lab import SimulatedAxis, SimulatedPerson
from gradcal_jax.hardware.simulate.plants import AxisPlant, AxisTruth
from gradcal_jax.hardware.track import AxisCommand, Track, TrackStep, track_of
from gradcal_jax.hardware.transport import Terminal
from gradcal_jax.records import run_log
from gradcal_jax.records.log import ReadingKind
from gradcal_jax.spec import presets
from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.rig import parse_rig
from gradcal_jax.spec.spec import parse_spec
from gradcal_jax.tables.problems import SpecError
from gradcal_jax.tables.quantity import Quantity
from gradcal_jax.tables.writing import write_toml

ASKS = "let it come to rest and type the angle that its scale shows: "


# ------------------------------------------------------------------------------------------------------ the driver


class Person(SimulatedPerson):
    """Types `types(number, text)` in place of its answer of that number."""

    def __init__(self, clock, plant, types, **hand):
        super().__init__(clock, {"x": plant}, **hand)
        self.heard, self.typed, self._types = [], [], types

    def ask(self, question):
        self.heard.append(question)
        super().ask(question)

    def withdraw(self, why):
        self.heard.append(why)
        super().withdraw(why)

    def answer(self):
        if (answer := super().answer()) is None:
            return None
        self.typed.append(self._types(len(self.typed), answer[0]))
        return self.typed[-1], answer[1]


def gimbal(clock, types=lambda number, text: text, hand=None, **config):
    plant = AxisPlant(AxisTruth(reading_noise_deg=0.01), clock.now())
    person = Person(clock, plant, types, **(hand or {}))
    return operator.OperatorAxis(person, operator.OperatorConfig(**config), clock, "x"), person, plant


def settled(axis, clock):
    end = clock.now() + 600.0
    while (reading := axis.read()).moving:
        assert math.isnan(reading.position_deg)
        assert clock.now() < end
        clock.sleep(0.25)
    return reading.position_deg


def test_a_person_turns_and_types_what_the_dial_shows():
    clock = VirtualClock()
    axis, person, plant = gimbal(clock)
    axis.home()
    assert settled(axis, clock) == pytest.approx(plant.state(clock.now())[0], abs=0.05)
    for goal in (360.0, 0.0, -90.0):
        axis.move_to(goal, 72.0, 14.4)
        began = clock.now()
        angle = settled(axis, clock)
        # A typed angle is what the dial shows, not what was asked for; and it is one reading.
        assert angle == pytest.approx(plant.state(clock.now())[0], abs=0.05)
        assert angle != goal
        assert angle == pytest.approx(goal, abs=2.0)
        reading = axis.read()
        clock.sleep(5.0)
        assert axis.read() == reading
        assert began < reading.time_s < clock.now() - 4.9
    words = "x: turn by +360 deg in 10 s, to 360 deg; let it come to rest and type the angle"
    assert person.heard[1].startswith(words)
    assert axis.safe("hold").verified


def test_slips_are_asked_again_and_angles_far_from_the_goal_are_asked_once_more():
    clock = VirtualClock()
    slips = lambda number, text: text if number % 2 else text.replace(".", ",").replace("0", "o")  # noqa: E731
    axis, person, plant = gimbal(clock, slips, {"seed": 3})
    axis.home()
    settled(axis, clock)
    for goal in (90.0, 180.0, 270.0):
        axis.move_to(goal, 30.0, 10.0)
        assert settled(axis, clock) == pytest.approx(plant.state(clock.now())[0], abs=0.05)
    assert any("," in typed for typed in person.typed)
    assert any("is not understood" in heard for heard in person.heard)
    axis, person, plant = gimbal(clock, hand={"miss_deg": 0.001})
    axis.home()
    settled(axis, clock)
    axis.move_to(90.0, 30.0, 10.0)
    # Somebody misread the mark by ten degrees, says so twice, and is believed.
    clock.sleep(2.0)
    plant.move_to(clock.now() + 20.0, 80.0, 30.0, 200.0)
    person.answers_s = clock.now() + 25.0
    assert settled(axis, clock) == pytest.approx(80.0, abs=0.05)
    assert "differs by 10 deg from 90 deg; correct the angle, or type it again to confirm:" in person.heard[-1]


def test_a_question_is_taken_back_and_then_nobody_knows_the_angle():
    clock = VirtualClock()
    axis, person, _ = gimbal(clock, travel="400 deg")
    axis.home()
    settled(axis, clock)
    with pytest.raises(LimitExceeded, match="its travel is -400 to 400 deg"):
        axis.move_to(500.0, 30.0, 10.0)
    axis.move_to(360.0, 30.0, 10.0)
    clock.sleep(3.0)
    axis.stop()
    clock.sleep(60.0)
    assert person.heard[-1] == "x: cancelled: leave the axis where it is."
    reading = axis.read()
    assert math.isnan(reading.position_deg)
    assert reading.moving
    axis.move_to(0.0, 60.0, 60.0)
    # Without knowing where it stands nobody can say by how much.
    clock.sleep(0.5)
    assert person.heard[-1].startswith("x: turn to 0 deg; let it come to rest")
    assert settled(axis, clock) == pytest.approx(0.0, abs=2.0)


class TypesAtOnce:
    def receive(self, data):
        return [b"1 deg\r\n", b"nobody asked\r\n"]


def test_a_console_has_one_answer_a_question_and_says_that_its_port_is_gone():
    clock = VirtualClock()
    with served(TypesAtOnce(), clock, 9600) as (_, line):
        console = operator.Console(line, clock)
        console.ask("x: type it:")
        clock.sleep(1.0)
        answer = console.answer()
        assert answer[0] == "1 deg"
        assert console.answer() is None
        line.close()
        clock.sleep(1.0)
        with pytest.raises(Disconnected):
            console.answer()


def test_an_encoder_is_read_and_its_motor_is_left_alone():
    with grbl_bench() as (encoder, board, _, clock):
        # The encoder's zero lies two turns away from where the gimbal's mark is.
        plant = board.plant = AxisPlant(AxisTruth(reading_noise_deg=0.001), clock.now())
        plant.set_zero(clock.now(), 720.0)
        person = SimulatedPerson(clock, {"x": plant})
        axis = operator.OperatorAxis(person, operator.OperatorConfig(), clock, "x", encoder)
        axis.home()
        while axis.read().moving:
            clock.sleep(0.25)
        axis.move_to(360.0, 60.0, 30.0)
        readings = [axis.read()]
        while readings[-1].moving:
            clock.sleep(0.25)
            readings.append(axis.read())
        # Read on the move as well as at rest, in turns from the zero mark.
        assert any(100.0 < r.position_deg < 250.0 for r in readings)
        assert readings[-1].position_deg == pytest.approx(360.0, abs=2.0)
        assert readings[-1].position_deg == pytest.approx(plant.state(clock.now())[0], abs=0.01)
        axis.stop()
        axis.safe("hold")
    # Questions, and no command that moves or changes anything.
    assert set(board.lines) <= {"$I", "$$"}


def test_what_is_typed_without_a_dial_is_asked_again():
    clock = VirtualClock()
    axis, person, _ = gimbal(clock, types=lambda number, text: text or "90 deg", angle="none")
    axis.move_to(90.0, 72.0, 14.4)
    end = clock.now() + 60.0
    while not any("press Enter when" in heard for heard in person.heard):
        assert clock.now() < end
        assert axis.read().moving
        clock.sleep(0.25)


def test_in_a_rehearsal_a_motor_stops_off_its_goal_and_its_reading_does_not_show_it():
    clock = VirtualClock()
    plant = AxisPlant(None, clock.now())
    motor = SimulatedAxis(plant, clock, AxisLimits(300.0, 400.0, None, None, 0.01, told=True))
    with clock.party():
        motor.home()
        motor.move_to(90.0, 60.0, 60.0)
        clock.sleep(10.0)
        assert motor.read().position_deg == pytest.approx(90.0, abs=0.02)
        assert 0.05 < abs(plant.state(clock.now())[0] - 90.0) < 20.0


# -------------------------------------------------------------------------------------------------------- rig files

BY_HAND = """
format = "gradcal-rig/1"
[[axis]]
name = "x"
driver = "operator"
port = "terminal"
safe = "hold"
gravity_loaded = false
"""


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("gravity_loaded = false", "gravity_loaded = true"), "gravity turns this axis if nothing holds it"),
        (('driver = "operator"', 'driver = "lines"'), '"terminal" is only for the driver "operator"'),
        (
            ("gravity_loaded = false", 'gravity_loaded = false\nencoder = { driver = "operator", port = "/dev/a" }'),
            "an encoder is only for",
        ),
        (
            (
                'port = "terminal"',
                'port = "/dev/a"\nencoder = { driver = "lines", port = "/dev/a" }',
            ),
            "two devices use this port",
        ),
    ],
)
def test_what_a_person_cannot_be_is_refused(change, said):
    with pytest.raises(SpecError, match=re.escape(said)):
        parse_rig(BY_HAND.replace(*change))


def test_nobody_there_is_said_before_anything_begins(tmp_path):
    rig = parse_rig(BY_HAND)
    with pytest.raises(ValueError, match="axis x is turned by the operator, who is asked at the terminal, but"):
        run(hand_recipe(), tmp_path / "run", rig=rig)
    assert not (tmp_path / "run").exists()
    # Asked what it is, it answers; making it safe asks nobody.
    with open_rig(rig, VirtualClock()) as bench:
        axis = bench.axes["x"]
        assert axis.identify().driver == "operator"
        assert axis.safe("hold").verified
        with pytest.raises(HardwareError, match="no terminal at which to ask the operator"):
            axis.home()
        spin = AxisCommand(0.0, "x", "spin", rate_dps=10.0, acceleration_dps2=10.0)
        (problem,) = dry_run_of(Track((TrackStep("rates", 5.0, moves=(spin,)),)), {"x": axis.limits()}).problems
    assert "but is turned by hand" in problem


# -------------------------------------------------------------------------------------------------------- whole runs


def moves_by_hand(rest, turn):
    """There and back, with rests that nobody reads."""
    rests = {"rest": rest, "read_every": "none"}
    there, back = ({"turn": way, "duration": turn, "shape": "hand"} for way in ("360 deg", "-360 deg"))
    return [rests, there, rests, back, rests]


def hand_recipe(**more):
    """Of the preset whose gimbal is moved by hand: a minute of it, its angles typed."""
    keys = {
        "plan.temperature": ["23 degC", "25 degC"],
        "plan.gradient": "1 K/min",
        "plan.soak": "2 s",
        "plan.cycle.moves": moves_by_hand("6 s", "8 s"),
        "plan.cycle.other_axes": {"duration": "20 s"},
        "rig.table.answer_time": "0 s",
        "rig.table.axis[0].angle.read_every": "rest",
        "requirement": None,
    }
    return unpredicted(changed(parse_spec(presets.text("rig-hand")), keys | more))


QUICK = {
    "rig.table.axis[0].max_rate": "200 deg/s",
    "plan.cycle.moves": moves_by_hand("1 s", "6 s"),
    "plan.temperature": ["23 degC", "23.3 degC"],
    "plan.cycle.other_axes": None,
}
READ_AT_REST = [
    move | ({"read_every": "1 s"} if "rest" in move else {})
    for move in ({"rest": "6 s"}, {"turn": "360 deg", "duration": "8 s", "shape": "hand"}, {"rest": "6 s"})
]


def readings_of_rests(folder, made):
    """Of a simulated run's log: how many planned readings each standstill has."""
    assert run(made, folder, simulate=True, seed=3).exit_status == "success"
    log = run_log.log(folder)
    rows = log.readings.of_axis(0, ReadingKind.PLANNED).row
    angles = (np.degrees(angles_of_rests(log)) + 180.0) % 360.0 - 180.0
    # Every rest keeps its length, however late somebody was; nobody hits the mark exactly.
    assert np.bincount(log.standstill + 1)[1:].min() >= 5.8 * 125.0
    assert np.all((np.abs(angles) > 0.0) & (np.abs(angles) < 2.0))
    return np.bincount(log.standstill[rows] + 1)[1:].tolist()


def test_a_log_has_the_readings_that_the_plan_counts(tmp_path):
    """One typed angle in each rest; with an encoder one each second besides, also of the time that no cycle fills."""
    typed = hand_recipe()
    assert readings_of_rests(tmp_path / "typed", typed) == [1] * (2 * typed.motion[0].repeat + 1)
    others = {"duration": "20 s", "read_every": "1 s"}
    keys = {"plan.cycle.moves": READ_AT_REST, "plan.cycle.other_axes": others, "rig.table.answer_time": "4 s"}
    keys |= {"rig.table.axis[0].angle.read_every": "1 s"}
    first, *middle, _ = readings_of_rests(tmp_path / "encoder", hand_recipe(**keys))
    assert first >= 6
    # Somebody who is late has less time for other axes.
    assert middle == pytest.approx([1 + 6 + 20 + 6] * len(middle), abs=5)


def test_an_axis_whose_angle_is_typed_is_not_read_at_rest():
    typed = AxisLimits(120.0, 200.0, None, None, 0.01, by_hand=True, typed=True)
    track, chamber = (
        track_of(hand_recipe(**{"plan.cycle.moves": READ_AT_REST}), ["x"]),
        ChamberLimits(-50.0, 90.0, True),
    )
    assert not dry_run_of(track, {"chamber": chamber, "x": replace(typed, typed=False)}).problems
    assert not dry_run_of(track_of(hand_recipe(), ["x"]), {"chamber": chamber, "x": typed}).problems
    (problem,) = dry_run_of(track, {"chamber": chamber, "x": typed}).problems
    assert "types its angle only once: add an [axis.encoder]" in problem


# The terminal is the one that Ctrl-C is typed at.
PROGRAM = """
import fcntl, sys, termios
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
from gradcal_jax.cli import main
sys.exit(main())
"""


@pytest.mark.long
def test_somebody_at_the_terminal_of_gradcal_run(tmp_path):
    """Chamber and sensor in real time; who turns the gimbal is the test."""
    folder, made = tmp_path / "run", hand_recipe(**QUICK)
    stability = made.stability.model_copy(update={"for_at_least": Quantity.read("1 s", "time")})
    write_toml(made.model_copy(update={"stability": stability}), tmp_path / "recipe.toml")
    with SimulatedLab(made.spec, RealClock()) as lab:
        plant = lab.axis_plants[0]
        write_toml(lab.rig, tmp_path / "rig.toml")
        words = [sys.executable, "-c", PROGRAM, "run", "recipe.toml", "--rig", "rig.toml", "-o", str(folder)]
        master, slave = os.openpty()
        process = subprocess.Popen(words, stdin=slave, stdout=slave, stderr=slave, cwd=tmp_path, start_new_session=True)
        os.close(slave)
        terminal = fdspawn(master, encoding="utf-8", timeout=60)
        terminal.expect_exact("press Enter to begin; type anything else to end without a run: ")
        terminal.send("\n")
        terminal.expect_exact(f"x: bring it to its zero mark; {ASKS}")
        terminal.send("o.02 deg\n")
        terminal.expect_exact("expected an angle such as '0.05 deg'. Type the angle that its scale shows: ")
        terminal.send("0.02 deg\n")
        terminal.expect_exact(f"\ax: turn by +360 deg in 6 s, to 360 deg; {ASKS}")
        plant.move_to(time.monotonic(), 360.4, 480.0, 1900.0)
        time.sleep(1.2)
        terminal.send("0.3")
        # Nothing is drawn over what somebody is typing.
        time.sleep(6.0)
        terminal.send("8 deg\n")
        terminal.expect_exact("x: turn by -360 deg in 6 s, to 0 deg")
        assert terminal.before.replace("\r", "").startswith("0.38 deg\n")
        # Who types nothing can still end the run.
        terminal.send("\x03")
        terminal.expect_exact("x: cancelled: leave the axis where it is.")
        terminal.expect_exact("chamber: safe (standby")
        terminal.expect_exact("gradcal run --resume")
        assert process.wait(timeout=60.0) == 130
        terminal.close()
    angles = [e.data["position_deg"] for e in read_journal(folder / "journal").events if e.name == "angle"]
    assert np.round(angles, 3).tolist() == [0.02, 360.38]


def test_a_terminal_hands_on_whole_lines():
    master, slave = os.openpty()
    with os.fdopen(slave, "w") as screen:
        terminal = Terminal(keyboard=slave, screen=screen)
        assert terminal.read_stamped(0.01)[0] == b""
        terminal.write(b"\ax: type it: ")
        assert terminal.asking
        os.write(master, b"1 de")
        assert terminal.read_stamped(0.05)[0] == b""
        os.write(master, b"g\n")
        assert terminal.read_stamped(2.0)[0] == b"1 deg\n"
        assert not terminal.asking
        os.write(master, b"\x04")
        with pytest.raises(Disconnected, match="the operator cannot be asked"):
            terminal.read_stamped(2.0)
    os.close(master)
