"""An axis that somebody turns by hand: questions and answers, angles typed or read from an encoder, whole runs."""

import contextlib
import math
import os
import re
import select
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hardware_bench import served, unpredicted
from journal_log import angles_of_rests
from simulated_devices.line_tables import SimulatedGrbl
from simulated_devices.operator import SimulatedOperator
from simulated_devices.port_lab import SimulatedLab

from gradcal_jax.hardware.axis_control import AxisControl
from gradcal_jax.hardware.clock import Clock, RealClock, VirtualClock
from gradcal_jax.hardware.drivers import lines, operator
from gradcal_jax.hardware.dry_run import dry_run_of
from gradcal_jax.hardware.errors import Disconnected, HardwareError, LimitExceeded
from gradcal_jax.hardware.execute import run
from gradcal_jax.hardware.journal import read_journal
from gradcal_jax.hardware.roles import AxisLimits, ChamberLimits
from gradcal_jax.hardware.setup import open_rig
from gradcal_jax.hardware.simulate.lab import SimulatedHand, SimulatedPerson
from gradcal_jax.hardware.simulate.plants import AxisPlant, AxisTruth
from gradcal_jax.hardware.track import AxisCommand, Track, TrackStep, track_of
from gradcal_jax.hardware.transport import Terminal
from gradcal_jax.recipe.recipe import Recipe
from gradcal_jax.records import run_log
from gradcal_jax.records.log import ReadingKind
from gradcal_jax.spec import presets
from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.rig import parse_rig
from gradcal_jax.spec.spec import parse_spec
from gradcal_jax.tables.problems import SpecError
from gradcal_jax.tables.quantity import Quantity
from gradcal_jax.tables.writing import to_toml, write_toml

ASKS = "let it come to rest and type the angle that its scale shows: "


# ------------------------------------------------------------------------------------------------------ the driver


@contextlib.contextmanager
def gimbal(
    clock: Clock, hand: SimulatedHand | None = None, slips: float = 0.0, **config: str
) -> Iterator[tuple[operator.OperatorAxis, SimulatedOperator, AxisPlant]]:
    plant = AxisPlant(AxisTruth(reading_noise_deg=0.01), clock.now())
    person = SimulatedOperator({"x": plant}, clock, hand, slips=slips)
    settings = operator.OperatorConfig(**config)  # type: ignore[arg-type]
    with served(person, clock, 9600) as (_, transport):
        console = settings.link(transport, clock)
        yield operator.OperatorAxis(console, settings, clock, "x"), person, plant


def settled(axis: operator.OperatorAxis, clock: Clock) -> float:
    end = clock.now() + 600.0
    while (reading := axis.read()).moving:
        assert math.isnan(reading.position_deg)
        assert clock.now() < end
        clock.sleep(0.25)
    return reading.position_deg


def test_a_person_turns_and_types_what_the_dial_shows() -> None:
    clock = VirtualClock()
    with gimbal(clock) as (axis, person, plant):
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


def test_slips_are_asked_again_and_angles_far_from_the_goal_are_asked_once_more() -> None:
    clock = VirtualClock()
    with gimbal(clock, SimulatedHand(3), slips=0.6) as (axis, person, plant):
        axis.home()
        settled(axis, clock)
        for goal in (90.0, 180.0, 270.0):
            axis.move_to(goal, 30.0, 10.0)
            assert settled(axis, clock) == pytest.approx(plant.state(clock.now())[0], abs=0.05)
        assert sum("," in typed for typed in person.typed) > 0
        assert sum("is not understood" in heard for heard in person.heard) > 0
    with gimbal(clock, SimulatedHand(miss_deg=0.001)) as (axis, person, plant):
        axis.home()
        settled(axis, clock)
        axis.move_to(90.0, 30.0, 10.0)
        # Somebody misread the mark by ten degrees, says so twice, and is believed.
        clock.sleep(2.0)
        plant.turn_by_hand(clock.now() + 20.0, 80.0, 0.5)
        person.person.answers_s = clock.now() + 25.0
        assert settled(axis, clock) == pytest.approx(80.0, abs=0.05)
        assert "differs by 10 deg from 90 deg; correct the angle, or type it again to confirm:" in person.heard[-1]


def test_a_question_is_taken_back_and_then_nobody_knows_the_angle() -> None:
    clock = VirtualClock()
    with gimbal(clock, travel="400 deg") as (axis, person, _):
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


def test_a_port_that_is_gone_is_said() -> None:
    clock = VirtualClock()
    with gimbal(clock) as (axis, _, _):
        axis.home()
        settled(axis, clock)
        axis.move_to(10.0, 30.0, 10.0)
        axis._console._line.close()  # type: ignore[attr-defined]
        end = time.monotonic() + 5.0
        with pytest.raises(Disconnected):
            axis.home()
        assert time.monotonic() < end


def test_an_encoder_is_read_and_its_motor_is_left_alone() -> None:
    clock = VirtualClock()
    # The encoder's zero lies two turns away from where the gimbal's mark is.
    plant = AxisPlant(AxisTruth(reading_noise_deg=0.001), clock.now())
    plant.set_zero(clock.now(), 720.0)
    board = SimulatedGrbl(plant, clock)
    person = SimulatedOperator({"x": plant}, clock)
    with served(person, clock, 9600) as (_, text), served(board, clock, 115200) as (_, line):
        settings = lines.LinesConfig(protocol="grbl", changes={"line": {"boot": "0 s"}}, reply_timeout="0.2 s")
        encoder = settings.device(settings.link(line, clock), clock)
        config = operator.OperatorConfig()
        console = config.link(text, clock)
        axis = operator.OperatorAxis(console, config, clock, "x", encoder)
        assert "encoder of lines" in axis.identify().model
        assert axis.limits().by_hand
        axis.home()
        readings = [axis.read()]
        while readings[-1].moving:
            clock.sleep(0.25)
            readings.append(axis.read())
        axis.move_to(360.0, 60.0, 30.0)
        while (reading := axis.read()).moving:
            readings.append(reading)
            clock.sleep(0.25)
        # Read on the move as well as at rest, in turns from the zero mark.
        assert any(100.0 < r.position_deg < 250.0 for r in readings)
        assert reading.position_deg == pytest.approx(360.0, abs=2.0)
        assert reading.position_deg == pytest.approx(plant.state(clock.now())[0], abs=0.01)
        axis.stop()
        axis.safe("hold")
        assert "press Enter:" in person.heard[0]
    # Questions, and no command that moves or changes anything.
    assert set(board.lines) <= {"$I", "$$"}


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
def test_what_a_person_cannot_be_is_refused(change: tuple[str, str], said: str) -> None:
    with pytest.raises(SpecError, match=re.escape(said)):
        parse_rig(BY_HAND.replace(*change))


def test_nobody_there_is_said_before_anything_begins(tmp_path: Path) -> None:
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
        (problem,) = dry_run_of(Track((TrackStep("rates", 5.0, moves=(spin,)),)), None, {"x": axis.limits()}).problems
    assert "but is turned by hand" in problem


# -------------------------------------------------------------------------------------------------------- whole runs


def hand_recipe(**more: object) -> Recipe:
    """Of the preset whose gimbal is moved by hand: a minute of it, its angles typed."""
    moves = [
        {"rest": "6 s", "read_every": "none"},
        {"turn": "360 deg", "duration": "8 s", "shape": "hand"},
        {"rest": "6 s", "read_every": "none"},
        {"turn": "-360 deg", "duration": "8 s", "shape": "hand"},
        {"rest": "6 s", "read_every": "none"},
    ]
    keys = {
        "plan.temperature": ["23 degC", "25 degC"],
        "plan.gradient": "1 K/min",
        "plan.soak": "2 s",
        "plan.cycle.moves": moves,
        "plan.cycle.other_axes": {"duration": "20 s"},
        "rig.table.answer_time": "0 s",
        "rig.table.axis[0].angle.read_every": "rest",
        "requirement": None,
    }
    return unpredicted(changed(parse_spec(presets.text("rig-hand")), keys | more))


READ_AT_REST = [
    move | ({"read_every": "1 s"} if "rest" in move else {})
    for move in ({"rest": "6 s"}, {"turn": "360 deg", "duration": "8 s", "shape": "hand"}, {"rest": "6 s"})
]


def readings_of_rests(folder: Path, made: Recipe) -> list[int]:
    """Of a simulated run's log: how many planned readings each standstill has."""
    assert run(made, folder, simulate=True, seed=3).exit_status == "success"
    log = run_log.log(folder)
    assert log.standstill is not None
    assert log.readings is not None
    rows = log.readings.of_axis(0, ReadingKind.PLANNED).row
    angles = (np.degrees(angles_of_rests(log)) + 180.0) % 360.0 - 180.0
    # Every rest keeps its length, however late somebody was; nobody hits the mark exactly.
    assert np.bincount(log.standstill + 1)[1:].min() >= 5.8 * 125.0
    assert np.all((np.abs(angles) > 0.0) & (np.abs(angles) < 2.0))
    return np.bincount(log.standstill[rows] + 1)[1:].tolist()


def test_a_log_has_the_readings_that_the_plan_counts(tmp_path: Path) -> None:
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


def test_an_axis_whose_angle_is_typed_is_not_read_at_rest() -> None:
    typed = AxisLimits(120.0, 200.0, None, None, 0.01, by_hand=True, typed=True)
    encoder = replace(typed, typed=False)
    typed_plan, read_plan = (
        track_of(made, ["x"]) for made in (hand_recipe(), hand_recipe(**{"plan.cycle.moves": READ_AT_REST}))
    )
    chamber = ChamberLimits(-50.0, 90.0, 0.1, hardware_ramp=True)
    for track, limits in ((typed_plan, typed), (typed_plan, encoder), (read_plan, encoder)):
        assert not dry_run_of(track, chamber, {"x": limits}).problems
    (problem,) = dry_run_of(read_plan, chamber, {"x": typed}).problems
    assert "types its angle only once: add an [axis.encoder]" in problem


def test_early_turns_make_up_for_late_ones() -> None:
    clock = VirtualClock()
    slow = SimulatedHand(reaction_s=9.0, pace_spread=0.0)
    person = SimulatedPerson(clock, {"x": AxisPlant()}, slow)
    axis = operator.OperatorAxis(person, operator.OperatorConfig(), clock, "x")
    control = AxisControl({"x": axis}, clock, lambda *_, **__: None)
    turn = AxisCommand(0.0, "x", "turn", rate_dps=60.0, acceleration_dps2=60.0, angle_deg=90.0, answer_s=4.0)
    with clock.party():
        control.home(["x"], lambda: None)
        late = []
        for person.hand in (slow, replace(slow, reaction_s=0.0), replace(slow, reaction_s=0.0)):
            control.move("turns", turn, clock.now(), lambda: None)
            control.settle_all(lambda: None)
            late.append(control.late_s)
    assert 4.0 < late[0] < 12.0
    # Each takes two of the four seconds.
    assert late[1:] == pytest.approx([late[0] - 2.0, late[0] - 4.0], abs=0.3)


PROGRAM = """
import fcntl, sys, termios
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
from gradcal_jax.cli import main
sys.exit(main())
"""


class AtTerminal:
    """`gradcal` on a pseudo-terminal of its own, and somebody who reads and types."""

    def __init__(self, *words: object) -> None:
        self.master, slave = os.openpty()
        environment = {**os.environ, "TERM": "xterm", "OPENBLAS_NUM_THREADS": "1"}
        environment.pop("NO_COLOR", None)
        self.process = subprocess.Popen(
            [sys.executable, "-c", PROGRAM, *map(str, words)],
            stdin=slave,
            stdout=slave,
            stderr=slave,
            start_new_session=True,
            env=environment,
        )
        os.close(slave)
        self.said = ""
        self._read = 0

    def wait_for(self, text: str, timeout_s: float = 60.0) -> str:
        """Read until `text` has come since the last call; what came before it."""
        end = time.monotonic() + timeout_s
        while (place := self.said.find(text, self._read)) < 0:
            if time.monotonic() > end or not self._more(0.5):
                raise AssertionError(f"never came: {text!r}; the end of what was said: {self.said[-1500:]!r}")
        before, self._read = self.said[self._read : place], place + len(text)
        return before

    def _more(self, timeout_s: float) -> bool:
        if select.select([self.master], [], [], timeout_s)[0]:
            try:
                self.said += os.read(self.master, 65536).decode("utf-8", "replace")
            except OSError:
                return False  # the other side is closed
        return True

    def type(self, text: str) -> None:
        os.write(self.master, text.encode())

    def ends(self, timeout_s: float = 60.0) -> int:
        end = time.monotonic() + timeout_s
        while self._more(0.1) and self.process.poll() is None:
            assert time.monotonic() < end, self.said[-1500:]
        while self._more(0.0) and select.select([self.master], [], [], 0.0)[0]:
            pass
        return self.process.wait(timeout=10.0)

    def __enter__(self) -> "AtTerminal":
        return self

    def __exit__(self, *_: object) -> None:
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()
        os.close(self.master)


def quick_hand_recipe(folder: Path) -> Path:
    """In real time: a second here, two there."""
    moves = [
        {"rest": "1 s", "read_every": "none"},
        {"turn": "360 deg", "duration": "6 s", "shape": "hand"},
        {"rest": "1 s", "read_every": "none"},
        {"turn": "-360 deg", "duration": "6 s", "shape": "hand"},
        {"rest": "1 s", "read_every": "none"},
    ]
    made = hand_recipe(
        **{
            "rig.table.axis[0].max_rate": "200 deg/s",
            "plan.cycle.moves": moves,
            "plan.temperature": ["23 degC", "23.3 degC"],
            "plan.cycle.other_axes": None,
        }
    )
    stability = made.stability.model_copy(update={"for_at_least": Quantity.read("1 s", "time")})
    write_toml(made.model_copy(update={"stability": stability}), folder / "recipe.toml")
    return folder / "recipe.toml"


@contextlib.contextmanager
def laboratory(folder: Path) -> Iterator[tuple[SimulatedLab, Path, Path]]:
    """Chamber and sensor in real time; who turns the gimbal is the test."""
    recipe = quick_hand_recipe(folder)
    with SimulatedLab(hand_recipe().spec, RealClock()) as lab:
        rig = to_toml(lab.rig).replace(lab.ports[1].url, "terminal")
        (folder / "rig.toml").write_text(rig, encoding="utf-8")
        yield lab, recipe, folder / "rig.toml"


@pytest.mark.long
def test_somebody_at_the_terminal_of_gradcal_run(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with laboratory(tmp_path) as (lab, recipe, rig):
        plant = lab.axis_plants[0]
        with AtTerminal("run", recipe, "--rig", rig, "-o", folder) as terminal:
            terminal.wait_for("press Enter to begin; type anything else to end without a run: ")
            terminal.type("\n")
            terminal.wait_for(f"x: bring it to its zero mark; {ASKS}")
            terminal.type("o.02 deg\n")
            terminal.wait_for("expected an angle such as '30 arcsec'. Type the angle that its scale shows: ")
            terminal.type("0.02 deg\n")
            terminal.wait_for(f"\ax: turn by +360 deg in 6 s, to 360 deg; {ASKS}")
            plant.turn_by_hand(time.monotonic(), 360.4, 1.0)
            time.sleep(1.2)
            terminal.type("0.3")
            # Nothing is drawn over what somebody is typing.
            time.sleep(6.0)
            terminal.type("8 deg\n")
            between = terminal.wait_for("x: turn by -360 deg in 6 s, to 0 deg")
            assert between.replace("\r", "").startswith("0.38 deg\n")
            # Who types nothing can still end the run.
            terminal.type("\x03")
            assert terminal.ends() == 130
            assert "x: cancelled: leave the axis where it is." in terminal.said
            assert "chamber: safe (standby" in terminal.said
            assert f"gradcal run --resume {folder}" in terminal.said.replace("\r\n", " ")
    contents = read_journal(folder / "journal")
    angles = [event.data for event in contents.events if event.name == "angle"]
    assert [round(angle["position_deg"], 3) for angle in angles] == [0.02, 360.38]


def test_a_terminal_hands_on_whole_lines() -> None:
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
