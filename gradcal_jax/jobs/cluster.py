"""Tasks on a Dask cluster, by its scheduler's address (extra `cluster`).

A Dask worker does its tasks in its own process, whatever that may use; Dask repeats the chunk of a killed worker on
another one.
"""

from collections.abc import Iterable, Iterator
from typing import Any

from gradcal_jax.jobs.pool import Task, TaskRunner
from gradcal_jax.jobs.worker import do


class Cluster(TaskRunner):
    """A `pool.TaskRunner` on a Dask cluster. Errors: `ValueError` without the extra, or where no scheduler answers."""

    def __init__(self, address: str, *, timeout_s: float = 20.0):
        try:
            from distributed import Client
        except ImportError:
            raise ValueError(
                "a cluster needs Dask: install gradcal_jax[cluster], here and on the cluster's workers"
            ) from None
        try:
            self._client = Client(address, timeout=timeout_s, set_as_default=False)
        except (OSError, ValueError, TimeoutError) as error:
            raise ValueError(
                f"no Dask scheduler answers at {address} ({error}); start one with `dask scheduler` and "
                "`dask worker ADDRESS`"
            ) from None
        self.workers = max(1, sum(w["nthreads"] for w in self._client.scheduler_info(n_workers=-1)["workers"].values()))

    def run(self, tasks: Iterable[Task]) -> Iterator[tuple[int, Any]]:
        from distributed import as_completed

        futures = {self._client.submit(do_on_cluster, task, pure=False, retries=2): task.key for task in tasks}
        with self._client.as_current():
            completed = as_completed(futures)
        for future in completed:
            error = future.exception() if future.status != "finished" else None
            yield futures[future], future.result() if error is None else error
            future.release()

    def close(self) -> None:
        self._client.close()


def do_on_cluster(task: Task) -> Any:
    """Do a task in a Dask worker."""
    import jax

    jax.config.update("jax_enable_x64", True)
    return do(task.name, task.arguments)
