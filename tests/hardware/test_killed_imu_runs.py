"""Runs of a whole unit's recipe that are killed (SIGKILL) at random instants, made safe by the guard and gone on with:
their logs hold every step once and whole, and what is estimated of them is as sure as it says.

Two axes, three gyros and three accelerometers; a laboratory of its own for every run, so that no two have one truth.
"""

import time
from dataclasses import dataclass, field

import numpy as np
import pytest
from hardware_evidence import record
from hardware_processes import laboratory
from imu_bench import estimated, hidden_truth, made, short
from killing import Killer, require_seams
from scipy.stats import chi2

from gradcal_jax.hardware.run_folder import RunFolder, exit_status
from gradcal_jax.hardware.track import track_of
from gradcal_jax.records.run_log import log as log_of_run
from gradcal_jax.spec.changes import changed
from gradcal_jax.tables.writing import write_toml

SPEED = 10.0
RATE_HZ = 125.0
AXES = ["tilt", "spin"]


def quick(cycles):
    """Of a chamber that is soon where a run goes on."""
    return made(changed(short(cycles), {"rig.chamber.max_cooling": "60 K/min"}))


@dataclass
class Sums:
    """What the runs gave together."""

    kills: int = 0
    guarded: int = 0
    seams: int = 0
    each: list[tuple[float, int, float, int]] = field(default_factory=list)

    def require_in_bands(self, outside=0.01):
        squares, degrees, nees, count = np.sum(self.each, axis=0)
        for value, free in ((squares, degrees), (nees, count)):
            assert chi2.ppf(outside / 2.0, free) < value < chi2.ppf(1.0 - outside / 2.0, free), self.each
        return f"χ² {squares:.0f} of {degrees:.0f}, NEES {nees:.0f} of {count:.0f}"


def killed_run(folder, made, kills, seed, sums):
    folder.mkdir()
    write_toml(made, folder / "recipe.toml")
    track, run = track_of(made, AXES), folder / "run"
    killer = Killer(folder, track, SPEED, np.random.default_rng([seed, 5]), kills, guard=True)
    with laboratory(folder, SPEED, seed) as lab:
        killer.run_to_its_end(run, lambda fresh: require_safe(lab, fresh, sums))
    log = log_of_run(run)
    require_every_step_once(run, track, log)
    sums.kills += killer.kills
    sums.seams += require_seams(RunFolder(run).contents(), track)
    sums.each.append(estimated(log, made.spec, hidden_truth(folder)))
    return log


def require_safe(lab, fresh, sums):
    """After a kill: whatever the run had begun to do, the guard has ended, unless the run itself came to it."""
    names = [event.name for event in fresh]
    if "identity" not in names:
        return
    lab.stdin.write("state\n")
    lab.stdin.flush()
    assert lab.stdout.readline().split() == ["STANDBY", "0.0"]
    by_guard = {e.data["device"]: e.data["verified"] for e in fresh if e.data.get("by") == "guard"}
    if "end" not in names:
        assert by_guard == dict.fromkeys(["chamber", *AXES, "unit1"], True)
    sums.guarded += bool(by_guard)


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


@pytest.mark.long
def test_a_killed_run_of_a_unit_is_made_safe_and_gone_on_with(tmp_path):
    sums, recipe = Sums(), quick(2)
    log = killed_run(tmp_path / "one", recipe, 1, 2, sums)
    assert sums.kills == sums.guarded == sums.seams == 1
    sums.require_in_bands(2e-4)
    # Over either clock: which one is the better depends on how busy the computer was.
    for clock in ("sensor", "host"):
        _, _, nees, count = estimated(log, recipe.spec, hidden_truth(tmp_path / "one"), clock)
        assert chi2.ppf(1e-4, count) < nees < chi2.ppf(1.0 - 1e-4, count), (clock, nees)


@pytest.mark.evidence
def test_a_hundred_kills_lose_nothing(tmp_path):
    began = time.monotonic()
    sums, recipe = Sums(), quick(2)
    for seed in range(20, 60):
        if sums.kills < 100:
            killed_run(tmp_path / f"run{seed}", recipe, min(10, 100 - sums.kills), seed, sums)
    assert sums.kills == 100
    record(
        "runs of a unit (two axes, gyros and accelerometers) killed at random and resumed",
        f"{sums.kills} kills of {len(sums.each)} runs; {sums.guarded} times the guard made all safe, verified; "
        f"{sums.seams} seams; every step once and whole, no sample lost or doubled; of all runs together "
        f"{sums.require_in_bands()}; {time.monotonic() - began:.0f} s",
        "tests/hardware/test_killed_imu_runs.py",
    )
