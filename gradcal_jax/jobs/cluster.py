"""Tasks on a Dask cluster, by its scheduler's address (extra `cluster`).

Each Dask worker passes its tasks to a worker process (`gradcal_jax.jobs.worker`), so that a cluster computes the same
bits as one machine of its kind. Dask repeats the chunk of a killed worker on another one.
"""

import threading
from collections.abc import Iterable, Iterator
from typing import Any

from gradcal_jax.jobs.pool import Task, TaskRunner, tried
from gradcal_jax.jobs.worker import Worker


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

        futures = {self._client.submit(do, task, pure=False, retries=2): task.key for task in tasks}
        with self._client.as_current():
            completed = as_completed(futures)
        for future in completed:
            error = future.exception() if future.status != "finished" else None
            yield futures[future], future.result() if error is None else error
            future.release()

    def close(self) -> None:
        self._client.close()


_HERE = threading.local()


def do(task: Task) -> Any:
    """Do a task in the process of this thread; runs in a thread of a Dask worker."""
    if not hasattr(_HERE, "worker"):
        _HERE.worker = Worker()
    return tried(_HERE.worker, task)
