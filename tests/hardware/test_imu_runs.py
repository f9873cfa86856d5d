"""Runs of whole units on simulated devices: what devices, journal and log make of poses, turns and mountings."""

import itertools
import math

import numpy as np
import pytest
from hardware_evidence import record
from imu_bench import estimated, hidden_truth, made, short, triad
from scipy.stats import chi2

from gradcal_jax.estimation.imu_executed import executed_imu
from gradcal_jax.estimation.log_rows import Options, imu_rows, with_options
from gradcal_jax.hardware import execute
from gradcal_jax.hardware.errors import HardwareError
from gradcal_jax.hardware.run_folder import RunFolder
from gradcal_jax.hardware.track import Ask, track_of
from gradcal_jax.model.build import build_imu
from gradcal_jax.records import run_log
from gradcal_jax.spec import presets
from gradcal_jax.spec.absent import absent_terms
from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.rig import parse_rig
from gradcal_jax.spec.spec import parse_spec


@pytest.fixture(scope="module")
def ran(imu_run):
    """One cycle with two units on the table, and the log of the second."""
    return imu_run / "run", run_log.log(imu_run / "run", "unit2")


def consistent(log, spec, truth, tail):
    """`estimated`, whose sums of squares lie between the quantiles of `tail` and 1 - `tail`."""
    squares, degrees, nees, count = estimated(log, spec, truth)
    assert chi2.ppf(tail, degrees) < squares < chi2.ppf(1.0 - tail, degrees)
    assert chi2.ppf(tail, count) < nees < chi2.ppf(1.0 - tail, count)
    return squares, degrees, nees, count


def test_in_every_cycle_a_turn_is_read_before_the_next_one_begins():
    """By the very number, of turns without a rest between them: else the reading is one on the move."""
    keys = {"plan.temperature": ["10 degC", "40 degC"], "plan.gradient": "1.5 K/min", "plan.soak": "5 min"}
    track = track_of(made(changed(parse_spec(presets.text("paper-dynamic-gradient")), keys)), ["x"])
    for step in track.steps:
        for before, turn in itertools.pairwise(step.moves):
            if turn.start_s - before.start_s < 45.0:
                assert turn.start_s in step.read_at_s


def test_a_rehearsal_with_one_seed_is_the_same_byte_for_byte(ran, tmp_path):
    """One thread of a run works at a time, whatever else the computer does."""
    again = tmp_path / "run"
    assert execute.run(made(short()), again, simulate=True, seed=3, units=2).exit_status == "success"
    first, second = (RunFolder(folder).contents().records for folder in (ran[0], again))
    # The first record has the wall clock's time.
    assert first[1:] == second[1:]


def test_one_axis_turns_at_a_time(ran):
    turned, under_way = [], ""
    for event in RunFolder(ran[0]).contents().events:
        if event.name == "move" and event.data["kind"] == "turn":
            assert not under_way
            under_way = event.data["axis"]
            turned.append(under_way)
        elif event.name == "angle" and not event.data["moving"] and event.data["axis"] == under_way:
            under_way = ""
    assert " ".join(turned) == "spin spin tilt tilt tilt tilt spin tilt spin tilt spin"


def test_the_estimate_finds_what_was_hidden(ran):
    folder, log = ran
    spec = RunFolder(folder).recipe().spec
    count = consistent(log, spec, hidden_truth(folder, "unit2"), 1e-4)[3]
    # Of another unit it is far off: the bands can tell.
    wrong = estimated(log, spec, hidden_truth(folder))[2]
    assert wrong > chi2.ppf(1.0 - 1e-12, count)


def test_an_axis_that_is_not_read_before_a_break_stands_as_before_and_not_as_behind_it(ran):
    """A run that is killed in the first quarter of a second of a rest, and gone on with at other angles."""
    folder, log = ran
    built = build_imu(RunFolder(folder).recipe().spec)
    rows, _ = imu_rows(built, [log], "unit2", Options())
    whole = executed_imu(rows, built.motion.geometry).motion.angles()[0]
    numbers = np.unique(log.standstill[log.standstill >= 0])
    rest, behind = (np.flatnonzero(log.standstill == numbers[k]) for k in (-3, -1))
    kept = np.r_[: rest[30], behind[0] : len(rows.time_s)]
    parts = {name: of[kept] for name, of in rows._asdict().items() if np.shape(of)[:1] == rows.time_s.shape}
    broken = rows._replace(**parts)
    angles, usable, standing = broken.angles.copy(), broken.usable.copy(), broken.standing.copy()
    angles[rest[0] - 100 : rest[30], 0], usable[rest[30]], standing[rest[27] : rest[30]] = np.nan, False, False
    broken = broken._replace(angles=angles, usable=usable, standing=standing)
    found = executed_imu(broken, built.motion.geometry).motion.angles()[0]
    stands = len(found) - 3
    np.testing.assert_allclose(found[:stands], whole[:stands], rtol=0.0, atol=np.radians(0.02))


@pytest.mark.parametrize("late", [-8, 8])
def test_a_stop_of_an_instant_is_where_the_gyros_see_it_whenever_it_was_read(ran, late):
    """A busy computer's stamps of readings and of samples are late by different times."""
    folder, log = ran
    built = build_imu(RunFolder(folder).recipe().spec)
    rows, _ = imu_rows(built, [log], "unit2", Options())
    stops = np.flatnonzero(np.isfinite(rows.angles).any(axis=1) & rows.at_a_stop & ~rows.standing)
    angles, at_a_stop = rows.angles.copy(), rows.at_a_stop.copy()
    angles[stops], at_a_stop[stops] = np.nan, False
    angles[stops + late], at_a_stop[stops + late] = rows.angles[stops], True
    on_time, shifted = (
        executed_imu(one, built.motion.geometry).rows
        for one in (rows, rows._replace(angles=angles, at_a_stop=at_a_stop))
    )
    assert len(stops) >= 4
    np.testing.assert_array_equal(shifted, on_time)


def test_units_hang_as_the_step_says_or_nobody_is_asked(tmp_path):
    spec = parse_spec(presets.text("one-axis-table"))
    recipe = made(spec)
    steps = track_of(recipe, ["turn"]).steps
    asked = [step for step in steps if isinstance(step, Ask)]
    assert [step.mounting for step in asked] == [1, 2, 3]
    assert asked[1].hang == "mounting 2 (y along the axis): x along +z, y along +x, z along +y"
    with pytest.raises(ValueError, match="the IMUs is changed by the operator, who is asked at the terminal"):
        execute.run(recipe, tmp_path / "run", rig=one_axis_rig())
    assert not (tmp_path / "run").exists()


def test_where_nobody_controls_the_temperature_it_does_not_wait_for_the_units_to_be_hung_anew(tmp_path):
    """Each stretch begins when the plan says, since hanging anew is done in the unread part before it."""
    ways = [{"ramp_to": f"{end} degC", "rate": "6 K/min"} for end in (18, 10, 18)]
    soak = {"soak": "130 s", "at": "10 degC"}
    later = {"soak": "130 s"}
    programme = [soak, ways[0], later, ways[1], later, ways[2]]
    recipe = made(changed(parse_spec(presets.text("no-encoder")), {"plan.programme": programme}))
    run = tmp_path / "run"
    assert execute.run(recipe, run, simulate=True, seed=3).exit_status == "success"
    events = RunFolder(run).contents().events
    begins = {e.data["step"]: e.data["begins_s"] for e in events if e.name == "step begins"}
    assert [e.data["mounting"] for e in events if e.name == "hung"] == [1, 2, 3]
    for before, stretch, starts in (("soak 1", "motion 1", 0.0), ("soak 2", "motion 2", 210.0)):
        first = min(at for name, at in begins.items() if name.startswith(stretch))
        assert first - begins[before] == pytest.approx(130.0, abs=0.5)
        assert first - begins["soak 1"] == pytest.approx(130.0 + starts, abs=1.0)


@pytest.mark.parametrize("measured", [True, False], ids=["accelerometers", "gyros alone"])
def test_gyros_feel_rotation_by_their_g_sensitivity(tmp_path, measured):
    """The simulated gyros lie 3 mm beside the accelerometers, and 3 cm off the axes: a spec that does not say so is
    estimated with the lever arm of its class, and its errors are as stated."""
    sensitive = {"sensor.gyro.g_sensitivity": {"prior": "2000 deg/h/g"}}
    changes = sensitive if measured else {**sensitive, "sensor.gyro.angle_random_walk": "0.3 deg/sqrt(h)"}
    spec, run = changed(short(4) if measured else triad(), changes), tmp_path / "run"
    assert execute.run(made(spec), run, simulate=True, seed=3).exit_status == "success"
    log = run_log.log(run)
    consistent(log, spec, hidden_truth(run), 1e-4)
    counted, _, said = with_options(spec, [log], Options())
    arm = "3 mm" if measured else "3 cm"
    assert str(counted.sensor.gyro.g_sensitivity.lever_arm) == arm
    assert any(f"lever_arm = {arm}" in sentence for sentence in said)
    assert [t.typical for t in absent_terms(spec) if t.key.endswith("lever_arm")] == [arm]


def one_axis_rig():
    return parse_rig(
        'format = "gradcal-rig/1"\n[[axis]]\nname = "turn"\ndriver = "lines"\nport = "/dev/ttyUSB9"\nsafe = "hold"\n'
        "gravity_loaded = false\noptions = { protocol = 'grbl' }\n"
    )


# ------------------------------------------------------------------------------------------------------- long proofs


@pytest.mark.evidence
def test_three_mountings_on_one_axis(tmp_path):
    """Somebody hangs the unit anew between the ramps, once each although the run is stopped in the second; the log says
    how it hung, and the estimate is in its band."""
    moves = [{"rest": "4 s"}]
    for turn in ("360 deg", "-360 deg", "90 deg", "90 deg", "-180 deg"):
        moves += [{"turn": turn, "axis": "turn"}, {"rest": "4 s"}]
    keys = {
        "plan.gradient": "40 K/min",
        "plan.soak": "2 min",
        "plan.cycle.moves": moves,
        "rig.chamber.max_heating": "60 K/min",
        "rig.chamber.max_cooling": "60 K/min",
        "sensor.gyro.scale_factor.prior": "1000 ppm",
    }
    recipe = made(changed(parse_spec(presets.text("one-axis-table")), keys))
    run = tmp_path / "run"

    def look(progress):
        if progress.step.startswith("motion 2, 2 of") and (progress.step_left_s or math.inf) < 15.0:
            raise HardwareError("enough")

    first = execute.run(recipe, run, simulate=True, seed=2, on_progress=look)
    assert first.reason == "enough"
    assert execute.resume(run).exit_status == "success"
    hung = [event.data["mounting"] for event in RunFolder(run).contents().events if event.name == "hung"]
    assert hung == [1, 2, 3]
    log = run_log.log(run)
    assert np.unique(log.mounting).tolist() == [0, 1, 2]
    assert np.all(np.diff(log.mounting) >= 0)
    squares, degrees, nees, count = consistent(log, recipe.spec, hidden_truth(run), 0.005)
    said = f"χ² {squares:.0f} of {degrees}, NEES {nees:.0f} of {count}"
    record("three mountings on one axis", said, "test_imu_runs")
