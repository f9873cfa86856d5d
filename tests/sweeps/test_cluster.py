"""The same sweep on a Dask cluster gives the same results, with a worker killed half way, too."""

import os
import signal

import pytest
from jobs_small import written

from gradcal_jax.sweeps.sweep import local_workers, sweep
from gradcal_jax.sweeps.sweep_file import read_sweep

distributed = pytest.importorskip("distributed", reason="the cluster's tests need the extra: gradcal_jax[cluster]")
# What Dask's own processes leave behind when they are killed is not ours to close.
pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")


@pytest.mark.long
def test_two_workers_one_killed_half_way_give_the_same_results(tmp_path):
    job = read_sweep(written(tmp_path))
    with local_workers(1) as one:
        expected = sweep(job, tmp_path / "one.nc", workers=one)
    shot: list[int] = []
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None) as cluster,
        distributed.Client(cluster, set_as_default=False) as client,
    ):
        victim = next(iter(cluster.workers.values())).pid

        def shoot(done, total):
            if done >= 2 and not shot:
                shot.append(victim)
                os.kill(victim, signal.SIGKILL)

        found = sweep(
            job, tmp_path / "two.nc", workers=lambda: client.get_executor(pure=False, retries=2), progress=shoot
        )
    assert shot
    assert found.equals(expected)
