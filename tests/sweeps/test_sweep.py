"""Sweeps from end to end, in real worker processes: right, the same for any number of workers, and resumed."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from jobs_small import GRID, SPEC, written

import gradcal_jax as gj
from gradcal_jax.information import STATISTICS
from gradcal_jax.spec import presets
from gradcal_jax.spec.changes import tables_of
from gradcal_jax.sweeps.dataset import identity_in, read_dataset
from gradcal_jax.sweeps.evaluate import predict_points
from gradcal_jax.sweeps.points import Points
from gradcal_jax.sweeps.pool import LocalPool, Task
from gradcal_jax.sweeps.sweep import Store, already_finished, chunks_of, dry_run, identity_of, sweep
from gradcal_jax.sweeps.sweep_file import read_sweep


@pytest.fixture(scope="module")
def pool():
    with LocalPool(1) as workers:
        yield workers


@pytest.fixture(scope="module")
def done(tmp_path_factory, pool):
    """The grid, once: its folder, its job and its results."""
    folder = tmp_path_factory.mktemp("grid")
    job = read_sweep(written(folder))
    told = []
    swept = sweep(job, folder / "results.nc", runner=pool, progress=told.append)
    return folder, job, swept, told


def test_every_point_is_what_predict_says(done):
    folder, job, *_ = done
    results = read_dataset(folder / "results.nc")
    points = Points(job)
    assert results.sizes == {"rest": 4, "peak_rate": 3}
    expected = gj.predict(gj.changed(job.base, points.changes(7)))
    place = np.unravel_index(7, points.shape)
    scale, bias = expected.requirements
    for name in ("mean_of_max", "max", "mean", "rms"):
        assert results[f"scale_{name}"].values[place] == pytest.approx(getattr(scale, name), rel=1e-12)
    assert results["bias_mean"].values[place] == pytest.approx(bias.mean, rel=1e-12)
    assert results["scale_verdict"].values[place] == scale.verdict
    assert results["duration"].values[place] == pytest.approx(expected.duration_s)


GAP = {
    "plan.temperature": None,
    "plan.gradient": None,
    "plan.programme": [
        {"soak": "1 min", "at": "0 degC"},
        {"ramp_to": "10 degC", "rate": "2 K/min"},
        {"soak": "2 min"},
        {"ramp_to": "20 degC", "rate": "2 K/min"},
    ],
}
LAG = {"sensor.thermal_lag": "1 min", "plan.cycle.duration": "1 min", "plan.soak": {"duration": "5 min"}}
USED_SOAK = {"plan.soak": {"duration": "1 min", "used": True}}


@pytest.mark.parametrize(
    ("base", "changes"),
    [
        *((SPEC, changes) for changes in ({}, GAP, LAG, USED_SOAK)),
        *((presets.text(name), {}) for name in ("rig-hand", "paper-static-gradient", "paper-static-standard")),
    ],
    ids=["ramp", "two stretches", "lag and idle time", "used soak", "three axes", "standing", "standard"],
)
def test_a_worker_predicts_as_predict_does(base, changes):
    spec = gj.parse_spec(base)
    expected = gj.predict(gj.changed(spec, changes))
    (found,) = predict_points(tables_of(spec), [(0, changes)])
    assert found.failure == ""
    assert (found.duration_s, found.motion_s) == (expected.duration_s, expected.motion_s)
    names = {i: requirement.name for i, requirement in enumerate(spec.requirement)}
    mine = {names[row.requirement]: row for row in found.residuals}
    assert len(mine) == len(found.residuals) == len(expected.requirements)
    for row in expected.requirements:
        values = dict(zip(STATISTICS, mine[row.name].values, strict=True))
        for name in STATISTICS:
            said = getattr(row, name.replace(" ", "_"))
            assert values[name] == (None if said is None else pytest.approx(said, rel=1e-12))
        assert mine[row.name].verdict == (row.verdict or "")


def test_results_carry_their_units_their_file_and_their_failures(done):
    folder, job, swept, told = done
    results = read_dataset(folder / "results.nc")
    assert results["rest"].values.tolist() == [3.0, 4.0, 5.0, 6.0]
    assert (results["rest"].attrs["units"], results["peak_rate"].attrs["units"]) == ("s", "deg/s")
    assert (results["scale_max"].attrs["units"], results["bias_max"].attrs["units"]) == ("ppm", "deg/h")
    assert "bias_mean_of_max" not in results
    assert results.attrs["sweep"] == job.text
    assert gj.parse_spec(results.attrs["base"]) == job.base
    assert swept.failed == 4
    failed = results["failure"].sel(peak_rate=110.0).values
    assert all("exceeds max_rate of axis" in reason for reason in failed)
    assert np.all(results["failure"].sel(peak_rate=[60.0, 80.0]).values == "")
    assert np.isnan(results["scale_max"].sel(peak_rate=110.0).values).all()
    assert np.isfinite(results["scale_max"].sel(peak_rate=[60.0, 80.0]).values).all()
    assert (told[0].stage, told[0].done, told[-1].done, told[-1].total) == ("predict", 0, 12, 12)
    assert already_finished(job, folder / "results.nc")
    assert not (folder / "results.nc.parts").exists()


@pytest.fixture(scope="module")
def in_pairs(done, pool):
    """The same sweep in chunks of two: the bytes of its file."""
    folder, job, *_ = done
    chunk = sys.modules["gradcal_jax.sweeps.sweep"].CHUNK
    usual, chunk["predict"] = chunk["predict"], 2
    sweep(job, folder / "pairs.nc", runner=pool)
    chunk["predict"] = usual
    return (folder / "pairs.nc").read_bytes()


def test_chunks_do_not_change_the_numbers(done, in_pairs):
    folder, *_ = done
    assert len(in_pairs) > 1000
    there, here = (read_dataset(folder / name) for name in ("results.nc", "pairs.nc"))
    for name in here.data_vars:
        np.testing.assert_array_equal(here[name].values, there[name].values)


def test_the_file_does_not_depend_on_workers_nor_on_a_killed_one(done, in_pairs, monkeypatch):
    folder, job, *_ = done
    monkeypatch.setitem(sys.modules["gradcal_jax.sweeps.sweep"].CHUNK, "predict", 2)
    with LocalPool(2) as two:
        shot = []

        def shoot(progress):
            # One of the two is killed as soon as the first chunk is done; its chunk goes to its successor.
            if progress.stage == "predict" and progress.done > progress.kept and not shot:
                shot.append(next(iter(two._executor._processes)))
                os.kill(shot[0], signal.SIGKILL)

        sweep(job, folder / "two.nc", runner=two, progress=shoot)
    assert shot
    assert (folder / "two.nc").read_bytes() == in_pairs


def _children(process: int) -> list[str]:
    threads = Path(f"/proc/{process}/task")
    return [c for t in threads.iterdir() for c in (t / "children").read_text().split()] if threads.exists() else []


def _runs(process: str) -> bool:
    stat = Path(f"/proc/{process}/stat")
    return stat.exists() and stat.read_text().rpartition(")")[2].split()[0] != "Z"


def test_a_killed_sweep_goes_on_and_ends_the_same(done, in_pairs, tmp_path):
    path, output = written(tmp_path), tmp_path / "results.nc"
    # The first time it stops after two chunks of the six, to be killed there.
    script = (
        "import sys, time; from pathlib import Path; from gradcal_jax.sweeps import sweep as s\n"
        "s.CHUNK['predict'] = 2\n"
        "from gradcal_jax.sweeps.sweep_file import read_sweep; from gradcal_jax.sweeps.pool import LocalPool\n"
        "wait = lambda p: time.sleep(600.0) if sys.argv[3:] and p.done >= 4 else None\n"
        "s.sweep(read_sweep(sys.argv[1]), Path(sys.argv[2]), runner=LocalPool(1), progress=wait)\n"
    )
    command = [sys.executable, "-c", script, str(path), str(output)]
    process = subprocess.Popen([*command, "wait"], stderr=subprocess.PIPE)
    parts = tmp_path / "results.nc.parts"
    deadline = time.monotonic() + 120.0
    while len(list(parts.glob("chunk-*.json"))) < 2 and time.monotonic() < deadline and process.poll() is None:
        time.sleep(0.002)
    workers = _children(process.pid)
    process.kill()
    process.communicate()
    while any(map(_runs, workers)) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not any(map(_runs, workers))
    kept = sorted(parts.glob("chunk-*.json"))
    assert len(kept) >= 2
    assert not output.exists()
    # A chunk that was torn is not believed.
    kept[-1].write_bytes(kept[-1].read_bytes()[:-5])
    again = subprocess.run(command, capture_output=True, check=False)
    assert again.returncode == 0, again.stderr
    assert output.read_bytes() == in_pairs


def test_what_is_kept_is_not_done_again(done, pool, tmp_path, monkeypatch):
    _, job, swept, _ = done
    monkeypatch.setitem(sys.modules["gradcal_jax.sweeps.sweep"].CHUNK, "predict", 5)
    output = tmp_path / "results.nc"
    first = chunks_of(len(Points(job)), 5)[0]
    mine = [swept.results[point]._replace(duration_s=1.0) for point in first]
    Store(output, identity_of(job)).write(0, mine)
    again = sweep(job, output, runner=pool)
    assert again.kept == len(first) == 5
    # The numbers come from the disk, the forged durations among them.
    whole = sum(not result.failure for result in mine)
    assert np.count_nonzero(read_dataset(output)["duration"].values == 1.0) == whole == 4


def test_the_parts_of_another_sweep_are_refused(done, pool, tmp_path):
    _, job, *_ = done
    output = tmp_path / "results.nc"
    Store(output, identity_of(job) | {"asked": "another"})
    with pytest.raises(ValueError, match=r"parts of another sweep \(which differs in asked\)"):
        sweep(job, output, runner=pool)
    (tmp_path / "other.nc.parts").mkdir()
    (tmp_path / "other.nc.parts" / "letter.txt").write_text("mine")
    with pytest.raises(ValueError, match="was not made by a sweep"):
        sweep(job, tmp_path / "other.nc", runner=pool)
    (tmp_path / "taken.nc").write_text("mine")
    with pytest.raises(ValueError, match="exists and belongs to another sweep"):
        sweep(job, tmp_path / "taken.nc", runner=pool)
    assert identity_in(tmp_path / "taken.nc") is None


STANDARD = """
[plan]
method = "standard"
temperatures = ["0 degC", "10 degC", "20 degC"]
soak = "10 min"
integration = "5 min"
rates = ["-100 deg/s", "0 deg/s", "100 deg/s"]
"""


def test_two_sweeps_do_not_write_into_one_folder(done, tmp_path):
    """The second one says so; the lock goes with the process that has it."""
    _, job, *_ = done
    begun = Store(tmp_path / "a.nc", identity_of(job))
    with pytest.raises(ValueError, match="another sweep is writing into"):
        Store(tmp_path / "a.nc", identity_of(job))
    begun.remove()
    Store(tmp_path / "a.nc", identity_of(job)).remove()


def test_standard_plans_and_drawn_points(tmp_path, pool):
    path = written(
        tmp_path,
        'format = "gradcal-sweep/1"\nbase = "small.toml"\n'
        '[[axis]]\nkey = "plan.integration"\nstart = "1 min"\nstop = "10 min"\n'
        '[[axis]]\nname = "walk"\nkey = "sensor.angle_random_walk"\n'
        'start = "0.05 deg/sqrt(h)"\nstop = "0.5 deg/sqrt(h)"\nspacing = "logarithmic"\n'
        '[samples]\nmethod = "latin hypercube"\ncount = 5\n',
    )
    small = tmp_path / "small.toml"
    small.write_text(small.read_text(encoding="utf-8").split("[plan]")[0] + STANDARD, encoding="utf-8")
    job = read_sweep(path)
    sweep(job, tmp_path / "results.nc", runner=pool)
    results = read_dataset(tmp_path / "results.nc")
    assert results.sizes == {"point": 5}
    assert results["walk"].dims == ("point",)
    points = Points(job)
    for index in (0, 4):
        expected = gj.predict(gj.changed(job.base, points.changes(index))).requirements[0]
        assert results["scale_mean_of_max"].values[index] == pytest.approx(expected.mean_of_max, rel=1e-12)
        said = float(points.values(index)[1].split()[0])
        assert results["walk"].values[index] == pytest.approx(said)


def test_a_dry_run_counts_times_and_writes_nothing(done, pool):
    folder, job, *_ = done
    before = sorted(folder.iterdir())
    found = dry_run(job, runner=pool)
    assert (found.points, found.failing, found.workers, found.chunks) == (12, 4, 1, 1)
    assert "exceeds max_rate of axis" in found.first_failure
    assert found.next_chunk_s > 0.0
    assert 0.0 < found.first_chunk_s <= found.seconds
    assert sorted(folder.iterdir()) == before


def test_a_sweep_of_which_no_point_is_a_spec_says_why(tmp_path, pool):
    path = written(tmp_path, GRID.replace('"60 deg/s", "80 deg/s", "110 deg/s"', '"110 deg/s"'))
    with pytest.raises(ValueError, match=r"none of the 4 points has a result.*exceeds max_rate of axis"):
        sweep(read_sweep(path), tmp_path / "results.nc", runner=pool)
    assert not (tmp_path / "results.nc.parts").exists()


def test_a_point_that_fails_does_not_take_its_neighbours_along(done, pool):
    _, job, swept, _ = done
    points = Points(job)
    base = tables_of(job.base)
    first, second = 0, 1
    share = [(first, points.changes(first)), (99, {"plan.gradient": "30 K/min"}), (second, points.changes(second))]
    ((_, found),) = pool.run([Task(0, "predict", (base, share))])
    assert "max_heating" in found[1].failure
    assert (found[0], found[2]) == (swept.results[first], swept.results[second])
