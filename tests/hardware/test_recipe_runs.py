"""Recipes on rigs: what becomes of them when they are resumed, aborted, or have no business there."""

import threading
from unittest.mock import patch

import numpy as np
import pytest
from hardware_bench import short_recipe, unpredicted
from hardware_evidence import record
from simulated_devices.faults import Faults
from simulated_devices.port_lab import SimulatedLab

from gradcal_jax.hardware.clock import VirtualClock
from gradcal_jax.hardware.execute import run_session
from gradcal_jax.hardware.run_folder import new_folder
from gradcal_jax.hardware.runner import Runner
from gradcal_jax.hardware.track import track_of
from gradcal_jax.information import segments_of
from gradcal_jax.model.build import build_imu
from gradcal_jax.recipe.tracks import tracks_of
from gradcal_jax.spec import presets
from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.schedule import PlanSchedule, row_count
from gradcal_jax.spec.spec import parse_spec

SPEED = 20.0


# ------------------------------------------------------------------------------------------------------- the binding


@pytest.mark.parametrize("name", presets.names())
def test_every_preset_becomes_a_track_that_takes_as_long_as_its_plan(name):
    made = unpredicted(parse_spec(presets.text(name)))
    table = made.spec.rig.table
    track = track_of(made, [axis.name for axis in table.axis])
    assert track.duration_s == pytest.approx(made.duration_s, rel=1e-9)
    readings = sum(len(step.read_at_s) for step in track.steps)
    schedule = made.spec.schedule
    if isinstance(schedule, PlanSchedule) and table.standing == "read":
        # The first reading of each stretch is not among the plan's.
        assert readings == pytest.approx(row_count(schedule, table) + len(schedule.stretches), abs=2)
    # Where nobody controls the temperature, nothing waits for it.
    assert (track.steps[0].stable is None) == (made.spec.rig.chamber.control == "none")
    for step in track.steps:
        ends = [move.start_s + move.duration_s for move in step.moves]
        following = ([move.start_s for move in step.moves] + [step.duration_s])[1:]
        for move, end, after in zip(step.moves, ends, following, strict=True):
            assert move.kind != "turn" or end <= after + 1e-6


@pytest.mark.parametrize("drive", ["motor", "hand"])
@pytest.mark.parametrize("standing", ["read", "held"])
def test_a_prediction_reads_what_the_recipe_reads(drive, standing):
    """Of an axis that is read once in each rest, in a plan whose first stretch is shorter than its cycle: an operator
    types no angle there, nor behind the last cycle. Of a table that is held, a rest is data without a reading."""
    turn = {"duration": "10 s", "shape": "hand"} if drive == "hand" else {"peak_rate": "90 deg/s", "duration": "5 s"}
    turn |= {"shape": "linear ramps"} if drive == "motor" else {}
    programme = [
        {"soak": "30 s", "at": "20 degC", "used": True},
        {"soak": "30 min", "used": False},
        {"ramp_to": "40.2 degC", "rate": "1 K/min"},
    ]
    keys = {
        "rig.table.drive": drive,
        "rig.table.answer_time": "4 s" if drive == "hand" else "0 s",
        "rig.table.standing": standing,
        "rig.table.axis[0].angle.read_every": "rest",
        "plan.temperature": None,
        "plan.gradient": None,
        "plan.soak": None,
        "plan.programme": programme,
        "plan.cycle": {
            "moves": [{"rest": "15 s"}, {"turn": "360 deg"} | turn, {"rest": "15 s"}, {"turn": "-360 deg"} | turn]
        },
    }
    spec = unpredicted(changed(parse_spec(presets.text("rig-hand")), keys)).spec
    short, ramp = spec.gradient_schedule.stretches
    assert (short.cycles, ramp.cycles > 10, ramp.leftover > 1.0) == (0, True, True)
    built = build_imu(spec)
    rows = segments_of(built.motion, built.model)
    begins = np.asarray(built.motion.line.start)[rows.first][rows.row_segment[rows.used]]
    last_ends = ramp.start + ramp.cycles * spec.gradient_schedule.period
    fills = np.sum(begins < ramp.start), np.sum(begins > last_ends - 1e-6)
    assert fills == ((0, 0) if (drive, standing) == ("hand", "read") else (1, 1))
    assert rows.used.sum() == row_count(spec.gradient_schedule, spec.rig.table)
    blocks = tracks_of(spec).motion
    read = [(block.moves[0].read_every is not None or block.moves[0].read == "end") for block in blocks]
    behind = blocks[-1].read_every_after is not None
    assert (read[0], behind) == ((False, False) if drive == "hand" else (True, True))


def chamber_hears(track):
    """When on the track's own time, where to, and with which ramp (K/min)."""
    told = []
    clock = 0.0
    for step in track.steps:
        for course in step.courses:
            told.append((clock + course.start_s, course.temperature_c, course.ramp_k_per_min))
        clock += step.duration_s
    return told


WITH_UNUSED_SEGMENTS = [
    {"soak": "10 min", "at": "-30 degC"},
    {"ramp_to": "-20 degC", "rate": "1 K/min"},
    {"step_to": "-30 degC"},
    {"soak": "10 min"},
    {"ramp_to": "-20 degC", "rate": "1 K/min"},
    {"ramp_to": "-30 degC", "rate": "1 K/min", "used": False},
    {"ramp_to": "-20 degC", "rate": "0.5 K/min"},
]


@pytest.mark.parametrize("name", [*presets.names(), "programme"])
def test_the_chamber_hears_every_segment_of_the_recipe_when_it_begins(name):
    if name == "programme":
        keys = {"plan.programme": WITH_UNUSED_SEGMENTS, "plan.temperature": None, "plan.gradient": None}
        spec = changed(parse_spec(presets.text("paper-dynamic-gradient")), keys | {"plan.soak": None})
    else:
        spec = parse_spec(presets.text(name))
    made = unpredicted(spec)
    begins = np.cumsum([0.0] + [float(segment.duration) for segment in made.chamber])
    wanted = []
    for begin, segment in zip(begins, made.chamber, strict=False):
        ramp = None if segment.slope is None else pytest.approx(abs(float(segment.slope)) * 60.0)
        wanted.append((pytest.approx(begin, abs=1e-3), pytest.approx(float(segment.temperature_end)), ramp))
    heard = chamber_hears(track_of(made, [axis.name for axis in spec.rig.table.axis]))
    assert heard == ([] if spec.rig.chamber.control == "none" else wanted)


def test_gyros_may_differ_from_the_table_by_what_the_spec_says_of_them():
    usual = track_of(unpredicted(parse_spec(presets.text("paper-dynamic-gradient"))), ["table"]).gyros
    poor = track_of(unpredicted(parse_spec(presets.text("consumer-mems"))), ["table"]).gyros
    assert (usual.share, usual.bias_dps) == (0.1, 1.0)
    # 3 % a coefficient of nine, and 2 deg/s a gyro.
    assert poor.share == pytest.approx(3.0 * 0.03 * 3.0)
    assert poor.bias_dps == pytest.approx(3.0 * 2.0 * 3.0**0.5)
    forces = parse_spec(presets.text("accelerometer-six-positions"))
    assert track_of(unpredicted(forces), [axis.name for axis in forces.rig.table.axis]).gyros is None


# ----------------------------------------------------------------------------------------------- guarded, and aborted


# While a table is mute virtual time is real: a set point that is under way takes six seconds, and ends first.
ALLOWED_S = 15.0


def aborted(folder, after_s, *, mute):
    """A whole run that is aborted at an instant of its clock, with one device silent from then on."""
    clock = VirtualClock()
    made = short_recipe(2.0)
    with SimulatedLab(made.spec, clock) as lab:
        run = new_folder(folder, made, lab.rig, simulated={})
        begin = Runner.run

        def attended(runner):
            def abort():
                clock.sleep_until(after_s)
                if mute is not None:
                    lab.ports[mute].faults = Faults(mute=True)
                runner.abort("now")

            threading.Thread(target=abort, daemon=True).start()
            return begin(runner)

        with patch.object(Runner, "run", attended):
            result = run_session(run, clock, safe_deadline_s=ALLOWED_S)
        clock.sleep(0.0)
        assert lab.axis_plants[0].state(clock.now())[1] == 0.0 or mute == 1
        assert lab.chamber.mode == "STANDBY" or mute == 0
    return result


def check_aborts(folder, count, seed):
    """Random instants; a chamber, a table, then no device never answers again, in turn."""
    random = np.random.default_rng(seed)
    longest = 0.0
    for number in range(count):
        mute = (0, 1, None)[number % 3]
        result = aborted(folder / f"abort{number}", float(random.uniform(2.0, 110.0)), mute=mute)
        assert result.exit_status == "aborted"
        names = {None: set(), 0: {"chamber"}, 1: {"x"}}[mute]
        assert {outcome.name for outcome in result.outcomes if not outcome.verified} <= names
        longest = max(longest, *(o.took_s for o in result.outcomes if o.name not in names))
    return longest


@pytest.mark.long
def test_whole_runs_aborted_at_random_end_safe(tmp_path):
    assert check_aborts(tmp_path, 2, seed=1) < ALLOWED_S


@pytest.mark.evidence
def test_fifty_aborts_end_safe_also_with_a_device_that_never_answers(tmp_path):
    longest = check_aborts(tmp_path, 50, seed=2)
    assert longest < ALLOWED_S
    record(
        "aborts at random instants",
        "50 whole runs, of them 17 with a chamber and 17 with a table that never answers again: every device that "
        f"answers verified safe, the slowest after {longest:.1f} s of the {ALLOWED_S:g} s allowed",
        "tests/hardware/test_recipe_runs.py",
    )
