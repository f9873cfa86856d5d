"""The same sweep on a Dask cluster gives the same file, with a worker killed half way, too."""

import os
import signal

import pytest
from jobs_small import written

from gradcal_jax.sweeps.pool import Cluster, LocalPool
from gradcal_jax.sweeps.sweep import CHUNK, sweep
from gradcal_jax.sweeps.sweep_file import read_sweep

distributed = pytest.importorskip("distributed", reason="the cluster's tests need the extra: gradcal_jax[cluster]")
# What Dask's own processes leave behind when they are killed is not ours to close.
pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")


def test_an_address_where_nobody_answers_is_an_error_with_advice():
    with pytest.raises(ValueError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:9"):
        Cluster("tcp://127.0.0.1:9", timeout_s=1.0)


@pytest.mark.evidence
def test_two_workers_one_killed_half_way_give_the_same_file(tmp_path, monkeypatch):
    monkeypatch.setitem(CHUNK, "predict", 1)
    job = read_sweep(written(tmp_path))
    with LocalPool(1) as one:
        sweep(job, tmp_path / "one.nc", runner=one)
    shot: list[int] = []
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None) as cluster,
        Cluster(cluster.scheduler_address) as runner,
    ):
        assert runner.workers == 2
        victim = next(iter(cluster.workers.values())).pid

        def shoot(progress):
            if progress.stage == "predict" and progress.done >= progress.kept + 2 and not shot:
                shot.append(victim)
                os.kill(victim, signal.SIGKILL)

        sweep(job, tmp_path / "two.nc", runner=runner, progress=shoot)
    assert shot
    assert (tmp_path / "two.nc").read_bytes() == (tmp_path / "one.nc").read_bytes()
