"""Runs killed (SIGKILL) wherever they are and gone on with: what is in the journal stays, what is measured is whole.

A laboratory in a process of its own outlives the runs on it; when they are killed, `killing` says.
"""

import collections
import itertools
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from hardware_bench import short_recipe
from hardware_evidence import record
from hardware_processes import laboratory
from journal_log import angles_of_rests, log_of
from killing import SAFE, STANDING, STARTING, TURNING, WAITING, Killer, Watched, require_seams

from gradcal_jax.hardware.drivers import frames
from gradcal_jax.hardware.journal import Chunk, Event, JournalContents, read_journal
from gradcal_jax.hardware.run_folder import RunFolder, exit_status
from gradcal_jax.hardware.setup import config_of
from gradcal_jax.hardware.track import Track, TrackStep, track_of
from gradcal_jax.recipe.recipe import read_recipe
from gradcal_jax.records.log import Log
from gradcal_jax.tables.writing import write_toml

SPEED = 20.0
RATE_HZ = 125.0
EDGE = 31


def prepared(folder: Path, ramp_k: float) -> Track:
    """Rests so long that a busy computer does not sleep through them, at twenty times the speed of a clock."""
    rest = {"rest": "10 s", "read_every": "1 s"}
    moves = [
        rest,
        {"turns": 1, "peak_rate": "200 deg/s", "shape": "linear ramps"},
        rest,
        {"turns": -1, "peak_rate": "150 deg/s", "shape": "linear ramps"},
    ]
    changes = {"plan.cycle.moves": moves, "plan.cycle.other_axes.duration": "10 s", "plan.gradient": "1.5 K/min"}
    made = short_recipe(ramp_k, stable_for="10 s", changes=changes)
    write_toml(made, folder / "recipe.toml")
    return track_of(made, ["x"])


@dataclass
class Tally:
    """What was killed, where, and what became of it."""

    kills: collections.Counter[str] = field(default_factory=collections.Counter)
    runs: int = 0
    seams: int = 0
    samples: int = 0
    steps: int = 0
    torn: int = 0
    slept: int = 0


def killed_runs(folder: Path, track: Track, kills: int, seed: int, *, runs: int = 1) -> Tally:
    """Kill runs and go on with each until it is complete, until there are as many as asked."""
    killer = Killer(folder, track, SPEED, np.random.default_rng(seed), kills)
    tally = Tally(killer.kills)
    with laboratory(folder, SPEED):
        whole = Watched(folder, folder / "whole", SPEED)
        said = whole.end()
        assert whole.process.returncode == 0, said
        wanted = data_set(folder / "whole", track, tally)
        while tally.kills.total() < kills or tally.runs < runs:
            killer.run_to_its_end(folder / f"run{tally.runs}")
            with kept_where_it_fails(folder, tally.runs):
                found = data_set(folder / f"run{tally.runs}", track, tally)
                require_equal(found, wanted)
            tally.runs += 1
    return tally


@contextmanager
def kept_where_it_fails(folder: Path, number: int) -> Iterator[None]:
    """A run whose data are not as they should be is worth more than its verdict: its folder is copied to where no later
    test clears it away, beside that of the run that nobody killed."""
    try:
        yield
    except BaseException as problem:
        kept = Path(tempfile.mkdtemp(prefix="gradcal-killed-run-"))
        for name in ("whole", f"run{number}"):
            shutil.copytree(folder / name, kept / name)
        problem.add_note(f"run{number} and the run that nobody killed are kept in {kept}")
        raise


# ------------------------------------------------------------------------------------------------------ the data set


@dataclass(frozen=True)
class StepData:
    """What one step with data gave: its samples (`missing` ones counted; `torn` where a pseudo-terminal overflowed),
    its turns by the table's readings and by the integral of the sensor's rate, deg. Two turns whose rest the computer
    slept through, all but a moment of which nothing is sure, are one (`slept`)."""

    name: str
    samples: int
    missing: int
    torn: bool
    slept: bool
    table_deg: tuple[float, ...]
    sensor_deg: tuple[float, ...]


def data_set(path: Path, track: Track, tally: Tally) -> list[StepData]:
    """Of a complete run: what every step gave, in order. All else in its log belongs to what was interrupted, and there
    a seam is marked."""
    contents = read_journal(path / "journal")
    assert exit_status(contents) == "success"
    finished = [event.data["number"] for event in contents.events if event.name == "step done"]
    assert finished == list(range(len(track.steps)))
    log = log_of(contents, read_recipe(path / "recipe.toml"), RunFolder(path).rig())
    assert log.host_time_s is not None
    begins = {e.data["number"]: e.data["begins_s"] for e in contents.events if e.name == "step begins"}
    torn_s = overflows(contents, RunFolder(path))
    found = [step_data(log, step, begins[number], torn_s) for number, step in enumerate(track.steps) if step.read_at_s]
    tally.samples += sum(data.samples for data in found)
    tally.steps += len(found)
    tally.torn += sum(data.torn for data in found)
    tally.slept += sum(data.slept for data in found)
    tally.seams += require_seams(contents, track)
    # A stretch of the log begins anew at a seam, or where samples are missing, and nowhere else.
    again = [e.data["begins_s"] for e in contents.events if e.name == "step begins" and e.data["data"]]
    for row in log.stretch_starts[1:].tolist():
        at_s, step_s = float(log.host_time_s[row]), float(log.time_s[row] - log.time_s[row - 1])
        lost = round(step_s * RATE_HZ) > 1 and any(abs(at_s - lost_s) < 10.0 for lost_s in torn_s)
        assert lost or min(abs(at_s - begin) for begin in again) < 0.1, (at_s, step_s)
    return found


def overflows(contents: JournalContents, folder: RunFolder) -> list[float]:
    """When bytes were lost between laboratory and run: at this speed a busy computer lets a terminal overflow."""
    (device,) = folder.rig().imu
    # Most cuts leave part of a datagram; one in twenty falls between two of them and shows by the counter.
    found: list[float] = []
    decoder, bad = None, 0
    for entry in contents.records:
        if isinstance(entry, Event) and entry.name == "configuration":
            decoder = frames.decoder_of(config_of(device, "imu", ("imu", 0)), entry.data["registers"])
            bad = 0
        elif isinstance(entry, Chunk) and entry.line == device.name and entry.received and decoder is not None:
            gaps = decoder.push(entry.data, entry.time_s).gap_before
            if decoder.bad_bytes > bad or gaps.any():
                found.append(entry.time_s)
            bad = decoder.bad_bytes
    return found


def step_data(log: Log, step: TrackStep, begins_s: float, torn_s: list[float]) -> StepData:
    assert log.host_time_s is not None
    assert log.standstill is not None
    rests_rad = angles_of_rests(log)
    rows = np.flatnonzero((log.host_time_s > begins_s) & (log.host_time_s <= begins_s + step.duration_s))
    missing = int(np.sum(np.rint(np.diff(log.time_s[rows]) * RATE_HZ) - 1))
    numbers = [int(n) for n in dict.fromkeys(log.standstill[rows].tolist()) if n >= 0]
    table: list[float] = []
    sensor: list[float] = []
    for before, after in itertools.pairwise(numbers):
        # From the middle of a rest to the middle of the next; whatever row it is, the table stands.
        start, end = (int(np.median(rows[log.standstill[rows] == n])) for n in (before, after))
        table.append(float(np.degrees(rests_rad[after] - rests_rad[before])))
        sensor.append(float(np.degrees(log.rate_rad_per_s[0, start + 1 : end + 1, 0].sum()) / RATE_HZ))
    for number in numbers:
        # How late the quickest of all stamps are, nobody knows: five milliseconds are a tenth of a second of this run,
        # as much as a log leaves away. A quarter of a second from its ends a standstill is one.
        within = rows[log.standstill[rows] == number][EDGE:-EDGE]
        assert np.all(np.degrees(np.abs(log.rate_rad_per_s[0, within, 0])) < 0.5), (step.name, number)
    torn = any(begins_s <= at_s <= begins_s + step.duration_s + 10.0 for at_s in torn_s)
    slept = len(table) < len(step.moves)
    # Whatever the rests were, between them the sensor saw what the table says, but for its scale factor.
    for by_table, by_sensor in zip(table, sensor, strict=True) if not torn else ():
        assert abs(by_sensor - by_table) <= 0.5 + 0.003 * abs(by_table), (step.name, table, sensor)
    return StepData(step.name, len(rows), missing, torn, slept, tuple(table), tuple(sensor))


def require_equal(found: list[StepData], wanted: list[StepData]) -> None:
    """The same steps with the same samples and the same turns, but for the noise of the sensor and of the readings."""
    assert [data.name for data in found] == [data.name for data in wanted]
    for data, other in zip(found, wanted, strict=True):
        if data.torn or other.torn:
            # How many samples were lost is known to a round of the counter only: counted, and not compared.
            continue
        assert (data.missing, other.missing) == (0, 0)
        # Where a step begins among the samples is known as well as their stamps are.
        assert abs(data.samples - other.samples) <= 0.03 * other.samples, (data, other)
        if data.slept or other.slept:
            continue
        # Readings of the paper's table scatter by 0.05 deg each.
        np.testing.assert_allclose(data.table_deg, other.table_deg, atol=0.5)
        assert [round(angle / 360.0) for angle in data.table_deg] == [1, -1], data
        np.testing.assert_allclose(data.sensor_deg, other.sensor_deg, atol=0.1)


# -------------------------------------------------------------------------------------------------------- the proofs


@pytest.mark.long
def test_killed_runs_are_gone_on_with_and_lose_nothing(tmp_path: Path) -> None:
    tally = killed_runs(tmp_path, prepared(tmp_path, 2.0), 2, seed=3)
    assert tally.kills.total() == 2
    assert tally.runs >= 1


@pytest.mark.evidence
def test_a_hundred_killed_runs_are_gone_on_with_and_lose_nothing(tmp_path: Path) -> None:
    began = time.monotonic()
    tally = killed_runs(tmp_path, prepared(tmp_path, 3.0), 100, seed=7, runs=10)
    kills = tally.kills
    executing = kills[TURNING] + kills[STANDING]
    assert kills.total() >= 100
    assert tally.runs >= 10
    assert executing >= 0.5 * kills.total(), kills
    assert min(kills[state] for state in (STARTING, WAITING, TURNING, STANDING, SAFE)) >= 3, kills
    assert tally.torn + tally.slept <= 0.05 * tally.steps
    record(
        "runs killed at random (SIGKILL) and resumed",
        f"{kills.total()} kills of {tally.runs} runs, by what the journal shows: {kills[TURNING]} while the table "
        f"turned, {kills[STANDING]} while it stood in a step with data, {kills[WAITING]} while it waited for its "
        f"temperature or soaked, {kills[STARTING]} while it started, {kills[SAFE]} while it made the rig safe. All "
        f"complete; every journal a continuation of what the kill left; {tally.seams} seams marked; every step's data "
        f"equal to those of a run that nobody killed (samples, turns by table and by sensor); {tally.torn} of "
        f"{tally.steps} steps not compared, since the pseudo-terminal had overflowed, and of {tally.slept} only the "
        f"sum of the turns, since the computer slept through the rest between them; {time.monotonic() - began:.0f} s",
        "tests/hardware/test_killed_runs.py",
    )
