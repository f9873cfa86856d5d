"""A sweep gives what `predict` gives, whatever is killed on the way; its results carry their units and their file."""

import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from jobs_small import GRID, written

import gradcal_jax as gj
from gradcal_jax.spec.changes import tables_of
from gradcal_jax.sweeps.sweep import (
    changes_of,
    dataset_of,
    evaluate,
    identity_of,
    kept_records,
    local_workers,
    sweep,
)
from gradcal_jax.sweeps.sweep_file import parse_sweep, read_sweep

IMU = """format = "gradcal-sweep/1"
base = "accelerometer-six-positions"
[[axis]]
key = "rig.table.tilt"
values = ["10 urad", "1 mrad", "a lot"]
"""


@pytest.fixture(scope="module")
def pool():
    with local_workers(1) as workers:
        yield workers


@pytest.fixture(scope="module")
def done(tmp_path_factory, pool):
    """The grid, once: its job and its results."""
    folder = tmp_path_factory.mktemp("grid")
    job = read_sweep(written(folder))
    sweep(job, folder / "results.nc", workers=pool)
    assert not (folder / "results.nc.parts").exists()
    return job, gj.read_dataset(folder / "results.nc")


def test_every_point_is_what_predict_says(done):
    job, results = done
    assert results.sizes == {"rest": 4, "peak_rate": 3}
    expected = gj.predict(gj.changed(job.base, changes_of(job)[7]))
    place = np.unravel_index(7, (4, 3))
    scale, bias = expected.requirements
    for name in ("mean_of_max", "max", "mean", "rms"):
        assert results[f"scale_{name}"].values[place] == pytest.approx(getattr(scale, name), rel=1e-12)
    assert results["bias_mean"].values[place] == pytest.approx(bias.mean, rel=1e-12)
    assert results["scale_verdict"].values[place] == scale.verdict
    assert results["duration"].values[place] == pytest.approx(expected.duration_s)


def test_results_carry_their_units_their_file_and_their_failures(done):
    job, results = done
    assert results["scale_mean_of_max"].attrs["units"] == "ppm"
    assert results["bias_mean"].attrs["units"] == "deg/h"
    assert "bias_mean_of_max" not in results
    assert results["rest"].attrs["units"] == "s"
    np.testing.assert_allclose(results["rest"], [3.0, 4.0, 5.0, 6.0])
    assert results.attrs["sweep"] == job.text
    assert gj.parse_spec(results.attrs["base"]) == job.base
    assert json.loads(results.attrs["identity"]) == identity_of(job)
    failed = results["failure"].values != ""
    assert failed.sum() == 4
    assert failed[:, 2].all()
    assert "exceeds max_rate of axis" in results["failure"].values[0, 2]
    assert np.isnan(results["scale_mean"].values[failed]).all()


def test_a_killed_worker_changes_nothing(done, tmp_path):
    job, results = done
    shot: list[int] = []
    with local_workers(2) as pool:

        def shoot(count, total):
            if count >= 1 and not shot:
                shot.append(next(iter(pool()._processes)))
                os.kill(shot[0], signal.SIGKILL)

        again = sweep(job, tmp_path / "again.nc", workers=pool, progress=shoot)
    assert shot
    assert again.equals(results)


@pytest.mark.long
def test_a_killed_sweep_goes_on_and_ends_the_same(done, tmp_path):
    path, output = written(tmp_path), tmp_path / "results.nc"
    # The first time it stops after four points of the twelve, to be killed there.
    script = (
        "import sys, time\nfrom gradcal_jax.sweeps.sweep import local_workers, sweep\n"
        "from gradcal_jax.sweeps.sweep_file import read_sweep\n"
        "def wait(done, total):\n    time.sleep(600.0 if sys.argv[3:] and done >= 4 else 0.0)\n"
        "with local_workers(1) as workers:\n"
        "    sweep(read_sweep(sys.argv[1]), sys.argv[2], workers=workers, most=1, progress=wait)\n"
    )
    command = [sys.executable, "-c", script, str(path), str(output)]
    process = subprocess.Popen([*command, "wait"])
    parts = tmp_path / "results.nc.parts"
    deadline = time.monotonic() + 120.0
    while not (parts.exists() and parts.read_text().count("\n") >= 5):
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.05)
    process.kill()
    process.wait()
    assert not output.exists()
    # A line that was torn is not believed.
    parts.write_bytes(parts.read_bytes()[:-9])
    again = subprocess.run(command, capture_output=True, check=False)
    assert again.returncode == 0, again.stderr
    assert gj.read_dataset(output).equals(done[1])


def test_what_is_kept_is_not_done_again_and_belongs_to_one_sweep(done, pool, tmp_path):
    job, _ = done
    parts = tmp_path / "results.nc.parts"
    forged = evaluate("predict", json.dumps(tables_of(job.base)), {}) | {"duration": 1.0}
    parts.write_text("".join(json.dumps(line) + "\n" for line in (identity_of(job), [0, forged])))
    results = sweep(job, tmp_path / "results.nc", workers=pool)
    assert np.count_nonzero(results["duration"].values == 1.0) == 1
    (tmp_path / "other.nc.parts").write_text(json.dumps(identity_of(job) | {"asked": "another"}) + "\n")
    with pytest.raises(ValueError, match="points of another sweep"):
        sweep(job, tmp_path / "other.nc", workers=pool)
    with pytest.raises(ValueError, match="exists; choose another output"):
        sweep(job, tmp_path / "results.nc", workers=pool)


def test_two_sweeps_do_not_write_into_one_file(tmp_path):
    second = kept_records(tmp_path / "a.parts", {})
    with kept_records(tmp_path / "a.parts", {}), pytest.raises(ValueError, match="another sweep is writing into"):
        second.__enter__()
    assert not (tmp_path / "a.parts").exists()


def test_a_sweep_of_which_no_point_is_a_spec_says_why(tmp_path, pool):
    path = written(tmp_path, GRID.replace('"60 deg/s", "80 deg/s", "110 deg/s"', '"110 deg/s"'))
    with pytest.raises(ValueError, match=r"none of the 4 points has a result.*exceeds max_rate of axis"):
        sweep(read_sweep(path), tmp_path / "results.nc", workers=pool)


def test_an_axis_with_the_name_of_a_result_has_the_name_of_its_key():
    """The soak is a key of the plan, and its whole duration a result."""
    job = parse_sweep(IMU.replace("rig.table.tilt", "plan.soak").replace('"10 urad", "1 mrad", "a lot"', '"1 h"'))
    results = dataset_of(job, [{"failure": "", "soak": 3600.0}])
    assert results["soak"].dims == ("plan_soak",)
    assert results["plan_soak"].attrs["long_name"] == "soak"


def test_an_imu_is_swept():
    job = parse_sweep(IMU)
    base = json.dumps(tables_of(job.base))
    points = changes_of(job)
    first, _, wrong = (evaluate("predict", base, changes) for changes in points)
    assert "rig.table.tilt" in wrong["failure"]
    for k, row in enumerate(gj.predict(gj.changed(job.base, points[0])).requirements):
        assert first[f"{k} {row.statistic}"] == pytest.approx(row.decisive, rel=1e-12)
