"""Sweeps from end to end, in real worker processes: right, the same for any number of workers, and resumed."""

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from jobs_small import GRID, compiled_programs, written

import gradcal_jax as gj
from gradcal_jax.files.sweep import read_sweep
from gradcal_jax.jobs.dataset import identity_in, read_dataset
from gradcal_jax.jobs.points import Points
from gradcal_jax.jobs.pool import LocalPool, Task
from gradcal_jax.jobs.store import Store
from gradcal_jax.jobs.sweep import CHUNK, chunks_of, dry_run, finished, identity_of, survey, sweep


@pytest.fixture(scope="module")
def pool():
    with LocalPool(1, compiled_programs()) as workers:
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
        assert results[f"scale_{name}"].values[place] == pytest.approx(getattr(scale, name), rel=1e-9)
    assert results["bias_mean"].values[place] == pytest.approx(bias.mean, rel=1e-9)
    assert results["scale_verdict"].values[place] == scale.verdict
    assert results["duration"].values[place] == pytest.approx(expected.duration_s)


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
    assert all("exceeds rig.table.max_rate" in reason for reason in failed)
    assert np.all(results["failure"].sel(peak_rate=[60.0, 80.0]).values == "")
    assert np.isnan(results["scale_max"].sel(peak_rate=110.0).values).all()
    assert np.isfinite(results["scale_max"].sel(peak_rate=[60.0, 80.0]).values).all()
    assert (told[0].stage, told[-1].done, told[-1].total) == ("reading", 12, 12)
    assert finished(job, folder / "results.nc")
    assert not (folder / "results.nc.parts").exists()


@pytest.fixture(scope="module")
def in_pairs(done, pool):
    """The same sweep in chunks of two: the bytes of its file."""
    folder, job, *_ = done
    chunk = sys.modules["gradcal_jax.jobs.sweep"].CHUNK
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
    monkeypatch.setitem(sys.modules["gradcal_jax.jobs.sweep"].CHUNK, "predict", 2)
    with LocalPool(2, compiled_programs()) as two:
        shot = []

        def shoot(progress):
            # One of the two is killed as soon as the first chunk is done; its chunk goes to its successor.
            if progress.stage == "predict" and progress.done > progress.kept and not shot:
                shot.append(two._all[0]._process.pid)
                os.kill(shot[0], signal.SIGKILL)

        sweep(job, folder / "two.nc", runner=two, progress=shoot)
    assert shot
    assert (folder / "two.nc").read_bytes() == in_pairs


def test_a_killed_sweep_goes_on_and_ends_the_same(done, in_pairs, tmp_path):
    path, output = written(tmp_path), tmp_path / "results.nc"
    script = (
        "import sys; from pathlib import Path; from gradcal_jax.jobs import sweep as s; s.CHUNK['predict'] = 2\n"
        "from gradcal_jax.files.sweep import read_sweep; from gradcal_jax.jobs.pool import LocalPool\n"
        "s.sweep(read_sweep(sys.argv[1]), Path(sys.argv[2]), runner=LocalPool(1, sys.argv[3]))\n"
    )
    command = [sys.executable, "-c", script, str(path), str(output), compiled_programs()]
    process = subprocess.Popen(command, stderr=subprocess.PIPE)
    parts = tmp_path / "results.nc.parts"
    deadline = time.monotonic() + 120.0
    while len(list(parts.glob("chunk-*.json"))) < 2 and time.monotonic() < deadline and process.poll() is None:
        time.sleep(0.002)
    process.kill()
    process.communicate()
    kept = sorted(parts.glob("chunk-*.json"))
    assert len(kept) >= 2
    assert not output.exists()
    # A chunk that was torn is not believed.
    kept[-1].write_bytes(kept[-1].read_bytes()[:-5])
    again = subprocess.run(command, capture_output=True, check=False)
    assert again.returncode == 0, again.stderr
    assert output.read_bytes() == in_pairs


def test_what_is_kept_is_not_done_again(done, pool, tmp_path):
    _, job, swept, _ = done
    output = tmp_path / "results.nc"
    first = chunks_of(survey(job, Points(job), pool), CHUNK["predict"])[0].points
    mine = [swept.results[point]._replace(duration_s=1.0) for point in first]
    Store(output, identity_of(job)).write(0, mine)
    again = sweep(job, output, runner=pool)
    assert again.kept == len(first) + 4
    # The numbers come from the disk, the forged durations among them.
    assert np.count_nonzero(read_dataset(output)["duration"].values == 1.0) == len(first)


def test_the_parts_of_another_sweep_are_refused(done, pool, tmp_path):
    _, job, *_ = done
    output = tmp_path / "results.nc"
    Store(output, identity_of(job) | {"asked": "another"})
    with pytest.raises(ValueError, match=r"parts of another sweep \(different: asked\)"):
        sweep(job, output, runner=pool)
    (tmp_path / "other.nc.parts").mkdir()
    (tmp_path / "other.nc.parts" / "letter.txt").write_text("mine")
    with pytest.raises(ValueError, match="is not a sweep's"):
        sweep(job, tmp_path / "other.nc", runner=pool)
    (tmp_path / "taken.nc").write_text("mine")
    with pytest.raises(ValueError, match="exists and is not of this sweep"):
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
        assert results["scale_mean_of_max"].values[index] == pytest.approx(expected.mean_of_max, rel=1e-9)
        said = float(points.values(index)[1].split()[0])
        assert results["walk"].values[index] == pytest.approx(said)


def test_a_dry_run_counts_times_and_writes_nothing(done, pool):
    folder, job, *_ = done
    before = sorted(folder.iterdir())
    found = dry_run(job, runner=pool)
    assert (found.points, found.failing, found.workers) == (12, 4, 1)
    assert 1 <= found.programs <= found.chunks
    assert 0.0 < found.next_chunk_s <= found.seconds
    assert sorted(folder.iterdir()) == before


def test_a_sweep_of_which_no_point_is_a_spec_says_why(tmp_path, pool):
    path = written(tmp_path, GRID.replace('"60 deg/s", "80 deg/s", "110 deg/s"', '"110 deg/s"'))
    with pytest.raises(ValueError, match=r"not one of the 4 points is a spec.*exceeds rig\.table\.max_rate"):
        sweep(read_sweep(path), tmp_path / "results.nc", runner=pool)
    assert not (tmp_path / "results.nc.parts").exists()


def test_a_point_that_fails_does_not_take_its_neighbours_along(done, pool):
    _, job, swept, _ = done
    points = Points(job)
    base = gj.tables_of(job.base)
    chunk = chunks_of(survey(job, points, pool), CHUNK["predict"])[0]
    first, second = chunk.points[:2]
    share = [(first, points.changes(first)), (99, {"plan.gradient": "30 K/min"}), (second, points.changes(second))]
    ((_, found),) = pool.run([Task(0, "predict", (base, share, chunk.rooms))])
    assert "max_heating" in found[1].failure
    assert (found[0], found[2]) == (swept.results[first], swept.results[second])
