"""Runs of a whole unit's recipe that are killed (SIGKILL) at random instants, made safe by the guard and gone on with:
their logs hold every step once and whole, and what is estimated of them is as sure as it says.

Two axes, three gyros and three accelerometers; a laboratory of its own for every run, so that no two have one truth. A
kill comes at any time of a run with the same chance; what the run did then is read from the journal afterwards.
"""

import signal
import subprocess
import time

import numpy as np
import pytest
from hardware_bench import parse_journal
from hardware_evidence import record
from hardware_processes import laboratory, require_standing, start_run
from imu_bench import estimated, hidden_truth, made, short
from scipy.stats import chi2

from gradcal_jax.hardware.journal import Event
from gradcal_jax.hardware.run_folder import RunFolder, exit_status
from gradcal_jax.hardware.track import track_of
from gradcal_jax.records.run_log import log as log_of_run
from gradcal_jax.spec.changes import changed
from gradcal_jax.tables.writing import write_toml

SPEED = 10.0
RATE_HZ = 125.0
AXES = ["tilt", "spin"]
# A run waits for the temperature for about so long, real s.
WAITS_S = 3.0
WHILE_IT_STARTS, WHILE_SAFE = 0.1, 0.15


# ---------------------------------------------------------------------------------------------------------------- kills


def lasts(run, real_s):
    """Wait so long; False when the run ended before."""
    try:
        run.wait(timeout=real_s)
    except subprocess.TimeoutExpired:
        return True
    return False


def runs_begun(journal):
    return journal.read_bytes().count(b'"state":"running"') if journal.exists() else 0


def strike(run, journal, track, random):
    """Kill the run at an instant, some while they start or make the rig safe; False when it ended before."""
    begun = runs_begun(journal)
    if random.random() < WHILE_IT_STARTS:
        alive = lasts(run, random.uniform(0.0, 1.2))
    else:
        while lasts(run, 0.05) and runs_begun(journal) == begun:
            pass
        alive = lasts(run, random.uniform(0.0, WAITS_S + track.duration_s / SPEED))
    if alive and random.random() < WHILE_SAFE:
        run.send_signal(signal.SIGTERM)
        alive = lasts(run, random.uniform(0.0, 0.15))
    if alive:
        run.send_signal(signal.SIGKILL)
    return alive


def killed_until_done(folder, path, track, random, most, after_a_kill):
    """Begin a run, kill it at most so many times and go on with it until it is complete; how many kills there were.
    `after_a_kill` is handed the events of the part that was killed, and what its guard added."""
    torn, records, kills = b"", [], 0
    while True:
        run = start_run(folder, path, SPEED, guard=True)
        killed = kills < most and strike(run, path / "journal", track, random)
        said, _ = run.communicate()
        journal = (path / "journal").read_bytes() if (path / "journal").exists() else b""
        # Nothing that was on the disk is ever lost or changed, and it reads as it did.
        assert journal.startswith(torn)
        contents = parse_journal(journal)
        assert contents.records[: len(records)] == records
        fresh = [entry for entry in contents.records[len(records) :] if isinstance(entry, Event)]
        if killed:
            kills += 1
            after_a_kill(fresh)
        # Of SIGTERM a run that has not yet begun anything ends as any process does, without a word.
        unbegun = run.returncode == -signal.SIGTERM and not said and not any(e.name == "state" for e in fresh)
        torn, records = journal, contents.records
        # A kill may come between the run's last word and the end of its process.
        if run.returncode == 0 or exit_status(contents) == "success":
            return kills
        assert run.returncode == -signal.SIGKILL or "SIGTERM" in said or unbegun, said
        if not (path / "run.json").exists():
            for entry in path.glob("*"):
                entry.unlink()


# -------------------------------------------------------------------------------------------------------- what is asked


def require_safe(lab, fresh):
    """After a kill: whatever the run had begun to do, the guard has ended, unless the run itself came to it; whether it
    was the guard. (A run that has only asked the devices who they are has begun nothing.)"""
    names = [event.name for event in fresh]
    if "identity" not in names:
        return False
    require_standing(lab)
    by_guard = {e.data["device"]: e.data["verified"] for e in fresh if e.data.get("by") == "guard"}
    if "end" not in names and (by_guard or not {*names} <= {"session", "identity", "configuration"}):
        assert by_guard == dict.fromkeys(["chamber", *AXES, "unit1"], True)
    return bool(by_guard)


def require_seams(events, track):
    """Every session that goes on in the middle of the track marks a seam, at the step with which it goes on, before it
    does anything of it; beside those there are only those of steps that a busy computer did not execute as written, and
    made again. How many there are."""
    begins = [k for k, event in enumerate(events) if event.name == "session"]
    seams = 0
    for number, session in enumerate(events[a:b] for a, b in zip(begins, [*begins[1:], None], strict=True)):
        first, names = int(session[0].data["first_step"]), [event.name for event in session]
        if "step" not in names:
            continue
        marked = [event for event in session if event.name == "seam"]
        resumed = number > 0 and first > 0
        assert resumed <= len(marked) <= resumed + names.count("not done")
        if resumed:
            assert marked[0].data["step"] == track.steps[first].name
            assert names.index("seam") < names.index("step")
        seams += len(marked)
    return seams


def require_every_step_once(run, track, log):
    """Of every step its last attempt is there as the recipe has it; samples are neither lost nor doubled."""
    contents = RunFolder(run).contents()
    assert exit_status(contents) == "success"
    done = [event.data["number"] for event in contents.events if event.name == "step done"]
    assert done == list(range(len(track.steps)))
    begins = {e.data["number"]: e.data["begins_s"] for e in contents.events if e.name == "step begins"}
    moves = [e for e in contents.events if e.name == "move" and e.data["kind"] == "turn"]
    for number, step in enumerate(track.steps):
        begin, end = begins[number], begins[number] + step.duration_s
        own = [e.data for e in moves if begin <= e.data["began_s"] < end]
        assert [(move["axis"], move["angle_deg"]) for move in own] == [(m.axis, m.angle_deg) for m in step.moves]
        if step.read_at_s:
            rows = np.sum((log.host_time_s > begin) & (log.host_time_s <= end))
            # Where a step begins among the samples is known as well as their stamps are.
            assert rows == pytest.approx(RATE_HZ * step.duration_s, rel=0.01)
    apart = np.rint(np.diff(log.time_s) * RATE_HZ).astype(int)
    within = np.ones(len(apart), bool)
    within[log.stretch_starts[1:] - 1] = False
    assert np.all(apart[within] == 1)
    # A stretch of the log begins where a step is made again, and nowhere else.
    again = sum(event.name == "not done" for event in contents.events)
    assert len(log.stretch_starts) <= int(log.provenance["sessions"]) + again


def in_bands(sums, outside=0.01):
    squares, degrees, nees, count = sums[3:]
    for value, free in ((squares, degrees), (nees, count)):
        assert chi2.ppf(outside / 2.0, free) < value < chi2.ppf(1.0 - outside / 2.0, free), sums
    return f"χ² {squares:.0f} of {degrees:.0f}, NEES {nees:.0f} of {count:.0f}"


# Of a chamber that is soon where a run goes on.
RECIPE = made(changed(short(2), {"rig.chamber.max_cooling": "60 K/min"}))


def killed_run(folder, kills, seed):
    """Its log; the kills, those behind which the guard made all safe, the seams, and what `estimated` says."""
    folder.mkdir()
    write_toml(RECIPE, folder / "recipe.toml")
    track, run, guarded = track_of(RECIPE, AXES), folder / "run", []
    with laboratory(folder, SPEED, seed) as lab:
        random, after = np.random.default_rng([seed, 5]), lambda fresh: guarded.append(require_safe(lab, fresh))
        kills = killed_until_done(folder, run, track, random, kills, after)
    log = log_of_run(run)
    require_every_step_once(run, track, log)
    seams = require_seams(RunFolder(run).contents().events, track)
    return log, np.array([kills, sum(guarded), seams, *estimated(log, RECIPE.spec, hidden_truth(folder))])


@pytest.mark.long
def test_a_killed_run_of_a_unit_is_made_safe_and_gone_on_with(tmp_path):
    log, sums = killed_run(tmp_path / "one", 1, 2)
    assert sums[:3].tolist() == [1, 1, 1]
    in_bands(sums, 2e-4)
    # Over either clock: which one is the better depends on how busy the computer was.
    for clock in ("sensor", "host"):
        _, _, nees, count = estimated(log, RECIPE.spec, hidden_truth(tmp_path / "one"), clock)
        assert chi2.ppf(1e-4, count) < nees < chi2.ppf(1.0 - 1e-4, count), (clock, nees)


@pytest.mark.evidence
def test_a_hundred_kills_lose_nothing(tmp_path):
    began, sums, seed = time.monotonic(), np.zeros(7), 20
    while sums[0] < 100:
        sums += killed_run(tmp_path / f"run{seed}", min(10, 100 - sums[0]), seed)[1]
        seed += 1
        assert seed <= 60
    record(
        "runs of a unit (two axes, gyros and accelerometers) killed at random and resumed",
        f"{sums[0]:.0f} kills of {seed - 20} runs; {sums[1]:.0f} times the guard made all safe, verified; "
        f"{sums[2]:.0f} seams; every step once and whole, no sample lost or doubled; of all runs together "
        f"{in_bands(sums)}; {time.monotonic() - began:.0f} s",
        "tests/hardware/test_killed_imu_runs.py",
    )
